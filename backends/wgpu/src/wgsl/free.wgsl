// Free bodies in a slot, a workgroup each: gravity, the levels' nodes one level after the other, and the motion. What they and the nodes inside them do is
// found together, as by `contact.rs` of the coupling: with V the twist, m_i the nodes' masses and G_i V the surface's velocity at node i,
//   M (V - V_free) = sum_i G_iT m_i f(u_i - G_i V),
// by Newton's method; the last step is that of the secant f(u) = K(u) u, K frozen, so that the body gets what the nodes lose, and the whole is
// dissipative even where the iteration has not converged. All sums are in a fixed order.
//
// A body has some hundreds of nodes inside, and two iterations do: time goes by in waiting for memory and for one another. So all threads take up
// the body, each keeps the nodes that it finds, and what one thread can do by itself is not shared. Where a workgroup is wider than this needs, the
// threads beyond come along and keep none.
//
// Where a slot has many particles, this text has left a GPU's caches when its turn comes, and is fetched piece by piece on the way. So one workgroup
// more goes through the solution at once, with nodes of a slot before, while the others still look for theirs. What it finds nobody reads.

// As in `contact.rs`, but for the tolerance: f32 carries seven digits, of which sums over nodes lose some.
const MAX_ITERATIONS: u32 = 40u;
const OVERSHOT: f32 = 0.5;
const LIGHT: f32 = 10.0;
const HEAVIER: f32 = 4.0;
const SMALL: f32 = 0.03;
const TOLERANCE: f32 = 1e-5;
// Rounding of what nodes give, relative to the sum of its sizes.
const ROUNDING: f32 = 4e-7;

// What is solved next: the law's derivative at the frozen twist, its secant, the secant as the last step; or nothing more.
const TANGENT: u32 = 0u;
const SECANT: u32 = 1u;
const LAST: u32 = 2u;
const DONE: u32 = 3u;

// Threads that keep nodes. Columns of sums, and rows of each, with room between them so that threads do not wait for the same bank.
const THREADS: u32 = 256u;
const COLUMNS: u32 = 11u;
const ROWS: u32 = 64u;
const COLUMN: u32 = 65u;

struct Touch { arm: vec3<f32>, mass: f32, velocity: vec3<f32>, node: u32, grip: CouplingGrip }
struct Twist { linear: vec3<f32>, angular: vec3<f32> }

// What touches add up to: upper and lower half of each column of the 6 x 6 matrix; as fourth components first the impulse and the angular impulse that
// nodes give, then the sum of impulses' sizes [N s] and of masses [kg], and the last column's lower half.
struct Sums {
    upper0: vec4<f32>, upper1: vec4<f32>, upper2: vec4<f32>, upper3: vec4<f32>, upper4: vec4<f32>, upper5: vec4<f32>,
    lower0: vec4<f32>, lower1: vec4<f32>, lower2: vec4<f32>, lower3: vec4<f32>, lower4: vec4<f32>,
}

// One past the last level that the body meets; rooms for blocks in its box; which of 256 rooms there is a block in, as bits; these blocks, with their
// places from the box's first.
var<workgroup> end_level: u32;
var<workgroup> rooms: u32;
var<workgroup> filled: array<atomic<u32>, 8>;
var<workgroup> blocks: array<vec2<u32>, 256>;
var<workgroup> touching: atomic<u32>;
var<workgroup> deep: atomic<u32>;
var<workgroup> sliding: atomic<u32>;
var<workgroup> fastest_node: atomic<u32>;
var<workgroup> mode: u32;
// The body's twist in the iteration, the one that the last step leads to, and the impulse of the nodes then.
var<workgroup> frozen: Twist;
var<workgroup> met: Twist;
var<workgroup> gained: Twist;

