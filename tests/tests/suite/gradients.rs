//! Gradients, against differences of runs, closed forms and the chain rule.

mod levels;
mod robots;
mod tools;

use barchan::gradient::by_number;
use barchan::{Cotangents, Gradient, ParticleState, Precision, Simulation, Tape, Vec3};
use barchan_tests::scenes::{Noise, options, scene, simulation, within};
use barchan_tests::sketch::{Head, block, damped, half, material, tool};

/// Cell width [m].
const H: f64 = 0.05;
const AWAKE: &str = "[sleep]\non = false\n";

/// Laws, with parameters that a step of 1 ms bears, and a differentiable one of these that is changed.
const LAWS: [(&str, &str, &str, f64); 7] = [
    ("hencky", "young_modulus = {}, poisson_ratio = 0.3", "young_modulus", 2e4),
    ("neo_hookean", "young_modulus = 2e4, poisson_ratio = {}", "poisson_ratio", 0.3),
    ("fixed_corotated", "young_modulus = {}, poisson_ratio = 0.3", "young_modulus", 2e4),
    ("von_mises", "young_modulus = 2e4, poisson_ratio = 0.3, yield_stress = {}", "yield_stress", 60.0),
    ("snow", "young_modulus = 2e4, poisson_ratio = 0.3, hardening = {}", "hardening", 8.0),
    ("sand", "young_modulus = 2e4, poisson_ratio = 0.3, friction_angle = {}", "friction_angle", 0.6),
    ("liquid", "bulk_modulus = {}, viscosity = 5.0", "bulk_modulus", 2e4),
];

/// What a loss is made of: random weights of positions and velocities.
fn weights(particles: usize) -> Cotangents {
    let mut noise = Noise::new(5);
    let mut all = Cotangents::zero(particles);
    all.position.iter_mut().for_each(|x| *x = std::array::from_fn(|_| noise.draw()));
    all.velocity.iter_mut().for_each(|v| *v = std::array::from_fn(|_| 0.1 * noise.draw()));
    all
}

fn dot(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (0..3).map(|d| a[d] * b[d]).sum::<f64>()).sum()
}

/// Gives particles a rough motion, and moves positions and velocities along directions by so much.
fn stir(sim: &mut Simulation, lag: f64, by: [f64; 2]) {
    let mut state = ParticleState { sort: None, strain_dt: lag, ..sim.particles() };
    let mut noise = Noise::new(9);
    for (l, i) in by_number(&state) {
        let list = &mut state.lists[l];
        list.velocity[i] = std::array::from_fn(|_| 0.5 * noise.draw());
        list.affine[i] = std::array::from_fn(|_| 6.0 * noise.draw());
        let [along_x, along_v]: [Vec3; 2] = [0; 2].map(|_| std::array::from_fn(|_| noise.draw()));
        for d in 0..3 {
            let moved = list.offset[i][d] + by[0] * along_x[d] / list.cell_width;
            assert!((0.0..1.0).contains(&moved), "particles stay in their cells");
            list.offset[i][d] = moved;
            list.velocity[i][d] += by[1] * along_v[d];
        }
    }
    sim.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
}

/// The directions in which [`stir`] moves positions and velocities.
fn directions(particles: usize) -> [Vec<Vec3>; 2] {
    let mut noise = Noise::new(9);
    let mut both = [Vec::new(), Vec::new()];
    for _ in 0..particles {
        (0..12).for_each(|_| _ = noise.draw());
        both.iter_mut().for_each(|along| along.push(std::array::from_fn(|_| noise.draw())));
    }
    both
}

/// A block of ground in a corner of a box, which is stirred.
struct Case<'a> {
    law: &'a str,
    parameters: &'a str,
    walls: &'a str,
    steps: u32,
    /// Time over which the velocity gradients that particles start with have yet to change their strain [s].
    lag: f64,
    /// Of the material [s].
    damping: f64,
}

