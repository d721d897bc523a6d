//! What sand does to plates and spheres, beside theories and measurements of others. The suite runs them short, `examples/sand_forces.rs`
//! whole; both run the same code.

use crate::report::Outcome;
use crate::scenes::scene;
use crate::sketch::{Head, block, driven, half, material, tool};
use barchan::picture::{Chart, Series};
use barchan::{Options, Simulation, Vec3};
use std::fs;
use std::path::Path;

/// Sand on a rough floor between periodic sides.
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
    /// The bed's scene with a tool in it, whose `position` is seen from the middle of the surface.
    fn with(&self, position: Vec3, shape: &str, friction: f64, motion: &str, more: &str) -> Simulation {
        let Self { cell, extent: [width, depth], density, young, friction: mu } = *self;
        let walls =
            "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"periodic\"\ny_max = \"periodic\"\nz_min = \"stick\"";
        let across = (width / cell).round() as u32;
        let head = Head::cells(cell, [across, across, (1.5 * depth / cell).round() as u32], walls);
        // The cone is matched in triaxial compression: this angle gives the wanted friction in simple shear.
        let angle = (3.0 * mu / (2.0 * 3f64.sqrt() + mu)).asin();
        let sand = format!("young_modulus = {young}, poisson_ratio = 0.2, friction_angle = {angle}");
        let at = [0.5 * width + position[0], 0.5 * width + position[1], depth + position[2]];
        let text = head.with(&[
            material("sand", density, &sand),
            block("sand", [0.0; 3], [width, width, depth], "settled = true"),
            tool("tool", at, shape, &format!("{{ coulomb = {{ friction = {friction} }} }}"), motion),
            format!("{more}\n"),
        ]);
        let options = Options { threads: 2, ..Options::default() };
        Simulation::new(&barchan::registry(), &scene(&text), &options).unwrap_or_else(|e| panic!("{e}\n{text}"))
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
    /// Sand of friction 0.4 and 1600 kg/m³ and a plate of 6 by 6 cells.
    pub fn coarse() -> Self {
        let bed = Bed { cell: 0.01, extent: [0.28, 0.16], density: 1600.0, young: 2e6, friction: 0.4 };
        Self { bed, side: 0.06, angles: [0.0, 90.0], depth: 0.0, travel: 0.065, speed: 0.1 }
    }

    /// Moves it and says what it felt.
    ///
    /// # Panics
    /// If a step fails.
    pub fn pushed(&self) -> Vec<Push> {
        let [tilt, below] = self.angles.map(f64::to_radians);
        let way = [below.cos(), 0.0, -below.sin()];
        let normal = [tilt.sin(), 0.0, tilt.cos()];
        let leads = (normal[0] * way[0] + normal[2] * way[2]).signum();
        let thick = 2.0 * self.bed.cell;
        // Half of the way on either side of the middle.
        let at: Vec3 = std::array::from_fn(|d| {
            let face = [-0.5 * self.travel * way[0], 0.0, -self.depth][d];
            face - 0.5 * thick * leads * normal[d]
        });
        let turn = format!("rotation = [{}, 0.0, {}, 0.0]", (0.5 * tilt).cos(), (0.5 * tilt).sin());
        let shape = half([0.5 * self.side, 0.5 * self.side, 0.5 * thick]);
        let mut s = self.bed.with(at, &shape, 0.3, &driven(way.map(|x| self.speed * x)), &turn);
        let mut pushes = Vec::new();
        let window = 0.002;
        while s.time() * self.speed < self.travel {
            let (from, mut impulse) = (s.time(), [0.0; 3]);
            while (s.time() - from) * self.speed < window {
                s.set_stop(from + window / self.speed);
                let dt = s.step().unwrap_or_else(|e| panic!("{e}")).dt;
                let force = s.wrenches()[0].force;
                (0..3).for_each(|d| impulse[d] += dt * force[d]);
            }
            let moved = self.speed * 0.5 * (from + s.time());
            let stress = impulse.map(|x| x / (s.time() - from) / (self.side * self.side));
            pushes.push(Push { depth: self.depth + moved * below.sin(), way: moved, stress });
        }
        pushes
    }
}