// What each thread knows of the body: mass [kg], inertia [kg m2], world frame, and its inverse [1/(kg m2)], body frame; where it is; its angular momentum, and
// its twist without the contact at hand, and the one that is expected with it.
var<private> body_mass: f32;
var<private> inertia: mat3x3<f32>;
var<private> inverse: mat3x3<f32>;
var<private> cell: vec3<i32>;
var<private> place: vec4<u32>;
var<private> rotation: vec4<u32>;
var<private> momentum: vec3<f32>;
var<private> free: Twist;
var<private> expected: Twist;
// Impulses in the slot, and counts.
var<private> impulse: vec3<f32>;
var<private> angular_impulse: vec3<f32>;
var<private> deep_nodes: u32;
var<private> unconverged: u32;
// Is all this only for the text to be there? See above.
var<private> rehearses: bool;
// Nodes that the thread keeps.
var<private> kept_touches: u32;
// What the first thread alone knows of the iteration.
var<private> weight: f32;
var<private> iterations: u32;
// The last step, and what was out of balance along it before; 0 where there is none to cut back.
var<private> last_step: Twist;
var<private> before_step: f32;

fn velocity_of(twist: Twist, arm: vec3<f32>) -> vec3<f32> {
    return twist.linear + cross(twist.angular, arm);
}

// A tensor of the body's frame, whose rows begin at a vector.
fn tensor_at(at: u32) -> mat3x3<f32> {
    return mat3x3<f32>(real(lent[at]).xyz, real(lent[at + 1u]).xyz, real(lent[at + 2u]).xyz);
}

// The same in the world's frame.
fn seen_from_world(tensor: mat3x3<f32>, q: vec4<f32>) -> mat3x3<f32> {
    let rows = rows_of(q);
    let back = mat3x3<f32>(rows[0], rows[1], rows[2]);
    return transpose(back) * tensor * back;
}

// The angular velocity that an angular momentum makes at a rotation.
fn spin(q: vec4<f32>, turning_momentum: vec3<f32>) -> vec3<f32> {
    let rows = rows_of(q);
    let back = mat3x3<f32>(rows[0], rows[1], rows[2]);
    return (inverse * (back * turning_momentum)) * back;
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

// Takes up the body as it is, and gravity.
fn take_up(k: u32, at: u32, is_first: bool) {
    cell = bitcast<vec3<i32>>(lent[at].xyz);
    place = lent[at + 1u];
    rotation = lent[at + 2u];
    body_mass = real(lent[k * LENT]).w;
    inverse = tensor_at(k * LENT + 3u);
    momentum = real(lent[at + 4u]).xyz;
    let q = rotation_of(rotation);
    inertia = seen_from_world(tensor_at(k * LENT), q);
    free = Twist(real(lent[at + 3u]).xyz, spin(q, momentum));
    let before = real(lent[at + 5u]).xyz;
    let angular_before = real(lent[at + 6u]).xyz;
    if is_first {
        var gravity = step.gravity;
        if GRAVITY_GROWS {
            gravity *= bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)]));
        }
        free.linear += gravity;
    } else {
        deep_nodes = lent[at + 3u].w;
        unconverged = lent[at + 4u].w;
        impulse = before;
        angular_impulse = angular_before;
    }
    expected = free;
    // From one slot of a step to the next impulses change little. What lies before a step is not looked at: it may have been another submission's.
    if is_first && slot_now() % SUBSTEPS != 0u {
        expected.linear += before / body_mass;
        expected.angular = spin(q, momentum + angular_before);
    }
}

// One past the last level that the body meets in this pass; 0 if there is nothing to do.
fn last_level(k: u32) -> u32 {
    if atomicLoad(&status[HALTED]) != 0u || (LAYERS > 1u && layers[layer_now].on == 0u) {
        return 0u;
    }
    let levels = lent[k * LENT + 5u].w;
    return select(levels, min(levels, step.end_level), SUBCYCLED);
}

