//! Gradients: what a loss at the end of some steps owes to what was before them.
//!
//! A [`Tape`] remembers where these steps began and how long they were, and no more. To pull a loss back it takes them again, keeps the particles of as many
//! steps at a time as there are such stretches, and goes back through each stretch step by step ([`Adjoint`]). So it needs room for twice the root of the
//! number of steps, and takes them twice. Nothing is clipped.

use crate::coupling::Kept;
use crate::{
    Adapted, Adjoint, Backend, Coupling, Engine, Error, Form, Options, ParticleState, Plan, Registry, Result,
    Simulation, Stage, Vec3, Wrench,
};
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex, PoisonError};

/// Most history variables of a law that gradients go through.
pub const MOST_STATES: usize = 16;

/// Derivatives of a loss by what particles are: for each particle, in the order of their numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cotangents {
    /// By position [1/m].
    pub position: Vec<Vec3>,
    /// By velocity [s/m].
    pub velocity: Vec<Vec3>,
    /// By the affine matrix C, row-major [s].
    pub affine: Vec<[f64; 9]>,
    /// By strain: F row-major, or the six values xx, yy, zz, xy, xz, yz of b_e, where one off the diagonal stands for two entries.
    pub strain: Vec<[f64; 9]>,
    /// By the law's history variables.
    pub state: Vec<[f64; MOST_STATES]>,
    /// Are strain and history those that C has [yet to change](ParticleState::strain_dt)?
    pub lags: bool,
    /// By tools and other bodies of couplings, in the scene's order; empty if nothing is owed to them.
    pub bodies: Vec<BodyCotangents>,
    /// By robots' joints, in the scene's order; empty if nothing is owed to them, as each one's numbers may be.
    pub robots: Vec<RobotCotangents>,
}

/// Derivatives of a loss by a robot's joints. Its base, as its links, is among the bodies.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotCotangents {
    /// By their positions [1/rad or 1/m].
    pub positions: Vec<f64>,
    /// By their rates [s/rad or s/m].
    pub rates: Vec<f64>,
    /// By the energy that later steps make up for, twice: what a robot has too much of that has coiled up too far to turn so fast [1/J].
    pub energy: f64,
}

/// Derivatives of a loss by what a robot's motors were told over a tape, and by their gains, joint by joint: 0 where the motor's effort or speed was at its bound, and by
/// targets at a joint's limit, within which commands are kept.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotGradient {
    /// By joint targets [1/rad or 1/m]; of motion that the scene gives, by all of its positions alike.
    pub targets: Vec<f64>,
    /// By target rates, likewise [s/rad or s/m].
    pub rates: Vec<f64>,
    /// By torques or forces besides [1/(N m) or 1/N].
    pub torques: Vec<f64>,
    /// By the gains: torque for each unit of position, and of rate.
    pub kp: Vec<f64>,
    /// The latter.
    pub kd: Vec<f64>,
}

/// Derivatives of a loss by what a body of a coupling is and felt.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BodyCotangents {
    /// By where it is. At the start of a tape a robot's is its base's, and 0 for the other links.
    pub pose: PoseCotangent,
    /// By the velocity of its reference point [s/m]. At the start of a tape it is 0 for a body that is driven: there it goes to what that was told.
    pub velocity: Vec3,
    /// By its angular velocity, likewise [s/rad]; 0 for one in a guide.
    pub angular_velocity: Vec3,
    /// By the impulse of the ground on it over the tape [1/(N s)], and the angular impulse about its reference point [1/(N m s)]. At the start of a tape it is 0.
    pub impulse: Wrench,
}

/// Derivatives of a loss by where a body is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseCotangent {
    /// By its reference point: its centre of mass if it is free, else its frame's origin [1/m].
    pub position: Vec3,
    /// By its rotation, as a small turn on top of it, about axes through the reference point along the world's [1/rad].
    pub rotation: Vec3,
}

/// Derivatives of a loss by what a body was told over a tape, and by what it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BodyGradient {
    /// By its velocity, if it is driven by velocity [s/m].
    pub linear: Vec3,
    /// By its angular velocity, likewise [s/rad].
    pub angular: Vec3,
    /// By the positions of its keyframes, if it moves along some [1/m].
    pub keyframes: Vec<Vec3>,
    /// By its coefficient of friction: 0 for contact that knows none. Of a robot it is of all links together, and stands with the base.
    pub friction: f64,
    /// By its mass, with which its inertia grows, if it answers the ground's impulses [1/kg]; a link's is its own.
    pub mass: f64,
    /// By the whole force of its servo [1/N], with the mass that follows it where the scene gives none.
    pub force: f64,
}

