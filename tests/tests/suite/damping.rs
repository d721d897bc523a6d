//! Damping of elastic strain: how fast waves die away, what that dissipates, and that flow is not slowed.

use barchan::{Precision, Simulation};
use barchan_tests::limits::{self, Lie};
use barchan_tests::scenes::{alter, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, PERIODIC, block, damped, material};
use std::f64::consts::PI;

/// Cells in the wave's length, and their width [m].
const LENGTH: u32 = 32;
const H: f64 = 0.05;
const DENSITY: f64 = 1000.0;
/// Speed of the wave's crests [m/s]: of sound by a millionth, so that nothing yields and nothing is bent.
const SPEED: f64 = 3e-5;

/// Laws with parameters by which their p-wave modulus at rest is 1e6 Pa.
const LAWS: [(&str, &str); 7] = [
    ("hencky", "young_modulus = 9e5, poisson_ratio = 0.2"),
    ("neo_hookean", "young_modulus = 9e5, poisson_ratio = 0.2"),
    ("fixed_corotated", "young_modulus = 9e5, poisson_ratio = 0.2"),
    ("von_mises", "young_modulus = 9e5, poisson_ratio = 0.2, yield_stress = 1e3"),
    ("snow", "young_modulus = 9e5, poisson_ratio = 0.2"),
    ("sand", "young_modulus = 9e5, poisson_ratio = 0.2"),
    ("liquid", "bulk_modulus = 1e6, tait_exponent = 1.0"),
];

/// ω of a wave through ground of that modulus [rad/s].
fn omega() -> f64 {
    2.0 * PI / (f64::from(LENGTH) * H) * (1e6 / DENSITY).sqrt()
}

/// A standing wave along z in ground without an end: of pressure, or of shear along x.
fn wave(law: &str, parameters: &str, damping: f64, shear: bool, precision: Precision) -> Simulation {
    let head = Head { gravity: [0.0; 3], ..Head::cells(H, [4, 4, LENGTH], PERIODIC) }.time("safety = 0.3");
    let size = [4.0 * H, 4.0 * H, f64::from(LENGTH) * H];
    let parts = [damped(law, DENSITY, parameters, damping), block(law, [0.0; 3], size, "")];
    let mut sim = simulation(&head.with(&parts), precision);
    alter(&mut sim, |r| {
        r.v = [0.0; 3];
        r.v[if shear { 0 } else { 2 }] = SPEED * (2.0 * PI * r.x[2] / size[2]).sin();
        // Sand bears no tension: it is pressed beforehand.
        if law == "sand" {
            r.strain[..3].fill(1.0 - 2e-4);
        }
    });
    sim
}

/// How much of the wave there is now: its velocity's part of the first shape [m/s].
fn amplitude(sim: &Simulation, shear: bool) -> f64 {
    let rows = rows(sim);
    let size = f64::from(LENGTH) * H;
    2.0 / rows.len() as f64
        * rows.iter().map(|r| r.v[if shear { 0 } else { 2 }] * (2.0 * PI * r.x[2] / size).sin()).sum::<f64>()
}

/// ω [rad/s] and rate of decay [1/s] of a wave over its first `turns` half periods, by where it passes zero and the extremes between.
fn ring(mut sim: Simulation, shear: bool, turns: usize) -> [f64; 2] {
    let (mut zeros, mut peaks) = (Vec::new(), vec![(0.0, 0.0f64)]);
    let mut last = (0.0, amplitude(&sim, shear));
    while zeros.len() <= turns {
        sim.step().unwrap_or_else(|e| panic!("{e}"));
        let now = (sim.time(), amplitude(&sim, shear));
        if now.1 * last.1 <= 0.0 {
            zeros.push(last.0 - last.1 * (now.0 - last.0) / (now.1 - last.1));
            peaks.push((0.0, 0.0));
        }
        let peak = peaks.last_mut().expect("there is one");
        if now.1.abs() > peak.1 {
            *peak = (now.0, now.1.abs());
        }
        last = now;
    }
    // The first peak may be the start, the last is not over.
    let (first, end) = (peaks[1], peaks[turns]);
    let omega = PI * turns as f64 / (zeros[turns] - zeros[0]);
    [omega, (first.1 / end.1).ln() / (PI * (turns - 1) as f64 / omega)]
}