/// The straight line through points: slope, value at 0, and R².
pub fn line(points: &[[f64; 2]]) -> [f64; 3] {
    let n = points.len() as f64;
    let mean = |d: usize| points.iter().map(|p| p[d]).sum::<f64>() / n;
    let (x, y) = (mean(0), mean(1));
    let sum = |a: usize, b: usize| points.iter().map(|p| (p[a] - [x, y][a]) * (p[b] - [x, y][b])).sum::<f64>();
    let slope = sum(0, 1) / sum(0, 0);
    [slope, y - slope * x, sum(0, 1).powi(2) / (sum(0, 0) * sum(1, 1))]
}

/// The line of a stress over depth between two depths [m].
pub fn over_depth(pushes: &[Push], between: [f64; 2], axis: usize) -> [f64; 3] {
    let chosen = pushes.iter().filter(|p| (between[0]..=between[1]).contains(&p.depth));
    line(&chosen.map(|p| [p.depth, p.stress[axis]]).collect::<Vec<_>>())
}

/// Mean stress over depth of those that are chosen [Pa/m].
fn mean_over_depth(pushes: &[Push], axis: usize, is_chosen: impl Fn(&Push) -> bool) -> f64 {
    let chosen: Vec<f64> = pushes.iter().filter(|p| is_chosen(p)).map(|p| p.stress[axis] / p.depth).collect();
    chosen.iter().sum::<f64>() / chosen.len() as f64
}

/// The same after a way [m], for plates that keep their depth.
pub fn after(pushes: &[Push], way: f64, axis: usize) -> f64 {
    mean_over_depth(pushes, axis, |p| p.way > way)
}

/// Stress a depth of a flat plate that is pushed straight down [Pa/m]: ξ of Agarwal, Goldman and Kamrin 2023.
pub fn flat_plate(bed: &Bed) -> f64 {
    let mu = bed.friction;
    bed.density * 9.81 * (894.0 * mu.powi(3) - 386.0 * mu * mu + 89.0 * mu)
}

/// Adds how far a figure is off what theory says, with both.
fn beside(outcome: &mut Outcome, what: &str, measured: f64, theory: f64, tolerance: f64) {
    outcome.add(format!("{what}: {measured:.3}, theory {theory:.3}, off by"), (measured - theory).abs(), tolerance);
}

/// Writes a chart into docs/reports/plots, as SVG.
fn draw(chart: &Chart, name: &str) {
    let written = tempfile::tempdir().and_then(|folder| {
        let file = folder.path().join(name);
        chart.write(&file)?;
        let to = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/reports/plots").join(name);
        fs::copy(file.with_extension("svg"), to.with_extension("svg"))
    });
    written.unwrap_or_else(|e| panic!("{name}: {e}"));
}

/// A series of a chart, without labels.
fn series(name: &str, points: impl IntoIterator<Item = [f64; 2]>, joined: bool) -> Series {
    let points = points.into_iter().map(|[x, y]| (x, y, String::new())).collect();
    Series { name: name.to_owned(), points, joined }
}

/// Depths between which the force on a plate is held to a line [m].
const DEPTHS: [f64; 2] = [0.01, 0.06];

/// A6, short: a flat plate is pushed down, and a standing one is dragged.
///
/// Symptom of a contact or a cone that is wrong: sand bears a foot with another force than it should. Physics: the force goes linearly with depth,
/// by the slope that the friction alone gives, and sideways it is 0.37 of it.
pub fn plates_short() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate { travel: 0.05, ..Plate::coarse() };
    let down = flat.pushed();
    let [slope, _, linear] = over_depth(&down, [0.01, 0.05], 2);
    outcome.add(format!("force over depth, 1 to 5 cm: R² {linear:.4}, short of 1 by"), 1.0 - linear, 0.03);
    beside(&mut outcome, "slope over xi_n", slope / flat_plate(&flat.bed), 1.0, 0.3);
    let drag = Plate { angles: [90.0, 0.0], depth: 0.045, travel: 0.03, ..flat }.pushed();
    beside(&mut outcome, "alpha_x(90, 0) over alpha_z(0, 90)", -after(&drag, 0.02, 0) / slope, 0.375, 0.12);
    outcome
}