impl RobotCotangents {
    /// Of a loss that owes nothing to so many joints.
    pub fn zero(joints: usize) -> Self {
        Self { positions: vec![0.0; joints], rates: vec![0.0; joints], energy: 0.0 }
    }
}

impl Cotangents {
    /// Of a loss that owes nothing to so many particles.
    pub fn zero(particles: usize) -> Self {
        Self {
            position: vec![[0.0; 3]; particles],
            velocity: vec![[0.0; 3]; particles],
            affine: vec![[0.0; 9]; particles],
            strain: vec![[0.0; 9]; particles],
            state: vec![[0.0; MOST_STATES]; particles],
            lags: false,
            bodies: Vec::new(),
            robots: Vec::new(),
        }
    }

    /// Number of particles.
    pub fn len(&self) -> usize {
        self.position.len()
    }
    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.position.is_empty()
    }
}

/// What a loss at the end of a [`Tape`] owes to what was at its start, and to what was the same throughout.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gradient {
    /// By the particles at the start.
    pub particles: Cotangents,
    /// By each parameter of each of the plan's materials, in their order: 0 for those that the law does not declare differentiable.
    pub parameters: Vec<Vec<f64>>,
    /// By gravity [s²/m].
    pub gravity: Vec3,
    /// By what each body of the couplings was told, in the scene's order.
    pub bodies: Vec<BodyGradient>,
    /// By what each robot was told, in the scene's order.
    pub robots: Vec<RobotGradient>,
}

/// Where a robot's joints are.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotPose {
    /// The robot's name.
    pub name: String,
    /// Positions of its joints, in the order of commands [rad or m].
    pub positions: Vec<f64>,
    /// Their rates [rad/s or m/s].
    pub rates: Vec<f64>,
}

/// Where a body of a coupling is.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyPose {
    /// Its name.
    pub name: String,
    /// Its reference point [m].
    pub position: Vec3,
    /// Its orientation quaternion (w, x, y, z).
    pub rotation: [f64; 4],
    /// Velocity of its reference point [m/s], and angular velocity [rad/s], if it answers the ground's impulses; else 0.
    pub twist: [Vec3; 2],
}

/// Where particles are and how fast, in the order of their numbers, and where bodies of couplings are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moment {
    /// When [s].
    pub time: f64,
    /// Numbers.
    pub id: Vec<u64>,
    /// Numbers of the scene's bodies that they were seeded for.
    pub body: Vec<u16>,
    /// Numbers of their materials, in the plan's order.
    pub material: Vec<u16>,
    /// Masses [kg].
    pub mass: Vec<f64>,
    /// Positions [m].
    pub position: Vec<Vec3>,
    /// Velocities [m/s].
    pub velocity: Vec<Vec3>,
    /// Affine matrices C, row-major [1/s].
    pub affine: Vec<[f64; 9]>,
    /// Tools and other bodies of couplings, in the scene's order.
    pub bodies: Vec<BodyPose>,
    /// Robots' joints, in the scene's order.
    pub robots: Vec<RobotPose>,
}

/// A step that was taken.
#[derive(Clone, Debug)]
struct Taken {
    /// When it began, and its length [s].
    time: f64,
    dt: f64,
    /// What became of levels and particles before it.
    adapted: Option<Arc<Adapted>>,
}

/// What is asked whether to go on, after each of so many steps.
pub type OnStep<'a> = dyn FnMut(usize) -> ControlFlow<()> + 'a;

/// Steps that gradients can go back through. Made by [`Simulation::record`].
pub struct Tape {
    plan: Arc<Plan>,
    forwards: Arc<dyn Backend>,
    backwards: Arc<dyn Backend>,
    start: ParticleState,
    steps: Vec<Taken>,
    moments: [Moment; 2],
    /// Couplings of their own to take steps again with, and what those of the simulation were at the start.
    couplings: Mutex<Vec<Box<dyn Coupling>>>,
    coupled: Vec<Vec<u8>>,
    impulses: Vec<Wrench>,
}

impl std::fmt::Debug for Tape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tape")
            .field("scene", &self.plan.scene.name)
            .field("particles", &self.moments[0].id.len())
            .field("steps", &self.steps.len())
            .finish_non_exhaustive()
    }
}

