// Bodies that answer the ground's impulses in a slot, a workgroup for each group of them: gravity, the levels' nodes one level after the other, and the motion.
// What they and the nodes that they grip do is found together, as by `contact.rs` of the core: with V the bodies' twists, m_i the nodes' masses and G_i V the
// surface's velocity at node i, r(V) + sum_i G_iT m_i f(u_i - G_i V) = 0, where r is what bodies have out of balance by themselves, which their coupling knows,
// by Newton's method; the last step is that of the secant f(u) = K(u) u, K frozen, so that bodies get what the nodes lose, and the whole is
// dissipative even where the iteration has not converged. All sums are in a fixed order. What is the coupling's to say is in functions of its own, which
// all threads call together.
//
// Time goes by in waiting for memory and for one another. So which nodes bodies grip is found before, by the pass of pressing particles, and a group's threads take
// up TEAMS bodies at once, TEAM threads each, that keep its nodes among them. What is one body's alone is its thread's: the thread of the body's number in
// the group. Where a workgroup is wider than this needs, the threads beyond come along and keep none.
//
// Where a slot has many particles, this text has left a GPU's caches when its turn comes, and is fetched piece by piece on the way. So one workgroup
// more goes through the solution at once, with nodes of a slot before, while the others still look for theirs. What it finds nobody reads.

// As in `contact.rs`, but for the tolerance: f32 carries seven digits, of which sums over nodes lose some. All places that are tried along steps are counted.
const MAX_ITERATIONS: u32 = 100u;
const LIGHT: f32 = 10.0;
const HEAVIER: f32 = 4.0;
const SMALL: f32 = 0.03;
const TOLERANCE: f32 = 1e-5;
// Rounding of what nodes give, relative to the sum of its sizes.
const ROUNDING: f32 = 4e-7;

// What is solved next: the law's derivative at the twists that are tried, its secant, the secant as the last step; or nothing more.
const TANGENT: u32 = 0u;
const SECANT: u32 = 1u;
const LAST: u32 = 2u;
const DONE: u32 = 3u;

// Threads that keep nodes: those of a body, and how many bodies they are for at once; all bodies' turns. Columns of sums, and rows of each, with room between them
// so that threads do not wait for the same bank, and rows of a body.
const THREADS: u32 = 256u;
const TEAM: u32 = select(64u, THREADS, GROUP_BODIES == 1u);
const TEAMS: u32 = THREADS / TEAM;
const TURNS: u32 = (GROUP_BODIES + TEAMS - 1u) / TEAMS;
const COLUMNS: u32 = 11u;
const ROWS: u32 = 64u;
const COLUMN: u32 = 65u;
const OWN_ROWS: u32 = ROWS / TEAMS;
const PARTS_OF_ROWS: u32 = select(4u, 8u, TEAMS == 1u);

struct Touch { arm: vec3<f32>, mass: f32, velocity: vec3<f32>, node: u32, grip: CouplingGrip }

// What touches add up to: upper and lower half of each column of the 6 x 6 matrix; as fourth components first the impulse and the angular impulse that
// nodes give, then the sum of impulses' sizes [N s] and of masses [kg], and the last column's lower half.
struct Sums {
    upper0: vec4<f32>, upper1: vec4<f32>, upper2: vec4<f32>, upper3: vec4<f32>, upper4: vec4<f32>, upper5: vec4<f32>,
    lower0: vec4<f32>, lower1: vec4<f32>, lower2: vec4<f32>, lower3: vec4<f32>, lower4: vec4<f32>,
}

