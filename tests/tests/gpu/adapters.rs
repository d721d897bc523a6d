//! What adapters are asked for and refused, and what happens when one is lost or does too little.

use super::{apart, column, cpu, dropped, followed, gpu, jelly, on_gpu, take};
use barchan::scene::Scene;
use barchan::{Backend, Error, Form, Options, ParticleState, Plan, Precision, Registry, Simulation, Stage};
use barchan_tests::scenes::{rows, scene, within};
use barchan_tests::sketch::{Head, block, material};
use barchan_wgpu::device::Offer;
use barchan_wgpu::{Wgpu, device};
use std::sync::Arc;

/// The same input gives the same bits, also where particles crowd and leave their cells.
#[test]
fn the_same_adapter_gives_the_same_bits() {
    let run = || {
        let mut sim = gpu(&column());
        take(&mut sim, 150);
        rows(&sim)
    };
    assert!(run() == run(), "two runs differ");
}

/// What WebGPU promises everywhere is enough: eight storage buffers a stage, bindings of 128 MiB, no features; with the same bits. What
/// does not fit into that is refused, with the cap.
#[test]
fn the_poorest_adapter_gives_the_same_bits_or_says_what_does_not_fit() {
    let on = |offer: Offer, toml: &str, change: fn(&mut ParticleState)| {
        let sim = cpu(toml);
        let plan = Plan { precision: Precision::F32, ..sim.plan().clone() };
        let mut particles = sim.particles();
        change(&mut particles);
        Wgpu { offer, device: None }.compile(&plan, particles)
    };
    let run = |offer: Offer| {
        let mut engine = on(offer, &column(), |_| ()).unwrap();
        for step in 0..40 {
            engine.step(f64::from(step) * 2e-4, 2e-4, &mut []).unwrap();
        }
        engine.download().lists
    };
    assert!(run(Offer::Least) == run(Offer::All), "they differ");
    // What binds most: levels with steps of their own, walls, a tool, and ground that sleeps.
    let run = |offer: Offer| {
        let (registry, options) = held(Wgpu { offer, device: None });
        let mut scene = followed(0, true, false);
        scene.sleep.on = Some(true);
        let mut sim = Simulation::new(&registry, &scene, &options).unwrap();
        take(&mut sim, 5);
        sim.particles().lists
    };
    assert!(run(Offer::Least) == run(Offer::All), "they differ on levels");

    // One particle a block: blocks are what costs.
    let grains = Head::space(0.01).time("step = 1e-4").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("hencky", [0.0; 3], [0.27; 3], "spacing = 0.01"),
    ]);
    let spread = |particles: &mut ParticleState| particles.lists[0].cell.iter_mut().flatten().for_each(|c| *c *= 4);
    let refused = on(Offer::Least, &grains, spread).map(|_| ()).unwrap_err().to_string();
    assert!(refused.contains("nodes and tiles") && refused.contains("134217728"), "{refused}");
}

/// Symptom: an adapter refused a large bed after it had been seeded for a minute. What cannot fit is refused at once: no machine could seed these. Planes
/// that stand apart let an adapter hold as many particles as fit into one plane, six times those that fit into one binding of all.
#[test]
fn what_cannot_fit_is_refused_before_anything_is_seeded() {
    let bed = Head::cells(0.01, [4000, 4000, 400], "z_min = \"stick\"").time("step = 1e-5").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("hencky", [0.0; 3], [40.0, 40.0, 3.0], ""),
    ]);
    let options = Options { max_bytes: Some(u64::MAX), ..on_gpu() };
    let Err(error) = Simulation::new(&barchan::registry(), &scene(&bed), &options) else { panic!("38.4 billion fit") };
    let Error::Capacity { what: "particles on the adapter, about", asked, cap, mend } = error else {
        panic!("{error}")
    };
    assert!((asked as f64 / 3.84e10 - 1.0).abs() < 1e-9, "{asked} of 38.4 billion particles");
    assert!(mend.contains("--adapter"), "{mend}");
    // A symmetric strain and the volume take two vectors.
    let most = |offer: Offer| Wgpu { offer, device: None }.most_particles(None, 6).unwrap().unwrap();
    assert_eq!(cap, most(Offer::All));
    // 128 MiB of six vectors each.
    assert_eq!(most(Offer::Least), (128 << 20) / 96 / 128 * 128);
    let gpu = device::open(None).unwrap();
    if gpu.limits.max_storage_buffers_per_shader_stage >= 20 {
        assert_eq!(cap, gpu.limits.max_storage_buffer_binding_size.min(gpu.limits.max_buffer_size) / 16 / 128 * 128);
    }
}

fn refusal(toml: &str, precision: Precision) -> String {
    let options = Options { backend: "wgpu".into(), precision, ..Options::default() };
    let made = scene_of(toml).and_then(|scene| Simulation::new(&barchan::registry(), &scene, &options));
    made.map(drop).unwrap_err().to_string()
}

fn scene_of(toml: &str) -> barchan::Result<Scene> {
    Scene::from_str(toml, "test scene", std::path::Path::new("."))
}

/// What it cannot do is refused by name, with what would mend it.
#[test]
fn what_it_lacks_is_refused_by_name() {
    let error = refusal(&jelly(""), Precision::F64);
    assert!(error.contains("wgpu") && error.contains("64-bit") && error.contains("cpu"), "{error}");
}

