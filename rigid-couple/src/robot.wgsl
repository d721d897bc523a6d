// How robots answer the ground's impulses, as `robot.rs` does on the host: a group of links in trees of joints, all threads of a workgroup together. Robots that may touch are
// one group, each a tree of its own. Where links are is in `robot/dynamics.wgsl`, what acts in joints in `robot/joints.wgsl`, what they touch beside the ground in
// `robot/points.wgsl`.
//
// Links stand tree by tree, in an order in which what hangs on one comes right behind it, and so do rates: those of a tree's base, then those of its drives. All vectors are
// along the world's axes, and places are from the centre of mass of the tree's first body, which is its root. A motion is an angular velocity, and the velocity of what passes
// through that centre; a wrench is a moment about it, and a force. So motions and wrenches of a tree's links add up as they are.
//
// The table holds, from ROBOT_HEADS on, for each group: where its links begin, how many, where its rates begin, how many; where its trees begin, how many, depth of the
// deepest, words of all their states. LINK vectors for each link: parent, freedom, rate, body, -1 for none; ratio, offset, mass, depth; origin, one past the last that hangs on it; rotation of the
// origin; axis, the next link with the same rate; centre of mass, tree; rows of the inertia. DRIVE for each rate: first link, least and greatest position, effort; speed,
// damping, friction, armature; kp, kd, tree, number within it. TREE for each tree: first rate, how many rates its base has, first body, first word of its state; where its path
// begins, how many frames, how many drives, 0; the path's end, its period or 0, where its corrections begin, how many. For each correction its rate, 0 for the pitch and 1 for
// the roll, gain, rate of that. For each frame of a path its time, then positions, four a vector.
//
// Words of a tree's state: time along the path, whole seconds and 2^-32 of them, and whether motors follow orders in place of the path; momentum, and twice the kinetic energy; momentum
// about the base's centre of mass, and twice the work of impulses in the step; the base's velocity; its angular velocity; for each drive its position, whole and 2^-32, and its rate; for each drive an order: target, rate,
// torque, whether the gains act. Behind the trees' words, POINTS vectors say what points gave in the step [N s]. Momentum and energy are what impulses and gravity made of them; rates, which lose a little on the way, are corrected by them.

// As in `joints.rs`, but for stops: f32 bears less.
const ROBOT_STIFF: f32 = 1e4;
const ROBOT_CREEP: f32 = 1e-3;
const ROBOT_BACK: f32 = 0.1;
const ROBOT_FADE: f32 = 0.1;
// As in `robot.rs`.
const ROBOT_MOST_RAISED: f32 = 4.0;
const ROBOT_ITERATIONS: u32 = 20u;
const ROBOT_TOLERANCE: f32 = 1e-5;
// As in `solve.rs`: points first count as lighter than they are, which finds those that touch. All places that are tried along steps are counted.
const ROBOT_ITERATIONS_AT_POINTS: u32 = 100u;
// They are heavy: with a light body between them f32 comes no nearer than 3e-5. Then a step that halves nothing tells that there is no more to find. Forces on points need
// all that there is.
const ROBOT_TOLERANCE_AT_POINTS: f32 = 5e-5;
// Where surfaces drag a robot along it is 2e-4, and here and there more. What comes no nearer with all iterations is solved as well as f32 can.
const ROBOT_ROUGH_AT_POINTS: f32 = 4e-4;
// Rounding of what is out of balance, relative to momentum.
const ROBOT_ROUNDING: f32 = 1e-6;
const ROBOT_LIGHT: f32 = 10.0;
const ROBOT_HEAVIER: f32 = 4.0;
const ROBOT_SMALL: f32 = 0.03;
// Rates as they are, beside the kinds that the backend keeps.
const ROBOT_NOW: u32 = 5u;
const ROBOT_NONE: u32 = 0xffffffffu;
const ROBOT_LINK: u32 = 9u;
const ROBOT_DRIVE: u32 = 3u;
const ROBOT_TREE: u32 = 3u;
// Rates of a base that moves.
const ROBOT_BASE: u32 = 6u;
const ROBOT_WORDS: u32 = 5u;
// Of its matrix, with what is out of balance behind.
const ROBOT_ROW: u32 = ROBOT_RATES + 1u;
const ROBOT_THREADS: u32 = 256u;
// Bodies whose contact is added up at once.
const ROBOT_CONTACTS: u32 = min(8u, GROUP_ROOM / (3u * (ROBOT_RATES + 1u)));

struct RobotMotion { angular: vec3<f32>, linear: vec3<f32> }
struct RobotWrench { moment: vec3<f32>, force: vec3<f32> }
// Mass times centre, mass; the inertia's diagonal; yz, zx, xy of it.
struct RobotInertia { first: vec4<f32>, diagonal: vec3<f32>, beside: vec3<f32> }
// An impulse in a joint, and by how much it falls for each unit of the rate.
struct RobotImpulse { value: f32, slope: f32 }

