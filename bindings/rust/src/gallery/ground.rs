//! A3 and A5: sand at rest, and sand that is sheared.

use super::{Outcome, alter, places, run_to, series, simulation, spread, stresses, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result};

/// Height of the column [m], its cell, and its weight a volume [N/m³].
const HEIGHT: f64 = 0.48;
const CELL: f64 = 0.02;
const WEIGHT: f64 = 1500.0 * 9.81;

/// A layer of a column, one cell thick.
#[derive(Clone, Copy, Debug, Default)]
pub struct Layer {
    /// Mean height at which its particles started [m].
    pub height: f64,
    /// Vertical Kirchhoff stress [Pa].
    pub vertical: f64,
    /// Mean horizontal Kirchhoff stress [Pa].
    pub horizontal: f64,
}

impl Layer {
    /// What it bears: the weight of all above, which is that of what started there, however far the column has settled [Pa].
    pub fn weight(&self) -> f64 {
        WEIGHT * (HEIGHT - self.height)
    }
}

/// Layers of a column at rest, for a friction angle [degrees] and a Poisson's ratio; those nearest its ends are left out, three cells each.
///
/// Means over layers remove the pattern of two particles a cell; means over several periods of the column (58 ms) the ringing that it keeps.
///
/// # Errors
/// Those of a simulation.
pub fn column_at_rest(angle: f64, poisson: f64) -> Result<Vec<Layer>> {
    let changes = [
        format!("material.sand.parameters.friction_angle_deg={angle:?}"),
        format!("material.sand.parameters.poisson_ratio={poisson:?}"),
    ];
    let mut column = simulation("oedometer", &changes, Precision::F64)?;
    let start = places(&column);
    run_to(&mut column, 0.5)?;
    let count = (HEIGHT / CELL).round() as usize;
    let mut layers = vec![(0.0, Layer::default()); count];
    for sample in 1..=50 {
        run_to(&mut column, 0.5 + 0.006 * f64::from(sample))?;
        for (place, tau) in start.iter().zip(stresses(&column)?) {
            let (particles, layer) = &mut layers[(place[2] / CELL) as usize];
            *particles += 1.0;
            layer.height += place[2];
            layer.vertical += tau[2];
            layer.horizontal += 0.5 * (tau[0] + tau[1]);
        }
    }
    let mean = |(n, sum): &(f64, Layer)| Layer {
        height: sum.height / n,
        vertical: sum.vertical / n,
        horizontal: sum.horizontal / n,
    };
    Ok(layers[3..count - 3].iter().map(mean).collect())
}

/// Pressure on the sides over that on the ground, for this cone.
fn side_pressure(angle: f64, poisson: f64) -> f64 {
    let sine = angle.to_radians().sin();
    (poisson / (1.0 - poisson)).max((1.0 - sine) / (1.0 + sine))
}

pub(super) fn oedometer() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let mut all = Vec::new();
    for (angle, poisson) in [(30.0, 0.2), (30.0, 0.3), (45.0, 0.2)] {
        let layers = column_at_rest(angle, poisson)?;
        let name = format!("phi {angle}, nu {poisson}");
        let off = |ratio: &dyn Fn(&Layer) -> f64, to: f64| {
            let worst = |worst: f64, layer: &Layer| {
                if (ratio(layer) - to).abs() > (worst - to).abs() { ratio(layer) } else { worst }
            };
            layers.iter().fold(to, worst)
        };
        let bears = off(&|layer| -layer.vertical / layer.weight(), 1.0);
        outcome.add(format!("{name}: vertical stress over weight, worst layer"), bears, 1.0, 0.02);
        let k0 = side_pressure(angle, poisson);
        let sides = off(&|layer| layer.horizontal / layer.vertical, k0);
        outcome.add(format!("{name}: K0, worst layer"), sides, k0, 0.02 * k0);
        if poisson == 0.2 {
            let point = |layer: &Layer| [layer.height, -1e-3 * layer.horizontal];
            all.push(series(&format!("sides, phi {angle}"), layers.iter().map(point), Style::Points));
        }
        if (angle, poisson) == (30.0, 0.2) {
            let point = |layer: &Layer| [layer.height, -1e-3 * layer.vertical];
            all.push(series("upright", layers.iter().map(point), Style::Points));
        }
    }
    let law = |share: f64| move |z: f64| [1.0, 0.02].map(|part| 1e-3 * part * share * WEIGHT * (HEIGHT - z));
    let [upright, sides, steep] = [1.0, side_pressure(30.0, 0.2), side_pressure(45.0, 0.2)].map(law);
    all.extend(theory(&spread(0.0, HEIGHT, 2), &[&upright, &sides, &steep]));
    outcome.chart = Chart {
        title: "Stress in a column of sand at rest".to_owned(),
        x: "height [m]".to_owned(),
        y: "pressure [kPa]".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}

/// Shear over vertical stress of sand that is sheared steadily, and how far its normal stresses differ from one another, for a friction angle [degrees].
///
/// Pressed evenly to b = 0.998 I, then sheared homogeneously: periodic sides cannot hold a shear velocity, so C alone is imposed at every step, and the
/// particles stay.
///
/// # Errors
/// Those of a simulation.
pub fn sheared(angle: f64) -> Result<[f64; 2]> {
    let mut cell =
        simulation("shear-box", &[format!("material.sand.parameters.friction_angle_deg={angle:?}")], Precision::F64)?;
    alter(&mut cell, |list, i| (0..3).for_each(|c| list.strain[c][i] = 0.998))?;
    for _ in 0..2000 {
        alter(&mut cell, |list, i| {
            list.velocity[i] = [0.0; 3];
            list.affine[i] = [0.0; 9];
            list.affine[i][2] = 0.2;
        })?;
        cell.step()?;
    }
    let all = stresses(&cell)?;
    let [xx, yy, zz, xz] = [0, 1, 2, 4].map(|c| all.iter().map(|tau| tau[c]).sum::<f64>() / all.len() as f64);
    Ok([xz.abs() / -zz, (xx / zz - 1.0).abs().max((yy / zz - 1.0).abs())])
}

/// Shear over normal stress of a cone in simple shear, for a friction angle [degrees].
///
/// # Source
/// Klar et al. 2016, the cone that meets Mohr and Coulomb's in triaxial compression.
pub fn mobilised(angle: f64) -> f64 {
    let sine = angle.to_radians().sin();
    2.0 * 3f64.sqrt() * sine / (3.0 - sine)
}

pub(super) fn shear_box() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let mut points = Vec::new();
    for angle in [20.0, 25.0, 30.0, 35.0] {
        let [ratio, spread] = sheared(angle)?;
        let expected = mobilised(angle);
        outcome.add(format!("phi {angle}: shear over normal stress"), ratio, expected, 0.01 * expected);
        outcome.add(format!("phi {angle}: normal stresses differ by"), spread, 0.0, 0.01);
        points.push([angle, ratio]);
    }
    let mut all = vec![series("measured", points, Style::Points)];
    all.extend(theory(&spread(18.0, 37.0, 40), &[&|angle| [mobilised(angle), 0.01 * mobilised(angle)]]));
    outcome.chart = Chart {
        title: "Friction of sand in simple shear".to_owned(),
        x: "friction angle [degrees]".to_owned(),
        y: "shear over normal stress".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}