/// The particles of all lists, in the order of their numbers: of each its list and place there.
pub fn by_number(particles: &ParticleState) -> Vec<(usize, usize)> {
    let lists = particles.lists.iter().enumerate();
    let mut all: Vec<(usize, usize)> = lists.flat_map(|(l, list)| (0..list.len()).map(move |i| (l, i))).collect();
    all.sort_unstable_by_key(|&(l, i)| particles.lists[l].id[i]);
    all
}

fn moment(particles: &ParticleState, simulation: &Simulation) -> Moment {
    let bodies = simulation.bodies().into_iter();
    let bodies = bodies.map(|body| {
        let answers = body.mass.is_finite();
        let twist = if answers { [body.velocity, body.angular_velocity] } else { [[0.0; 3]; 2] };
        BodyPose { name: body.name, position: body.position, rotation: body.rotation, twist }
    });
    let of_robot = |name: String| RobotPose { name, positions: Vec::new(), rates: Vec::new() };
    let names = simulation.couplings().iter().flat_map(|one| one.robots()).map(|robot| robot.name);
    let mut robots: Vec<RobotPose> = names.map(of_robot).collect();
    for joint in simulation.joints() {
        if let Some(robot) = robots.iter_mut().find(|robot| robot.name == joint.body) {
            robot.positions.push(joint.position);
            robot.rates.push(joint.rate);
        }
    }
    let mut moment = Moment { time: simulation.time(), bodies: bodies.collect(), robots, ..Moment::default() };
    for (l, i) in by_number(particles) {
        let list = &particles.lists[l];
        moment.id.push(list.id[i]);
        moment.body.push(list.body[i]);
        moment.material.push(list.material as u16);
        moment.mass.push(list.mass[i]);
        moment.position.push(list.position(i));
        moment.velocity.push(list.velocity[i]);
        moment.affine.push(list.affine[i]);
    }
    moment
}

/// What a scene may do so that it needs no stage that has no adjoint.
fn mend(stage: Stage) -> &'static str {
    match stage {
        Stage::SLEEP => "set sleep.on = false",
        _ => "choose a scene without it",
    }
}

/// Holds a plan to what gradients can go back through.
fn check(plan: &Plan, backwards: &dyn Backend) -> Result<()> {
    let lacks = |stage: &Stage| !backwards.has_form(*stage, Form::Adjoint);
    if let Some(stage) = plan.schedule.stages().into_iter().find(lacks) {
        return Err(Error::Missing {
            kind: "backend",
            name: backwards.name().to_owned(),
            origin: "registered".to_owned(),
            what: format!("{} of the stage '{stage}'", Form::Adjoint),
            why: "gradients go back through every stage of a step".to_owned(),
            mend: mend(stage).to_owned(),
        });
    }
    for planned in &plan.materials {
        let table = &planned.material.table;
        let callbacks =
            [("update_f64", table.update_f64.is_some()), ("update_adj_f64", table.update_adj_f64.is_some())];
        if let Some((lacking, _)) = callbacks.iter().find(|(_, has)| !has) {
            return Err(Error::Missing {
                kind: "material",
                name: planned.material.name.clone(),
                origin: planned.material.origin.clone(),
                what: (*lacking).to_owned(),
                why: format!("gradients go back through the law of material '{}'", planned.name),
                mend: "supply it (laws that are written with the kit have it), or use another law".to_owned(),
            });
        }
        if planned.material.states.len() > MOST_STATES {
            return Err(Error::Capacity {
                what: "history variables of a law that gradients go through",
                asked: planned.material.states.len() as u64,
                cap: MOST_STATES as u64,
                mend: "declare fewer",
            });
        }
    }
    if plan.schedule.slots > 1 {
        return Err(refused("levels.subcycle", "steps of each level's own have no adjoint yet", "set it to false"));
    }
    if plan.flows.is_some() {
        return Err(refused("source", "sources and sinks have no adjoint", "leave them out"));
    }
    Ok(())
}

fn refused(path: &str, what: &str, mend: &str) -> Error {
    Error::Body { path: path.to_owned(), what: format!("gradients: {what}"), mend: mend.to_owned() }
}