// One past the last level that the group meets, and how many bodies it has; the bodies that grip nodes, and how many there are; of each body of a turn,
// rooms for blocks in its box; how many nodes it grips in the blocks of some of these rooms.
var<workgroup> extents: vec2<u32>;
var<workgroup> gripping: array<u32, GROUP_BODIES>;
var<workgroup> gripping_bodies: u32;
var<workgroup> rooms: array<u32, TEAMS>;
var<workgroup> counts: array<u32, THREADS>;
// The bodies that grip nodes, then those that touch some, as bits: as threads find them, then to be read by all.
const TOUCHED: u32 = (GROUP_BODIES + 31u) / 32u;
var<workgroup> touching: array<atomic<u32>, TOUCHED>;
var<workgroup> touched: array<u32, TOUCHED>;
// Of several bodies, one over the root of the mass, the sum of impulses' sizes [N s], and that of nodes' masses [kg].
var<workgroup> root_of_mass: array<f32, GROUP_BODIES>;
var<workgroup> impulses_of: array<f32, GROUP_BODIES>;
var<workgroup> ground_of: array<f32, GROUP_BODIES>;
var<workgroup> deep: atomic<u32>;
var<workgroup> sliding: atomic<u32>;
var<workgroup> fastest_node: atomic<u32>;
var<workgroup> mode: u32;
// The ground's weight in the iteration.
var<workgroup> weight: f32;

// Impulses in the slot on the thread's own body, and of all bodies what is counted.
var<private> impulse: vec3<f32>;
var<private> angular_impulse: vec3<f32>;
var<private> deep_nodes: u32;
// Of the thread's body in each turn: its number in the group; nodes that the thread keeps, and where the first of them stands; friction.
struct Kept { body: u32, touches: u32, first: u32, friction: f32 }
var<private> own_nodes: array<Kept, TURNS>;
// What the first thread alone knows of the iteration: how many there were; the size of the last step, 0 where there is none to look along; the group's mass, and the only body's [kg].
var<private> iterations: u32;
var<private> last_size: f32;
var<private> group_mass: f32;
var<private> only_mass: f32;

fn velocity_of(twist: CouplingTwist, arm: vec3<f32>) -> vec3<f32> {
    return twist.linear + cross(twist.angular, arm);
}

// Takes up the group.
fn take_up(thread: u32) {
    let first = answering_body(0u);
    slot_from = state_now();
    slot_to = select(slot_now(), MAX_SLOTS, rehearses) + 1u;
    if GROUP_BODIES == 1u {
        only_pose = pose_at(state_of_body(first, slot_from));
        only_number = answering[body_head(first)].x;
    }
    if thread == 0u {
        group_mass = real(answering[group_now * GROUP_HEAD + 1u]).x;
        only_mass = real(answering[body_head(first) + 1u]).w;
        let end = last_level();
        extents = vec2<u32>(end, group_bodies());
    }
    if GROUP_BODIES > 1u && thread < GROUP_BODIES {
        // What has a shape and no mass moves with the rest.
        let mass = real(answering[body_head(first + thread) + 1u]).w;
        let of_group = real(answering[group_now * GROUP_HEAD + 1u]).x;
        root_of_mass[thread] = inverseSqrt(select(of_group, mass, mass > 0.0));
    }
    if !group_moves() {
        let at = state_of_body(first + thread % GROUP_BODIES, slot_from);
        let one = answering[at + 3u];
        let other = answering[at + 4u];
        impulse = real(one).xyz;
        angular_impulse = real(other).xyz;
        deep_nodes = one.w;
        unconverged = other.w;
    }
}

// One past the last level that the group meets in this pass; 0 if there is nothing to do.
fn last_level() -> u32 {
    if atomicLoad(&status[HALTED]) != 0u || (LAYERS > 1u && layers[layer_now].on == 0u) {
        return 0u;
    }
    let levels = answering[group_now * GROUP_HEAD].w;
    return select(levels, min(levels, step.end_level), SUBCYCLED);
}

// From a body's reference point to a node of a level [m].
fn arm_of(pose: CouplingPose, x: vec3<i32>, level: u32, shrink: f32) -> vec3<f32> {
    let centre = vec3<f32>(0.5 / shrink) - place_of(vec4<u32>(pose.place, 0u));
    return (vec3<f32>((x << vec3<u32>(level)) - pose.cell) + centre) * extent.world.cell;
}

