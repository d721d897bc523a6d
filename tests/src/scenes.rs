//! Short ways to say a scene, and to read a simulation.

use barchan::{BodyState, Command, Ledger, Options, ParticleList, Precision, RobotState, Scene, Simulation, Vec3};
use std::path::Path;

/// A scene from TOML text.
///
/// # Panics
/// If the scene is not valid.
pub fn scene(toml: &str) -> Scene {
    Scene::from_str(toml, "test scene", Path::new(".")).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

/// Options with a precision, on one thread.
pub fn options(precision: Precision) -> Options {
    Options { precision, threads: 1, ..Options::default() }
}

/// Backends and number formats that a case is run on which holds for all of them. The device is the first adapter, be it a software one; a case fails where
/// there is none.
pub fn everywhere() -> [Options; 3] {
    let on = |backend: &str, precision| Options { backend: backend.to_owned(), ..options(precision) };
    [on("cpu", Precision::F32), on("cpu", Precision::F64), on("wgpu", Precision::F32)]
}

/// A simulation from TOML text.
///
/// # Panics
/// If the scene cannot be assembled.
pub fn simulation(toml: &str, precision: Precision) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(toml), &options(precision)).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

/// How often what robots and bodies do was not solved to its end, as a ledger or a coupling counts it.
pub fn missed<'a>(counts: impl IntoIterator<Item = (&'a String, &'a u64)>) -> u64 {
    let of_solutions = |name: &str| name.contains("not converged") || name.contains("not found");
    counts.into_iter().filter(|(name, _)| of_solutions(name)).map(|(_, count)| count).sum()
}

/// Steps until `time` [s].
///
/// # Panics
/// If a step fails.
pub fn run_to(simulation: &mut Simulation, time: f64) {
    while simulation.time() < time {
        simulation.set_stop(time);
        simulation.step().unwrap_or_else(|e| panic!("{e}"));
    }
}

/// Prints a figure beside its tolerance, and asserts that it is within.
///
/// # Panics
/// If it is not.
#[track_caller]
pub fn within(what: &str, measured: f64, tolerance: f64) {
    println!("{what}: {measured:.3e}, tolerance {tolerance:.1e}");
    assert!(measured <= tolerance, "{what}: {measured:e} instead of at most {tolerance:e}");
}

/// A particle, read out.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its id.
    pub id: u64,
    /// Its level, 0 is finest.
    pub level: u32,
    /// Position [m].
    pub x: Vec3,
    /// Velocity [m/s].
    pub v: Vec3,
    /// Affine matrix [1/s].
    pub c: [f64; 9],
    /// Mass [kg].
    pub m: f64,
    /// Rest volume [m³].
    pub volume0: f64,
    /// Strain planes.
    pub strain: Vec<f64>,
    /// History.
    pub state: Vec<f64>,
}

/// All particles in the order of their ids.
pub fn rows(simulation: &Simulation) -> Vec<Row> {
    let mut rows: Vec<Row> = simulation.particles().lists.iter().flat_map(list_rows).collect();
    rows.sort_by_key(|r| r.id);
    rows
}

fn list_rows(list: &ParticleList) -> Vec<Row> {
    (0..list.len())
        .map(|i| Row {
            id: list.id[i],
            level: list.level,
            x: list.position(i),
            v: list.velocity[i],
            c: list.affine[i],
            m: list.mass[i],
            volume0: list.volume0[i],
            strain: list.strain.iter().map(|plane| plane[i]).collect(),
            state: list.state.iter().map(|plane| plane[i]).collect(),
        })
        .collect()
}

/// Changes every particle: `f(position, row)` may alter velocity, affine matrix, strain and history.
///
/// # Panics
/// If the state does not fit, which cannot happen for the simulation's own particles.
pub fn alter(simulation: &mut Simulation, mut f: impl FnMut(&mut Row)) {
    let mut state = simulation.particles();
    for list in &mut state.lists {
        for (i, mut row) in list_rows(list).into_iter().enumerate() {
            f(&mut row);
            list.velocity[i] = row.v;
            list.affine[i] = row.c;
            list.mass[i] = row.m;
            for (plane, x) in list.strain.iter_mut().zip(&row.strain).chain(list.state.iter_mut().zip(&row.state)) {
                plane[i] = *x;
            }
        }
    }
    simulation.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
}

