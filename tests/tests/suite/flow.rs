//! Sources and sinks: what comes in and goes out, and what is left of it.

use barchan::worlds::Worlds;
use barchan::{Options, Precision, Scene, Simulation};
use barchan_tests::scenes::{everywhere, left, options, rows, run_to, scene, simulation, within};

/// Sand that leaves a mouth of 8 by 8 particles downwards, 0.5 m above a sink.
const HEAD: &str = r#"
name = "stream"
world = { cell = 0.02, min = [0, 0, 0], max = [0.2, 0.2, 0.64] }
time = { end = 1 }
material = [{ name = "sand", law = "sand", density = 1600, parameters = { young_modulus = 1e5, friction_angle_deg = 30 } }]
"#;
const MOUTH: &str = r#"
[[source]]
name = "mouth"
material = "sand"
shape = { box = { half = [0.04, 0.04, 0.01], center = [0.1, 0.1, 0.58] } }
velocity = [0, 0, -1]
"#;
const DRAIN: &str = r#"
[[sink]]
name = "drain"
shape = { box = { min = [0, 0, 0], max = [0.2, 0.2, 0.1] } }
"#;
/// Particles of a layer, seconds between layers, mass of a particle [kg].
const LAYER: (u64, f64, f64) = (64, 0.01, 1600.0 * 1e-6);

fn stream() -> String {
    [HEAD, MOUTH, DRAIN].concat()
}

fn start(text: &str, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(text), options).unwrap_or_else(|e| panic!("{e}"))
}

fn is_near(what: &str, measured: f64, expected: f64, relative: f64) {
    within(what, (measured - expected).abs() / expected.abs(), relative);
}

/// What comes in is the rate times the time, to the particle. What fell d below the mouth has v² = v0² + 2 g d, and what is between two heights is the rate
/// times the time from one to the other. Mass, momentum and energy are what came in and what gravity gave, minus what went out.
#[test]
fn a_stream_comes_in_at_its_rate_falls_freely_and_closes_the_ledger() {
    let (each, period, mass) = LAYER;
    for options in everywhere() {
        let what = format!("{} {}", options.backend, options.precision);
        let mut s = start(&stream(), &options);
        assert_eq!(s.particle_count(), 0);
        run_to(&mut s, 0.405);
        let ledger = s.ledger();
        assert_eq!(ledger.sources.particles, 41 * each, "{what}: layers at 0, 0.01, … 0.4 s");
        assert!(ledger.sinks.particles > 0, "{what}: nothing has gone");
        assert_eq!(ledger.particles, ledger.sources.particles - ledger.sinks.particles, "{what}");
        let f32s = 1e-6;
        is_near(&format!("{what} mass in"), ledger.sources.mass, 41.0 * each as f64 * mass, f32s);
        is_near(&format!("{what} mass"), ledger.mass, ledger.sources.mass - ledger.sinks.mass, 1e-12);
        let momentum = ledger.sources.momentum[2] + ledger.gravity_impulse[2] - ledger.sinks.momentum[2];
        is_near(&format!("{what} momentum"), ledger.momentum[2], momentum, 1e-4);
        is_near(&format!("{what} energy"), ledger.energy(), ledger.sources.energy - ledger.sinks.energy, 2e-2);
        let g = 9.81_f64;
        let speed = |depth: f64| (1.0 + 2.0 * g * depth).sqrt();
        let own = rows(&s).into_iter().map(|row| (row.v[2] / -speed(0.58 - row.x[2]) - 1.0).abs());
        let own: Vec<f64> = own.collect();
        within(&format!("{what} speed, on average"), own.iter().sum::<f64>() / own.len() as f64, 0.01);
        within(&format!("{what} speed of any"), own.iter().copied().fold(0.0, f64::max), 0.06);
        let between = rows(&s).iter().filter(|row| (0.2..0.5).contains(&row.x[2])).map(|row| row.m).sum::<f64>();
        let expected = each as f64 * mass / period * (speed(0.38) - speed(0.08)) / g;
        within(&format!("{what} mass on the way, in layers"), (between - expected).abs() / (each as f64 * mass), 1.0);
    }
}