// The number of the bit that so many bits stand below.
fn place_of_bit(bits: vec2<u32>, below: u32) -> u32 {
    let low = countOneBits(bits.x);
    var left = select(below - low, below, below < low);
    var word = select(bits.y, bits.x, below < low);
    var place = select(32u, 0u, below < low);
    for (var width = 16u; width > 0u; width /= 2u) {
        let here = countOneBits(word & ((1u << width) - 1u));
        if left >= here {
            left -= here;
            word >>= width;
            place += width;
        }
    }
    return place;
}

// Finds which bodies grip nodes of a level. Many more have blocks of nodes near them.
fn find_gripping(count: u32, level: u32, thread: u32) {
    if thread < count && answering[near_at(answering_body(thread), level)].x == slot_mark() {
        atomicOr(&touching[thread >> 5u], 1u << (thread & 31u));
    }
    workgroupBarrier();
    if thread == 0u {
        gripping_bodies = 0u;
        for (var word = 0u; word < TOUCHED; word++) {
            for (var bits = atomicExchange(&touching[word], 0u); bits != 0u; bits &= bits - 1u) {
                gripping[gripping_bodies] = 32u * word + firstTrailingBit(bits);
                gripping_bodies++;
            }
        }
    }
}

// Takes up the nodes that the bodies of a turn grip on a level: those of the blocks in a body's box, lowest first, are dealt to its threads one by one.
fn find_touches(turn: u32, level: u32, thread: u32) {
    let own = min(thread / TEAM, TEAMS - 1u);
    let lane = thread % TEAM;
    let b = body_of_turn(turn, thread);
    own_nodes[turn] = Kept(b, 0u, 0u, 0.0);
    var all = 0u;
    var size = vec3<u32>(0u);
    var first = vec3<i32>(0);
    var body = 0u;
    var pose: CouplingPose;
    if b != NONE {
        body = answering_body(b);
        pose = group_pose(b);
        let head = near_at(body, level);
        size = (vec3<u32>(answering[head].y) >> vec3<u32>(20u, 10u, 0u)) & vec3<u32>(1023u);
        first = bitcast<vec3<i32>>(answering[head + 1u].xyz);
        let room = rooms_of(body);
        all = min(size.x * size.y * size.z, room.y);
        own_nodes[turn].first = TOUCHES + room.x * 64u * TOUCH + lane;
        own_nodes[turn].friction = coupling_friction(number_of(b));
    }
    if thread < THREADS && lane == 0u {
        rooms[own] = all;
    }
    let of_turn = workgroupUniformLoad(&rooms);
    var most = 0u;
    for (var k = 0u; k < TEAMS; k++) {
        most = max(most, of_turn[k]);
    }
    for (var start = 0u; start < most; start += TEAM) {
        var count = 0u;
        if start + lane < all {
            let held = answering[room_at(body, level, start + lane)];
            if held.x == slot_mark() {
                count = countOneBits(held.z) + countOneBits(held.w);
            }
        }
        if thread < THREADS {
            counts[thread] = count;
        }
        workgroupBarrier();
        // The room of the thread's next node, and how many nodes there are in those before.
        var room = 0u;
        var before = 0u;
        let end = min(all - min(start, all), TEAM);
        for (var next = lane; room < end; next += TEAM) {
            while room < end && next >= before + counts[own * TEAM + room] {
                before += counts[own * TEAM + room];
                room++;
            }
            if room < end {
                take_touch(turn, pose, body, level, vec2<u32>(start + room, next - before), size, first);
            }
        }
        workgroupBarrier();
    }
}

// The body that a thread takes up in a turn, if any.
fn body_of_turn(turn: u32, thread: u32) -> u32 {
    let at = turn * TEAMS + thread / TEAM;
    if thread >= THREADS || at >= gripping_bodies {
        return NONE;
    }
    return gripping[at];
}