/// Symptom: beds and walls ring for seconds, since nothing damps small strains. Physics: a wave of Kelvin and Voigt's solid follows
/// q'' + β ω² q' + ω² q = 0, so that it dies away as exp(-½ β ω² t); the grid's own losses come on top and are taken off.
#[test]
fn waves_die_away_as_kelvin_and_voigt_say() {
    for (law, parameters) in LAWS {
        let [own, loss] = ring(wave(law, parameters, 0.0, false, Precision::F64), false, 6);
        within(&format!("{law}: ω {own:.2} rad/s, off"), (own / omega() - 1.0).abs(), 0.02);
        for ratio in [0.02, 0.1] {
            let damping = 2.0 * ratio / omega();
            let [_, rate] = ring(wave(law, parameters, damping, false, Precision::F64), false, 6);
            let measured = (rate - loss) / omega();
            println!("{law}: ratio {measured:.4}, without damping {:.5}", loss / omega());
            within(&format!("{law}: damping ratio {ratio}, off"), (measured / ratio - 1.0).abs(), 0.03);
        }
    }
}

/// Waves of shear of the same length are slower, and lose less by ω².
#[test]
fn waves_of_shear_die_away_likewise() {
    for (law, parameters) in [LAWS[0], LAWS[2], LAWS[4], LAWS[5]] {
        let [omega, loss] = ring(wave(law, parameters, 0.0, true, Precision::F64), true, 4);
        let damping = 0.1 / omega;
        let [_, rate] = ring(wave(law, parameters, damping, true, Precision::F64), true, 4);
        let measured = (rate - loss) / omega;
        within(&format!("{law}: ratio {measured:.4}, off"), (measured / 0.05 - 1.0).abs(), 0.03);
    }
}

/// What a wave loses is what the ledger says that damping dissipates, but for the grid's own loss.
#[test]
fn the_ledger_says_where_the_energy_went() {
    for (precision, law, parameters) in [
        (Precision::F64, LAWS[0].0, LAWS[0].1),
        (Precision::F64, LAWS[4].0, LAWS[4].1),
        (Precision::F32, LAWS[2].0, LAWS[2].1),
    ] {
        let lost = |damping: f64| {
            let mut sim = wave(law, parameters, damping, false, precision);
            if precision == Precision::F32 {
                // So that strains have digits.
                alter(&mut sim, |r| r.v[2] *= 1e3);
            }
            let before = sim.ledger().energy();
            assert_eq!(sim.ledger().damped, 0.0);
            run_to(&mut sim, 4.0 * PI / omega());
            let after = sim.ledger();
            [1.0 - after.energy() / before, after.damped / before]
        };
        let [by_grid, nothing] = lost(0.0);
        assert_eq!(nothing, 0.0, "{law}");
        let [all, by_damping] = lost(0.1 / omega());
        println!("{law}: lost {all:.4} of the energy, {by_damping:.4} by damping; {by_grid:.4} without it");
        // Two turns at a twentieth of the critical damping.
        within("what damping takes, off", (by_damping / (1.0 - f64::exp(-0.4 * PI)) - 1.0).abs(), 0.03);
        within("what the ledger does not explain", (all - by_damping).abs(), 0.01 + by_grid);
    }
}

