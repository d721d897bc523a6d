//! Free bodies: flight, stacks, snapshots, and what is refused.

use crate::{batch, meet, refusal, rigid, step, within, world};
use barchan_core::{Coupling, NodeBatch, Registry, Scene};
use barchan_rigid::{Rigid, Robots};
use glam::DVec3;

#[test]
fn tumbling_flight_keeps_momentum_and_energy() {
    // A body thrown with a spin about its middle axis turns over and over (Dzhanibekov): L stays to rounding, the energy to second
    // order in the step. Rapier alone keeps ω instead of L, and gains or loses energy.
    let mut rigid = rigid(
        "[[tool]]\nname = 'book'\nshape = { box = { half = [0.02, 0.1, 0.15] } }\nmotion = { free = { mass = 0.5, linear = [1, 2, 3], angular = [0.1, 10, 0.1] } }",
    );
    let start = rigid.bodies()[0].clone();
    let (l, p) = (DVec3::from_array(start.angular_momentum), DVec3::from_array(start.momentum));
    let (mut spin_error, mut l_error, mut p_error, mut e_error, mut turned) = (0f64, 0f64, 0f64, 0f64, false);
    for i in 0..20000 {
        step(&mut rigid, f64::from(i) * 1e-4, 1e-4, &mut NodeBatch::default());
        let body = &rigid.bodies()[0];
        let orbital = DVec3::from_array(body.position).cross(p);
        let change = DVec3::from_array(body.angular_momentum) - l;
        // The body flies 7 m: about the origin, L is as exact as the sum of 20000 additions to its position.
        l_error = l_error.max(change.length() / (DVec3::from_array(body.position).length() * p.length() + l.length()));
        spin_error = spin_error.max((change - orbital).length() / l.length());
        p_error = p_error.max((DVec3::from_array(body.momentum) - p).length() / p.length());
        e_error = e_error.max((body.kinetic_energy / start.kinetic_energy - 1.0).abs());
        let q = glam::DQuat::from_xyzw(body.rotation[1], body.rotation[2], body.rotation[3], body.rotation[0]);
        turned |= (q * DVec3::Y).dot(l) < -0.9 * l.length();
    }
    within("linear momentum over 2 s", p_error, 1e-15);
    within("angular momentum about the origin over 2 s", l_error, 1e-12);
    within("angular momentum about the centre of mass", spin_error, 1e-13);
    within("energy over 2 s", e_error, 1e-6);
    assert!(turned, "the middle axis turns over");
}

#[test]
fn free_fall_is_exact() {
    // Gravity counted twice, or damped: after n steps of a fall v = n g dt and z = −g dt² n (n + 1) / 2.
    let mut rigid = Rigid::new(&world(
        "[[tool]]\nname = 'ball'\nshape = { sphere = { radius = 0.1 } }\nmotion = { free = { mass = 2.0 } }",
        "",
        [0.0, 0.0, -9.81],
    ))
    .unwrap();
    for i in 0..1000 {
        step(&mut rigid, f64::from(i) * 1e-3, 1e-3, &mut NodeBatch::default());
    }
    let ball = &rigid.bodies()[0];
    within("speed", (ball.velocity[2] / -9.81 - 1.0).abs(), 1e-13);
    within("height", (ball.position[2] / (-9.81e-6 * 1000.0 * 1001.0 / 2.0) - 1.0).abs(), 1e-12);
    within("potential energy", (ball.potential_energy / (2.0 * 9.81 * ball.position[2]) - 1.0).abs(), 1e-14);
}

#[test]
fn centre_of_mass_moves_and_not_the_origin() {
    // A box whose frame sits at its corner turns about its middle: position is that of the centre of mass.
    let mut rigid = rigid(
        "[[tool]]\nname = 'box'\nposition = [1, 0, 0]\nrotation = [0, 0, 0, 1]\nshape = { box = { min = [0, 0, 0], max = [0.2, 0.4, 0.6] } }\nmotion = { free = { mass = 1, angular = [0, 0, 5] } }",
    );
    let centre = [0.9, -0.2, 0.3];
    for i in 0..1000 {
        step(&mut rigid, f64::from(i) * 1e-3, 1e-3, &mut NodeBatch::default());
    }
    let moved = (DVec3::from_array(rigid.bodies()[0].position) - DVec3::from_array(centre)).length();
    within("centre of mass [m]", moved, 1e-13);
    // The box has turned by 5 rad from half a turn; what was above its corner is where the rotation puts it.
    let x = DVec3::from_array(centre)
        + glam::DQuat::from_rotation_z(5.0 + std::f64::consts::PI) * DVec3::new(0.0, 0.0, 0.31);
    within("distance above the lid [m]", (rigid.distance(&[x.to_array()])[0] - 0.01).abs(), 1e-12);
}

