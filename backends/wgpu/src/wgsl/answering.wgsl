// Bodies that answer the ground's impulses, in groups that answer together, which the device moves by itself for the steps of a submission. Lengths are in cells
// of the finest level but where units are given.
//
// Worlds have room for GROUPS groups each, and for ANSWERING bodies. In `answering` there stand GROUP_HEAD vectors for each group: its first body among all
// worlds', how many it has, its number among its coupling's groups, and how many levels it meets, none if there is no such group; and its mass [kg]. Then
// BODY_HEAD for each body: its number, how many levels it meets, how far a surface may move in a step, and the greatest distance of a surface point from
// the reference point; the leash: least displacement, with the body's mass [kg], and greatest, with its first room; the cell, with the number of its rooms, and the place in it at the start,
// with how far the ends of its box move for each radian that it turns.
// Then GROUP_TOLD words that each group is told for the submission.
// Behind those there stand the states before each slot, after the last, and one that is not read: BODY_STATE vectors for each body, its cell; its place in it, in
// 2^-32, and how far turning has moved the ends of its box; its rotation (x, y, z, w), in 2^-30; and, in the slot before, impulse [N s] from the ground with
// nodes deep inside, and angular impulse [N m s] with solutions that did not converge, which the group's first body has for all. Then GROUP_WORDS words of
// each group's own.
// All that a state holds, doubles hold, too: it does not matter how steps are cut into submissions.
const GROUP_HEAD: u32 = 2u;
const BODY_HEAD: u32 = 5u;
const BODY_STATE: u32 = 5u;
const WORLDS: u32 = LAYERS / LEVELS;
const SUBSTEPS: u32 = select(1u, 1u << (LEVELS - 1u), SUBCYCLED);
const ALL_GROUPS: u32 = WORLDS * GROUPS;
const ALL_ANSWERING: u32 = WORLDS * ANSWERING;
const HEADS: u32 = ALL_GROUPS * GROUP_HEAD;
const TOLD: u32 = HEADS + ALL_ANSWERING * BODY_HEAD;
const STATES: u32 = TOLD + ALL_GROUPS * GROUP_TOLD;
const SLOT: u32 = ALL_ANSWERING * BODY_STATE + ALL_GROUPS * GROUP_WORDS;

fn body_head(body: u32) -> u32 {
    return HEADS + body * BODY_HEAD;
}

fn state_of_body(body: u32, slot: u32) -> u32 {
    return STATES + slot * SLOT + body * BODY_STATE;
}

fn words_of_group(k: u32, slot: u32) -> u32 {
    return STATES + slot * SLOT + ALL_ANSWERING * BODY_STATE + k * GROUP_WORDS;
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
    return (vec3<f32>(cell - (base << vec3<u32>(level))) + place + corner / extent.world.cell) * shrink;
}

// Behind all states there is room for touches, the nodes that a body grips on the level at hand: for each node TOUCH vectors, arm [m] and mass [kg], velocity [m/s]
// and the node with, from bit 30 on, the kind of grip, normal and friction. Each block in a body's box has a room, of `extent.rooms` for all bodies of a world.
const TOUCH: u32 = 3u;
const TOUCHES: u32 = STATES + (MAX_SLOTS + 2u) * SLOT;

// Behind these, how a body grips nodes, as the pass of pressing particles finds it, for each level, room and node of the block: the surface's normal, and the
// greatest impulse [N s]; the normal is 0 where the node sticks, and the impulse has the sign - where it may not separate either.
fn gripped_from() -> u32 {
    return TOUCHES + WORLDS * extent.rooms * TOUCH * 64u;
}

// A body's first room, and how many it has.
fn rooms_of(body: u32) -> vec2<u32> {
    let at = body_head(body);
    return vec2<u32>(answering[at + 2u].w, answering[at + 3u].w);
}

fn gripped_at(body: u32, level: u32, room: u32, n: u32) -> u32 {
    let own = rooms_of(body);
    return gripped_from() + (own.x * LEVELS + level * own.y + room) * 64u + n;
}

// Behind these, HELD_HEAD vectors for each level and room: the mark of the slot in which the body gripped nodes of the block there, the block's number, and which
// nodes it grips, as bits; which of them are deep inside, as bits.
const HELD_HEAD: u32 = 2u;

fn held_from() -> u32 {
    return gripped_from() + WORLDS * LEVELS * extent.rooms * 64u;
}

fn room_at(body: u32, level: u32, room: u32) -> u32 {
    let own = rooms_of(body);
    return held_from() + (own.x * LEVELS + level * own.y + room) * HELD_HEAD;
}

// Behind these, NEAR_HEAD vectors for each body and level: the mark of the slot in which it gripped a node, and how many blocks its box has
// along each axis, in ten bits each; the first of these blocks.
const NEAR_HEAD: u32 = 2u;

fn near_from() -> u32 {
    return held_from() + WORLDS * LEVELS * extent.rooms * HELD_HEAD;
}

fn near_at(body: u32, level: u32) -> u32 {
    return near_from() + (body * LEVELS + level) * NEAR_HEAD;
}

// What tells the slot from all others, of other submissions, too.
fn slot_mark() -> u32 {
    return step.submission * 2u * MAX_SLOTS + slot_now() + 1u;
}

// Behind these, where groups have several bodies, what touches add up to for each, and once more for the group that is rehearsed.
fn systems_from() -> u32 {
    return near_from() + ALL_ANSWERING * LEVELS * NEAR_HEAD;
}

// The least and the greatest node of a level that a body may act on: those of its box, and REACH cells further.
fn nodes_near(number: u32, rows: array<vec3<f32>, 3>, cell: vec3<i32>, place: vec3<f32>, level: u32, shrink: f32) -> array<vec3<i32>, 2> {
    let corners = coupling_box(number, rows, extent.world.cell / shrink);
    let base = cell >> vec3<u32>(level);
    // Nodes stand at the centres of cells.
    let least = base + vec3<i32>(ceil(in_level(cell, place, corners[0], level, shrink) - 0.5 - REACH));
    let most = base + vec3<i32>(floor(in_level(cell, place, corners[1], level, shrink) - 0.5 + REACH));
    return array<vec3<i32>, 2>(least, most);
}
