//! Robots: what their files say, how they move, and how they stand on soft ground.

use barchan_rigid::motion::Pose;
use barchan_rigid::robot::Model;
use barchan_rigid::robot::dynamics::{bias, gravity, mass_matrix, momentum, places};
use barchan_rigid::robot::urdf::Source;
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// The repository's root.
fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// What pinocchio says; see tests/robots/README.md.
fn truth() -> Value {
    let text = std::fs::read_to_string(root().join("tests/robots/truth.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn read(urdf: &str) -> Model {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from);
    let ours = !urdf.starts_with("example-robot-data/");
    let file = if ours { root().join(urdf) } else { target.join("robots").join(urdf) };
    let text = std::fs::read_to_string(&file)
        .unwrap_or_else(|e| panic!("{}: {e}; run: bash tests/robots/fetch.sh", file.display()));
    let name = file.display().to_string();
    let source = Source { text: &text, file: &name, folder: file.parent().unwrap(), mends: false };
    let mut model = Model::read(&source).unwrap_or_else(|e| panic!("{}: {}", e.what, e.mend));
    // The truth knows none.
    model.drives.iter_mut().for_each(|drive| drive.armature = 0.0);
    model
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn pose(value: &Value) -> Pose {
    let [x, y, z, w, i, j, k] = numbers(value)[..] else { panic!("no pose: {value}") };
    Pose { position: DVec3::new(x, y, z), rotation: DQuat::from_xyzw(i, j, k, w).normalize() }
}

/// A robot of the table, and the order of its joints there.
struct Known<'a> {
    model: Model,
    floating: bool,
    /// For each of our drives, its number in the table; and among those joints that mimic no other.
    order: Vec<usize>,
    names: Vec<&'a str>,
    own: Vec<&'a str>,
}

impl<'a> Known<'a> {
    fn new(entry: &'a Value) -> Self {
        let model = read(entry["urdf"].as_str().unwrap());
        let names: Vec<&str> = entry["names"].as_array().unwrap().iter().map(|x| x.as_str().unwrap()).collect();
        let place = |name: &str| names.iter().position(|other| *other == name).unwrap();
        let order = model.drives.iter().map(|drive| place(&drive.name)).collect();
        let own = names.iter().copied().filter(|name| model.drives.iter().any(|drive| drive.name == *name)).collect();
        Self { model, floating: entry["floating"].as_bool().unwrap(), order, names, own }
    }

    fn positions(&self, state: &Value) -> Vec<f64> {
        let all = numbers(&state["angles"]);
        self.order.iter().map(|&i| all[i]).collect()
    }

    /// From our rates, along the world's axes and for the base's centre of mass, to those of the table: the base's origin, along the axes that `turn` gives.
    fn to_table(&self, arm: DVec3, turn: DMat3) -> DMatrix<f64> {
        let base = if self.floating { 6 } else { 0 };
        let ours = base + self.model.drives.len();
        // Ours = G · table's.
        let mut g = DMatrix::zeros(ours, ours);
        for (drive, known) in self.model.drives.iter().enumerate() {
            let i = self.own.iter().position(|name| *name == known.name).unwrap();
            g[(base + drive, base + i)] = 1.0;
        }
        if self.floating {
            for j in 0..3 {
                let axis = turn.col(j);
                let moved = axis.cross(arm);
                for i in 0..3 {
                    g[(i, j)] = axis[i];
                    g[(i, 3 + j)] = moved[i];
                    g[(3 + i, 3 + j)] = axis[i];
                }
            }
        }
        g
    }
}

fn greatest(values: impl IntoIterator<Item = f64>) -> f64 {
    values.into_iter().fold(0.0, |most, x: f64| most.max(x.abs()))
}

/// Robots of others, and ours: masses, joints, where links are, mass matrix, and what motion and gravity ask of the joints.
#[test]
fn robots_are_what_pinocchio_says() {
    let truth = truth();
    for entry in truth["robots"].as_array().unwrap() {
        let name = entry["name"].as_str().unwrap();
        let known = Known::new(entry);
        let model = &known.model;
        let mass = entry["mass"].as_f64().unwrap();
        assert!((model.mass() - mass).abs() < 1e-8 * mass, "{name}: {} kg, and it has {mass}", model.mass());
        assert_eq!(model.links.len(), entry["links"].as_u64().unwrap() as usize, "{name}: links");
        let mimics = entry["mimic"].as_array().unwrap().iter();
        let follows = mimics.filter(|mimic| known.names.contains(&mimic["joint"].as_str().unwrap_or_default())).count();
        assert_eq!(model.drives.len() + follows, known.names.len(), "{name}: joints");
        let (mut worst_place, mut worst_matrix, mut worst_bias) = (0.0_f64, 0.0_f64, 0.0_f64);
        for state in entry["states"].as_array().unwrap() {
            let base = if known.floating { pose(&state["base"]) } else { Pose::IDENTITY };
            let all = places(model, known.floating, &base, &known.positions(state));
            for (link, place) in model.links.iter().zip(&all) {
                let truth = pose(&state["links"][&link.name]);
                let turned = (truth.rotation * place.frame.rotation.conjugate()).xyz().length();
                worst_place = worst_place.max(turned).max((truth.position - place.frame.position).length());
            }
            let turn = DMat3::from_quat(base.rotation);
            let arm = all[0].centre - all[0].frame.position;
            let g = known.to_table(arm, turn);
            // Where joints mimic others, what is left.
            let of = if state["reduced"].is_null() { state } else { &state["reduced"] };
            if let Some(rows) = of["mass_matrix"].as_array() {
                let ours = g.transpose() * mass_matrix(model, known.floating, &all) * &g;
                let mut entries = rows.iter().map(|x| x.as_f64().unwrap());
                let scale = ours.amax();
                for i in 0..ours.nrows() {
                    for j in i..ours.ncols() {
                        worst_matrix = worst_matrix.max((ours[(i, j)] - entries.next().unwrap()).abs() / scale);
                    }
                }
            }
            let key = if known.floating { "bias_world" } else { "bias" };
            if let (Some(table), Some(velocity)) =
                (of[key].as_array(), state[key.replace("bias", "velocity")].as_array())
            {
                let base_rates = if known.floating { 6 } else { 0 };
                let is_own = |i: usize| i < base_rates || known.own.contains(&known.names[i - base_rates]);
                let velocity =
                    velocity.iter().enumerate().filter(|(i, _)| is_own(*i)).map(|(_, x)| x.as_f64().unwrap());
                let velocity = DVector::from_iterator(base_rates + known.own.len(), velocity);
                let world = known.to_table(arm, DMat3::IDENTITY);
                let rates = &world * &velocity;
                let asked = bias(model, known.floating, &all, &rates)
                    - gravity(model, &all, DVec3::new(0.0, 0.0, -9.81), rates.len());
                // In the table the base's origin, not its centre of mass, is without acceleration.
                let mut still = DVector::zeros(rates.len());
                if known.floating {
                    let spin = DVec3::new(velocity[3], velocity[4], velocity[5]);
                    let pulled = spin.cross(spin.cross(arm));
                    (0..3).for_each(|d| still[d] = pulled[d]);
                }
                let asked = world.transpose() * (asked + mass_matrix(model, known.floating, &all) * still);
                let table: Vec<f64> = table.iter().map(|x| x.as_f64().unwrap()).collect();
                assert_eq!(table.len(), base_rates + known.own.len());
                let scale = greatest(table.iter().copied());
                worst_bias = worst_bias.max(greatest(asked.iter().zip(&table).map(|(a, b)| a - b)) / scale);
            }
        }
        println!(
            "{name}: places {worst_place:.1e} (2e-6), mass matrix {worst_matrix:.1e} (1e-8), bias {worst_bias:.1e} (1e-8)"
        );
        assert!(worst_place < 2e-6, "{name}: a link is off by {worst_place}");
        assert!(worst_matrix < 1e-8 && worst_bias < 1e-8, "{name}: {worst_matrix}, {worst_bias}");
    }
}

/// Momentum is that of the mass matrix's rows, and kinetic energy half of its form.
#[test]
fn a_robots_momentum_is_that_of_its_links() {
    let known = read("rigid-couple/models/quadruped.urdf");
    let base =
        Pose { position: DVec3::new(0.3, -0.2, 1.0), rotation: DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.5, 0.8) };
    let positions: Vec<f64> = (0..known.drives.len()).map(|i| 0.1 * i as f64 - 0.5).collect();
    let all = places(&known, true, &base, &positions);
    let rates = DVector::from_fn(18, |i, _| (i as f64 * 0.7).sin());
    let rows = mass_matrix(&known, true, &all) * &rates;
    let [linear, angular] = momentum(&known, &all, &rates, all[0].centre);
    for d in 0..3 {
        assert!((rows[d] - linear[d]).abs() < 1e-12 && (rows[3 + d] - angular[d]).abs() < 1e-12);
    }
    let mut by_links = BTreeMap::new();
    for (link, place) in known.links.iter().zip(&all) {
        let twist = place.twist(&rates);
        let energy = link.mass * twist.linear.length_squared() + twist.angular.dot(place.inertia * twist.angular);
        by_links.insert(&link.name, energy);
    }
    let energy: f64 = by_links.values().sum();
    assert!((energy - rates.dot(&rows)).abs() < 1e-12 * energy);
}
