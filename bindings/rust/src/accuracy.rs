//! How far a run is from a finer one of the same scene.
//!
//! 1. [`rung`] puts a scene on another resolution, with the same extent, mass and duration.
//! 2. [`record`] runs it and keeps what the comparison needs; only the steps are timed.
//! 3. [`Errors::of`] holds a record against that of the reference.
//!
//! Lengths are compared where a user would see them: the height of the surface, the place of the tool, the force on it, and
//! the distance between the two clouds of particles. The first body counts as the tool; if it is a robot's base, so do all links in the force on it.

//!
//! ```
//! use barchan::accuracy::{Balance, Chamfer, Contact, Cost, Crater, Errors, Grain, HeightMap, Nearest, Norms, Record, record, rung};
//! use barchan::Options;
//!
//! let mut scene = barchan::example();
//! scene.time.end = 0.01;
//! let (registry, options) = (barchan::registry(), Options::default());
//! let mut run = |cell: f64| -> barchan::Result<Record> {
//!     record(&registry, &rung(&scene, cell, &scene.levels, None)?, &options, &mut |_| {})
//! };
//! let (coarse, fine) = (run(0.1)?, run(0.05)?);
//! let errors = Errors::of(&coarse, &fine);
//! let (height, crater): (Norms, Crater) = (errors.height, errors.crater);
//! assert!(height.max_mm >= height.mean_mm && crater.volume_cm3 >= 0.0);
//! let cloud: Chamfer = errors.chamfer;
//! assert!(cloud.sum_mm() > 0.0);
//! let touch: Option<Contact> = errors.contact;
//! assert!(touch.is_some_and(|touch| touch.peak_n == 0.0), "the ball is still in the air");
//! let (cost, kept): (&Cost, Balance) = (&fine.cost, fine.balance());
//! assert!(cost.steps > 0 && kept.momentum_drift_ns.abs() < 1e-3);
//! let grains: &[Grain] = &fine.end;
//! assert!(HeightMap::new(grains, &fine.scene.world, 0.05).heights().iter().all(|z| (0.0..0.4).contains(z)));
//! assert_eq!(Nearest::new(vec![grains[0].position.map(f64::from)]).distance(grains[0].position.map(f64::from)), 0.0);
//! # Ok::<(), barchan::Error>(())
//! ```

mod height;

pub use barchan_core::nearest::Nearest;
pub use height::HeightMap;

use crate::run::Progress;
use barchan_core::scene::{Levels, Scene, Shape};
use barchan_core::{Error, Ledger, Options, Registry, Result, Simulation, Spot, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::time::Instant;

/// Horizontal distance from where the tool was lowest that counts as near [m]: twice and a half the side of UBSoft's cube.
pub const NEAR: f64 = 0.25;
/// Forces are compared as means over this time [s], so that the ringing of single cells does not count.
pub const FORCE_WINDOW: f64 = 5e-3;
/// Time between two samples of pose and force [s].
const SAMPLE: f64 = 1e-3;
/// Steps between two looks at the memory in use.
const MEMORY_EVERY: u64 = 16;

/// A scene on cells of another width: same extent, same mass, same duration. The distance between particles and a fixed step
/// scale with the cell; `spacing` sets that distance in cells instead.
///
/// # Errors
/// [`Error::Scene`] naming the side of the world or of a box that is no whole number of cells or particles then.
pub fn rung(scene: &Scene, cell: f64, levels: &Levels, spacing: Option<f64>) -> Result<Scene> {
    let mut rung = scene.clone();
    let scale = cell / scene.world.cell;
    rung.world.cell = cell;
    rung.levels = levels.clone();
    rung.time.step = scene.time.step.map(|step| step * scale);
    for body in &mut rung.body {
        body.spacing = spacing.map(|cells| cells * cell).or(body.spacing.map(|spacing| spacing * scale));
    }
    rung.check()?;
    for (i, body) in rung.body.iter().enumerate() {
        let spacing = body.spacing.unwrap_or(0.5 * cell);
        let Some(bounds) = matches!(body.shape, Shape::Box { .. }).then(|| body.shape.bounds()).flatten() else {
            continue;
        };
        let bounds = bounds.intersection(&rung.world_box());
        for (d, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let count = (bounds.max[d] - bounds.min[d]) / spacing;
            if (count - count.round()).abs() > 1e-6 * count {
                return Err(Error::Scene {
                    file: scene.name.clone(),
                    line: 0,
                    path: format!("body[{i}].shape.box"),
                    what: format!("is {count:.3} particles along {axis} at a spacing of {spacing} m"),
                    allowed: Some("equal mass on all rungs needs a whole number".to_owned()),
                });
            }
        }
    }
    Ok(rung)
}

/// A particle as the comparison sees it: a cube of its rest volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grain {
    /// Position [m].
    pub position: [f32; 3],
    /// Side of the cube [m].
    pub side: f32,
}