/// A6, whole: plates at several tilts and directions, how linear the forces are, and what speed, stiffness, cells and the bed's size make of them.
pub fn plates() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate::coarse();
    let (bed, xi) = (flat.bed, flat_plate(&flat.bed));
    let down = flat.pushed();
    let [slope, offset, linear] = over_depth(&down, DEPTHS, 2);
    outcome.add(format!("force over depth, 1 to 6 cm: R² {linear:.4}, short of 1 by"), 1.0 - linear, 0.01);
    beside(&mut outcome, "slope over xi_n", slope / xi, 1.0, 0.3);
    let secant = |pushes: &[Push]| mean_over_depth(pushes, 2, |p| (0.02..0.06).contains(&p.depth));
    beside(&mut outcome, "mean stress over depth, 2 to 6 cm, over xi_n", secant(&down) / xi, 1.0, 0.3);
    println!("the line meets no depth at {:.1} kPa", 1e-3 * offset);
    let ratio = |outcome: &mut Outcome, what: &str, value: f64, theory: f64| {
        beside(outcome, &format!("{what} over alpha_z(0, 90)"), value / slope, theory, 0.12);
    };
    let out = Plate { angles: [0.0, -90.0], depth: 0.08, travel: 0.065, ..flat }.pushed();
    ratio(&mut outcome, "pull-out, alpha_z(0, -90)", over_depth(&out, [0.02, 0.06], 2)[0], -0.25);
    let drag = Plate { angles: [90.0, 0.0], depth: 0.045, travel: 0.06, ..flat }.pushed();
    ratio(&mut outcome, "sideways, alpha_x(90, 0)", -after(&drag, 0.03, 0), 0.375);
    ratio(&mut outcome, "its lift, alpha_z(90, 0)", after(&drag, 0.03, 2), 0.037);
    let tilt = Plate { angles: [45.0, 90.0], depth: -0.02, travel: 0.085, ..flat }.pushed();
    let along = |axis: usize| over_depth(&tilt, [0.025, 0.06], axis)[0];
    ratio(&mut outcome, "at 45 degrees, alpha_z(45, 90)", along(2), 0.564);
    ratio(&mut outcome, "at 45 degrees, alpha_x(45, 90)", along(0).abs(), 0.219);
    let fast = Plate { speed: 0.2, ..flat }.pushed();
    let change = secant(&fast) / secant(&down) - 1.0;
    outcome.add(
        format!("20 instead of 10 cm/s: {:+.1} % of the mean stress, size", 100.0 * change),
        change.abs(),
        0.05,
    );
    let (mut curves, third) = (
        vec![series("6 cells", down.iter().map(|p| [100.0 * p.depth, 1e-3 * p.stress[2]]), false)],
        bed.cell * 2.0 / 3.0,
    );
    for (what, other) in [
        ("E 8 MPa", Bed { young: 4.0 * bed.young, ..bed }),
        ("9 cells", Bed { cell: third, extent: [40.0 * third, bed.extent[1]], ..bed }),
        ("wide bed", Bed { extent: [0.4, 0.2], ..bed }),
    ] {
        let pushes = Plate { bed: other, ..flat }.pushed();
        let change = secant(&pushes) / secant(&down) - 1.0;
        outcome.add(
            format!(
                "{what}: {:+.1} % of the mean stress, R² {:.4}, size",
                100.0 * change,
                over_depth(&pushes, DEPTHS, 2)[2]
            ),
            change.abs(),
            0.3,
        );
        curves.push(series(what, pushes.iter().map(|p| [100.0 * p.depth, 1e-3 * p.stress[2]]), false));
    }
    curves.push(series("theory", [0.5, 6.5].map(|z| [z, 1e-5 * xi * z]), true));
    draw(
        &Chart {
            title: "A plate of 6 x 6 cm pushed into sand".to_owned(),
            x: "depth [cm]".to_owned(),
            y: "force over area [kPa]".to_owned(),
            series: curves,
        },
        "plate-force",
    );
    outcome
}