// Of each link: rotation; centre of mass; how its joint moves it, for each unit of the drive's rate; what its motion asks
// of all that hangs on it, and before that the origin of its frame as a moment; inertia of these; one past the last of these, the next link with the same drive, parent, and the rate that moves it.
var<workgroup> robot_rotation: array<vec4<f32>, ROBOT_LINKS>;
var<workgroup> robot_centre: array<vec3<f32>, ROBOT_LINKS>;
var<workgroup> robot_axis: array<RobotMotion, ROBOT_LINKS>;
var<workgroup> robot_asked: array<RobotWrench, ROBOT_LINKS>;
var<workgroup> robot_inertia: array<RobotInertia, ROBOT_LINKS>;
var<workgroup> robot_order: array<vec4<u32>, ROBOT_LINKS>;
var<workgroup> robot_body: array<u32, ROBOT_LINKS>;
// How many links and rates there are whose trees have to be told apart.
const ROBOT_LINKS_APART: u32 = select(1u, ROBOT_LINKS, ROBOT_TREES > 1u);
const ROBOT_RATES_APART: u32 = select(1u, ROBOT_RATES, ROBOT_TREES > 1u);
// Of each link its tree, and of each tree: its first rate, how many its base has, its first body, its first word; where its first body is after the step.
var<workgroup> robot_tree_of: array<u32, ROBOT_LINKS_APART>;
var<workgroup> robot_trees: array<vec4<u32>, ROBOT_TREES>;
var<workgroup> robot_base: array<CouplingPose, ROBOT_TREES>;
// Of each rate: which of its base's it is, or ROBOT_BASE if it is a drive's; the first link that it moves; its value before the contact at hand; what joints give then, less what gravity and motion add if it is that before the
// step; what no iteration changes; what is out of balance.
var<workgroup> robot_unit: array<u32, ROBOT_RATES_APART>;
var<workgroup> robot_head: array<u32, ROBOT_RATES>;
var<workgroup> robot_free: array<f32, ROBOT_RATES>;
var<workgroup> robot_own: array<f32, ROBOT_RATES>;
var<workgroup> robot_driven: array<f32, ROBOT_RATES>;
var<workgroup> robot_missing: array<f32, ROBOT_RATES>;
var<workgroup> robot_step: array<f32, ROBOT_RATES>;
var<workgroup> robot_work: array<f32, ROBOT_RATES>;
var<workgroup> robot_tried_work: array<f32, ROBOT_RATES>;
// Of each drive, by its rate: position; order, with the way to the target in place of the target.
var<workgroup> robot_position: array<f32, ROBOT_RATES>;
var<workgroup> robot_told: array<vec4<f32>, ROBOT_RATES>;
// The mass matrix, and the one that is solved.
var<workgroup> robot_mass: array<f32, ROBOT_RATES * ROBOT_RATES>;
var<workgroup> robot_matrix: array<f32, ROBOT_RATES * ROBOT_ROW>;
var<workgroup> robot_go_on: u32;

// What the table says of the group and its first tree, of the thread's own link, of the rate with the thread's number, and of that rate's tree. Is it a drive's? Then the words of
// that and of its order; else what the state says of its share in the momentum. And the momentum of the tree with the thread's number.
var<private> robot_links: u32;
var<private> robot_rates: u32;
var<private> robot_tree_count: u32;
var<private> robot_trees_at: u32;
var<private> robot_depth: u32;
var<private> robot_bodies: u32;
var<private> robot_points: u32;
var<private> robot_given_at: u32;
var<private> robot_first_tree: vec4<u32>;
var<private> robot_link: array<vec4<f32>, ROBOT_LINK>;
var<private> robot_drive: array<vec4<f32>, ROBOT_DRIVE>;
var<private> robot_own_tree: vec4<u32>;
var<private> robot_drives: bool;
var<private> robot_word: u32;
var<private> robot_order_word: u32;
var<private> robot_held: f32;
// Twice the kinetic energy of that rate's tree as it is kept, and the work; what it is before the step, and by how much that is too much; the rate before the step, and what the forces of motion take from it in the step.
var<private> robot_kept: vec2<f32>;
var<private> robot_at_start: vec2<f32>;
var<private> robot_began: f32;
var<private> robot_taken: f32;
// How the first body of the tree of the thread's link is turned.
var<private> robot_turn: vec4<f32>;
// How that link moves.
var<private> robot_motion: RobotMotion;
var<private> robot_lacks: RobotWrench;
var<private> robot_linear: vec3<f32>;
var<private> robot_angular: vec3<f32>;
// Do the rates balance what acts on the robot in this step, as far as it has been met?
var<private> robot_is_settled: bool;
// What the first thread alone knows: twice the kinetic energy without the contact at hand, at the rates that are tried, and of the step; what is out of
// balance along the last step, and along this one; along the last one before it; and, as that was found, twice the kinetic energy, and what rounding is of it.
var<private> robot_free_energy: f32;
var<private> robot_tried_energy: f32;
var<private> robot_step_energy: f32;
var<private> robot_beyond: f32;
var<private> robot_ahead: f32;
var<private> robot_before: f32;
var<private> robot_speed: f32;
var<private> robot_noise: f32;

// Fixed-point numbers: whole, and 2^-32.
fn robot_number(word: vec2<u32>) -> f32 {
    return f32(bitcast<i32>(word.x)) + f32(word.y) * 2.3283064365386963e-10;
}

fn robot_more(word: vec2<u32>, by: f32) -> vec2<u32> {
    let whole = floor(abs(by));
    let part = u32((abs(by) - whole) * 4294967296.0);
    let count = i32(whole);
    if by >= 0.0 {
        let next = word.y + part;
        return vec2<u32>(bitcast<u32>(bitcast<i32>(word.x) + count + i32(next < word.y)), next);
    }
    let next = word.y - part;
    return vec2<u32>(bitcast<u32>(bitcast<i32>(word.x) - count - i32(next > word.y)), next);
}

// One rotation behind another (x, y, z, w).
fn robot_turned(q: vec4<f32>, r: vec4<f32>) -> vec4<f32> {
    return vec4<f32>(q.w * r.xyz + r.w * q.xyz + cross(q.xyz, r.xyz), q.w * r.w - dot(q.xyz, r.xyz));
}

