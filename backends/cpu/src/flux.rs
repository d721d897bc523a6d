//! What crosses the sections of probes.
//!
//! Where a particle was before it moved is kept beside those near a section, and held against where it has come. Both are worked out in the same way from
//! what is stored, so that who stands on a plane is on the same side of it at the end of a step and at the beginning of the next: each crossing counts once.

use crate::level::Level;
use barchan_core::Plan;
use barchan_core::probe::{Crossed, Crossing};
use barchan_grid::block::{self, SIDE};
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;

/// A particle near a section: the section, and its list, chunk and lane; where it was [m].
type Near = (usize, [usize; 3], [f64; 3]);

/// The sections of a plan, and what has crossed them.
#[derive(Debug)]
pub(crate) struct Flux {
    crossings: Vec<Crossing>,
    pub(crate) crossed: Vec<Crossed>,
    /// Of each level, those near a section before they moved.
    near: Vec<Vec<Near>>,
}

impl Flux {
    pub(crate) fn new(plan: &Plan) -> Self {
        let crossings = Crossing::all(plan);
        let crossed = vec![Crossed::default(); crossings.len()];
        Self { crossings, crossed, near: vec![Vec::new(); plan.cell_widths.len()] }
    }

    /// Goes on from what another engine has counted.
    pub(crate) fn carry_on(&mut self, crossed: &[Crossed]) {
        self.crossed.iter_mut().zip(crossed).for_each(|(own, other)| {
            *own = Crossed { rest: Default::default(), ..*other };
        });
    }

    /// Takes note of where the particles of a level are that may cross a section in its step: no particle moves by more than a cell.
    pub(crate) fn see_sides<T: Scalar>(&mut self, l: usize, level: &Level<T>) {
        let h = level.h();
        self.near[l].clear();
        for (s, crossing) in self.crossings.iter().enumerate() {
            if crossing.filter.level.is_some_and(|own| own as usize != l) {
                continue;
            }
            let bounds = crossing.section.bounds().grown(h);
            let cells = [bounds.min, bounds.max].map(|x| x.map(|x| (x / h).floor() as i32));
            // Particles may have left their block by a cell since they were sorted.
            let is_near = |key: &u64| {
                let first = block::of_key(*key).map(|b| b * SIDE);
                (0..3).all(|d| first[d] - 1 <= cells[1][d] && cells[0][d] <= first[d] + SIDE)
            };
            let blocks = level.grid.occupied.iter().enumerate().filter(|(_, key)| is_near(key));
            for ((b, _), (m, list)) in
                blocks.flat_map(|block| level.store.lists.iter().enumerate().map(move |l| (block, l)))
            {
                let run = list.runs[b];
                for chunk in
                    (run.first..run.first + run.chunks()).filter(|&chunk| list.lanes_within(chunk, &cells) != 0)
                {
                    let lanes = (run.count - (chunk - run.first) * CHUNK).min(CHUNK);
                    let near = (0..lanes).map(|lane| (s, [m, chunk, lane], list.position_of(chunk, lane, h)));
                    self.near[l].extend(near);
                }
            }
        }
    }

    /// Adds what has crossed since.
    pub(crate) fn see_crossed<T: Scalar>(&mut self, l: usize, level: &Level<T>) {
        let h = level.h();
        for &(s, [m, chunk, lane], from) in &self.near[l] {
            let (crossing, list) = (&self.crossings[s], &level.store.lists[m]);
            let Some(is_against) = crossing.is_crossed(from, list.position_of(chunk, lane, h)) else { continue };
            if !crossing.filter.takes(list.material as u32, list.body[chunk][lane], l as u32) {
                continue;
            }
            let velocity = std::array::from_fn(|d| list.motion_of(chunk, lane)[d]);
            self.crossed[s].add(is_against, list.mass_of(chunk, lane), list.volume0_of(chunk, lane), velocity);
        }
    }
}