// Finds the nodes inside the body on a level: of the blocks in its box those that there are are listed, lowest first, and dealt to the threads, a node of
// each block to each of 64, turn by turn another one, so that a layer of nodes along any axis is many threads'.
fn find_touches(k: u32, level: u32, thread: u32) {
    let number = lent[k * LENT + 3u].w;
    let shrink = shrink_of(layer_now);
    let rows = rows_of(rotation_of(rotation));
    let within = place_of(place);
    let nodes = nodes_near(number, rows, cell, within, level, shrink);
    let least = nodes[0];
    let most = nodes[1];
    let first = least >> vec3<u32>(2u);
    let size = vec3<u32>(max((most >> vec3<u32>(2u)) - first + vec3<i32>(1), vec3<i32>(0)));
    if thread == 0u {
        rooms = min(size.x * size.y * size.z, ROOMS);
    }
    kept_touches = 0u;
    let own = thread >> 5u;
    let all_rooms = workgroupUniformLoad(&rooms);
    for (var room = 0u; room < all_rooms; room += THREADS) {
        let r = room + thread;
        let at = vec3<u32>(r % size.x, (r / size.x) % size.y, r / (size.x * size.y));
        var g = NONE;
        if thread < THREADS && r < all_rooms {
            // Bodies do not reach round a periodic world.
            let b = first + vec3<i32>(at);
            let here = place_in_box(layer_now, b);
            if here != NONE && all(wrapped(layer_now, b) == b) {
                g = directory[here].y;
            }
        }
        let bit = 1u << (thread & 31u);
        if g != NONE {
            atomicOr(&filled[own], bit);
        }
        workgroupBarrier();
        let one = vec4<u32>(atomicLoad(&filled[0]), atomicLoad(&filled[1]), atomicLoad(&filled[2]), atomicLoad(&filled[3]));
        let two = vec4<u32>(atomicLoad(&filled[4]), atomicLoad(&filled[5]), atomicLoad(&filled[6]), atomicLoad(&filled[7]));
        let count = countOneBits(one);
        let more = countOneBits(two);
        let listed = dot(count + more, vec4<u32>(1u));
        if g != NONE {
            let before = dot(count, vec4<u32>(vec4<u32>(0u, 1u, 2u, 3u) < vec4<u32>(own)))
                + dot(more, vec4<u32>(vec4<u32>(4u, 5u, 6u, 7u) < vec4<u32>(own)));
            blocks[before + countOneBits(atomicLoad(&filled[own]) & (bit - 1u))] = vec2<u32>(g, (at.x << 20u) | (at.y << 10u) | at.z);
        }
        workgroupBarrier();
        if thread < 8u {
            atomicStore(&filled[thread], 0u);
        }
        for (var start = select(listed, thread >> 6u, thread < THREADS); start < listed; start += 128u) {
            // Those with ground in the box, as bits.
            var candidates = 0u;
            for (var turn = 0u; turn < 32u && start + 4u * turn < listed; turn += 8u) {
                let m = vec4<f32>(
                    mass_at(start, turn, listed, thread),
                    mass_at(start, turn + 1u, listed, thread),
                    mass_at(start, turn + 2u, listed, thread),
                    mass_at(start, turn + 3u, listed, thread),
                );
                let n = vec4<f32>(
                    mass_at(start, turn + 4u, listed, thread),
                    mass_at(start, turn + 5u, listed, thread),
                    mass_at(start, turn + 6u, listed, thread),
                    mass_at(start, turn + 7u, listed, thread),
                );
                let low = vec4<u32>(m > vec4<f32>(layers[layer_now].least));
                let high = vec4<u32>(n > vec4<f32>(layers[layer_now].least));
                candidates |= (dot(low, vec4<u32>(1u, 2u, 4u, 8u)) | dot(high, vec4<u32>(16u, 32u, 64u, 128u))) << turn;
            }
            while candidates != 0u {
                let turn = firstTrailingBit(candidates);
                candidates &= candidates - 1u;
                let n = node_of(turn, thread);
                let block = blocks[start + 4u * turn];
                let g = block.x;
                let node = grid[g * 64u + n];
                let at = vec3<u32>(block.y >> 20u, block.y >> 10u, block.y) & vec3<u32>(1023u);
                let x = (first + vec3<i32>(at)) * 4 + local_of(n);
                if any(x < least) || any(x > most) {
                    continue;
                }
                let mass = $MASS;
                if mass > layers[layer_now].least {
                    let centre = vec3<f32>(0.5 / shrink) - within;
                    let arm = (vec3<f32>((x << vec3<u32>(level)) - cell) + centre) * H;
                    let room = at.x + size.x * (at.y + size.y * at.z);
                    let press = real(lent[pressed_at(k, level, room, n)]).xyz * (step.dt * steps_of(layer_now) / mass);
                    let grip = coupling_grip(number, arm.x * rows[0] + arm.y * rows[1] + arm.z * rows[2], H / shrink, press);
                    if grip.kind != GRIP_NONE {
                        let normal = vec3<f32>(dot(rows[0], grip.normal), dot(rows[1], grip.normal), dot(rows[2], grip.normal));
                        let to = touch_at(k, kept_touches, thread);
                        lent[to] = bitcast<vec4<u32>>(vec4<f32>(arm, mass));
                        lent[to + THREADS] = vec4<u32>(bitcast<vec3<u32>>(node.xyz), (g * 64u + n) | (grip.kind << 30u));
                        lent[to + 2u * THREADS] = bitcast<vec4<u32>>(vec4<f32>(normal, grip.most));
                        kept_touches++;
                        if grip.deep {
                            atomicAdd(&deep, 1u);
                        }
                    }
                }
            }
        }
        workgroupBarrier();
    }
}

