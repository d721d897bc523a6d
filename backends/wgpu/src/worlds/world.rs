//! The host's record of a world of a batch.

use crate::device::layout::{Periods, by_level};
use crate::device::memory::{MAX_SLOTS, MAX_STEPS};
use crate::device::probed::Exact;
use crate::device::uniforms::Layer;
use crate::passes::laws::{hardens, is_asked_on_device, is_asked_on_host};
use crate::passes::scene::{may_sleep, parameter_vectors, parameters_of, softs, stiffens};
use crate::passes::since_sort::SinceSort;
use crate::worlds::sleep::Slept;
use crate::worlds::soft::Softs;
use crate::worlds::stiffness::{self, lesser};
use barchan_core::backend::Bound;
use barchan_core::coupling::DeviceGroup;
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::Wall;
use barchan_core::{Ledger, LevelPhase, ParticleList, Plan, Result, Scene, SortPhase, Vec3};
use barchan_grid::adapt::Adapt;
use barchan_grid::archive::Reach;
use barchan_grid::limits::{self, FULL_SPEED, LEAST_MASS, MAX_DRIFT, MAX_MOVE, STIFFNESS_AGE};
use std::ops::Range;

/// So many times faster than now particles might become: drifts add up the fastest particle's moves of each step, which jump.
pub(crate) const FASTER: f32 = 2.0;
/// Steps after which laws that are asked on the device are asked on the host, where ground may sleep: the device asks those awake.
pub(crate) const ASLEEP_AGE: u32 = 1000;
/// Ground that needs no more than so many steps a second bears steps of `dt` [s].
pub(crate) fn most_need(dt: f64) -> f32 {
    (1.000_001 / dt).min(f64::from(f32::MAX)) as f32
}

/// How a level goes on in a submission, before anybody has seen it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Foresight {
    /// As its particles move now, and if they become faster. A sort that nobody needs takes a small world's time of two or three steps; one that is missing stops it,
    /// and what has been written down behind is in vain.
    pub(crate) foreseen: SinceSort,
    pub(crate) faster: SinceSort,
    /// How far they move in a step [cells].
    pub(crate) each: f32,
}

impl Foresight {
    /// A step, behind a sort that was due, or not.
    pub(crate) fn step(&mut self, sorted: bool) {
        if sorted {
            (self.foreseen, self.faster) = Default::default();
        }
        self.foreseen = self.foreseen.after(self.each);
        self.faster = self.faster.after(FASTER * self.each);
    }
}

/// The part of the directory that covers a world: first block, blocks along each axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Span {
    pub(crate) first: [i32; 3],
    pub(crate) size: [i32; 3],
}

/// One level of a world: a layer of the device.
#[derive(Clone, Debug, Default)]
pub(crate) struct Level {
    /// Cell width [m].
    pub(crate) h: f64,
    pub(crate) periods: Periods,
    /// Slots of its particles, and its blocks and node blocks since the last sort.
    pub(crate) particles: Range<usize>,
    pub(crate) blocks: Range<usize>,
    pub(crate) node_blocks: Range<usize>,
    /// Least and greatest block, if there are any.
    pub(crate) reach: Option<([i32; 3], [i32; 3])>,
    pub(crate) span: Span,
    pub(crate) since_sort: SinceSort,
    /// Greatest speed of any particle along an axis [m/s].
    pub(crate) particle_speed: f64,
    /// Its steps in one of the simulation.
    pub(crate) steps_within: u32,
    /// Particles that the next sort leaves behind.
    pub(crate) gone: usize,
}

/// Where the law of a world's bodies runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// It has no bodies.
    Nowhere,
    Host,
    Device,
}

