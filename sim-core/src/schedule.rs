//! The step as data: which stages run, on which levels, in what order. A plan makes it, every backend carries it out.

use std::fmt;
use std::ops::Range;

/// A stage of the step, by name. A backend that has no form of one is refused by that name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Stage(&'static str);

impl Stage {
    /// Ground brought in as agents come near, and put away behind them.
    pub const ARCHIVE: Self = Self("archive");
    /// Regions moved after their agents, particles split and merged.
    pub const ADAPT: Self = Self("adapt");
    /// Particles into blocks and cells.
    pub const SORT: Self = Self("sort");
    /// Who of the ground at rest is left out of the stages that follow.
    pub const SLEEP: Self = Self("sleep");
    /// Particles to grid, the material update inside.
    pub const P2G: Self = Self("P2G");
    /// What nodes at the rim of the next finer level hand to these levels. Subcycled, what such nodes hold is kept apart from what the coarser level's own
    /// particles give them, as momentum and as force.
    pub const RESTRICT: Self = Self("restrict");
    /// Node sums, gravity and walls.
    pub const GRID_UPDATE: Self = Self("grid update");
    /// Couplings on the nodes near their bodies.
    pub const CONTACT: Self = Self("contact");
    /// Bodies move, by what they have felt on the finest level.
    pub const BODIES: Self = Self("bodies");
    /// Velocities at the rims of these levels, from the next coarser one. Subcycled, nodes that both share are solved first.
    pub const PROLONG: Self = Self("prolong");
    /// Does anything move too far? Together, a step is repeated with a shorter one as long as nodes would; subcycled, finer levels have gone ahead, and it ends
    /// in an error.
    pub const LIMIT: Self = Self("limit");
    /// Grid to particles, and advection.
    pub const G2P: Self = Self("G2P");

    /// On which side of the sections of probes particles are, before they move. A backend that can tell afterwards does nothing here.
    pub const SIDES: Self = Self("sides");
    /// What has crossed the sections of probes.
    pub const FLUX: Self = Self("flux");
    /// What the parts of walls that probes ask about have taken.
    pub const PRESS: Self = Self("press on walls");

    /// A stage of another name.
    pub const fn new(name: &'static str) -> Self {
        Self(name)
    }

    /// Its name.
    pub const fn name(self) -> &'static str {
        self.0
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0)
    }
}

/// How a backend can carry out a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// As a step goes.
    Forward,
    /// Backwards, for gradients.
    Adjoint,
}

impl fmt::Display for Form {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Forward => "forward form",
            Self::Adjoint => "adjoint form",
        })
    }
}

/// A stage of some levels, in a slot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// The stage.
    pub stage: Stage,
    /// Its levels; 0 is the finest.
    pub levels: Range<usize>,
    /// Number of the finest level's step within the whole step.
    pub slot: usize,
}

/// What a schedule is made for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// Are there particles?
    pub ground: bool,
    /// How many levels.
    pub levels: usize,
    /// Does each level take two steps in one of the next coarser one?
    pub subcycled: bool,
    /// Does ground at rest sleep?
    pub sleeps: bool,
    /// Is there an archive of ground out of reach?
    pub unbounded: bool,
    /// Are there couplings?
    pub bodies: bool,
    /// Are there probes of what crosses a section?
    pub flux: bool,
    /// Are there probes of walls?
    pub press: bool,
}

/// The stages of a step, in order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schedule {
    /// What it was made for.
    pub needs: Needs,
    /// Stages between steps, where they are due.
    pub upkeep: Vec<Stage>,
    /// Stages of every step, slot by slot.
    pub step: Vec<Call>,
    /// Steps of the finest level in a step: 1 unless levels are subcycled.
    pub slots: usize,
}