fn robot_rotated(q: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    let t = 2.0 * cross(q.xyz, v);
    return v + q.w * t + cross(q.xyz, t);
}

fn robot_link_of(x: f32) -> u32 {
    return select(u32(max(x, 0.0)), ROBOT_NONE, x < 0.0);
}

// Does `l` hang on `a`, or is it the same?
fn robot_hangs_on(l: u32, a: u32) -> bool {
    return a <= l && l < robot_order[a].x;
}

// A tree. A group of one has no need to look.
fn robot_tree(t: u32) -> vec4<u32> {
    if ROBOT_TREES == 1u {
        return robot_first_tree;
    }
    return robot_trees[t];
}

fn robot_tree_of_link(l: u32) -> u32 {
    if ROBOT_TREES == 1u {
        return 0u;
    }
    return robot_tree_of[l];
}

// The link of a tree's first body, on which all others hang.
fn robot_root(t: u32) -> u32 {
    if ROBOT_TREES == 1u {
        return 0u;
    }
    return robot_body[robot_trees[t].z];
}

// Which of its base's rates one is, or ROBOT_BASE.
fn robot_unit_of(rate: u32) -> u32 {
    if ROBOT_TREES == 1u {
        return select(ROBOT_BASE, rate, rate < robot_first_tree.y);
    }
    return robot_unit[rate];
}

// How a rate moves the link `a`, one of those that it moves first, for each unit.
fn robot_axis_of(rate: u32, a: u32) -> RobotMotion {
    let number = robot_unit_of(rate);
    if number < ROBOT_BASE {
        let unit = vec3<f32>(vec3<u32>(number % 3u) == vec3<u32>(0u, 1u, 2u));
        let turns = number >= 3u;
        return RobotMotion(select(vec3<f32>(0.0), unit, turns), select(unit, vec3<f32>(0.0), turns));
    }
    return robot_axis[a];
}

// How a rate moves a link, for each unit.
fn robot_axis_at(rate: u32, l: u32) -> RobotMotion {
    var sum = RobotMotion(vec3<f32>(0.0), vec3<f32>(0.0));
    var a = robot_head[rate];
    for (var turn = 0u; turn < robot_links && a != ROBOT_NONE; turn++) {
        if robot_hangs_on(l, a) {
            let axis = robot_axis_of(rate, a);
            sum = RobotMotion(sum.angular + axis.angular, sum.linear + axis.linear);
        }
        a = robot_order[a].y;
    }
    return sum;
}

fn robot_momentum(own: RobotInertia, m: RobotMotion) -> RobotWrench {
    let w = m.angular;
    let turning = vec3<f32>(
        own.diagonal.x * w.x + own.beside.z * w.y + own.beside.y * w.z,
        own.beside.z * w.x + own.diagonal.y * w.y + own.beside.x * w.z,
        own.beside.y * w.x + own.beside.x * w.y + own.diagonal.z * w.z,
    );
    return RobotWrench(turning + cross(own.first.xyz, m.linear), own.first.w * m.linear + cross(w, own.first.xyz));
}

fn robot_power(m: RobotMotion, f: RobotWrench) -> f32 {
    return dot(m.angular, f.moment) + dot(m.linear, f.force);
}

// What the table says of a tree.
fn robot_tree_row(t: u32, row: u32) -> vec4<f32> {
    return coupling_table(robot_trees_at + t * ROBOT_TREE + row);
}

// Reads what the group is, and its state.
fn robot_take_up(group: u32, thread: u32) {
    let one = vec4<u32>(coupling_table(ROBOT_HEADS + 2u * group));
    let two = vec4<u32>(coupling_table(ROBOT_HEADS + 2u * group + 1u));
    robot_links = one.y;
    robot_rates = one.w;
    robot_trees_at = two.x;
    robot_tree_count = two.y;
    robot_depth = two.z;
    robot_given_at = two.w;
    robot_bodies = group_bodies();
    robot_points = robot_points_told();
    robot_first_tree = vec4<u32>(robot_tree_row(0u, 0u));
    if thread < robot_tree_count {
        let tree = vec4<u32>(robot_tree_row(thread, 0u));
        robot_trees[thread] = tree;
        robot_linear = bitcast<vec3<f32>>(group_word(tree.w + 1u).xyz);
        robot_angular = bitcast<vec3<f32>>(group_word(tree.w + 2u).xyz);
    }
    if thread < robot_links {
        // At once, and not only when the parent stands: a link waits for its parent often enough.
        let from_here = one.x + thread * ROBOT_LINK;
        robot_link = array<vec4<f32>, ROBOT_LINK>(
            coupling_table(from_here),
            coupling_table(from_here + 1u),
            coupling_table(from_here + 2u),
            coupling_table(from_here + 3u),
            coupling_table(from_here + 4u),
            coupling_table(from_here + 5u),
            coupling_table(from_here + 6u),
            coupling_table(from_here + 7u),
            coupling_table(from_here + 8u),
        );
        let head = robot_link[0];
        let rate = select(ROBOT_NONE, u32(max(head.z, 0.0)), head.y > 0.0);
        robot_order[thread] = vec4<u32>(u32(robot_link[2].w), robot_link_of(robot_link[4].w), robot_link_of(head.x), rate);
        if ROBOT_TREES > 1u {
            robot_tree_of[thread] = u32(robot_link[5].w);
        }
        let body = robot_link_of(head.w);
        if body != ROBOT_NONE {
            robot_body[body] = thread;
        }
    }
    robot_drives = false;
    if thread < robot_rates {
        let own = one.z + thread * ROBOT_DRIVE;
        robot_drive = array<vec4<f32>, ROBOT_DRIVE>(coupling_table(own), coupling_table(own + 1u), coupling_table(own + 2u));
        robot_head[thread] = robot_link_of(robot_drive[0].x);
        let t = robot_tree_of_rate();
        robot_own_tree = robot_first_tree;
        if t > 0u {
            robot_own_tree = vec4<u32>(robot_tree_row(t, 0u));
        }
        let number = thread - robot_own_tree.x;
        let state = robot_own_tree.w;
        robot_kept = bitcast<vec2<f32>>(vec2<u32>(group_word(state + 1u).w, group_word(state + 2u).w));
        robot_taken = 0.0;
        robot_drives = number >= robot_own_tree.y;
        if ROBOT_TREES > 1u {
            robot_unit[thread] = select(number, ROBOT_BASE, robot_drives);
        }
        if robot_drives {
            robot_word = state + ROBOT_WORDS + number - robot_own_tree.y;
            robot_order_word = robot_word + u32(robot_tree_row(t, 1u).z);
            let word = group_word(robot_word);
            robot_position[thread] = robot_number(word.xy);
            robot_free[thread] = bitcast<f32>(word.z);
            robot_told[thread] = robot_order_of(t, robot_word - state - ROBOT_WORDS, word);
        } else {
            robot_held = bitcast<f32>(group_word(state + 1u + number / 3u)[number % 3u]);
            robot_free[thread] = bitcast<f32>(group_word(state + 3u + number / 3u)[number % 3u]);
        }
    }
    workgroupBarrier();
}

