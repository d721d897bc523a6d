//! States that must stay as they are: small scenes, and a hash of what a run of each leaves.
//!
//! `golden/states.txt` holds the hashes for each [`key`]: what computes them to the last bit. The example `goldens` compares, and writes it anew.

use crate::long_cases::furrow_scene;
use crate::scenes::{rows, scene};
use crate::sketch::{Head, bed, block, box_mesh, damped, driven, half, material, tool};
use crate::sleeping;
use barchan::worlds::Worlds;
use barchan::{Options, Precision, Result, Simulation};
use barchan_lanes::Isa;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Steps that are taken in each scene.
const STEPS: usize = 200;

/// Hashes by key and name of the scene.
pub type Hashes = BTreeMap<(String, String), u64>;

/// What the hashes are kept in.
pub fn file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/states.txt")
}

/// The scenes by name, each as the texts of its worlds. Meshes are written into `folder`.
pub fn scenes(folder: &Path) -> Vec<(&'static str, Vec<String>)> {
    let cell = 0.05;
    let falling = |law: &'static str, parameters: &str| {
        let walls = "x_min = \"slip\"\ny_min = { separate = { friction = 0.3 } }\nz_min = \"stick\"";
        let shape =
            block(law, [0.1, 0.1, 0.1], [0.4, 0.35, 0.4], "velocity = [-0.5, 0.3, -1.0]\nsampling = \"jitter\"");
        Head::cells(cell, [16, 16, 16], walls).time("safety = 0.5").with(&[material(law, 1000.0, parameters), shape])
    };
    let of_sand = |more: &[String]| {
        let (head, mut parts) = bed(cell, [16, 8], 4, 12, "young_modulus = 1e5, friction_angle_deg = 30");
        parts.extend_from_slice(more);
        head.with(&parts)
    };
    let grip = "{ coulomb = { friction = 0.4 } }";
    let blade =
        |speed: f64| tool("blade", [0.25, 0.2, 0.2], &half([0.06, 0.1, 0.08]), grip, &driven([speed, 0.1, -0.2]));
    let free = |name: &str, shape: &str, x: f64| {
        tool(name, [x, 0.2, 0.3], shape, grip, "{ free = { mass = 2, linear = [0.3, 0, -1], angular = [1, 2, 0] } }")
    };
    // Three levels of which the blade's box leaves the bed's ends to the coarser ones.
    let levels = |more: &str| {
        let (head, mut parts) = bed(0.02, [64, 32], 8, 24, "young_modulus = 1e5, friction_angle_deg = 30");
        parts.push(format!("[levels]\ncount = 3\nhalf = 8\n{more}"));
        parts.push(tool("blade", [0.4, 0.32, 0.18], &half([0.03, 0.06, 0.05]), grip, &driven([1.5, 0.2, -0.3])));
        head.with(&parts)
    };
    let mesh = format!("mesh = {{ file = {:?} }}", box_mesh(folder, [0.1, 0.06, 0.05]));
    let damped_fall = falling("hencky", "young_modulus = 1e5").replace(
        &material("hencky", 1000.0, "young_modulus = 1e5"),
        &damped("hencky", 1000.0, "young_modulus = 1e5", 1e-3),
    );
    // The blade keeps one end of the bed awake while the other falls asleep.
    let stir = tool("blade", [0.08, 0.08, 0.12], &half([0.03, 0.04, 0.03]), grip, &driven([0.1, 0.0, -0.05]));
    let asleep = sleeping::bed([24, 8, 6], "sand", sleeping::SAND, "on = true\nspeed = 1e-2", &[stir]);
    let worlds = [0.4, 0.6, 0.9].map(|speed| of_sand(&[blade(speed)]));
    let mut all = vec![
        ("fixed corotated", vec![falling("fixed_corotated", "young_modulus = 1e5")]),
        ("Hencky", vec![falling("hencky", "young_modulus = 1e5")]),
        ("liquid", vec![falling("liquid", "")]),
        ("neo-Hookean", vec![falling("neo_hookean", "young_modulus = 1e5")]),
        ("sand", vec![falling("sand", "young_modulus = 1e5")]),
        ("snow", vec![falling("snow", "young_modulus = 1e5")]),
        ("von Mises", vec![falling("von_mises", "young_modulus = 1e5")]),
        ("damping", vec![damped_fall]),
        ("driven tool", vec![of_sand(&[blade(0.5)])]),
        (
            "free bodies",
            vec![of_sand(&[free("ball", "sphere = { radius = 0.08 }", 0.3), free("box", &half([0.06; 3]), 0.6)])],
        ),
        ("mesh", vec![of_sand(&[free("stone", &mesh, 0.4)])]),
        ("levels", vec![levels("")]),
        ("levels with steps of their own", vec![levels("subcycle = true\n")]),
        ("sleep", vec![asleep]),
        ("unbounded ground", vec![furrow_scene(5.12, 2.56)]),
    ];
    all.push(("worlds", worlds.to_vec()));
    all
}