impl Grain {
    /// Of a particle of a simulation.
    pub fn of(spot: &Spot) -> Self {
        Self { position: spot.position.map(|x| x as f32), side: spot.side() as f32 }
    }
}

/// The first tool, or robot, after a step.
#[derive(Clone, Copy, Debug, Default)]
struct Moment {
    /// Time [s].
    time: f64,
    /// Centre of mass [m].
    position: Vec3,
    /// Impulse that the ground has given it since the start [N s].
    impulse: Vec3,
}

/// A run, as far as it is compared.
#[derive(Clone, Debug)]
pub struct Record {
    /// The scene.
    pub scene: Scene,
    /// Particles at the start.
    pub start: Vec<Grain>,
    /// Particles at the end.
    pub end: Vec<Grain>,
    /// What it cost.
    pub cost: Cost,
    /// Totals at the start.
    pub ledger_start: Ledger,
    /// Totals at the end.
    pub ledger_end: Ledger,
    /// What the plan warned of.
    pub warnings: Vec<String>,
    /// Impulse that the ground has given to all tools [N s].
    to_tools: Vec3,
    /// The first tool, if there is one, after every step.
    tool: Vec<Moment>,
    /// Does the ground move it?
    free: bool,
}

/// What a run cost.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Cost {
    /// Wall seconds of the steps, without start-up and output.
    pub wall_s: f64,
    /// Wall seconds until the first step: placing particles, compiling.
    pub start_up_s: f64,
    /// Steps.
    pub steps: u64,
    /// Particles, mean over all steps.
    pub particles: f64,
    /// Bytes of particles and grid, the most that there were.
    pub memory_bytes: u64,
    /// Mass of the ground at the start [kg].
    pub mass_kg: f64,
}

/// What a run should have kept, and how far it did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Balance {
    /// Energy of ground and free bodies at the end less that at the start [J].
    pub energy_change_j: f64,
    /// Change of the ground's momentum that gravity, walls, tools and sleep do not explain [N s].
    pub momentum_drift_ns: f64,
    /// Change of the angular momentum of ground and free bodies, about where the first tool was lowest [kg m²/s]: 0 where the
    /// scene is symmetric about it.
    pub angular_momentum_change: f64,
    /// What merging particles took of it [kg m²/s].
    pub resampled_angular_momentum: f64,
}

