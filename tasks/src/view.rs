//! What agents see of the ground.

use barchan_core::parameter::{Parameter, Parameters};
use barchan_core::scene::Scene;
use barchan_core::task::{Part, Sampled, Seen, Watch};
use barchan_core::{Simulation, Vec3};

/// Particles that are sampled.
///
/// # Source
/// UBSoft (CoRL 2024), appendix: 200 over all levels, more of finer ones.
const SAMPLED: usize = 200;
/// Points of the height map along x and y.
const MAP: usize = 16;

/// What agents may be asked to see of the ground.
const CHOICES: [&str; 4] = ["particles", "heights", "both", "none"];

/// How agents see the ground.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// Particles that are sampled of each level, the finest first.
    sample: Vec<usize>,
    /// Distance from the middle of the height map to its sides; none: there is no map [m].
    reach: Option<f64>,
}

impl View {
    /// The parameter that says how, for a task's list.
    pub(crate) fn parameter(default: &str) -> Parameter {
        let doc = "What the agent sees of the ground besides itself: 200 particles sampled over the levels, more of finer ones, with their velocities; \
                   a map of 16 × 16 heights around it; both, or none.";
        Parameter::text("observation", &CHOICES, doc).or(default)
    }

    /// As a scene and its parameters say; the map reaches so far to each side of the agent [m].
    pub(crate) fn new(scene: &Scene, parameters: &Parameters, reach: f64) -> Self {
        let wanted = parameters.text("observation");
        let has = |kind: &str| wanted == kind || wanted == "both";
        let sample = if has("particles") { shares(scene.levels.count as usize) } else { Vec::new() };
        Self { sample, reach: has("heights").then_some(reach) }
    }

    /// The parts of the observation.
    pub(crate) fn parts(&self) -> Vec<Part> {
        let particles =
            (!self.sample.is_empty()).then(|| Part::new("x, y, z [m], vx, vy, vz [m/s] of each particle", 6 * SAMPLED));
        let heights =
            self.reach.map(|_| Part::new("height of the ground around the agent [m], rows along x", MAP * MAP));
        particles.into_iter().chain(heights).collect()
    }

    /// What is to be looked at, with an agent there.
    pub(crate) fn watch(&self, agent: Vec3) -> Watch {
        Watch { sample: self.sample.clone(), heights: self.points(agent), ..Watch::default() }
    }

    /// How many heights of it are wanted.
    pub(crate) fn heights(&self) -> usize {
        self.reach.map_or(0, |_| MAP * MAP)
    }

    /// The numbers of [`parts`](Self::parts).
    pub(crate) fn numbers(&self, world: &Simulation, seen: &Seen) -> Vec<f64> {
        let mut numbers = Vec::new();
        if !self.sample.is_empty() {
            let of_one =
                |Sampled { position, velocity }: &Sampled| position.iter().chain(velocity).copied().collect::<Vec<_>>();
            numbers.extend(seen.sample.iter().flat_map(of_one));
            // Without any ground there is nothing to see.
            numbers.resize(6 * SAMPLED, 0.0);
        }
        if self.reach.is_some() {
            let floor = world.plan().scene.world.min[2];
            numbers.extend(seen.heights.iter().take(MAP * MAP).map(|height| height.unwrap_or(floor)));
        }
        numbers
    }

    fn points(&self, agent: Vec3) -> Vec<[f64; 2]> {
        let Some(reach) = self.reach else { return Vec::new() };
        let along = |i: usize, d: usize| agent[d] + reach * (2.0 * (i as f64 + 0.5) / MAP as f64 - 1.0);
        (0..MAP * MAP).map(|i| [along(i % MAP, 0), along(i / MAP, 1)]).collect()
    }
}

/// How many particles are sampled of each level: half as many as of the next finer one.
fn shares(levels: usize) -> Vec<usize> {
    let parts = (1_usize << levels) - 1;
    let mut all: Vec<usize> = (0..levels).rev().map(|l| SAMPLED * (1 << l) / parts).collect();
    all[0] += SAMPLED - all.iter().sum::<usize>();
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finer_levels_give_more_particles_and_all_give_200() {
        for levels in 1..=8 {
            let shares = shares(levels);
            assert_eq!(shares.iter().sum::<usize>(), 200);
            assert!(shares.windows(2).all(|pair| pair[0] > pair[1]), "{shares:?}");
        }
    }
}