// The tree of the rate with the thread's number.
fn robot_tree_of_rate() -> u32 {
    if ROBOT_TREES == 1u {
        return 0u;
    }
    return u32(robot_drive[2].z);
}

// What the motor of the thread's drive, number `d` of tree `t`, is told in this step: by an order, or by the path.
fn robot_order_of(t: u32, d: u32, word: vec4<u32>) -> vec4<f32> {
    let head = group_word(robot_own_tree.w);
    var order = bitcast<vec4<f32>>(group_word(robot_order_word));
    if head.z == 0u {
        // At the step's end.
        let time = select(head.xy, robot_clock_after(t, head.xy), group_moves());
        order = robot_path(t, d, robot_number(time));
    }
    return vec4<f32>(order.x - robot_number(word.xy), order.yzw);
}

// A tree's time along its path after a step.
fn robot_clock_after(t: u32, clock: vec2<u32>) -> vec2<u32> {
    let path = robot_tree_row(t, 2u);
    let next = robot_more(clock, group_dt());
    if path.y > 0.0 && robot_number(next) >= path.x {
        return robot_more(next, -path.y);
    }
    return next;
}

// Where the path leads a drive at a time, and how fast: straight from frame to frame.
fn robot_path(t: u32, d: u32, time: f32) -> vec4<f32> {
    let head = vec4<u32>(robot_tree_row(t, 1u));
    let at = head.x;
    let each = 1u + (head.z + 3u) / 4u;
    // One past the last frame that is not behind that time.
    var next = 0u;
    var end = head.y;
    for (var turn = 0u; turn < 32u && next < end; turn++) {
        let middle = (next + end) / 2u;
        if coupling_table(at + middle * each).x <= time {
            next = middle + 1u;
        } else {
            end = middle;
        }
    }
    let last = max(next, 1u) - 1u;
    let from_here = coupling_table(at + last * each + 1u + d / 4u)[d % 4u];
    if next == 0u || next == head.y {
        return vec4<f32>(from_here, 0.0, 0.0, 1.0);
    }
    let to_there = coupling_table(at + next * each + 1u + d / 4u)[d % 4u];
    let begin = coupling_table(at + last * each).x;
    let rate = (to_there - from_here) / (coupling_table(at + next * each).x - begin);
    return vec4<f32>(from_here + (time - begin) * rate, rate, 0.0, 1.0);
}

// Entries of the matrix that a thread keeps while it is solved.
const ROBOT_ENTRIES: u32 = (ROBOT_RATES * ROBOT_ROW + ROBOT_THREADS - 1u) / ROBOT_THREADS;

// Solves the matrix for what stands behind each row, into the step. Threads keep entries to themselves, and show each other only those of the row and the column that
// are next.
fn robot_solve(thread: u32) {
    let n = robot_rates;
    var kept: array<f32, ROBOT_ENTRIES>;
    for (var e = 0u; e < ROBOT_ENTRIES; e++) {
        kept[e] = robot_matrix[min(thread + e * ROBOT_THREADS, ROBOT_RATES * ROBOT_ROW - 1u)];
    }
    for (var k = 0u; k < n; k++) {
        let pivot = 1.0 / robot_matrix[k * ROBOT_ROW + k];
        for (var e = 0u; e < select(0u, ROBOT_ENTRIES, thread < ROBOT_THREADS); e++) {
            let at = thread + e * ROBOT_THREADS;
            let i = at / ROBOT_ROW;
            let j = at % ROBOT_ROW;
            if i < n && i != k && j > k && j <= n {
                kept[e] -= robot_matrix[i * ROBOT_ROW + k] * pivot * robot_matrix[k * ROBOT_ROW + j];
                if i == k + 1u || j == k + 1u {
                    robot_matrix[at] = kept[e];
                }
            }
        }
        workgroupBarrier();
    }
    if thread < n {
        robot_step[thread] = robot_matrix[thread * ROBOT_ROW + n] / robot_matrix[thread * ROBOT_ROW + thread];
    }
    workgroupBarrier();
}

