// Motors, losses and stops of a robot's joints, as in `joints.rs`; a part of `robot.wgsl`.

// Corrects what the motor of the thread's drive is told by how its robot's base leans, as in `balance.rs`.
fn robot_balance(thread: u32) {
    if !robot_drives || robot_told[thread].w == 0.0 {
        return;
    }
    let head = robot_tree_row(robot_tree_of_rate(), 2u);
    if head.w == 0.0 {
        return;
    }
    // From the world's frame to the base's.
    let q = pose_rotation(group_pose(robot_own_tree.z));
    let back = vec4<f32>(-q.xyz, q.w);
    let up = robot_rotated(back, vec3<f32>(0.0, 0.0, 1.0));
    var spin = vec3<f32>(0.0);
    if robot_own_tree.y > 0u {
        let i = robot_own_tree.x + 3u;
        spin = robot_rotated(back, vec3<f32>(robot_free[i], robot_free[i + 1u], robot_free[i + 2u]));
    }
    let pitch = vec2<f32>(atan2(-up.x, length(up.yz)), spin.y);
    let roll = vec2<f32>(atan2(up.y, up.z), spin.x);
    for (var c = 0u; c < u32(head.w); c++) {
        let one = coupling_table(u32(head.z) + c);
        if u32(one.x) == thread {
            let lean = select(pitch, roll, one.y == 1.0);
            let leads_to = robot_position[thread] + robot_told[thread].x + one.z * lean.x + one.w * lean.y;
            robot_told[thread].x = clamp(leads_to, robot_drive[0].y, robot_drive[0].z) - robot_position[thread];
        }
    }
}

// The motor of the thread's drive at a rate: its torque, and by how much that falls for each unit.
fn robot_motor(thread: u32, rate: f32) -> RobotImpulse {
    let limits = robot_drive[0];
    let speed = robot_drive[1].x;
    let told = robot_told[thread];
    let gains = robot_drive[2].xy * told.w;
    let demand = gains.x * (told.x - group_dt() * rate) + gains.y * (told.y - rate) + told.z;
    let effort = limits.w;
    let fade = ROBOT_FADE * speed;
    let up = clamp((speed - rate) / fade, 0.0, 1.0);
    let down = clamp((speed + rate) / fade, 0.0, 1.0);
    if demand > effort * up {
        return RobotImpulse(effort * up, select(0.0, effort / fade, up > 0.0 && up < 1.0));
    }
    if demand < -effort * down {
        return RobotImpulse(-effort * down, select(0.0, effort / fade, down > 0.0 && down < 1.0));
    }
    return RobotImpulse(demand, gains.x * group_dt() + gains.y);
}

// All that acts in the joint of the thread's drive over the step, if it ends with this rate.
fn robot_impulse(thread: u32, rate: f32) -> RobotImpulse {
    let dt = group_dt();
    let limits = robot_drive[0];
    let losses = robot_drive[1];
    let motor = robot_motor(thread, rate);
    let grown = sqrt(rate * rate + ROBOT_CREEP * ROBOT_CREEP);
    let calm = ROBOT_CREEP / grown;
    var sum = RobotImpulse(
        dt * (motor.value - losses.y * rate - losses.z * (rate / grown)),
        dt * (motor.slope + losses.y + losses.z * calm * calm / grown),
    );
    let stiff = ROBOT_STIFF * robot_mass[thread * (ROBOT_RATES + 1u)];
    for (var end = 0u; end < 2u; end++) {
        let sign = select(-1.0, 1.0, end == 1u);
        let gap = sign * (limits[1u + end] - robot_position[thread]);
        let most = select(ROBOT_BACK * gap, gap, gap > 0.0) / dt;
        let beyond = sign * rate - most;
        if beyond > 0.0 {
            sum = RobotImpulse(sum.value - sign * stiff * beyond, sum.slope + stiff);
        }
    }
    return sum;
}

// What acts on the rate with the thread's number.
fn robot_joint(thread: u32, rate: f32) -> RobotImpulse {
    if !robot_drives {
        return RobotImpulse(0.0, 0.0);
    }
    return robot_impulse(thread, rate);
}