/// A world of a batch.
#[derive(Clone)]
pub(crate) struct World {
    pub(crate) materials: Vec<PlannedMaterial>,
    /// Of each, what contact asks of it: stiffness against being pushed into [Pa], and volume over mass [m³/kg].
    pub(crate) contact_materials: Vec<[f32; 4]>,
    pub(crate) scene: Scene,
    /// Finest first.
    pub(crate) levels: Vec<Level>,
    /// Where they are, and who is split and merged.
    pub(crate) adapt: Adapt,
    /// Has that been done since the last step?
    pub(crate) adapted: bool,
    /// Soft bodies that they follow.
    pub(crate) softs: Softs,
    /// What is live, and the archive of what was, if not the whole world is.
    pub(crate) reach: Option<Reach>,
    /// Where its bodies' law runs, once that is known.
    pub(crate) contact: Option<Place>,
    /// On the device, the number of each coupling's first body there.
    pub(crate) first_bodies: Vec<usize>,
    /// And what each coupling's groups ask of it.
    pub(crate) groups: Vec<Vec<DeviceGroup>>,
    /// Each coupling's bodies: name and mass [kg].
    pub(crate) bodies: Vec<Vec<(String, f64)>>,
    /// Steps of the finest level in one.
    pub(crate) substeps: u32,
    /// Has a subcycled step ended in the middle, with finer levels ahead of coarser ones?
    pub(crate) torn: Option<(f64, f64)>,
    pub(crate) last_dt: f64,
    /// Did the last step's numbers stay on the device?
    pub(crate) pending: bool,
    /// Nodes lighter than this carry nothing [kg].
    pub(crate) least_mass: f64,
    /// Of the laws whose stiffness does not follow the state; of those that are asked on the device; of those that are asked on the host, when they
    /// were asked last.
    unchanging: Bound,
    needed: Bound,
    asked: Bound,
    /// Most steps a second of the simulation that are needed by those whom the device asks.
    need: f32,
    /// The least of each material [kg/m³].
    pub(crate) densities: Vec<f64>,
    /// Steps since a law was asked on the host, if any is.
    pub(crate) stiffness_age: u32,
    /// After so many steps that is to be done again.
    pub(crate) ask_after: Option<u32>,
    /// Are laws asked on the device?
    pub(crate) stiffens: bool,
    /// Is that a bound of those awake only?
    sleeps: bool,
    pub(crate) spoilt: bool,
    pub(crate) steps: u64,
    /// Of all live particles [kg].
    pub(crate) mass: f64,
    /// Of the particles that were deleted on leaving the world [kg], and how many they were.
    pub(crate) deleted_mass: f64,
    pub(crate) deleted: u64,
    /// How often particles were put back into the world.
    pub(crate) clamped: u64,
    pub(crate) shortened: u64,
    pub(crate) parted: u64,
    /// What damping has dissipated since the start [J].
    pub(crate) damped: f64,
    pub(crate) wall_impulse: Vec3,
    pub(crate) gravity_impulse: Vec3,
    pub(crate) slept: Slept,
    /// What had crossed the sections of probes, and what walls had taken, before the device began to count, and less what it has counted of others.
    pub(crate) crossed: Vec<Exact>,
}

impl Span {
    /// Places of the directory, at least one.
    pub(crate) fn places(&self) -> u64 {
        self.size.iter().fold(1, |n: u64, &size| n.saturating_mul(size.max(1) as u64))
    }

    /// Is another one part of it?
    pub(crate) fn holds(&self, other: Self) -> bool {
        let end = |span: &Self, d: usize| span.first[d] + span.size[d];
        (0..3).all(|d| self.first[d] <= other.first[d] && end(self, d) >= end(&other, d))
    }
}

impl Level {
    pub(crate) fn new(plan: &Plan, level: usize) -> Self {
        let (min, max) = (plan.cell_min.map(|c| c >> level), plan.cell_max.map(|c| ((c - 1) >> level) + 1));
        let is_periodic = |d: usize| plan.scene.world.walls.pair(d)[0] == Wall::Periodic;
        let periods = Periods {
            first: min.map(|c| c.div_euclid(4)),
            count: std::array::from_fn(|d| if is_periodic(d) { (max[d] - min[d]) / 4 } else { 0 }),
        };
        let steps_within = stiffness::steps_within(plan.substeps, level as u32);
        Self { h: plan.cell_widths[level], periods, steps_within, ..Self::default() }
    }
}

