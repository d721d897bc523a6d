//! How tools grip nodes, and free bodies that move with them.

use crate::{Random, angular_momentum, batch, energy, meet, momentum, rigid, step, within};
use barchan_core::{Coupling, NearParticle, NodeBatch};
use glam::DVec3;

/// A floor below z = 0, and one node just inside it.
fn on_floor(contact: &str, velocity: [f64; 3]) -> ([f64; 3], [f64; 3]) {
    let mut rigid = rigid(&format!(
        "[[tool]]\nname = 'floor'\nshape = {{ plane = {{ normal = [0, 0, 1] }} }}\ncontact = {contact}"
    ));
    let mut nodes = batch(&[([0.1, 0.2, -0.005], 2.0, velocity)]);
    step(&mut rigid, 0.0, 1e-3, &mut nodes);
    (nodes.velocity[0], rigid.wrenches()[0].force)
}

#[test]
fn laws_have_their_closed_forms() {
    // A block slides at the wrong rate if the law takes anything but μ |Δu_n| from the tangential velocity (D3, A10).
    let cases = [
        ("'stick'", [3.0, 0.0, -1.0], [0.0, 0.0, 0.0]),
        ("'stick'", [3.0, 0.0, 1.0], [0.0, 0.0, 0.0]),
        ("'slip'", [3.0, 4.0, -1.0], [3.0, 4.0, 0.0]),
        ("'slip'", [3.0, 4.0, 1.0], [3.0, 4.0, 1.0]),
        ("{ coulomb = { friction = 0.5 } }", [3.0, 4.0, -1.0], [2.7, 3.6, 0.0]),
        ("{ coulomb = { friction = 0.5 } }", [0.3, 0.0, -1.0], [0.0, 0.0, 0.0]),
        ("{ coulomb = { friction = 0.5 } }", [3.0, 4.0, 1.0], [3.0, 4.0, 1.0]),
        ("{ coulomb = { friction = 0.0 } }", [3.0, 4.0, -1.0], [3.0, 4.0, 0.0]),
    ];
    let mut worst = 0f64;
    for (contact, before, after) in cases {
        let (velocity, force) = on_floor(contact, before);
        worst = worst.max((DVec3::from_array(velocity) - DVec3::from_array(after)).length());
        // A9 (v): the force on a driven tool is the momentum that the grid lost.
        let lost = 2.0 * (DVec3::from_array(before) - DVec3::from_array(velocity)) / 1e-3;
        worst = worst.max((DVec3::from_array(force) - lost).length() / 1e4);
    }
    within("velocity after contact [m/s]", worst, 1e-15);
}

#[test]
fn nodes_outside_are_left_alone() {
    // Contact at a distance would make tools hover: a node outside on which no particle presses keeps its velocity to the bit.
    let mut rigid = rigid("[[tool]]\nname = 'floor'\nshape = { plane = { normal = [0, 0, 1] } }\ncontact = 'stick'");
    let mut nodes = batch(&[([0.1, 0.2, 1e-9], 2.0, [1.0, 2.0, -3.0]), ([0.1, 0.2, 1e-3], 2.0, [1.0, 2.0, -3.0])]);
    let before = nodes.velocity.clone();
    step(&mut rigid, 0.0, 1e-3, &mut nodes);
    assert_eq!(nodes.velocity, before);
    assert_eq!(rigid.wrenches()[0].force, [0.0; 3]);
}

#[test]
fn matter_inside_a_body_is_not_ejected() {
    // B49: a body that overlaps the ground by five cells at the start must not shoot it out: at rest it stays at rest, and what
    // moves outwards is not sped up. Deep nodes go with the body and are counted.
    let mut rigid = rigid(
        "[[tool]]\nname = 'ball'\nshape = { sphere = { radius = 0.1 } }\nmotion = { velocity = { linear = [0, 0, -0.5] } }",
    );
    let lattice: Vec<_> = (-9..=9)
        .flat_map(|i| (-9..=9).map(move |j| ([0.01 * f64::from(i), 0.0, 0.01 * f64::from(j)], 1e-3, [0.0; 3])))
        .collect();
    let mut nodes = batch(&lattice);
    step(&mut rigid, 0.0, 1e-3, &mut nodes);
    let fastest = nodes.velocity.iter().map(|v| DVec3::from_array(*v).length()).fold(0.0, f64::max);
    within("fastest matter [m/s], tool at 0.5 m/s", fastest, 0.5 + 1e-12);
    let centre = nodes.position.iter().position(|x| *x == [0.0; 3]).unwrap();
    assert!((DVec3::from_array(nodes.velocity[centre]) - DVec3::new(0.0, 0.0, -0.5)).length() < 1e-12);
    assert!(rigid.counts()[0].1 > 0);
}