// Which node of a block a thread looks at, turn by turn.
fn node_of(turn: u32, thread: u32) -> u32 {
    return (thread + 21u * turn) & 63u;
}

// What it weighs, if there is such a block.
fn mass_at(start: u32, turn: u32, listed: u32, thread: u32) -> f32 {
    let j = start + 4u * turn;
    if j >= listed {
        return 0.0;
    }
    return grid[blocks[j].x * 64u + node_of(turn, thread)].w;
}

// Where a node that a thread keeps stands.
fn touch_at(k: u32, i: u32, thread: u32) -> u32 {
    return TOUCHES + (k * EACH + i) * TOUCH * THREADS + thread;
}

fn touch_of(k: u32, i: u32, thread: u32) -> Touch {
    let at = touch_at(k, i, thread);
    let arm = real(lent[at]);
    let how = lent[at + THREADS];
    let grip = real(lent[at + 2u * THREADS]);
    return Touch(arm.xyz, arm.w, real(how).xyz, how.w & 0x3fffffffu, CouplingGrip(how.w >> 30u, grip.xyz, grip.w, false, 0.0));
}

// What the nodes give at the frozen twist, and G_iT m_i D G_i with D the law's derivative or its secant, summed over a thread's.
fn assemble(k: u32, tangent: bool, thread: u32) -> Sums {
    var sum: Sums;
    var slides = false;
    let twist = frozen;
    let number = lent[k * LENT + 3u].w;
    for (var i = 0u; i < kept_touches; i++) {
        let touch = touch_of(k, i, thread);
        sum.lower1.w += touch.mass;
        let r = touch.arm;
        let u = touch.velocity - velocity_of(twist, r);
        let hold = hold_of(coupling_friction(number), touch.grip, u);
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

// Sums what threads have into the first of each column's rows.
fn sum_up(own: Sums, thread: u32) {
    let row = thread % ROWS;
    let quarter = thread / ROWS;
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
    // A column's eighth of rows a thread, then a column.
    if thread < 8u * COLUMNS {
        let at = thread % COLUMNS * COLUMN + thread / COLUMNS;
        exchange[at] = eight(at, 8u);
    }
    workgroupBarrier();
    if thread < COLUMNS {
        exchange[thread * COLUMN] = eight(thread * COLUMN, 1u);
    }
    workgroupBarrier();
}

fn eight(at: u32, by: u32) -> vec4<f32> {
    return ((exchange[at] + exchange[at + by]) + (exchange[at + 2u * by] + exchange[at + 3u * by]))
        + ((exchange[at + 4u * by] + exchange[at + 5u * by]) + (exchange[at + 6u * by] + exchange[at + 7u * by]));
}

// A row of the system: its coefficients, and what is out of balance, an impulse or an angular impulse.
struct Row { linear: vec3<f32>, angular: vec3<f32>, missing: f32 }

fn without(row: Row, other: Row, times: f32) -> Row {
    return Row(row.linear - times * other.linear, row.angular - times * other.angular, row.missing - times * other.missing);
}

// Solves the system by elimination; the secant's is symmetric and positive, and needs no pivots.
fn eliminate(rows: array<Row, 6>) -> Twist {
    let a = rows[0];
    var b = rows[1];
    var c = rows[2];
    var d = rows[3];
    var e = rows[4];
    var f = rows[5];
    let pa = 1.0 / a.linear.x;
    b = without(b, a, b.linear.x * pa);
    c = without(c, a, c.linear.x * pa);
    d = without(d, a, d.linear.x * pa);
    e = without(e, a, e.linear.x * pa);
    f = without(f, a, f.linear.x * pa);
    let pb = 1.0 / b.linear.y;
    c = without(c, b, c.linear.y * pb);
    d = without(d, b, d.linear.y * pb);
    e = without(e, b, e.linear.y * pb);
    f = without(f, b, f.linear.y * pb);
    let pc = 1.0 / c.linear.z;
    d = without(d, c, d.linear.z * pc);
    e = without(e, c, e.linear.z * pc);
    f = without(f, c, f.linear.z * pc);
    let pd = 1.0 / d.angular.x;
    e = without(e, d, e.angular.x * pd);
    f = without(f, d, f.angular.x * pd);
    let pe = 1.0 / e.angular.y;
    f = without(f, e, f.angular.y * pe);
    var turns = vec3<f32>(0.0, 0.0, f.missing / f.angular.z);
    turns.y = (e.missing - e.angular.z * turns.z) * pe;
    turns.x = (d.missing - d.angular.y * turns.y - d.angular.z * turns.z) * pd;
    var moves = vec3<f32>(0.0, 0.0, (c.missing - dot(c.angular, turns)) * pc);
    moves.y = (b.missing - dot(b.angular, turns) - b.linear.z * moves.z) * pb;
    moves.x = (a.missing - dot(a.angular, turns) - a.linear.y * moves.y - a.linear.z * moves.z) * pa;
    return Twist(moves, turns);
}

// Root of twice the kinetic energy of a twist of the body.
fn energy_norm(twist: Twist) -> f32 {
    return sqrt(body_mass * dot(twist.linear, twist.linear) + dot(twist.angular, inertia * twist.angular));
}

// Solves the system of the sums, and takes the step that was found, or asks for another one.
fn decide() {
    if iterations == 0u && mode == TANGENT {
        // Ground much heavier than the body is first taken as lighter: its true weight then finds the right nodes in contact.
        weight = min(LIGHT * body_mass / exchange[7u * COLUMN].w, 1.0);
    }
    let u0 = exchange[0];
    let u1 = exchange[COLUMN];
    let u2 = exchange[2u * COLUMN];
    let u3 = exchange[3u * COLUMN];
    let u4 = exchange[4u * COLUMN];
    let u5 = exchange[5u * COLUMN];
    let l0 = exchange[6u * COLUMN];
    let l1 = exchange[7u * COLUMN];
    let l2 = exchange[8u * COLUMN];
    let l3 = exchange[9u * COLUMN];
    let l4 = exchange[10u * COLUMN];
    let force = vec3<f32>(u0.w, u1.w, u2.w);
    let torque = vec3<f32>(u3.w, u4.w, u5.w);
    let size_of_all = l0.w;
    // Rows of the four quarters of the nodes' matrix.
    let p = transpose(mat3x3<f32>(u0.xyz, u1.xyz, u2.xyz));
    let q = transpose(mat3x3<f32>(u3.xyz, u4.xyz, u5.xyz));
    let r = transpose(mat3x3<f32>(l0.xyz, l1.xyz, l2.xyz));
    let s = transpose(mat3x3<f32>(l3.xyz, l4.xyz, vec3<f32>(l2.w, l3.w, l4.w)));
    let old = frozen;
    let lag = Twist(free.linear - old.linear, free.angular - old.angular);
    let f = weight * force + body_mass * lag.linear;
    let t = weight * torque + inertia * lag.angular;
    if mode == TANGENT && before_step > 0.0 && iterations < MAX_ITERATIONS {
        // Where bounds are reached on the way, a step may lead beyond what balances along it: it is cut back.
        let beyond = -(dot(last_step.linear, f) + dot(last_step.angular, t));
        if beyond > OVERSHOT * before_step {
            let back = beyond / (before_step + beyond);
            frozen = Twist(old.linear - back * last_step.linear, old.angular - back * last_step.angular);
            last_step = Twist((1.0 - back) * last_step.linear, (1.0 - back) * last_step.angular);
            before_step *= 1.0 - back;
            iterations++;
            atomicStore(&sliding, 0u);
            return;
        }
    }
    before_step = 0.0;
    let own = body_mass;
    let change = eliminate(array<Row, 6>(
        Row(weight * p[0] + vec3<f32>(own, 0.0, 0.0), weight * q[0], f.x),
        Row(weight * p[1] + vec3<f32>(0.0, own, 0.0), weight * q[1], f.y),
        Row(weight * p[2] + vec3<f32>(0.0, 0.0, own), weight * q[2], f.z),
        Row(weight * r[0], weight * s[0] + inertia[0], t.x),
        Row(weight * r[1], weight * s[1] + inertia[1], t.y),
        Row(weight * r[2], weight * s[2] + inertia[2], t.z),
    ));
    let slid = atomicLoad(&sliding) != 0u;
    atomicStore(&sliding, 0u);
    let moved = Twist(old.linear + change.linear, old.angular + change.angular);
    if mode == TANGENT && !(dot(change.linear, f) + dot(change.angular, t) >= 0.0) {
        // Such a direction is replaced by the secant's, which always leads towards balance.
        mode = SECANT;
        return;
    }
    if mode != LAST {
        iterations++;
        let size = energy_norm(change);
        let speed = max(energy_norm(old), energy_norm(free));
        let noise = ROUNDING * size_of_all * inverseSqrt(body_mass);
        let converged = weight == 1.0 && size <= TOLERANCE * speed + noise;
        if !converged && iterations < MAX_ITERATIONS {
            frozen = moved;
            last_step = change;
            before_step = dot(change.linear, f) + dot(change.angular, t);
            // Newton's steps square what is missing. Where a small one was found and nodes slide, the secant's tells as well whether that was all, and
            // serves as the last.
            let was_small = weight == 1.0 && size * size <= TOLERANCE * speed * speed + noise * noise;
            mode = select(TANGENT, SECANT, mode == TANGENT && slid && was_small);
            if size <= SMALL * speed + noise && weight < 1.0 {
                weight = min(HEAVIER * weight, 1.0);
                before_step = 0.0;
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
    met = moved;
    gained = Twist(
        force - (change.linear * p + change.angular * q),
        torque - (change.linear * r + change.angular * s),
    );
}

// The body meets the nodes of a level.
fn meet(k: u32, level: u32, thread: u32) {
    if rehearses {
        kept_touches = u32(thread < THREADS);
    } else {
        find_touches(k, level, thread);
    }
    if kept_touches > 0u {
        atomicStore(&touching, 1u);
    }
    workgroupBarrier();
    if thread == 0u {
        mode = select(DONE, TANGENT, atomicLoad(&touching) != 0u);
        atomicStore(&touching, 0u);
        deep_nodes += atomicLoad(&deep);
        atomicStore(&deep, 0u);
        iterations = 0u;
        before_step = 0.0;
        frozen = expected;
    }
    if workgroupUniformLoad(&mode) == DONE {
        return;
    }
    // A step more for each direction that is replaced, and the last.
    for (var turn = 0u; turn < select(2u * MAX_ITERATIONS + 1u, 1u, rehearses); turn++) {
        let now = workgroupUniformLoad(&mode);
        if now == DONE {
            break;
        }
        sum_up(assemble(k, now == TANGENT, thread), thread);
        if thread == 0u {
            decide();
        }
    }
    let at_last = frozen;
    let number = lent[k * LENT + 3u].w;
    let surface = met;
    var fastest = 0u;
    for (var i = 0u; i < kept_touches; i++) {
        let touch = touch_of(k, i, thread);
        let hold = hold_of(coupling_friction(number), touch.grip, touch.velocity - velocity_of(at_last, touch.arm));
        if !hold.held {
            continue;
        }
        if rehearses {
            break;
        }
        let of_surface = velocity_of(surface, touch.arm);
        let u = touch.velocity - of_surface;
        let kept = of_surface + kept_by(hold, u);
        grid[touch.node].x = kept.x;
        grid[touch.node].y = kept.y;
        grid[touch.node].z = kept.z;
        let felt = min(touch.mass * layers[layer_now].felt, 1.0);
        fastest = max(fastest, max(max(magnitude_bits(felt * kept.x), magnitude_bits(felt * kept.y)), magnitude_bits(felt * kept.z)));
    }
    atomicMax(&fastest_node, fastest);
    impulse += gained.linear;
    angular_impulse += gained.angular;
    momentum += gained.angular;
    free.linear += gained.linear / body_mass;
    free.angular = spin(rotation_of(rotation), momentum);
    expected = free;
    workgroupBarrier();
    if thread == 0u {
        atomicMax(&status[step_word(step.number, layer_now, SPEED)], atomicLoad(&fastest_node));
        if is_too_fast(layer_now, bitcast<f32>(atomicLoad(&fastest_node))) {
            atomicAdd(&status[fast_word(step.number)], 1u);
        }
        atomicStore(&fastest_node, 0u);
    }
}

// Notes what contact made of the body, and moves it if that is the slot's first.
fn finish(k: u32) {
    let next = state_at(k, select(slot_now(), MAX_SLOTS, rehearses) + 1u);
    if !SUBCYCLED || step.first_level == 0u {
        move_on(k, next);
    }
    lent[next + 3u] = vec4<u32>(bitcast<vec3<u32>>(free.linear), deep_nodes);
    lent[next + 4u] = vec4<u32>(bitcast<vec3<u32>>(momentum), unconverged);
    lent[next + 5u] = vec4<u32>(bitcast<vec3<u32>>(impulse), 0u);
    lent[next + 6u] = vec4<u32>(bitcast<vec3<u32>>(angular_impulse), 0u);
}

fn move_on(k: u32, next: u32) {
    let q = rotation_of(rotation);
    // The angular velocity half-way, by the implicit midpoint rule: each round gains a factor |w| dt / 2.
    var angular = free.angular;
    for (var again = 0u; again < 4u; again++) {
        let before = angular;
        angular = spin(q + turning(q, 0.5 * step.dt * angular), momentum);
        if all(abs(angular - before) <= 1e-7 * abs(before)) {
            break;
        }
    }
    let turned = turning(q, step.dt * angular) + q * (0.5 - 0.5 * dot(q, q));
    rotation += bitcast<vec4<u32>>(vec4<i32>(round(turned * 1073741824.0)));

    let by = free.linear * step.dt_per_h;
    let whole = floor(abs(by));
    let part = vec3<u32>((abs(by) - whole) * 4294967296.0);
    let old = place.xyz;
    let other = select(old - part, old + part, by >= vec3<f32>(0.0));
    let carry = select(-vec3<i32>(other > old), vec3<i32>(other < old), by >= vec3<f32>(0.0));
    cell += vec3<i32>(sign(by) * whole) + carry;

    // How far the surface has come, along the axes and by turning, and how far it goes in a step of all levels.
    let extent_in_cells = real(lent[k * LENT + 2u]).w;
    let way = bitcast<f32>(place.w) + length(angular) * step.dt * extent_in_cells;
    place = vec4<u32>(other, bitcast<u32>(way));
    let start = bitcast<vec3<i32>>(lent[k * LENT + 8u].xyz);
    let come = vec3<f32>(cell - start) + (vec3<f32>(other) - vec3<f32>(lent[k * LENT + 9u].xyz)) * 2.3283064365386963e-10;
    let fits = all(come - way >= real(lent[k * LENT + 6u]).xyz) && all(come + way <= real(lent[k * LENT + 7u]).xyz);
    let surface = (length(free.linear) + length(step.gravity)) * step.dt_per_h + length(angular) * step.dt * extent_in_cells;
    let is_slow = surface * f32(SUBSTEPS) < real(lent[k * LENT + 4u]).w;
    lent[next] = vec4<u32>(bitcast<vec3<u32>>(cell), 0u);
    lent[next + 1u] = place;
    lent[next + 2u] = rotation;
    if !rehearses {
        if !(fits && is_slow) && (slot_now() + 1u) % SUBSTEPS == 0u {
            atomicStore(&status[FOLLOWED], 1u);
        }
        $STAY_AWAKE
    }
}

// What happens to a body in a slot. Behind the last one stands the workgroup that rehearses.
fn free_body(w: u32, thread: u32) {
    rehearses = w >= WORLDS * FREES;
    let k = select(w, 0u, rehearses);
    let is_first = !SUBCYCLED || step.first_level == 0u;
    let at = state_at(k, state_now());
    layer_now = k / FREES * LEVELS;
    take_up(k, at, is_first);
    if thread == 0u {
        end_level = last_level(k);
    }
    let first_level = select(0u, step.first_level, SUBCYCLED);
    let end = workgroupUniformLoad(&end_level);
    if end <= first_level {
        return;
    }
    for (var level = first_level; level < end; level++) {
        layer_now = k / FREES * LEVELS + level;
        meet(k, level, thread);
    }
    if thread == 0u {
        layer_now = k / FREES * LEVELS;
        finish(k);
    }
}
