//! Gradients through nested levels: through rims, and through particles that split, merge and change their level as levels follow a tool.

use super::{AWAKE, Noise, by_number, difference, dot, gradient, simulation, weights, within};
use barchan::{ParticleState, Precision, Simulation, Tape};
use barchan_tests::sketch::{Head, block, driven, material, tool};
use std::collections::BTreeMap;

/// Cell width of the finest level [m].
const H: f64 = 0.05;

/// Ground that swirls gently, and levels that follow a ball which flies over it.
struct Case<'a> {
    law: (&'a str, &'a str),
    levels: u32,
    walls: &'a str,
    steps: u32,
    /// How far from the ball ground is live [coarsest cells]; 0: all of it is.
    reach: u32,
}

/// What is changed, along directions of their own.
#[derive(Clone, Copy, Default)]
struct By {
    place: f64,
    velocity: f64,
    affine: f64,
    parameter: f64,
    gravity: f64,
}

/// The world, and how deep ground is [cells].
const WORLD: [u32; 3] = [44, 24, 16];
const DEEP: f64 = 6.0;
/// A world of which only a part is live.
const FAR: [u32; 3] = [128, 64, 16];
const YOUNG: f64 = 2e4;
/// Length of a step [s].
const STEP: f64 = 5e-4;
const FLOOR: &str = "z_min = \"stick\"\nx_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\n";
const JELLY: (&str, &str) = ("neo_hookean", "young_modulus = {}, poisson_ratio = 0.3");

impl Case<'_> {
    fn simulation(&self, by: By, precision: Precision) -> Simulation {
        let world = if self.reach > 0 { FAR } else { WORLD };
        // What comes within reach is at rest.
        let (aside, more) = if self.reach > 0 { (0.0, "settled = true") } else { (0.4, "") };
        // Which particles merge at a surface hangs on a hair.
        let tolerance = if self.reach > 0 { 1e-3 } else { 0.1 };
        let head = Head { gravity: [aside, 0.0, -9.81 - by.gravity], ..Head::cells(H, world, self.walls) };
        let (law, parameters) = self.law;
        let parameters = parameters.replace("{}", &format!("{:?}", YOUNG * (1.0 + by.parameter)));
        let size = [f64::from(world[0]), f64::from(world[1]), DEEP].map(|cells| cells * H);
        let flies = driven([30.0, 0.0, 0.0]);
        let parts = [
            AWAKE.into(),
            format!("[levels]\ncount = {}\nhalf = 8\nreach = {}\ntolerance = {tolerance:?}\n", self.levels, self.reach),
            material(law, 1000.0, &parameters),
            block(law, [0.0; 3], size, more),
            tool(
                "ball",
                [0.5, 0.5 * H * f64::from(world[1]) - 0.1, 0.47],
                "sphere = { radius = 0.05 }",
                "\"stick\"",
                &flies,
            ),
        ];
        let mut sim = simulation(&head.time(format!("step = {STEP:?}")).with(&parts), precision);
        let mut state = ParticleState { sort: None, ..sim.particles() };
        let mut noise = Noise::new(17);
        for (l, i) in by_number(&state) {
            let list = &mut state.lists[l];
            let (x, h) = (list.position(i), list.cell_width);
            let swirl = |at: f64, rate: f64| (0.4 * (rate * at).sin(), 0.4 * rate * (rate * at).cos());
            let [(u, of_u), (v, of_v), (w, of_w)] = [swirl(x[2], 5.0), swirl(x[0], 4.0), swirl(x[1], 6.0)];
            list.velocity[i] = [u, v, 0.3 * w];
            list.affine[i] = [0.0, 0.0, of_u, of_v, 0.0, 0.0, 0.0, 0.3 * of_w, 0.0];
            for d in 0..3 {
                let moved = list.offset[i][d] + by.place * noise.draw() / h;
                assert!((0.0..1.0).contains(&moved), "particles stay in their cells");
                list.offset[i][d] = moved;
                list.velocity[i][d] += (0.02 + by.velocity) * noise.draw();
            }
            list.affine[i].iter_mut().for_each(|c| *c += (0.2 + by.affine) * noise.draw());
        }
        sim.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
        sim
    }

    fn tape(&self, sim: &mut Simulation) -> Tape {
        sim.record(&barchan::registry(), STEP * f64::from(self.steps)).unwrap_or_else(|e| panic!("{e}"))
    }

    fn loss(&self, by: By) -> f64 {
        let tape = self.tape(&mut self.simulation(by, Precision::F64));
        let weights = weights(tape.end().id.len());
        dot(&tape.end().position, &weights.position) + dot(&tape.end().velocity, &weights.velocity)
    }

    /// Compares a gradient with differences of runs, so many times as long as is good where nothing yields. Returns what the ledger counted.
    fn compare(&self, fd: f64, tolerance: f64) -> BTreeMap<String, u64> {
        let mut sim = self.simulation(By::default(), Precision::F64);
        let tape = self.tape(&mut sim);
        let found = gradient(&tape);
        let mut noise = Noise::new(17);
        let mut along = [0.0; 3];
        let particles = &found.particles;
        assert_eq!(particles.len(), tape.start().id.len());
        for number in 0..particles.len() {
            for d in 0..3 {
                along[0] += noise.draw() * particles.position[number][d];
                along[1] += noise.draw() * particles.velocity[number][d];
            }
            along[2] += particles.affine[number].iter().map(|owed| owed * noise.draw()).sum::<f64>();
        }
        let [place, velocity, affine] = along;
        let still = By::default();
        type Change<'a> = &'a dyn Fn(f64) -> By;
        let compared: [(&str, f64, f64, Change<'_>); 5] = [
            ("places", place, 1e-7, &|place| By { place, ..still }),
            ("velocities", velocity, 1e-4, &|velocity| By { velocity, ..still }),
            ("affine", affine, 1e-2, &|affine| By { affine, ..still }),
            ("gravity", -found.gravity[2], 1e-1, &|gravity| By { gravity, ..still }),
            ("modulus", YOUNG * found.parameters[0][0], 1e-3, &|parameter| By { parameter, ..still }),
        ];
        // Settled ground begins otherwise with other parameters and another gravity.
        let starts_alike = if self.reach > 0 { 3 } else { compared.len() };
        for (what, given, size, by) in compared.into_iter().take(starts_alike) {
            let expected = difference(fd * size, |x| self.loss(by(x)));
            let name = format!("{}, {} levels, {what}: {given:.9e} {expected:.9e}", self.law.0, self.levels);
            // A particle counts in one parent cell or the next: as it crosses between them, the mean C at a rim jumps by a little.
            let tolerance = if what == "places" { 10.0 * tolerance } else { tolerance };
            within(&name, (given - expected).abs() / expected.abs().max(1e-3), tolerance);
        }
        sim.ledger().counts
    }
}

