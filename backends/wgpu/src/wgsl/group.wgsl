// What the functions by which a group of bodies answers may call; see `DeviceAnswer` in `coupling.rs` of the core. `b` counts the group's bodies.

// A velocity [m/s] and an angular velocity [rad/s], or an impulse [N s] and an angular impulse [N m s].
struct CouplingTwist { linear: vec3<f32>, angular: vec3<f32> }

// Where a body's reference point is: a cell of the finest level, and the place in it, in 2^-32; and its rotation (x, y, z, w), in 2^-30.
struct CouplingPose { cell: vec3<i32>, place: vec3<u32>, rotation: vec4<i32> }

// The impulse b that contact gives to a body at the twist that is tried, and rows of the four quarters of the matrix A: if the twist changes by d, it is b - A d.
struct CouplingSystem {
    force: vec3<f32>,
    torque: vec3<f32>,
    force_linear: mat3x3<f32>,
    force_angular: mat3x3<f32>,
    torque_linear: mat3x3<f32>,
    torque_angular: mat3x3<f32>,
}

// Twists of each body: as it would be without the contact at hand; as it is expected with it; the one that is tried; by how much that is to change; by how much
// it changed last.
const TWIST_FREE: u32 = 0u;
const TWIST_EXPECTED: u32 = 1u;
const TWIST_TRIED: u32 = 2u;
const TWIST_STEP: u32 = 3u;
const TWIST_LAST: u32 = 4u;
var<workgroup> twists: array<CouplingTwist, 5u * GROUP_BODIES>;
// Numbers of each kind that change along with them.
var<workgroup> group_rates: array<f32, max(5u * GROUP_RATES, 1u)>;
// What nodes gave in the contact that was met last.
var<workgroup> gained: array<CouplingTwist, GROUP_BODIES>;

// The group at hand, among those of all worlds; the slots whose states it reads and writes.
var<private> group_now: u32;
var<private> slot_from: u32;
var<private> slot_to: u32;
// Is all this only for the text to be there? See `answer.wgsl`.
var<private> rehearses: bool;
// Of a group with one body, what all threads know of it.
var<private> only_pose: CouplingPose;
var<private> only_number: u32;

// The body's number among all worlds'.
fn answering_body(b: u32) -> u32 {
    if GROUP_BODIES == 1u {
        return group_now;
    }
    return answering[group_now * GROUP_HEAD].x + b;
}

// Its number among the bodies of all couplings, and among its own's.
fn number_of(b: u32) -> u32 {
    if GROUP_BODIES == 1u {
        return only_number;
    }
    return answering[body_head(answering_body(b))].x;
}

fn group_body(b: u32) -> u32 {
    return number_in_coupling(number_of(b));
}

// How many bodies the group has.
fn group_bodies() -> u32 {
    if GROUP_BODIES == 1u {
        return 1u;
    }
    return answering[group_now * GROUP_HEAD].y;
}

// Solutions that did not converge in the slot, which the group's first thread counts.
var<private> unconverged: u32;

// One of the group's own did not.
fn group_missed(thread: u32) {
    unconverged += u32(thread == 0u);
}

// A word of those that the group is told for the submission.
fn group_told(i: u32) -> vec4<u32> {
    return answering[TOLD + group_now * GROUP_TOLD + i];
}

// A word of the group's state before the slot, or, where it does not move in this pass, as it is.
fn group_word(i: u32) -> vec4<u32> {
    return answering[words_of_group(group_now, slot_from) + i];
}

fn set_group_word(i: u32, word: vec4<u32>) {
    answering[words_of_group(group_now, slot_to) + i] = word;
}

// Do bodies move in this pass? Else they only meet levels coarser than the finest, where those take longer steps.
fn group_moves() -> bool {
    return !SUBCYCLED || step.first_level == 0u;
}

// The step [s].
fn group_dt() -> f32 {
    return step.dt;
}

// The width of the finest cells [m].
fn group_cell() -> f32 {
    return extent.world.cell;
}

// What gravity adds to a velocity in the step [m/s].
fn group_gravity() -> vec3<f32> {
    var gravity = step.gravity;
    if GRAVITY_GROWS {
        gravity *= bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)]));
    }
    return gravity;
}

fn group_twist(which: u32, b: u32) -> CouplingTwist {
    return twists[which * GROUP_BODIES + b];
}

fn set_group_twist(which: u32, b: u32, twist: CouplingTwist) {
    twists[which * GROUP_BODIES + b] = twist;
}

// The numbers that change along with twists.
fn group_rate(which: u32, i: u32) -> f32 {
    return group_rates[which * GROUP_RATES + i];
}

fn set_group_rate(which: u32, i: u32, rate: f32) {
    group_rates[which * GROUP_RATES + i] = rate;
}

// Room for what a function works out on its way; nothing stays there when it is left. The first row of sums keeps its place.
const GROUP_ROOM: u32 = 704u;
const_assert GROUP_ROOM == COLUMNS * ROWS;

