//! What others read of particles: of a region, what is asked for.

use crate::store::{List, Store};
use barchan_core::task::Sampled;
use barchan_core::{Aabb, Reading};
use barchan_grid::block;
use barchan_grid::particles::Run;
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;
use rayon::prelude::*;

impl<T: Scalar> Store<T> {
    /// Reads particles in a region; blocks that cannot have any there are passed by.
    pub(crate) fn read(&self, level: usize, region: Option<&Aabb>, into: &mut Reading) {
        let h: f64 = self.cell_width;
        let (fields, origin) = (into.fields, into.origin);
        for list in &self.lists {
            let of_run = |(b, run): (usize, &Run)| {
                let mut some = Reading::new(fields, origin);
                if self.may_meet(b, region) {
                    run.places().for_each(|place| list.read(level, place, h, region, &mut some));
                }
                some
            };
            let all: Vec<Reading> = list.runs.par_iter().enumerate().map(of_run).collect();
            all.into_iter().for_each(|some| into.append(some));
        }
    }

    /// Can a block have particles in a region? Who is in a block may have left it by up to two cells.
    pub(crate) fn may_meet(&self, b: usize, region: Option<&Aabb>) -> bool {
        let h: f64 = self.cell_width;
        match (region, self.blocks.get(b)) {
            (Some(region), Some(&key)) => (0..3).all(|d| {
                let first = 4.0 * f64::from(block::of_key(key)[d]);
                (first - 2.0) * h <= region.max[d] && region.min[d] <= (first + 6.0) * h
            }),
            _ => true,
        }
    }

    /// The particles of some numbers, which count in the order of a [`download`](Self::download).
    pub(crate) fn sample<'a>(
        &'a self,
        numbers: impl Iterator<Item = usize> + 'a,
    ) -> impl Iterator<Item = Sampled> + 'a {
        let runs = self.lists.iter().flat_map(|list| list.runs.iter().map(move |run| (list, run)));
        let numbered = runs.scan(0, |count, (list, run)| {
            let first = *count;
            *count += run.count;
            Some((first, list, run))
        });
        let numbered: Vec<_> = numbered.collect();
        numbers.map(move |number| {
            let (first, list, run) = numbered[numbered.partition_point(|(first, ..)| *first <= number) - 1];
            let (chunk, lane) = (run.first + (number - first) / CHUNK, (number - first) % CHUNK);
            let motion = list.motion_of(chunk, lane);
            let velocity = std::array::from_fn(|d| motion[d]);
            Sampled { position: list.position_of(chunk, lane, self.cell_width), velocity }
        })
    }
}

impl<T: Scalar> List<T> {
    /// Reads a particle of a level if it lies in the region.
    fn read(&self, level: usize, (chunk, lane): (usize, usize), h: f64, region: Option<&Aabb>, into: &mut Reading) {
        let position = self.position_of(chunk, lane, h);
        if region.is_some_and(|region| !region.contains(position)) {
            return;
        }
        into.add_position(position);
        let fields = into.fields;
        let motion = self.motion_of(chunk, lane).map(|x| x as f32);
        into.velocity.extend(fields.velocity.then(|| std::array::from_fn(|d| motion[d])));
        into.affine.extend(fields.affine.then(|| std::array::from_fn(|k| motion[3 + k])));
        into.mass.extend(fields.mass.then(|| self.mass_of(chunk, lane) as f32));
        into.volume0.extend(fields.volume0.then(|| self.volume0_of(chunk, lane) as f32));
        into.id.extend(fields.id.then(|| u64::from(self.id[chunk][lane])));
        into.body.extend(fields.body.then(|| self.body[chunk][lane]));
        into.material.extend(fields.material.then_some(self.material as u16));
        into.level.extend(fields.level.then_some(level as u8));
    }
}
