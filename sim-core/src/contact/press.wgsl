// How particles press on bodies: for each node of a block near one, the sum of their greatest forces [N], in the body's frame. Each particle
// gives to the eight nodes around it, by linear weights. Sums are of whole numbers, so that their order does not matter.

// These are two: so many of the first one's unit make a modulus times the square of a cell's width, and so many of the second one's the first one's unit.
const COARSE_UNITS: f32 = 4096.0;
const FINE_UNITS: f32 = 524288.0;
// How far a particle's half may reach [cells].
const PRESS_HALF: f32 = 0.7;

// There are PRESSING threads, as the backend says. So many of them write a node each, and so many particles near a body are dealt to all at a time. Each
// looks at so many cells before it waits for the others.
const NODES: u32 = 64u;
const DEALT: u32 = 4u * PRESSING;
const LOOKED_AT: u32 = 256u / PRESSING;

var<workgroup> go: u32;
// The bodies near the block, as bits: as threads find them, then to be read by all.
const NEAR_WORDS: u32 = (PRESSED_BODIES + 31u) / 32u;
var<workgroup> found_near: array<atomic<u32>, NEAR_WORDS>;
var<workgroup> near: array<u32, NEAR_WORDS>;
var<workgroup> layer: u32;
// How far particles have drifted from their cells at most [cells].
var<workgroup> drifted: f32;
var<workgroup> sums: array<atomic<i32>, 384>;
// Particles near a body, as threads find them, then to be read by all.
var<workgroup> found: atomic<u32>;
var<workgroup> sought: u32;
// Where they stand, and the first cell of their block, counted from the first of the nodes' block.
var<workgroup> dealt: array<vec2<u32>, DEALT>;

// The greatest modulus of the world's materials [Pa].
fn greatest_modulus() -> f32 {
    var most = 0.0;
    for (var m = 0u; m < MATERIALS; m++) {
        most = max(most, coupling_table(MODULI + m).x);
    }
    return most;
}

@compute @workgroup_size(PRESSING)
fn press(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let g = group.y * extent.row + group.x;
    let entry = (extent.block_room + min(g, extent.node_room - 1u)) * ENTRY;
    if thread == 0u {
        go = u32(atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]));
        layer = u32(lists[entry].w);
        go = select(0u, go, is_live(layer));
        drifted = 1.0;
        if !SUBCYCLED {
            // P2G has noted it; finer levels that step more often have moved since.
            drifted = min(bitcast<f32>(atomicLoad(&status[step_word(step.number, layer, DRIFT)])), 1.0);
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    layer_now = workgroupUniformLoad(&layer);
    let own_first = lists[entry].xyz * 4;
    for (var b = thread; b < PRESSED_BODIES; b += PRESSING) {
        let first = image_near(layer_now, own_first, pressed_cell(b));
        if !may_be_near(b, first) {
            continue;
        }
        let body = pressed_body(b);
        if all(first + vec3<i32>(3) >= body.least) && all(first <= body.most) && is_within_reach(body, first) {
            atomicOr(&found_near[b >> 5u], 1u << (b & 31u));
            note_near(b);
        }
    }
    workgroupBarrier();
    for (var word = thread; word < NEAR_WORDS; word += PRESSING) {
        near[word] = atomicLoad(&found_near[word]);
    }
    let drift = workgroupUniformLoad(&drifted);
    // Only bodies near the block are gone through, not all of the scene.
    for (var word = 0u; word < NEAR_WORDS; word++) {
        for (var bits = workgroupUniformLoad(&near[word]); bits != 0u; bits &= bits - 1u) {
            press_on(32u * word + firstTrailingBit(bits), g, entry, drift, thread);
        }
    }
    end_pressed(g, thread);
}

// How particles, which have drifted from their cells by at most `drift` [cells], press on one body at the nodes of the block.
fn press_on(b: u32, g: u32, entry: u32, drift: f32, thread: u32) {
    let width = extent.world.cell / shrink_of(layer_now);
    let own_first = lists[entry].xyz * 4;
    // Cells by whose particles the block's nodes may be reached: a cell around it, and one more if they may have drifted by half of one. And how far from the
    // middle of a cell the end of a particle may be, which stands in its corner and has drifted.
    let margin = select(2u, 1u, drift < 0.49);
    let side = 4u + 2u * margin;
    let near_by = (PRESS_HALF + 1.7321 * (0.51 + drift)) * width;
    let unit = greatest_modulus() * width * width / COARSE_UNITS;
    let body = pressed_body(b);
    let first = image_near(layer_now, own_first, pressed_cell(b));
    // From the body's reference point to the block's first cell [cells].
    let corner = vec3<f32>(first - body.cell) - body.place;
    for (var start = 0u; start < side * side * side; start += LOOKED_AT * PRESSING) {
        // Of each cell that is near: its block, its number in there, its particles, and their first place among those of all threads.
        var near_cells: array<vec4<u32>, LOOKED_AT>;
        for (var k = 0u; k < LOOKED_AT; k++) {
            let c = start + k * PRESSING + thread;
            near_cells[k] = vec4<u32>(0u);
            if c >= side * side * side {
                continue;
            }
            let cell = nth_cell(c, side, margin);
            let block = block_beside(entry, cell >> vec3<u32>(2u));
            if block == NONE {
                continue;
            }
            let in_block = vec3<u32>(cell & vec3<i32>(3));
            let own = (in_block.x << 4u) | (in_block.y << 2u) | in_block.z;
            let held = cells[block * 64u + own + 1u] - cells[block * 64u + own];
            let arm = (corner + vec3<f32>(cell) + vec3<f32>(0.5)) * width;
            let middle = arm.x * body.rows[0] + arm.y * body.rows[1] + arm.z * body.rows[2];
            if held > 0u && coupling_distance(body.number, middle, width) <= near_by {
                near_cells[k] = vec4<u32>(block, own, held, atomicAdd(&found, held));
            }
        }
        workgroupBarrier();
        if thread == 0u {
            sought = atomicExchange(&found, 0u);
        }
        let all = workgroupUniformLoad(&sought);
        for (var from_here = 0u; from_here < all; from_here += DEALT) {
            let end = min(from_here + DEALT, all);
            for (var k = 0u; k < LOOKED_AT; k++) {
                let one = near_cells[k];
                let beside = pack_block(nth_cell(start + k * PRESSING + thread, side, margin) >> vec3<u32>(2u));
                for (var at = max(one.w, from_here); at < min(one.w + one.z, end); at++) {
                    dealt[at - from_here] = vec2<u32>(slot_of(one.x, one.y, at - one.w), u32(beside));
                }
            }
            workgroupBarrier();
            for (var i = thread; i < end - from_here; i += PRESSING) {
                press_of(dealt[i], body.number, corner, body.rows, width, unit);
            }
            workgroupBarrier();
        }
    }
    if thread < NODES {
        let sum = vec3<f32>(sum_at(thread), sum_at(64u + thread), sum_at(128u + thread));
        put_pressed(b, body, g, first, thread, sum * unit);
    }
    workgroupBarrier();
}