fn group_room(i: u32) -> vec4<f32> {
    return exchange[i / ROWS * COLUMN + i % ROWS + 1u];
}

fn set_group_room(i: u32, v: vec4<f32>) {
    exchange[i / ROWS * COLUMN + i % ROWS + 1u] = v;
}

// What nodes gave to a body in the contact that was met last; and what they gave in the slot before, of the same step.
fn group_impulse(b: u32) -> CouplingTwist {
    return gained[b];
}

fn group_impulse_before(b: u32) -> CouplingTwist {
    // What lies before a step is not looked at: it may have been another submission's.
    if slot_now() % SUBSTEPS == 0u {
        return CouplingTwist(vec3<f32>(0.0), vec3<f32>(0.0));
    }
    let at = state_of_body(answering_body(b), slot_from);
    return CouplingTwist(real(answering[at + 3u]).xyz, real(answering[at + 4u]).xyz);
}

fn pose_at(at: u32) -> CouplingPose {
    return CouplingPose(bitcast<vec3<i32>>(answering[at].xyz), answering[at + 1u].xyz, bitcast<vec4<i32>>(answering[at + 2u]));
}

// Where a body is in this pass.
fn group_pose(b: u32) -> CouplingPose {
    if GROUP_BODIES == 1u {
        return only_pose;
    }
    return pose_at(state_of_body(answering_body(b), slot_from));
}

// Its rotation (x, y, z, w), nearly of length 1.
fn pose_rotation(pose: CouplingPose) -> vec4<f32> {
    return rotation_of(bitcast<vec4<u32>>(pose.rotation));
}

// What turning by `angle` [rad] adds to a rotation.
fn turning(q: vec4<f32>, angle: vec3<f32>) -> vec4<f32> {
    let half = 0.5 * angle;
    let a = dot(half, half);
    // Sine over angle, and cosine less one.
    let v = half * (1.0 - a / 6.0 * (1.0 - a / 20.0 * (1.0 - a / 42.0)));
    let c = -0.5 * a * (1.0 - a / 12.0 * (1.0 - a / 30.0));
    return vec4<f32>(c * q.xyz + q.w * v + cross(v, q.xyz), c * q.w - dot(v, q.xyz));
}

// A rotation that has changed by so much, brought back to length 1; each component is within 2^-30 of it.
fn pose_turned(pose: CouplingPose, by: vec4<f32>) -> CouplingPose {
    let q = pose_rotation(pose);
    let turned = by + q * (0.5 - 0.5 * dot(q, q));
    let rotation = bitcast<vec4<u32>>(pose.rotation) + bitcast<vec4<u32>>(vec4<i32>(round(turned * 1073741824.0)));
    return CouplingPose(pose.cell, pose.place, bitcast<vec4<i32>>(rotation));
}

// A pose so many cells of the finest level further.
fn pose_shifted(pose: CouplingPose, by: vec3<f32>) -> CouplingPose {
    let whole = floor(abs(by));
    let part = vec3<u32>((abs(by) - whole) * 4294967296.0);
    let old = pose.place;
    let other = select(old - part, old + part, by >= vec3<f32>(0.0));
    let carry = select(-vec3<i32>(other > old), vec3<i32>(other < old), by >= vec3<f32>(0.0));
    return CouplingPose(pose.cell + vec3<i32>(sign(by) * whole) + carry, other, pose.rotation);
}

// A pose after a step at a twist.
fn pose_after(pose: CouplingPose, twist: CouplingTwist) -> CouplingPose {
    let turned = pose_turned(pose, turning(pose_rotation(pose), step.dt * twist.angular));
    return pose_shifted(turned, twist.linear * step.dt_per_h);
}

// Where a body is after the step. What leads it to the end of its leash, or too fast, the host looks at before the next step.
fn set_group_pose(b: u32, pose: CouplingPose) {
    let body = answering_body(b);
    let old = state_of_body(body, slot_from);
    let before = pose_at(old);
    let at = body_head(body);
    let head = answering[at];
    let place = answering[at + 4u];
    let angle = 2.0 * length(vec4<f32>(pose.rotation - before.rotation)) * 9.313225746154785e-10;
    let moved = vec3<f32>(pose.cell - before.cell) + (vec3<f32>(pose.place) - vec3<f32>(before.place)) * 2.3283064365386963e-10;
    // How far the ends of its box have come, along the axes and by turning, and how far its surface goes in a step of all levels.
    let way = bitcast<f32>(answering[old + 1u].w) + angle * real(place).w;
    let start = bitcast<vec3<i32>>(answering[at + 3u].xyz);
    let come = vec3<f32>(pose.cell - start) + (vec3<f32>(pose.place) - vec3<f32>(place.xyz)) * 2.3283064365386963e-10;
    let fits = all(come - way >= real(answering[at + 1u]).xyz) && all(come + way <= real(answering[at + 2u]).xyz);
    let surface = length(moved) + length(step.gravity) * step.dt_per_h + angle * real(head).w;
    let is_slow = surface * f32(SUBSTEPS) < real(head).z;
    let to = state_of_body(body, slot_to);
    answering[to] = vec4<u32>(bitcast<vec3<u32>>(pose.cell), 0u);
    answering[to + 1u] = vec4<u32>(pose.place, bitcast<u32>(way));
    answering[to + 2u] = bitcast<vec4<u32>>(pose.rotation);
    if !rehearses {
        if !(fits && is_slow) && (slot_now() + 1u) % SUBSTEPS == 0u {
            atomicStore(&status[FOLLOWED], 1u);
        }
        $STAY_AWAKE
    }
}