/// A sphere of 2.5 cm that falls into sand of friction 0.3 and 1510 kg/m³.
///
/// Its depth when it stops [m].
///
/// # Panics
/// If a step fails.
pub fn impact(density: f64, height: f64, cells: u32) -> f64 {
    let diameter: f64 = 0.025;
    let cell = 0.15 / f64::from(cells);
    let bed = Bed { cell, extent: [0.15, 0.1], density: 1510.0, young: 5e5, friction: 0.3 };
    let (mass, gap) = (density * std::f64::consts::PI / 6.0 * diameter.powi(3), 1.5 * cell);
    let speed = (2.0 * 9.81 * (height - gap)).sqrt();
    let motion = format!("{{ free = {{ mass = {mass}, linear = [0.0, 0.0, {:?}] }} }}", -speed);
    let start = 0.5 * diameter + gap;
    let mut s = bed.with([0.0, 0.0, start], &format!("sphere = {{ radius = {} }}", 0.5 * diameter), 0.3, &motion, "");
    let first = s.bodies()[0].position[2];
    while s.time() < 0.3 && s.bodies()[0].velocity[2] < 0.0 {
        s.step().unwrap_or_else(|e| panic!("{e}"));
    }
    first - s.bodies()[0].position[2] - gap
}

/// Uehara et al. 2003: depth of an impact from a total drop, height and depth together [m].
fn uehara(density: f64, drop: f64) -> f64 {
    0.14 / 0.3 * (density / 1510.0).sqrt() * 0.025f64.powf(2.0 / 3.0) * drop.cbrt()
}

/// A7: spheres of several densities fall from several heights; exponents of total drop and density, and the prefactor. By measurements depth goes with
/// the cube root of the drop and the square root of the density.
///
/// Contact acts from a cell off a body's surface on. Where a sphere stops a few cells deep, this layer counts: the figures that may fail are of the sphere
/// itself, the others of the sphere and its layer, which are what the sand feels.
pub fn impacts(densities: &[f64], heights: &[f64], cells: u32) -> Outcome {
    let mut outcome = Outcome::default();
    let layer = 0.15 / f64::from(cells);
    let mut rows = Vec::new();
    for &density in densities {
        for &height in heights {
            let depth = impact(density, height, cells);
            let theory = uehara(density, height + depth);
            println!(
                "{density} kg/m³ from {height} m: {:.1} mm deep, by the formula {:.1} mm",
                1e3 * depth,
                1e3 * theory
            );
            rows.push([density, height + depth, depth]);
        }
    }
    for (what, layer) in [("with its layer", layer), ("sphere itself", 0.0)] {
        // The suite holds what does not hang on the cell.
        if layer == 0.0 && densities.len() < 3 {
            continue;
        }
        let rows: Vec<[f64; 3]> = rows.iter().map(|r| [r[0], r[1] + layer, r[2] + layer]).collect();
        let slope = |density: &f64| {
            let of = rows.iter().filter(|r| r[0] == *density).map(|r| [r[1].ln(), r[2].ln()]);
            line(&of.collect::<Vec<_>>())[0]
        };
        let mean = densities.iter().map(slope).sum::<f64>() / densities.len() as f64;
        beside(&mut outcome, &format!("{what}: exponent of the total drop"), mean, 1.0 / 3.0, 0.08);
        if densities.len() > 1 {
            let points: Vec<[f64; 2]> = rows.iter().map(|r| [r[0].ln(), r[2].ln() - r[1].ln() / 3.0]).collect();
            beside(&mut outcome, &format!("{what}: exponent of the density"), line(&points)[0], 0.5, 0.1);
        }
        let ratio = rows.iter().map(|r| (r[2] / uehara(r[0], r[1])).ln()).sum::<f64>() / rows.len() as f64;
        beside(&mut outcome, &format!("{what}: depth over the formula, mean"), ratio.exp(), 1.0, 0.3);
    }
    if densities.len() > 2 {
        // A periodic side is of whole blocks of four cells.
        let finer = (cells * 3 / 2).next_multiple_of(4);
        let change = impact(2200.0, 0.1, finer) / impact(2200.0, 0.1, cells) - 1.0;
        outcome.add(
            format!("{finer} cells instead of {cells}: {:+.1} % of the depth, size", 100.0 * change),
            change.abs(),
            0.3,
        );
    }
    if densities.len() > 2 {
        let of = |r: &[f64; 3]| [1e3 * uehara(r[0], r[1]), 1e3 * r[2]];
        let mut curves: Vec<Series> = densities
            .iter()
            .map(|density| series(&format!("{density} kg/m³"), rows.iter().filter(|r| r[0] == *density).map(of), false))
            .collect();
        curves.push(series("equal", [[8.0, 8.0], [80.0, 80.0]], true));
        draw(
            &Chart {
                title: "A sphere of 2.5 cm dropped into sand".to_owned(),
                x: "depth by Uehara et al. 2003 [mm]".to_owned(),
                y: "depth [mm]".to_owned(),
                series: curves,
            },
            "impact-depth",
        );
    }
    outcome
}