/// Runs a scene of one world.
///
/// # Errors
/// Those of the run.
pub fn run(text: &str, options: &Options) -> Result<Simulation> {
    let mut simulation = Simulation::new(&barchan::registry(), &scene(text), options)?;
    let mut taken = 0;
    while taken < STEPS {
        taken += simulation.steps(STEPS - taken, f64::INFINITY)?.len();
    }
    Ok(simulation)
}

/// A hash of everything that a run of these worlds leaves: particles, bodies, wrenches, time.
///
/// # Errors
/// Those of the run.
pub fn hash(worlds: &[String], options: &Options) -> Result<u64> {
    let mut sum = Fnv::default();
    if let [text] = worlds {
        sum.take_in(&run(text, options)?);
    } else {
        let mut worlds = Worlds::new(&barchan::registry(), worlds.iter().map(|text| scene(text)).collect(), options)?;
        for _ in 0..STEPS {
            worlds.step().into_iter().try_for_each(|report| report.map(drop))?;
        }
        worlds.iter().for_each(|world| sum.take_in(world));
    }
    Ok(sum.0)
}

/// What computes hashes: the backend with its precision, on a GPU the adapter and its driver, and the instruction set.
///
/// # Errors
/// If the environment asks for an instruction set that there is not.
pub fn key(options: &Options) -> std::result::Result<String, String> {
    let isa = Isa::current().map_err(|e| e.to_string())?.name();
    if options.backend == "cpu" {
        return Ok(format!("cpu, {:?}, {isa}", options.precision));
    }
    let registry = barchan::registry();
    let adapters = registry.backends().find(|b| b.name() == options.backend).and_then(|backend| backend.adapters());
    let first = adapters.into_iter().flatten().next().ok_or(format!("no adapter for {}", options.backend))?;
    // Of what an adapter says of itself, up to what it offers.
    let driver = first.doc.split("), ").next().unwrap_or_default();
    Ok(format!("{}, {}, {driver}), {isa}", options.backend, first.name))
}

/// Hashes of all scenes on a backend, in each precision that it has, with the process's instruction set.
///
/// # Errors
/// Those of [`key`] and [`hash`], with the scene's name.
pub fn compute(backend: &str, folder: &Path) -> std::result::Result<Hashes, String> {
    let precisions = if backend == "cpu" { &[Precision::F32, Precision::F64][..] } else { &[Precision::F32] };
    let mut all = Hashes::new();
    for &precision in precisions {
        let options = Options { backend: backend.into(), precision, threads: 2, ..Options::default() };
        let key = key(&options)?;
        for (name, worlds) in scenes(folder) {
            let hash = hash(&worlds, &options).map_err(|error| format!("{key}, {name}: {error}"))?;
            all.insert((key.clone(), name.to_owned()), hash);
        }
    }
    Ok(all)
}

/// One line each: key, scene and hash.
pub fn lines(hashes: &Hashes) -> String {
    hashes.iter().map(|((key, name), hash)| format!("{key} | {name} | {hash:016x}\n")).collect()
}

/// Hashes out of lines; others are passed over.
pub fn read(text: &str) -> Hashes {
    let hash_of = |line: &str| {
        let mut parts = line.split(" | ");
        let (key, name, hash) = (parts.next()?, parts.next()?, parts.next()?);
        Some(((key.to_owned(), name.to_owned()), u64::from_str_radix(hash.trim(), 16).ok()?))
    };
    text.lines().filter_map(hash_of).collect()
}

/// The hash FNV-1a, 64 bits.
struct Fnv(u64);

impl Default for Fnv {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv {
    fn add(&mut self, bits: u64) {
        for byte in bits.to_le_bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    fn add_all(&mut self, values: impl IntoIterator<Item = f64>) {
        values.into_iter().for_each(|value| self.add(value.to_bits()));
    }

    fn take_in(&mut self, simulation: &Simulation) {
        self.add_all([simulation.time()]);
        for row in rows(simulation) {
            self.add(row.id);
            self.add(row.level.into());
            self.add_all(row.x.into_iter().chain(row.v).chain(row.c).chain([row.m, row.volume0]));
            self.add_all(row.strain.into_iter().chain(row.state));
        }
        for body in simulation.bodies() {
            self.add_all(
                body.position.into_iter().chain(body.rotation).chain(body.velocity).chain(body.angular_velocity),
            );
        }
        for wrench in simulation.wrenches() {
            self.add_all(wrench.force.into_iter().chain(wrench.torque));
        }
    }
}
