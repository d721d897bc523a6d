//! Ground that starts at rest under its own weight.

use barchan::{Precision, Scene, Simulation};
use barchan_tests::scenes::{Row, everywhere, options, rows, run_to, scene, simulation, within};
use barchan_tests::sketch::{Head, block, body, material, tool};

/// Cell width [m].
const CELL: f64 = 0.01;
/// Depth of the beds [m].
const DEPTH: f64 = 0.1;
/// Weight of a cubic metre of all beds [N/m³].
const WEIGHT: f64 = 9.81 * 1000.0;
const WALLS: &str =
    "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"periodic\"\ny_max = \"periodic\"\nz_min = \"stick\"";

/// A bed 0.1 m deep and 8 cells wide on a stick floor, between periodic sides.
fn bed(law: &str, parameters: &str, settled: bool) -> String {
    Head::cells(CELL, [8, 8, 16], WALLS).with(&[
        material(law, 1000.0, parameters),
        block(law, [0.0; 3], [0.08, 0.08, DEPTH], &format!("settled = {settled}")),
    ])
}

/// Greatest speed of any particle along an axis until `time` [m/s].
fn fastest(s: &mut Simulation, time: f64) -> f64 {
    let mut fastest = 0f64;
    while s.time() < time {
        s.step().unwrap_or_else(|e| panic!("{e}"));
        if s.step_count().is_multiple_of(8) {
            fastest = rows(s).iter().flat_map(|r| r.v).fold(fastest, |most, v| most.max(v.abs()));
        }
    }
    fastest
}

/// Kirchhoff stress of a particle of a Hencky law along an axis [Pa].
fn stress_along(axis: usize, r: &Row, young: f64, poisson: f64) -> f64 {
    let mu = 0.5 * young / (1.0 + poisson);
    let lambda = 2.0 * mu * poisson / (1.0 - 2.0 * poisson);
    let log: f64 = r.strain[..3].iter().map(|b| 0.5 * b.ln()).sum();
    lambda * log + mu * r.strain[axis].ln()
}

/// The same along z.
fn stress(r: &Row, young: f64, poisson: f64) -> f64 {
    stress_along(2, r, young, poisson)
}

/// Symptom: a ledger said of settled ground that it begins without elastic energy, so that energy seemed to grow in the first step. A confined column under its own weight has
/// w² d³ / 6 M for each area, with M the modulus of confined compression.
#[test]
fn settled_ground_begins_with_its_elastic_energy() {
    let (young, poisson) = (1e6, 0.25);
    let text = bed("hencky", &format!("young_modulus = {young:e}, poisson_ratio = {poisson}"), true);
    let confined = young * (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson));
    let expected = 0.08 * 0.08 * WEIGHT.powi(2) * DEPTH.powi(3) / (6.0 * confined);
    for options in everywhere() {
        let mut s = Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap();
        let begins = s.ledger().elastic;
        within(&format!("{}: elastic energy, off by", options.backend), (begins / expected - 1.0).abs(), 0.02);
        s.step().unwrap();
        within("and by the first step", (s.ledger().elastic / begins - 1.0).abs(), 1e-3);
    }
}

/// Symptom: every bed falls into itself when gravity sets in, and what is measured in the first second is its bounce.
/// Physics: settled ground carries its weight, so nothing moves. The bounce's greatest speed comes within the first 50 ms.
#[test]
fn settled_ground_starts_at_rest() {
    for (law, parameters) in [
        ("sand", "young_modulus = 1e6, friction_angle_deg = 35.0"),
        ("neo_hookean", "young_modulus = 1e5, poisson_ratio = 0.3"),
        ("fixed_corotated", "young_modulus = 1e5, poisson_ratio = 0.3"),
        ("snow", "young_modulus = 1.4e5"),
        ("von_mises", "young_modulus = 1e6"),
        ("liquid", ""),
    ] {
        let [bounce, rest] = [(false, 0.05), (true, 0.2)]
            .map(|(settled, time)| fastest(&mut simulation(&bed(law, parameters, settled), Precision::F32), time));
        println!("{law}: {bounce:.2e} m/s without, {rest:.2e} m/s with");
        within(&format!("{law}: speed of settled ground over that of the same ground unsettled"), rest / bounce, 2e-3);
    }
}

/// The stress at each depth is the weight above it, from the start on; also under another body, on levels, in f32 and f64.
#[test]
fn settled_ground_carries_the_weight_above_it() {
    let (young, poisson) = (1e6, 0.3);
    let parameters = format!("young_modulus = {young}, poisson_ratio = {poisson}, friction_angle_deg = 35.0");
    let two = |levels: &str| {
        let top = "height_field = { min = [0.0, 0.0], max = [0.32, 0.32], bottom = 0.08, heights = [[0.16, 0.16], [0.16, 0.16]] }";
        Head::cells(CELL, [32, 32, 32], WALLS).with(&[
            material("sand", 1000.0, &parameters),
            block("sand", [0.0; 3], [0.32, 0.32, 0.08], "settled = true"),
            body("sand", top, "settled = true"),
            tool("marker", [0.16, 0.16, 0.24], "sphere = { radius = 0.001 }", "\"slip\"", "\"fixed\""),
            levels.to_owned(),
        ])
    };
    let nested = "[levels]\ncount = 3\nhalf = 8\nagents = [\"marker\"]\n";
    for (name, levels, precision) in
        [("f32", "", Precision::F32), ("f64", "", Precision::F64), ("3 levels", nested, Precision::F32)]
    {
        let mut s = simulation(&two(levels), precision);
        let off = |s: &Simulation| {
            rows(s).iter().fold(0f64, |most, r| {
                let weight = WEIGHT * (0.16 - r.x[2]);
                most.max((stress(r, young, poisson) + weight).abs() / (WEIGHT * 0.16))
            })
        };
        let start = off(&s);
        run_to(&mut s, 0.02);
        // In f32 a strain of 1e-3 has four digits.
        let rounding = if precision == Precision::F64 { 1e-9 } else { 2e-4 };
        within(&format!("{name}: stress at the start over the weight, off by (of the deepest)"), start, rounding);
        within(&format!("{name}: stress after 20 ms, likewise"), off(&s), 0.02);
    }
}

