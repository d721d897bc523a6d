// How far to go along a step of Newton's method, as `search.rs`. One thread knows of it.
const SEARCH_BALANCED: f32 = 0.2;
const SEARCH_TRIES: u32 = 20u;
const SEARCH_HALVED: u32 = 3u;

// What is out of balance along the step before it; the part tried last; parts on either side of the place that is looked for, and what is out of
// balance there; which of them moved last; places tried.
struct Search { before: f32, part: f32, low: vec2<f32>, high: vec2<f32>, moved: f32, tries: u32 }
var<private> search: Search;

// All of a step is tried first, before which so much is out of balance along it [J].
fn search_from(before: f32) {
    search = Search(before, 1.0, vec2<f32>(0.0, before), vec2<f32>(1.0, 0.0), 0.0, 1u);
}

// The part of the step that was tried last.
fn search_part() -> f32 {
    return search.part;
}

// How much further to go, as a part of the step, where so much is out of balance along it, of which rounding may be some [J]; 0 if what was tried will do.
fn search_on(left: f32, noise: f32) -> f32 {
    let most = SEARCH_BALANCED * search.before + noise;
    let will_do = left >= -most && (left <= most || search.part == 1.0);
    if search.before <= 0.0 || will_do || search.tries == SEARCH_TRIES {
        return 0.0;
    }
    search.tries++;
    let side = select(1.0, -1.0, left < 0.0);
    if side < 0.0 {
        search.high = vec2<f32>(search.part, left);
        search.low.y *= select(1.0, 0.5, search.moved == side);
    } else {
        search.low = vec2<f32>(search.part, left);
        search.high.y *= select(1.0, 0.5, search.moved == side);
    }
    search.moved = side;
    let low = search.low;
    let high = search.high;
    var part = (low.x * high.y - high.x * low.y) / (high.y - low.y);
    if search.tries % SEARCH_HALVED == 0u {
        part = 0.5 * (low.x + high.x);
    }
    let further = part - search.part;
    search.part = part;
    return further;
}