/// Runs a scene to its end; `watch` sees every step.
///
/// # Errors
/// Those of [`Simulation::new`] and [`Simulation::step`].
pub fn record(
    registry: &Registry,
    scene: &Scene,
    options: &Options,
    watch: &mut dyn FnMut(&Progress),
) -> Result<Record> {
    let begin = Instant::now();
    let mut simulation = Simulation::new(registry, scene, options)?;
    let start_up_s = begin.elapsed().as_secs_f64();
    let (start, ledger_start) = (grains(&simulation), simulation.ledger());
    let mut cost = Cost { start_up_s, mass_kg: ledger_start.mass, ..Cost::default() };
    let first = |simulation: &Simulation| simulation.bodies().first().map(|body| body.position);
    // Links of a robot come right behind its base.
    let links = simulation.robots().first().map_or(1, |robot| {
        let is_first = simulation.bodies().first().is_some_and(|body| body.name == robot.name);
        if is_first { robot.links.len() } else { 1 }
    });
    let mut tool: Vec<Moment> =
        first(&simulation).map(|position| Moment { position, ..Moment::default() }).into_iter().collect();
    let (end, mut particle_steps, mut to_tools) = (scene.time.end, 0, [0.0; 3]);
    simulation.set_stop(end);
    while simulation.time() < end {
        let before = Instant::now();
        let report = simulation.step()?;
        cost.wall_s += before.elapsed().as_secs_f64();
        cost.steps += 1;
        particle_steps += simulation.particle_count() as u64;
        if cost.steps % MEMORY_EVERY == 1 {
            let (particles, grid) = simulation.memory();
            cost.memory_bytes = cost.memory_bytes.max(particles + grid);
        }
        let impulses = simulation.wrenches().into_iter().map(|wrench| wrench.force.map(|f| report.dt * f));
        let impulses: Vec<Vec3> = impulses.collect();
        impulses.iter().for_each(|impulse| to_tools = plus(to_tools, *impulse));
        if let (Some(last), Some(position)) = (tool.last(), first(&simulation)) {
            let impulse = impulses.iter().take(links).fold(last.impulse, |sum, impulse| plus(sum, *impulse));
            tool.push(Moment { time: simulation.time(), position, impulse });
        }
        watch(&Progress {
            done: simulation.time() / end,
            time: simulation.time(),
            step: cost.steps,
            dt: report.dt,
            elapsed: begin.elapsed().as_secs_f64(),
        });
    }
    let ledger_end = simulation.ledger();
    cost.particles = particle_steps as f64 / cost.steps.max(1) as f64;
    let end = grains(&simulation);
    let warnings = simulation.plan().warnings.clone();
    let free = simulation.bodies().first().is_some_and(|body| body.mass.is_finite());
    Ok(Record { scene: scene.clone(), start, end, cost, ledger_start, ledger_end, warnings, to_tools, tool, free })
}

fn grains(simulation: &Simulation) -> Vec<Grain> {
    simulation.spots().iter().map(Grain::of).collect()
}

fn plus(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[d] + b[d])
}

fn minus(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[d] - b[d])
}

fn norm(a: Vec3) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

impl Record {
    /// Where the first tool was lowest, seen from above [m].
    pub fn lowest_place(&self) -> Option<[f64; 2]> {
        self.lowest().map(|[x, y, _]| [x, y])
    }

    /// Where the first tool was lowest [m].
    fn lowest(&self) -> Option<Vec3> {
        self.tool.iter().map(|moment| moment.position).min_by(|a, b| a[2].total_cmp(&b[2]))
    }

    /// What should have been kept, and how far it was.
    pub fn balance(&self) -> Balance {
        let (start, end) = (&self.ledger_start, &self.ledger_end);
        let given =
            plus(minus(end.gravity_impulse, start.gravity_impulse), minus(end.wall_impulse, start.wall_impulse));
        // Ground that falls asleep, or lies asleep beside ground awake, takes momentum with it.
        let had = |ledger: &Ledger| plus(ledger.momentum, ledger.slept_momentum);
        let gained = minus(had(end), had(start));
        let about = self.lowest().unwrap_or_default();
        let spin = |ledger: &Ledger| {
            let p = plus(ledger.momentum, ledger.body_momentum);
            let of_motion = std::array::from_fn(|d| {
                let (a, b) = ((d + 1) % 3, (d + 2) % 3);
                about[a] * p[b] - about[b] * p[a]
            });
            minus(plus(ledger.angular_momentum, ledger.body_angular_momentum), of_motion)
        };
        Balance {
            energy_change_j: end.energy() - start.energy(),
            momentum_drift_ns: norm(minus(gained, minus(given, self.to_tools))),
            angular_momentum_change: norm(minus(spin(end), spin(start))),
            resampled_angular_momentum: norm(minus(end.resampled_angular_momentum, start.resampled_angular_momentum)),
        }
    }