// Keeps a node that the body of a turn grips: of a room's, that which so many stand below.
fn take_touch(turn: u32, pose: CouplingPose, body: u32, level: u32, which: vec2<u32>, size: vec3<u32>, first: vec3<i32>) {
    let in_room = room_at(body, level, which.x);
    let held = answering[in_room];
    let g = held.y;
    let n = place_of_bit(held.zw, which.y);
    let node = grid[g * 64u + n];
    let how = real(answering[gripped_at(body, level, which.x, n)]);
    let mass = $MASS;
    if mass <= layers[layer_now].least {
        return;
    }
    let at = vec3<u32>(which.x % size.x, (which.x / size.x) % size.y, which.x / (size.x * size.y));
    let x = (first + vec3<i32>(at)) * 4 + local_of(n);
    let arm = arm_of(pose, x, level, shrink_of(layer_now));
    var kind = select(GRIP_COULOMB, GRIP_STICK, all(how.xyz == vec3<f32>(0.0)));
    kind = select(kind, GRIP_BILATERAL, how.w < 0.0);
    // A thread's nodes stand as far from each other as all threads' do.
    let to = own_nodes[turn].first + own_nodes[turn].touches * TOUCH * TEAM;
    answering[to] = bitcast<vec4<u32>>(vec4<f32>(arm, mass));
    answering[to + TEAM] = vec4<u32>(bitcast<vec3<u32>>(node.xyz), (g * 64u + n) | (kind << 30u));
    answering[to + 2u * TEAM] = bitcast<vec4<u32>>(vec4<f32>(how.xyz, most_of(abs(how.w), mass)));
    own_nodes[turn].touches++;
    let of_word = answering[in_room + 1u][n >> 5u];
    if (of_word & (1u << (n & 31u))) != 0u {
        atomicAdd(&deep, 1u);
    }
}

// A node that a thread keeps in a turn.
fn touch_of(turn: u32, i: u32) -> Touch {
    let at = own_nodes[turn].first + i * TOUCH * TEAM;
    let arm = real(answering[at]);
    let how = answering[at + TEAM];
    let grip = real(answering[at + 2u * TEAM]);
    return Touch(arm.xyz, arm.w, real(how).xyz, how.w & 0x3fffffffu, CouplingGrip(how.w >> 30u, grip.xyz, grip.w, false, 0.0));
}

// What the nodes give at the twist that is tried, and G_iT m_i D G_i with D the law's derivative or its secant, summed over a thread's.
fn assemble(turn: u32, tangent: bool) -> Sums {
    var sum: Sums;
    var slides = false;
    let own = own_nodes[turn];
    if own.touches == 0u {
        return sum;
    }
    let twist = group_twist(TWIST_TRIED, own.body);
    for (var i = 0u; i < own.touches; i++) {
        let touch = touch_of(turn, i);
        sum.lower1.w += touch.mass;
        let r = touch.arm;
        let u = touch.velocity - velocity_of(twist, r);
        let hold = hold_of(own.friction, touch.grip, u);
        if !hold.held {
            continue;
        }
        let n = hold.normal;
        let held = touch.mass * hold.drag;
        // Where the bound is reached, more approach is not met by more.
        let is_cut = tangent && hold.bounded;
        let m = (touch.mass * select(hold.hold, 0.0, is_cut) - held) * n;
        var d = mat3x3<f32>(n.x * m, n.y * m, n.z * m);
        d[0].x += held;
        d[1].y += held;
        d[2].z += held;
        var taken = d * u;
        if is_cut {
            taken += touch.mass * hold.hold * dot(n, u) * n;
        }
        let moment = cross(r, taken);
        if tangent && hold.friction > 0.0 {
            // d(f |u_n| t) = -f t nT + drag (1 - n nT - t tT)
            let slope = touch.mass * (select(hold.friction, 0.0, hold.bounded) * n + hold.drag * hold.along);
            d[0] -= slope.x * hold.along;
            d[1] -= slope.y * hold.along;
            d[2] -= slope.z * hold.along;
            slides = true;
        }
        slides |= is_cut;
        let d3 = d[2] * r.y - d[1] * r.z;
        let d4 = d[0] * r.z - d[2] * r.x;
        let d5 = d[1] * r.x - d[0] * r.y;
        let last = cross(r, d5);
        sum.upper0 += vec4<f32>(d[0], taken.x);
        sum.upper1 += vec4<f32>(d[1], taken.y);
        sum.upper2 += vec4<f32>(d[2], taken.z);
        sum.upper3 += vec4<f32>(d3, moment.x);
        sum.upper4 += vec4<f32>(d4, moment.y);
        sum.upper5 += vec4<f32>(d5, moment.z);
        sum.lower0 += vec4<f32>(cross(r, d[0]), touch.mass * length(u));
        sum.lower1 += vec4<f32>(cross(r, d[1]), 0.0);
        sum.lower2 += vec4<f32>(cross(r, d[2]), last.x);
        sum.lower3 += vec4<f32>(cross(r, d3), last.y);
        sum.lower4 += vec4<f32>(cross(r, d4), last.z);
    }
    if slides {
        atomicStore(&sliding, 1u);
    }
    return sum;
}

