// Free bodies in a slot, a workgroup each: gravity, the levels' nodes one level after the other, and the motion. What they and the nodes inside them do is
// found together, as by `contact.rs` of the coupling: with V the twist, m_i the nodes' masses and G_i V the surface's velocity at node i,
//   M (V - V_free) = sum_i G_iT m_i f(u_i - G_i V),
// by Newton's method; the last step is that of the secant f(u) = K(u) u, K frozen, so that the body gets what the nodes lose, and the whole is
// dissipative even where the iteration has not converged. All sums are in a fixed order.

// As in `contact.rs`, but for the tolerance: f32 carries seven digits, of which sums over nodes lose some.
const MAX_ITERATIONS: u32 = 24u;
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

// Columns of sums, with room between them so that threads do not wait for the same bank.
const COLUMNS: u32 = 12u;
const COLUMN: u32 = 65u;
const FOUND: u32 = 4u * COLUMNS;

struct Touch { arm: vec3<f32>, mass: f32, velocity: vec3<f32>, node: u32, grip: CouplingGrip }
struct Twist { linear: vec3<f32>, angular: vec3<f32> }

// Touches that a thread keeps at hand.
const KEPT: u32 = 4u;
var<private> kept_touches: array<Touch, KEPT>;

var<workgroup> go: u32;
var<workgroup> columns: array<vec4<f32>, 780>;
var<workgroup> parts: array<f32, 192>;
var<workgroup> sums: array<f32, 48>;
var<workgroup> matrix: array<f32, 84>;
var<workgroup> solution: array<f32, 6>;
var<workgroup> total: vec4<f32>;
var<workgroup> mode: u32;
var<workgroup> weight: f32;
var<workgroup> greatest: atomic<u32>;
// Touches on each level.
var<workgroup> on_level: array<atomic<u32>, LEVELS>;
var<workgroup> met_levels: u32;
// The body: mass [kg] and inertia [kg m2], world frame; its twist without the contact at hand, and in the iteration.
var<workgroup> body_mass: f32;
var<workgroup> inertia: array<f32, 9>;
var<workgroup> free: Twist;
var<workgroup> frozen: Twist;
var<workgroup> met: Twist;
// What is left to the twist without contact, and what is out of balance [N s, N m s].
var<workgroup> lag: array<f32, 6>;
var<workgroup> missing: array<f32, 6>;
// What the first thread alone knows: the inertia's inverse, body frame [1/(kg m2)], angular momentum, impulses in the slot, and counts.
var<private> inverse: mat3x3<f32>;
var<private> momentum: vec3<f32>;
var<private> impulse: vec3<f32>;
var<private> angular_impulse: vec3<f32>;
var<private> deep_nodes: u32;
var<private> unconverged: u32;
var<private> iterations: u32;

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

// The angular velocity that the angular momentum makes at a rotation.
fn spin(q: vec4<f32>) -> vec3<f32> {
    let rows = rows_of(q);
    let back = mat3x3<f32>(rows[0], rows[1], rows[2]);
    return (inverse * (back * momentum)) * back;
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

// Takes up the body as it is, and gravity. Is there anything to do?
fn begin(k: u32) -> u32 {
    let world = k / FREES;
    layer_now = world * LEVELS;
    if atomicLoad(&status[HALTED]) != 0u || (LAYERS > 1u && layers[layer_now].on == 0u) || lent[k * LENT + 5u].w == 0u {
        return 0u;
    }
    let is_first = !SUBCYCLED || step.first_level == 0u;
    let at = state_at(k, state_now());
    if is_first && slot_now() % SUBSTEPS == 0u && lent[at].w != 0u {
        // Nothing has moved yet.
        atomicStore(&status[HALT_STEP], step.number);
        atomicStore(&status[HALTED], FOLLOW);
        return 0u;
    }
    let q = rotation_of(lent[at + 2u]);
    body_mass = real(lent[k * LENT]).w;
    let tensor = seen_from_world(tensor_at(k * LENT), q);
    for (var j = 0u; j < 3u; j++) {
        inertia[j] = tensor[0][j];
        inertia[3u + j] = tensor[1][j];
        inertia[6u + j] = tensor[2][j];
    }
    inverse = tensor_at(k * LENT + 3u);
    momentum = real(lent[at + 4u]).xyz;
    free = Twist(real(lent[at + 3u]).xyz, spin(q));
    if is_first {
        var gravity = step.gravity;
        if GRAVITY_GROWS {
            gravity *= bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)]));
        }
        free.linear += gravity;
    } else {
        deep_nodes = lent[at + 3u].w;
        unconverged = lent[at + 4u].w;
        impulse = real(lent[at + 5u]).xyz;
        angular_impulse = real(lent[at + 6u]).xyz;
    }
    return 1u;
}

