// Points at which a robot's links touch walls and tools, or one another, as `touching.rs` finds them on the host; a part of `robot.wgsl`. Each acts like a node of ground that is
// much heavier than the robot and moves with the surface that it lies on.
//
// The group is told how many there are and what they weigh together, then POINT vectors for each: its place and its mass; the normal out of what the link touches, and how fast
// they may meet along it; the link's body and the one that it touches, ROBOT_NONE if that is a wall or a tool, and friction; its place as that one's tree has it, or how fast the wall
// or tool moves there.

const ROBOT_POINT: u32 = 4u;
// Points whose impulses are added up at once.
const ROBOT_PRESSES: u32 = min(ROBOT_POINTS, GROUP_ROOM / (2u * (ROBOT_RATES + 1u)));

// Of each point: mass, 0 where links move apart, and the share that friction takes of how they slide; what it gives [N s].
var<workgroup> robot_hold: array<vec2<f32>, max(ROBOT_POINTS, 1u)>;
var<workgroup> robot_given: array<vec3<f32>, max(ROBOT_POINTS, 1u)>;

// What points count for while rates without the ground are found.
var<workgroup> robot_weight: f32;

// How much points count for at first.
fn robot_least_weight() -> f32 {
    return min(ROBOT_LIGHT * robot_mass_of_all() / bitcast<f32>(group_told(0u).y), 1.0);
}

// How many points there are.
fn robot_points_told() -> u32 {
    if ROBOT_POINTS == 0u {
        return 0u;
    }
    return min(group_told(0u).x, ROBOT_POINTS);
}

// A vector of a point: its place, its surface, who touches whom and how, its place as the other's tree has it.
fn robot_point(p: u32, row: u32) -> vec4<u32> {
    return group_told(1u + p * ROBOT_POINT + row);
}

fn robot_velocity_at(m: RobotMotion, at: vec3<f32>) -> vec3<f32> {
    return m.linear + cross(m.angular, at);
}

// How a rate moves a link at a point against what it touches, for each unit.
fn robot_axis_against(p: u32, rate: u32) -> vec3<f32> {
    let at = bitcast<vec3<f32>>(robot_point(p, 0u).xyz);
    let bodies = robot_point(p, 2u).xy;
    let by = robot_velocity_at(robot_axis_at(rate, robot_body[bodies.x]), at);
    if bodies.y == ROBOT_NONE {
        return by;
    }
    return by - robot_velocity_at(robot_axis_at(rate, robot_body[bodies.y]), bitcast<vec3<f32>>(robot_point(p, 3u).xyz));
}

// Finds what each point gives at the rates of a kind, by the secant of the law: points are so heavy that its derivative would lead to and fro between sticking and sliding, and
// the secant's matrix needs no pivots.
fn robot_press(kind: u32, thread: u32) {
    if thread < robot_points {
        let place = bitcast<vec4<f32>>(robot_point(thread, 0u));
        let surface = bitcast<vec4<f32>>(robot_point(thread, 1u));
        let who = robot_point(thread, 2u);
        var moves = robot_velocity_at(robot_motion_at(kind, robot_body[who.x]), place.xyz);
        let other = bitcast<vec3<f32>>(robot_point(thread, 3u).xyz);
        if who.y == ROBOT_NONE {
            moves -= other;
        } else {
            moves -= robot_velocity_at(robot_motion_at(kind, robot_body[who.y]), other);
        }
        let u = -surface.w * surface.xyz - moves;
        let into = max(dot(u, surface.xyz), 0.0);
        let across = u - dot(u, surface.xyz) * surface.xyz;
        let sliding = length(across);
        let most = bitcast<f32>(who.z) * into;
        let drag = select(1.0, most / sliding, most < sliding);
        let mass = select(0.0, robot_weight * place.w, into > 0.0);
        robot_hold[thread] = vec2<f32>(mass, drag);
        robot_given[thread] = mass * (into * surface.xyz + drag * across);
    }
    workgroupBarrier();
}