fn put(row: u32, own: Sums) {
    exchange[row] = own.upper0;
    exchange[COLUMN + row] = own.upper1;
    exchange[2u * COLUMN + row] = own.upper2;
    exchange[3u * COLUMN + row] = own.upper3;
    exchange[4u * COLUMN + row] = own.upper4;
    exchange[5u * COLUMN + row] = own.upper5;
    exchange[6u * COLUMN + row] = own.lower0;
    exchange[7u * COLUMN + row] = own.lower1;
    exchange[8u * COLUMN + row] = own.lower2;
    exchange[9u * COLUMN + row] = own.lower3;
    exchange[10u * COLUMN + row] = own.lower4;
}

fn with_row(row: u32, own: Sums) -> Sums {
    return Sums(
        own.upper0 + exchange[row],
        own.upper1 + exchange[COLUMN + row],
        own.upper2 + exchange[2u * COLUMN + row],
        own.upper3 + exchange[3u * COLUMN + row],
        own.upper4 + exchange[4u * COLUMN + row],
        own.upper5 + exchange[5u * COLUMN + row],
        own.lower0 + exchange[6u * COLUMN + row],
        own.lower1 + exchange[7u * COLUMN + row],
        own.lower2 + exchange[8u * COLUMN + row],
        own.lower3 + exchange[9u * COLUMN + row],
        own.lower4 + exchange[10u * COLUMN + row],
    );
}

// Sums what the threads of a turn's bodies have into where `sums_of` finds it.
fn sum_up(turn: u32, own: Sums, thread: u32) {
    let row = thread / TEAM * OWN_ROWS + thread % OWN_ROWS;
    let quarter = select(thread % TEAM / OWN_ROWS, NONE, thread >= THREADS);
    if quarter == 0u {
        put(row, own);
    }
    workgroupBarrier();
    if quarter == 1u {
        put(row, with_row(row, own));
    }
    workgroupBarrier();
    if quarter == 2u {
        put(row, with_row(row, own));
    }
    workgroupBarrier();
    if quarter == 3u {
        put(row, with_row(row, own));
    }
    workgroupBarrier();
    // A part of a body's rows in a column a thread, then a column.
    let part = thread / COLUMNS;
    let column = thread % COLUMNS;
    if part < TEAMS * PARTS_OF_ROWS {
        let at = column * COLUMN + part / PARTS_OF_ROWS * OWN_ROWS + part % PARTS_OF_ROWS;
        exchange[at] = sum_of_rows(at, OWN_ROWS, PARTS_OF_ROWS);
    }
    workgroupBarrier();
    if part < TEAMS {
        let sum = sum_of_rows(column * COLUMN + part * OWN_ROWS, PARTS_OF_ROWS, 1u);
        let at = turn * TEAMS + part;
        if GROUP_BODIES == 1u {
            exchange[column * COLUMN] = sum;
        } else if at < gripping_bodies {
            let b = gripping[at];
            answering[sums_at(b) + column] = bitcast<vec4<u32>>(sum);
            if column == 6u {
                impulses_of[b] = sum.w;
            } else if column == 7u {
                ground_of[b] = sum.w;
            }
        }
    }
    workgroupBarrier();
}

