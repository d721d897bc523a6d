//! The schedule on a device: which passes carry out each stage, what a submission dispatches, and what the host does between submissions.

pub(crate) mod adapt;
pub(crate) mod archive;
pub(crate) mod arrivals;
pub(crate) mod batch;
pub(crate) mod bodies;
pub(crate) mod contact_on_host;
pub(crate) mod describe;
pub(crate) mod groups;
pub(crate) mod near;
pub(crate) mod outcome;
pub(crate) mod probes;
pub(crate) mod steps;
pub(crate) mod submission;

use crate::device::kernel::Kernel;
use crate::device::uniforms::StepConstants;
use crate::passes::{Kernels, Set};
use crate::worlds::world::most_need;
use barchan_core::schedule::{Call, Needs, Stage, beginning, ending};
use barchan_core::{Plan, Schedule, Vec3};
use std::ops::Range;

/// Has this backend a form of the stage? Of most it is [`passes`]; which sides of sections particles are on, flux finds out afterwards; what walls
/// take is found just before G2P; archive, adapt and sort are carried out between steps, where they are due; the limit is held within the grid update,
/// and bodies that answer move within the contact, while the host moves driven ones.
pub(crate) fn has_form(stage: Stage) -> bool {
    matches!(
        stage,
        Stage::ARCHIVE
            | Stage::ADAPT
            | Stage::SORT
            | Stage::SLEEP
            | Stage::P2G
            | Stage::RESTRICT
            | Stage::GRID_UPDATE
            | Stage::CONTACT
            | Stage::LIMIT
            | Stage::BODIES
            | Stage::PROLONG
            | Stage::SIDES
            | Stage::G2P
            | Stage::FLUX
            | Stage::PRESS
    )
}

/// The schedule that the worlds of a batch share. Some may have particles or bodies only later.
pub(crate) fn of_batch(plan: &Plan) -> Schedule {
    Schedule::new(Needs { ground: true, bodies: true, ..plan.schedule.needs })
}

/// Contact on the device: with driven bodies, and with those that answer, alone or together with what is done at rims; and whether bodies may come near
/// coarser levels.
#[derive(Debug)]
pub(crate) struct ContactPasses<'a, K = Kernel> {
    pub(crate) driven: &'a [K],
    pub(crate) answering: &'a [K],
    pub(crate) with_rims: bool,
    pub(crate) roams: bool,
    /// Does the law run on the host, where bodies come near walls and others?
    pub(crate) on_host: bool,
}

impl<K> Clone for ContactPasses<'_, K> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<K> Copy for ContactPasses<'_, K> {}

impl<K> Default for ContactPasses<'_, K> {
    fn default() -> Self {
        Self { driven: &[], answering: &[], with_rims: false, roams: false, on_host: false }
    }
}

impl<K> ContactPasses<'_, K> {
    /// None, for the law runs on the host.
    pub(crate) fn on_host() -> Self {
        Self { on_host: true, ..Self::default() }
    }

    /// May nodes near walls change after the grid update?
    pub(crate) fn comes_to_walls(&self) -> bool {
        self.on_host || self.roams || !self.driven.is_empty()
    }
}

/// The passes that carry out a call, each with its levels; for what is yet a text as for what a device has compiled.
///
/// Passes concern all levels at once whose steps begin, or end, in the slot. So what bodies that answer and rims ask of the same nodes may be one pass.
pub(crate) fn passes<'a, K>(
    set: &'a Set<K>,
    contact: ContactPasses<'a, K>,
    schedule: &Schedule,
    call: &Call,
) -> Vec<(Range<usize>, &'a K)> {
    let subcycled = schedule.slots > 1;
    let levels = schedule.needs.levels;
    let (begin, end) =
        if subcycled { (beginning(levels, call.slot), ending(levels, call.slot)) } else { (0..levels, 0..levels) };
    let ContactPasses { driven, answering, with_rims, roams, .. } = contact;
    let all = |levels: Range<usize>, kernels: &mut dyn Iterator<Item = &'a K>| {
        kernels.map(|kernel| (levels.clone(), kernel)).collect::<Vec<_>>()
    };
    match call.stage {
        Stage::SLEEP => all(begin, &mut set.watch.iter()),
        Stage::P2G => all(begin, &mut [&set.p2g].into_iter()),
        Stage::RESTRICT => all(begin, &mut set.restrict.iter()),
        Stage::GRID_UPDATE => all(begin, &mut set.grid.iter()),
        // Those that answer act on the finest level where they were, on coarser ones where they have come, if they come near any. Driven ones stand where the host
        // has said for each slot, so that one pass does for all levels.
        Stage::CONTACT => {
            let last = call.levels.end == end.end;
            let meets = !(subcycled && with_rims) && (call.levels.start == 0 || roams);
            let answering = all(call.levels.clone(), &mut answering.iter().filter(|_| meets));
            let driven = all(end, &mut driven.iter().filter(|_| last));
            if subcycled {
                return [answering, driven].concat();
            }
            // Which nodes bodies that answer grip is known before driven ones take those that are deeper in them.
            let (press, answer) = answering.split_at(answering.len().min(1));
            [press, &driven, answer].concat()
        }
        Stage::PROLONG => {
            // Rims read what stands behind walls that let go, and mirrors what stands at rims.
            let rims: Vec<&K> = match (with_rims, subcycled) {
                (true, true) => answering.iter().collect(),
                (true, false) => Vec::new(),
                (false, true) => set.solve.iter().collect(),
                (false, false) => set.mirror.iter().chain(&set.prolong).collect(),
            };
            all(begin, &mut rims.into_iter().chain(&set.pressed_rims))
        }
        Stage::G2P => {
            let mirror = set.mirror.iter().filter(|_| levels == 1);
            let reflects = !subcycled || !set.mirrored || contact.comes_to_walls();
            all(end, &mut mirror.chain(set.reflect.iter().filter(|_| reflects)).chain(&set.pressed).chain([&set.g2p]))
        }
        Stage::FLUX => all(end, &mut set.flux.iter()),
        _ => Vec::new(),
    }
}