// The cell with that number of a cube with so many along a side, which begins `margin` before the block of nodes, counted from the block's first.
fn nth_cell(c: u32, side: u32, margin: u32) -> vec3<i32> {
    return vec3<i32>(vec3<u32>(c / (side * side), (c / side) % side, c % side)) - vec3<i32>(i32(margin));
}

// Blocks beside the nodes' one, by an offset of -1, 0 or 1 along each axis.
fn pack_block(to: vec3<i32>) -> i32 {
    return ((to.x + 1) << 4u) | ((to.y + 1) << 2u) | (to.z + 1);
}

fn unpack_block(packed: u32) -> vec3<i32> {
    return vec3<i32>(vec3<u32>(packed >> 4u, (packed >> 2u) & 3u, packed & 3u)) - vec3<i32>(1);
}

// Powers are not exact to the last digits, and a particle that just touches a body makes all of them count.
fn cube_root(x: f32) -> f32 {
    let guess = pow(x, 1.0 / 3.0);
    return guess - (guess - x / (guess * guess)) / 3.0;
}

// Adds to a sum, in the first unit.
fn add_to(at: u32, part: f32) {
    let coarse = round(part);
    if coarse != 0.0 {
        atomicAdd(&sums[at], i32(coarse));
    }
    atomicAdd(&sums[192u + at], i32(round((part - coarse) * FINE_UNITS)));
}

// What a sum came to, and begins it anew.
fn sum_at(at: u32) -> f32 {
    return f32(atomicExchange(&sums[at], 0)) + f32(atomicExchange(&sums[192u + at], 0)) / FINE_UNITS;
}

// The block with particles beside a block of nodes, by an offset along each axis.
fn block_beside(entry: u32, to: vec3<i32>) -> u32 {
    // Entries go by the offset from those to these.
    let by = vec3<i32>(1) - to;
    let which = u32(by.x * 9 + by.y * 3 + by.z);
    return u32(lists[entry + 1u + (which >> 2u)][which & 3u]);
}

// What a particle gives to the nodes of the block: it stands there, in the block beside.
fn press_of(one: vec2<u32>, body: u32, corner: vec3<f32>, rows: array<vec3<f32>, 3>, width: f32, unit: f32) {
    let place = record_of(one.x, 0u);
    let weight = bitcast<f32>(record_of(one.x, 1u).w);
    let now = cell_of(place.w) + unpack_block(one.y) * 4;
    if any(now < vec3<i32>(-1)) || any(now > vec3<i32>(4)) {
        return;
    }
    let f = fraction(place);
    let arm = (corner + vec3<f32>(now) + f) * width;
    let material = coupling_table(MODULI + law_of(place.w));
    let half = 0.5 * cube_root(weight * material.y);
    let force = coupling_press(body, arm.x * rows[0] + arm.y * rows[1] + arm.z * rows[2], half, material.x, width) / unit;
    if all(force == vec3<f32>(0.0)) {
        return;
    }
    // Nodes stand at the centres of cells.
    let least = floor(f - 0.5);
    let beyond = f - 0.5 - least;
    for (var k = 0u; k < 8u; k++) {
        let to = vec3<u32>(k >> 2u, (k >> 1u) & 1u, k & 1u);
        let node = now + vec3<i32>(least) + vec3<i32>(to);
        if any(node < vec3<i32>(0)) || any(node > vec3<i32>(3)) {
            continue;
        }
        let n = u32((node.x << 4u) | (node.y << 2u) | node.z);
        let weights = select(1.0 - beyond, beyond, to == vec3<u32>(1u));
        let part = (weights.x * weights.y * weights.z) * force;
        add_to(n, part.x);
        add_to(64u + n, part.y);
        add_to(128u + n, part.z);
    }
}