fn sum_of_rows(at: u32, rows: u32, by: u32) -> vec4<f32> {
    var sum = exchange[at];
    for (var k = by; k < rows; k += by) {
        sum += exchange[at + k];
    }
    return sum;
}

fn mass_of_ground(b: u32) -> f32 {
    if GROUP_BODIES == 1u {
        return sums_of(b, 7u).w;
    }
    return ground_of[b];
}

// Finds the weight of the ground to begin with: ground much heavier than the group is first taken as lighter, and its true weight then finds the right nodes in
// contact.
fn weigh(count: u32) {
    var ground = 0.0;
    for (var b = 0u; b < count; b++) {
        if group_touches(b) {
            ground += mass_of_ground(b);
        }
    }
    weight = min(LIGHT * group_mass / ground, 1.0);
}

// What rounding of the nodes' impulses may do to the root of twice the kinetic energy.
fn noise_of(count: u32) -> f32 {
    if GROUP_BODIES == 1u {
        return ROUNDING * sums_of(0u, 6u).w * inverseSqrt(only_mass);
    }
    var noise = 0.0;
    for (var b = 0u; b < count; b++) {
        if group_touches(b) {
            noise += ROUNDING * impulses_of[b] * root_of_mass[b];
        }
    }
    return noise;
}

// What the first thread decided: twists that are tried go so many times a kind of them further, if at all, and what changed last becomes so many times that kind.
struct Further { times: f32, along: u32, last: f32 }
var<workgroup> further: Further;

// Tries other twists, as was decided.
fn try_further(count: u32, thread: u32) {
    if further.times == 0.0 {
        return;
    }
    if thread < count {
        let tried = group_twist(TWIST_TRIED, thread);
        let by = group_twist(further.along, thread);
        let times = further.times;
        set_group_twist(TWIST_TRIED, thread, CouplingTwist(tried.linear + times * by.linear, tried.angular + times * by.angular));
        set_group_twist(TWIST_LAST, thread, CouplingTwist(further.last * by.linear, further.last * by.angular));
    }
    for (var i = thread; i < GROUP_RATES; i += THREADS) {
        let by = group_rate(further.along, i);
        set_group_rate(TWIST_TRIED, i, group_rate(TWIST_TRIED, i) + further.times * by);
        set_group_rate(TWIST_LAST, i, further.last * by);
    }
}

// Takes the step that was found, or asks for another one: `beyond` is what is out of balance against the last step, `lead` along this one, `size` how large it
// is, and `speed` how fast bodies are, in the norm of the kinetic energy.
fn decide(count: u32, beyond: f32, lead: f32, size: f32, speed: f32) {
    further.times = 0.0;
    let slid = atomicLoad(&sliding) != 0u;
    atomicStore(&sliding, 0u);
    if mode == TANGENT && last_size > 0.0 && iterations < MAX_ITERATIONS {
        let times = search_on(-beyond, last_size * noise_of(count));
        if times != 0.0 {
            further = Further(times, TWIST_LAST, 1.0);
            iterations++;
            return;
        }
        if search_part() < 1.0 && search_part() * last_size <= SMALL * speed && weight < 1.0 {
            last_size = 0.0;
            // Bounds are in the way of more: the same is solved anew with heavier ground.
            weight = min(HEAVIER * weight, 1.0);
            iterations++;
            return;
        }
    }
    last_size = 0.0;
    if mode == TANGENT && !(lead >= 0.0) {
        // Such a direction is replaced by the secant's, which always leads towards balance.
        mode = SECANT;
        return;
    }
    if mode != LAST {
        iterations++;
        let noise = noise_of(count);
        let converged = weight == 1.0 && size <= TOLERANCE * speed + noise;
        if !converged && iterations < MAX_ITERATIONS {
            further = Further(1.0, TWIST_STEP, 1.0);
            last_size = size;
            search_from(lead);
            // Newton's steps square what is missing. Where a small one was found and nodes slide, the secant's tells as well whether that was all, and
            // serves as the last.
            let was_small = weight == 1.0 && size * size <= TOLERANCE * speed * speed + noise * noise;
            mode = select(TANGENT, SECANT, mode == TANGENT && slid && was_small);
            if size <= SMALL * speed + noise && weight < 1.0 {
                weight = min(HEAVIER * weight, 1.0);
                last_size = 0.0;
            }
            return;
        }
        unconverged += u32(!converged);
        let is_secant = weight == 1.0 && (mode == SECANT || !slid);
        weight = 1.0;
        if !is_secant {
            mode = LAST;
            return;
        }
    }
    mode = DONE;
}