const LOWEST: &str = "[[tool]]\nname = 'a'\nposition = [0, 0, 0.05]\nshape = { box = { half = [0.05, 0.05, 0.05] } }\nmotion = { free = { mass = 1 } }\n";
const UPON: &str = "[[tool]]\nname = 'b'\nposition = [0.005, 0, 0.15]\nshape = { box = { half = [0.05, 0.05, 0.05] } }\nmotion = { free = { mass = 0.1 } }
[[tool]]\nname = 'c'\nposition = [0, 0.005, 0.251]\nshape = { box = { half = [0.05, 0.05, 0.05] } }\nmotion = { free = { mass = 20 } }\n";

/// Tools on a floor at z = 0.
fn on_floor(tools: &str) -> Scene {
    let mut scene = world(tools, "z_min = { separate = { friction = 0.6 } }", [0.0, 0.0, -9.81]);
    // That of the test world is at z = −1.
    scene.world.min[2] = 0.0;
    scene
}

/// A box that rapier holds to the floor.
fn lone() -> Rigid {
    Rigid::new(&on_floor(LOWEST)).unwrap()
}

/// Three boxes that are solved together.
fn stack() -> Robots {
    Robots::new(&on_floor(&[LOWEST, UPON].concat())).unwrap()
}

/// Ground that pushes at the lowest box, so that soft contact is part of what is restored.
fn dust() -> NodeBatch {
    batch(&[([0.045, 0.0, 0.02], 1e-3, [-1.0, 0.2, 0.0]), ([0.0, 0.045, 0.03], 2e-3, [0.0, -0.5, 0.1])])
}

#[test]
fn stacks_stand_on_a_rigid_floor() {
    // B45 without the sand: three boxes, the heaviest on the lightest, must neither sink nor fly.
    let mut rigid = stack();
    for i in 0..3000 {
        step(&mut rigid, 0.0, 1e-4, &mut NodeBatch::default());
        assert!(rigid.bodies().iter().all(|b| DVec3::from_array(b.velocity).length() < 0.3), "step {i}");
    }
    let heights: Vec<f64> = rigid.bodies()[..3].iter().map(|b| b.position[2]).collect();
    println!("heights {heights:?}");
    for (height, expected) in heights.iter().zip([0.05, 0.15, 0.25]) {
        within("height [m]", (height - expected).abs(), 2e-3);
    }
    let speed = rigid.bodies()[..3].iter().map(|b| DVec3::from_array(b.velocity).length()).fold(0.0, f64::max);
    within("speed left [m/s]", speed, 2e-2);
}

/// A checksum keeps accidents out, not forgers. Symptom: a snapshot with one byte changed behind a right checksum, and rapier's
/// "No element at index" panics through the run. Whatever the byte, the state is refused, or the next steps succeed or fail with
/// an error.
#[test]
fn forged_states_are_errors_and_no_panics() {
    let mut honest = lone();
    for i in 0..400 {
        step(&mut honest, f64::from(i) * 1e-3, 1e-3, &mut dust());
    }
    let saved = honest.save();
    let (mut refused, mut failed, mut went_on) = (0, 0, 0);
    let mut rigid = lone();
    let mut forge = |bytes: &[u8]| match rigid.restore(bytes) {
        Err(_) => refused += 1,
        Ok(()) => {
            let mut steps = (0..2).map(|_| {
                rigid.before_step(0.4, 1e-3)?;
                meet(&mut rigid, 1e-3, &mut dust())?;
                rigid.after_step(0.4, 1e-3)
            });
            if steps.any(|step| step.is_err()) { failed += 1 } else { went_on += 1 }
        }
    };
    for at in 0..saved.len() {
        for mask in [0x01, 0x80, 0xff] {
            let mut forged = saved.clone();
            forged[at] ^= mask;
            forge(&forged);
        }
    }
    (0..saved.len()).step_by(7).for_each(|length| forge(&saved[..length]));
    println!("{} bytes: {refused} refused, {failed} failed in a step, {went_on} went on", saved.len());
    assert!(refused > 0 && failed > 0 && went_on > 0);
    // What is refused leaves nothing behind.
    rigid.restore(&saved).unwrap();
    assert_eq!(rigid.save(), saved);
}

#[test]
fn restored_runs_continue_bit_for_bit() {
    is_restored(lone);
    is_restored(stack);
    let saved = lone().save();
    assert!(lone().restore(&saved[..saved.len() / 2]).unwrap_err().contains("cannot be read"));
    let other = "[[tool]]\nname = 'ball'\nshape = { sphere = { radius = 0.1 } }";
    assert!(rigid(other).restore(&saved).is_err());
    assert!(stack().restore(&saved).is_err());
}