impl World {
    /// Are there groups that answer on the device?
    pub(crate) fn answers(&self) -> bool {
        self.groups.iter().any(|groups| !groups.is_empty())
    }

    /// A world without particles.
    ///
    /// # Errors
    /// If a material does not say how stiff it is.
    pub(crate) fn new(plan: &Plan) -> Result<Self> {
        let unbounded = stiffness::nothing;
        Ok(Self {
            materials: plan.materials.clone(),
            contact_materials: plan.materials.iter().map(|m| contact_material(m, plan)).collect::<Result<_>>()?,
            scene: plan.scene.clone(),
            levels: (0..plan.cell_widths.len()).map(|level| Level::new(plan, level)).collect(),
            adapt: Adapt::new(plan),
            adapted: false,
            softs: Softs::new(softs(plan).into_iter()),
            reach: plan.terrain.clone().map(Reach::new),
            contact: None,
            first_bodies: Vec::new(),
            groups: Vec::new(),
            bodies: Vec::new(),
            substeps: plan.substeps,
            torn: None,
            last_dt: 0.0,
            pending: false,
            least_mass: 0.0,
            unchanging: unbounded(),
            needed: unbounded(),
            asked: unbounded(),
            need: 0.0,
            densities: Vec::new(),
            stiffness_age: 0,
            ask_after: if plan.materials.iter().any(is_asked_on_host) {
                Some(STIFFNESS_AGE)
            } else {
                (stiffens(plan) && may_sleep(plan)).then_some(ASLEEP_AGE)
            },
            stiffens: stiffens(plan),
            sleeps: may_sleep(plan),
            spoilt: false,
            steps: 0,
            mass: 0.0,
            deleted_mass: 0.0,
            deleted: 0,
            clamped: 0,
            shortened: 0,
            parted: 0,
            damped: 0.0,
            wall_impulse: [0.0; 3],
            gravity_impulse: [0.0; 3],
            slept: Slept::default(),
            crossed: Vec::new(),
        })
    }

    /// The parts of the directory around all blocks of its levels that some sorts can find, and so many blocks more: they have drifted by up to a
    /// cell or two, and nodes reach a block further.
    pub(crate) fn spans(&self, sorts: usize, more: i32) -> impl Iterator<Item = Span> {
        // A cell and a half each time is less than a block in two.
        let margin = 2 + sorts as i32 / 2 + more;
        let with = |a: Option<[i32; 3]>, b: Option<[i32; 3]>, f: fn(i32, i32) -> i32| match (a, b) {
            (Some(a), Some(b)) => Some([0, 1, 2].map(|d| f(a[d], b[d]))),
            (one, other) => one.or(other),
        };
        // Where blocks of finer levels are, in blocks of the level.
        self.levels.iter().scan(None, move |finer: &mut Option<([i32; 3], [i32; 3])>, level| {
            let least = with(level.reach.map(|r| r.0), finer.map(|r| r.0), i32::min).unwrap_or_default();
            let greatest = with(level.reach.map(|r| r.1), finer.map(|r| r.1), i32::max).unwrap_or_default();
            *finer = level.reach.map(|_| (least.map(|b| b >> 1), greatest.map(|b| b >> 1)));
            let along = |d: usize| match level.periods.count[d] {
                0 => (least[d] - margin, greatest[d] - least[d] + 1 + 2 * margin),
                count => (level.periods.first[d], count),
            };
            let axes = [0, 1, 2].map(along);
            Some(Span { first: axes.map(|a| a.0), size: axes.map(|a| a.1) })
        })
    }

    /// What the device knows of a level, with its part of the directory from `first_place` on.
    pub(crate) fn layer(&self, l: usize, first_place: u32, on: bool) -> Layer {
        let level = &self.levels[l];
        let felt = if self.least_mass > 0.0 { 1.0 / (self.least_mass * FULL_SPEED) } else { f64::from(f32::MAX) };
        Layer {
            box_min: level.span.first,
            first_place,
            box_size: level.span.size,
            places: level.span.places() as u32,
            on: u32::from(on),
            age: level.since_sort.age,
            drift: level.since_sort.drift,
            least: self.least_mass as f32,
            felt: felt as f32,
            first_particle: level.particles.start as u32,
            level: l as u32,
            shrink: 0.5f32.powi(l as i32),
        }
    }