/// A particle that leaves the world stops the run with its name, and so does a number that is not one.
#[test]
fn faults_carry_the_particle_and_the_place() {
    let toml = Head::cells(0.02, [12; 3], "").time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.2"),
        block("hencky", [0.06; 3], [0.12; 3], "velocity = [4.0, 0.0, 0.0]"),
    ]);
    let mut sim = gpu(&toml);
    let error = (0..200).find_map(|_| sim.step().err()).expect("it flies out").to_string();
    assert!(error.contains("left the world") && error.contains("world.leaving"), "{error}");

    let mut sim = gpu(&toml);
    take(&mut sim, 3);
    let mut state = sim.particles();
    let id = state.lists[0].id[5];
    state.lists[0].velocity[5][1] = f64::NAN;
    sim.set_particles(state).unwrap();
    let error = sim.step().unwrap_err().to_string();
    assert!(error.contains("velocity") && error.contains(&format!("particle {id} ")), "{error}");
}

/// The backend under another name, with a device that the test holds too.
struct Held(Wgpu);

impl Backend for Held {
    fn name(&self) -> &str {
        "held"
    }
    fn doc(&self) -> &str {
        self.0.doc()
    }
    fn has_form(&self, stage: Stage, form: Form) -> bool {
        self.0.has_form(stage, form)
    }
    fn check(&self, plan: &Plan) -> barchan::Result<()> {
        self.0.check(plan)
    }
    fn compile(&self, plan: &Plan, particles: ParticleState) -> barchan::Result<Box<dyn barchan::Engine>> {
        self.0.compile(plan, particles)
    }
}

/// What a simulation runs on, with that backend registered.
pub(super) fn held(backend: Wgpu) -> (Registry, Options) {
    let mut registry = barchan::registry();
    registry.add_backend(Arc::new(Held(backend))).unwrap();
    (registry, Options { backend: "held".into(), ..on_gpu() })
}

/// Symptom guarded against: a device that is lost in the middle of a run takes the last snapshot with it, as an empty one is saved over it. The
/// error says what happened and what to do; the snapshot stays, and a run goes on from it, on a new device as it would have on the old one.
#[test]
fn a_device_that_is_lost_leaves_the_last_snapshot() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    let scenes = [scene(&column()), dropped(0), followed(0, true, false)];
    for scene in scenes {
        let gpu = Arc::new(device::open(None).unwrap());
        let (registry, options) = held(Wgpu { device: Some(Arc::clone(&gpu)), ..Wgpu::default() });
        let mut sim = Simulation::new(&registry, &scene, &options).unwrap();
        take(&mut sim, 10);
        sim.save(&file).unwrap();
        let kept = std::fs::read(&file).unwrap();
        let there = rows(&sim);
        gpu.device.destroy();
        for error in [sim.step().unwrap_err(), sim.step().unwrap_err(), sim.save(&file).unwrap_err()] {
            let text = error.to_string();
            assert!(matches!(error, barchan::Error::Device { .. }), "{text}");
            assert!(text.contains("lost") && text.contains("resume from the last snapshot"), "{text}");
        }
        assert!(sim.step_count() == 10 && std::fs::read(&file).unwrap() == kept, "the snapshot has changed");
        let mut resumed = Simulation::resume(&barchan::registry(), &file, &on_gpu()).unwrap();
        assert_eq!(resumed.step_count(), 10);
        assert!(rows(&resumed) == there, "particles have changed");
        take(&mut resumed, 5);
    }
}

/// Ground that flies apart until its directory does not fit the adapter any more: the error says what does not fit and what to do, the state
/// before the step is saved, and the backend cpu goes on from there.
#[test]
fn what_outgrows_the_adapter_in_the_middle_of_a_run_can_go_on_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    let far = Head { gravity: [0.0; 3], min: [-20.0; 3], max: [20.0; 3], ..Head::space(0.02) };
    let away = |velocity: f64| format!("velocity = [{velocity:?}, {velocity:?}, {velocity:?}]");
    let toml = far.time("step = 1e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
        block("hencky", [-9.9; 3], [-9.86; 3], &away(-8.0)),
        block("hencky", [9.86; 3], [9.9; 3], &away(8.0)),
    ]);
    let (registry, options) = held(Wgpu { offer: Offer::Least, device: None });
    let mut sim = Simulation::new(&registry, &scene(&toml), &options).unwrap();
    let error = (0..200).find_map(|_| sim.step().err()).expect("it does not fit for ever");
    let text = error.to_string();
    assert!(matches!(error, barchan::Error::Capacity { .. }), "{text}");
    assert!(text.contains("directory of blocks") && text.contains("use the backend cpu"), "{text}");
    println!("{text} after {} steps", sim.step_count());
    assert!(sim.step_count() > 10);
    sim.save(&file).unwrap();
    let on_cpu = Options { backend: "cpu".into(), ..on_gpu() };
    let mut resumed = Simulation::resume(&barchan::registry(), &file, &on_cpu).unwrap();
    assert_eq!(resumed.step_count(), sim.step_count());
    within("distance of particles, in cells", apart(&rows(&resumed), &rows(&sim)) / 0.02, 1e-6);
    take(&mut resumed, 20);
}