/// Holds a run to have done all of this.
fn have_happened(counts: &BTreeMap<String, u64>, all: &[&str]) {
    for what in all {
        assert!(counts.get(*what).is_some_and(|count| *count > 0), "{what}: {counts:?}");
    }
}

/// Physics: gradients are derivatives through rims of moving levels, and through splits and merges.
#[test]
fn gradients_go_through_levels() {
    for (levels, steps, happened) in
        [(2, 60, &["particles split", "particles merged"][..]), (3, 30, &["particles split"])]
    {
        let counts = Case { law: JELLY, levels, walls: FLOOR, steps, reach: 0 }.compare(1.0, 2e-6);
        have_happened(&counts, happened);
    }
    let laws = [
        ("fixed_corotated", "young_modulus = {}, poisson_ratio = 0.3", 1.0, 2e-6),
        // Some begin or end to yield.
        ("snow", "young_modulus = {}, poisson_ratio = 0.3, hardening = 8.0", 1e-2, 1e-5),
        ("sand", "young_modulus = {}, poisson_ratio = 0.3, friction_angle = 0.6", 1e-2, 1e-4),
    ];
    for (law, parameters, fd, tolerance) in laws {
        let case = Case { law: (law, parameters), levels: 2, walls: FLOOR, steps: 20, reach: 0 };
        have_happened(&case.compare(fd, tolerance), &["particles split"]);
    }
}

/// Likewise where rims end at walls that let go and rub, and across ends that are joined.
#[test]
fn gradients_go_through_rims_at_walls_and_joined_ends() {
    let walls = "z_min = { separate = { friction = 0.3 } }\nx_min = { separate = { friction = 0.2 } }\nx_max = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"\n";
    Case { law: JELLY, levels: 2, walls, steps: 8, reach: 0 }.compare(1e-2, 1e-5);
}

/// Likewise where ground comes within reach and goes out of it, and what lies further off holds the edge.
#[test]
fn gradients_go_through_ground_that_comes_and_goes() {
    let case = Case { law: JELLY, levels: 2, walls: "z_min = \"stick\"\n", steps: 80, reach: 4 };
    have_happened(&case.compare(0.03, 5e-6), &["tiles archived", "tiles brought in from the terrain"]);
}

/// The chain rule: what two tapes give one after the other, the first of which has split particles, is what one gives; also of f32.
#[test]
fn gradients_through_levels_chain() {
    let case = Case { law: JELLY, levels: 2, walls: FLOOR, steps: 40, reach: 0 };
    for precision in [Precision::F64, Precision::F32] {
        let whole = gradient(&case.tape(&mut case.simulation(By::default(), precision)));
        let mut sim = case.simulation(By::default(), precision);
        let first = sim.record(&barchan::registry(), 23.0 * STEP).unwrap_or_else(|e| panic!("{e}"));
        let second = case.tape(&mut sim);
        assert_eq!((first.len(), second.len()), (23, 17));
        assert_ne!(first.start().id.len(), first.end().id.len());
        let later = gradient(&second);
        let earlier = first.pull_back(later.particles).unwrap_or_else(|e| panic!("{e}"));
        for (whole, parts) in [
            (&whole.particles.position, &earlier.particles.position),
            (&whole.particles.velocity, &earlier.particles.velocity),
        ] {
            let size = whole.iter().flatten().fold(0.0, |most: f64, x| most.max(x.abs()));
            let apart = whole.iter().flatten().zip(parts.iter().flatten()).map(|(a, b)| (a - b).abs());
            within("apart", apart.fold(0.0, f64::max) / size, 1e-12);
        }
    }
}