/// Below what the mouth lets through, layers have gaps; a limit and an end stop it. All to the particle.
#[test]
fn a_rate_a_limit_and_an_end_are_held_to_the_particle() {
    let (each, period, mass) = LAYER;
    let came = |keys: &str, time: f64| {
        let mut s = simulation(&[HEAD, MOUTH, keys, DRAIN].concat(), Precision::F32);
        run_to(&mut s, time);
        s.ledger().sources.particles
    };
    let rate = 2.9;
    let due = (21.0 * period * rate / mass) as u64;
    for sampling in ["auto", "lattice", "stagger", "jitter"] {
        assert_eq!(came(&format!("mass_rate = 2.9\nsampling = \"{sampling}\"\n"), 0.205), due, "{sampling}");
    }
    assert_eq!(came(&format!("volume_rate = {}\n", rate / 1600.0), 0.205), due);
    assert_eq!(came("limit = 0.5\n", 0.205), (0.5 / mass) as u64);
    assert_eq!(came("from = 0.05\nuntil = 0.1\n", 0.205), 5 * each, "layers at 0.05, 0.06, … 0.09 s");
}

/// A closed box with a mouth in its lid: sources stop when it is full, and say so. A tool over half of a mouth holds back half of what is due.
#[test]
fn a_source_waits_where_there_is_no_room() {
    let walls = "x_min = \"slip\", x_max = \"slip\", y_min = \"slip\", y_max = \"slip\", z_min = \"slip\"";
    let head = HEAD.replace(
        "min = [0, 0, 0], max = [0.2, 0.2, 0.64]",
        &format!("min = [0.04, 0.04, 0.44], max = [0.16, 0.16, 0.64], walls = {{ {walls} }}, leaving = \"delete\""),
    );
    let mut s = simulation(&[&head, MOUTH].concat(), Precision::F32);
    run_to(&mut s, 0.805);
    let ledger = s.ledger();
    let holds = 0.12 * 0.12 * 0.2 * 1600.0;
    println!(
        "{} kg in a box of {holds} kg, {} held back",
        ledger.mass, ledger.counts["particles that sources held back"]
    );
    assert!(ledger.mass < holds && ledger.mass > 0.4 * holds);
    assert_eq!(ledger.sources.particles + ledger.counts["particles that sources held back"], 81 * LAYER.0);

    let tool =
        "[[tool]]\nname = \"lid\"\nshape = { box = { half = [0.04, 0.1, 0.02] } }\nposition = [0.06, 0.1, 0.58]\n";
    let mut s = simulation(&[&stream(), tool].concat(), Precision::F32);
    run_to(&mut s, 0.005);
    let ledger = s.ledger();
    assert_eq!([ledger.sources.particles, ledger.counts["particles that sources held back"]], [LAYER.0 / 2; 2]);
}

/// A heap under a source on nested, subcycled levels around a rod, with a sink beside: the hardest setting that sources and sinks can be in.
fn heap() -> String {
    let walls = "walls = { x_min = \"slip\", x_max = \"slip\", y_min = \"slip\", y_max = \"slip\", z_min = \"stick\" }";
    let head = HEAD.replace("max = [0.2, 0.2, 0.64] }", &format!("max = [0.64, 0.64, 0.64], {walls} }}"));
    let rest = r#"
[[source]]
material = "sand"
shape = { cylinder = { center = [0.32, 0.2, 0.24], radius = 0.05, half_height = 0.02 } }
velocity = [0, 0.3, -1]
mass_rate = 5
sampling = "jitter"
[[sink]]
shape = { box = { min = [0.24, 0.24, 0], max = [0.4, 0.4, 0.16] } }
from = 0.05
[levels]
count = 2
half = 8
subcycle = true
[[tool]]
name = "rod"
shape = { sphere = { radius = 0.03 } }
position = [0.32, 0.25, 0.12]
motion = { velocity = { linear = [0, 0.4, 0] } }
[[body]]
material = "sand"
shape = { box = { min = [0, 0, 0], max = [0.64, 0.64, 0.08] } }
"#;
    head + rest
}

/// Work is cut by blocks, and what flows by time and step: so threads and interruptions change no bit, and numbers of particles stay unique. On a device, too.
#[test]
fn threads_and_snapshots_change_no_bit_of_what_flows() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("flow.snapshot");
    let registry = barchan::registry();
    for (text, steps) in [(stream(), 260), (heap(), 80)] {
        for (backend, precision) in [("cpu", Precision::F32), ("cpu", Precision::F64), ("wgpu", Precision::F32)] {
            let with = |threads| Options { threads, backend: backend.to_owned(), ..options(precision) };
            let go = |s: &mut Simulation, count: usize| {
                let mut taken = 0;
                while taken < count {
                    taken += s.steps(count - taken, f64::INFINITY).unwrap_or_else(|e| panic!("{e}")).len();
                }
            };
            let mut whole = start(&text, &with(1));
            go(&mut whole, steps);
            let ledger = whole.ledger();
            println!("{} in, {} out", ledger.sources.particles, ledger.sinks.particles);
            assert!(ledger.sources.particles > 0 && ledger.sinks.particles > 0);
            is_near(
                "mass",
                ledger.mass,
                ledger.sources.mass - ledger.sinks.mass + start(&text, &with(1)).ledger().mass,
                1e-6,
            );
            let mut ids: Vec<u64> = rows(&whole).iter().map(|row| row.id).collect();
            ids.dedup();
            assert_eq!(ids.len(), whole.particle_count(), "numbers of particles are unique");
            let mut parts = start(&text, &with(2));
            go(&mut parts, steps / 2 + 1);
            parts.save(&file).unwrap();
            let mut parts = Simulation::resume(&registry, &file, &with(2)).unwrap();
            go(&mut parts, steps - steps / 2 - 1);
            assert!(left(&whole) == left(&parts), "{backend} {precision}: two threads and a snapshot");
            assert_eq!(format!("{ledger:?}"), format!("{:?}", parts.ledger()));
        }
    }
}

