//! Cases of the backend wgpu at sizes for which GPUs are made: against the CPU in f64, against truths, and against itself. The suite of
//! `gpu` asks the same of small ones; `examples/large_gpu.rs` runs these on a GPU.

use crate::long_cases::LAWS;
use crate::report::Outcome;
use crate::scenes::{Row, minus, norm, rows, scene};
use crate::sketch::{Head, PERIODIC, block, driven, half, material, tool};
use barchan::worlds::Worlds;
use barchan::{Ledger, Options, Precision, Simulation, Vec3};

const H: f64 = 0.02;
const BOX: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";

/// On the first adapter; the CPU uses all cores.
fn on(backend: &str, precision: Precision) -> Options {
    Options { backend: backend.into(), precision, threads: 0, ..Options::default() }
}

fn start(toml: &str, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(toml), options).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

/// A scene on the GPU, and on the CPU in 64 bits.
fn both(toml: &str) -> [Simulation; 2] {
    [start(toml, &on("wgpu", Precision::F32)), start(toml, &on("cpu", Precision::F64))]
}

/// Takes so many steps, as many at once as the backend can. Returns the impulse on the first body [N s].
fn take(simulation: &mut Simulation, steps: u64) -> Vec3 {
    let end = simulation.step_count() + steps;
    let mut impulse = [0.0; 3];
    while simulation.step_count() < end {
        let count = (end - simulation.step_count()) as usize;
        for report in simulation.steps(count, f64::INFINITY).unwrap_or_else(|e| panic!("{e}")) {
            let wrenches = report.wrenches.unwrap_or_else(|| simulation.wrenches().to_vec());
            if let Some(first) = wrenches.first() {
                (0..3).for_each(|d| impulse[d] += first.force[d] * report.dt);
            }
        }
    }
    impulse
}

/// Greatest distance between the same particles, in cells.
fn apart(a: &[Row], b: &[Row]) -> f64 {
    assert!(a.iter().map(|row| row.id).eq(b.iter().map(|row| row.id)));
    a.iter().zip(b).map(|(a, b)| norm(minus(a.x, b.x)) / H).fold(0.0, f64::max)
}

/// Mean difference of the depths of matter over squares of two cells, in cells.
fn depths_apart(a: &[Row], b: &[Row], extent: [f64; 2]) -> f64 {
    let counts = extent.map(|length| (length / (2.0 * H)).ceil() as usize);
    let depths = |rows: &[Row]| {
        let mut depths = vec![0.0; counts[0] * counts[1]];
        for row in rows {
            let at = |d: usize| ((row.x[d].max(0.0) / (2.0 * H)) as usize).min(counts[d] - 1);
            depths[at(0) * counts[1] + at(1)] += row.volume0 / (2.0 * H).powi(2);
        }
        depths
    };
    let (a, b) = (depths(a), depths(b));
    a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / (a.len() as f64 * H)
}

/// What came in, what walls and gravity gave and what went into tools make up what is there; relative to what walls gave.
fn imbalance(before: &Ledger, after: &Ledger, tools: Vec3) -> f64 {
    let lost: Vec3 = std::array::from_fn(|d| {
        after.momentum[d] - before.momentum[d] - after.wall_impulse[d] - after.gravity_impulse[d] + tools[d]
    });
    norm(lost) / norm(after.wall_impulse)
}

/// 1.1 million particles of jelly fall into a corner.
pub fn jelly() -> Outcome {
    let toml = Head::cells(H, [80, 80, 80], "x_min = \"slip\"\nz_min = \"stick\"").time("step = 4e-4").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
        block("neo_hookean", [0.1, 0.1, 0.03], [1.2, 1.2, 0.93], "velocity = [-0.7, 0.3, -1.0]"),
    ]);
    let [mut gpu, mut cpu] = both(&toml);
    let before = gpu.ledger();
    let mut outcome = Outcome { steps: 200, ..Outcome::default() };
    take(&mut gpu, 200);
    take(&mut cpu, 200);
    let what = format!("{} particles: distance from the CPU's [cells]", before.particles);
    outcome.add(what, apart(&rows(&gpu), &rows(&cpu)), 1e-3);
    outcome.add("momentum that is missing, of what walls gave", imbalance(&before, &gpu.ledger(), [0.0; 3]), 1e-3);
    outcome
}