    /// The age and drift of one of its levels since its last sort, as far as is known if the last step's numbers stayed on the device.
    pub(crate) fn likely(&self, level: &Level) -> SinceSort {
        let moved = (level.particle_speed * self.last_dt / level.h) as f32;
        if self.pending { level.since_sort.after(moved) } else { level.since_sort }
    }

    /// Slots of its particles.
    pub(crate) fn particles(&self) -> Range<usize> {
        let end = |f: fn(&Level) -> usize, level: Option<&Level>| level.map_or(0, f);
        end(|l| l.particles.start, self.levels.first())..end(|l| l.particles.end, self.levels.last())
    }

    /// The greatest stable step.
    pub(crate) fn bound(&self) -> Bound {
        self.bound_within(0)
    }

    /// The same for so many steps from here on. Where levels take steps of their own, the device repeats none that was too long, so those that fall freely must
    /// not become too fast on the way.
    pub(crate) fn bound_within(&self, steps: u64) -> Bound {
        let gravity = self.scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
        let gains = if self.scene.levels.substeps() > 1 { gravity * steps as f64 } else { 0.0 };
        // (v + n g dt) dt is as far as any may move.
        let of_level = |level: &Level| {
            let (speed, most) = (level.particle_speed, MAX_MOVE * level.h);
            let gains = if level.particles.is_empty() { 0.0 } else { gains };
            2.0 * most / (speed + (speed * speed + 4.0 * gains * most).sqrt())
        };
        // NaN, too, is for the step to find.
        let speed =
            self.levels.iter().map(of_level).fold(f64::INFINITY, |least, dt| if dt < least { dt } else { least });
        limits::bound(speed, self.stiffness())
    }

    /// Its particles are to be sorted, at once or before its next step.
    pub(crate) fn be_due(&mut self) {
        self.levels.iter_mut().for_each(|level| level.since_sort = SinceSort::DUE);
    }

    /// What depends on the particles as they come in.
    pub(crate) fn take_stock(&mut self, lists: &[ParticleList], sort: Option<&SortPhase>) -> Result<()> {
        let masses = lists.iter().flat_map(|list| &list.mass);
        let least = masses.clone().copied().fold(f64::INFINITY, f64::min);
        self.mass = masses.sum();
        self.least_mass = if least.is_finite() { least * LEAST_MASS } else { 0.0 };
        for (level, lists) in self.levels.iter_mut().zip(by_level(lists, self.materials.len())) {
            let speeds = lists.iter().flat_map(|list| &list.velocity).flatten();
            level.particle_speed = speeds.fold(0.0, |most: f64, v| if v.is_nan() { *v } else { most.max(v.abs()) });
        }
        if !self.spoilt {
            self.measure_stiffness(lists)?;
        }
        // Without a phase, they lie as a sort would put them, but nobody has looked yet who of them is outside the world: a sort is due.
        for (l, level) in self.levels.iter_mut().enumerate() {
            let drift = |sort: &SortPhase| sort.drift.get(l).map_or(MAX_DRIFT as f32, |drift| *drift as f32);
            level.since_sort = sort.map_or(SinceSort::DUE, |sort| SinceSort { age: sort.age, drift: drift(sort) });
        }
        if let Some(sort) = sort {
            for bound in [&mut self.needed, &mut self.asked].into_iter().filter(|bound| bound.dt.is_finite()) {
                bound.dt = sort.measured.stiffness_bound;
            }
            self.set_needed(self.needed.clone());
            self.stiffness_age = sort.measured.stiffness_age;
            (self.mass, self.least_mass) = (sort.measured.mass, sort.measured.least_mass);
        }
        Ok(())
    }