// Notes what contact made of the body, and moves it if that is the slot's first.
fn finish(k: u32) {
    let at = state_at(k, state_now());
    let next = state_at(k, slot_now() + 1u);
    if !SUBCYCLED || step.first_level == 0u {
        move_on(k, at, next);
    }
    lent[next + 3u] = vec4<u32>(bitcast<vec3<u32>>(free.linear), deep_nodes);
    lent[next + 4u] = vec4<u32>(bitcast<vec3<u32>>(momentum), unconverged);
    lent[next + 5u] = vec4<u32>(bitcast<vec3<u32>>(impulse), 0u);
    lent[next + 6u] = vec4<u32>(bitcast<vec3<u32>>(angular_impulse), 0u);
}

fn move_on(k: u32, at: u32, next: u32) {
    let q = rotation_of(lent[at + 2u]);
    // The angular velocity half-way, by the implicit midpoint rule: each round gains a factor |w| dt / 2.
    var angular = free.angular;
    for (var again = 0u; again < 4u; again++) {
        let before = angular;
        angular = spin(q + turning(q, 0.5 * step.dt * angular));
        if all(abs(angular - before) <= 1e-7 * abs(before)) {
            break;
        }
    }
    let turned = turning(q, step.dt * angular) + q * (0.5 - 0.5 * dot(q, q));
    lent[next + 2u] = lent[at + 2u] + bitcast<vec4<u32>>(vec4<i32>(round(turned * 1073741824.0)));

    let by = free.linear * step.dt_per_h;
    let whole = floor(abs(by));
    let part = vec3<u32>((abs(by) - whole) * 4294967296.0);
    let old = lent[at + 1u].xyz;
    let place = select(old - part, old + part, by >= vec3<f32>(0.0));
    let carry = select(-vec3<i32>(place > old), vec3<i32>(place < old), by >= vec3<f32>(0.0));
    let cell = bitcast<vec3<i32>>(lent[at].xyz) + vec3<i32>(sign(by) * whole) + carry;

    // How far the surface has come, along the axes and by turning, and how far it goes in a step of all levels.
    let extent_in_cells = real(lent[k * LENT + 2u]).w;
    let way = bitcast<f32>(lent[at + 1u].w) + length(angular) * step.dt * extent_in_cells;
    let start = bitcast<vec3<i32>>(lent[k * LENT + 8u].xyz);
    let come = vec3<f32>(cell - start) + (vec3<f32>(place) - vec3<f32>(lent[k * LENT + 9u].xyz)) * 2.3283064365386963e-10;
    let fits = all(come - way >= real(lent[k * LENT + 6u]).xyz) && all(come + way <= real(lent[k * LENT + 7u]).xyz);
    let surface = (length(free.linear) + length(step.gravity)) * step.dt_per_h + length(angular) * step.dt * extent_in_cells;
    let is_slow = surface * f32(SUBSTEPS) < real(lent[k * LENT + 4u]).w;
    lent[next] = vec4<u32>(bitcast<vec3<u32>>(cell), u32(!(fits && is_slow)));
    lent[next + 1u] = vec4<u32>(place, bitcast<u32>(way));
    $STAY_AWAKE
}

// Sums what threads have, column by column, into `sums`.
fn sum_up(thread: u32, own: array<vec4<f32>, COLUMNS>) {
    var mine = own;
    let row = thread & 63u;
    for (var quarter = 0u; quarter < 4u; quarter++) {
        if thread >> 6u == quarter {
            for (var c = 0u; c < COLUMNS; c++) {
                let before = columns[c * COLUMN + row];
                columns[c * COLUMN + row] = select(before + mine[c], mine[c], quarter == 0u);
            }
        }
        workgroupBarrier();
    }
    if thread < 4u * FOUND {
        let c = thread % FOUND;
        let start = thread / FOUND * 16u;
        var sum = 0.0;
        for (var r = 0u; r < 16u; r++) {
            let four = columns[(c >> 2u) * COLUMN + start + r];
            sum += select(select(four.x, four.y, (c & 1u) != 0u), select(four.z, four.w, (c & 1u) != 0u), (c & 2u) != 0u);
        }
        parts[thread] = sum;
    }
    workgroupBarrier();
    if thread < FOUND {
        sums[thread] = parts[thread] + parts[FOUND + thread] + parts[2u * FOUND + thread] + parts[3u * FOUND + thread];
    }
    workgroupBarrier();
}

