//! Worlds a few cells thick.

use barchan::{Precision, Scene, Simulation};
use barchan_tests::scenes::{everywhere, rows, run_to, simulation, within};

/// A column of sand that falls, in a world whose thickness follows from its cells; places without y.
fn slice(cell: f64, thickness: u32) -> String {
    format!(
        r#"
name = "slice"
gravity = [0, -9.81]
[world]
cell = {cell}
min = [0, 0]
max = [0.64, 0.32]
plane_strain = {{ thickness_cells = {thickness} }}
walls = {{ x_min = "slip", x_max = "slip", z_min = "stick" }}
[time]
end = 0.3
[[material]]
name = "sand"
law = "sand"
density = 1500
parameters = {{ young_modulus = 2e5, friction_angle_deg = 30.0 }}
[[body]]
material = "sand"
shape = {{ box = {{ min = [0, 0], max = [0.16, 0.24] }} }}
[[tool]]
name = "step"
position = [0.5, 0]
shape = {{ box = {{ half = [0.04, 0.04] }} }}
"#
    )
}

/// `cell` alone changes the resolution, and the thickness changes nothing but the number of particles.
#[test]
fn thickness_follows_from_the_cells_and_changes_nothing() {
    let mut fronts = Vec::new();
    for (cell, thickness) in [(0.02, 2), (0.02, 4), (0.01, 2)] {
        let mut s = simulation(&slice(cell, thickness), Precision::F32);
        let world = &s.plan().scene.world;
        let thick = world.max[1] - world.min[1];
        assert!((thick - cell * f64::from(thickness)).abs() < 1e-12, "{thick} m");
        let expected = 0.16 * 0.24 * thick * 1500.0;
        within("mass off that of the slice, relative", (s.ledger().mass / expected - 1.0).abs(), 1e-6);
        run_to(&mut s, 0.25);
        let all = rows(&s);
        let across = all.iter().fold(0f64, |most, row| most.max(row.v[1].abs()));
        let along = all.iter().fold(0f64, |most, row| most.max(row.v[0].abs()));
        within("greatest speed across the slice over that along it", across / along, 1e-3);
        fronts.push(all.iter().fold(0f64, |most, row| most.max(row.x[0])));
    }
    let [thin, thick, fine] = fronts[..] else { unreachable!("three were run") };
    println!("fronts {fronts:?} m");
    within("front with four cells off that with two [m]", (thin - thick).abs(), 2e-3);
    within("front with half the cells off [m]", (thin - fine).abs(), 0.03);
    assert!(thin > 0.25, "it has come to {thin} m");
}

/// A slice has the same form everywhere, and is what its written form says.
#[test]
fn a_slice_runs_everywhere_and_can_be_written() {
    let text = slice(0.02, 2);
    let mut ends = Vec::new();
    for options in everywhere() {
        let scene = Scene::from_str(&text, "slice", "").unwrap();
        let mut s = Simulation::new(&barchan::registry(), &scene, &options).unwrap_or_else(|e| panic!("{e}"));
        run_to(&mut s, 0.1);
        ends.push(rows(&s).iter().map(|row| row.x[0]).sum::<f64>() / s.particle_count() as f64);
        let mut again = Scene::from_str(&scene.to_toml().unwrap(), "slice", "").unwrap();
        assert_eq!(again.difference(&scene), None);
        // In code, too, the cell alone says how thick it is.
        again.world.cell = 0.01;
        again.check().unwrap();
        assert_eq!((again.world.min[1], again.world.max[1]), (-0.01, 0.01));
    }
    within("mean place off that on the CPU in f64 [m]", (ends[0] - ends[1]).abs().max((ends[2] - ends[1]).abs()), 1e-4);
}

/// What cannot be a slice is refused, with what would mend it.
#[test]
fn what_is_no_slice_is_refused_by_name() {
    for (change, path, what) in [
        ("world.plane_strain.thickness_cells=1", "world.plane_strain.thickness_cells", "must be from 2"),
        ("world.walls.y_min=stick", "world.walls.y_min", "leave it out"),
        ("world.cell=0.03", "world.max", "the nearest are 0.63 and 0.6"),
        ("levels.count=2", "world.min", "the 2 levels need a multiple of 2"),
    ] {
        let error = Scene::from_str_with(&slice(0.02, 2), "slice", "", &[change]).unwrap_err().to_string();
        assert!(error.contains(path) && error.contains(what), "{error}");
    }
}