#[test]
fn thin_blades_let_nothing_through() {
    // B42: a blade of a quarter cell slips between the nodes and sand walks through it. It counts as two cells thick: what is up
    // to a cell ahead is pushed, what is up to a cell behind and more than 0.75 off may fall back, and the core between goes with
    // the blade, wherever it is on the grid.
    let cell = 0.01;
    for offset in 0..40 {
        let x = cell * f64::from(offset) / 40.0;
        let mut rigid = rigid(&format!(
            "[[tool]]\nname = 'blade'\nposition = [{x}, 0, 0]\nshape = {{ box = {{ half = [0.00125, 0.2, 0.2] }} }}\ncontact = 'slip'\nmotion = {{ velocity = {{ linear = [1, 0, 0] }} }}"
        ));
        let line: Vec<_> = (-5..=6).map(|i| ([cell * f64::from(i), 0.0, 0.0], 1e-3, [0.0, 0.3, 0.0])).collect();
        let mut nodes = batch(&line);
        step(&mut rigid, 0.0, 1e-4, &mut nodes);
        for (position, velocity) in nodes.position.iter().zip(&nodes.velocity) {
            let ahead = (position[0] - x) / cell;
            let edge = (ahead - 1.0).abs().min((ahead + 0.75).abs()) < 1e-9;
            let expected = if ahead > -0.75 && ahead < 1.0 { 1.0 } else { 0.0 };
            assert!(edge || (velocity[0] - expected).abs() < 1e-9, "{ahead} cells ahead: {velocity:?}");
            assert_eq!(velocity[1], 0.3, "slip: no drag along the blade");
        }
        let warning = rigid.warnings(cell).join("\n");
        assert!(
            warning.contains("'blade' is 2.500 mm thick, 0.25 cells") && warning.contains("<= 1.250 mm"),
            "{warning}"
        );
        let rough = rigid.warnings(0.001).join("\n");
        assert!(
            rough.contains("'blade' is only 2.5 cells thick") && rough.contains("world.cell <= 0.417 mm"),
            "{rough}"
        );
        assert!(rigid.warnings(0.0005).is_empty());
    }
}

/// What contact takes from the edges of boxes and cylinders is told where it matters; a mesh keeps its edges, and balls have none.
#[test]
fn faces_that_rounded_edges_leave_small_are_told() {
    let warned = |shape: &str, cell: f64| {
        let text = format!("[[tool]]\nname = 'foot'\nshape = {{ {shape} }}\nmotion = {{ velocity = {{}} }}");
        rigid(&text).warnings(cell).join("\n")
    };
    for shape in ["box = { half = [0.08, 0.08, 0.08] }", "cylinder = { radius = 0.3, half_height = 0.08 }"] {
        let warning = warned(shape, 0.02);
        assert!(
            warning.contains("tool 'foot' has faces 8.0 cells wide") && warning.contains("38 % of the force"),
            "{warning}"
        );
        assert!(warning.contains("world.cell <= 5.333 mm"), "{warning}");
        assert!(!warned(shape, 0.0134).is_empty() && warned(shape, 0.0133).is_empty(), "12 cells");
        assert!(warned(shape, 0.04).contains("75 % of the force"));
    }
    assert_eq!(warned("sphere = { radius = 0.08 }", 0.02), "");
    let still = rigid("[[tool]]\nname = 'wall'\nshape = { box = { half = [0.08, 0.08, 0.08] } }");
    assert!(still.warnings(0.02).is_empty(), "what stays presses on nothing");
}