// The rates begin as they are. Joints are not asked yet: whoever meets the ground or settles does that.
fn robot_go_ahead(thread: u32) {
    if thread < robot_rates {
        robot_began = robot_free[thread];
        var gains = 0.0;
        var a = robot_head[thread];
        for (var turn = 0u; turn < robot_links && a != ROBOT_NONE; turn++) {
            let axis = robot_axis_of(thread, a);
            let all = robot_inertia[a].first;
            let weight = RobotWrench(cross(all.xyz, group_gravity()), all.w * group_gravity());
            gains += robot_power(axis, weight);
            robot_taken += group_dt() * robot_power(axis, robot_asked[a]);
            a = robot_order[a].y;
        }
        robot_own[thread] = robot_taken - gains;
    }
    robot_expect(thread);
    if thread == 0u {
        robot_free_energy += robot_pull();
    }
    robot_is_settled = false;
}

// What gravity alone adds to twice the kinetic energy: a robot at rest has none.
fn robot_pull() -> f32 {
    return robot_mass_of_all() * dot(group_gravity(), group_gravity());
}

fn robot_mass_of_all() -> f32 {
    var sum = robot_inertia[0].first.w;
    for (var t = 1u; t < robot_tree_count; t++) {
        sum += robot_inertia[robot_root(t)].first.w;
    }
    return sum;
}

// Finds the rates that balance without soft ground, as `balance_alone` of `robot.rs`. Whoever calls it knows whether there are points: without them a device has
// much less to compile.
fn robot_settle(at_points: bool, thread: u32) {
    let n = robot_rates;
    if thread < n {
        var driven = -robot_own[thread];
        for (var j = 0u; j < n; j++) {
            driven += robot_mass[thread * ROBOT_RATES + j] * robot_free[j];
        }
        robot_driven[thread] = driven;
        robot_step[thread] = 0.0;
    }
    robot_before = 0.0;
    if at_points && thread == 0u {
        robot_weight = robot_least_weight();
    }
    workgroupBarrier();
    let turns = select(ROBOT_ITERATIONS, ROBOT_ITERATIONS_AT_POINTS, at_points);
    // Least twice the kinetic energy that was out of balance along a step.
    var least = 1e30;
    for (var turn = 0u; turn < turns; turn++) {
        if at_points && thread == 0u && turn + 1u == turns {
            robot_weight = 1.0;
        }
        if thread < n {
            var sum = 0.0;
            for (var j = 0u; j < n; j++) {
                let m = robot_mass[thread * ROBOT_RATES + j];
                sum += m * robot_free[j];
                robot_matrix[thread * ROBOT_ROW + j] = m;
            }
            let own = robot_joint(thread, robot_free[thread]);
            let missing = robot_driven[thread] - sum + own.value;
            robot_matrix[thread * ROBOT_ROW + thread] += own.slope;
            robot_matrix[thread * ROBOT_ROW + n] = missing;
            robot_missing[thread] = missing;
            robot_work[thread] = robot_free[thread] * sum;
        }
        workgroupBarrier();
        if at_points {
            robot_add_points(ROBOT_NOW, thread);
            if thread < n {
                robot_missing[thread] = robot_matrix[thread * ROBOT_ROW + n];
            }
            workgroupBarrier();
        }
        if thread == 0u {
            robot_go_on = 1u;
            if robot_before > 0.0 {
                let further = search_on(robot_lead(), robot_noise);
                if further != 0.0 {
                    for (var i = 0u; i < n; i++) {
                        robot_free[i] += further * robot_step[i];
                    }
                    robot_go_on = 2u;
                } else if at_points && search_part() < 1.0 && robot_weight < 1.0
                    && search_part() * search_part() * robot_before <= ROBOT_SMALL * ROBOT_SMALL * robot_speed {
                    // Bounds are in the way of more: the same is solved anew with heavier points.
                    robot_weight = min(ROBOT_HEAVIER * robot_weight, 1.0);
                    robot_before = 0.0;
                    robot_go_on = 2u;
                }
            }
        }
        if workgroupUniformLoad(&robot_go_on) == 2u {
            continue;
        }
        robot_solve(thread);
        if thread < n {
            robot_free[thread] += robot_step[thread];
        }
        if thread == 0u {
            robot_speed = robot_pull();
            robot_before = 0.0;
            for (var i = 0u; i < n; i++) {
                robot_speed += robot_work[i];
                robot_before += robot_missing[i] * robot_step[i];
            }
            search_from(robot_before);
            robot_noise = ROBOT_ROUNDING * sqrt(robot_speed * robot_before);
            robot_go_on = u32(robot_before > ROBOT_TOLERANCE * ROBOT_TOLERANCE * robot_speed);
            if at_points && robot_weight == 1.0 {
                let is_near = robot_before <= ROBOT_TOLERANCE_AT_POINTS * ROBOT_TOLERANCE_AT_POINTS * robot_speed;
                if is_near && robot_before > 0.25 * least {
                    robot_go_on = 0u;
                }
                least = min(least, robot_before);
            }
            if at_points && robot_weight < 1.0 {
                if robot_before <= ROBOT_SMALL * ROBOT_SMALL * robot_speed {
                    robot_weight = min(ROBOT_HEAVIER * robot_weight, 1.0);
                    robot_before = 0.0;
                }
                robot_go_on = 1u;
            }
        }
        if workgroupUniformLoad(&robot_go_on) == 0u {
            return;
        }
    }
    if !at_points || robot_before > ROBOT_ROUGH_AT_POINTS * ROBOT_ROUGH_AT_POINTS * robot_speed {
        group_missed(thread);
    }
}