impl Schedule {
    /// The schedule that a plan calls for.
    ///
    /// All levels together: particles give to nodes, bodies act on these, and rims take the coarser level's velocities last, bodies' part included.
    ///
    /// Subcycled: a level's step begins with the slot in which its coarser level's does or is half over, and ends when the finer one has taken two. Within
    /// a slot the levels that begin come first, then those that end. A rim needs the coarser level's velocities as its step begins, so that prolong comes before
    /// contact; bodies meet coarser levels where they have come to by then.
    pub fn new(needs: Needs) -> Self {
        let Needs { ground, levels, subcycled, sleeps, unbounded, bodies, flux, press } = needs;
        let nested = ground && levels > 1;
        let upkeep = [(Stage::ARCHIVE, ground && unbounded), (Stage::ADAPT, nested), (Stage::SORT, ground)];
        // Bodies move alike whether there is ground or not.
        let slots = if subcycled { 1 << (levels - 1) } else { 1 };
        let mut step = Vec::new();
        for slot in 0..slots {
            let mut call = |stage: Stage, levels: Range<usize>, called_for: bool| {
                if called_for && !levels.is_empty() {
                    step.push(Call { stage, levels, slot });
                }
            };
            if slots == 1 {
                let all = 0..levels;
                call(Stage::SLEEP, all.clone(), ground && sleeps);
                call(Stage::P2G, all.clone(), ground);
                call(Stage::RESTRICT, 1..levels, nested);
                call(Stage::GRID_UPDATE, all.clone(), ground);
                call(Stage::CONTACT, all.clone(), bodies);
                call(Stage::LIMIT, all.clone(), ground);
                call(Stage::BODIES, all.clone(), bodies);
                call(Stage::PROLONG, 0..levels.saturating_sub(1), nested);
                call(Stage::SIDES, all.clone(), ground && flux);
                call(Stage::G2P, all.clone(), ground);
                call(Stage::FLUX, all.clone(), ground && flux);
                call(Stage::PRESS, all, ground && press);
            } else {
                let (begin, end) = (beginning(levels, slot), ending(levels, slot));
                call(Stage::SLEEP, begin.clone(), ground && sleeps);
                call(Stage::P2G, begin.clone(), ground);
                call(Stage::GRID_UPDATE, begin.clone(), ground);
                call(Stage::RESTRICT, 1..begin.end, ground);
                call(Stage::PROLONG, 0..begin.end.min(levels - 1), ground);
                call(Stage::CONTACT, 0..1, bodies);
                call(Stage::BODIES, 0..1, bodies);
                call(Stage::CONTACT, 1..end.end, bodies);
                call(Stage::SIDES, end.clone(), ground && flux);
                call(Stage::G2P, end.clone(), ground);
                call(Stage::FLUX, end.clone(), ground && flux);
                call(Stage::LIMIT, end, ground);
                call(Stage::PRESS, 0..levels, ground && press && slot + 1 == slots);
            }
        }
        let upkeep = upkeep.into_iter().filter(|(_, called_for)| *called_for).map(|(stage, _)| stage).collect();
        Self { needs, upkeep, step, slots }
    }

    /// All its stages, each once.
    pub fn stages(&self) -> Vec<Stage> {
        let mut stages = self.upkeep.clone();
        for call in &self.step {
            if !stages.contains(&call.stage) {
                stages.push(call.stage);
            }
        }
        stages
    }

    /// Is the stage part of it?
    pub fn has(&self, stage: Stage) -> bool {
        self.upkeep.contains(&stage) || self.step.iter().any(|call| call.stage == stage)
    }

    /// The calls of a slot.
    pub fn of_slot(&self, slot: usize) -> &[Call] {
        let before = |slot: usize| self.step.partition_point(|call| call.slot < slot);
        &self.step[before(slot)..before(slot + 1)]
    }

    /// The length of a level's step in a step of `dt` [s].
    pub fn dt_of(&self, level: usize, dt: f64) -> f64 {
        let steps = (self.slots >> level).max(1);
        dt / steps as f64
    }

    /// When a slot of a step of `dt` from `time` begins [s]: half of half a step later for each of the levels that have come half their way.
    pub fn time_of(&self, slot: usize, time: f64, dt: f64) -> f64 {
        let halves = (1..=self.slots.ilog2()).map(|k| (self.slots >> k, dt / f64::from(1 << k)));
        halves.filter(|(half, _)| slot & half != 0).fold(time, |time, (_, dt)| time + dt)
    }
}

/// The levels whose steps begin with a slot.
pub fn beginning(levels: usize, slot: usize) -> Range<usize> {
    0..levels.min(slot.trailing_zeros() as usize + 1)
}

/// The levels whose steps end with a slot.
pub fn ending(levels: usize, slot: usize) -> Range<usize> {
    beginning(levels, slot + 1)
}

/// What the numbers mean where there are several slots.
const LEGEND: &str = "behind each stage its levels, 0 the finest; a slot is a step of level 0";
/// Slots that are printed one by one.
const SHOWN_SLOTS: usize = 8;

/// A line for what is done between steps, then one for each slot, with the levels of its stages where there are several slots.
impl fmt::Display for Schedule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.upkeep.is_empty() && self.step.is_empty() {
            return f.write_str("none");
        }
        let names = |stages: &[String]| stages.join(" -> ");
        if !self.upkeep.is_empty() {
            let stages: Vec<_> = self.upkeep.iter().map(Stage::to_string).collect();
            writeln!(f, "when due: {}", names(&stages))?;
        }
        for slot in 0..self.slots.min(SHOWN_SLOTS) {
            let with_levels = |call: &Call| match call.levels.clone() {
                _ if self.slots == 1 => call.stage.to_string(),
                one if one.len() == 1 => format!("{} {}", call.stage, one.start),
                some => format!("{} {}-{}", call.stage, some.start, some.end - 1),
            };
            let calls: Vec<_> = self.of_slot(slot).iter().map(with_levels).collect();
            let when = if self.slots == 1 { "each step".to_owned() } else { format!("slot {slot}") };
            write!(f, "{when}: {}", names(&calls))?;
            if slot + 1 < self.slots.min(SHOWN_SLOTS) {
                writeln!(f)?;
            }
        }
        match self.slots {
            1 => Ok(()),
            slots if slots > SHOWN_SLOTS => write!(f, "\n… {slots} slots in all; {LEGEND}"),
            _ => write!(f, "\n{LEGEND}"),
        }
    }
}