// What touches of a body add up to: the first of each column's rows; where groups have several bodies they stand behind all else.
fn sums_of(b: u32, column: u32) -> vec4<f32> {
    if GROUP_BODIES == 1u {
        return exchange[column * COLUMN];
    }
    return real(answering[sums_at(b) + column]);
}

fn sums_at(b: u32) -> u32 {
    return systems_from() + select(answering_body(b), ALL_ANSWERING + b, rehearses) * COLUMNS;
}

// Does it touch any node on the level at hand?
fn group_touches(b: u32) -> bool {
    return GROUP_BODIES == 1u || (touched[b >> 5u] & (1u << (b & 31u))) != 0u;
}

// What contact on a body comes to at the twist that is tried. There is nothing where it touches no node.
fn group_system(b: u32) -> CouplingSystem {
    if !group_touches(b) {
        return CouplingSystem();
    }
    let u0 = sums_of(b, 0u);
    let u1 = sums_of(b, 1u);
    let u2 = sums_of(b, 2u);
    let u3 = sums_of(b, 3u);
    let u4 = sums_of(b, 4u);
    let u5 = sums_of(b, 5u);
    let l0 = sums_of(b, 6u);
    let l1 = sums_of(b, 7u);
    let l2 = sums_of(b, 8u);
    let l3 = sums_of(b, 9u);
    let l4 = sums_of(b, 10u);
    return CouplingSystem(
        weight * vec3<f32>(u0.w, u1.w, u2.w),
        weight * vec3<f32>(u3.w, u4.w, u5.w),
        weight * transpose(mat3x3<f32>(u0.xyz, u1.xyz, u2.xyz)),
        weight * transpose(mat3x3<f32>(u3.xyz, u4.xyz, u5.xyz)),
        weight * transpose(mat3x3<f32>(l0.xyz, l1.xyz, l2.xyz)),
        weight * transpose(mat3x3<f32>(l3.xyz, l4.xyz, vec3<f32>(l2.w, l3.w, l4.w))),
    );
}

// A row of the system of a body: its coefficients, and what is out of balance, an impulse or an angular impulse.
struct CouplingRow { linear: vec3<f32>, angular: vec3<f32>, missing: f32 }

fn without_row(row: CouplingRow, other: CouplingRow, times: f32) -> CouplingRow {
    return CouplingRow(row.linear - times * other.linear, row.angular - times * other.angular, row.missing - times * other.missing);
}

// Solves the system by elimination; the secant's is symmetric and positive, and needs no pivots.
fn solve_rows(rows: array<CouplingRow, 6>) -> CouplingTwist {
    let a = rows[0];
    var b = rows[1];
    var c = rows[2];
    var d = rows[3];
    var e = rows[4];
    var f = rows[5];
    let pa = 1.0 / a.linear.x;
    b = without_row(b, a, b.linear.x * pa);
    c = without_row(c, a, c.linear.x * pa);
    d = without_row(d, a, d.linear.x * pa);
    e = without_row(e, a, e.linear.x * pa);
    f = without_row(f, a, f.linear.x * pa);
    let pb = 1.0 / b.linear.y;
    c = without_row(c, b, c.linear.y * pb);
    d = without_row(d, b, d.linear.y * pb);
    e = without_row(e, b, e.linear.y * pb);
    f = without_row(f, b, f.linear.y * pb);
    let pc = 1.0 / c.linear.z;
    d = without_row(d, c, d.linear.z * pc);
    e = without_row(e, c, e.linear.z * pc);
    f = without_row(f, c, f.linear.z * pc);
    let pd = 1.0 / d.angular.x;
    e = without_row(e, d, e.angular.x * pd);
    f = without_row(f, d, f.angular.x * pd);
    let pe = 1.0 / e.angular.y;
    f = without_row(f, e, f.angular.y * pe);
    var turns = vec3<f32>(0.0, 0.0, f.missing / f.angular.z);
    turns.y = (e.missing - e.angular.z * turns.z) * pe;
    turns.x = (d.missing - d.angular.y * turns.y - d.angular.z * turns.z) * pd;
    var moves = vec3<f32>(0.0, 0.0, (c.missing - dot(c.angular, turns)) * pc);
    moves.y = (b.missing - dot(b.angular, turns) - b.linear.z * moves.z) * pb;
    moves.x = (a.missing - dot(a.angular, turns) - a.linear.y * moves.y - a.linear.z * moves.z) * pa;
    return CouplingTwist(moves, turns);
}