// The sum over rates of what threads left there.
fn robot_sum() -> f32 {
    var sum = 0.0;
    for (var i = 0u; i < robot_rates; i++) {
        sum += robot_work[i];
    }
    return sum;
}

// What is out of balance along the last step.
fn robot_lead() -> f32 {
    var sum = 0.0;
    for (var i = 0u; i < robot_rates; i++) {
        sum += robot_missing[i] * robot_step[i];
    }
    return sum;
}

// The rates as they are now are those without the contact to come, and nothing better is known of those with it.
fn robot_set_free(at_points: bool, thread: u32) {
    if at_points {
        robot_press(ROBOT_NOW, thread);
    }
    if thread < robot_rates {
        robot_own[thread] = robot_joint(thread, robot_free[thread]).value;
        if at_points {
            robot_own[thread] += robot_pressed(thread);
        }
    }
    robot_expect(thread);
    robot_is_settled = true;
}

// The iteration begins at the rates as they are now.
fn robot_expect(thread: u32) {
    if thread < robot_rates {
        let rate = robot_free[thread];
        set_group_rate(TWIST_FREE, thread, rate);
        set_group_rate(TWIST_EXPECTED, thread, rate);
    }
    workgroupBarrier();
    if thread < robot_rates {
        robot_work[thread] = robot_energy_of(TWIST_FREE, thread);
    }
    robot_set_twists(TWIST_FREE, thread);
    if thread < robot_bodies {
        set_group_twist(TWIST_EXPECTED, thread, group_twist(TWIST_FREE, thread));
    }
    workgroupBarrier();
    if thread == 0u {
        robot_free_energy = robot_sum();
    }
    workgroupBarrier();
}

fn robot_rate(kind: u32, i: u32) -> f32 {
    if kind == ROBOT_NOW {
        return robot_free[i];
    }
    return group_rate(kind, i);
}

// How a link moves at the rates of a kind.
fn robot_motion_at(kind: u32, l: u32) -> RobotMotion {
    var motion = RobotMotion(vec3<f32>(0.0), vec3<f32>(0.0));
    let tree = robot_tree(robot_tree_of_link(l));
    if tree.y > 0u {
        let i = tree.x;
        motion.linear = vec3<f32>(robot_rate(kind, i), robot_rate(kind, i + 1u), robot_rate(kind, i + 2u));
        motion.angular = vec3<f32>(robot_rate(kind, i + 3u), robot_rate(kind, i + 4u), robot_rate(kind, i + 5u));
    }
    for (var a = l; a != ROBOT_NONE; a = robot_order[a].z) {
        let i = robot_order[a].w;
        if i != ROBOT_NONE {
            let rate = robot_rate(kind, i);
            motion = RobotMotion(motion.angular + rate * robot_axis[a].angular, motion.linear + rate * robot_axis[a].linear);
        }
    }
    return motion;
}

// The bodies' twists at the rates of a kind.
fn robot_set_twists(kind: u32, thread: u32) {
    if thread >= robot_bodies {
        return;
    }
    let l = robot_body[thread];
    let motion = robot_motion_at(kind, l);
    set_group_twist(kind, thread, CouplingTwist(robot_velocity_at(motion, robot_centre[l]), motion.angular));
}

fn coupling_begin(group: u32, thread: u32) {
    robot_take_up(group, thread);
    robot_balance(thread);
    if thread < robot_links {
        robot_turn = pose_rotation(group_pose(robot_tree(robot_tree_of_link(thread)).z));
    }
    robot_place(thread);
    robot_move(thread);
    robot_compose(thread);
    robot_correct(thread);
    if group_moves() {
        // Where links touch the ground, rates change less in a step than they would without it: legs are light, and motors press their feet into the ground.
        robot_go_ahead(thread);
        // Points are too heavy to be met from there.
        if robot_points > 0u {
            robot_settle(true, thread);
            robot_note_given(thread);
            workgroupBarrier();
            robot_set_free(true, thread);
            if thread == 0u {
                robot_free_energy += robot_pull();
            }
        }
    } else {
        // Points are told of where it moves in every slot.
        robot_set_free(false, thread);
    }
}

// What contact on a body comes to, as wrenches about the base's centre of mass: what it gives, and by how much that falls for each unit of a motion.
struct RobotContact {
    given: RobotWrench,
    moment_angular: mat3x3<f32>,
    moment_linear: mat3x3<f32>,
    force_angular: mat3x3<f32>,
    force_linear: mat3x3<f32>,
}
var<workgroup> robot_contact: array<RobotContact, ROBOT_CONTACTS>;
// The bodies that touch, and how many there are.
var<workgroup> robot_touching: array<u32, ROBOT_LINKS>;
var<workgroup> robot_touches: u32;

// What crosses a vector from the left.
fn robot_cross(c: vec3<f32>) -> mat3x3<f32> {
    return mat3x3<f32>(vec3<f32>(0.0, c.z, -c.y), vec3<f32>(-c.z, 0.0, c.x), vec3<f32>(c.y, -c.x, 0.0));
}

