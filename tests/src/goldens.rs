//! States that must stay as they are: small scenes, and a hash of what a run of each leaves.
//!
//! `golden/states.txt` holds the hashes for each [`key`]: what computes them to the last bit. The example `goldens` compares, and writes it anew.

use crate::long_cases::furrow_scene;
use crate::scenes::{rows, scene};
use crate::sketch::{Head, bed, block, box_mesh, damped, driven, half, material, tool};
use crate::sleeping;
use barchan::worlds::Worlds;
use barchan::{Options, Precision, Result, Simulation};
use barchan_core::backend::Adapter;
use barchan_lanes::Isa;
use fnv::FnvHasher;
use std::collections::BTreeMap;
use std::hash::Hasher;
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
    let falling_of = |law: &str, material: String| {
        let walls = "x_min = \"slip\"\ny_min = { separate = { friction = 0.3 } }\nz_min = \"stick\"";
        let shape =
            block(law, [0.1, 0.1, 0.1], [0.4, 0.35, 0.4], "velocity = [-0.5, 0.3, -1.0]\nsampling = \"jitter\"");
        Head::cells(cell, [16, 16, 16], walls).time("safety = 0.5").with(&[material, shape])
    };
    let falling = |law: &str, parameters: &str| falling_of(law, material(law, 1000.0, parameters));
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
    let damped = damped("hencky", 1000.0, "young_modulus = 1e5", 1e-3);
    // The blade keeps one end of the bed awake while the other falls asleep.
    let stir = tool("blade", [0.08, 0.08, 0.12], &half([0.03, 0.04, 0.03]), grip, &driven([0.1, 0.0, -0.05]));
    let asleep = sleeping::bed([24, 8, 6], "sand", sleeping::SAND, "on = true\nspeed = 1e-2", &[stir]);
    let worlds = [0.4, 0.6, 0.9].map(|speed| of_sand(&[blade(speed)]));
    vec![
        ("fixed corotated", vec![falling("fixed_corotated", "young_modulus = 1e5")]),
        ("Hencky", vec![falling("hencky", "young_modulus = 1e5")]),
        ("liquid", vec![falling("liquid", "")]),
        ("neo-Hookean", vec![falling("neo_hookean", "young_modulus = 1e5")]),
        ("sand", vec![falling("sand", "young_modulus = 1e5")]),
        ("snow", vec![falling("snow", "young_modulus = 1e5")]),
        ("von Mises", vec![falling("von_mises", "young_modulus = 1e5")]),
        ("damping", vec![falling_of("hencky", damped)]),
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
        ("worlds", worlds.to_vec()),
    ]
}

/// What a backend can run on.
///
/// # Errors
/// If there is no such backend.
pub fn adapters(backend: &str) -> Result<Vec<Adapter>> {
    Ok(barchan::registry().backend(backend)?.adapters().unwrap_or_default())
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
    let mut sum = FnvHasher::default();
    if let [text] = worlds {
        add(&mut sum, &run(text, options)?);
    } else {
        let mut worlds = Worlds::new(&barchan::registry(), worlds.iter().map(|text| scene(text)).collect(), options)?;
        for _ in 0..STEPS {
            worlds.step().into_iter().try_for_each(|report| report.map(drop))?;
        }
        worlds.iter().for_each(|world| add(&mut sum, world));
    }
    Ok(sum.finish())
}

/// What computes hashes: the backend with its precision, on a GPU the adapter and its driver, and the instruction set.
///
/// # Errors
/// If the environment asks for an instruction set that there is not, or the backend has nothing to run on.
pub fn key(options: &Options) -> std::result::Result<String, String> {
    let isa = Isa::current().map_err(|e| e.to_string())?.name();
    if options.backend == "cpu" {
        return Ok(format!("cpu, {:?}, {isa}", options.precision));
    }
    let adapters = adapters(&options.backend).map_err(|e| e.to_string())?;
    let first = adapters.first().ok_or_else(|| format!("no adapter for {}", options.backend))?;
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

/// Adds everything that a run leaves to a hash.
fn add(sum: &mut FnvHasher, simulation: &Simulation) {
    let mut add = |bits: u64| sum.write(&bits.to_le_bytes());
    add(simulation.time().to_bits());
    for row in rows(simulation) {
        add(row.id);
        add(row.level.into());
        let own = row.x.into_iter().chain(row.v).chain(row.c).chain([row.m, row.volume0]);
        own.chain(row.strain).chain(row.state).for_each(|value| add(value.to_bits()));
    }
    for body in simulation.bodies() {
        let pose = body.position.into_iter().chain(body.rotation);
        pose.chain(body.velocity).chain(body.angular_velocity).for_each(|value| add(value.to_bits()));
    }
    for wrench in simulation.wrenches() {
        wrench.force.into_iter().chain(wrench.torque).for_each(|value| add(value.to_bits()));
    }
}