// Which levels there are touches on, as bits: all of them are asked for at once.
fn levels_touched(k: u32, first_level: u32, end_level: u32, thread: u32) -> u32 {
    for (var level = first_level; level < end_level; level++) {
        let first_room = k * ROOMS + first_room_on(level);
        let rooms = touches[first_room].w;
        var count = 0u;
        for (var r = thread; r < rooms; r += 256u) {
            count += touches[first_room + r].x;
        }
        if count > 0u {
            atomicAdd(&on_level[level], count);
        }
    }
    workgroupBarrier();
    if thread == 0u {
        for (var level = first_level; level < end_level; level++) {
            met_levels |= select(0u, 1u << level, atomicLoad(&on_level[level]) > 0u);
        }
    }
    return workgroupUniformLoad(&met_levels);
}

// Lists the touches of a level in the order of rooms. Returns how many there are.
fn list_touches(k: u32, first_room: u32, thread: u32) -> u32 {
    let rooms = touches[first_room].w;
    let each = (rooms + 255u) / 256u;
    let start = min(thread * each, rooms);
    let end = min(start + each, rooms);
    var own = vec4<f32>(0.0);
    for (var r = start; r < end; r++) {
        let head = touches[first_room + r];
        own += vec4<f32>(f32(head.x), f32(head.y), bitcast<f32>(head.z), 0.0);
    }
    columns[thread] = own;
    workgroupBarrier();
    var side = 0u;
    for (var by = 1u; by < 256u; by = by << 1u) {
        var sum = columns[side * 256u + thread];
        if thread >= by {
            sum += columns[side * 256u + thread - by];
        }
        side = 1u - side;
        columns[side * 256u + thread] = sum;
        workgroupBarrier();
    }
    if thread == 255u {
        total = columns[thread];
    }
    var to = k * ROOMS * 64u + u32(columns[thread].x - own.x);
    for (var r = start; r < end; r++) {
        let count = touches[first_room + r].x;
        for (var rank = 0u; rank < count; rank++) {
            touch_order[to] = (first_room + r) * 64u + rank;
            to++;
        }
    }
    storageBarrier();
    return u32(workgroupUniformLoad(&total).x);
}

fn touch_at(k: u32, i: u32) -> Touch {
    let at = HEADS + touch_order[k * ROOMS * 64u + i] * TOUCH;
    let arm = real(touches[at]);
    let how = touches[at + 1u];
    let grip = real(touches[at + 2u]);
    return Touch(arm.xyz, arm.w, real(how).xyz, how.w & 0x3fffffffu, CouplingGrip(how.w >> 30u, grip.xyz, grip.w, false));
}

// The same, of which each thread keeps its first ones.
fn touch_of(k: u32, i: u32) -> Touch {
    if i < 256u * KEPT {
        return kept_touches[i / 256u];
    }
    return touch_at(k, i);
}