    /// The times at which pose and force are compared [s].
    fn samples(&self) -> impl Iterator<Item = f64> + use<'_> {
        (1..).map(|i| f64::from(i) * SAMPLE).take_while(|t| *t <= self.scene.time.end)
    }

    /// Contact of the first tool; `None` if there is none.
    pub fn contact(&self) -> Option<Contact> {
        let impulse_ns = norm(self.tool.last()?.impulse);
        let peak_n = self.samples().filter_map(|t| self.force_at(t)).map(norm).fold(0.0, f64::max);
        Some(Contact { peak_n, impulse_ns })
    }

    /// The first tool at a time [s], straight between steps.
    fn tool_at(&self, time: f64) -> Option<Moment> {
        let after = self.tool.partition_point(|moment| moment.time < time).clamp(1, self.tool.len().max(2) - 1);
        let (a, b) = (self.tool.get(after - 1)?, self.tool.get(after)?);
        let share = ((time - a.time) / (b.time - a.time)).clamp(0.0, 1.0);
        let between = |a: Vec3, b: Vec3| std::array::from_fn(|d| a[d] + share * (b[d] - a[d]));
        Some(Moment { time, position: between(a.position, b.position), impulse: between(a.impulse, b.impulse) })
    }

    /// How far it has come along the ground [m].
    fn way(&self) -> Option<f64> {
        let ([x, y, _], [u, v, _]) = (self.tool.first()?.position, self.tool.last()?.position);
        Some((u - x).hypot(v - y))
    }

    /// Mean force on the first tool over the [`FORCE_WINDOW`] that ends at a time [N].
    fn force_at(&self, time: f64) -> Option<Vec3> {
        let (a, b) = (self.tool_at((time - FORCE_WINDOW).max(0.0))?, self.tool_at(time)?);
        Some(std::array::from_fn(|d| (b.impulse[d] - a.impulse[d]) / FORCE_WINDOW))
    }
}

/// Mean and greatest of some distances [mm].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Norms {
    /// Mean (L1) [mm].
    pub mean_mm: f64,
    /// Greatest (L∞, Hausdorff) [mm].
    pub max_mm: f64,
}

impl Norms {
    fn of(distances: impl Iterator<Item = f64>) -> Self {
        let (sum, max, count) =
            distances.fold((0.0, 0.0f64, 0usize), |(sum, max, count), d| (sum + d, max.max(d), count + 1));
        Self { mean_mm: 1e3 * sum / count.max(1) as f64, max_mm: 1e3 * max }
    }
}

/// Distances between two clouds of particles, each particle to the nearest of the other cloud.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Chamfer {
    /// From the run's particles to the reference's.
    pub to_reference: Norms,
    /// From the reference's particles to the run's.
    pub from_reference: Norms,
}

impl Chamfer {
    /// Sum of both means [mm].
    pub fn sum_mm(&self) -> f64 {
        self.to_reference.mean_mm + self.from_reference.mean_mm
    }
}

/// What a tool has left in the ground near it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Crater {
    /// Depth of the deepest column below the surface at the start [mm].
    pub depth_mm: f64,
    /// Height of the highest column above it [mm].
    pub rim_mm: f64,
    /// Volume of all that lies deeper than it [cm³].
    pub volume_cm3: f64,
}

/// Contact between the ground and the first tool.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Contact {
    /// Greatest force, as a mean over [`FORCE_WINDOW`] [N].
    pub peak_n: f64,
    /// Impulse of the whole run [N s].
    pub impulse_ns: f64,
}