impl Case<'_> {
    fn simulation(&self, parameter: f64, gravity: f64, stirred: [f64; 2], precision: Precision) -> Simulation {
        // Gravity grows over longer than the steps take.
        let head = Head { gravity: [0.6, 0.0, -gravity], gravity_ramp: 0.3, ..Head::cells(H, [8, 8, 8], self.walls) };
        let head = head.time("step = 1e-3");
        let parameters = self.parameters.replace("{}", &format!("{parameter:?}"));
        let size = [3.0 * H, 4.0 * H, 3.0 * H];
        let parts =
            [AWAKE.into(), damped(self.law, 1000.0, &parameters, self.damping), block(self.law, [0.0; 3], size, "")];
        let mut sim = simulation(&head.with(&parts), precision);
        stir(&mut sim, self.lag, stirred);
        sim
    }

    fn tape(&self, sim: &mut Simulation) -> Tape {
        let until = 1e-3 * f64::from(self.steps);
        sim.record(&barchan::registry(), until).unwrap_or_else(|e| panic!("{e}"))
    }

    fn loss(&self, mut sim: Simulation) -> f64 {
        let tape = self.tape(&mut sim);
        let weights = weights(tape.end().id.len());
        dot(&tape.end().position, &weights.position) + dot(&tape.end().velocity, &weights.velocity)
    }
}

fn gradient(tape: &Tape) -> Gradient {
    tape.pull_back(weights(tape.end().id.len())).unwrap_or_else(|e| panic!("{e}"))
}

/// Derivative of a loss by differences, to the fourth order of the step.
fn difference(step: f64, loss: impl Fn(f64) -> f64) -> f64 {
    (8.0 * (loss(step) - loss(-step)) - (loss(2.0 * step) - loss(-2.0 * step))) / (12.0 * step)
}

/// Compares what a gradient says along positions, velocities, gravity and a parameter with differences of runs.
fn compare(case: &Case<'_>, parameter: (&str, f64)) {
    let (name, value) = parameter;
    let still = [0.0; 2];
    let mut sim = case.simulation(value, 9.81, still, Precision::F64);
    let planned = &sim.plan().materials[0];
    let number = planned.material.parameters.iter().position(|p| p.name == name).expect("a parameter of the law");
    let tape = case.tape(&mut sim);
    assert_eq!(tape.len(), case.steps as usize);
    let found = gradient(&tape);
    let [along_x, along_v] = directions(tape.end().id.len());
    let run = |parameter: f64, gravity: f64, moved: [f64; 2]| {
        case.loss(case.simulation(parameter, gravity, moved, Precision::F64))
    };
    let is_elastic = name.ends_with("modulus") || name == "poisson_ratio";
    // Laws tell the moduli that damping has in f32, so that differences need long steps.
    let (size, rough) = if case.damping > 0.0 && is_elastic { (1e-3, 1e-4) } else { (1e-6, 2e-6) };
    let compared = [
        ("positions", dot(&found.particles.position, &along_x), difference(1e-7, |by| run(value, 9.81, [by, 0.0]))),
        ("velocities", dot(&found.particles.velocity, &along_v), difference(1e-6, |by| run(value, 9.81, [0.0, by]))),
        ("gravity", -found.gravity[2], difference(1e-3, |by| run(value, 9.81 + by, still))),
        (name, value * found.parameters[0][number], difference(size, |by| run(value * (1.0 + by), 9.81, still))),
    ];
    for (what, given, expected) in compared {
        let (size, tolerance) = (expected.abs().max(1e-3), if what == name { rough } else { 2e-6 });
        within(&format!("{} {what}: {given:.9e} {expected:.9e}", case.law), (given - expected).abs() / size, tolerance);
    }
}

/// Physics: a gradient is the derivative. Of every law, in ground that yields, between walls that hold, slip, and join the ends.
#[test]
fn gradients_are_those_of_runs() {
    for (law, parameters, name, value) in LAWS {
        let walls = "z_min = \"stick\"\nx_min = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"\n";
        compare(&Case { law, parameters, walls, steps: 12, lag: 0.0, damping: 0.0 }, (name, value));
    }
}