/// A run that is resumed must be the run that was not interrupted, contact caches included.
fn is_restored<C: Coupling>(make: impl Fn() -> C) {
    let mut whole = make();
    for i in 0..400 {
        step(&mut whole, f64::from(i) * 1e-3, 1e-3, &mut dust());
    }
    let saved = whole.save();
    let mut resumed = make();
    resumed.restore(&saved).unwrap();
    assert_eq!(resumed.bodies(), whole.bodies());
    assert_eq!(resumed.wrenches(), whole.wrenches());
    assert_eq!(resumed.counts(), whole.counts());
    for i in 400..600 {
        let (mut a, mut b) = (dust(), dust());
        step(&mut whole, f64::from(i) * 1e-3, 1e-3, &mut a);
        step(&mut resumed, f64::from(i) * 1e-3, 1e-3, &mut b);
        assert_eq!(a.velocity, b.velocity, "step {i}");
        assert_eq!(resumed.bodies(), whole.bodies(), "step {i}");
    }
    assert_eq!(resumed.save(), whole.save());
    println!("snapshot of {} bodies: {} bytes", whole.bodies().len(), saved.len());
}

/// What fails is as if it had never been tried: bodies go back to what they kept, bit for bit, contact caches included, and that is what they were restored from.
#[test]
fn bodies_go_back_to_what_they_kept() {
    let mut rigid = lone();
    let steps = |from: i32, count: i32, rigid: &mut Rigid| {
        for i in from..from + count {
            step(rigid, f64::from(i) * 1e-3, 1e-3, &mut dust());
        }
        rigid.save()
    };
    let saved = steps(0, 400, &mut rigid);
    let kept = rigid.keep();
    let later = steps(400, 50, &mut rigid);
    rigid.go_back(kept).unwrap();
    assert!(rigid.save() == saved, "it is not what it was");
    assert!(steps(400, 50, &mut rigid) == later, "the steps after it are others");
    let foreign: barchan_core::coupling::Kept = Box::new(1.0);
    assert!(rigid.go_back(foreign).unwrap_err().contains("not what rigid bodies keep"));
}

#[test]
fn free_meshes_collide_by_their_hull() {
    // A mesh that falls on a floor must rest on it, not sink in: a tetrahedron, and a U-shape would need the decomposition.
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("t.obj"),
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
    )
    .unwrap();
    let mut scene = world(
        "[[tool]]\nname = 't'\nposition = [0, 0, 0.01]\nshape = { mesh = { file = 't.obj', scale = 0.1 } }\nmotion = { free = { mass = 0.2 } }",
        "z_min = 'stick'",
        [0.0, 0.0, -9.81],
    );
    scene.world.min[2] = 0.0;
    scene.folder = folder.path().to_owned();
    let mut rigid = Rigid::new(&scene).unwrap();
    within(
        "centre of mass before",
        (DVec3::from_array(rigid.bodies()[0].position) - DVec3::new(0.025, 0.025, 0.035)).length(),
        1e-12,
    );
    for i in 0..2000 {
        step(&mut rigid, f64::from(i) * 1e-3, 1e-3, &mut NodeBatch::default());
    }
    within("height of the centre of mass [m]", (rigid.bodies()[0].position[2] - 0.025).abs(), 1e-3);
}

#[test]
fn driven_tools_push_free_bodies() {
    // A kinematic plate that rises under a ball carries it at the plate's speed, whatever the ball weighs.
    let scene = world(
        "[[tool]]\nname = 'plate'\nshape = { box = { half = [0.2, 0.2, 0.01] } }\nmotion = { velocity = { linear = [0, 0, 0.2] } }\n[[tool]]\nname = 'ball'\nposition = [0, 0, 0.06]\nshape = { sphere = { radius = 0.05 } }\nmotion = { free = { mass = 50 } }",
        "",
        [0.0, 0.0, -9.81],
    );
    let (mut driven, mut free) = (Rigid::new(&scene).unwrap(), Robots::new(&scene).unwrap());
    for i in 0..1000 {
        free.see(&driven.bodies());
        step(&mut driven, f64::from(i) * 1e-3, 1e-3, &mut NodeBatch::default());
        step(&mut free, f64::from(i) * 1e-3, 1e-3, &mut NodeBatch::default());
    }
    let (plate, ball) = (&driven.bodies()[0], &free.bodies()[0]);
    within("plate [m]", (plate.position[2] - 0.2).abs(), 1e-12);
    within("ball on plate [m]", (ball.position[2] - plate.position[2] - 0.06).abs(), 2e-3);
    within("speed of the ball [m/s]", (ball.velocity[2] - 0.2).abs(), 1e-2);
}