// What nodes give to a body in the end.
fn gain_of(b: u32) -> CouplingTwist {
    let system = group_system(b);
    let change = group_twist(TWIST_STEP, b);
    return CouplingTwist(
        system.force - (change.linear * system.force_linear + change.angular * system.force_angular),
        system.torque - (change.linear * system.torque_linear + change.angular * system.torque_angular),
    );
}

// The group meets the nodes of a level.
fn meet(group: u32, count: u32, level: u32, thread: u32) {
    if rehearses {
        if thread == 0u {
            gripping[0] = 0u;
            gripping_bodies = 1u;
        }
    } else {
        find_gripping(count, level, thread);
    }
    let turns = (workgroupUniformLoad(&gripping_bodies) + TEAMS - 1u) / TEAMS;
    for (var turn = 0u; turn < turns; turn++) {
        if rehearses {
            own_nodes[turn] = Kept(0u, u32(thread < THREADS), TOUCHES + rooms_of(answering_body(0u)).x * 64u * TOUCH + thread % TEAM, 0.5);
        } else {
            find_touches(turn, level, thread);
        }
        let own = own_nodes[turn];
        if own.touches > 0u {
            atomicOr(&touching[own.body >> 5u], 1u << (own.body & 31u));
        }
    }
    workgroupBarrier();
    if thread == 0u {
        mode = DONE;
        for (var word = 0u; word < TOUCHED; word++) {
            let bits = atomicLoad(&touching[word]);
            atomicStore(&touching[word], 0u);
            touched[word] = bits;
            if bits != 0u {
                mode = TANGENT;
            }
        }
        deep_nodes += atomicLoad(&deep);
        atomicStore(&deep, 0u);
        iterations = 0u;
        last_size = 0.0;
    }
    if thread < count {
        set_group_twist(TWIST_TRIED, thread, group_twist(TWIST_EXPECTED, thread));
        set_group_twist(TWIST_LAST, thread, CouplingTwist());
    }
    for (var i = thread; i < GROUP_RATES; i += THREADS) {
        set_group_rate(TWIST_TRIED, i, group_rate(TWIST_EXPECTED, i));
        set_group_rate(TWIST_LAST, i, 0.0);
    }
    if workgroupUniformLoad(&mode) == DONE {
        return;
    }
    // A step more for each direction that is replaced, and the last; and behind it, all see what it found.
    for (var turn = 0u; turn < select(2u * MAX_ITERATIONS + 2u, 1u, rehearses); turn++) {
        let now = workgroupUniformLoad(&mode);
        if now == DONE {
            break;
        }
        for (var some = 0u; some < turns; some++) {
            sum_up(some, assemble(some, now == TANGENT), thread);
        }
        if GROUP_BODIES > 1u {
            storageBarrier();
        }
        if thread == 0u && turn == 0u {
            weigh(count);
        }
        if GROUP_BODIES > 1u {
            workgroupBarrier();
        }
        coupling_answer(group, thread);
        let beyond = -coupling_balance(group, TWIST_LAST, thread);
        let lead = coupling_balance(group, TWIST_STEP, thread);
        let size = sqrt(coupling_twice_energy(group, TWIST_STEP, thread));
        let tried = coupling_twice_energy(group, TWIST_TRIED, thread);
        let free = coupling_twice_energy(group, TWIST_FREE, thread);
        if thread == 0u {
            decide(count, beyond, lead, size, max(sqrt(tried), sqrt(free)));
        }
        workgroupBarrier();
        try_further(count, thread);
    }
    if thread < count {
        let gain = gain_of(thread);
        gained[thread] = gain;
        impulse += gain.linear;
        angular_impulse += gain.angular;
    }
    var fastest = 0u;
    for (var turn = 0u; turn < turns; turn++) {
        if own_nodes[turn].touches > 0u {
            fastest = max(fastest, hand_over(turn));
        }
    }
    atomicMax(&fastest_node, fastest);
    workgroupBarrier();
    coupling_feel(group, thread);
    if thread == 0u {
        atomicMax(&status[step_word(step.number, layer_now, SPEED)], atomicLoad(&fastest_node));
        if is_too_fast(layer_now, bitcast<f32>(atomicLoad(&fastest_node))) {
            atomicAdd(&status[fast_word(step.number)], 1u);
        }
        atomicStore(&fastest_node, 0u);
    }
}