/// A world of a batch, each with its own source, is the world alone; on a device too.
#[test]
fn worlds_of_a_batch_have_sources_of_their_own() {
    let registry = barchan::registry();
    let of = |world: usize| -> Scene { scene(&[HEAD, MOUTH, &format!("mass_rate = {}\n", 3 + world), DRAIN].concat()) };
    for options in [options(Precision::F32), Options { backend: "wgpu".to_owned(), ..options(Precision::F32) }] {
        let options = Options { threads: 2, ..options };
        let mut worlds = Worlds::new(&registry, (0..2).map(of).collect(), &options).unwrap();
        (0..80).for_each(|_| worlds.step().into_iter().for_each(|report| drop(report.unwrap())));
        for (w, world) in worlds.iter().enumerate() {
            let ledger = world.ledger();
            let layers = (world.time() / LAYER.1).floor();
            assert!(layers >= 2.0, "the test must see layers");
            let least = (layers * LAYER.1 * (3 + w) as f64 / LAYER.2).floor();
            assert!(
                (ledger.sources.particles as f64 - least).abs() <= LAYER.0 as f64,
                "{}: world {w}",
                options.backend
            );
            is_near("mass", ledger.mass, ledger.sources.mass - ledger.sinks.mass, 1e-12);
        }
    }
}

#[test]
fn sources_and_sinks_that_cannot_be_are_refused_by_name() {
    let refusal = |text: &str| match Scene::from_str(text, "test", ".") {
        Err(error) => error.to_string(),
        Ok(scene) => match Simulation::new(&barchan::registry(), &scene, &Options::default()) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("is not refused: {text}"),
        },
    };
    let with = |old: &str, new: &str| {
        assert!(stream().contains(old));
        refusal(&stream().replace(old, new))
    };
    let reach = "[levels]\ncount = 2\nreach = 4\n[[tool]]\nname = \"rod\"\nshape = { sphere = { radius = 0.03 } }\nposition = [0.1, 0.1, 0.1]\nmotion = { velocity = {} }\n[[sink]]";
    for (error, parts) in [
        (with("velocity = [0, 0, -1]", "velocity = [0, 0, 0]"), ["source[0].velocity", "is zero"]),
        (with("velocity = [0, 0, -1]", "velocity = [0, 0, -1]\nmass_rate = 11"), ["source[0].mass_rate", "10.24"]),
        (with("velocity = [0, 0, -1]", "velocity = [0, 0, -1]\nlimit = 1e-5"), ["source[0].limit", "none would come"]),
        (
            with("velocity = [0, 0, -1]", "velocity = [0, 0, -1]\nmass_rate = 1\nvolume_rate = 1"),
            ["volume_rate", "one of"],
        ),
        (with("center = [0.1, 0.1, 0.58]", "center = [0.1, 0.1, 0.68]"), ["source[0].shape", "out of the world"]),
        (with("half = [0.04, 0.04, 0.01]", "half = [0.002, 0.04, 0.01]"), ["source[0].shape", "no point"]),
        (with("material = \"sand\"\nshape", "material = \"snad\"\nshape"), ["source[0].material", "snad"]),
        (with("max = [0.2, 0.2, 0.1]", "max = [0.2, 0.2, 0.05]"), ["sink[0].shape", "0.08 m thick"]),
        (with("[[sink]]", "[[sink]]\nfrom = 2\nuntil = 1"), ["sink[0].until", "later"]),
        (with("[[sink]]", reach), ["source[0]", "levels.reach"]),
        (with("time = { end = 1 }", "time = { end = 1e12 }"), ["memory for what sources", "source.limit"]),
    ] {
        println!("{error}");
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    }
}
