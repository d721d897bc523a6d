//! Backends: where particles live and a step is carried out.

use crate::gradient::Gradient;
use crate::parameter::Parameter;
use crate::plan::PlannedMaterial;
use crate::probe::Filter;
use crate::task::{Sampled, Watch, chosen};
use crate::{
    Aabb, Adapted, Apart, BodyState, Coupling, Crossed, Fields, Form, Ledger, Newcomer, ParticleList, ParticleState,
    Plan, Reading, Result, Sought, Spot, Stage, Sums, Tile, Vec3, Wrench,
};
use std::sync::Arc;

/// A way to run a plan, such as `cpu`.
pub trait Backend: Send + Sync {
    /// Name in scenes and on the command line.
    fn name(&self) -> &str;
    /// One paragraph.
    fn doc(&self) -> &str;
    /// What it can be asked for beyond what every backend is ([`Options::backend_parameters`](crate::Options::backend_parameters)); the values are in
    /// [`Plan::backend_parameters`].
    fn parameters(&self) -> Vec<Parameter> {
        Vec::new()
    }
    /// What it can run on besides the processor, best first: GPUs, and software in their place. `None`: nothing, so that naming one
    /// in [`crate::Options`] is an error.
    fn adapters(&self) -> Option<Vec<Adapter>> {
        None
    }
    /// Has it this form of a stage? A plan with a stage that it cannot carry out is refused by the stage's name.
    fn has_form(&self, stage: Stage, form: Form) -> bool;
    /// Finds out what [`compile`](Self::compile) would refuse of the plan, without building anything.
    ///
    /// # Errors
    /// As [`compile`](Self::compile).
    fn check(&self, plan: &Plan) -> Result<()> {
        let _ = plan;
        Ok(())
    }
    /// Finds out what is wrong with the forms that couplings have for it, such as their WGSL. Whether it uses them depends on the state, so it is asked before.
    ///
    /// # Errors
    /// Names the coupling.
    fn check_couplings(&self, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        let _ = couplings;
        Ok(())
    }
    /// Most particles that the adapter has room for, of a law with so many values of strain and history: asked before any is seeded. `None`: only
    /// memory bounds them.
    ///
    /// # Errors
    /// No such adapter.
    fn most_particles(&self, adapter: Option<&str>, values: usize) -> Result<Option<u64>> {
        let _ = (adapter, values);
        Ok(None)
    }
    /// The passes that a plan calls for, a line each, for people: what each takes and touches. Empty where there is nothing to say
    /// beyond the plan's stages.
    fn passes(&self, plan: &Plan) -> Vec<String> {
        let _ = plan;
        Vec::new()
    }
    /// Builds exactly the passes that the plan calls for and takes in the particles. A phase of the sort that is not its own
    /// cannot come here: the simulation leaves it out.
    ///
    /// # Errors
    /// [`crate::Error::Missing`] if it lacks a form of a stage, by name.
    fn compile(&self, plan: &Plan, particles: ParticleState) -> Result<Box<dyn Engine>>;
    /// What goes back through steps of the plan, for [gradients](crate::gradient).
    ///
    /// # Errors
    /// [`crate::Error::Missing`] if it has no [adjoint forms](Form::Adjoint).
    fn adjoint(&self, plan: &Plan) -> Result<Box<dyn Adjoint>> {
        let _ = plan;
        Err(crate::Error::Missing {
            kind: "backend",
            name: self.name().to_owned(),
            origin: "registered".to_owned(),
            what: format!("{} of any stage", Form::Adjoint),
            why: "gradients go back through every stage of a step".to_owned(),
            mend: "choose another backend".to_owned(),
        })
    }
    /// Can it step worlds together in the same passes? Otherwise they are compiled one by one.
    fn has_batches(&self) -> bool {
        false
    }
    /// Builds worlds that step together, each the bits that it would be alone if it took the same steps.
    ///
    /// # Errors
    /// As [`compile`](Self::compile), and [`crate::Error::Missing`] if it [has no batches](Self::has_batches), or if worlds differ in what
    /// they must have in common, by name.
    fn compile_batch(&self, worlds: Vec<NewWorld<'_>>) -> Result<Box<dyn Batch>> {
        Err(crate::Error::Missing {
            kind: "backend",
            name: self.name().to_owned(),
            origin: "it compiles worlds one by one".to_owned(),
            what: "batches".to_owned(),
            why: format!("{} worlds are to step together", worlds.len()),
            mend: "compile each on its own".to_owned(),
        })
    }
}