/// Symptom: a bed that falls into itself at the start rings for seconds, and none of it sleeps. Physics: its slowest wave has ω = π c/(2 H); it
/// is gone to a thousandth after 7/(½ β ω²), and what is at rest sleeps.
#[test]
fn a_bed_that_is_damped_comes_to_rest_and_sleeps() {
    let sand = "young_modulus = 1e6, poisson_ratio = 0.3";
    let bed = |damping: f64| {
        let floor = PERIODIC.replace("z_min = \"periodic\"\nz_max = \"periodic\"", "z_min = \"stick\"");
        let head = Head::cells(0.02, [8, 8, 12], &floor);
        let ground = block("sand", [0.0; 3], [0.16; 3], "");
        let mut sim = simulation(&head.with(&[damped("sand", 1600.0, sand, damping), ground]), Precision::F32);
        let mut kinetic = [0.0; 2];
        for (k, time) in [(0, 0.01), (1, 0.5)] {
            run_to(&mut sim, time);
            kinetic[k] = sim.ledger().kinetic;
        }
        let asleep = sim.ledger().counts.get("particles asleep now").copied().unwrap_or(0);
        println!("β = {damping} s: kinetic energy {kinetic:?} J, {asleep} of {} asleep", sim.particle_count());
        (kinetic[1] / kinetic[0], asleep)
    };
    let ((rings, awake), (rests, asleep)) = (bed(0.0), bed(1e-3));
    assert!(awake == 0 && rings > 1e-3, "undamped it came to rest by itself: {rings}");
    within("part of the kinetic energy that is left after half a second", rests, 1e-6 * rings);
    assert_eq!(asleep, 8 * 8 * 8 * 8, "damped ground does not sleep");
}

/// A column of sand that has fallen apart, in steps of one length [s].
fn collapse(damping: f64, step: Option<f64>) -> Simulation {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let parameters = "young_modulus = 1e6, poisson_ratio = 0.3, friction_angle_deg = 30.0";
    let column = block("sand", [0.0; 3], [0.12, 0.08, 0.24], "");
    let step = step.map_or_else(String::new, |step| format!("step = {step:e}"));
    let head = Head::cells(0.02, [32, 4, 16], walls).time(step);
    let mut sim = simulation(&head.with(&[damped("sand", 1600.0, parameters, damping), column]), Precision::F32);
    run_to(&mut sim, 0.8);
    sim
}

/// Flow is not elastic strain: a column of sand runs out as far with damping as without, and damping takes hardly any of the energy that it falls by.
/// In steps of one length, for shorter ones lose more on the grid: a fifth more steps shorten the run-out of undamped sand by 1.4 %.
#[test]
fn flowing_sand_is_not_slowed() {
    for damping in [1e-4, 1e-3] {
        // The column's first mode has ω = π c/(2 H) = 190 rad/s: a hundredth and a tenth of the critical damping.
        let held = collapse(damping, None);
        let free = collapse(0.0, Some(held.plan().dt));
        let [(front, middle), (front_held, middle_held)] = [&free, &held].map(|sim| {
            let rows = rows(sim);
            let mut x: Vec<f64> = rows.iter().map(|r| r.x[0]).collect();
            x.sort_by(f64::total_cmp);
            (x[x.len() * 98 / 100], rows.iter().map(|r| r.x[2]).sum::<f64>() / rows.len() as f64)
        });
        println!(
            "β = {damping} s: runs out to {front_held:.4} m, free {front:.4} m; middle at {middle_held:.4} m, free {middle:.4} m"
        );
        within("run-out, off", (front_held / front - 1.0).abs(), 0.02);
        within("height of the middle, off", (middle_held / middle - 1.0).abs(), 0.02);
        let fallen = 1600.0 * 0.12 * 0.08 * 0.24 * 9.81 * (0.12 - middle_held);
        within("part of the fallen energy that damping takes", held.ledger().damped / fallen, 0.02);
    }
}

