//! A6: a plate that is pushed through sand.

use super::{Outcome, line, series, simulation, spread, theory};
use crate::picture::{Axes, Chart, Style};
use barchan_core::{Precision, Result, Vec3};

/// Sand on a rough floor between periodic sides: what of a scene with a body and a material `sand` may vary.
#[derive(Clone, Copy, Debug)]
pub struct Bed {
    /// Cell width [m].
    pub cell: f64,
    /// Width and depth of the sand [m].
    pub extent: [f64; 2],
    /// Density [kg/m³].
    pub density: f64,
    /// Young's modulus [Pa].
    pub young: f64,
    /// Shear over normal stress in simple shear.
    pub friction: f64,
}

impl Bed {
    /// The keys of a scene that it sets.
    pub fn changes(&self) -> Vec<String> {
        let Self { cell, extent: [width, depth], density, young, friction: mu } = *self;
        let [across, high] = [(width / cell).round() * cell, (1.5 * depth / cell).round() * cell];
        // The cone is matched in triaxial compression: this angle gives the wanted friction in simple shear.
        let angle = (3.0 * mu / (2.0 * 3f64.sqrt() + mu)).asin().to_degrees();
        vec![
            format!("world.cell={cell:?}"),
            format!("world.max=[{across:?}, {across:?}, {high:?}]"),
            format!("body.sand.shape.box.max=[{width:?}, {width:?}, {depth:?}]"),
            format!("material.sand.density={density:?}"),
            format!("material.sand.parameters.young_modulus={young:?}"),
            format!("material.sand.parameters.friction_angle_deg={angle:?}"),
        ]
    }
}

/// A square plate, two cells thick, that is moved through sand.
#[derive(Clone, Copy, Debug)]
pub struct Plate {
    /// The sand.
    pub bed: Bed,
    /// Side of the plate [m].
    pub side: f64,
    /// Tilt β out of the horizontal, and direction γ of its motion below the horizontal [degrees].
    pub angles: [f64; 2],
    /// Depth of the middle of its leading face at the start [m].
    pub depth: f64,
    /// How far it is moved [m].
    pub travel: f64,
    /// How fast [m/s].
    pub speed: f64,
}

/// A mean over two millimetres of way.
#[derive(Clone, Copy, Debug)]
pub struct Push {
    /// Depth of the middle of the leading face [m].
    pub depth: f64,
    /// Way from the start [m].
    pub way: f64,
    /// Force on the plate over its area [Pa].
    pub stress: Vec3,
}

impl Plate {
    /// Sand of friction 0.4 and 1600 kg/m³ and a plate of 6 by 6 cells, pushed down: the scene as it is.
    pub fn coarse() -> Self {
        let bed = Bed { cell: 0.01, extent: [0.28, 0.16], density: 1600.0, young: 2e6, friction: 0.4 };
        Self { bed, side: 0.06, angles: [0.0, 90.0], depth: 0.0, travel: 0.065, speed: 0.1 }
    }

    /// Moves it and says what it felt.
    ///
    /// # Errors
    /// Those of a simulation.
    pub fn pushed(&self) -> Result<Vec<Push>> {
        let [tilt, below] = self.angles.map(f64::to_radians);
        let way = [below.cos(), 0.0, -below.sin()];
        let normal = [tilt.sin(), 0.0, tilt.cos()];
        let leads = (normal[0] * way[0] + normal[2] * way[2]).signum();
        let thick = 2.0 * self.bed.cell;
        let middle = [0.5 * self.bed.extent[0], 0.5 * self.bed.extent[0], self.bed.extent[1]];
        // Half of the way on either side of the middle.
        let at: Vec3 = std::array::from_fn(|d| {
            let face = [-0.5 * self.travel * way[0], 0.0, -self.depth][d];
            middle[d] + face - 0.5 * thick * leads * normal[d]
        });
        let mut changes = self.bed.changes();
        changes.extend([
            format!("tool.tool.shape.box.half=[{:?}, {:?}, {:?}]", 0.5 * self.side, 0.5 * self.side, 0.5 * thick),
            format!("tool.tool.position={at:?}"),
            format!("tool.tool.rotation=[{:?}, 0.0, {:?}, 0.0]", (0.5 * tilt).cos(), (0.5 * tilt).sin()),
            format!("tool.tool.motion.velocity.linear={:?}", way.map(|x| self.speed * x)),
        ]);
        let mut s = simulation("plate-in-sand", &changes, Precision::F32)?;
        let mut pushes = Vec::new();
        let window = 0.002;
        while s.time() * self.speed < self.travel {
            let (from, mut impulse) = (s.time(), [0.0; 3]);
            while (s.time() - from) * self.speed < window {
                s.set_stop(from + window / self.speed);
                let dt = s.step()?.dt;
                let force = s.wrenches()[0].force;
                (0..3).for_each(|d| impulse[d] += dt * force[d]);
            }
            let moved = self.speed * 0.5 * (from + s.time());
            let stress = impulse.map(|x| x / (s.time() - from) / (self.side * self.side));
            pushes.push(Push { depth: self.depth + moved * below.sin(), way: moved, stress });
        }
        Ok(pushes)
    }
}