// The nodes that a thread keeps in a turn take the velocities that the law at the twists tried last leaves them. Returns the greatest as much as a particle may
// feel of it.
fn hand_over(turn: u32) -> u32 {
    let own = own_nodes[turn];
    let at_last = group_twist(TWIST_TRIED, own.body);
    let change = group_twist(TWIST_STEP, own.body);
    let surface = CouplingTwist(at_last.linear + change.linear, at_last.angular + change.angular);
    var fastest = 0u;
    for (var i = 0u; i < own.touches; i++) {
        let touch = touch_of(turn, i);
        let hold = hold_of(own.friction, touch.grip, touch.velocity - velocity_of(at_last, touch.arm));
        if !hold.held {
            continue;
        }
        if rehearses {
            break;
        }
        let of_surface = velocity_of(surface, touch.arm);
        let u = touch.velocity - of_surface;
        let left = of_surface + kept_by(hold, u);
        grid[touch.node].x = left.x;
        grid[touch.node].y = left.y;
        grid[touch.node].z = left.z;
        let felt = min(touch.mass * layers[layer_now].felt, 1.0);
        fastest = max(fastest, max(max(magnitude_bits(felt * left.x), magnitude_bits(felt * left.y)), magnitude_bits(felt * left.z)));
    }
    return fastest;
}

// Notes what contact made of the bodies. They move if that is the slot's first.
fn finish(group: u32, count: u32, thread: u32) {
    coupling_advance(group, thread);
    if thread < count {
        let to = state_of_body(answering_body(thread), slot_to);
        answering[to + 3u] = vec4<u32>(bitcast<vec3<u32>>(impulse), deep_nodes);
        answering[to + 4u] = vec4<u32>(bitcast<vec3<u32>>(angular_impulse), unconverged);
    }
}

// What happens to a group in a slot. Behind the last one stands the workgroup that rehearses.
fn answer_of_group(w: u32, thread: u32) {
    rehearses = w >= ALL_GROUPS;
    group_now = select(w, 0u, rehearses);
    let first_layer = group_now / GROUPS * LEVELS;
    layer_now = first_layer;
    let group = answering[group_now * GROUP_HEAD].z;
    take_up(thread);
    take_up_group(thread);
    coupling_begin(group, thread);
    let first_level = select(0u, step.first_level, SUBCYCLED);
    let all = workgroupUniformLoad(&extents);
    if all.x <= first_level {
        return;
    }
    for (var level = first_level; level < all.x; level++) {
        layer_now = first_layer + level;
        meet(group, all.y, level, thread);
    }
    layer_now = first_layer;
    finish(group, all.y, thread);
}