// Says what points give behind the last step, by how that changes them: what they are at the rates there would say it no better than to what rounding leaves of these, and
// points are heavy. The step was found with what they gave before it.
fn robot_note_given(thread: u32) {
    if thread >= robot_points {
        return;
    }
    let hold = robot_hold[thread];
    var given = vec3<f32>(0.0);
    if hold.x > 0.0 {
        var moves = vec3<f32>(0.0);
        for (var i = 0u; i < robot_rates; i++) {
            moves += robot_step[i] * robot_axis_against(thread, i);
        }
        let normal = bitcast<vec3<f32>>(robot_point(thread, 1u).xyz);
        given = robot_given[thread] - hold.x * (hold.y * moves + (1.0 - hold.y) * dot(normal, moves) * normal);
    }
    set_group_word(robot_given_at + thread, vec4<u32>(bitcast<vec3<u32>>(given), 0u));
}

// What the points give a rate.
fn robot_pressed(rate: u32) -> f32 {
    var sum = 0.0;
    for (var p = 0u; p < robot_points; p++) {
        if robot_hold[p].x > 0.0 {
            sum += dot(robot_axis_against(p, rate), robot_given[p]);
        }
    }
    return sum;
}

// Adds what points give and take at the rates of a kind to the equations: for each point and rate first how that moves the point, and what the link then gets there.
fn robot_add_points(kind: u32, thread: u32) {
    robot_press(kind, thread);
    let n = robot_rates;
    for (var first = 0u; first < robot_points; first += ROBOT_PRESSES) {
        let count = min(robot_points - first, ROBOT_PRESSES);
        for (var e = thread; e < select(0u, count * (n + 1u), thread < ROBOT_THREADS); e += ROBOT_THREADS) {
            let p = first + e / (n + 1u);
            let rate = e % (n + 1u);
            let hold = robot_hold[p];
            var by = vec3<f32>(0.0);
            var gets = robot_given[p];
            if rate < n && hold.x > 0.0 {
                by = robot_axis_against(p, rate);
                let normal = bitcast<vec3<f32>>(robot_point(p, 1u).xyz);
                gets = hold.x * (hold.y * by + (1.0 - hold.y) * dot(normal, by) * normal);
            }
            set_group_room(2u * e, vec4<f32>(by, 0.0));
            set_group_room(2u * e + 1u, vec4<f32>(gets, 0.0));
        }
        workgroupBarrier();
        for (var i = thread >> 5u; i < select(0u, n, thread < ROBOT_THREADS); i += ROBOT_THREADS / 32u) {
            for (var j = thread & 31u; j <= n; j += 32u) {
                var sum = 0.0;
                for (var p = 0u; p < count; p++) {
                    sum += dot(group_room(2u * (p * (n + 1u) + i)).xyz, group_room(2u * (p * (n + 1u) + j) + 1u).xyz);
                }
                robot_matrix[i * ROBOT_ROW + j] += sum;
            }
        }
        workgroupBarrier();
    }
}

// The momentum of each tree after the step: what its rates say that impulses made of it, those of points among them.
fn robot_take_momentum(thread: u32) {
    if thread < robot_rates && !robot_drives {
        var sum = -robot_driven[thread];
        for (var j = 0u; j < robot_rates; j++) {
            sum += robot_mass[thread * ROBOT_RATES + j] * robot_free[j];
        }
        robot_missing[thread] = sum;
    }
    workgroupBarrier();
    if thread < robot_tree_count {
        let tree = robot_tree(thread);
        if tree.y > 0u {
            let i = tree.x;
            robot_linear += vec3<f32>(robot_missing[i], robot_missing[i + 1u], robot_missing[i + 2u]);
            robot_angular += vec3<f32>(robot_missing[i + 3u], robot_missing[i + 4u], robot_missing[i + 5u]);
        }
    }
    workgroupBarrier();
}