/// How far a run is from the reference.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Errors {
    /// Height of the surface near the tool, on columns one cell of the reference wide.
    pub height_near: Norms,
    /// Height of the surface everywhere.
    pub height: Norms,
    /// What the tool has left near it.
    pub crater: Crater,
    /// That less the reference's.
    pub crater_error: Crater,
    /// Height of the tool at the end less the reference's [mm]; `None` if it is driven.
    pub final_z_mm: Option<f64>,
    /// Root mean square of the difference in the tool's height over time [mm]; `None` if it is driven.
    pub z_rms_mm: Option<f64>,
    /// How far it has come at the end along the ground, less the reference's [mm]; `None` if it is driven.
    pub way_mm: Option<f64>,
    /// Root mean square of the difference in the force on the tool over time [N], as a vector, over [`FORCE_WINDOW`].
    pub force_rms_n: Option<f64>,
    /// Contact of the first tool; `None` if there is none.
    pub contact: Option<Contact>,
    /// That less the reference's.
    pub contact_error: Option<Contact>,
    /// Change of energy less the reference's [J].
    pub energy_error_j: f64,
    /// Particles near the tool at the end.
    pub chamfer_near: Chamfer,
    /// All particles at the end.
    pub chamfer: Chamfer,
    /// Particles near the tool at the start, where nothing has moved: what their lattices alone make.
    pub chamfer_near_floor: Chamfer,
    /// All particles at the start.
    pub chamfer_floor: Chamfer,
}

impl Errors {
    /// Holds a run against the reference of the same extent and duration.
    pub fn of(run: &Record, reference: &Record) -> Self {
        let place = reference.lowest_place();
        let near = |x: f64, y: f64| place.is_none_or(|[px, py]| (x - px).hypot(y - py) < NEAR);
        let column = reference.scene.world.cell;
        let map = |grains: &[Grain]| HeightMap::new(grains, &reference.scene.world, column);
        let [ours, theirs] = [&run.end, &reference.end].map(|grains| map(grains));
        let difference = |i: usize| (ours.heights()[i] - theirs.heights()[i]).abs();
        let columns: Vec<usize> = (0..ours.heights().len()).filter(|i| near(ours.at(*i)[0], ours.at(*i)[1])).collect();
        let crater = |start: &[Grain], end: &HeightMap| {
            let surface = map(start).median();
            columns.iter().map(|i| surface - end.heights()[*i]).fold(Crater::default(), |crater, down| Crater {
                depth_mm: crater.depth_mm.max(1e3 * down),
                rim_mm: crater.rim_mm.max(-1e3 * down),
                volume_cm3: crater.volume_cm3 + 1e6 * down.max(0.0) * column * column,
            })
        };
        let (crater, their_crater) = (crater(&run.start, &ours), crater(&reference.start, &theirs));
        let (contact, their_contact) = (run.contact(), reference.contact());

        let samples: Vec<f64> = run.samples().collect();
        let rms = |squares: Option<Vec<f64>>| squares.map(|s| (s.iter().sum::<f64>() / s.len().max(1) as f64).sqrt());
        let heights = |t: &f64| {
            let apart = run.tool_at(*t)?.position[2] - reference.tool_at(*t)?.position[2];
            run.free.then_some(apart)
        };
        let forces = |t: &f64| {
            let (a, b) = (run.force_at(*t)?, reference.force_at(*t)?);
            Some(norm(minus(a, b)).powi(2))
        };
        let [(all, close), (all_floor, close_floor)] = [(&run.end, &reference.end), (&run.start, &reference.start)]
            .map(|(ours, theirs)| {
                let to = distances(ours, theirs);
                let from = distances(theirs, ours);
                let norms = |grains: &[Grain], distances: &[f64], within: &dyn Fn(&Grain) -> bool| {
                    Norms::of(grains.iter().zip(distances).filter(|(grain, _)| within(grain)).map(|(_, d)| *d))
                };
                let chamfer = |within: &dyn Fn(&Grain) -> bool| Chamfer {
                    to_reference: norms(ours, &to, within),
                    from_reference: norms(theirs, &from, within),
                };
                (chamfer(&|_| true), chamfer(&|g| near(f64::from(g.position[0]), f64::from(g.position[1]))))
            });
        Self {
            height_near: Norms::of(columns.iter().map(|i| difference(*i))),
            height: Norms::of((0..ours.heights().len()).map(difference)),
            crater,
            crater_error: Crater {
                depth_mm: crater.depth_mm - their_crater.depth_mm,
                rim_mm: crater.rim_mm - their_crater.rim_mm,
                volume_cm3: crater.volume_cm3 - their_crater.volume_cm3,
            },
            final_z_mm: heights(&run.scene.time.end).map(|z| 1e3 * z),
            way_mm: run.way().zip(reference.way()).map(|(ours, theirs)| 1e3 * (ours - theirs)).filter(|_| run.free),
            z_rms_mm: rms(samples.iter().map(|t| heights(t).map(|z| (1e3 * z).powi(2))).collect()),
            force_rms_n: rms(samples.iter().map(forces).collect()),
            contact,
            contact_error: contact.zip(their_contact).map(|(ours, theirs)| Contact {
                peak_n: ours.peak_n - theirs.peak_n,
                impulse_ns: ours.impulse_ns - theirs.impulse_ns,
            }),
            energy_error_j: run.balance().energy_change_j - reference.balance().energy_change_j,
            chamfer_near: close,
            chamfer: all,
            chamfer_near_floor: close_floor,
            chamfer_floor: all_floor,
        }
    }
}