const LAWS: [&str; 3] = ["'stick'", "'slip'", "{ coulomb = { friction = 0.4 } }"];

fn free_box(contact: &str, mass: f64, extra: &str) -> String {
    format!(
        "[[tool]]\nname = 'box'\nshape = {{ box = {{ half = [0.05, 0.06, 0.07] }} }}\ncontact = {contact}\nmotion = {{ free = {{ mass = {mass}, {extra} }} }}\n"
    )
}

#[test]
fn momentum_closes_over_random_contacts() {
    // A9 (i): soft and rigid together are alone in space: P and L of both stay, to 1e-13 over 1000 steps, whatever the law; the
    // energy never grows. Impulses booked at the body's centre instead of the node would lose L.
    for law in LAWS {
        let mut rigid = rigid(&free_box(law, 0.7, "linear = [0.3, -0.2, 0.1], angular = [3, 1, -2]"));
        let mut random = Random(7);
        let (mut momentum_error, mut angular_error, mut gain) = (0f64, 0f64, 0f64);
        let (mut momentum_scale, mut angular_scale) = (0f64, 0f64);
        for i in 0..1000 {
            let centre = DVec3::from_array(rigid.bodies()[0].position);
            let nodes: Vec<_> = (0..60)
                .map(|_| {
                    (
                        (centre + 0.08 * random.vector()).to_array(),
                        0.02 * (1.01 + random.number()),
                        random.vector().to_array(),
                    )
                })
                .collect();
            let mut nodes = batch(&nodes);
            let sums = |rigid: &barchan_rigid::Rigid, nodes: &NodeBatch| {
                let body = &rigid.bodies()[0];
                let p = DVec3::from_array(body.momentum) + momentum(nodes);
                let l = DVec3::from_array(body.angular_momentum) + angular_momentum(nodes);
                (p, l, body.kinetic_energy + energy(nodes))
            };
            rigid.before_step(f64::from(i) * 1e-4, 1e-4).unwrap();
            let (p, l, e) = sums(&rigid, &nodes);
            meet(&mut rigid, 1e-4, &mut nodes).unwrap();
            let (p2, l2, e2) = sums(&rigid, &nodes);
            gain = gain.max((e2 - e) / e);
            rigid.after_step(f64::from(i) * 1e-4, 1e-4).unwrap();
            let (p3, l3, _) = sums(&rigid, &nodes);
            momentum_error += (p2 - p).length() + (p3 - p2).length();
            angular_error += (l2 - l).length() + (l3 - l2).length();
            momentum_scale = momentum_scale.max(p.length());
            angular_scale = angular_scale.max(l.length());
        }
        within(&format!("{law}: momentum, sum of |errors| over 1000 steps"), momentum_error / momentum_scale, 1e-12);
        within(&format!("{law}: mean per step"), momentum_error / momentum_scale / 1000.0, 1e-15);
        within(&format!("{law}: angular momentum, sum"), angular_error / angular_scale, 1e-12);
        within(&format!("{law}: greatest relative energy gain in a contact"), gain, 1e-14);
        assert_eq!(rigid.counts()[1].1, 0, "{law}: all solutions converged");
    }
}