/// A plate that is put on sand sinks until the sand's work is its own: by the force on a driven plate.
///
/// By theory the force goes linearly with depth, so a weight that is put on at once sinks twice as deep as one that is let down slowly, which stops at its pressure over the slope.
pub fn sinkage() -> Outcome {
    let mut outcome = Outcome::default();
    let flat = Plate::coarse();
    let driven = flat.pushed();
    let xi = flat_plate(&flat.bed);
    let static_depth = 0.015;
    let pressure = xi * static_depth;
    // Work a unit of area, of the sand and of the weight.
    let (mut work, mut last, mut depth) = (0.0, 0.0, f64::NAN);
    for push in &driven {
        work += push.stress[2] * (push.depth - last);
        if depth.is_nan() && work > pressure * push.depth {
            depth = push.depth;
        }
        last = push.depth;
    }
    let at_rest = driven.iter().find(|push| push.stress[2] >= pressure).map_or(f64::NAN, |push| push.depth);
    let side = flat.side;
    let thick = 2.0 * flat.bed.cell;
    let motion = format!("{{ free = {{ mass = {} }} }}", pressure * side * side / 9.81);
    let shape = half([0.5 * side, 0.5 * side, 0.5 * thick]);
    let mut s = flat.bed.with([0.0, 0.0, 0.5 * thick], &shape, 0.3, &motion, "");
    let start = s.bodies()[0].position[2];
    while s.time() < 0.6 {
        s.step().unwrap_or_else(|e| panic!("{e}"));
    }
    let sunk = start - s.bodies()[0].position[2];
    println!(
        "{:.2} kPa: sunk {:.1} mm; the driven plate bears it at {:.1} mm",
        1e-3 * pressure,
        1e3 * sunk,
        1e3 * at_rest
    );
    let relative =
        |outcome: &mut Outcome, what: &str, ratio: f64, tolerance: f64| beside(outcome, what, ratio, 1.0, tolerance);
    relative(
        &mut outcome,
        "depth at which a driven plate bears the pressure, over pressure over xi_n",
        at_rest / static_depth,
        0.3,
    );
    relative(
        &mut outcome,
        "sinkage of a weight put on at once, over that by the driven plate's work",
        sunk / depth,
        0.15,
    );
    relative(&mut outcome, "the same, over twice the pressure over xi_n", sunk / (2.0 * static_depth), 0.3);
    outcome
}