    /// What depends on particles that come in beside the others.
    pub(crate) fn take_new(&mut self, lists: &[ParticleList]) -> Result<()> {
        let masses = lists.iter().flat_map(|list| &list.mass);
        self.least_mass = masses.fold(self.least_mass, |least, mass| least.min(mass * LEAST_MASS));
        for (level, lists) in self.levels.iter_mut().zip(by_level(lists, self.materials.len())) {
            let speeds = lists.iter().flat_map(|list| &list.velocity).flatten();
            level.particle_speed = speeds.fold(level.particle_speed, |most, v| most.max(v.abs()));
        }
        for list in lists {
            let bound = stiffness::bound(std::slice::from_ref(list), &self.materials, self.substeps)?;
            let planned = &self.materials[list.material as usize];
            let known = match planned {
                planned if is_asked_on_device(planned) => &mut self.needed,
                planned if is_asked_on_host(planned) => &mut self.asked,
                _ => &mut self.unchanging,
            };
            *known = lesser(known.clone(), bound);
            let densities = list.mass.iter().zip(&list.volume0).map(|(m, v)| m / v);
            let least = &mut self.densities[list.material as usize];
            *least = densities.fold(*least, f64::min);
        }
        Ok(())
    }

    pub(crate) fn measure_stiffness(&mut self, lists: &[ParticleList]) -> Result<()> {
        self.stiffness_age = 0;
        let of = |is_asked: fn(&PlannedMaterial) -> bool| {
            let lists = lists.iter().filter(|list| is_asked(&self.materials[list.material as usize]));
            stiffness::bound(lists, &self.materials, self.substeps)
        };
        self.unchanging = of(|planned| !hardens(planned))?;
        let needed = of(is_asked_on_device)?;
        self.asked = of(is_asked_on_host)?;
        self.set_needed(needed);
        let density = |list: &ParticleList| {
            list.mass.iter().zip(&list.volume0).fold(f64::INFINITY, |least, (m, v)| least.min(m / v))
        };
        let of_material = |m: usize| by_level(lists, self.materials.len()).map(move |lists| density(&lists[m]));
        self.densities = (0..self.materials.len()).map(|m| of_material(m).fold(f64::INFINITY, f64::min)).collect();
        Ok(())
    }

    /// Laws have been asked on the device: particles of each level, finest first, need so many steps a second.
    pub(crate) fn take_needs(&mut self, needs: impl Iterator<Item = f32>) {
        // Those asleep are not asked: what they needed when they fell asleep is kept. The device does so, too, from step to step, so that it
        // does not matter after which of them anyone looks.
        let before = if self.sleeps { self.need } else { 0.0 };
        self.need = needs.zip(&self.levels).fold(before, |most, (need, level)| {
            // A power of two: exact, as on the device.
            let need = need / level.steps_within as f32;
            if most.is_nan() || need <= most { most } else { need }
        });
        self.needed = stiffness::bound_of_need(&self.materials, self.need);
    }

    /// Laws that the device asks have been asked here.
    pub(crate) fn set_needed(&mut self, needed: Bound) {
        self.need = (1.0 / needed.dt) as f32;
        self.needed = needed;
    }

    /// Laws have been asked on the host: those that are always asked there, and, if ground may sleep, the others, whose bounds are these.
    pub(crate) fn take_asked(&mut self, asked: Bound, needed: Option<Bound>) {
        self.stiffness_age = 0;
        self.asked = asked;
        if let Some(needed) = needed {
            self.set_needed(needed);
        }
    }

    /// Are those that the device asks asked on the host, too, since some may be asleep?
    pub(crate) fn asks_those_asleep(&self) -> bool {
        self.stiffens && self.sleeps
    }

    /// The greatest step that stiffness allows.
    pub(crate) fn stiffness(&self) -> Bound {
        [&self.needed, &self.asked].into_iter().cloned().fold(self.unchanging.clone(), lesser)
    }

    /// What part of gravity there is in a step that starts at a time [s].
    pub(crate) fn grown(&self, time: f64) -> f32 {
        let (now, full) = (self.scene.gravity_at(time), self.scene.gravity);
        (0..3).find(|d| full[*d] != 0.0).map_or(1.0, |d| (now[d] / full[d]) as f32)
    }

