// Parts of walls and what the ground gives to them. Parts stand behind the sections: the first cell and the wall's number, twice its axis, and one more at the greater end;
// then one past the last cell. Of the twelve numbers of a part's sums the last three of the first six are what it has taken [N s]; those of the others what it takes
// through rims if the step under way turns out to be short enough.
const CROSSED: u32 = 48u;
const PENDING_PART: u32 = 24u;

// Of a thread, by parts [N s].
var<private> pressed: array<vec3<f32>, PARTS>;

fn forget() {
    for (var k = 0u; k < PARTS; k++) {
        pressed[k] = vec3<f32>(0.0);
    }
}

// Notes what a wall gives at a node behind it. What lies behind another wall counts where that begins.
fn see(layer: u32, wall: u32, cell: vec3<i32>, impulse: vec3<f32>) {
    var at = clamp(cell, world_min(layer), world_max(layer) - vec3<i32>(1));
    for (var d = 0u; d < 3u; d++) {
        if IS_PERIODIC[d] {
            let period = 4 * (extent.world.period[d] >> level_of(layer));
            at[d] = world_min(layer)[d] + (((cell[d] - world_min(layer)[d]) % period) + period) % period;
        }
    }
    for (var k = 0u; k < PARTS; k++) {
        let part = PLACE * (layer * PROBED + SECTIONS + k);
        let least = bitcast<vec3<i32>>(vec3<u32>(probed_word(part), probed_word(part + 1u), probed_word(part + 2u)));
        let end = bitcast<vec3<i32>>(vec3<u32>(probed_word(part + 4u), probed_word(part + 5u), probed_word(part + 6u)));
        let across = vec3<u32>(0u, 1u, 2u) == vec3<u32>(wall / 2u);
        if probed_word(part + 3u) == wall && all(across | ((at >= least) & (at < end))) {
            pressed[k] -= impulse;
        }
    }
}

// Where the numbers of a part stand.
fn sums_of_part(world: u32, k: u32) -> u32 {
    return PLACE * LAYERS * PROBED + CROSSED * (world * PROBED + SECTIONS + k) + 12u;
}

// Adds what a thread has noted to one or the other sums.
fn add_pressed(layer: u32, which: u32) {
    for (var k = 0u; k < PARTS; k++) {
        for (var d = 0u; d < 3u; d++) {
            if pressed[k][d] != 0.0 {
                add_exactly(sums_of_part(layer / LEVELS, k) + which + 4u * d, pressed[k][d]);
            }
        }
    }
}
