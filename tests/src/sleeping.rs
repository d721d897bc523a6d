//! Ground that falls asleep, for tests on any backend.

use crate::sketch::{Head, block, half, material, tool};
use barchan::Simulation;

/// Cell width [m].
pub const CELL: f64 = 0.02;
const WALLS: &str = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
/// A sand's parameters.
pub const SAND: &str = "young_modulus = 1e5, poisson_ratio = 0.2, friction_angle_deg = 35.0";

/// A bed of so many cells that starts at rest under its own weight.
pub fn bed(cells: [u32; 3], law: &str, parameters: &str, sleep: &str, more: &[String]) -> String {
    bed_in(cells[0], cells, law, parameters, sleep, more)
}

/// The same in a world that is so many cells long.
fn bed_in(length: u32, cells: [u32; 3], law: &str, parameters: &str, sleep: &str, more: &[String]) -> String {
    let side = cells.map(|n| CELL * f64::from(n));
    let head = Head::cells(CELL, [length, cells[1], cells[2] + 16], WALLS).time("safety = 0.6");
    let mut parts = vec![
        format!("[sleep]\n{sleep}\n"),
        material(law, 1000.0, parameters),
        block(law, [0.0; 3], side, "settled = true"),
    ];
    parts.extend_from_slice(more);
    head.with(&parts)
}

/// A bed of sand in a world twice as long, held by a gate that is drawn upwards from `shut` to `open` [s].
pub fn gated(cells: [u32; 3], [shut, open]: [f64; 2], sleep: &str, more: &[String]) -> String {
    let side = cells.map(|n| CELL * f64::from(n));
    let [down, up] = [0.5, 3.0].map(|up| [side[0] + 0.03, 0.5 * side[1], up * side[2]]);
    let frames = [(0.0, down), (shut, down), (open, up)]
        .map(|(time, position)| format!("{{ time = {time:?}, position = {position:?} }}"))
        .join(", ");
    let motion = format!("{{ keyframes = {{ frames = [{frames}] }} }}");
    let gate = tool("gate", down, &half([0.03, side[1], side[2]]), "\"slip\"", &motion);
    bed_in(2 * cells[0], cells, "sand", SAND, sleep, &[&[gate], more].concat())
}

/// Elastic ground, 6 cm deep, under gravity that grows over a second: all the while it sinks more slowly than what may sleep.
pub fn eased() -> String {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
    let head = Head { gravity_ramp: 1.0, ..Head::cells(CELL, [4, 4, 6], walls).time("step = 4e-4") };
    head.with(&[
        "[sleep]\non = true\n".to_owned(),
        material("neo_hookean", 1500.0, "young_modulus = 1e6, poisson_ratio = 0.2"),
        block("neo_hookean", [0.0; 3], [0.08, 0.08, 0.06], ""),
    ])
}

/// Upward speed with which a block of [`adrift`] begins [m/s], and gravity there [m/s²].
pub const ADRIFT: [f64; 2] = [2e-8, -1e-6];

/// A block in the air over an asteroid: it rises, turns round and falls, and is slower than `sleep.speed` for 140 steps.
pub fn adrift() -> String {
    let [rises, gravity] = ADRIFT;
    let head = Head { gravity: [0.0, 0.0, gravity], ..Head::cells(CELL, [8, 8, 8], WALLS).time("step = 2e-4") };
    head.with(&[
        "[sleep]\non = true\n".to_owned(),
        material("sand", 1500.0, SAND),
        block("sand", [0.04; 3], [0.12; 3], &format!("velocity = [0, 0, {rises:?}]")),
    ])
}

/// Particles asleep now.
pub fn asleep(s: &Simulation) -> u64 {
    s.ledger().counts.get("particles asleep now").copied().unwrap_or(0)
}

/// A plate that comes down on the bed's middle from just above, and goes through it sideways.
pub fn plate(cells: [u32; 3], wait: f64) -> String {
    let [x, y, z] = cells.map(|n| CELL * f64::from(n));
    let at = |t: f64, x: f64, z: f64| format!("{{ time = {}, position = [{x}, {}, {z}] }}", wait + t, 0.5 * y);
    let path = [(0.0, 0.3 * x, z + 0.08), (0.3, 0.3 * x, z), (0.8, 0.5 * x, z)].map(|(t, x, z)| at(t, x, z)).join(", ");
    let motion = format!("{{ keyframes = {{ frames = [{}, {path}] }} }}", at(-wait, 0.3 * x, z + 0.08));
    tool("plate", [0.3 * x, 0.5 * y, z + 0.08], &half([0.03, 0.06, 0.06]), "{ coulomb = { friction = 0.4 } }", &motion)
}
