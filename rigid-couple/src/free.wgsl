// How a free body answers the ground's impulses, as in `rigid.rs`: a group by itself, of which the first thread alone takes care.
//
// The group's words are its velocity [m/s], and its angular momentum about the centre of mass [kg m2/s]. Behind a free body's parts, the table holds the rows of
// its inertia in its frame [kg m2], with its mass [kg], and of the inverse.

var<private> free_mass: f32;
// In the world's frame, and the inverse in the body's.
var<private> free_inertia: mat3x3<f32>;
var<private> free_inverse: mat3x3<f32>;
var<private> free_momentum: vec3<f32>;
// What is out of balance at the twist that is tried, with what contact gives.
var<private> free_missing: CouplingTwist;

fn free_tensor(at: u32) -> mat3x3<f32> {
    return mat3x3<f32>(coupling_table(at).xyz, coupling_table(at + 1u).xyz, coupling_table(at + 2u).xyz);
}

// Rows of a rotation, as columns: what leads from the world's frame to the body's.
fn free_back(q: vec4<f32>) -> mat3x3<f32> {
    let rows = rows_of(q);
    return mat3x3<f32>(rows[0], rows[1], rows[2]);
}

// The angular velocity that the angular momentum makes at a rotation.
fn free_spin(q: vec4<f32>) -> vec3<f32> {
    let back = free_back(q);
    return (free_inverse * (back * free_momentum)) * back;
}

fn coupling_begin(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let head = coupling_table(group_body(0u));
    let at = u32(head.x) + 6u * u32(head.y);
    let q = pose_rotation(group_pose(0u));
    let back = free_back(q);
    free_mass = coupling_table(at).w;
    free_inertia = transpose(back) * free_tensor(at) * back;
    free_inverse = free_tensor(at + 3u);
    free_momentum = bitcast<vec3<f32>>(group_word(1u).xyz);
    var free = CouplingTwist(bitcast<vec3<f32>>(group_word(0u).xyz), free_spin(q));
    if !group_moves() {
        set_group_twist(TWIST_FREE, 0u, free);
        set_group_twist(TWIST_EXPECTED, 0u, free);
        return;
    }
    free.linear += group_gravity();
    set_group_twist(TWIST_FREE, 0u, free);
    // From one slot of a step to the next impulses change little.
    let before = group_impulse_before(0u);
    let momentum = free_momentum;
    free_momentum += before.angular;
    set_group_twist(TWIST_EXPECTED, 0u, CouplingTwist(free.linear + before.linear / free_mass, free_spin(q)));
    free_momentum = momentum;
}

fn coupling_answer(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let system = group_system(0u);
    let free = group_twist(TWIST_FREE, 0u);
    let tried = group_twist(TWIST_TRIED, 0u);
    let f = system.force + free_mass * (free.linear - tried.linear);
    let t = system.torque + free_inertia * (free.angular - tried.angular);
    free_missing = CouplingTwist(f, t);
    set_group_twist(TWIST_STEP, 0u, solve_rows(array<CouplingRow, 6>(
        CouplingRow(system.force_linear[0] + vec3<f32>(free_mass, 0.0, 0.0), system.force_angular[0], f.x),
        CouplingRow(system.force_linear[1] + vec3<f32>(0.0, free_mass, 0.0), system.force_angular[1], f.y),
        CouplingRow(system.force_linear[2] + vec3<f32>(0.0, 0.0, free_mass), system.force_angular[2], f.z),
        CouplingRow(system.torque_linear[0], system.torque_angular[0] + free_inertia[0], t.x),
        CouplingRow(system.torque_linear[1], system.torque_angular[1] + free_inertia[1], t.y),
        CouplingRow(system.torque_linear[2], system.torque_angular[2] + free_inertia[2], t.z),
    )));
}

fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    let by = group_twist(along, 0u);
    return dot(by.linear, free_missing.linear) + dot(by.angular, free_missing.angular);
}

fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 {
    if thread != 0u {
        return 0.0;
    }
    let twist = group_twist(which, 0u);
    return free_mass * dot(twist.linear, twist.linear) + dot(twist.angular, free_inertia * twist.angular);
}

fn coupling_feel(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let gained = group_impulse(0u);
    free_momentum += gained.angular;
    let velocity = group_twist(TWIST_FREE, 0u).linear + gained.linear / free_mass;
    let twist = CouplingTwist(velocity, free_spin(pose_rotation(group_pose(0u))));
    set_group_twist(TWIST_FREE, 0u, twist);
    set_group_twist(TWIST_EXPECTED, 0u, twist);
}

fn coupling_advance(group: u32, thread: u32) {
    if thread != 0u {
        return;
    }
    let twist = group_twist(TWIST_FREE, 0u);
    if group_moves() {
        let pose = group_pose(0u);
        let q = pose_rotation(pose);
        // The angular velocity half-way, by the implicit midpoint rule: each round gains a factor |w| dt / 2.
        var angular = twist.angular;
        for (var again = 0u; again < 4u; again++) {
            let before = angular;
            angular = free_spin(q + turning(q, 0.5 * group_dt() * angular));
            if all(abs(angular - before) <= 1e-7 * abs(before)) {
                break;
            }
        }
        set_group_pose(0u, pose_after(pose, CouplingTwist(twist.linear, angular)));
    }
    set_group_word(0u, vec4<u32>(bitcast<vec3<u32>>(twist.linear), 0u));
    set_group_word(1u, vec4<u32>(bitcast<vec3<u32>>(free_momentum), 0u));
}
