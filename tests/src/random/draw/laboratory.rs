//! What a laboratory asks of a scene.

use super::{Frame, below, entries, floats, within};
use toml::{Table, Value};

/// Tools that come and go or that a force pushes, ground that presses sideways, a world a few cells thick.
pub(super) fn add(scene: &mut Table, frame: &mut Frame) {
    for tool in entries(scene, "tool") {
        let is_free = below(tool, &["motion", "free"]).is_some();
        if is_free && frame.is(0.3) || frame.is(0.1) {
            let weight = 9810.0 * (2.0 * frame.cell).powi(3) * frame.decades(0.1, 100.0);
            let mut servo: Table =
                [("axis", floats(frame.pick(&[[0.0, 0.0, -1.0], [1.0, 0.0, -0.5], [0.0, 1.0, 0.0]])))]
                    .map(|(key, value)| (key.to_owned(), value))
                    .into_iter()
                    .collect();
            if frame.is(0.3) {
                servo.insert("pressure".to_owned(), Value::Float(weight / frame.cell.powi(2)));
                servo.insert("area".to_owned(), Value::Float(frame.cell.powi(2)));
            } else {
                servo.insert("force".to_owned(), Value::Float(weight * frame.pick(&[1.0, 1.0, -1.0])));
            }
            for (key, of) in [("damping", weight / frame.speed), ("ramp", 0.01)] {
                if frame.is(0.4) {
                    servo.insert(key.to_owned(), Value::Float(of * frame.decades(0.1, 10.0)));
                }
            }
            let motion = Table::from_iter([("servo".to_owned(), Value::Table(servo))]);
            tool.insert("motion".to_owned(), Value::Table(motion));
        } else if !is_free && frame.is(0.25) {
            let from = frame.pick(&[0.0, 1.0]) * frame.decades(1e-4, 0.1);
            tool.insert("from".to_owned(), Value::Float(from));
            if from == 0.0 || frame.is(0.5) {
                tool.insert("until".to_owned(), Value::Float(from + frame.decades(1e-4, 0.1)));
            }
        }
    }
    for body in entries(scene, "body").filter(|body| body.get("settled").and_then(Value::as_bool) == Some(true)) {
        if frame.is(0.4) {
            body.insert("k0".to_owned(), Value::Float(frame.pick(&[0.0, 0.3, 0.5, 0.7, 1.0, 1.5])));
        }
    }
    if frame.is(0.08) {
        let cells = 2 * i64::from(1_u32 << (frame.levels - 1)) * frame.pick(&[1, 1, 2]);
        let plane = Table::from_iter([("thickness_cells".to_owned(), Value::Integer(cells))]);
        let Some(world) = within(scene, "world") else { return };
        world.insert("plane_strain".to_owned(), Value::Table(plane));
        if let Some(walls) = within(world, "walls") {
            ["y_min", "y_max"].iter().for_each(|side| drop(walls.remove(*side)));
        }
    }
}
