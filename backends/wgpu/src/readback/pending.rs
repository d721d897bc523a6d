//! The numbers of a step that are still on the device: where bodies' law runs on the host, the next step asks for them.

use crate::device::kernel::Role;
use crate::device::memory::read;
use crate::device::status::{DAMPED, DAMPED_DIGITS, MOVE, SLEPT, WALL_IMPULSE, energy_of};
use crate::passes::scene::damps;
use crate::passes::since_sort::SinceSort;
use crate::readback::Readback;
use crate::worlds::sleep::{SUMS, Slept};
use crate::worlds::world::Level;
use barchan_core::{Result, Vec3};
use barchan_grid::limits::MAX_DRIFT;

impl Readback<'_> {
    /// The age and drift of a world's levels since their last sort, after its last step, also if that step's numbers are still on the device.
    pub(crate) fn since_sorts(&self, w: usize) -> Vec<SinceSort> {
        let since_sort = |(layer, level): (usize, &Level)| {
            if !self.worlds[w].pending {
                return level.since_sort;
            }
            let at = 4 * self.memory.words().of_step(0, layer, MOVE) as u64;
            let words: Result<Vec<f32>> = read(self.gpu, self.memory.buffer(Role::Status, 0), at, 1);
            level.since_sort.after(words.map_or(MAX_DRIFT as f32, |words| words[0]))
        };
        self.layers_of(w).zip(&self.worlds[w].levels).map(since_sort).collect()
    }

    /// What walls gave a world in a step whose numbers are still on the device [N s].
    pub(crate) fn pending_walls(&self, w: usize) -> Vec3 {
        if !self.worlds[w].pending || !self.has_walls {
            return [0.0; 3];
        }
        let of_layer = |layer: usize| {
            let at = 4 * self.memory.words().of_sum(layer, WALL_IMPULSE) as u64;
            let words: Result<Vec<f32>> = read(self.gpu, self.memory.buffer(Role::Status, 0), at, 3);
            words.map_or([0.0; 3], |w| [w[0], w[1], w[2]].map(f64::from))
        };
        self.layers_of(w).map(of_layer).fold([0.0; 3], |sum, v| std::array::from_fn(|d| sum[d] + v[d]))
    }

    /// What damping dissipated of a world in such a step [J].
    pub(crate) fn pending_damped(&self, w: usize) -> f64 {
        if !self.worlds[w].pending || !damps(&self.worlds[w].materials) {
            return 0.0;
        }
        let of_layer = |layer: usize| {
            let at = 4 * self.memory.words().of_sum(layer, DAMPED) as u64;
            let words: Vec<u32> =
                read(self.gpu, self.memory.buffer(Role::Status, 0), at, DAMPED_DIGITS).unwrap_or_default();
            words.try_into().map_or(0.0, energy_of)
        };
        self.layers_of(w).map(of_layer).sum()
    }

    /// What sleep took from a world in a step whose numbers are still on the device, and what gravity has not given it [N s].
    pub(crate) fn pending_sleep(&self, w: usize) -> (Slept, Vec3) {
        let (mut slept, mut kept) = (Slept::default(), [0.0; 3]);
        if self.sleeps && self.worlds[w].pending {
            for (l, layer) in self.layers_of(w).enumerate() {
                let at = 4 * self.memory.words().of_sum(layer, SLEPT) as u64;
                let words: Vec<u32> = read(self.gpu, self.memory.buffer(Role::Status, 0), at, SUMS).unwrap_or_default();
                if let Ok(words) = <[u32; SUMS]>::try_from(words) {
                    let by_gravity = self.worlds[w].kept_from_gravity(l, slept.add(words));
                    (0..3).for_each(|d| kept[d] += by_gravity[d]);
                }
            }
        }
        (slept, kept)
    }
}