#[test]
fn solution_satisfies_the_law_at_the_final_motion() {
    // An explicit law would be evaluated at the body's old motion; here each node must obey it against the new one.
    let friction = 0.4;
    let mut rigid =
        rigid(&free_box("{ coulomb = { friction = 0.4 } }", 0.2, "linear = [0.5, 0, -1], angular = [0, 4, 1]"));
    let mut random = Random(8);
    let mut worst = 0f64;
    for _ in 0..200 {
        // A patch of nodes under the box's lower face, with ground of some weight in them.
        let body = rigid.bodies()[0].clone();
        let rotation = glam::DQuat::from_xyzw(body.rotation[1], body.rotation[2], body.rotation[3], body.rotation[0]);
        let normal = rotation * DVec3::NEG_Z;
        let nodes: Vec<_> = (0..40)
            .map(|_| {
                // Away from the edges, which contact rounds.
                let r = random.vector() * DVec3::new(0.03, 0.04, 0.0) + DVec3::new(0.0, 0.0, -0.065);
                ((DVec3::from_array(body.position) + rotation * r).to_array(), 0.03, (0.3 * random.vector()).to_array())
            })
            .collect();
        let mut nodes = batch(&nodes);
        rigid.before_step(0.0, 1e-3).unwrap();
        let before = nodes.velocity.clone();
        meet(&mut rigid, 1e-3, &mut nodes).unwrap();
        let body = rigid.bodies()[0].clone();
        for (i, before) in before.iter().enumerate() {
            let arm = DVec3::from_array(nodes.position[i]) - DVec3::from_array(body.position);
            let surface = DVec3::from_array(body.velocity) + DVec3::from_array(body.angular_velocity).cross(arm);
            let u = DVec3::from_array(*before) - surface;
            let approach = -u.dot(normal);
            let expected = if approach <= 0.0 {
                u
            } else {
                let tangential = u + approach * normal;
                (1.0 - friction * approach / tangential.length()).max(0.0) * tangential
            };
            worst = worst.max((DVec3::from_array(nodes.velocity[i]) - surface - expected).length());
        }
        rigid.after_step(0.0, 1e-3).unwrap();
    }
    within("deviation from the law [m/s]", worst, 1e-10);
}

#[test]
fn sticking_capture_has_the_common_velocity() {
    // A9 (iii): ground of mass m1 at v1 is caught by a resting body of mass m2: v = m1 v1 / (m1 + m2), for any ratio.
    for ratio in [1e-2, 1.0, 1e2, 1e4] {
        let mut rigid = rigid(&free_box("'stick'", 0.5, ""));
        let corners: Vec<_> = (0..8)
            .map(|i| {
                ([0, 1, 2].map(|d| if i >> d & 1 == 1 { 0.03 } else { -0.03 }), 0.5 * ratio / 8.0, [2.0, 0.0, 1.0])
            })
            .collect();
        let mut nodes = batch(&corners);
        step(&mut rigid, 0.0, 1e-4, &mut nodes);
        let common = DVec3::new(2.0, 0.0, 1.0) * (ratio / (1.0 + ratio));
        let body = DVec3::from_array(rigid.bodies()[0].velocity);
        let apart = nodes.velocity.iter().map(|v| (DVec3::from_array(*v) - body).length()).fold(0.0, f64::max);
        within(&format!("ratio {ratio:e}: velocity"), (body - common).length() / common.length(), 1e-12);
        within(&format!("ratio {ratio:e}: nodes against body [m/s]"), apart, 1e-11);
    }
}

#[test]
fn any_mass_ratio_is_stable() {
    // B45, A9 (iv): explicit coupling multiplies the body's velocity by the mass ratio at each step. Here a body dropped on a bed
    // of nodes that weighs 1e-2 to 1e4 times as much comes to rest with it and never gains energy.
    for law in LAWS {
        for ratio in [1e-2, 1.0, 1e2, 1e4] {
            let mut rigid = rigid(&free_box(law, 0.1, "linear = [0.4, 0.1, -1], angular = [2, -3, 1]"));
            // Away from the edges, which contact rounds: what slips off there keeps its approach.
            let patch: Vec<_> = (-3..=3)
                .flat_map(|i| {
                    (-4..=4).map(move |j| {
                        ([0.01 * f64::from(i), 0.01 * f64::from(j), -0.065], 0.1 * ratio / 63.0, [0.0; 3])
                    })
                })
                .collect();
            let mut nodes = batch(&patch);
            let total =
                |rigid: &barchan_rigid::Rigid, nodes: &NodeBatch| rigid.bodies()[0].kinetic_energy + energy(nodes);
            let start = total(&rigid, &nodes);
            let mut gain = 0f64;
            for i in 0..50 {
                // The bed stays where it is and keeps its velocity, as a grid does within a step; the body does not move away.
                let before = total(&rigid, &nodes);
                rigid.before_step(f64::from(i) * 1e-5, 1e-5).unwrap();
                meet(&mut rigid, 1e-5, &mut nodes).unwrap();
                gain = gain.max((total(&rigid, &nodes) - before) / start);
                rigid.after_step(f64::from(i) * 1e-5, 1e-5).unwrap();
            }
            within(&format!("{law}, ratio {ratio:e}: energy gain in a step"), gain, 1e-12);
            let approach = -(rigid.bodies()[0].velocity[2] - momentum(&nodes).z / (0.1 * ratio));
            within(&format!("{law}, ratio {ratio:e}: approach left [m/s]"), approach, 1e-3);
        }
    }
}

