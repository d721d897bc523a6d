// Where a robot's links are, how they move, and its mass matrix, as `dynamics.rs` finds them on the host; a part of `robot.wgsl`.

// Finds where links are, from the roots on, which are turned as `robot_turn` says: how each is turned and shifted within its parent is known before.
fn robot_place(thread: u32) {
    var depth_of = ROBOT_NONE;
    var turn = robot_turn;
    var shift = -robot_rotated(turn, robot_link[5].xyz);
    if thread < robot_links {
        depth_of = u32(robot_link[1].w);
        let head = robot_link[0];
        if depth_of > 0u {
            turn = robot_link[3];
            shift = robot_link[2].xyz;
            if head.y > 0.0 {
                let along = robot_link[4].xyz;
                let position = robot_link[1].x * robot_position[u32(head.z)] + robot_link[1].y;
                if head.y == 1.0 {
                    turn = robot_turned(turn, vec4<f32>(sin(0.5 * position) * along, cos(0.5 * position)));
                } else {
                    shift += position * robot_rotated(turn, along);
                }
            }
        }
    }
    for (var depth = 0u; depth <= robot_depth; depth++) {
        if depth == depth_of {
            var q = turn;
            var origin = shift;
            if depth > 0u {
                let parent = robot_order[thread].z;
                let of_parent = robot_rotation[parent];
                q = robot_turned(of_parent, turn);
                origin = robot_asked[parent].moment + robot_rotated(of_parent, shift);
            }
            q = normalize(q);
            robot_rotation[thread] = q;
            robot_asked[thread].moment = origin;
            robot_centre[thread] = origin + robot_rotated(q, robot_link[5].xyz);
        }
        workgroupBarrier();
    }
}

// Finds how links move, and what that asks: their accelerations without any rate changing.
fn robot_move(thread: u32) {
    let none = RobotMotion(vec3<f32>(0.0), vec3<f32>(0.0));
    var by = none;
    if thread < robot_links {
        let head = robot_link[0];
        var axis = none;
        if head.y > 0.0 {
            // Turning about an axis leaves it where it is.
            let in_world = robot_link[1].x * robot_rotated(robot_rotation[thread], robot_link[4].xyz);
            if head.y == 1.0 {
                axis = RobotMotion(in_world, cross(robot_asked[thread].moment, in_world));
            } else {
                axis.linear = in_world;
            }
            let rate = robot_free[robot_order[thread].w];
            by = RobotMotion(rate * axis.angular, rate * axis.linear);
        }
        robot_axis[thread] = axis;
    }
    workgroupBarrier();
    if thread < robot_links {
        let motion = robot_motion_at(ROBOT_NOW, thread);
        var asked = RobotWrench(vec3<f32>(0.0), vec3<f32>(0.0));
        asked.force = -cross(motion.angular, motion.linear) * f32(robot_link[1].w == 0.0);
        robot_motion = motion;
        asked.moment += cross(motion.angular, by.angular);
        asked.force += cross(motion.angular, by.linear) + cross(motion.linear, by.angular);
        robot_asked[thread] = asked;
    }
    workgroupBarrier();
    if thread < robot_links {
        robot_weigh(thread);
    }
    workgroupBarrier();
}

// A link's inertia, and how much momentum it lacks for the acceleration that is asked of it.
fn robot_weigh(l: u32) {
    let mass = robot_link[1].z;
    let c = robot_centre[l];
    let rows = rows_of(robot_rotation[l]);
    let back = mat3x3<f32>(rows[0], rows[1], rows[2]);
    let tensor = mat3x3<f32>(robot_link[6].xyz, robot_link[7].xyz, robot_link[8].xyz);
    let turned = transpose(back) * tensor * back;
    let first = mass * c;
    let own = RobotInertia(
        vec4<f32>(first, mass),
        vec3<f32>(turned[0].x, turned[1].y, turned[2].z) + vec3<f32>(dot(first, c)) - first * c,
        vec3<f32>(turned[1].z, turned[2].x, turned[0].y) - first.yzx * c.zxy,
    );
    robot_inertia[l] = own;
    var drift = RobotMotion(vec3<f32>(0.0), vec3<f32>(0.0));
    for (var a = l; a != ROBOT_NONE; a = robot_order[a].z) {
        drift = RobotMotion(drift.angular + robot_asked[a].moment, drift.linear + robot_asked[a].force);
    }
    let motion = robot_motion;
    let momentum = robot_momentum(own, motion);
    let lacks = robot_momentum(own, drift);
    robot_lacks = RobotWrench(
        lacks.moment + cross(motion.angular, momentum.moment) + cross(motion.linear, momentum.force),
        lacks.force + cross(motion.angular, momentum.force),
    );
}