#[test]
fn impossible_bodies_are_refused() {
    // Each would be NaN or nonsense later; the message names the key and what to mend.
    let tool = |shape: &str, rest: &str| format!("[[tool]]\nname = 'a'\nshape = {shape}\n{rest}");
    let ball = "{ sphere = { radius = 0.1 } }";
    for (tools, parts) in [
        (tool(ball, "motion = { free = { mass = 0 } }"), ["tool[0]", "mass is 0"]),
        (tool(ball, "motion = { free = { mass = nan } }"), ["tool[0]", "mass is NaN"]),
        (tool(ball, "motion = { free = { mass = 1, restitution = 2 } }"), ["tool[0]", "restitution is 2"]),
        (tool(ball, "motion = { velocity = { linear = [inf, 0, 0] } }"), ["tool[0]", "motion.linear"]),
        (tool(ball, "position = [nan, 0, 0]"), ["tool[0]", "position is [NaN"]),
        (tool(ball, "rotation = [0, 0, 0, 0]"), ["tool[0]", "no quaternion"]),
        (tool(ball, "contact = { coulomb = { friction = -1 } }"), ["tool[0]", "friction is -1"]),
        (
            tool("{ plane = { normal = [0, 0, 1] } }", "motion = { free = { mass = 1 } }"),
            ["tool[0]", "a plane has no mass"],
        ),
        (tool("{ plane = { normal = [0, 0, 0] } }", ""), ["tool[0].shape", "normal is zero"]),
        (tool("{ sphere = { radius = -1 } }", ""), ["tool[0].shape", "radius is -1"]),
        (tool("{ box = { min = [0, 0, 0] } }", ""), ["tool[0].shape", "give either half"]),
        (tool("{ box = { min = [0, 0, 0], max = [1, 1, 0] } }", ""), ["tool[0].shape", "half the box's side is 0"]),
        (tool("{ union = [] }", ""), ["tool[0].shape", "union is empty"]),
        (
            tool("{ union = [{ shape = { capsule = { radius = 1, half_height = nan } } }] }", ""),
            ["tool[0].shape.union[0].shape", "half_height is NaN"],
        ),
        (
            tool("{ height_field = { min = [0, 0], max = [1, 1], bottom = 0, heights = [[1, 1], [1, -1]] } }", ""),
            ["tool[0].shape", "a height is -1"],
        ),
        (
            tool("{ height_field = { min = [0, 0], max = [1, 1], bottom = 0, heights = [[1, 1]] } }", ""),
            ["tool[0].shape", "rows"],
        ),
        (format!("{0}\n{0}", tool(ball, "")), ["tool[1].name", "two tools are called 'a'"]),
    ] {
        let message = refusal(&tools);
        assert!(parts.iter().all(|part| message.contains(part)), "{tools}\n{message}\nexpected {parts:?}");
    }
}

#[test]
fn ground_that_is_not_finite_is_reported() {
    // A NaN from the grid must stop the run with the body's name, not spread.
    for motion in ["", "motion = { free = { mass = 1 } }"] {
        let mut rigid = rigid(&format!("[[tool]]\nname = 'ball'\nshape = {{ sphere = {{ radius = 0.1 }} }}\n{motion}"));
        rigid.before_step(0.0, 1e-3).unwrap();
        let mut nodes = batch(&[([0.0, 0.0, 0.095], 1.0, [f64::NAN, 0.0, 0.0])]);
        let message = meet(&mut rigid, 1e-3, &mut nodes).unwrap_err().to_string();
        assert!(message.contains("'ball'") && message.contains("no longer finite"), "{message}");
    }
}

#[test]
fn the_registry_makes_rigid_couplings() {
    // The engine knows no plugin: it asks the registry for "rigid".
    let mut registry = Registry::default();
    barchan_rigid::register(&mut registry).unwrap();
    let twice = barchan_rigid::register(&mut registry).unwrap_err().to_string();
    assert!(twice.contains("rigid"), "{twice}");
}

#[test]
fn a_step_of_free_bodies_is_cheap() {
    // A free body must not cost more than the ground around it: a box on a floor, and a stack of three.
    within("seconds for a step of a body", quickest(lone()), 1e-3);
    within("seconds for a step of a stack", quickest(stack()), 1e-3);
}

/// The least that a step takes [s].
fn quickest(mut coupling: impl Coupling) -> f64 {
    for i in 0..200 {
        step(&mut coupling, f64::from(i) * 1e-4, 1e-4, &mut NodeBatch::default());
    }
    let mut best = f64::INFINITY;
    for _ in 0..200 {
        let start = std::time::Instant::now();
        step(&mut coupling, 0.02, 1e-4, &mut NodeBatch::default());
        best = best.min(start.elapsed().as_secs_f64());
    }
    best
}