/// Blocks of all laws fall upon each other, 1.4 million particles in all.
pub fn laws() -> Outcome {
    let mut parts = Vec::new();
    for (i, (law, parameters)) in LAWS.into_iter().enumerate() {
        let z = 0.3 * i as f64;
        parts.push(material(law, 1000.0, parameters));
        parts.push(block(law, [0.1, 0.1, z], [1.1, 1.1, z + 0.28], "velocity = [0.0, 0.0, -0.5]"));
    }
    let [mut gpu, mut cpu] = both(&Head::cells(H, [60, 60, 120], BOX).time("step = 2e-4").with(&parts));
    let before = gpu.ledger();
    let mut outcome = Outcome { steps: 200, ..Outcome::default() };
    take(&mut gpu, 200);
    take(&mut cpu, 200);
    let (g, c) = (rows(&gpu), rows(&cpu));
    outcome.add(
        format!("{} particles of 7 laws: distance from the CPU's [cells]", before.particles),
        apart(&g, &c),
        1e-2,
    );
    outcome.add("momentum that is missing, of what walls gave", imbalance(&before, &gpu.ledger(), [0.0; 3]), 1e-3);
    outcome
}

/// A column of a million particles of sand collapses: the same heap, though grains go their own ways; and twice the same bits.
pub fn heap() -> Outcome {
    let toml = Head::cells(H, [150, 60, 60], BOX).time("safety = 0.5").with(&[
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2, friction_angle_deg = 35"),
        block("sand", [0.0; 3], [1.0, 1.2, 0.9], "sampling = \"jitter\""),
    ]);
    let [mut gpu, mut cpu] = both(&toml);
    let mut outcome = Outcome { steps: 1500, ..Outcome::default() };
    take(&mut gpu, 1500);
    take(&mut cpu, 1500);
    let (g, c) = (rows(&gpu), rows(&cpu));
    outcome.add(
        format!("{} grains: mean difference of depths from the CPU's [cells]", g.len()),
        depths_apart(&g, &c, [3.0, 1.2]),
        0.1,
    );
    let mut again = start(&toml, &on("wgpu", Precision::F32));
    take(&mut again, 1500);
    let differ = rows(&again).iter().zip(&g).filter(|(a, b)| a != b).count();
    outcome.add("grains that another run leaves elsewhere, bit by bit", differ as f64, 0.0);
    outcome
}

/// 1.7 million particles fly round a periodic world.
pub fn flight() -> Outcome {
    let velocity = [3.0, -2.0, 1.0];
    let head = Head { gravity: [0.0; 3], ..Head::cells(H, [80, 80, 80], PERIODIC) };
    let toml = head.time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.2"),
        block("hencky", [0.1; 3], [1.3; 3], &format!("velocity = {velocity:?}")),
    ]);
    let mut gpu = start(&toml, &on("wgpu", Precision::F32));
    let from = rows(&gpu);
    let steps = 1000;
    take(&mut gpu, steps);
    let time = gpu.time();
    let off = |(row, from): (&Row, &Row)| {
        let way: Vec3 = std::array::from_fn(|d| {
            let x = from.x[d] + velocity[d] * time;
            let off = (row.x[d] - x).rem_euclid(80.0 * H);
            off.min(80.0 * H - off)
        });
        norm(way) / H
    };
    let mut outcome = Outcome { steps, ..Outcome::default() };
    let most = rows(&gpu).iter().zip(&from).map(off).fold(0.0, f64::max);
    outcome.add(
        format!("{} particles: off their way after {:.0} cells [cells]", from.len(), 3.0 * time / H),
        most,
        0.05,
    );
    outcome
}