// Sums up, for each link, the inertia of all that hangs on it, and what their motion asks; then the mass matrix.
fn robot_compose(thread: u32) {
    if thread < robot_links {
        robot_asked[thread] = robot_lacks;
    }
    workgroupBarrier();
    var asked = RobotWrench(vec3<f32>(0.0), vec3<f32>(0.0));
    var inertia = RobotInertia(vec4<f32>(0.0), vec3<f32>(0.0), vec3<f32>(0.0));
    if thread < robot_links {
        let end = robot_order[thread].x;
        for (var l = thread; l < end; l++) {
            let one = robot_asked[l];
            let own = robot_inertia[l];
            asked = RobotWrench(asked.moment + one.moment, asked.force + one.force);
            inertia = RobotInertia(inertia.first + own.first, inertia.diagonal + own.diagonal, inertia.beside + own.beside);
        }
    }
    workgroupBarrier();
    if thread < robot_links {
        robot_asked[thread] = asked;
        robot_inertia[thread] = inertia;
    }
    workgroupBarrier();
    for (var e = thread; e < select(0u, robot_rates * robot_rates, thread < ROBOT_THREADS); e += ROBOT_THREADS) {
        let i = e / robot_rates;
        let j = e % robot_rates;
        robot_mass[i * ROBOT_RATES + j] = robot_mass_of(i, j);
    }
    workgroupBarrier();
    if robot_drives {
        robot_mass[thread * (ROBOT_RATES + 1u)] += robot_drive[1].w;
    }
    workgroupBarrier();
}

// Power for each unit of both rates that the momentum of what both move takes.
fn robot_mass_of(i: u32, j: u32) -> f32 {
    var sum = 0.0;
    var a = robot_head[i];
    for (var turn = 0u; turn < robot_links && a != ROBOT_NONE; turn++) {
        var b = robot_head[j];
        for (var other = 0u; other < robot_links && b != ROBOT_NONE; other++) {
            var deeper = ROBOT_NONE;
            if robot_hangs_on(b, a) {
                deeper = b;
            } else if robot_hangs_on(a, b) {
                deeper = a;
            }
            if deeper != ROBOT_NONE {
                sum += robot_power(robot_axis_of(i, a), robot_momentum(robot_inertia[deeper], robot_axis_of(j, b)));
            }
            b = robot_order[b].y;
        }
        a = robot_order[a].y;
    }
    return sum;
}

// The rates' equation takes the forces of motion as they were. What momentum lost by that, the base's rates make up for; what energy lost or gained, the motion of joints does, less
// what the tree moves as a whole. What is more than that can give is owed.
fn robot_correct(thread: u32) {
    if thread < robot_rates {
        let base = robot_own_tree.x + robot_own_tree.y;
        var of_base = 0.0;
        var of_joints = 0.0;
        for (var j = 0u; j < robot_rates; j++) {
            let part = robot_mass[thread * ROBOT_RATES + j] * robot_free[j];
            of_base += select(0.0, part, j < base);
            of_joints += select(part, 0.0, j < base);
        }
        robot_work[thread] = robot_free[thread] * of_joints;
        if !robot_drives {
            robot_missing[thread] = robot_held - of_base - of_joints;
            robot_work[thread] = of_joints;
            robot_driven[thread] = robot_held;
        }
    }
    workgroupBarrier();
    // Two threads for each tree: what momentum lacks, and how the base would move if joints stood still of a sudden, less how it moves.
    if thread < 2u * robot_tree_count {
        let tree = robot_tree(thread / 2u);
        let halts = thread % 2u == 1u;
        if tree.y > 0u {
            var rows: array<CouplingRow, 6>;
            for (var i = 0u; i < 6u; i++) {
                let at = (tree.x + i) * ROBOT_RATES + tree.x;
                rows[i] = CouplingRow(
                    vec3<f32>(robot_mass[at], robot_mass[at + 1u], robot_mass[at + 2u]),
                    vec3<f32>(robot_mass[at + 3u], robot_mass[at + 4u], robot_mass[at + 5u]),
                    select(robot_missing[tree.x + i], robot_work[tree.x + i], halts),
                );
            }
            let by = solve_rows(rows);
            for (var i = 0u; i < 3u; i++) {
                if halts {
                    robot_step[tree.x + i] = by.linear[i];
                    robot_step[tree.x + 3u + i] = by.angular[i];
                } else {
                    robot_free[tree.x + i] += by.linear[i];
                    robot_free[tree.x + 3u + i] += by.angular[i];
                }
            }
        }
    }
    workgroupBarrier();
    var further = 0.0;
    if thread < robot_rates {
        // Twice the energy of the tree as a whole, and of its joints besides.
        var whole = 0.0;
        var own = 0.0;
        let base = robot_own_tree.x + robot_own_tree.y;
        for (var i = robot_own_tree.x; i < base; i++) {
            whole += (robot_free[i] + robot_step[i]) * robot_driven[i];
            own -= robot_step[i] * robot_work[i];
        }
        let end = base + u32(robot_tree_row(robot_tree_of_rate(), 1u).z);
        for (var i = base; i < end; i++) {
            own += robot_work[i];
        }
        // As in `robot.rs`; but rounding of the whole is not the joints' to make up for.
        robot_at_start = vec2<f32>(whole + own, 0.0);
        if own > 0.0 {
            let blow = robot_kept.y / robot_at_start.x;
            let missing = robot_kept.x - robot_at_start.x;
            let rounding = ROBOT_ROUNDING * robot_at_start.x;
            let wanted = sign(missing) * max(abs(missing) - rounding, 0.0) / (1.0 + blow * blow);
            let share = clamp(1.0 + wanted / own, 0.0, ROBOT_MOST_RAISED);
            further = (sqrt(share) - 1.0) * select(-robot_step[thread], robot_free[thread], robot_drives);
            let gained = (share - 1.0) * own;
            robot_at_start = vec2<f32>(whole + own + gained, max(gained - wanted, 0.0));
        }
    }
    workgroupBarrier();
    if thread < robot_rates {
        robot_free[thread] += further;
    }
    workgroupBarrier();
}
