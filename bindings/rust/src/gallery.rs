//! Classic experiments, each beside the law that it is known for.
//!
//! An [`Experiment`] is a built-in scene and what is varied in it. It comes to [`Figure`]s, each with what theory or measurements of others say, and to one
//! plot. `barchan gallery` runs them; `docs/gallery.md` shows them.
//!
//! ```
//! use barchan::gallery::{Bed, Experiment, Figure, Heap, Layer, Outcome, Plate, Push, experiments, flat_plate};
//! use barchan::gallery::{mobilised, over_depth, standing_wave};
//!
//! let run: fn(&Experiment) -> barchan::Result<Outcome> = Experiment::run;
//! let cases: Vec<&str> = experiments().iter().map(|experiment| experiment.case).collect();
//! assert_eq!(cases, ["A8", "A14", "A15", "A7", "A6", "A10", "A3", "A5", "A2"]);
//! // The parts of some are there to be varied.
//! let order = (standing_wave(8)? / standing_wave(16)?).log2();
//! assert!(Figure { what: "order".into(), measured: order, theory: 2.0, tolerance: 0.3 }.holds());
//! let bed: Bed = Plate::coarse().bed;
//! let by_theory = |depth: f64| Push { depth, way: depth, stress: [0.0, 0.0, flat_plate(&bed) * depth] };
//! let [slope, ..] = over_depth(&[0.01, 0.02, 0.03].map(by_theory), [0.0, 0.05], 2);
//! assert!((slope / flat_plate(&bed) - 1.0).abs() < 1e-9);
//! let heap = Heap { height: 0.11, slopes: [28.9, 27.7], speed: 0.002 }; // as `poured(24.28, 0.005)` measures it
//! assert!(heap.slopes.iter().all(|slope| (slope - mobilised(24.28).atan().to_degrees()).abs() < 3.0));
//! assert!((Layer { height: 0.24, ..Layer::default() }.weight() - 1500.0 * 9.81 * 0.24).abs() < 1e-6);
//! # Ok::<(), barchan::Error>(())
//! ```

mod block;
mod collapse;
mod ground;
mod heap;
mod hopper;
mod impact;
mod plate;
mod wave;

pub use block::slide;
pub use collapse::run_out;
pub use ground::{Layer, column_at_rest, mobilised, sheared};
pub use heap::{Heap, poured};
pub use hopper::discharge;
pub use impact::{impact, uehara};
pub use plate::{Bed, Plate, Push, flat_plate, over_depth, stress_after};
pub use wave::standing_wave;

use crate::picture::{Chart, Series, Style};
use crate::stress::kirchhoff;
use barchan_core::{Options, ParticleList, Precision, Result, Simulation, Vec3};

/// A figure beside what it should be.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// What was measured, with its unit.
    pub what: String,
    /// How much it is.
    pub measured: f64,
    /// How much it should be.
    pub theory: f64,
    /// How far it may be off.
    pub tolerance: f64,
}

impl Figure {
    /// Is it within its tolerance?
    pub fn holds(&self) -> bool {
        (self.measured - self.theory).abs() <= self.tolerance
    }
}

/// What an experiment came to.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// What was measured.
    pub figures: Vec<Figure>,
    /// The same as a plot: measured, theory, tolerance.
    pub chart: Chart,
}

impl Outcome {
    fn add(&mut self, what: impl Into<String>, measured: f64, theory: f64, tolerance: f64) {
        self.figures.push(Figure { what: what.into(), measured, theory, tolerance });
    }
}

/// An experiment.
#[derive(Clone, Copy, Debug)]
pub struct Experiment {
    /// Name of it and of its scene.
    pub name: &'static str,
    /// Code of its case in `docs/cases.md`.
    pub case: &'static str,
    /// What it is held to, and by whom.
    pub law: &'static str,
    run: fn() -> Result<Outcome>,
}

impl Experiment {
    /// Runs it on all cores.
    ///
    /// # Errors
    /// Those of a simulation.
    pub fn run(&self) -> Result<Outcome> {
        (self.run)()
    }
}

/// All of them.
pub fn experiments() -> &'static [Experiment] {
    &[
        Experiment {
            name: "column-collapse",
            case: "A8",
            law: "run-out over width: 1.2 a for a < 1.8, 1.9 a^(2/3) for a > 2.8; a is height over width (Lube et al. 2005)",
            run: collapse::outcome,
        },
        Experiment {
            name: "poured-heap",
            case: "A14",
            law: "tan(slope) = 2 sqrt(3) sin phi/(3 - sin phi), the cone in simple shear",
            run: heap::outcome,
        },
        Experiment {
            name: "hopper-discharge",
            case: "A15",
            law: "rate goes with (D - k d)^(5/2) of an opening, and not with the head above it (Beverloo et al. 1961)",
            run: hopper::outcome,
        },
        Experiment {
            name: "sphere-impact",
            case: "A7",
            law: "depth (0.14/mu) (rho_b/rho_g)^(1/2) D^(2/3) (h + d)^(1/3) (Uehara et al. 2003)",
            run: impact::outcome,
        },
        Experiment {
            name: "plate-in-sand",
            case: "A6",
            law: "force on a plate grows with depth, by its tilt and direction (Li et al. 2013, Agarwal et al. 2023)",
            run: plate::outcome,
        },
        Experiment {
            name: "block-on-incline",
            case: "A10",
            law: "acceleration g (sin theta - mu cos theta), or none where tan theta < mu (Coulomb)",
            run: block::outcome,
        },
        Experiment {
            name: "oedometer",
            case: "A3",
            law: "sigma_zz = -rho g (H - z), sides at K0 = max(nu/(1 - nu), (1 - sin phi)/(1 + sin phi)) of it",
            run: ground::oedometer,
        },
        Experiment {
            name: "shear-box",
            case: "A5",
            law: "shear over normal stress: 2 sqrt(3) sin phi/(3 - sin phi), the cone in simple shear",
            run: ground::shear_box,
        },
        Experiment {
            name: "standing-wave",
            case: "A2",
            law: "u = (v0/w) sin(w t) sin(k x): the error falls with the square of the cell",
            run: wave::outcome,
        },
    ]
}