/// The passes of calls of a step of all levels, with bodies' law on the host.
pub(crate) fn passes_beside_host<'a>(
    set: &'a Set<Kernel>,
    schedule: &Schedule,
    calls: &[Call],
) -> impl Iterator<Item = &'a Kernel> + use<'a> {
    let of = |call| passes(set, ContactPasses::on_host(), schedule, call);
    calls.iter().flat_map(of).map(|(_, kernel)| kernel).collect::<Vec<_>>().into_iter()
}

/// The calls of a slot before bodies act on the ground, and those from there on.
pub(crate) fn around_contact(schedule: &Schedule, slot: usize) -> (&[Call], &[Call]) {
    let calls = schedule.of_slot(slot);
    calls.split_at(calls.iter().position(|call| call.stage == Stage::CONTACT).unwrap_or(calls.len()))
}

/// One dispatch of a submission.
pub(crate) struct Dispatch<'a> {
    pub(crate) kernel: &'a Kernel,
    /// Which set of buffers is the present one.
    pub(crate) now: usize,
    /// Number of the step's constants.
    pub(crate) step: usize,
    /// One past the last of the levels whose step it is.
    pub(crate) end: usize,
}

/// Writes down the passes of a submission.
pub(crate) struct Passes<'a> {
    kernels: &'a Kernels,
    contact: ContactPasses<'a>,
    schedule: &'a Schedule,
    /// Width of the finest cell [m].
    h: f64,
    /// Which set of buffers is the present one.
    pub(crate) now: usize,
    /// Steps written down so far, and gravity when it has grown [m/s²].
    pub(crate) number: usize,
    gravity: Vec3,
    pub(crate) constants: Vec<StepConstants>,
    /// The levels and the slot that the last constants are for.
    last: Option<(Range<usize>, usize)>,
    pub(crate) dispatches: Vec<Dispatch<'a>>,
}

impl<'a> Passes<'a> {
    pub(crate) fn new(
        kernels: &'a Kernels,
        contact: ContactPasses<'a>,
        schedule: &'a Schedule,
        now: usize,
        (h, gravity): (f64, Vec3),
    ) -> Self {
        let (constants, dispatches) = (Vec::new(), Vec::new());
        Self { kernels, contact, schedule, h, now, number: 0, gravity, constants, last: None, dispatches }
    }

    /// The constants of a step of `dt` of all levels.
    pub(crate) fn constants(&mut self, dt: f64) -> usize {
        self.last = None;
        self.constants.push(step_constants(self.h, dt, self.gravity, self.number));
        self.constants.len() - 1
    }

    /// The constants of some levels' steps in a slot of a step of `dt`; the last ones if they will do.
    pub(crate) fn constants_of(&mut self, dt: f64, levels: Range<usize>, slot: usize) -> usize {
        let wanted = Some((levels, self.number * self.schedule.slots + slot));
        if self.last == wanted {
            return self.constants.len() - 1;
        }
        let step = self.constants(self.schedule.dt_of(0, dt));
        if let (true, Some((levels, slot))) = (self.schedule.slots > 1, &wanted) {
            let mirrors = u32::from(!self.contact.comes_to_walls());
            let (first_level, end_level) = (levels.start as u32, levels.end as u32);
            let constants = &mut self.constants[step];
            *constants = StepConstants { slot: *slot as u32, first_level, end_level, mirrors, ..*constants };
        }
        self.last = wanted;
        step
    }

    pub(crate) fn run(&mut self, step: usize, kernels: impl IntoIterator<Item = &'a Kernel>) {
        let now = self.now;
        let end = (self.constants[step].end_level as usize).min(self.schedule.needs.levels);
        self.dispatches.extend(kernels.into_iter().map(|kernel| Dispatch { kernel, now, step, end }));
    }

    /// A sort moves the particles to the other set of buffers.
    pub(crate) fn sort(&mut self, dt: f64) {
        let step = self.constants(dt);
        self.run(step, &self.kernels.set.sort);
        self.now = 1 - self.now;
    }

    /// Calls of a step of `dt`.
    pub(crate) fn carry_out(&mut self, calls: &[Call], dt: f64) {
        for call in calls {
            for (levels, kernel) in passes(&self.kernels.set, self.contact, self.schedule, call) {
                let step = self.constants_of(dt, levels, call.slot);
                self.run(step, [kernel]);
            }
        }
    }

    /// A step of `dt`.
    pub(crate) fn step(&mut self, dt: f64) {
        self.carry_out(&self.schedule.step, dt);
        self.look_for_soft(dt);
        self.number += 1;
    }

    /// Where soft bodies are after a step, if levels follow any.
    pub(crate) fn look_for_soft(&mut self, dt: f64) {
        if self.kernels.set.soft.is_some() {
            let step = self.constants(dt);
            self.run(step, self.kernels.set.soft());
        }
    }
}

/// The constants of a step of all levels, where the finest cells have width `h` [m].
pub(crate) fn step_constants(h: f64, dt: f64, gravity: Vec3, number: usize) -> StepConstants {
    StepConstants {
        most_need: most_need(dt),
        dt: dt as f32,
        dt_per_h: (dt / h) as f32,
        stress: (-4.0 * dt / h) as f32,
        number: number as u32,
        gravity: gravity.map(|g| (g * dt) as f32),
        slot: number as u32,
        end_level: u32::MAX,
        ..StepConstants::default()
    }
}