fn robot_contact_of(b: u32) -> RobotContact {
    let system = group_system(b);
    let c = robot_centre[robot_body[b]];
    let arm = robot_cross(c);
    // At the body's own centre of mass; there are rows in the columns.
    let linear = transpose(system.force_linear);
    let torque = transpose(system.torque_linear);
    // Its velocity is v - c x w, the moment c x f larger.
    let angular = transpose(system.force_angular) - linear * arm;
    return RobotContact(
        RobotWrench(system.torque + cross(c, system.force), system.force),
        transpose(system.torque_angular) - torque * arm + arm * angular,
        torque + arm * linear,
        angular,
        linear,
    );
}

// Adds what some bodies' contact gives and takes, of which so many stand in `robot_contact`, the first of them the `first` that touches: for each body and
// rate first how that moves the body, and what the body then gets from the ground, three vectors.
fn robot_add_contact(first: u32, count: u32, thread: u32) {
    let n = robot_rates;
    for (var e = thread; e < select(0u, count * (n + 1u), thread < ROBOT_THREADS); e += ROBOT_THREADS) {
        let c = e / (n + 1u);
        let j = e % (n + 1u);
        var by = RobotMotion(vec3<f32>(0.0), vec3<f32>(0.0));
        var gets = robot_contact[c].given;
        if j < n {
            by = robot_axis_at(j, robot_body[robot_touching[first + c]]);
            gets = RobotWrench(
                robot_contact[c].moment_angular * by.angular + robot_contact[c].moment_linear * by.linear,
                robot_contact[c].force_angular * by.angular + robot_contact[c].force_linear * by.linear,
            );
        }
        set_group_room(3u * e, vec4<f32>(by.angular, by.linear.x));
        set_group_room(3u * e + 1u, vec4<f32>(by.linear.yz, gets.moment.xy));
        set_group_room(3u * e + 2u, vec4<f32>(gets.moment.z, gets.force));
    }
    workgroupBarrier();
    for (var i = thread >> 5u; i < select(0u, n, thread < ROBOT_THREADS); i += ROBOT_THREADS / 32u) {
        for (var j = thread & 31u; j <= n; j += 32u) {
            var sum = 0.0;
            for (var c = 0u; c < count; c++) {
                let own = 3u * (c * (n + 1u) + i);
                let other = 3u * (c * (n + 1u) + j);
                let one = group_room(own);
                let two = group_room(own + 1u);
                let by = RobotMotion(one.xyz, vec3<f32>(one.w, two.xy));
                let three = group_room(other + 2u);
                sum += robot_power(by, RobotWrench(vec3<f32>(group_room(other + 1u).zw, three.x), three.yzw));
            }
            robot_matrix[i * ROBOT_ROW + j] += sum;
        }
    }
}

fn coupling_answer(group: u32, thread: u32) {
    let n = robot_rates;
    if thread < n {
        let tried = group_rate(TWIST_TRIED, thread);
        let own = robot_joint(thread, tried);
        var missing = own.value - robot_own[thread];
        var momentum = 0.0;
        for (var j = 0u; j < n; j++) {
            let m = robot_mass[thread * ROBOT_RATES + j];
            let of_other = group_rate(TWIST_TRIED, j);
            missing += m * (robot_free[j] - of_other);
            momentum += m * of_other;
            robot_matrix[thread * ROBOT_ROW + j] = m;
        }
        robot_matrix[thread * ROBOT_ROW + thread] += own.slope;
        robot_matrix[thread * ROBOT_ROW + n] = missing;
        robot_tried_work[thread] = momentum * tried;
    }
    // Far from the threads of the rates, which are still at work.
    if thread == ROBOT_THREADS - 1u {
        var count = 0u;
        for (var b = 0u; b < robot_bodies; b++) {
            if group_touches(b) {
                robot_touching[count] = b;
                count++;
            }
        }
        robot_touches = count;
    }
    let touches = workgroupUniformLoad(&robot_touches);
    for (var first = 0u; first < touches; first += ROBOT_CONTACTS) {
        let count = min(touches - first, ROBOT_CONTACTS);
        if thread < count {
            robot_contact[thread] = robot_contact_of(robot_touching[first + thread]);
        }
        workgroupBarrier();
        robot_add_contact(first, count, thread);
        workgroupBarrier();
    }
    if robot_points > 0u {
        robot_add_points(TWIST_TRIED, thread);
    }
    if thread < n {
        robot_missing[thread] = robot_matrix[thread * ROBOT_ROW + n];
    }
    workgroupBarrier();
    robot_solve(thread);
    if thread < n {
        set_group_rate(TWIST_STEP, thread, robot_step[thread]);
        robot_work[thread] = robot_energy_of(TWIST_STEP, thread);
    }
    workgroupBarrier();
    // The first thread has its own to do meanwhile, unless there are too many bodies for the others.
    let half = ROBOT_THREADS / 2u;
    robot_set_twists(TWIST_STEP, select(thread - half, thread, robot_bodies > half));
    if thread == 0u {
        robot_tried_energy = 0.0;
        robot_step_energy = 0.0;
        robot_beyond = 0.0;
        robot_ahead = 0.0;
        for (var i = 0u; i < n; i++) {
            robot_tried_energy += robot_tried_work[i];
            robot_step_energy += robot_work[i];
            robot_beyond += robot_missing[i] * group_rate(TWIST_LAST, i);
            robot_ahead += robot_missing[i] * robot_step[i];
        }
    }
    workgroupBarrier();
}

// A rate's part in twice the kinetic energy.
fn robot_energy_of(kind: u32, i: u32) -> f32 {
    var sum = 0.0;
    for (var j = 0u; j < robot_rates; j++) {
        sum += robot_mass[i * ROBOT_RATES + j] * group_rate(kind, j);
    }
    return sum * group_rate(kind, i);
}