/// Ground with a given K0 rests: after 0.2 s its stresses are what they were, and nothing moves. Two layers, of which the upper one is twice as heavy, press the
/// more below; walls are what holds the sides.
#[test]
fn ground_rests_with_a_given_k0() {
    let (young, poisson) = (1e6, 0.3);
    let walls = ["x_min", "x_max", "y_min", "y_max", "z_min"].map(|side| format!("{side} = \"slip\"\n")).concat();
    let parameters = format!("young_modulus = {young}, poisson_ratio = {poisson}");
    let sand = parameters.clone() + ", friction_angle_deg = 35.0";
    for (name, k0) in [("sand", 0.5), ("sand", 1.0), ("sand", 1.5), ("hencky", 0.2)] {
        let of = if name == "sand" { &sand } else { &parameters };
        let heavy = material(name, 2000.0, of).replacen(name, "heavy", 1);
        let layers = format!("settled = true\nk0 = {k0}\nzone = [{{ material = \"{name}\", below = 0.05 }}]");
        let text = Head::cells(CELL, [8, 8, 16], &walls).with(&[
            material(name, 1000.0, of),
            heavy,
            block("heavy", [0.0; 3], [0.08, 0.08, DEPTH], &layers),
        ]);
        let mut s = simulation(&text, Precision::F32);
        let worst = |s: &Simulation| {
            let off = |r: &Row| {
                let weight = 9.81 * (2000.0 * (DEPTH - r.x[2].max(0.05)) + 1000.0 * (0.05 - r.x[2]).max(0.0));
                let off = |axis, share: f64| (stress_along(axis, r, young, poisson) + share * weight).abs();
                off(0, k0).max(off(1, k0)).max(off(2, 1.0))
            };
            rows(s).iter().map(off).fold(0.0, f64::max) / (9.81 * 150.0)
        };
        within(&format!("{name}, K0 {k0}: stress at the start off, over the greatest"), worst(&s), 2e-3);
        let speed = fastest(&mut s, 0.2);
        within(&format!("{name}, K0 {k0}: greatest speed until 0.2 s [m/s]"), speed, 1e-3);
        within(&format!("{name}, K0 {k0}: stress after 0.2 s, likewise"), worst(&s), 0.02);
    }
}

/// What has no surface to ask for is settled, too: a round column of rubber stands by itself, without a sound, if its sides bear nothing, as the sides of a
/// free column do; a ball between plates would not.
#[test]
fn a_round_column_stands_by_itself() {
    let column = |keys: &str| {
        let shape = "cylinder = { center = [0.16, 0.16, 0.1], radius = 0.06, half_height = 0.1 }";
        Head::cells(CELL, [32, 32, 24], "z_min = \"slip\"").with(&[
            material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
            body("hencky", shape, keys),
        ])
    };
    let [falls, stands] =
        ["", "settled = true\nk0 = 0.0"].map(|keys| fastest(&mut simulation(&column(keys), Precision::F32), 0.1));
    within("speed of a column at rest over that of one that falls into itself", stands / falls, 0.03);
}

/// What cannot start at rest is refused, with the key and what would mend it.
#[test]
fn what_cannot_settle_is_refused_by_name() {
    let refused = |scene: &Scene, what: &str| {
        let error = Simulation::new(&barchan::registry(), scene, &options(Precision::F32)).unwrap_err().to_string();
        assert!(error.contains("body[0].settled") && error.contains(what), "{error}");
    };
    let with = |changes: &[&str]| {
        let mut scene = scene(&bed("neo_hookean", "young_modulus = 1e5", true));
        scene.set(changes).map(|()| scene)
    };
    for (change, what) in [
        ("gravity=[1, 0, -9.81]", "works in gravity along -z"),
        ("gravity_ramp=0.1", "gravity_ramp is 0.1 s"),
        ("body[0].velocity=[1, 0, 0]", "the body has a velocity"),
    ] {
        match with(&[change]) {
            Ok(scene) => refused(&scene, what),
            Err(error) => {
                let error = error.to_string();
                assert!(error.contains("body[0].settled") && error.contains(what), "{error}");
            }
        }
    }
    for (keys, what) in
        [("settled = true\nk0 = -0.1", "must be from 0 to 10"), ("k0 = 0.5", "set settled = true, or leave k0 out")]
    {
        let ball =
            Head::space(CELL).with(&[material("sand", 1000.0, ""), body("sand", "sphere = { radius = 0.1 }", keys)]);
        let error = Scene::from_str(&ball, "ball", "").unwrap_err().to_string();
        assert!(error.contains("body[0].k0") && error.contains(what), "{error}");
    }
    // A cone bears only so much less on its sides, and a liquid nothing but the same.
    for (law, k0) in [("sand", 0.1), ("liquid", 0.5)] {
        let mut tilted = scene(&bed(law, "", true));
        tilted.set(&[format!("body[0].k0={k0}")]).unwrap();
        let error = Simulation::new(&barchan::registry(), &tilted, &options(Precision::F32)).unwrap_err().to_string();
        assert!(error.contains("body[0].k0") && error.contains("does not bear"), "{error}");
    }
    let soft = scene(&bed("neo_hookean", "young_modulus = 100.0, poisson_ratio = 0.0", true));
    refused(&soft, "does not carry the");
}
