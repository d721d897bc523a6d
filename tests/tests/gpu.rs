//! The backend wgpu against the CPU in 64 bits, against truths, and against itself. Without an adapter these tests fail, and the
//! error says how to get a software one.

use barchan::scene::{Motion, Scene};
use barchan::{Ledger, Options, Precision, Registry, Simulation, Vec3};
use barchan_tests::scenes::{Row, left, norm, scene};
use barchan_tests::sketch::{Head, bed, block, driven, half, material, tool};

#[path = "gpu/adapters.rs"]
mod adapters;
#[path = "gpu/agree.rs"]
mod agree;
#[path = "gpu/couplings.rs"]
mod couplings;
#[path = "gpu/damping.rs"]
mod damping;
#[path = "gpu/free.rs"]
mod free;
#[path = "gpu/gradients.rs"]
mod gradients;
#[path = "gpu/ground.rs"]
mod ground;
#[path = "gpu/levels.rs"]
mod levels;
#[path = "gpu/robots.rs"]
mod robots;
#[path = "gpu/robust.rs"]
mod robust;
#[path = "gpu/sleeping.rs"]
mod sleeping;
#[path = "gpu/stiffness.rs"]
mod stiffness;
#[path = "gpu/tools.rs"]
mod tools;
#[path = "gpu/worlds.rs"]
mod worlds;

fn on(backend: &str, precision: Precision, toml: &str) -> Simulation {
    let options = Options { backend: backend.into(), precision, threads: 1, ..Options::default() };
    Simulation::new(&barchan::registry(), &scene(toml), &options).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

fn gpu(toml: &str) -> Simulation {
    on("wgpu", Precision::F32, toml)
}

fn cpu(toml: &str) -> Simulation {
    on("cpu", Precision::F64, toml)
}

fn take(simulation: &mut Simulation, steps: usize) {
    for _ in 0..steps {
        simulation.step().unwrap_or_else(|e| panic!("{e}"));
    }
}

/// Takes steps, as many at once as the backend likes.
fn take_at_once(sim: &mut Simulation, steps: usize) {
    let mut taken = 0;
    while taken < steps {
        taken += sim.steps(steps - taken, f64::INFINITY).unwrap_or_else(|e| panic!("{e}")).len();
    }
}

/// How far two places, or other vectors, are apart.
fn off(a: Vec3, b: Vec3) -> f64 {
    norm(std::array::from_fn::<f64, 3, _>(|d| a[d] - b[d]))
}

/// How often a pass was made.
fn passes_of(sim: &Simulation, name: &str) -> u64 {
    sim.timings().iter().find(|timing| timing.effect == name).map_or(0, |timing| timing.passes)
}

/// Greatest distance between the same particles [m].
fn apart(a: &[Row], b: &[Row]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |most, (a, b)| {
        assert_eq!(a.id, b.id);
        most.max(norm(std::array::from_fn::<f64, 3, _>(|d| a.x[d] - b.x[d])))
    })
}

/// A jelly block that falls on a corner's walls and squashes.
fn jelly(walls: &str) -> String {
    let head = Head::cells(0.02, [20, 18, 24], walls).time("step = 4e-4");
    head.with(&[
        material("neo_hookean", 1000.0, "young_modulus = 2e4, poisson_ratio = 0.3"),
        block("neo_hookean", [0.1, 0.1, 0.03], [0.22, 0.2, 0.15], "velocity = [-0.7, 0.3, -1.0]"),
    ])
}

fn momentum(ledger: &Ledger) -> f64 {
    norm(ledger.momentum)
}

fn gpu_of(walls: &str) -> Simulation {
    gpu(&jelly(walls))
}

/// A column of sand collapses: the same heights as on the CPU.
fn column() -> String {
    Head::cells(
        0.02,
        [30, 8, 16],
        "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"",
    )
    .time("step = 2.5e-4")
    .with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 30.0"),
        block("sand", [0.0, 0.0, 0.0], [0.16, 0.16, 0.2], ""),
    ])
}

fn on_gpu() -> Options {
    Options { backend: "wgpu".into(), threads: 1, ..Options::default() }
}

/// A patch of sand, sown at random, and a blade that an agent drives; worlds differ in seed, friction, the blade's height, and how fast the
/// sand is.
fn patch(world: u64) -> Scene {
    let friction = 25.0 + 3.0 * world as f64;
    let parameters = format!("young_modulus = 1e5, friction_angle_deg = {friction}");
    let (head, mut parts) = bed(0.05, [12, 8], 3, 8, &parameters);
    parts[1] += &format!("sampling = \"jitter\"\nvelocity = [{:?}, 0.0, 0.0]\n", 0.6 * world as f64);
    parts.push(tool(
        "blade",
        [0.15, 0.2, 0.14 + 0.01 * world as f64],
        &half([0.06, 0.08, 0.06]),
        "{ coulomb = { friction = 0.4 } }",
        &driven([0.5, 0.0, 0.0]),
    ));
    Scene { seed: world, ..scene(&head.time("step = 1e-3").with(&parts)) }
}

/// The patch under gravity that grows, by other times in worlds that are reset.
fn eased(world: u64) -> Scene {
    Scene { gravity_ramp: 0.03, ..patch(world) }
}

/// Likewise with a cube that drops into it, from world to world another way.
fn dropped(world: u64) -> Scene {
    let mut scene = eased(world);
    let mut cube = scene.tool[0].clone();
    cube.name = "cube".into();
    cube.position = [0.4, 0.2 + 0.01 * world as f64, 0.22];
    let spin = [0.5 * world as f64, 1.0, 0.0];
    cube.motion = Motion::Free { mass: 1.5, linear: [0.3, 0.0, -1.0], angular: spin, restitution: 0.0 };
    scene.tool.push(cube);
    scene
}

/// Barchan's plugins and the current.
fn with_currents() -> Registry {
    let mut registry = barchan::registry();
    barchan_seam_coupling::register(&mut registry).unwrap();
    registry
}

/// A bed of sand on two levels, which follow a blade that is driven through it and, if asked for, a cube that drops beside it; worlds differ in
/// seed, and in how fast the blade is.
fn followed(world: u64, subcycle: bool, cube: bool) -> Scene {
    let h = 0.04;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let mut parts = vec![
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [1.44, 0.48, 0.16], ""),
        format!("[levels]\ncount = 2\nhalf = 8\nagents = [\"blade\"]\nsubcycle = {subcycle}\n"),
        tool(
            "blade",
            [0.6, 0.24, 0.24],
            &half([0.06, 0.12, 0.14]),
            "{ coulomb = { friction = 0.3 } }",
            &driven([3.5 + 0.5 * world as f64, 0.0, 0.0]),
        ),
    ];
    if cube {
        let free = "{ free = { mass = 2.0, linear = [0.0, 0.0, -0.5] } }";
        parts.push(tool("cube", [0.2, 0.24, 0.23], &half([0.08; 3]), "{ coulomb = { friction = 0.3 } }", free));
    }
    let step = if subcycle { "step = 1.4e-3" } else { "step = 7e-4" };
    Scene { seed: world, ..scene(&Head::cells(h, [36, 12, 16], walls).time(step).with(&parts)) }
}