impl Simulation {
    /// Steps until `until` [s], as [`advance`](Self::advance) does, and remembers them, so that [gradients](Tape::pull_back) can go back through them. Backends that have
    /// no adjoint of their own are gone back through by one that has, in f64.
    ///
    /// # Errors
    /// [`Error::Missing`] for a stage or a law that has no adjoint, by name and before any step. [`Error::Body`] if particles left the world on the way, or were
    /// put back into it. Else as [`step`](Self::step).
    pub fn record(&mut self, registry: &Registry, until: f64) -> Result<Tape> {
        let tape = self.record_while(registry, until, |_| ControlFlow::Continue(()))?;
        Ok(tape.expect("nothing breaks it off"))
    }

    /// The same, unless `on_step` breaks it off, which is asked after each step: then there is no tape.
    ///
    /// # Errors
    /// As [`record`](Self::record).
    pub fn record_while(
        &mut self,
        registry: &Registry,
        until: f64,
        mut on_step: impl FnMut(&Self) -> ControlFlow<()>,
    ) -> Result<Option<Tape>> {
        let plan = self.plan_shared();
        let own = Arc::clone(registry.backend(self.backend())?);
        let stages = plan.schedule.stages();
        let has_all = stages.iter().all(|stage| own.has_form(*stage, Form::Adjoint));
        let backwards = if has_all { &own } else { registry.backend(&Options::default().backend)? };
        let backwards = Arc::clone(backwards);
        check(&plan, &*backwards)?;
        let couplings = Mutex::new(self.couplings().iter().map(|one| one.twin()).collect::<Result<_>>()?);
        let coupled = self.couplings().iter().map(|coupling| coupling.save()).collect();
        let start = self.engine().state();
        self.engine().check()?;
        let began = moment(&start, self);
        let mut lost = self.lost();
        let mut steps = Vec::new();
        let mut impulses = vec![Wrench::default(); began.bodies.len()];
        let mut time = self.time();
        let reached = self.advance(until, |simulation, report| {
            steps.push(Taken { time, dt: report.dt, adapted: report.adapted.clone() });
            time = simulation.time();
            let felt = impulses.iter_mut().zip(simulation.wrenches());
            felt.for_each(|(sum, wrench)| sum.add_change(&Wrench::default(), &wrench, report.dt));
            on_step(simulation)
        })?;
        if !reached {
            return Ok(None);
        }
        let end = self.particles();
        self.engine().check()?;
        lost = self.lost() - lost;
        let moments = [began, moment(&end, self)];
        let resampled =
            steps.iter().filter_map(|step| step.adapted.as_ref()).any(|adapted| !adapted.changes.is_empty());
        if lost > 0 || !resampled && moments[0].id != moments[1].id {
            return Err(refused(
                "world.leaving",
                "particles left the world, or were put back into it, on the way",
                "make the world larger, or record a shorter time",
            ));
        }
        Ok(Some(Tape { plan, forwards: own, backwards, start, steps, moments, couplings, coupled, impulses }))
    }
}

