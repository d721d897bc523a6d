//! Cases that blow up other codes. A good simulator stays right, or refuses with an error that says what is wrong: it is never
//! silently wrong. The codes are those of docs/cases.md, which also says where the cases are that need several levels or a GPU.

mod degeneracies;
mod precision;
mod rigid;
mod time_step;

use barchan::{Error, Options, Plan, Precision, Simulation};
use barchan_tests::scenes::{Row, norm, options, rows, scene, within};

/// The error that a scene is refused with.
#[track_caller]
fn refusal(toml: &str) -> Error {
    match barchan::Scene::from_str(toml, "case.toml", "") {
        Err(error) => error,
        Ok(scene) => match Simulation::new(&barchan::registry(), &scene, &options(Precision::F32)) {
            Err(error) => error,
            Ok(_) => panic!("the scene is not refused:\n{toml}"),
        },
    }
}

/// Asserts that an error's text holds all of `parts`, and prints it.
#[track_caller]
fn says(error: &Error, parts: &[&str]) {
    let text = error.to_string();
    println!("refused: {text}");
    for part in parts {
        assert!(text.contains(part), "'{part}' is not in: {text}");
    }
}

/// The plan of a scene.
fn plan(toml: &str) -> Plan {
    Plan::assemble(&barchan::registry(), &scene(toml), &Options::default()).unwrap_or_else(|e| panic!("{e}\n{toml}")).0
}

/// Is every number of every particle finite?
fn all_finite(rows: &[Row]) -> bool {
    rows.iter().all(|r| r.x.iter().chain(&r.v).chain(&r.c).chain(&r.strain).chain(&r.state).all(|x| x.is_finite()))
}

/// Sum of mass times velocity, and of mass.
fn momentum(rows: &[Row]) -> [f64; 3] {
    std::array::from_fn(|d| rows.iter().map(|r| r.m * r.v[d]).sum())
}

/// Kirchhoff stresses of all particles, in the order of `rows`.
fn stresses(simulation: &Simulation) -> Vec<[f64; 6]> {
    let state = simulation.particles();
    let mut all: Vec<(u64, [f64; 6])> = Vec::new();
    for list in &state.lists {
        let which: Vec<usize> = (0..list.len()).collect();
        let law = &simulation.plan().materials[list.material as usize];
        let tau = barchan::stress::kirchhoff(law, list, &which).unwrap();
        all.extend(list.id.iter().copied().zip(tau));
    }
    all.sort_by_key(|(id, _)| *id);
    all.into_iter().map(|(_, tau)| tau).collect()
}

/// Takes steps.
#[track_caller]
fn steps(simulation: &mut Simulation, count: u32) {
    for _ in 0..count {
        simulation.step().unwrap_or_else(|e| panic!("{e}"));
    }
}

/// Heights of the surface over columns of width `h` along x, from the greatest z of each; 0 where there is none.
fn surface(rows: &[Row], h: f64, columns: usize) -> Vec<f64> {
    let mut heights = vec![0f64; columns];
    for r in rows {
        if let Some(height) = heights.get_mut((r.x[0] / h) as usize) {
            *height = height.max(r.x[2]);
        }
    }
    heights
}

/// Slope of the straight line through `heights` at distances `h` [rad].
fn slope(heights: &[f64], h: f64) -> f64 {
    let n = heights.len() as f64;
    let mean = heights.iter().sum::<f64>() / n;
    let (mut xy, mut xx) = (0.0, 0.0);
    for (i, z) in heights.iter().enumerate() {
        let x = (i as f64 - 0.5 * (n - 1.0)) * h;
        xy += x * (z - mean);
        xx += x * x;
    }
    (xy / xx).atan()
}

/// Steps until `time`, and asserts that no step fails.
fn until(simulation: &mut Simulation, time: f64) -> Vec<Row> {
    barchan_tests::scenes::run_to(simulation, time);
    rows(simulation)
}

/// Moves particles: `f` may set the position of a row [m].
fn place(simulation: &mut Simulation, mut f: impl FnMut(&mut Row)) {
    let all = rows(simulation);
    let mut state = simulation.particles();
    for list in &mut state.lists {
        for i in 0..list.len() {
            let mut row = all[list.id[i] as usize].clone();
            f(&mut row);
            let cells = row.x.map(|x| x / list.cell_width);
            list.cell[i] = cells.map(|x| x.floor() as i32);
            list.offset[i] = cells.map(|x| x - x.floor());
        }
    }
    state.sort = None;
    simulation.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
}

/// As [`until`], from now on.
fn later(simulation: &mut Simulation, time: f64) -> Vec<Row> {
    let time = simulation.time() + time;
    until(simulation, time)
}