/// Deterministic numbers in [-1, 1), for set-ups that should have no symmetry.
#[derive(Clone, Debug)]
pub struct Noise(u64);

impl Noise {
    /// A sequence of its own for each seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }
    /// The next number.
    pub fn draw(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// Difference of two vectors.
pub fn minus(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[d] - b[d])
}

/// Length of a vector.
pub fn norm(v: impl AsRef<[f64]>) -> f64 {
    v.as_ref().iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Sum of two vectors.
pub fn plus(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[d] + b[d])
}

/// Momentum and angular momentum of ground and bodies together.
pub fn totals(ledger: &Ledger) -> (Vec3, Vec3) {
    (
        std::array::from_fn(|d| ledger.momentum[d] + ledger.body_momentum[d]),
        std::array::from_fn(|d| ledger.angular_momentum[d] + ledger.body_angular_momentum[d]),
    )
}

/// Gives particles a velocity field that is linear in place, with rows of its gradient `b` [1/s], takes a step, and says for each of three levels how many particles
/// there are within 0.3 m along an axis, and by how much a component of their velocities has changed at most [m/s].
///
/// # Panics
/// If the step fails.
pub fn change_of_linear_field(patch: &mut Simulation, axis: usize, b: [f64; 9]) -> [(usize, f64); 3] {
    alter(patch, |r| {
        r.v = std::array::from_fn(|i| (0..3).map(|j| b[3 * i + j] * r.x[j]).sum::<f64>());
        r.c = b;
    });
    let before = rows(patch);
    patch.step().unwrap_or_else(|e| panic!("{e}"));
    let mut worst = [(0, 0f64); 3];
    for (old, new) in before.iter().zip(&rows(patch)).filter(|(old, _)| old.x[axis] < 0.3) {
        let worst = &mut worst[new.level as usize];
        *worst = (worst.0 + 1, (0..3).fold(worst.1, |w, i| w.max((new.v[i] - old.v[i]).abs())));
    }
    worst
}

/// What an agent does in a world for the next steps, where it drives a blade.
///
/// # Panics
/// If there is no tool `blade`, or it is not driven.
pub fn drive_blade(s: &mut Simulation, world: usize) {
    let turn = 0.05 * s.step_count() as f64 + world as f64;
    let (linear, angular) = ([0.6 * turn.cos(), 0.3 * turn.sin(), -0.1], [0.0, 0.0, turn.sin()]);
    s.act("blade", &Command::Twist { linear, angular }).unwrap_or_else(|e| panic!("{e}"));
}

/// Everything that a world has left behind.
pub fn left(s: &Simulation) -> String {
    format!("{:?} {:?} {:?} {:?}", s.particles(), s.bodies(), s.wrenches(), s.time().to_bits())
}

/// A quadruped in empty space and a ball of jelly that flies at it from below, its centre at height `z` [m].
pub fn robot_meets_ball(z: f64, radius: f64) -> String {
    format!(
        r#"
name = "meeting"
gravity = [0, 0, 0]
world = {{ cell = 0.03125, min = [-1, -1, -1], max = [1, 1, 1] }}
time = {{ end = 1 }}
[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000
parameters = {{ young_modulus = 1e5, poisson_ratio = 0.3 }}
[[body]]
name = "ball"
material = "jelly"
shape = {{ sphere = {{ center = [0.05, 0, {z}], radius = {radius} }} }}
velocity = [0, 0.3, 2.0]
[[robot]]
name = "dog"
model = "quadruped"
position = [0, 0, 0]
joints = {{ "*_thigh_joint" = 0.8, "*_calf_joint" = -1.6 }}
motor = [{{ kp = 100, kd = 3 }}]
"#
    )
}

/// Shear over normal stress that a cone matched in triaxial compression mobilises in plane shear: 2 √3 sin φ / (3 − sin φ).
pub fn plane_shear_friction(friction_angle: f64) -> f64 {
    let sine = friction_angle.sin();
    2.0 * 3f64.sqrt() * sine / (3.0 - sine)
}

/// How far a robot's base leans [degrees].
pub fn lean(state: &RobotState) -> f64 {
    let [_, x, y, _] = state.rotation;
    (1.0 - 2.0 * (x * x + y * y)).acos().to_degrees()
}

/// A chain of rods of 0.1 kg and 0.2 m in `folder`, whose joints turn about x and y in turns by 0.6 rad each, free of friction; on a bed that it never
/// touches, which is so soft that steps may take 5 ms. What stands in the robot's entry besides says how it begins.
///
/// # Panics
/// If the folder cannot be written to.
pub fn chain(folder: &Path, links: usize, gravity: f64, more: &str) -> Scene {
    let mut urdf =
        "<robot name=\"chain\"><link name=\"base\"><inertial><mass value=\"0.1\"/>ROUND</inertial></link>\n".to_owned();
    for i in 0..links {
        let parent = if i == 0 { "base".to_owned() } else { format!("rod{}", i - 1) };
        let origin = if i == 0 { 0.0 } else { -0.2 };
        let axis = if i % 2 == 0 { "1 0 0" } else { "0 1 0" };
        urdf += &format!(
            "<link name=\"rod{i}\"><inertial><origin xyz=\"0 0 -0.1\"/><mass value=\"0.1\"/>ROUND</inertial></link>
<joint name=\"j{i}\" type=\"continuous\"><parent link=\"{parent}\"/><child link=\"rod{i}\"/><origin xyz=\"0 0 {origin}\"/><axis xyz=\"{axis}\"/></joint>\n"
        );
    }
    urdf += "</robot>";
    let inertia = "<inertia ixx=\"1e-4\" iyy=\"1e-4\" izz=\"1e-4\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/>";
    std::fs::write(folder.join("chain.urdf"), urdf.replace("ROUND", inertia)).expect("the folder can be written to");
    let text = format!(
        r#"
name = "chain"
gravity = [0, 0, {gravity}]
world = {{ cell = 0.25, min = [-16, -16, -16], max = [16, 16, 16], walls = {{ z_min = "stick" }} }}
time = {{ end = 100, step = 5e-3 }}
[[material]]
name = "jelly"
law = "neo_hookean"
density = 100
parameters = {{ young_modulus = 1e4, poisson_ratio = 0.3 }}
[[body]]
name = "bed"
material = "jelly"
shape = {{ box = {{ min = [-1, -1, -16], max = [1, 1, -15] }} }}
settled = true
[[robot]]
name = "chain"
urdf = "chain.urdf"
position = [0, 0, 0]
joints = {{ "*" = 0.6 }}
motor = [{{ armature = 0 }}]
{more}
"#
    );
    Scene::from_str(&text, "chain.toml", folder).expect("a sound scene")
}

/// Kinetic energy of some bodies, and that with the potential one [J].
pub fn energies(bodies: &[BodyState]) -> [f64; 2] {
    let kinetic: f64 = bodies.iter().map(|body| body.kinetic_energy).sum();
    [kinetic, kinetic + bodies.iter().map(|body| body.potential_energy).sum::<f64>()]
}

/// Tools over a soft bed in a world of 2 m along x, which is periodic, without gravity: each at so much x and with a motion. A robot is far off.
pub fn round_world(tools: &[(f64, &str)]) -> Scene {
    let mut text = r#"
name = "round"
gravity = [0, 0, 0]
world = { cell = 0.0625, min = [-1, -0.5, -1], max = [1, 0.5, 1], walls = { x_min = "periodic", x_max = "periodic", z_min = "stick" } }
time = { end = 2, step = 1e-3 }
[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000
parameters = { young_modulus = 1e4, poisson_ratio = 0.3 }
[[body]]
name = "bed"
material = "jelly"
shape = { box = { min = [-1, -0.5, -1], max = [1, 0.5, -0.75] } }
"#
    .to_owned();
    text += "[[robot]]\nname = \"arm\"\nmodel = \"arm\"\nfixed = true\nposition = [0, 3, 0]\n";
    for (i, (x, motion)) in tools.iter().enumerate() {
        text += &format!(
            "[[tool]]\nname = \"ball{i}\"\nshape = {{ sphere = {{ radius = 0.1 }} }}\nposition = [{x}, 0, 0]\nmotion = {motion}\n"
        );
    }
    scene(&text)
}
