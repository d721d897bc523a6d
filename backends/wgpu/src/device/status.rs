//! What the device says of a submission: why it halted, what it counted and summed.

use crate::device::memory::Words;
use barchan_grid::block;
use std::ops::Range;

/// Words of the status; see `common.wgsl`.
pub(crate) const BLOCKS: usize = 0;
pub(crate) const NODE_BLOCKS: usize = 1;
pub(crate) const HALTED: usize = 2;
/// Words from there on to that of sorts, as steps begin.
pub(crate) const AT_START: [u32; 8] = [0, 0, u32::MAX, 0, 0, 0, 0, 0];
pub(crate) const HALT_STEP: usize = 3;
pub(crate) const WHO: usize = 4;
pub(crate) const NEW_BLOCKS: usize = 6;
pub(crate) const NEW_NODE_BLOCKS: usize = 7;
pub(crate) const SORTS: usize = 9;
pub(crate) const COUNTED: usize = 10;
/// Blocks of nodes near bodies whose law runs on the host: gathered, and in the next word those on their way back.
pub(crate) const NEAR: usize = 11;
/// Blocks whose particles give to nodes that a finer level takes part in.
pub(crate) const GIVERS: usize = 13;
/// Of a layer.
pub(crate) const FIRST_BLOCK: usize = 0;
pub(crate) const FIRST_NODE_BLOCK: usize = 1;
pub(crate) const LEAST_BLOCK: usize = 2;
pub(crate) const GREATEST_BLOCK: usize = 5;
/// Of what a submission sums up of a layer.
pub(crate) const SORTED: usize = 0;
pub(crate) const PARTED: usize = 1;
pub(crate) const WALL_IMPULSE: usize = 2;
pub(crate) const ASTRAY: usize = 6;
pub(crate) const LEFT: usize = 7;
pub(crate) const LEFT_IMPULSE: usize = 8;
pub(crate) const LEFT_MASS: usize = 11;
pub(crate) const SLEPT: usize = 12;
/// Of a layer in a step.
pub(crate) const SPEED: usize = 0;
pub(crate) const MOVE: usize = 1;
pub(crate) const GROWN: usize = 3;
/// Of a layer in a submission, after an even step and after an odd one.
pub(crate) const NEED: usize = 18;
/// Of a layer in a submission: what damping has dissipated, in so many digits of 32 bits, and the least of these [J].
pub(crate) const DAMPED: usize = 20;
pub(crate) const DAMPED_DIGITS: usize = 4;
pub(crate) const DAMPED_UNIT: f64 = 1.0 / (1_u128 << 80) as f64;
pub(crate) const BIAS: i32 = block::REACH;

/// Why the device halted a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Halt {
    TooFast = 1,
    Drifted,
    Room,
    /// Particles are on another level than they should be.
    Misplaced,
    LeftWorld,
    Strayed,
    /// There are fewer particles than before.
    Fewer,
    /// Levels must move after soft bodies, or the host must look where free bodies are.
    Follow,
    /// Particles need shorter steps.
    TooStiff,
}

impl Halt {
    /// In the order of their words.
    const ALL: [Self; 9] = [
        Self::TooFast,
        Self::Drifted,
        Self::Room,
        Self::Misplaced,
        Self::LeftWorld,
        Self::Strayed,
        Self::Fewer,
        Self::Follow,
        Self::TooStiff,
    ];

    /// `None` for 0, where nothing has halted it.
    pub(crate) fn of(word: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|halt| *halt as u32 == word)
    }
}

/// The status as it was brought back.
pub(crate) struct Status {
    pub(crate) words: Vec<u32>,
    pub(crate) layout: Words,
}

impl Status {
    pub(crate) fn new(words: Vec<u32>, layout: Words) -> Self {
        Self { words, layout }
    }
    pub(crate) fn halt(&self) -> Option<Halt> {
        Halt::of(self.words[HALTED])
    }
    /// A number of a layer in a step.
    pub(crate) fn in_step(&self, step: usize, layer: usize, k: usize) -> f32 {
        f32::from_bits(self.words[self.layout.of_step(step, layer, k)])
    }
    pub(crate) fn of_layer(&self, layer: usize, k: usize) -> usize {
        self.words[self.layout.of_layer(layer, k)] as usize
    }
    pub(crate) fn sum(&self, layer: usize, k: usize) -> u32 {
        self.words[self.layout.of_sum(layer, k)]
    }
    /// A layer's blocks, or node blocks: from its first one to the next layer's.
    pub(crate) fn range(&self, layer: usize, first: usize, all: usize) -> Range<usize> {
        let next = layer + 1;
        let end = if next < self.layout.layers { self.of_layer(next, first) } else { self.words[all] as usize };
        self.of_layer(layer, first)..end
    }
    /// Did a sort find particles of some layers that belong on another level?
    pub(crate) fn is_astray(&self, mut layers: Range<usize>) -> bool {
        layers.any(|layer| self.sum(layer, ASTRAY) > 0)
    }
    /// The step before which a layer was sorted last in the submission.
    pub(crate) fn sorted_before(&self, layer: usize) -> Option<usize> {
        (self.sum(layer, SORTED) as usize).checked_sub(1)
    }
    /// The greatest node speed of some layers in a step, or NaN if any is not finite [m/s].
    pub(crate) fn speed(&self, step: usize, mut layers: Range<usize>) -> f64 {
        layers
            .try_fold(0.0, |most: f64, layer| {
                let speed = f64::from(self.in_step(step, layer, SPEED));
                if speed.is_nan() { Err(speed) } else { Ok(most.max(speed)) }
            })
            .unwrap_or_else(|nan| nan)
    }
}

/// What digits of dissipated energy come to [J].
pub(crate) fn energy_of(digits: [u32; DAMPED_DIGITS]) -> f64 {
    digits.iter().rev().fold(0.0, |sum, digit| sum * 2f64.powi(32) + f64::from(*digit)) * DAMPED_UNIT
}