// What the first thread says of this one and the next counts.
fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 {
    return select(robot_ahead, robot_beyond, along == TWIST_LAST);
}

fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 {
    switch which {
        case TWIST_FREE: { return robot_free_energy; }
        case TWIST_TRIED: { return robot_tried_energy; }
        default: { return robot_step_energy; }
    }
}

fn coupling_feel(group: u32, thread: u32) {
    // Where there are points, rates say in the end what became of momentum.
    for (var b = 0u; b < select(0u, robot_bodies, thread < robot_tree_count && robot_points == 0u); b++) {
        if !group_touches(b) || robot_tree_of_link(robot_body[b]) != thread {
            continue;
        }
        let gained = group_impulse(b);
        robot_linear += gained.linear;
        robot_angular += gained.angular + cross(robot_centre[robot_body[b]], gained.linear);
    }
    if thread < robot_rates {
        robot_free[thread] = group_rate(TWIST_TRIED, thread) + group_rate(TWIST_STEP, thread);
    }
    robot_note_given(thread);
    workgroupBarrier();
    robot_set_free(robot_points > 0u, thread);
}

fn coupling_advance(group: u32, thread: u32) {
    let keeps_tree = thread < robot_tree_count;
    var tree = vec4<u32>(0u);
    var clock = vec4<u32>(0u);
    if keeps_tree {
        tree = robot_tree(thread);
        clock = group_word(tree.w);
    }
    var word = vec4<u32>(0u);
    if robot_drives {
        word = group_word(robot_word);
    }
    if !robot_is_settled {
        // It met nothing, no point either.
        robot_settle(false, thread);
        workgroupBarrier();
        robot_set_free(false, thread);
    }
    if robot_points > 0u {
        robot_take_momentum(thread);
    }
    // What the forces of motion took is in the motion: they do no work.
    if thread < robot_rates {
        let given_back = (robot_began + robot_free[thread]) * robot_taken;
        robot_work[thread] = robot_energy_of(TWIST_FREE, thread) + given_back;
        robot_step[thread] = robot_at_start.x;
        robot_missing[thread] = robot_at_start.y;
    }
    workgroupBarrier();
    if thread >= robot_points && thread < ROBOT_POINTS {
        set_group_word(robot_given_at + thread, vec4<u32>(0u));
    }
    if group_moves() {
        if keeps_tree {
            let root = robot_root(thread);
            let all = robot_inertia[root].first;
            let gravity = group_gravity();
            robot_linear += all.w * gravity;
            robot_angular += cross(all.xyz, gravity);
            var base = group_pose(tree.z);
            // So does one that slides on a base that is no body.
            if tree.y > 0u || robot_order[root].w != ROBOT_NONE {
                base = pose_after(base, group_twist(TWIST_FREE, tree.z));
            }
            if tree.y > 0u {
                // About where its centre of mass is then.
                let velocity = vec3<f32>(robot_free[tree.x], robot_free[tree.x + 1u], robot_free[tree.x + 2u]);
                robot_angular -= cross(group_dt() * velocity, robot_linear);
            }
            robot_base[thread] = base;
            clock = vec4<u32>(robot_clock_after(thread, clock.xy), clock.zw);
        }
        if robot_drives {
            let next = robot_more(word.xy, group_dt() * robot_free[thread]);
            word = vec4<u32>(next, word.zw);
            robot_position[thread] = robot_number(next);
        }
        workgroupBarrier();
        if thread < robot_links {
            robot_turn = pose_rotation(robot_base[robot_tree_of_link(thread)]);
        }
        robot_place(thread);
        if thread < robot_bodies {
            let l = robot_body[thread];
            let t = robot_tree_of_link(l);
            let base = robot_base[t];
            let rotation = vec4<i32>(round(robot_rotation[l] * 1073741824.0));
            let pose = pose_shifted(CouplingPose(base.cell, base.place, rotation), robot_centre[l] / group_cell());
            if l == robot_root(t) {
                set_group_pose(thread, base);
            } else {
                set_group_pose(thread, pose);
            }
        }
    }
    if keeps_tree {
        set_group_word(tree.w, clock);
        var twice_energy = 0.0;
        for (var i = tree.x; i < tree.x + tree.y + u32(robot_tree_row(thread, 1u).z); i++) {
            twice_energy += robot_work[i];
        }
        let work = twice_energy - robot_step[tree.x];
        twice_energy -= robot_missing[tree.x];
        set_group_word(tree.w + 1u, vec4<u32>(bitcast<vec3<u32>>(robot_linear), bitcast<u32>(twice_energy)));
        set_group_word(tree.w + 2u, vec4<u32>(bitcast<vec3<u32>>(robot_angular), bitcast<u32>(work)));
    }
    if thread < 2u * robot_tree_count {
        let own = robot_tree(thread / 2u);
        let half = thread % 2u;
        var base_rates = vec3<f32>(0.0);
        if own.y > 0u {
            let i = own.x + 3u * half;
            base_rates = vec3<f32>(robot_free[i], robot_free[i + 1u], robot_free[i + 2u]);
        }
        set_group_word(own.w + 3u + half, vec4<u32>(bitcast<vec3<u32>>(base_rates), 0u));
    }
    if robot_drives {
        set_group_word(robot_word, vec4<u32>(word.xy, bitcast<u32>(robot_free[thread]), 0u));
        set_group_word(robot_order_word, group_word(robot_order_word));
    }
}
