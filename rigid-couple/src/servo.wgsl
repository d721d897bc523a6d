// How a body answers the ground's impulses that a force pushes along an axis, as in `rigid.rs`: a group by itself, of which the first thread alone takes care.
//
// The group's words are its velocity [m/s], and nothing. Behind its parts, the table holds the axis, with its mass [kg], then the force over the mass [m/s2] and
// the damping over the mass [1/s].

var<private> servo_axis: vec3<f32>;
var<private> servo_mass: f32;
// What is out of balance along the axis at the twist that is tried, with what contact gives.
var<private> servo_missing: f32;

fn servo_twist(linear: vec3<f32>) -> CouplingTwist {
    return CouplingTwist(linear, vec3<f32>(0.0));
}

fn coupling_begin(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let head = coupling_table(group_body(0u));
    let at = u32(head.x) + 6u * u32(head.y);
    servo_axis = coupling_table(at).xyz;
    servo_mass = coupling_table(at).w;
    let rates = coupling_table(at + 1u);
    var free = bitcast<vec3<f32>>(group_word(0u).xyz);
    var expected = free;
    if group_moves() {
        free = (free + rates.x * group_dt() * servo_axis) / (1.0 + rates.y * group_dt());
        // From one slot of a step to the next impulses change little.
        expected = free + dot(servo_axis, group_impulse_before(0u).linear) / servo_mass * servo_axis;
    }
    set_group_twist(TWIST_FREE, 0u, servo_twist(free));
    set_group_twist(TWIST_EXPECTED, 0u, servo_twist(expected));
}

fn coupling_answer(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let system = group_system(0u);
    let free = group_twist(TWIST_FREE, 0u).linear;
    let tried = group_twist(TWIST_TRIED, 0u).linear;
    servo_missing = dot(servo_axis, system.force + servo_mass * (free - tried));
    let rows = system.force_linear;
    let along = vec3<f32>(dot(rows[0], servo_axis), dot(rows[1], servo_axis), dot(rows[2], servo_axis));
    let step = servo_missing / (servo_mass + dot(servo_axis, along));
    set_group_twist(TWIST_STEP, 0u, servo_twist(step * servo_axis));
}

fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    return dot(group_twist(along, 0u).linear, servo_axis) * servo_missing;
}

fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    let linear = group_twist(which, 0u).linear;
    return servo_mass * dot(linear, linear);
}

fn coupling_feel(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let gained = dot(servo_axis, group_impulse(0u).linear) / servo_mass;
    let twist = servo_twist(group_twist(TWIST_FREE, 0u).linear + gained * servo_axis);
    set_group_twist(TWIST_FREE, 0u, twist);
    set_group_twist(TWIST_EXPECTED, 0u, twist);
}

fn coupling_advance(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let twist = group_twist(TWIST_FREE, 0u);
    if group_moves() {
        set_group_pose(0u, pose_after(group_pose(0u), twist));
    }
    set_group_word(0u, vec4<u32>(bitcast<vec3<u32>>(twist.linear), 0u));
    set_group_word(1u, vec4<u32>(0u));
}