#[test]
fn a_particle_presses_with_what_its_overlap_gives() {
    // The whole law of one particle: M d² o / (1 − o) along the normal, on the nodes around it by its weights, and no more than that in a step.
    let (modulus, width, cell) = (1e6, 4e-3, 0.01);
    let mut rigid = rigid("[[tool]]\nname = 'floor'\nshape = { plane = { normal = [0, 0, 1] } }\ncontact = 'slip'");
    for overlap in [-0.1, 0.0, 0.2, 0.5, 0.9] {
        // The particle is over the origin, as high as its overlap says.
        let place = [0.3, 0.6, 0.05];
        let node_at = |n: usize| [n / 4, n / 2 % 2, n % 2].map(|i| i as f64);
        let height = width * (0.5 - overlap);
        let at = |n: usize, d: usize| cell * (node_at(n)[d] - place[d]) + if d == 2 { height } else { 0.0 };
        let (mass, fall) = (1e-3, -1e3);
        let nodes: Vec<_> = (0..8).map(|n| ([0, 1, 2].map(|d| at(n, d)), mass, [0.0, 0.0, fall])).collect();
        let mut nodes = batch(&nodes);
        nodes.cubes = vec![std::array::from_fn(|n| n as u32)];
        nodes.particles =
            vec![NearParticle { cube: 0, position: [0.0, 0.0, height], place, volume: width.powi(3), modulus }];
        step(&mut rigid, 0.0, 1e-6, &mut nodes);
        let force = if overlap > 0.0 { modulus * width * width * overlap / (1.0 - overlap) } else { 0.0 };
        within(&format!("overlap {overlap}: force [N]"), (rigid.wrenches()[0].force[2] + force).abs() / 100.0, 1e-9);
        let weights = nodes.particles[0].weights();
        let off = (0..8).map(|n| (nodes.velocity[n][2] - fall - weights[n] * force * 1e-6 / mass).abs());
        within(&format!("overlap {overlap}: nodes [m/s]"), off.fold(0.0, f64::max), 1e-9);
    }
}

#[test]
fn contact_is_cheap() {
    // A task steps its tools some ten thousand times: 1000 nodes cost far below a millisecond, and free bodies converge in a few
    // iterations. The bound is wide, since other programs share the machine.
    for (name, tools) in [
        ("driven sphere", "[[tool]]\nname = 'a'\nshape = { sphere = { radius = 0.1 } }\nmotion = { velocity = { linear = [0, 0, -1] } }".to_owned()),
        ("free box, stick", free_box("'stick'", 1.0, "linear = [0, 0, -1]")),
        ("free box, Coulomb", free_box("{ coulomb = { friction = 0.4 } }", 1.0, "linear = [0.5, 0, -1]")),
    ] {
        let mut rigid = rigid(&tools);
        let mut random = Random(9);
        let nodes: Vec<_> = (0..1000).map(|_| ((0.048 * random.vector()).to_array(), 1e-3, (0.1 * random.vector()).to_array())).collect();
        let original = batch(&nodes);
        let mut nodes = original.clone();
        let mut best = f64::INFINITY;
        for _ in 0..50 {
            nodes.velocity.clone_from(&original.velocity);
            rigid.before_step(0.0, 1e-9).unwrap();
            let start = std::time::Instant::now();
            meet(&mut rigid, 1e-9, &mut nodes).unwrap();
            best = best.min(start.elapsed().as_secs_f64());
            rigid.after_step(0.0, 1e-9).unwrap();
        }
        within(&format!("{name}: seconds for 1000 nodes inside"), best, 1e-3);
    }
}