/// A simulation of a built-in scene with keys changed.
fn simulation(name: &str, changes: &[String], precision: Precision) -> Result<Simulation> {
    let scene = barchan_tasks::scene(name, changes)?;
    Simulation::new(&crate::registry(), &scene, &Options { precision, ..Options::default() })
}

/// Steps until a time [s], and lands on it.
fn run_to(simulation: &mut Simulation, time: f64) -> Result<()> {
    while simulation.time() < time {
        simulation.set_stop(time);
        simulation.step()?;
    }
    Ok(())
}

/// Changes every particle of a simulation, by its list and number.
fn alter(simulation: &mut Simulation, change: impl Fn(&mut ParticleList, usize)) -> Result<()> {
    let mut state = simulation.particles();
    for list in &mut state.lists {
        (0..list.len()).for_each(|i| change(list, i));
    }
    simulation.set_particles(state)
}

/// Places of all particles by id [m].
fn places(simulation: &Simulation) -> Vec<Vec3> {
    by_id(simulation, |list| (0..list.len()).map(|i| list.position(i)).collect())
}

/// Kirchhoff stresses of all particles by id [Pa].
fn stresses(simulation: &Simulation) -> Result<Vec<[f64; 6]>> {
    let mut failed = None;
    let stresses = by_id(simulation, |list| {
        let which: Vec<usize> = (0..list.len()).collect();
        kirchhoff(&simulation.plan().materials[list.material as usize], list, &which).unwrap_or_else(|error| {
            failed = Some(error);
            vec![[f64::NAN; 6]; list.len()]
        })
    });
    failed.map_or(Ok(stresses), Err)
}

fn by_id<T>(simulation: &Simulation, mut of: impl FnMut(&ParticleList) -> Vec<T>) -> Vec<T> {
    let state = simulation.particles();
    let mut all: Vec<(u64, T)> = Vec::new();
    for list in &state.lists {
        all.extend(list.id.iter().copied().zip(of(list)));
    }
    all.sort_by_key(|(id, _)| *id);
    all.into_iter().map(|(_, value)| value).collect()
}

/// The straight line through points: slope, value at 0, and R².
pub fn line(points: &[[f64; 2]]) -> [f64; 3] {
    let n = points.len() as f64;
    let mean = |d: usize| points.iter().map(|p| p[d]).sum::<f64>() / n;
    let middle = [mean(0), mean(1)];
    let sum = |a: usize, b: usize| points.iter().map(|p| (p[a] - middle[a]) * (p[b] - middle[b])).sum::<f64>();
    let slope = sum(0, 1) / sum(0, 0);
    [slope, middle[1] - slope * middle[0], sum(0, 1).powi(2) / (sum(0, 0) * sum(1, 1))]
}

/// The exponent of a power law through points.
fn exponent(points: &[[f64; 2]]) -> f64 {
    line(&points.iter().map(|p| p.map(f64::ln)).collect::<Vec<_>>())[0]
}

/// Points of a chart, without labels.
pub fn series(name: &str, points: impl IntoIterator<Item = [f64; 2]>, style: Style) -> Series {
    let points = points.into_iter().map(|[x, y]| (x, y, String::new())).collect();
    Series { name: name.to_owned(), points, style }
}

/// A law: the value at x, and how far a measurement may be off.
type Law<'a> = &'a dyn Fn(f64) -> [f64; 2];

/// Laws as lines, and beside them how far measurements may be off.
fn theory(x: &[f64], laws: &[Law<'_>]) -> [Series; 2] {
    let gap = [[f64::NAN; 2]];
    let along =
        |law: Law<'_>, side: f64| x.iter().map(|&x| [x, law(x)[0] + side * law(x)[1]]).chain(gap).collect::<Vec<_>>();
    let lines = |name: &str, sides: &[f64]| {
        series(name, laws.iter().flat_map(|&law| sides.iter().flat_map(move |&side| along(law, side))), Style::Line)
    };
    [lines("theory", &[0.0]), lines("tolerance", &[-1.0, 1.0])]
}

/// Numbers spread evenly from one to another.
fn spread(from: f64, to: f64, count: u32) -> Vec<f64> {
    (0..count).map(|i| from + (to - from) * f64::from(i) / f64::from(count - 1)).collect()
}