    /// Ground of that mass has come within reach, or fallen out of it [kg].
    pub(crate) fn come(&mut self, mass: f64) {
        self.mass += mass;
    }

    /// Particles of that mass have been deleted [kg].
    pub(crate) fn delete(&mut self, mass: f64) {
        self.mass -= mass;
        self.deleted_mass += mass;
    }

    /// Goes on from what an engine before this one has summed up.
    pub(crate) fn carry_on(&mut self, sums: &Ledger) {
        (self.wall_impulse, self.gravity_impulse) = (sums.wall_impulse, sums.gravity_impulse);
        (self.deleted_mass, self.deleted, self.clamped) = (sums.deleted_mass, 0, 0);
        (self.shortened, self.parted) = (0, 0);
        self.slept = Slept { blocks: 0, kinetic: sums.slept_kinetic, momentum: sums.slept_momentum };
        self.damped = sums.damped;
        self.adapt.carry_on(sums);
        if let Some(reach) = &mut self.reach {
            reach.carry_on(sums);
        }
    }

    /// Steps that are to have one length.
    pub(crate) fn stride(&self) -> u64 {
        match self.scene.tool.is_empty() && self.scene.robot.is_empty() && self.scene.coupling.is_empty() {
            _ if self.ask_after == Some(STIFFNESS_AGE) => u64::from(STIFFNESS_AGE),
            // What grew stiff for a while is not to shorten all of them.
            true if !self.stiffens => MAX_STEPS as u64,
            // A step has to be short enough for all that bodies do in so many.
            _ => MAX_SLOTS as u64 / 2,
        }
    }

    /// Has the ground become too stiff for steps of this length? The device stops before one in just this case.
    pub(crate) fn is_outgrown(&self, dt: f64) -> bool {
        let is_borne = || self.need <= most_need(dt) && dt <= 1.000_002 * self.stiffness().dt;
        self.stiffens && !is_borne()
    }

    /// What a snapshot holds of its levels; `None` if there is one only.
    pub(crate) fn phase(&self) -> Option<LevelPhase> {
        self.adapt.phase(self.reach.as_ref().map(Reach::live).unwrap_or_default())
    }

    /// Takes back what gravity has not given to ground asleep on a level: its mass, times gravity's part, summed over the level's steps [kg].
    pub(crate) fn unbook_gravity(&mut self, l: usize, slept: f64) {
        let impulse = self.kept_from_gravity(l, slept);
        (0..3).for_each(|d| self.gravity_impulse[d] -= impulse[d]);
    }

    /// What that comes to in the last steps [N s].
    pub(crate) fn kept_from_gravity(&self, l: usize, slept: f64) -> Vec3 {
        self.scene.gravity.map(|g| slept * g * self.last_dt / f64::from(self.levels[l].steps_within))
    }

    pub(crate) fn book_gravity(&mut self, mut time: f64, dt: f64, steps: usize) {
        for _ in 0..steps {
            let gravity = self.scene.gravity_at(time);
            // As a simulation counts it.
            time += dt;
            for (impulse, g) in self.gravity_impulse.iter_mut().zip(gravity) {
                *impulse += self.mass * g * dt;
            }
        }
    }
}

/// See [`World::contact_materials`].
fn contact_material(material: &PlannedMaterial, plan: &Plan) -> Result<[f32; 4]> {
    let modulus = material.contact_modulus(&plan.scene)?;
    Ok([modulus as f32, (1.0 / material.density) as f32, 0.0, 0.0])
}

/// The materials' parameters of a world, as passes read them.
pub(crate) fn parameters(plan: &Plan) -> Vec<[f32; 4]> {
    let mut values: Vec<f32> = plan.materials.iter().flat_map(parameters_of).map(|p| p as f32).collect();
    values.resize(4 * parameter_vectors(plan), 0.0);
    values.chunks_exact(4).map(|v| [v[0], v[1], v[2], v[3]]).collect()
}