impl Tape {
    /// Number of steps.
    pub fn len(&self) -> usize {
        self.steps.len()
    }
    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }
    /// What is simulated.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }
    /// Lengths of its steps [s].
    pub fn lengths(&self) -> Vec<f64> {
        self.steps.iter().map(|step| step.dt).collect()
    }
    /// The particles at its start.
    pub fn start(&self) -> &Moment {
        &self.moments[0]
    }
    /// The particles at its end.
    pub fn end(&self) -> &Moment {
        &self.moments[1]
    }
    /// The impulse of the ground on each body of the couplings over its steps [N s], and the angular impulse about the body's reference point [N m s].
    pub fn impulses(&self) -> &[Wrench] {
        &self.impulses
    }

    /// From what a loss owes to the particles at the end to what it owes to those at the start, and to what was the same throughout.
    ///
    /// # Errors
    /// [`Error::Body`] if there are not as many cotangents as particles, or one is not finite; [`Error::MaterialFailed`] if a law's derivative is not finite; what the engine says that takes
    /// the steps again.
    pub fn pull_back(&self, cotangents: Cotangents) -> Result<Gradient> {
        let gradient = self.pull_back_while(cotangents, &mut |_| ControlFlow::Continue(()))?;
        Ok(gradient.expect("nothing breaks it off"))
    }

    /// The same, unless `on_step` breaks it off: then there is no gradient. It is told how many steps have been taken, forwards again or backwards, of three times
    /// [`len`](Self::len).
    ///
    /// # Errors
    /// As [`pull_back`](Self::pull_back).
    pub fn pull_back_while(&self, cotangents: Cotangents, on_step: &mut OnStep<'_>) -> Result<Option<Gradient>> {
        let particles = self.moments[1].id.len();
        let Cotangents { position, velocity, affine, strain, state, lags, bodies, robots } = &cotangents;
        let lags = *lags;
        if [position.len(), velocity.len(), affine.len(), strain.len(), state.len()] != [particles; 5] {
            let what = format!("{} cotangents of {particles} particles", position.len());
            return Err(refused("cotangents", &what, "give one for each particle, in the order of their numbers"));
        }
        let own = position.iter().chain(velocity).flatten();
        let count = self.moments[0].bodies.len();
        if ![0, count].contains(&bodies.len()) {
            let what = format!("cotangents of {} bodies, and there are {count}", bodies.len());
            return Err(refused("cotangents.bodies", &what, "give one for each, in the scene's order, or none"));
        }
        let joints = &self.moments[0].robots;
        let fits = |(owed, robot): (&RobotCotangents, &RobotPose)| {
            let own = robot.positions.len();
            [&owed.positions, &owed.rates].into_iter().all(|all| [0, own].contains(&all.len()))
        };
        if ![0, joints.len()].contains(&robots.len()) || !robots.iter().zip(joints).all(fits) {
            let what = format!("cotangents of {} robots, and there are {}", robots.len(), joints.len());
            let mend = "give one for each, in the scene's order, with a number for each of its joints, or none";
            return Err(refused("cotangents.robots", &what, mend));
        }
        let of_robots = robots.iter().flat_map(|one| one.positions.iter().chain(&one.rates).chain([&one.energy]));
        let of_bodies = bodies.iter().flat_map(|one| {
            let BodyCotangents { pose, velocity, angular_velocity, impulse } = one;
            [&pose.position, &pose.rotation, velocity, angular_velocity, &impulse.force, &impulse.torque]
        });
        let rest = affine.iter().chain(strain).flatten().chain(state.iter().flatten()).chain(of_bodies.flatten());
        let rest = rest.chain(of_robots);
        if own.chain(rest).any(|x| !x.is_finite()) {
            return Err(refused("cotangents", "one is not a finite number", "look at the loss that they come from"));
        }
        let mut gradient = Gradient {
            particles: cotangents,
            parameters: self.plan.materials.iter().map(|planned| vec![0.0; planned.parameters.len()]).collect(),
            gravity: [0.0; 3],
            bodies: vec![BodyGradient::default(); count],
            robots: vec![RobotGradient::default(); joints.len()],
        };
        gradient.particles.bodies.resize_with(count, BodyCotangents::default);
        gradient.particles.robots.resize_with(joints.len(), RobotCotangents::default);
        for (owed, robot) in gradient.particles.robots.iter_mut().zip(joints) {
            owed.positions.resize(robot.positions.len(), 0.0);
            owed.rates.resize(robot.rates.len(), 0.0);
        }
        let mut couplings = self.couplings.lock().unwrap_or_else(PoisonError::into_inner);
        let couplings = &mut couplings[..];
        for (coupling, bytes) in couplings.iter_mut().zip(&self.coupled) {
            coupling.restore(bytes).map_err(|what| cannot_go_back(&**coupling, what))?;
        }
        let mut adjoint = self.backwards.adjoint(&self.plan)?;
        let stretch = self.steps.len().isqrt().max(1);
        let mut done = 0;
        let mut go_on = || {
            done += 1;
            on_step(done)
        };
        // Where each stretch begins, and the last state of all.
        let mut kept = Vec::new();
        let wanted = |i: usize| i.is_multiple_of(stretch) || i == self.steps.len();
        let start = Before { particles: self.start.clone(), lagging: None, coupled: keep(couplings) };
        let forwards = (&*adjoint, &self.steps[..]);
        if self.take_again(start, couplings, forwards, wanted, &mut kept, &mut go_on)?.is_break() {
            return Ok(None);
        }
        // A backend that brings strain up to date within a step has done so once more, and one that takes over from one that does not does so first.
        let end = kept.pop().map(|end| (end.particles.strain_dt > 0.0 && !lags, end));
        let carried = end.and_then(|(taken_over, end)| end.lagging.or(taken_over.then_some(end.particles)));
        if let Some(before) = carried {
            adjoint.step_back(&before, &mut [], self.moments[1].time, 0.0, None, &mut gradient)?;
        }
        for (steps, start) in self.steps.chunks(stretch).zip(kept).rev() {
            let mut within = Vec::with_capacity(steps.len());
            let to_last = (&*adjoint, &steps[..steps.len() - 1]);
            if self.take_again(start, couplings, to_last, |_| true, &mut within, &mut go_on)?.is_break() {
                return Ok(None);
            }
            for (step, before) in steps.iter().zip(within).rev() {
                let Before { particles, lagging, coupled } = before;
                go_back(couplings, coupled)?;
                let particles = lagging.as_ref().unwrap_or(&particles);
                let adapted = step.adapted.as_deref();
                adjoint.step_back(particles, couplings, step.time, step.dt, adapted, &mut gradient)?;
                if go_on().is_break() {
                    return Ok(None);
                }
            }
        }
        gradient.particles.lags = self.start.strain_dt > 0.0;
        gradient.particles.bodies.iter_mut().for_each(|body| body.impulse = Wrench::default());
        Ok(Some(gradient))
    }

    /// Takes steps again from a state, and keeps the particles before those that are wanted, by their numbers from 0, and behind the last.
    fn take_again(
        &self,
        start: Before,
        couplings: &mut [Box<dyn Coupling>],
        (adjoint, steps): (&dyn Adjoint, &[Taken]),
        wanted: impl Fn(usize) -> bool,
        kept: &mut Vec<Before>,
        go_on: &mut dyn FnMut() -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>> {
        if steps.is_empty() {
            kept.extend(wanted(0).then_some(start));
            return Ok(ControlFlow::Continue(()));
        }
        let mut engine: Box<dyn Engine> = self.forwards.compile(&self.plan, start.particles.clone())?;
        // The state before the present step, for engines that bring strain up to date within it.
        let mut last = (start.particles.strain_dt == 0.0).then(|| start.particles.clone());
        go_back(couplings, start.coupled)?;
        kept.extend(wanted(0).then_some(Before { coupled: keep(couplings), ..start }));
        for (i, step) in steps.iter().enumerate() {
            let report = engine.step(step.time, step.dt, couplings)?;
            if report.dt != step.dt {
                return Err(refused("steps", "one came out shorter when it was taken again", "record them anew"));
            }
            if last.is_some() || wanted(i + 1) {
                let now = engine.state();
                engine.check()?;
                let lags = now.strain_dt == 0.0;
                let last_kept = last.take_if(|_| lags);
                let lagging = last_kept.map(|last| match &step.adapted {
                    Some(adapted) if !adapted.changes.is_empty() => {
                        Ok(lagging(&now, &adjoint.adapted(&last, adapted)?, step.dt))
                    }
                    _ => Ok(lagging(&now, &last, step.dt)),
                });
                let lagging = lagging.transpose()?;
                last = lags.then(|| now.clone());
                kept.extend(wanted(i + 1).then(|| Before { particles: now, lagging, coupled: keep(couplings) }));
            }
            if go_on().is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }
}

/// Particles before a step.
struct Before {
    /// As the engine has them.
    particles: ParticleState,
    /// With strain and history as they were before C, which the step before has found, changed them: if the engine has already done so. Gradients go back through laws at the
    /// beginning of a step.
    lagging: Option<ParticleState>,
    /// What each coupling goes back to.
    coupled: Vec<Kept>,
}

fn keep(couplings: &[Box<dyn Coupling>]) -> Vec<Kept> {
    couplings.iter().map(|coupling| coupling.keep()).collect()
}

fn go_back(couplings: &mut [Box<dyn Coupling>], coupled: Vec<Kept>) -> Result<()> {
    let mut both = couplings.iter_mut().zip(coupled);
    both.try_for_each(|(coupling, kept)| coupling.go_back(kept).map_err(|what| cannot_go_back(&**coupling, what)))
}

fn cannot_go_back(coupling: &dyn Coupling, what: String) -> Error {
    let path = format!("coupling '{}'", coupling.name());
    refused(&path, &format!("it cannot go back to an earlier step: {what}"), "record the steps anew")
}

/// Particles with strain and history of a step of `dt` before, which C has yet to change.
fn lagging(now: &ParticleState, before: &ParticleState, dt: f64) -> ParticleState {
    let mut lagging = ParticleState { kept: None, strain_dt: dt, ..now.clone() };
    for ((l, i), (m, j)) in by_number(now).into_iter().zip(by_number(before)) {
        let (to, from) = (&mut lagging.lists[l], &before.lists[m]);
        let planes = to.strain.iter_mut().zip(&from.strain).chain(to.state.iter_mut().zip(&from.state));
        planes.for_each(|(to, from)| to[i] = from[j]);
    }
    lagging
}