/// A blade drawn through sand, which three levels follow.
pub fn levels(subcycle: bool) -> Outcome {
    let toml = Head::cells(H, [192, 96, 48], BOX).time("safety = 0.5").with(&[
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [3.84, 1.92, 0.48], ""),
        format!("[levels]\ncount = 3\nhalf = 12\nagents = [\"blade\"]\nsubcycle = {subcycle}\n"),
        tool(
            "blade",
            [0.8, 0.96, 0.5],
            &half([0.03, 0.2, 0.1]),
            "{ coulomb = { friction = 0.3 } }",
            &driven([0.8, 0.0, 0.0]),
        ),
    ]);
    let [mut gpu, mut cpu] = both(&toml);
    let before = gpu.ledger();
    let steps = if subcycle { 200 } else { 800 };
    let mut outcome = Outcome { steps, ..Outcome::default() };
    let (felt, on_cpu) = (take(&mut gpu, steps), take(&mut cpu, steps));
    let (g, c) = (gpu.ledger(), cpu.ledger());
    let name = if subcycle { "subcycled, " } else { "" };
    outcome.add(
        format!("{name}{} particles on three levels: impulse on the blade, off the CPU's", g.particles),
        norm(minus(felt, on_cpu)) / norm(on_cpu),
        0.02,
    );
    outcome.add("count of particles, off the CPU's", (g.particles as f64 / c.particles as f64 - 1.0).abs(), 0.05);
    outcome.add("mean difference of depths [cells]", depths_apart(&rows(&gpu), &rows(&cpu), [3.84, 1.92]), 0.05);
    outcome.add("mass that is missing", (g.mass / before.mass - 1.0).abs(), 1e-6);
    outcome.add("momentum that is missing, of what walls gave", imbalance(&before, &g, felt), 1e-3);
    outcome
}

/// A cube that falls onto 0.9 million particles of sand, coupled both ways.
pub fn cube() -> Outcome {
    let toml = Head::cells(H, [80, 80, 48], BOX).time("safety = 0.5").with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [1.6, 1.6, 0.36], "settled = true"),
        tool(
            "cube",
            [0.8, 0.8, 0.5],
            &half([0.1; 3]),
            "{ coulomb = { friction = 0.5 } }",
            "{ free = { mass = 12.0 } }",
        ),
    ]);
    let [mut gpu, mut cpu] = both(&toml);
    let mut outcome = Outcome { steps: 1000, ..Outcome::default() };
    take(&mut gpu, 1000);
    take(&mut cpu, 1000);
    let off = norm(minus(gpu.bodies()[0].position, cpu.bodies()[0].position)) / H;
    outcome.add(format!("{} particles: where the cube is, off the CPU's [cells]", gpu.ledger().particles), off, 0.05);
    outcome
}

/// 64 worlds of 20,000 particles, each with a blade of its own speed: some of them are what they are alone, bit for bit.
pub fn worlds() -> Outcome {
    let world = |w: usize| {
        let speed = 0.3 + 0.01 * w as f64;
        scene(&Head::cells(H, [26, 26, 20], BOX).time("step = 2e-4").with(&[
            material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
            block("sand", [0.0; 3], [0.52, 0.52, 0.06 + 0.02 * (w % 4) as f64], ""),
            tool(
                "blade",
                [0.1, 0.26, 0.14],
                &half([0.02, 0.1, 0.06]),
                "{ coulomb = { friction = 0.3 } }",
                &driven([speed, 0.0, 0.0]),
            ),
        ]))
    };
    let options = on("wgpu", Precision::F32);
    let mut worlds =
        Worlds::new(&barchan::registry(), (0..64).map(world).collect(), &options).unwrap_or_else(|e| panic!("{e}"));
    assert!(worlds.are_together(), "they are to share their passes");
    for reports in worlds.steps(500) {
        reports.unwrap_or_else(|e| panic!("{e}"));
    }
    let mut outcome = Outcome { steps: 500, ..Outcome::default() };
    let together: Vec<_> = worlds.iter().map(rows).collect();
    let mut differ = 0;
    for w in [0, 17, 42, 63] {
        let mut alone = Simulation::new(&barchan::registry(), &world(w), &options).unwrap_or_else(|e| panic!("{e}"));
        take(&mut alone, 500);
        differ += rows(&alone).iter().zip(&together[w]).filter(|(a, b)| a != b).count();
    }
    let particles: usize = together.iter().map(Vec::len).sum();
    outcome.add(
        format!("{particles} particles in 64 worlds: of four of them, not what they are alone"),
        differ as f64,
        0.0,
    );
    outcome
}