/// Likewise where walls let ground go and rub on it, in a corner of two of them beside one that slips; and where the strain of the first step is so great that it is applied in parts.
#[test]
fn gradients_go_through_walls_that_let_go() {
    let walls =
        "z_min = { separate = { friction = 0.3 } }\nx_min = { separate = { friction = 0.2 } }\ny_min = \"slip\"\n";
    for (law, parameters, name, value) in [LAWS[1], LAWS[5]] {
        compare(&Case { law, parameters, walls, steps: 8, lag: 0.0, damping: 0.0 }, (name, value));
    }
    let (law, parameters, name, value) = LAWS[1];
    let case = Case { law, parameters, walls, steps: 4, lag: 0.06, damping: 0.0 };
    compare(&case, (name, value));
    let mut sim = case.simulation(value, 9.81, [0.0; 2], Precision::F64);
    case.tape(&mut sim);
    assert!(sim.ledger().counts.get("steps with strain applied in parts").is_some_and(|parts| *parts > 0));
}

/// Likewise where materials are damped, of both kinds of strain, elastic and flowing, in one part and in several.
#[test]
fn gradients_go_through_damping() {
    let walls = "z_min = \"stick\"\nx_min = \"slip\"\n";
    for (law, parameters, name, value) in LAWS {
        compare(&Case { law, parameters, walls, steps: 8, lag: 0.0, damping: 4e-4 }, (name, value));
    }
    let (law, parameters, name, value) = LAWS[1];
    compare(&Case { law, parameters, walls, steps: 4, lag: 0.06, damping: 4e-4 }, (name, value));
}

/// Many steps: the gradient of an elastic block that has swung once is still that of runs.
#[test]
fn gradients_of_many_elastic_steps_are_those_of_runs() {
    let (law, parameters, name, value) = LAWS[1];
    compare(&Case { law, parameters, walls: "z_min = \"stick\"\n", steps: 200, lag: 0.0, damping: 0.0 }, (name, value));
}

/// Closed forms: what falls freely owes its height to its speed by the time that has passed, and to gravity by what symplectic Euler's steps add up to,
/// T (T + dt) / 2.
#[test]
fn free_fall_has_the_gradients_of_closed_forms() {
    let case = Case {
        law: "hencky",
        parameters: "young_modulus = {}, poisson_ratio = 0.3",
        walls: "",
        steps: 40,
        lag: 0.0,
        damping: 0.0,
    };
    let head = Head::cells(H, [8, 8, 16], "").time("step = 1e-3");
    let parts = [
        AWAKE.into(),
        material("hencky", 1000.0, "young_modulus = 2e4"),
        block("hencky", [0.1, 0.1, 0.5], [0.2, 0.2, 0.6], ""),
    ];
    let mut sim = simulation(&head.with(&parts), Precision::F64);
    let tape = case.tape(&mut sim);
    let particles = tape.end().id.len();
    let mut loss = Cotangents::zero(particles);
    loss.position.iter_mut().for_each(|x| x[2] = 1.0 / particles as f64);
    let found = tape.pull_back(loss).unwrap_or_else(|e| panic!("{e}"));
    let sum = |of: &[Vec3], d: usize| of.iter().map(|x| x[d]).sum::<f64>();
    within("by place", (sum(&found.particles.position, 2) - 1.0).abs(), 1e-12);
    within("by speed", (sum(&found.particles.velocity, 2) - 0.04).abs(), 1e-12);
    within("by speed sideways", sum(&found.particles.velocity, 0).abs(), 1e-12);
    within("by gravity", (found.gravity[2] - 0.5 * 0.04 * 0.041).abs(), 1e-12);
}