/// Distance of each grain to the nearest of others [m].
fn distances(from: &[Grain], to: &[Grain]) -> Vec<f64> {
    let nearest = Nearest::new(to.iter().map(|grain| grain.position.map(f64::from)).collect());
    from.par_iter().map(|grain| nearest.distance(grain.position.map(f64::from))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube_drop() -> Scene {
        barchan_tasks::scene("cube-drop", &["time.step=1e-4"]).unwrap()
    }

    #[test]
    fn a_rung_scales_what_goes_with_the_cell() {
        let rung = rung(&cube_drop(), 0.01, &Levels::default(), None).unwrap();
        assert_eq!((rung.world.cell, rung.body[0].spacing, rung.time.step), (0.01, Some(0.005), Some(5e-5)));
        assert_eq!(rung.world.max, cube_drop().world.max);
    }

    #[test]
    fn a_rung_that_does_not_divide_is_refused_by_name() {
        let refused = |cell: f64, levels: u32, spacing: Option<f64>| {
            let levels = Levels { count: levels, ..Levels::default() };
            rung(&cube_drop(), cell, &levels, spacing).unwrap_err().to_string()
        };
        assert!(refused(0.03, 1, None).contains("world.max"));
        assert!(refused(0.02, 3, None).contains("world.max"));
        let error = refused(0.02, 1, Some(0.3));
        assert!(error.contains("body[0].shape.box") && error.contains("along x"), "{error}");
    }

    /// A fall under a steady force: straight lines between steps give the force back on any step size.
    #[test]
    fn forces_are_means_over_the_window() {
        let scene = cube_drop();
        let moment = |i: i32| {
            let time = 3e-4 * f64::from(i);
            Moment { time, position: [0.0, 0.0, 1.0 - time], impulse: [0.0, 0.0, 7.0 * time] }
        };
        let record = Record {
            scene,
            start: Vec::new(),
            end: Vec::new(),
            cost: Cost::default(),
            ledger_start: Ledger::default(),
            ledger_end: Ledger::default(),
            warnings: Vec::new(),
            to_tools: [0.0; 3],
            tool: (0..100).map(moment).collect(),
            free: true,
        };
        assert!((record.force_at(0.02).unwrap()[2] - 7.0).abs() < 1e-9);
        assert!((record.tool_at(0.0101).unwrap().position[2] - 0.9899).abs() < 1e-12);
        assert!(record.force_at(0.002).unwrap()[2] < 7.0, "the window reaches back before the start");
        let contact = record.contact().unwrap();
        assert!((contact.peak_n - 7.0).abs() < 1e-9 && (contact.impulse_ns - 7.0 * 99.0 * 3e-4).abs() < 1e-12);
    }

    /// A bed that a block was pressed out of and put beside: depth, rim and volume are the block's.
    #[test]
    fn a_crater_has_depth_rim_and_volume() {
        let mut scene = cube_drop();
        (scene.world.cell, scene.world.max) = (0.02, [0.4, 0.4, 0.8]);
        let spacing = 0.01;
        let grain =
            |p: [usize; 3]| Grain { position: p.map(|i| ((i as f64 + 0.5) * spacing) as f32), side: spacing as f32 };
        let all = |keep: &dyn Fn([usize; 3]) -> bool| -> Vec<Grain> {
            let places = (0..40 * 40 * 20).map(|n| [n % 40, n / 40 % 40, n / 1600]);
            places.filter(|p| keep(*p)).map(grain).collect()
        };
        let start = all(&|p| p[2] < 16);
        // 0.12 x 0.12 x 0.04 m lie 0.04 m higher beside where they were.
        let within = |p: [usize; 3], from: usize| (from..from + 12).contains(&p[0]) && (14..26).contains(&p[1]);
        let end = all(&|p| (p[2] < 16 && !(p[2] >= 12 && within(p, 8))) || (p[2] >= 16 && within(p, 20)));
        let record = |end: Vec<Grain>| Record {
            scene: scene.clone(),
            start: start.clone(),
            end,
            cost: Cost::default(),
            ledger_start: Ledger::default(),
            ledger_end: Ledger::default(),
            warnings: Vec::new(),
            to_tools: [0.0; 3],
            tool: Vec::new(),
            free: false,
        };
        let Errors { crater, crater_error, contact, .. } = Errors::of(&record(end), &record(start.clone()));
        assert_eq!(contact, None, "there is no tool");
        // The reference has no crater but for the rounding of positions.
        let pairs = [(crater.depth_mm, crater_error.depth_mm), (crater.volume_cm3, crater_error.volume_cm3)];
        assert!(pairs.iter().all(|(own, off)| (own - off).abs() < 1e-2), "{crater:?} and {crater_error:?}");
        assert!((crater.depth_mm - 40.0).abs() < 1e-3 && (crater.rim_mm - 40.0).abs() < 1e-3, "{crater:?}");
        // Columns are blurred by their width, which takes away from neither volume.
        assert!((crater.volume_cm3 / (1e6 * 0.12 * 0.12 * 0.04) - 1.0).abs() < 0.1, "{crater:?}");
    }

    /// What gravity, a wall, a tool and sleep give adds up to what the ground gains, and a turn about the tool stays one.
    #[test]
    fn a_balance_explains_what_it_can() {
        let mut end = Ledger { momentum: [1.0, 0.0, -4.25], gravity_impulse: [0.0, 0.0, -10.0], ..Ledger::default() };
        end.slept_momentum = [0.0, 0.0, 0.25];
        (end.wall_impulse, end.angular_momentum) = ([1.0, 0.0, 3.0], [0.0, -4.0 - 2.0, 0.0]);
        let tool = Moment { position: [-1.0, 0.0, 2.0], ..Moment::default() };
        let record = Record {
            scene: cube_drop(),
            start: Vec::new(),
            end: Vec::new(),
            cost: Cost::default(),
            ledger_start: Ledger::default(),
            ledger_end: end,
            warnings: Vec::new(),
            to_tools: [0.0, 0.0, -3.5],
            tool: vec![tool],
            free: false,
        };
        let balance = record.balance();
        assert!((balance.momentum_drift_ns - 0.5).abs() < 1e-12, "{balance:?}");
        // Of what turns about the origin, tool x p = (0, -2.25, 0) is no turn about the tool.
        assert!((balance.angular_momentum_change - 3.75).abs() < 1e-12, "{balance:?}");
    }
}
