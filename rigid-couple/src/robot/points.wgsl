// Points at which a robot's links touch walls, or one another, as `touching.rs` finds them on the host; a part of `robot.wgsl`. Each acts like a node of ground that is
// much heavier than the robot and moves with the surface that it lies on.
//
// The robot is told how many there are, then three vectors for each: its place and its mass; the normal out of what the link touches, and the gap; the link's body and the
// one that it touches, ROBOT_NONE if that is a wall, friction, and the greatest speed at which they may meet.

// As in `touching.rs`.
const ROBOT_PUSH: f32 = 0.1;
const ROBOT_FASTEST_PUSH: f32 = 20.0;
// Points whose impulses are added up at once.
const ROBOT_PRESSES: u32 = min(ROBOT_POINTS, GROUP_ROOM / (2u * (ROBOT_RATES + 1u)));

// Of each point: mass, 0 where links move apart, and the share that friction takes of how they slide; what it gives [N s].
var<workgroup> robot_hold: array<vec2<f32>, max(ROBOT_POINTS, 1u)>;
var<workgroup> robot_given: array<vec3<f32>, max(ROBOT_POINTS, 1u)>;

// What points count for while rates without the ground are found.
var<workgroup> robot_weight: f32;

// How much points count for at first.
fn robot_least_weight() -> f32 {
    let all = f32(robot_points) * bitcast<f32>(group_told(1u).w);
    return min(ROBOT_LIGHT * robot_inertia[0].first.w / all, 1.0);
}

// How many points there are.
fn robot_points_told() -> u32 {
    if ROBOT_POINTS == 0u {
        return 0u;
    }
    return min(group_told(0u).x, ROBOT_POINTS);
}

fn robot_velocity_at(m: RobotMotion, at: vec3<f32>) -> vec3<f32> {
    return m.linear + cross(m.angular, at);
}

// How a rate moves a link at a point against what it touches, for each unit.
fn robot_axis_against(p: u32, rate: u32) -> vec3<f32> {
    let at = bitcast<vec3<f32>>(group_told(1u + 3u * p).xyz);
    let bodies = group_told(3u + 3u * p).xy;
    let by = robot_velocity_at(robot_axis_at(rate, robot_body[bodies.x]), at);
    if bodies.y == ROBOT_NONE {
        return by;
    }
    return by - robot_velocity_at(robot_axis_at(rate, robot_body[bodies.y]), at);
}

// Finds what each point gives at the rates of a kind, by the secant of the law: points are so heavy that its derivative would lead to and fro between sticking and sliding, and
// the secant's matrix needs no pivots.
fn robot_press(kind: u32, thread: u32) {
    if thread < robot_points {
        let place = bitcast<vec4<f32>>(group_told(1u + 3u * thread));
        let surface = bitcast<vec4<f32>>(group_told(2u + 3u * thread));
        let who = group_told(3u + 3u * thread);
        var moves = robot_velocity_at(robot_motion_at(kind, robot_body[who.x]), place.xyz);
        if who.y != ROBOT_NONE {
            moves -= robot_velocity_at(robot_motion_at(kind, robot_body[who.y]), place.xyz);
        }
        let gap = surface.w;
        let push = min(gap * select(min(ROBOT_PUSH / group_dt(), ROBOT_FASTEST_PUSH), 1.0 / group_dt(), gap > 0.0), bitcast<f32>(who.w));
        let u = -push * surface.xyz - moves;
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
                let normal = bitcast<vec3<f32>>(group_told(2u + 3u * p).xyz);
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

// The robot's momentum after the step: what its rates say that impulses made of it, those of points among them.
fn robot_take_momentum(thread: u32) {
    if thread < robot_base_rates {
        var sum = -robot_driven[thread];
        for (var j = 0u; j < robot_rates; j++) {
            sum += robot_mass[thread * ROBOT_RATES + j] * robot_free[j];
        }
        robot_missing[thread] = sum;
    }
    workgroupBarrier();
    if robot_base_rates > 0u {
        robot_linear += vec3<f32>(robot_missing[0], robot_missing[1], robot_missing[2]);
        robot_angular += vec3<f32>(robot_missing[3], robot_missing[4], robot_missing[5]);
    }
    workgroupBarrier();
}