/// The chain rule: two tapes one after the other give what one gives over both, whose kept states lie elsewhere. Any number of threads gives the same bits.
#[test]
fn tapes_that_follow_on_one_another_give_what_one_gives() {
    let walls = "z_min = \"stick\"\n";
    let (law, parameters, _, value) = LAWS[5];
    let case = Case { law, parameters, walls, steps: 23, lag: 0.0, damping: 0.0 };
    let simulation = || case.simulation(value, 9.81, [0.0; 2], Precision::F64);
    let whole = gradient(&case.tape(&mut simulation()));
    let mut sim = simulation();
    let first = sim.record(&barchan::registry(), 9e-3).unwrap_or_else(|e| panic!("{e}"));
    let second = case.tape(&mut sim);
    assert_eq!((first.len(), second.len()), (9, 14));
    let later = gradient(&second);
    let earlier = first.pull_back(later.particles.clone()).unwrap_or_else(|e| panic!("{e}"));
    for (what, whole, parts) in [
        ("positions", &whole.particles.position, &earlier.particles.position),
        ("velocities", &whole.particles.velocity, &earlier.particles.velocity),
    ] {
        let size = whole.iter().flatten().fold(0.0, |most: f64, x| most.max(x.abs()));
        let apart = whole.iter().flatten().zip(parts.iter().flatten()).map(|(a, b)| (a - b).abs());
        within(what, apart.fold(0.0, f64::max) / size, 1e-12);
    }
    for (whole, (first, second)) in
        whole.parameters[0].iter().zip(earlier.parameters[0].iter().zip(&later.parameters[0]))
    {
        within("parameters", (whole - first - second).abs(), 1e-12 * whole.abs().max(1e-6));
    }

    let text = Head::cells(H, [8, 8, 8], walls).time("step = 1e-3").with(&[
        AWAKE.into(),
        material(law, 1000.0, &parameters.replace("{}", "0.6")),
        block(law, [0.0; 3], [6.0 * H, 4.0 * H, 3.0 * H], ""),
    ]);
    let on = |threads: usize| {
        let options = barchan::Options { threads, ..options(Precision::F32) };
        let mut sim = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap_or_else(|e| panic!("{e}"));
        stir(&mut sim, 0.0, [0.0; 2]);
        gradient(&case.tape(&mut sim))
    };
    assert!(on(1) == on(3), "threads change a gradient");
}

/// What has no adjoint is refused by name, with what mends it, before any step is taken; cotangents that make no sense are refused as well.
#[test]
fn what_gradients_do_not_go_through_is_refused_by_name() {
    let ground = [material("hencky", 1000.0, "young_modulus = 2e4"), block("hencky", [0.0; 3], [0.2, 0.2, 0.2], "")];
    let head = Head::cells(H, [8, 8, 8], "").time("step = 1e-3");
    let with = |more: &[String]| simulation(&head.with(&[&ground[..], more].concat()), Precision::F64);
    let moving = |motion: &str| tool("plate", [0.1, 0.1, 0.25], &half([0.1, 0.1, 0.025]), "\"stick\"", motion);
    let free = moving("{ free = { mass = 1.0 } }").replace("plate", "other");
    let late = moving("{ velocity = { linear = [0.0, 0.0, -0.1] } }") + "from = 0.002\n";
    let levels =
        "[levels]\ncount = 2\nsubcycle = true\nbox = [{ min = [0.0, 0.0, 0.0], max = [0.2, 0.2, 0.2] }]\n".to_owned();
    let cases = [
        (with(&[]), "'sleep'", "sleep.on = false"),
        (with(&[AWAKE.into(), late.clone()]), "tool 'plate'", "leave out from"),
        (with(&[AWAKE.into(), free, late]), "tool 'plate'", "leave out from"),
        (with(&[AWAKE.into(), levels]), "levels.subcycle", "set it to false"),
    ];
    for (mut sim, what, mend) in cases {
        let refusal = sim.record(&barchan::registry(), 0.01).expect_err(what).to_string();
        assert!(refusal.contains(what) && refusal.contains(mend), "{what}: {refusal}");
        assert_eq!(sim.step_count(), 0, "{what} is refused before any step");
    }
    let mut sim = with(&[AWAKE.into()]);
    let tape = sim.record(&barchan::registry(), 3e-3).unwrap_or_else(|e| panic!("{e}"));
    let mut few = Cotangents::zero(tape.end().id.len());
    few.position.pop();
    let mut bad = Cotangents::zero(tape.end().id.len());
    bad.velocity[3][1] = f64::NAN;
    for (cotangents, what) in [(few, "give one for each particle"), (bad, "not a finite number")] {
        let refusal = tape.pull_back(cotangents).expect_err(what).to_string();
        assert!(refusal.contains(what), "{refusal}");
    }

    // A world that is left.
    let head = Head { world: "leaving = \"delete\"", ..Head::cells(H, [8, 8, 8], "") }.time("step = 1e-3");
    let mut sim = simulation(&head.with(&[&ground[..], &[AWAKE.into()]].concat()), Precision::F64);
    let refusal = sim.record(&barchan::registry(), 0.3).expect_err("they leave").to_string();
    assert!(refusal.contains("left the world"), "{refusal}");
}