/// What a world of a batch is made from.
pub struct NewWorld<'a> {
    /// What is simulated.
    pub plan: &'a Plan,
    /// Its particles.
    pub particles: ParticleState,
    /// Its couplings, to look at.
    pub couplings: &'a [Box<dyn Coupling>],
}

/// A world's part in steps of a batch.
pub struct WorldStep<'a> {
    /// Number of the world.
    pub world: usize,
    /// Its time [s].
    pub time: f64,
    /// Its couplings.
    pub couplings: &'a mut [Box<dyn Coupling>],
    /// Are [reports](StepReport::bodies) to say where its bodies are after each of several steps?
    pub reports_bodies: bool,
}

/// What is to be looked at in a world of a batch.
#[derive(Clone, Debug, Default)]
pub struct Look<'a> {
    /// The plan's materials.
    pub materials: &'a [PlannedMaterial],
    /// Regions to sum over.
    pub sought: &'a [Sought],
    /// How many particles are sampled of each level.
    pub sample: &'a [usize],
    /// Where heights of the ground are wanted [m], inside the world along periodic axes.
    pub points: Vec<[f64; 2]>,
    /// Height below which there is nothing [m].
    pub bottom: f64,
}

impl<'a> Look<'a> {
    /// What a task wants to see of a world of that plan, as far as a batch finds it.
    pub fn new(plan: &'a Plan, watch: &'a Watch) -> Self {
        let world = &plan.scene.world;
        let points = watch.heights.iter().map(|point| world.inside(*point)).collect();
        Self { materials: &plan.materials, sought: &watch.sums, sample: &watch.sample, points, bottom: world.min[2] }
    }
}

/// What was seen there.
#[derive(Clone, Debug, Default)]
pub struct Looked {
    /// Sums over regions.
    pub sums: Vec<Sums>,
    /// Particles that were sampled.
    pub sample: Vec<Sampled>,
    /// Heights of the ground [m], none where there is none; nothing if they are [left to others](Engine::heights).
    pub heights: Option<Vec<Option<f64>>>,
}

