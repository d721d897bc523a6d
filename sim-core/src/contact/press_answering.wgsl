const PRESSED_BODIES: u32 = ANSWERING;

// Blocks in a body's box, as `answer.wgsl` counts them: the first, and how many along each axis. Kept for where the forces go.
var<private> pressed_first: vec3<i32>;
var<private> pressed_size: vec3<i32>;

fn pressed_body(b: u32) -> PressedBody {
    let k = layer_now / LEVELS * ANSWERING + b;
    let level = level_of(layer_now);
    let shrink = shrink_of(layer_now);
    let at = state_of_body(k, state_now());
    let head = answering[body_head(k)];
    let cell = bitcast<vec3<i32>>(answering[at].xyz);
    let place = place_of(answering[at + 1u]);
    let number = head.x;
    let base = cell >> vec3<u32>(level);
    let rows = rows_of(rotation_of(answering[at + 2u]));
    let nodes = nodes_near(number, rows, cell, place, level, shrink);
    pressed_first = nodes[0] >> vec3<u32>(2u);
    pressed_size = (nodes[1] >> vec3<u32>(2u)) - pressed_first + vec3<i32>(1);
    var most = nodes[1];
    // It meets no level beyond.
    if level >= head.y {
        most = nodes[0] - vec3<i32>(1);
    }
    return PressedBody(nodes[0], most, base, in_level(cell, place, vec3<f32>(0.0), level, shrink), rows, number);
}

// The cell that the body's reference point is in.
fn pressed_cell(b: u32) -> vec3<i32> {
    let k = layer_now / LEVELS * ANSWERING + b;
    return bitcast<vec3<i32>>(answering[state_of_body(k, state_now())].xyz) >> vec3<u32>(level_of(layer_now));
}

// Is it so far from a block that its box need not be asked? Contact thickens a thin body by a cell.
fn may_be_near(b: u32, first: vec3<i32>) -> bool {
    let k = layer_now / LEVELS * ANSWERING + b;
    let cell = pressed_cell(b);
    let reach = i32(ceil(min(real(answering[body_head(k)]).w * shrink_of(layer_now), 1e6) + REACH)) + 3;
    return all(first + vec3<i32>(3) >= cell - vec3<i32>(reach)) && all(first <= cell + vec3<i32>(reach));
}

// May a node of the block be within reach of its surface? Boxes of long bodies that lean are mostly empty. The block's nodes are within 2.6 cells of its
// middle.
fn is_within_reach(body: PressedBody, first: vec3<i32>) -> bool {
    let width = H / shrink_of(layer_now);
    let arm = (vec3<f32>(first + vec3<i32>(2) - body.cell) - body.place) * width;
    let middle = arm.x * body.rows[0] + arm.y * body.rows[1] + arm.z * body.rows[2];
    return coupling_distance(body.number, middle, width) <= (REACH + 3.0) * width;
}

// Notes that there is a block of nodes near it in this slot.
fn note_near(b: u32) {
    answering[near_at(layer_now / LEVELS * ANSWERING + b, level_of(layer_now))].x = slot_now() + 1u;
}

fn put_pressed(b: u32, g: u32, block: vec3<i32>, n: u32, force: vec3<f32>) {
    let at = vec3<u32>(block - pressed_first);
    let size = vec3<u32>(pressed_size);
    let room = at.x + size.x * (at.y + size.y * at.z);
    let body = layer_now / LEVELS * ANSWERING + b;
    if room < rooms_of(body).y {
        answering[pressed_at(body, level_of(layer_now), room, n)] = bitcast<vec4<u32>>(vec4<f32>(force, 0.0));
    }
}
