// Free bodies, which the device moves by itself for the steps of a submission. Lengths are in cells of the finest level but where units are given.
//
// For each, world by world, there stand in `lent` LENT vectors that stay: three rows of the inertia, body frame [kg m2], with mass [kg], its
// inverse, and the extent; three rows of the inertia's inverse, with the body's number, how far a surface may move in a step, and
// how many levels it meets, none if there is no such body; the leash: least and greatest displacement; and the cell and the place in it at the start.
// Behind those there stand the states before each slot, after the last, and one that is not read: cell; place in it, in 2^-32, and how far turning has
// moved the surface; rotation (x, y, z, w), in 2^-30; velocity [m/s], and nodes deep inside; angular
// momentum [kg m2/s], and solutions that did not converge; and, in the slot before, impulse [N s] and angular impulse [N m s] from the ground.
// All that a state holds, doubles hold, too: it does not matter how steps are cut into submissions.
const LENT: u32 = 10u;
const STATE: u32 = 7u;
const WORLDS: u32 = LAYERS / LEVELS;
const SUBSTEPS: u32 = select(1u, 1u << (LEVELS - 1u), SUBCYCLED);

fn state_at(k: u32, slot: u32) -> u32 {
    return WORLDS * FREES * LENT + (slot * WORLDS * FREES + k) * STATE;
}

// Number of the state in which levels find bodies: subcycled, coarser ones after the finest level's step.
fn state_now() -> u32 {
    return slot_now() + select(0u, 1u, SUBCYCLED && step.first_level > 0u);
}

fn real(v: vec4<u32>) -> vec4<f32> {
    return bitcast<vec4<f32>>(v);
}

fn place_of(v: vec4<u32>) -> vec3<f32> {
    return vec3<f32>(v.xyz) * 2.3283064365386963e-10;
}

fn rotation_of(v: vec4<u32>) -> vec4<f32> {
    return vec4<f32>(bitcast<vec4<i32>>(v)) * 9.313225746154785e-10;
}

// Rows of the rotation from the body's frame to the world's.
fn rows_of(q: vec4<f32>) -> array<vec3<f32>, 3> {
    return array<vec3<f32>, 3>(
        vec3<f32>(1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y - q.w * q.z), 2.0 * (q.x * q.z + q.w * q.y)),
        vec3<f32>(2.0 * (q.x * q.y + q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z - q.w * q.x)),
        vec3<f32>(2.0 * (q.x * q.z - q.w * q.y), 2.0 * (q.y * q.z + q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y)),
    );
}

// Where `corner` [m] from a body is, in a level's cells from that which holds the body.
fn in_level(cell: vec3<i32>, place: vec3<f32>, corner: vec3<f32>, level: u32, shrink: f32) -> vec3<f32> {
    let base = cell >> vec3<u32>(level);
    return (vec3<f32>(cell - (base << vec3<u32>(level))) + place + corner / H) * shrink;
}

// Behind all states there is room for touches, the nodes inside a body on the level at hand, a row for each of its workgroup's threads: for each node
// TOUCH vectors, arm [m] and mass [kg], velocity [m/s] and the node with, from bit 30 on, the kind of grip, normal and friction. There are no more than ROOMS
// blocks in a body's box, so that a thread keeps EACH nodes at most.
const TOUCH: u32 = 3u;
const TOUCHES: u32 = WORLDS * FREES * (LENT + (MAX_SLOTS + 2u) * STATE);
const EACH: u32 = (ROOMS + 3u) / 4u;

// Behind these, how particles press on nodes [N], in the body's frame, for each level and room for a block in the body's box.
fn pressed_at(k: u32, level: u32, room: u32, n: u32) -> u32 {
    return TOUCHES + WORLDS * FREES * EACH * TOUCH * 256u + ((k * LEVELS + level) * ROOMS + room) * 64u + n;
}

// The least and the greatest node of a level that a body may act on: those of its box, and REACH cells further.
fn nodes_near(number: u32, rows: array<vec3<f32>, 3>, cell: vec3<i32>, place: vec3<f32>, level: u32, shrink: f32) -> array<vec3<i32>, 2> {
    let corners = coupling_box(number, rows, H / shrink);
    let base = cell >> vec3<u32>(level);
    // Nodes stand at the centres of cells.
    let least = base + vec3<i32>(ceil(in_level(cell, place, corners[0], level, shrink) - 0.5 - REACH));
    let most = base + vec3<i32>(floor(in_level(cell, place, corners[1], level, shrink) - 0.5 + REACH));
    return array<vec3<i32>, 2>(least, most);
}