/// The line of a stress over depth between two depths [m]: slope, value at 0, and R².
pub fn over_depth(pushes: &[Push], between: [f64; 2], axis: usize) -> [f64; 3] {
    let chosen = pushes.iter().filter(|p| (between[0]..=between[1]).contains(&p.depth));
    line(&chosen.map(|p| [p.depth, p.stress[axis]]).collect::<Vec<_>>())
}

/// Mean stress over depth after a way [m], for plates that keep their depth [Pa/m].
pub fn stress_after(pushes: &[Push], way: f64, axis: usize) -> f64 {
    let chosen: Vec<f64> = pushes.iter().filter(|p| p.way > way).map(|p| p.stress[axis] / p.depth).collect();
    chosen.iter().sum::<f64>() / chosen.len() as f64
}

/// Stress a depth of a flat plate that is pushed straight down [Pa/m].
///
/// # Source
/// ξ of Agarwal, Goldman and Kamrin 2023, Mechanistic framework for reduced-order models in soft materials.
pub fn flat_plate(bed: &Bed) -> f64 {
    let mu = bed.friction;
    bed.density * 9.81 * (894.0 * mu.powi(3) - 386.0 * mu * mu + 89.0 * mu)
}

/// Ratios are over the slope of the plate that is pushed down, by the coefficients of Li, Zhang and Goldman 2013.
pub(super) fn outcome() -> Result<Outcome> {
    let mut outcome = Outcome::default();
    let flat = Plate::coarse();
    let xi = flat_plate(&flat.bed);
    let down = flat.pushed()?;
    let [slope, _, linear] = over_depth(&down, [0.01, 0.06], 2);
    outcome.add("pushed down: slope over xi", slope / xi, 1.0, 0.3);
    outcome.add("pushed down: R² of the line over depth", linear, 1.0, 0.01);
    let out = Plate { angles: [0.0, -90.0], depth: 0.08, ..flat }.pushed()?;
    outcome.add("pulled out, alpha_z(0, -90)", over_depth(&out, [0.02, 0.06], 2)[0] / slope, -0.25, 0.12);
    let drag = Plate { angles: [90.0, 0.0], depth: 0.045, travel: 0.06, ..flat }.pushed()?;
    outcome.add("dragged standing, alpha_x(90, 0)", -stress_after(&drag, 0.03, 0) / slope, 0.375, 0.12);
    outcome.add("its lift, alpha_z(90, 0)", stress_after(&drag, 0.03, 2) / slope, 0.037, 0.12);
    let tilt = Plate { angles: [45.0, 90.0], depth: -0.02, travel: 0.085, ..flat }.pushed()?;
    let along = |axis: usize| over_depth(&tilt, [0.025, 0.06], axis)[0] / slope;
    outcome.add("tilted, alpha_z(45, 90)", along(2), 0.564, 0.12);
    outcome.add("tilted, alpha_x(45, 90)", along(0).abs(), 0.219, 0.12);
    let mut all = vec![series("measured", down.iter().map(|p| [100.0 * p.depth, 1e-3 * p.stress[2]]), Style::Points)];
    all.extend(theory(&spread(0.0, 6.5, 2), &[&|z| [1e-5 * xi * z, 0.3e-5 * xi * z]]));
    outcome.chart = Chart {
        title: "A plate of 6 x 6 cm is pushed into sand".to_owned(),
        x: "depth [cm]".to_owned(),
        y: "force over area [kPa]".to_owned(),
        series: all,
        axes: Axes::Linear,
    };
    Ok(outcome)
}