/// Worlds that step together.
pub trait Batch: Send {
    /// A world's engine, which shares the batch. Steps that are taken through it move that world alone.
    fn engine(&self, world: usize) -> Box<dyn Engine>;
    /// As [`Engine::steps`], for the worlds given; the others stay as they are. All that succeed take the same steps. A world
    /// that fails is as it was, its result says why, and the others go on without it.
    ///
    /// # Errors
    /// What is no world's own fault, such as a device that was lost.
    fn steps(&mut self, dt: f64, count: usize, worlds: &mut [WorldStep<'_>]) -> Result<Vec<Result<Vec<StepReport>>>>;
    /// Looks at all worlds: what [`Engine::sums`], [`Engine::sample`] and [`Engine::heights`] find in each. A device needs one transfer for it.
    ///
    /// # Errors
    /// As [`Engine::sums`], and a device that was lost.
    fn look(&mut self, looks: &[Look<'_>]) -> Result<Vec<Looked>> {
        let of_one = |(world, look): (usize, &Look<'_>)| {
            let engine = self.engine(world);
            Ok(Looked {
                sums: engine.sums(look.materials, look.sought)?,
                sample: engine.sample(look.sample),
                heights: engine.heights(&look.points, look.bottom),
            })
        };
        looks.iter().enumerate().map(of_one).collect()
    }
    /// Replaces the particles of some worlds, as [`Engine::upload`] does those of one.
    ///
    /// # Errors
    /// If a state does not fit its plan, and a device that was lost.
    fn upload(&mut self, states: Vec<(usize, ParticleState)>) -> Result<()> {
        states.into_iter().try_for_each(|(world, particles)| self.engine(world).upload(particles))
    }
    /// Puts a new world in the place of an old one, which is as it was on an error.
    ///
    /// # Errors
    /// As [`Backend::compile_batch`].
    fn replace(&mut self, world: usize, new: NewWorld<'_>) -> Result<()>;
    /// Puts a copy of one world, of that plan, in the place of another, which is as it was on an error: particles where they are, all that
    /// is known of them, and what has been summed up. It goes on as the first one does, bit for bit, if both take the same steps.
    ///
    /// # Errors
    /// What a copy has no room for, and a device that was lost.
    fn copy(&mut self, from: usize, to: usize, plan: &Plan) -> Result<()>;
}

/// A device that a backend can run on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// Name, by which it may be chosen.
    pub name: String,
    /// Kind, interface, driver, and what it offers, for people.
    pub doc: String,
}

/// The greatest stable time step and what sets it.
#[derive(Clone, Debug, PartialEq)]
pub struct Bound {
    /// Seconds; infinite if nothing bounds it.
    pub dt: f64,
    /// Such as "stiffness of material 'sand'" or "particle speed".
    pub by: String,
}

/// What one step did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// The step taken [s], at most the one asked for.
    pub dt: f64,
    /// Did the engine sort its particles?
    pub sorted: bool,
    /// Greatest node speed [m/s].
    pub max_speed: f64,
    /// Mean wrench on each body over the step, all couplings' bodies in their order, if the couplings took several steps
    /// within it; otherwise they know it themselves.
    pub wrenches: Option<Vec<Wrench>>,
    /// Bodies after the step, all couplings' in their order, if the engine has taken further steps since, and somebody asks for them
    /// ([`Simulation::report_bodies`](crate::Simulation::report_bodies)).
    pub bodies: Option<Vec<BodyState>>,
    /// What became of nested levels and their particles before the step, if anything did.
    pub adapted: Option<Arc<Adapted>>,
}

/// Time and calls of one effect since the start.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timing {
    /// Effect, such as "P2G" or "material sand".
    pub effect: String,
    /// Wall seconds; for effects inside a parallel pass, their share of it.
    pub seconds: f64,
    /// Passes run.
    pub passes: u64,
}

/// Goes back through steps.
pub trait Adjoint: Send {
    /// From what a loss owes to the particles after a step to what it owes to those before it, which are given, and to what is the same in all steps. The step began at `time` and took
    /// `dt` [s]; the couplings are as they were before it, and may be left otherwise. `adapted` is what became of levels and their particles in it, before anything moved. In one of no
    /// length nothing moves: C changes the strain that [lags behind](ParticleState::strain_dt), and no more.
    ///
    /// # Errors
    /// [`crate::Error::MaterialFailed`] if a law fails, or a derivative of it is not finite; [`crate::Error::Body`] for a body whose motion in a step of this kind has no adjoint.
    fn step_back(
        &mut self,
        before: &ParticleState,
        couplings: &mut [Box<dyn Coupling>],
        time: f64,
        dt: f64,
        adapted: Option<&Adapted>,
        gradient: &mut Gradient,
    ) -> Result<()>;
    /// Particles as they are once levels and particles have changed, strain as it was.
    ///
    /// # Errors
    /// [`crate::Error::Body`] if there are no such particles.
    fn adapted(&self, before: &ParticleState, adapted: &Adapted) -> Result<ParticleState>;
}

/// A compiled plan with its particles.
pub trait Engine: Send {
    /// Greatest stable step of the present state, before any safety factor. Cheap: called before every step.
    fn bound(&self) -> Bound;
    /// The same for so many steps from here on: one that knows no bound after each of them has to foresee how much faster particles become.
    fn bound_within(&self, steps: u64) -> Bound {
        let _ = steps;
        self.bound()
    }
    /// How many steps are to have one length: it is chosen before every so manieth step of the simulation, or more often where tools become
    /// faster, wherever anyone looks in between, so that looking changes nothing. An engine that knows its bound after each step says 1.
    fn stride(&self) -> u64 {
        1
    }
    /// Has the ground become too stiff for steps of `dt` [s] that were chosen before? They are chosen anew then. An engine that takes many steps
    /// at once stops before the next one in just this case, so that looking in between changes nothing.
    fn is_outgrown(&self, dt: f64) -> bool {
        let _ = dt;
        false
    }
    /// One step of at most `dt` seconds from `time`. The engine may take a shorter one (and says so) if node speeds or
    /// deformations would otherwise exceed their limits. On an error the particles are those before the step, and so is what it has booked.
    ///
    /// # Errors
    /// NaN or infinity, a material's failure, a particle that left the world.
    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport>;
    /// Up to `count` steps of at most `dt` each, one after the other from `time`; at least one. An engine that is faster when it is
    /// asked for many at once takes as many as it can without anyone looking in between; gravity follows the time. One that is shorter than
    /// asked is the last. Returns what each did, and where bodies were after it only if `bodies` says so, since that takes time. On an error,
    /// everything is as before the first of them.
    ///
    /// # Errors
    /// As [`step`](Self::step), of the first step.
    fn steps(
        &mut self,
        time: f64,
        dt: f64,
        count: usize,
        couplings: &mut [Box<dyn Coupling>],
        bodies: bool,
    ) -> Result<Vec<StepReport>> {
        let _ = (count, bodies);
        Ok(vec![self.step(time, dt, couplings)?])
    }
    /// Copies the particles out, with the phase of the sort, so that a copy continues bit for bit.
    fn download(&self) -> ParticleState;
    /// As [`download`](Self::download), with [what the engine keeps of particles besides](ParticleState::kept), so that one that is compiled with this
    /// state goes on with the same bits.
    fn state(&self) -> ParticleState {
        self.download()
    }
    /// Are the particles still there to be copied out? A device can be lost.
    ///
    /// # Errors
    /// [`Error::Device`](crate::Error::Device) if they are not: what was copied since is worth nothing.
    fn check(&self) -> Result<()> {
        Ok(())
    }
    /// Where every particle is and how large, in the order of [`download`](Self::download) but without the rest of its state; then
    /// those in the archive of ground out of reach.
    fn spots(&self) -> Vec<Spot> {
        let lists = self.download_where(None, &|_| true).lists;
        lists.iter().flat_map(|list| (0..list.len()).map(|i| list.spot(i))).collect()
    }
    /// Copies out the particles for which `wanted` holds, all of which are in the region if there is one: the same lists as [`download`](Self::download),
    /// shorter, without the phase of the sort. Then follow lists of those in the archive of ground out of reach.
    fn download_where(&self, region: Option<&Aabb>, wanted: &(dyn Fn(&Spot) -> bool + Sync)) -> ParticleState {
        let _ = region;
        let mut particles = ParticleState { sort: None, ..self.download() };
        let archive = std::mem::take(&mut particles.archive);
        particles.lists.extend(archive.values().flat_map(Tile::unpack));
        particles.lists.iter_mut().for_each(|list| list.retain(wanted));
        particles
    }
    /// Reads some values of the particles in a region, and of those in the archive there: f32 positions are counted from `origin` [m].
    fn read(&self, region: Option<&Aabb>, fields: Fields, origin: Vec3) -> Reading {
        let mut reading = Reading::new(fields, origin);
        let inside = |spot: &Spot| region.is_none_or(|region| region.contains(spot.position));
        self.download_where(region, &inside).lists.iter().for_each(|list| reading.add_list(list, None));
        reading
    }
    /// A sample of the particles, so many of each level, as [`Seen::sample`](crate::task::Seen::sample) says. The archive is left out.
    fn sample(&self, counts: &[usize]) -> Vec<Sampled> {
        let particles = self.download();
        let levels = particles.lists.iter().map(|list| list.level as usize + 1).max().unwrap_or_default();
        let mut by_level: Vec<Vec<(usize, usize)>> = vec![Vec::new(); levels];
        for (l, list) in particles.lists.iter().enumerate() {
            by_level[list.level as usize].extend((0..list.len()).map(|i| (l, i)));
        }
        let present: Vec<usize> = by_level.iter().map(Vec::len).collect();
        let sampled = |(level, number): (usize, usize)| {
            let (l, i) = by_level[level][number];
            let list = &particles.lists[l];
            Sampled { position: list.position(i), velocity: list.velocity[i] }
        };
        chosen(counts, &present).into_iter().map(sampled).collect()
    }
    /// Heights of the ground at points [m], which are inside the world, none where there is none, as [`Simulation::heights`](crate::Simulation::heights) says;
    /// below `bottom` [m] there is nothing. `None` leaves them to whoever asks, who reads the particles.
    fn heights(&self, points: &[[f64; 2]], bottom: f64) -> Option<Vec<Option<f64>>> {
        let _ = (points, bottom);
        None
    }
    /// Which points of the ground plan [m] lie out of reach where nothing has changed the ground: it is as the scene's shapes say.
    fn untouched(&self, points: &[[f64; 2]]) -> Vec<bool> {
        vec![false; points.len()]
    }
    /// How far points [m] and the particles that count are from one another; those in the archive of ground out of reach are among them. `None` leaves it to whoever
    /// asks, who reads the particles.
    ///
    /// # Errors
    /// What a device refuses.
    fn apart(&self, points: &[Vec3], filter: Filter) -> Result<Option<Apart>> {
        let _ = (points, filter);
        Ok(None)
    }
    /// Sums over the particles in regions, and over those in the archive there. `materials` are the plan's.
    ///
    /// # Errors
    /// What laws say that are asked for stress.
    fn sums(&self, materials: &[PlannedMaterial], sought: &[Sought]) -> Result<Vec<Sums>> {
        let of_one = |sought: &Sought| {
            let inside = |spot: &Spot| sought.region.contains(spot.position);
            let mut sums = Sums::default();
            for list in &self.download_where(Some(&sought.region.bounds()), &inside).lists {
                sums.add_list(sought, &materials[list.material as usize], list)?;
            }
            Ok(sums)
        };
        sought.iter().map(of_one).collect()
    }
    /// What has crossed each of the plan's sections since the scene's start. A backend with a form of [`Stage::FLUX`] knows.
    ///
    /// # Errors
    /// What it cannot read.
    fn crossed(&self) -> Result<Vec<Crossed>> {
        Ok(Vec::new())
    }
    /// Impulse of the ground on each of the parts of walls of the plan's probes since the scene's start [N s]. A backend with a form of [`Stage::PRESS`] knows.
    fn pressed(&self) -> Vec<Vec3> {
        Vec::new()
    }
    /// Replaces the particles.
    ///
    /// # Errors
    /// If the state does not fit the plan.
    fn upload(&mut self, particles: ParticleState) -> Result<()>;
    /// Takes particles out of the simulation: those for which `gone` holds. Returns them, in lists as those of [`download`](Self::download). Called between steps,
    /// at `time` [s].
    ///
    /// # Errors
    /// [`Error::Device`](crate::Error::Device) if a device was lost.
    fn take_out(&mut self, time: f64, gone: &(dyn Fn(&Spot) -> bool + Sync)) -> Result<Vec<ParticleList>> {
        let _ = time;
        let mut particles = ParticleState { sort: None, ..self.download() };
        self.check()?;
        let mut out = particles.lists.clone();
        out.iter_mut().for_each(|list| list.retain(gone));
        particles.lists.iter_mut().for_each(|list| list.retain(|spot| !gone(spot)));
        self.upload(particles)?;
        Ok(out)
    }
    /// Brings particles into the simulation, which [`Plan::newcomers`] makes of them. Returns these. Called between steps, at `time` [s]. Numbers start at
    /// `next_id` or later, which moves on.
    ///
    /// # Errors
    /// [`Error::Capacity`](crate::Error::Capacity) if there is no room for them, [`Error::Device`](crate::Error::Device) if a device was lost.
    fn bring_in(&mut self, plan: &Plan, time: f64, come: &[Newcomer], next_id: &mut u64) -> Result<Vec<ParticleList>> {
        let _ = time;
        let mut particles = ParticleState { sort: None, ..self.download() };
        self.check()?;
        let mut regions = plan.regions.clone();
        if let Some(phase) = &mut particles.levels {
            regions.restore(phase.boxes.clone());
            *next_id = phase.next_id.max(*next_id);
        }
        let lists = plan.newcomers(come, &regions, next_id);
        if let Some(phase) = &mut particles.levels {
            phase.next_id = *next_id;
        }
        particles.lists.iter_mut().zip(&lists).for_each(|(list, new)| list.append(new.clone()));
        self.upload(particles)?;
        Ok(lists)
    }
    /// Number of particles.
    fn particle_count(&self) -> usize;
    /// Adds the particles' mass, momenta, energies and counts to a ledger.
    fn account(&self, ledger: &mut Ledger);
    /// Goes on from what another engine has summed up over time, all but the counts: what is summed from then on is added to these numbers one
    /// by one, so that a run that is cut in two has the sums of a whole one, bit for bit. Called before the first step.
    fn carry_on(&mut self, sums: &Ledger);
    /// Time by effect since the start.
    fn timings(&self) -> Vec<Timing>;
    /// Bytes resident for particles and grid: (particles, grid).
    fn memory(&self) -> (u64, u64);
    /// How often something that somebody asked for was copied from a device to the host, and how many bytes in all, for all worlds of a batch together. What steps
    /// report is not counted.
    fn transferred(&self) -> (u64, u64) {
        (0, 0)
    }
}