// What the nodes give at the frozen twist, and G_iT m_i D G_i with D the law's derivative or its secant, summed: the columns of the 6 x 6 matrix,
// upper and lower half; and, as fourth components, the six of the impulse, the sum of impulses' sizes [N s], and how many nodes slide.
fn assemble(k: u32, count: u32, tangent: bool, thread: u32) {
    var own: array<vec4<f32>, COLUMNS>;
    let twist = frozen;
    for (var i = thread; i < count; i += 256u) {
        let touch = touch_of(k, i);
        let u = touch.velocity - velocity_of(twist, touch.arm);
        let hold = coupling_hold(touch.grip, u);
        if !hold.held {
            continue;
        }
        let n = hold.normal;
        var d = mat3x3<f32>((1.0 - hold.drag) * n.x * n, (1.0 - hold.drag) * n.y * n, (1.0 - hold.drag) * n.z * n);
        d[0].x += hold.drag;
        d[1].y += hold.drag;
        d[2].z += hold.drag;
        let taken = touch.mass * (d * u);
        let slides = tangent && hold.friction > 0.0;
        if slides {
            // d(f |u_n| t) = -f t nT + drag (1 - n nT - t tT)
            let slope = hold.friction * n + hold.drag * hold.along;
            d -= mat3x3<f32>(slope.x * hold.along, slope.y * hold.along, slope.z * hold.along);
        }
        let r = touch.arm;
        var upper = array<vec3<f32>, 6>(
            d[0], d[1], d[2], d[2] * r.y - d[1] * r.z, d[0] * r.z - d[2] * r.x, d[1] * r.x - d[0] * r.y
        );
        for (var j = 0u; j < 6u; j++) {
            own[2u * j] += vec4<f32>(touch.mass * upper[j], 0.0);
            own[2u * j + 1u] += vec4<f32>(touch.mass * cross(r, upper[j]), 0.0);
        }
        let moment = cross(r, taken);
        own[0].w += taken.x;
        own[1].w += taken.y;
        own[2].w += taken.z;
        own[3].w += moment.x;
        own[4].w += moment.y;
        own[5].w += moment.z;
        own[6].w += touch.mass * length(u);
        own[7].w += select(0.0, 1.0, slides);
    }
    sum_up(thread, own);
}

// An entry of the system's matrix: what nodes hold, and the body.
fn entry(i: u32, j: u32) -> f32 {
    var own = 0.0;
    if i < 3u && i == j {
        own = body_mass;
    } else if i >= 3u && j >= 3u {
        own = inertia[(i - 3u) * 3u + j - 3u];
    }
    return weight * sums[(2u * j + i / 3u) * 4u + i % 3u] + own;
}

// What is out of balance at the frozen twist: an impulse, then an angular impulse.
fn residual(i: u32) -> f32 {
    var own = body_mass * lag[i];
    if i >= 3u {
        let row = (i - 3u) * 3u;
        own = inertia[row] * lag[3] + inertia[row + 1u] * lag[4] + inertia[row + 2u] * lag[5];
    }
    return weight * sums[4u * i + 3u] + own;
}

// Solves the system by elimination, an entry a thread, scaled so that its diagonal is 1: the secant's is symmetric and positive then, and needs no pivots.
fn solve(thread: u32) {
    let i = thread / 7u;
    let j = thread % 7u;
    var scale = 1.0;
    if thread < 42u {
        scale = inverseSqrt(entry(i, i));
        if j < 6u {
            matrix[thread] = entry(i, j) * scale * inverseSqrt(entry(j, j));
        } else {
            missing[i] = residual(i);
            matrix[thread] = missing[i] * scale;
        }
    }
    workgroupBarrier();
    var side = 0u;
    for (var p = 0u; p < 6u; p++) {
        if thread < 42u {
            let row = matrix[side + p * 7u + j] / matrix[side + p * 7u + p];
            matrix[42u - side + thread] = select(matrix[side + thread] - matrix[side + i * 7u + p] * row, row, i == p);
        }
        side = 42u - side;
        workgroupBarrier();
    }
    if thread < 42u && j == 6u {
        solution[i] = matrix[thread] * scale;
    }
    workgroupBarrier();
}

// Root of twice the kinetic energy of a twist of the body.
fn energy_norm(twist: Twist) -> f32 {
    let w = twist.angular;
    let turning = vec3<f32>(
        dot(vec3<f32>(inertia[0], inertia[1], inertia[2]), w),
        dot(vec3<f32>(inertia[3], inertia[4], inertia[5]), w),
        dot(vec3<f32>(inertia[6], inertia[7], inertia[8]), w),
    );
    return sqrt(body_mass * dot(twist.linear, twist.linear) + dot(w, turning));
}

// Goes on from a twist.
fn freeze(twist: Twist) {
    frozen = twist;
    let linear = free.linear - twist.linear;
    let angular = free.angular - twist.angular;
    lag = array<f32, 6>(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z);
}