/// What nobody damps is what it was, to the last bit; another material's damping concerns nobody.
#[test]
fn undamped_ground_is_the_same_to_the_last_bit() {
    let run = |sand: String, more: &str| {
        let column = block("sand", [0.0; 3], [0.12, 0.08, 0.12], "");
        let head = Head::cells(0.02, [16, 4, 8], "z_min = \"stick\"");
        let mut sim = simulation(&head.with(&[sand, column, more.to_owned()]), Precision::F32);
        (0..60).for_each(|_| drop(sim.step().unwrap_or_else(|e| panic!("{e}"))));
        format!("{:?}", sim.particles())
    };
    let plain = run(material("sand", 1600.0, ""), "");
    let none = run(damped("sand", 1600.0, "", 0.0), "");
    let unused = run(material("sand", 1600.0, ""), &damped("snow", 400.0, "", 1e-3));
    assert!(plain == none && plain == unused);
    assert!(plain != run(damped("sand", 1600.0, "", 1e-4), ""), "damping changes nothing");
}

/// Symptom to avoid: a damped material blows up in the step that suits its stiffness. Physics: stress β k D beside k ε makes the limit
/// a dt² + 2 β a dt = 1, a = k/(ρ h²), k = 3λ + 2μ: dt = sqrt(β² + dt₀²) - β with the limit dt₀ = 1/√a of stiffness. Sharp for a particle alone in its cells; no
/// other arrangement bears less.
#[test]
fn damping_bounds_the_step() {
    let parameters = "young_modulus = 1e5, poisson_ratio = 0.3";
    let stiffness = 0.1 * f64::sqrt(1000.0 * (1.0 - 2.0 * 0.3) / 1e5);
    for times in [0.1, 0.5, 2.0, 20.0] {
        let damping = times * stiffness;
        let scene_of = |lie: Lie, time: &str| {
            limits::scene_of(lie, &damped("hencky", 1000.0, parameters, damping), "hencky", time)
        };
        let bound = simulation(&scene_of(Lie::Lone, ""), Precision::F64).plan().bound.clone();
        let exact = damping.hypot(stiffness) - damping;
        within(&format!("β {times} of dt: bound {:.3e} s, off", bound.dt), (bound.dt / exact - 1.0).abs(), 1e-5);
        let by = if times > 0.75 { "damping" } else { "stiffness" };
        assert_eq!(bound.by, format!("{by} of material 'hencky'"));
        let bears = |lie: Lie, factor: f64| {
            limits::bears(factor * bound.dt, |time| simulation(&scene_of(lie, time), Precision::F64))
        };
        for lie in [Lie::Lone, Lie::Bulk, Lie::Sheet, Lie::Levels] {
            assert!(bears(lie, 0.99), "β {times} of dt: {lie:?} grows below the bound");
        }
        assert!(!bears(Lie::Lone, 1.05), "β {times} of dt: a lone particle bears 1.05 of the bound");
        assert!(!bears(Lie::Bulk, 3.0), "β {times} of dt: bulk bears three times the bound");
    }
}

/// A sign that feeds waves is refused, and so is a number that is none.
#[test]
fn damping_below_zero_is_refused() {
    for (value, says) in [("-1e-4", "is -0.0001; must be 0 or above"), ("nan", "is NaN; give a finite number")] {
        let head = Head::cells(0.02, [16, 4, 8], "z_min = \"stick\"");
        let sand = material("sand", 1600.0, "").replacen("density", &format!("damping = {value}\ndensity"), 1);
        let text = head.with(&[sand, block("sand", [0.0; 3], [0.08; 3], "")]);
        let error = barchan::Scene::from_str(&text, "case.toml", "").map(|_| ()).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains("damping") && error.contains(says), "{error}");
    }
    // The plan says what is damped.
    let text = Head::cells(0.02, [16, 4, 8], "")
        .with(&[damped("sand", 1600.0, "", 1e-4), block("sand", [0.0; 3], [0.08; 3], "")]);
    let sim = Simulation::new(&barchan::registry(), &scene(&text), &barchan::Options::default()).unwrap();
    assert!(
        sim.plan().effects.iter().any(|e| e.name == "damping of material sand" && e.because == "damping = 0.0001 s")
    );
}