// Takes the step that was found, or asks for another one.
fn decide() {
    let change = Twist(vec3<f32>(solution[0], solution[1], solution[2]), vec3<f32>(solution[3], solution[4], solution[5]));
    let moved = Twist(frozen.linear + change.linear, frozen.angular + change.angular);
    if mode == LAST {
        met = moved;
        mode = DONE;
        return;
    }
    var ahead = 0.0;
    for (var i = 0u; i < 6u; i++) {
        ahead += solution[i] * missing[i];
    }
    if mode == TANGENT && !(ahead >= 0.0) {
        // Such a direction is replaced by the secant's, which always leads towards balance.
        mode = SECANT;
        return;
    }
    iterations++;
    let size = energy_norm(change);
    let speed = max(energy_norm(frozen), energy_norm(free));
    let noise = ROUNDING * sums[4u * 6u + 3u] * inverseSqrt(body_mass);
    let converged = weight == 1.0 && size <= TOLERANCE * speed + noise;
    if converged || iterations == MAX_ITERATIONS {
        unconverged += u32(!converged);
        let is_secant = weight == 1.0 && (mode == SECANT || sums[4u * 7u + 3u] == 0.0);
        met = moved;
        weight = 1.0;
        mode = select(LAST, DONE, is_secant);
        return;
    }
    freeze(moved);
    mode = TANGENT;
    if size <= SMALL * speed + noise {
        weight = min(HEAVIER * weight, 1.0);
    }
}

// The body meets the nodes of a level.
fn meet(k: u32, level: u32, thread: u32) {
    let first_room = k * ROOMS + first_room_on(level);
    let count = list_touches(k, first_room, thread);
    if thread == 0u {
        deep_nodes += u32(total.y);
        iterations = 0u;
        mode = TANGENT;
        freeze(free);
        // Ground much heavier than the body is first taken as lighter: its true weight then finds the right nodes in contact.
        weight = min(LIGHT * body_mass / total.z, 1.0);
    }
    for (var i = thread; i < min(count, 256u * KEPT); i += 256u) {
        kept_touches[i / 256u] = touch_at(k, i);
    }
    // A step more for each direction that is replaced, and the last.
    for (var turn = 0u; turn < 2u * MAX_ITERATIONS + 1u; turn++) {
        let now = workgroupUniformLoad(&mode);
        if now == DONE {
            break;
        }
        assemble(k, count, now == TANGENT, thread);
        solve(thread);
        if thread == 0u {
            decide();
        }
    }
    var own: array<vec4<f32>, COLUMNS>;
    let at_last = frozen;
    let surface = met;
    for (var i = thread; i < count; i += 256u) {
        let touch = touch_of(k, i);
        let hold = coupling_hold(touch.grip, touch.velocity - velocity_of(at_last, touch.arm));
        if !hold.held {
            continue;
        }
        let of_surface = velocity_of(surface, touch.arm);
        let u = touch.velocity - of_surface;
        let kept = of_surface + (1.0 - hold.drag) * (u - dot(u, hold.normal) * hold.normal);
        let given = touch.mass * (touch.velocity - kept);
        own[0] += vec4<f32>(given, 0.0);
        own[1] += vec4<f32>(cross(touch.arm, given), 0.0);
        grid[touch.node] = vec4<f32>(kept, grid[touch.node].w);
        let felt = min(touch.mass * layers[layer_now].felt, 1.0);
        atomicMax(&greatest, max(max(magnitude_bits(felt * kept.x), magnitude_bits(felt * kept.y)), magnitude_bits(felt * kept.z)));
    }
    sum_up(thread, own);
    if thread == 0u {
        let given = vec3<f32>(sums[0], sums[1], sums[2]);
        let turns = vec3<f32>(sums[4], sums[5], sums[6]);
        impulse += given;
        angular_impulse += turns;
        momentum += turns;
        free.linear += given / body_mass;
        free.angular = spin(rotation_of(lent[state_at(k, state_now()) + 2u]));
        atomicMax(&status[step_word(step.number, layer_now, SPEED)], atomicLoad(&greatest));
        if LAYERS > 1u {
            atomicMax(&status[greatest_word(step.number)], atomicLoad(&greatest));
        }
        atomicStore(&greatest, 0u);
    }
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn free_bodies(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let k = group.y * extent.row + group.x;
    if thread == 0u {
        go = 0u;
        if k < WORLDS * FREES {
            go = begin(k);
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    var first_level = 0u;
    var end_level = LEVELS;
    if SUBCYCLED {
        first_level = step.first_level;
        end_level = min(step.end_level, LEVELS);
    }
    let touched = levels_touched(k, first_level, end_level, thread);
    for (var level = first_level; level < end_level; level++) {
        if (touched & (1u << level)) != 0u {
            layer_now = k / FREES * LEVELS + level;
            meet(k, level, thread);
        }
    }
    if thread == 0u {
        layer_now = k / FREES * LEVELS;
        finish(k);
    }
}
