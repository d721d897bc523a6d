//! Particles in memory, and how they are sorted.
//!
//! Each list (one material) lies in chunks of 16 particles, structure of arrays within the chunk. Blocks own whole chunks, so
//! threads never share one; the last chunk of a block's run is padded with massless particles.

use crate::memory::{Line, Parts, Plane, Rows, lines, room};
use barchan_core::batch::Plane as Values;
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::Leaving;
use barchan_core::stiffness::{Need, PARTICLES, Stiffness};
use barchan_core::{Aabb, Error, ParticleList, Result, Spot};
use barchan_grid::adapt::Parcel;
use barchan_grid::block::{self, CELLS};
use barchan_grid::bounds::Bounds;
use barchan_grid::particles::{MASS, MOTION, Particles, Run, STRAIN, VOLUME};
use barchan_grid::rest::ASLEEP;
use barchan_grid::transfer::{Law, MAX_STATE, Scalar};
use barchan_lanes::{CHUNK, Float, Plain};
use rayon::prelude::*;
use std::borrow::Borrow;

/// Marks a padding lane in a permutation.
pub(crate) const PAD: u32 = u32::MAX;

/// The particles of one material.
pub(crate) struct List<T: Scalar> {
    /// Index into the plan's materials.
    pub(crate) material: usize,
    /// The material, with parameters.
    pub(crate) law: Law<T>,
    /// Undeformed strain, for padding.
    identity: &'static [f64],
    /// Chunks in each block.
    pub(crate) runs: Vec<Run>,
    pub(crate) id: Vec<[u32; CHUNK]>,
    pub(crate) body: Vec<[u16; CHUNK]>,
    cell: Vec<Line<i32>>,
    offset: Vec<Line<T::Offset>>,
    motion: Vec<Line<T>>,
    rest: Vec<Line<T>>,
    rest_planes: usize,
}

impl<T: Scalar> List<T> {
    fn new(index: usize, planned: &PlannedMaterial) -> Self {
        let law = Law {
            table: planned.material.table,
            params: planned.parameters.iter().map(|&p| T::from_f64(p)).collect(),
            damping: planned.damping,
        };
        let rest_planes = STRAIN + planned.material.values();
        Self {
            material: index,
            law,
            identity: planned.material.strain_identity(),
            runs: Vec::new(),
            id: Vec::new(),
            body: Vec::new(),
            cell: Vec::new(),
            offset: Vec::new(),
            motion: Vec::new(),
            rest: Vec::new(),
            rest_planes,
        }
    }

    /// The list with its chunks to be handed out.
    pub(crate) fn open(&mut self) -> OpenList<'_, T> {
        let planes = (
            (
                (Rows::new(&mut self.id, 1), Rows::new(&mut self.body, 1)),
                (Rows::new(&mut self.cell, 3), Rows::new(&mut self.offset, 3)),
            ),
            (Rows::new(&mut self.motion, MOTION), Rows::new(&mut self.rest, self.rest_planes)),
        );
        OpenList {
            material: self.material,
            law: &self.law,
            runs: &self.runs,
            identity: self.identity,
            rest_planes: self.rest_planes,
            chunks: Parts::new(planes),
        }
    }

    /// Chunks in use.
    fn chunks(&self) -> usize {
        self.id.len()
    }

    /// Planes of strain and of history.
    pub(crate) fn strain_planes(&self) -> usize {
        self.law.strain_planes()
    }

    /// Number of particles.
    pub(crate) fn len(&self) -> usize {
        self.runs.iter().map(|run| run.count).sum()
    }

    /// (chunk, lane) of every particle, block by block.
    pub(crate) fn places(&self) -> impl Iterator<Item = (usize, usize)> {
        // A step that failed may have left lanes that wait to be sorted out.
        self.lanes().filter(|&(chunk, lane)| self.id[chunk][lane] != PAD)
    }

    /// (chunk, lane) of every lane that a run counts.
    fn lanes(&self) -> impl Iterator<Item = (usize, usize)> {
        self.runs.iter().flat_map(|run| run.places())
    }

    pub(crate) fn cell_of(&self, chunk: usize, lane: usize) -> [i32; 3] {
        std::array::from_fn(|d| self.cell[chunk * 3 + d].0[lane])
    }
    /// Which lanes of a chunk are in the range of cells, from the first to the last along each axis, as bits.
    pub(crate) fn lanes_within(&self, chunk: usize, [first, last]: &[[i32; 3]; 2]) -> u16 {
        let mut inside = [true; CHUNK];
        for d in 0..3 {
            let cells = &self.cell[chunk * 3 + d].0;
            for lane in 0..CHUNK {
                inside[lane] &= (first[d] <= cells[lane]) & (cells[lane] <= last[d]);
            }
        }
        inside.iter().rev().fold(0, |bits, inside| bits << 1 | u16::from(*inside))
    }
    pub(crate) fn offset_of(&self, chunk: usize, lane: usize) -> [f64; 3] {
        std::array::from_fn(|d| T::offset_to_f64(self.offset[chunk * 3 + d].0[lane]))
    }
    /// Where a particle is, in cells `h` wide [m].
    pub(crate) fn position_of(&self, chunk: usize, lane: usize, h: f64) -> [f64; 3] {
        let (cell, offset) = (self.cell_of(chunk, lane), self.offset_of(chunk, lane));
        std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * h)
    }
    pub(crate) fn motion_of(&self, chunk: usize, lane: usize) -> [f64; MOTION] {
        std::array::from_fn(|p| self.motion[chunk * MOTION + p].0[lane].to_f64())
    }
    pub(crate) fn rest_of(&self, chunk: usize, lane: usize, plane: usize) -> f64 {
        self.rest[chunk * self.rest_planes + plane].0[lane].to_f64()
    }
    pub(crate) fn rest_plane(&self, chunk: usize, plane: usize) -> [T; CHUNK] {
        self.rest[chunk * self.rest_planes + plane].0
    }
    pub(crate) fn mass_of(&self, chunk: usize, lane: usize) -> f64 {
        self.rest_of(chunk, lane, MASS)
    }
    pub(crate) fn volume0_of(&self, chunk: usize, lane: usize) -> f64 {
        self.rest_of(chunk, lane, VOLUME)
    }

    /// How many steps a second the first particles of a chunk need.
    pub(crate) fn need(&self, law: &Stiffness<'_>, chunk: usize, count: usize, h: f64) -> Result<Need> {
        let (mut strain, mut state) =
            ([Values::<f32, PARTICLES>::default(); 9], [Values::<f32, PARTICLES>::default(); MAX_STATE]);
        let planes = self.strain_planes();
        let n_state = self.law.table.n_state;
        let values = strain[..planes].iter_mut().chain(&mut state[..n_state]);
        for (plane, value) in values.zip(STRAIN..) {
            plane.0 = self.rest_plane(chunk, value).map(|x| x.to_f64() as f32);
        }
        let id = |lane: usize| Some(u64::from(self.id[chunk][lane]));
        let (mass, volume0) = (self.rest_plane(chunk, MASS), self.rest_plane(chunk, VOLUME));
        let density = std::array::from_fn(|lane| mass[lane].to_f64() / volume0[lane].to_f64());
        law.need([&strain[..], &state[..]], count, (h, &density), id)
    }

    /// A copy of one particle.
    pub(crate) fn parcel(&self, index: usize, chunk: usize, lane: usize) -> Parcel {
        let mut rest = [0.0; STRAIN + 9 + MAX_STATE];
        for (p, value) in rest[..self.rest_planes].iter_mut().enumerate() {
            *value = self.rest_of(chunk, lane, p);
        }
        Parcel {
            list: index,
            id: self.id[chunk][lane],
            body: self.body[chunk][lane],
            cell: self.cell_of(chunk, lane),
            offset: self.offset_of(chunk, lane),
            motion: self.motion_of(chunk, lane),
            rest,
        }
    }

    /// Does any particle of a run move?
    fn moves(&self, run: Run) -> bool {
        let planes = &self.motion[run.first * MOTION..(run.first + run.chunks()) * MOTION];
        planes.iter().any(|plane| plane.0 != [T::default(); CHUNK])
    }

    /// Takes all motion from a run's particles.
    pub(crate) fn stop(&mut self, run: Run) {
        for plane in &mut self.motion[run.first * MOTION..(run.first + run.chunks()) * MOTION] {
            plane.0 = [T::default(); CHUNK];
        }
    }

    /// Bytes held.
    fn bytes(&self) -> u64 {
        (self.id.capacity() * size_of::<[u32; CHUNK]>()
            + self.body.capacity() * size_of::<[u16; CHUNK]>()
            + self.cell.capacity() * size_of::<Line<i32>>()
            + self.offset.capacity() * size_of::<Line<T::Offset>>()
            + (self.motion.capacity() + self.rest.capacity()) * size_of::<Line<T>>()) as u64
    }

    /// Makes room for exactly `chunks` chunks without looking at what they hold.
    fn resize(&mut self, chunks: usize) {
        fn fit<W: Copy>(plane: &mut Vec<Line<W>>, count: usize, value: W) {
            if count > plane.capacity() {
                let mut grown = lines(count + count / 32, value);
                grown[..plane.len()].copy_from_slice(plane);
                *plane = grown;
            }
            plane.resize(count, Line([value; CHUNK]));
        }
        self.id.resize(chunks, [PAD; CHUNK]);
        self.body.resize(chunks, [0; CHUNK]);
        fit(&mut self.cell, chunks * 3, 0);
        fit(&mut self.offset, chunks * 3, T::Offset::default());
        fit(&mut self.motion, chunks * MOTION, T::default());
        fit(&mut self.rest, chunks * self.rest_planes, T::default());
    }

    /// Sets runs from counts per block and returns the number of chunks.
    fn lay_out(&mut self, counts: impl Iterator<Item = usize>) -> usize {
        let mut first = 0;
        self.runs.clear();
        self.runs.extend(counts.map(|count| {
            let run = Run { first, count };
            first += run.chunks();
            run
        }));
        first
    }

    fn take_in(&mut self, list: &ParticleList, counts: impl Iterator<Item = usize>) {
        let chunks = self.lay_out(counts);
        self.resize(chunks);
        let open = self.open();
        let firsts: Vec<usize> =
            open.runs.iter().scan(0, |end, run| Some(std::mem::replace(end, *end + run.count))).collect();
        let each = open.runs.par_iter().zip(firsts);
        each.for_each(|(run, first)| open.fill(*run, |i| Parcel::of(list, first + i)));
    }

    /// Where a particle is and how large.
    pub(crate) fn spot(&self, (chunk, lane): (usize, usize), cell_width: f64) -> Spot {
        Spot {
            position: self.position_of(chunk, lane, cell_width),
            volume0: self.volume0_of(chunk, lane),
            material: self.material as u32,
        }
    }

    /// A list of the particles at some places.
    pub(crate) fn give_out(&self, level: usize, cell_width: f64, places: &[(usize, usize)]) -> ParticleList {
        let (planes, values) = (self.strain_planes(), self.rest_planes - STRAIN);
        let mut out = ParticleList::empty(level, self.material, cell_width, planes, values - planes);
        let ParticleList { id, body, cell, offset, velocity, affine, mass, volume0, strain, state, .. } = &mut out;
        let mut rest: Vec<&mut Vec<f64>> = [mass, volume0].into_iter().chain(strain).chain(state).collect();
        // Side by side what stands together in a chunk, so that each thread walks through memory.
        rayon::scope(|scope| {
            scope.spawn(|_| {
                for &(chunk, lane) in places {
                    let motion = self.motion_of(chunk, lane);
                    velocity.push([motion[0], motion[1], motion[2]]);
                    affine.push(std::array::from_fn(|i| motion[3 + i]));
                }
            });
            scope.spawn(|_| {
                for &(chunk, lane) in places {
                    rest.iter_mut().enumerate().for_each(|(p, plane)| plane.push(self.rest_of(chunk, lane, p)));
                }
            });
            for &(chunk, lane) in places {
                id.push(u64::from(self.id[chunk][lane]));
                body.push(self.body[chunk][lane]);
                cell.push(self.cell_of(chunk, lane));
                offset.push(self.offset_of(chunk, lane));
            }
        });
        out
    }
}

/// Planes of a list side by side: id and body, cell and offset, motion and rest.
type Planes<'a, T> = (
    ((Rows<'a, [u32; CHUNK]>, Rows<'a, [u16; CHUNK]>), (Rows<'a, Line<i32>>, Rows<'a, Line<<T as Float>::Offset>>)),
    (Rows<'a, Line<T>>, Rows<'a, Line<T>>),
);

/// A list whose chunks are handed out to threads, each to one of them.
pub(crate) struct OpenList<'a, T: Scalar> {
    pub(crate) material: usize,
    pub(crate) law: &'a Law<T>,
    pub(crate) runs: &'a [Run],
    identity: &'static [f64],
    rest_planes: usize,
    chunks: Parts<Planes<'a, T>>,
}

impl<'a, T: Scalar> OpenList<'a, T> {
    /// A block's particles, for a transfer.
    pub(crate) fn of_block(&self, b: usize) -> Particles<'a, T> {
        let run = self.runs[b];
        let Chunks { cell, offset, motion, rest, .. } = self.take(run.first, run.chunks());
        let rest = (Line::flat(rest), self.rest_planes);
        Particles::new(run.count, Line::flat(cell), Line::flat(offset), Line::flat(motion), rest)
    }

    fn take(&self, first: usize, count: usize) -> Chunks<'a, T> {
        let (((id, body), (cell, offset)), (motion, rest)) = self.chunks.take(first..first + count);
        Chunks { id, body, cell, offset, motion, rest, rest_planes: self.rest_planes }
    }

    /// Puts particles into the lanes of a run, in their order, and pads it.
    fn fill<P: Borrow<Parcel>>(&self, run: Run, parcel: impl Fn(usize) -> P + Sync) {
        (0..run.chunks()).into_par_iter().for_each(|k| {
            let mut chunk = self.take(run.first + k, 1);
            let here = k * CHUNK..run.count.min((k + 1) * CHUNK);
            here.clone().for_each(|i| chunk.put(parcel(i).borrow(), i % CHUNK));
            chunk.pad(here.len(), self.identity);
        });
    }

    /// Pads each run.
    fn pad(&self) {
        self.runs.par_iter().filter(|run| run.count % CHUNK > 0).for_each(|run| {
            self.take(run.first + run.count / CHUNK, 1).pad(run.count % CHUNK, self.identity);
        });
    }
}

/// Chunks of a list, to be written to.
struct Chunks<'a, T: Scalar> {
    id: &'a mut [[u32; CHUNK]],
    body: &'a mut [[u16; CHUNK]],
    cell: &'a mut [Line<i32>],
    offset: &'a mut [Line<T::Offset>],
    motion: &'a mut [Line<T>],
    rest: &'a mut [Line<T>],
    rest_planes: usize,
}

impl<T: Scalar> Chunks<'_, T> {
    /// Mass of a particle [kg].
    fn mass_of(&self, chunk: usize, lane: usize) -> f64 {
        self.rest[chunk * self.rest_planes + MASS].0[lane].to_f64()
    }

    /// Where a particle is in its cell.
    fn offset_of(&self, chunk: usize, lane: usize) -> [f64; 3] {
        std::array::from_fn(|d| T::offset_to_f64(self.offset[chunk * 3 + d].0[lane]))
    }

    /// Puts a particle into a lane of the first chunk.
    fn put(&mut self, parcel: &Parcel, lane: usize) {
        self.id[0][lane] = parcel.id;
        self.body[0][lane] = parcel.body;
        for d in 0..3 {
            let (cell, offset) = match T::offset_from_f64(parcel.offset[d]) {
                Some(offset) => (parcel.cell[d], offset),
                None => (parcel.cell[d] + 1, T::Offset::default()),
            };
            self.cell[d].0[lane] = cell;
            self.offset[d].0[lane] = offset;
        }
        let (motion, rest) = (self.motion.iter_mut().zip(&parcel.motion), self.rest.iter_mut().zip(&parcel.rest));
        motion.chain(rest).for_each(|(plane, &value)| plane.0[lane] = T::from_f64(value));
    }

    /// Turns the lanes behind the first `used` of the first chunk into massless particles at rest in the last one's cell. `identity`: undeformed strain.
    fn pad(&mut self, used: usize, identity: &[f64]) {
        for lane in used..CHUNK {
            self.id[0][lane] = PAD;
            for d in 0..3 {
                self.cell[d].0[lane] = self.cell[d].0[used - 1];
                self.offset[d].0[lane] = T::Offset::default();
            }
            for plane in &mut *self.motion {
                plane.0[lane] = T::default();
            }
            for (p, plane) in self.rest.iter_mut().enumerate() {
                // History planes keep some particle's value, which the material has seen before.
                plane.0[lane] = match p {
                    MASS | VOLUME => T::default(),
                    _ => match identity.get(p - STRAIN) {
                        Some(&one) => T::from_f64(one),
                        None => plane.0[used - 1],
                    },
                };
            }
        }
    }
}

/// What a sort did with particles that left the world.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Departures {
    /// Particles put back.
    pub(crate) clamped: u64,
    /// Impulse taken from them [N s].
    pub(crate) impulse: [f64; 3],
    /// Particles deleted.
    pub(crate) deleted: u64,
    /// Their mass [kg].
    pub(crate) deleted_mass: f64,
    /// The particle of least number outside, if the scene calls that an error, and where it is [m].
    pub(crate) refused: Option<(u32, [f64; 3])>,
}

impl Departures {
    fn add(&mut self, other: Self) {
        self.clamped += other.clamped;
        self.deleted += other.deleted;
        self.deleted_mass += other.deleted_mass;
        for (sum, x) in self.impulse.iter_mut().zip(other.impulse) {
            *sum += x;
        }
        self.refused = [self.refused, other.refused].into_iter().flatten().min_by_key(|(id, _)| *id);
    }
}

/// All particles of one level.
pub(crate) struct Store<T: Scalar> {
    pub(crate) lists: Vec<List<T>>,
    pub(crate) cell_width: f64,
    /// Keys of the blocks, rising, that `runs` of each list are parallel to.
    pub(crate) blocks: Vec<u64>,
    /// For how many steps each block's particles have been slow; see [`crate::sleep`].
    pub(crate) rest: Vec<u16>,
    /// Room for the largest group of planes of the largest list while it is permuted.
    scratch: Vec<Line<T>>,
    order: Vec<[u32; CHUNK]>,
}

/// A block as a sort left it: its coordinates, the particles of each list in it, and for how long it has been at rest.
pub(crate) type Laid<'a> = ([i32; 3], &'a [u32], u16);

/// A particle that changes its block, or comes in: new block, list, place (chunk * 16 + lane).
type Mover = (u64, u16, u32);

impl<T: Scalar> Store<T> {
    pub(crate) fn new(materials: &[PlannedMaterial], cell_width: f64) -> Self {
        Self {
            lists: materials.iter().enumerate().map(|(i, m)| List::new(i, m)).collect(),
            cell_width,
            blocks: Vec::new(),
            rest: Vec::new(),
            scratch: Vec::new(),
            order: Vec::new(),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.lists.iter().map(List::len).sum()
    }

    pub(crate) fn bytes(&self) -> u64 {
        self.lists.iter().map(List::bytes).sum::<u64>()
            + (self.scratch.capacity() * size_of::<Line<T>>() + self.order.capacity() * size_of::<[u32; CHUNK]>())
                as u64
    }

    /// Takes in one level's particles. With the blocks of a sort they are laid out exactly as it says; the caller sorts
    /// otherwise.
    pub(crate) fn upload(&mut self, lists: &[ParticleList], blocks: Option<&[Laid<'_>]>) -> Result<()> {
        let refuse = |what: String| Error::Body {
            path: "particles".into(),
            what,
            mend: "hand back particles of a simulation of the same scene".into(),
        };
        for (list, mine) in lists.iter().zip(&self.lists) {
            let states = mine.rest_planes - STRAIN - mine.strain_planes();
            if list.strain.len() != mine.strain_planes() || list.state.len() != states {
                return Err(refuse(format!(
                    "list {} has {} strain and {} history planes where its material has {} and {states}",
                    mine.material,
                    list.strain.len(),
                    list.state.len(),
                    mine.strain_planes()
                )));
            }
            if list.id.iter().any(|&id| id >= u64::from(PAD)) {
                return Err(refuse(format!("a particle id is {} or greater", PAD)));
            }
        }
        match blocks {
            Some(blocks) => {
                self.blocks = blocks
                    .iter()
                    .map(|(at, ..)| block::key(*at))
                    .collect::<Option<_>>()
                    .ok_or_else(|| refuse("a block lies beyond the reach of the grid".into()))?;
                self.rest = blocks.iter().map(|(.., rest)| *rest).collect();
                if blocks.iter().any(|(_, counts, _)| counts.len() != self.lists.len())
                    || !self.blocks.is_sorted_by(|a, b| a < b)
                {
                    return Err(refuse("the sort's blocks are out of order or lack a list".into()));
                }
                for (i, (mine, list)) in self.lists.iter_mut().zip(lists).enumerate() {
                    let counts = blocks.iter().map(|(_, counts, _)| counts[i] as usize);
                    if counts.clone().sum::<usize>() != list.len() {
                        return Err(refuse(format!("the sort's counts do not add up to list {i}")));
                    }
                    mine.take_in(list, counts);
                }
                // Whoever hands back particles may have set them in motion.
                for (b, rest) in self.rest.iter_mut().enumerate().filter(|(_, rest)| **rest == ASLEEP) {
                    if self.lists.iter().any(|list| list.moves(list.runs[b])) {
                        *rest = 0;
                    }
                }
            }
            None => {
                // One run that holds everything, in no block: the first sort sees every particle as a newcomer.
                self.blocks.clear();
                self.rest.clear();
                for (mine, list) in self.lists.iter_mut().zip(lists) {
                    mine.take_in(list, std::iter::once(list.len()));
                }
            }
        }
        Ok(())
    }

    /// A copy of one level's particles.
    pub(crate) fn download(&self, level: usize) -> Vec<ParticleList> {
        let of = |list: &List<T>| list.give_out(level, self.cell_width, &list.places().collect::<Vec<_>>());
        self.lists.par_iter().map(of).collect()
    }

    /// The particles for which `wanted` holds, all of which are in the region if there is one, as [`download`](Self::download) gives them.
    pub(crate) fn download_where<'a>(
        &'a self,
        level: usize,
        region: Option<&'a Aabb>,
        wanted: &'a (dyn Fn(&Spot) -> bool + Sync),
    ) -> impl Iterator<Item = ParticleList> + 'a {
        self.lists.iter().map(move |list| {
            let of_run = |(b, run): (usize, &Run)| match self.may_meet(b, region) {
                true => run.places().filter(|place| wanted(&list.spot(*place, self.cell_width))).collect(),
                false => Vec::new(),
            };
            let here: Vec<Vec<(usize, usize)>> = list.runs.par_iter().enumerate().map(of_run).collect();
            list.give_out(level, self.cell_width, &here.concat())
        })
    }

    /// Adds where every particle is and how large, in the order of [`download`](Self::download).
    pub(crate) fn add_spots(&self, spots: &mut Vec<Spot>) {
        for list in &self.lists {
            let of = |run: &Run| run.places().map(|place| list.spot(place, self.cell_width)).collect::<Vec<_>>();
            spots.par_extend(list.runs.par_iter().flat_map_iter(of));
        }
    }

    /// Blocks in order, and the number of particles of each list in them.
    pub(crate) fn blocks_held(&self) -> impl Iterator<Item = ([i32; 3], Vec<u32>)> {
        let count = |b: usize| self.lists.iter().map(move |list| list.runs[b].count as u32).collect();
        self.blocks.iter().enumerate().map(move |(b, &key)| (block::of_key(key), count(b)))
    }

    /// Takes in particles from elsewhere. They are in no block until the next sort.
    pub(crate) fn push(&mut self, parcels: &[&Parcel]) {
        for (index, list) in self.lists.iter_mut().enumerate() {
            let here: Vec<&Parcel> = parcels.iter().copied().filter(|parcel| parcel.list == index).collect();
            let run = Run { first: list.chunks(), count: here.len() };
            list.resize(run.first + run.chunks());
            list.open().fill(run, |i| here[i]);
            list.runs.push(run);
        }
    }

    /// Makes lanes of a list empty until the next sort, which must be told that there are holes. Places are numbers of lanes.
    pub(crate) fn remove(&mut self, list: usize, places: impl Iterator<Item = usize>) {
        let Self { lists, rest, .. } = self;
        let List { id, runs, .. } = &mut lists[list];
        let mut here = 0;
        for place in places {
            let chunk = place / CHUNK;
            id[chunk][place % CHUNK] = PAD;
            // As a rule it is in the same block as the one before. Runs without particles start where the next one does.
            if runs.get(here).is_none_or(|run| !(run.first..run.first + run.chunks()).contains(&chunk)) {
                here = runs.partition_point(|run| run.first + run.chunks() <= chunk);
            }
            if let Some(rest) = rest.get_mut(here) {
                *rest = (*rest).min(1);
            }
        }
    }

    /// Sorts particles into blocks, and within a block by cell. Particles of a cell keep their order; newcomers to a block
    /// come after those that stayed, in the order of where they were.
    /// `holes` says whether particles have been removed since the last sort.
    pub(crate) fn sort(&mut self, bounds: &Bounds, leaving: Leaving, holes: bool) -> Result<Departures> {
        // 1. Who leaves the world, who changes the block?
        let n_blocks = self.lists.first().map_or(0, |list| list.runs.len());
        let lists: Vec<_> = self.lists.iter_mut().map(List::open).collect();
        let (blocks, h) = (&self.blocks, self.cell_width);
        let of_block = |b: usize| find_movers(&lists, (b, blocks.get(b).copied()), h, bounds, leaving);
        let found: Vec<(Vec<Mover>, bool, Departures, bool)> = (0..n_blocks).into_par_iter().map(of_block).collect();
        let mut departures = Departures::default();
        let mut movers: Vec<Mover> = Vec::with_capacity(found.iter().map(|f| f.0.len()).sum());
        let mut keys: Vec<u64> = Vec::with_capacity(n_blocks);
        for (b, (moved, stays, gone, far)) in found.into_iter().enumerate() {
            if far {
                return Err(Error::Capacity {
                    what: "distance from the origin in cells",
                    asked: block::REACH as u64 * 4,
                    cap: block::REACH as u64 * 4,
                    mend: "use a coarser world.cell or move the scene towards the origin",
                });
            }
            departures.add(gone);
            movers.extend(moved);
            if stays {
                keys.push(self.blocks[b]);
            }
        }
        movers.par_sort_unstable();
        keys.extend(movers.iter().map(|m| m.0));
        keys.sort_unstable();
        keys.dedup();

        // 2. Count, lay out and order each list's particles.
        let old_blocks = std::mem::replace(&mut self.blocks, keys);
        let old_rest = std::mem::take(&mut self.rest);
        let rest = |key: &u64| old_blocks.binary_search(key).map_or(1, |old| old_rest[old]);
        self.rest = self.blocks.iter().map(rest).collect();
        for newcomers in movers.chunk_by(|a, b| a.0 == b.0) {
            if let Ok(b) = self.blocks.binary_search(&newcomers[0].0) {
                self.rest[b] = self.rest[b].min(1);
            }
        }
        for index in 0..self.lists.len() {
            self.sort_list(index, &old_blocks, &movers, holes || departures.deleted > 0);
        }
        Ok(departures)
    }

    /// Lays one list out for the new blocks and moves its particles there.
    fn sort_list(&mut self, index: usize, old_blocks: &[u64], movers: &[Mover], deleted: bool) {
        let most = self.lists.iter().map(|list| list.chunks() * MOTION.max(list.rest_planes)).max().unwrap_or(0);
        let list = &mut self.lists[index];
        let blocks = &self.blocks;
        let old_runs = std::mem::take(&mut list.runs);
        let staying = |b: usize| {
            let run = old_blocks.binary_search(&blocks[b]).map_or(Run { first: 0, count: 0 }, |old| old_runs[old]);
            (run, block::of_key(blocks[b]))
        };
        let (cells, ids) = (&list.cell, &list.id);
        let each = |b: usize, take: &mut dyn FnMut(&[u32; CHUNK], usize, usize)| {
            let (run, home) = staying(b);
            for chunk in run.first..run.first + run.chunks() {
                let count = (run.count - (chunk - run.first) * CHUNK).min(CHUNK);
                let mut local = local_cells(&cells[chunk * 3..], home);
                if deleted {
                    for (local, &id) in local.iter_mut().zip(&ids[chunk]) {
                        *local = if id == PAD { ELSEWHERE } else { *local };
                    }
                }
                take(&local, chunk * CHUNK, count);
            }
            // Newcomers, one at a time.
            let from = movers.partition_point(|m| (m.0, m.1) < (blocks[b], index as u16));
            let to = movers.partition_point(|m| (m.0, m.1) <= (blocks[b], index as u16));
            for mover in &movers[from..to] {
                let (chunk, lane) = (mover.2 as usize / CHUNK, mover.2 as usize % CHUNK);
                take(&[local_cells(&cells[chunk * 3..], home)[lane]; CHUNK], mover.2 as usize, 1);
            }
        };
        // How many particles each block has in each of its cells, and at the end those that are elsewhere.
        let in_cells: Vec<[u32; CELLS + 1]> = (0..blocks.len())
            .into_par_iter()
            .map(|b| {
                let mut count = [0; CELLS + 1];
                each(b, &mut |local, _, n| local[..n].iter().for_each(|&cell| count[cell as usize] += 1));
                count
            })
            .collect();
        let counts = in_cells.iter().map(|count| count[..CELLS].iter().sum::<u32>() as usize);
        let mut first = 0;
        let runs: Vec<Run> = counts
            .map(|count| {
                let run = Run { first, count };
                first += run.chunks();
                run
            })
            .collect();
        let chunks = first;

        // The permutation, chunk by chunk: a stable counting sort by cell within each block.
        self.order.clear();
        self.order.resize(chunks, [PAD; CHUNK]);
        let order = Parts::of(&mut self.order);
        (0..blocks.len()).into_par_iter().for_each(|b| {
            let own = order.take(runs[b].first..runs[b].first + runs[b].chunks()).as_flattened_mut();
            let mut next = in_cells[b];
            let mut start = 0;
            for next in &mut next {
                start += std::mem::replace(next, start);
            }
            each(b, &mut |local, place, n| {
                for (l, &cell) in local[..n].iter().enumerate() {
                    if cell != ELSEWHERE {
                        own[next[cell as usize] as usize] = (place + l) as u32;
                        next[cell as usize] += 1;
                    }
                }
            });
        });

        let changed = self.order.par_iter().enumerate().filter(|(c, lanes)| !is_own(*c, lanes)).count();
        let unchanged = chunks == list.chunks() && changed == 0;
        list.runs = runs;
        if unchanged {
            // A run may have gone to another block as it is; its padding must lie there too.
            list.open().pad();
            return;
        }
        let room = chunks.max(list.chunks());
        let widest = (MOTION.max(list.rest_planes) * size_of::<T>()).max(3 * size_of::<T::Offset>().max(4));
        let needed = room * widest / size_of::<T>();
        if needed > self.scratch.capacity() {
            self.scratch = lines(needed + needed / 32, T::default());
        }
        self.scratch.resize(needed, Line([T::default(); CHUNK]));
        let old_chunks = list.chunks();
        list.resize(room);
        let (order, scratch) = (&self.order, &mut self.scratch);
        permute(&mut list.id, 1, order, scratch);
        permute(&mut list.body, 1, order, scratch);
        permute(&mut list.cell, 3, order, scratch);
        permute(&mut list.offset, 3, order, scratch);
        let (mut narrow, mut wide) = ((&mut list.motion, MOTION), (&mut list.rest, list.rest_planes));
        if narrow.1 > wide.1 {
            std::mem::swap(&mut narrow, &mut wide);
        }
        permute(narrow.0, narrow.1, order, scratch);
        // The widest group and the scratch may change places, which saves the way back; but not if that leaves too little for a
        // longer list, nor if few chunks have changed.
        if wide.0.capacity() >= most.max(needed) && wide.0.len() == needed && 2 * changed > chunks {
            gather(wide.0, wide.1, order, scratch, |_, _| true);
            std::mem::swap(wide.0, scratch);
        } else {
            permute(wide.0, wide.1, order, scratch);
        }
        if old_chunks != chunks {
            list.resize(chunks);
        }
        list.open().pad();
    }
}

/// Looks at one block's particles, given its number and its key if it has one: those that belong elsewhere, whether any stays, those
/// outside the world, and whether one is too far away to be keyed.
fn find_movers<T: Scalar>(
    lists: &[OpenList<'_, T>],
    (b, home): (usize, Option<u64>),
    h: f64,
    bounds: &Bounds,
    leaving: Leaving,
) -> (Vec<Mover>, bool, Departures, bool) {
    let (mut movers, mut stays, mut gone, mut far) = (Vec::new(), false, Departures::default(), false);
    for (l, list) in lists.iter().enumerate() {
        let run = list.runs[b];
        let own = list.take(run.first, run.chunks());
        for i in 0..run.count {
            let (chunk, lane) = (i / CHUNK, i % CHUNK);
            let mut at = [0; 3];
            for d in 0..3 {
                let cell = own.cell[chunk * 3 + d].0[lane];
                at[d] = cell;
                if (bounds.min[d]..bounds.max[d]).contains(&cell) {
                    continue;
                }
                if bounds.periodic[d] {
                    at[d] = bounds.min[d] + (cell - bounds.min[d]).rem_euclid(bounds.max[d] - bounds.min[d]);
                } else if own.id[chunk][lane] != PAD {
                    match leaving {
                        Leaving::Error => {}
                        Leaving::Delete => {
                            gone.deleted += 1;
                            gone.deleted_mass += own.mass_of(chunk, lane);
                            // The mark is read when the list is laid out.
                            own.id[chunk][lane] = PAD;
                        }
                        Leaving::Clamp => {
                            let low = cell < bounds.min[d];
                            at[d] = if low { bounds.min[d] } else { bounds.max[d] - 1 };
                            let edge = if low { 0.0 } else { 1.0 - f64::from(f32::EPSILON) };
                            own.offset[chunk * 3 + d].0[lane] = T::offset_from_f64(edge).unwrap_or_default();
                            let mass = own.mass_of(chunk, lane);
                            let v = &mut own.motion[chunk * MOTION + d].0[lane];
                            let outward = if low { v.to_f64() < 0.0 } else { v.to_f64() > 0.0 };
                            if outward {
                                gone.impulse[d] -= v.to_f64() * mass;
                                *v = T::default();
                            }
                            gone.clamped += 1;
                        }
                    }
                }
                own.cell[chunk * 3 + d].0[lane] = at[d];
            }
            let id = own.id[chunk][lane];
            if id == PAD {
                continue;
            }
            if leaving == Leaving::Error
                && bounds.is_beyond(at, own.offset_of(chunk, lane))
                && gone.refused.is_none_or(|(first, _)| id < first)
            {
                let offset = own.offset_of(chunk, lane);
                gone.refused = Some((id, std::array::from_fn(|d| (f64::from(at[d]) + offset[d]) * h)));
            }
            match block::key(block::of_cell(at)) {
                Some(key) if Some(key) == home => stays = true,
                Some(key) => movers.push((key, l as u16, ((run.first + chunk) * CHUNK + lane) as u32)),
                None => far = true,
            }
        }
    }
    (movers, stays, gone, far)
}

/// Marks a particle that is not in the block asked about.
const ELSEWHERE: u32 = CELLS as u32;

/// The cell within block `home` of each particle of a chunk, or [`ELSEWHERE`]. No branches, so that it becomes vector code.
#[inline]
fn local_cells(cells: &[Line<i32>], home: [i32; 3]) -> [u32; CHUNK] {
    let [x, y, z] = [&cells[0].0, &cells[1].0, &cells[2].0];
    let mut local = [0; CHUNK];
    for l in 0..CHUNK {
        let away = ((x[l] >> 2) ^ home[0]) | ((y[l] >> 2) ^ home[1]) | ((z[l] >> 2) ^ home[2]);
        let cell = (x[l] & 3) * 16 + (y[l] & 3) * 4 + (z[l] & 3);
        local[l] = if away == 0 { cell as u32 } else { ELSEWHERE };
    }
    local
}

/// Do the particles of a chunk stay where they are? Padding lanes do not matter.
fn is_own(chunk: usize, lanes: &[u32; CHUNK]) -> bool {
    lanes.iter().enumerate().all(|(l, &p)| p == PAD || p as usize == chunk * CHUNK + l)
}

/// Chunks that one task moves: enough to outweigh handing it out.
const GRAIN: usize = 256;

/// Moves the particles of a group of planes: lane `l` of chunk `c` becomes the particle at `order[c][l]`. Padding lanes are
/// left as they come.
fn permute<P: Plane, W: Plain>(group: &mut [P], planes: usize, order: &[[u32; CHUNK]], scratch: &mut [Line<W>]) {
    let moves = |chunk: usize, lanes: &[u32; CHUNK]| !is_own(chunk, lanes);
    let moved = room(scratch, order.len() * planes);
    gather(group, planes, order, moved, moves);
    let tasks = group.par_chunks_mut(GRAIN * planes).zip(moved.par_chunks(GRAIN * planes)).zip(order.par_chunks(GRAIN));
    tasks.enumerate().for_each(|(task, ((group, moved), chunks))| {
        let each = group.chunks_exact_mut(planes).zip(moved.chunks_exact(planes)).zip(chunks);
        for (k, ((to, from), lanes)) in each.enumerate() {
            if moves(task * GRAIN + k, lanes) {
                to.copy_from_slice(from);
            }
        }
    });
}

/// Collects the particles of those chunks of the new order that are wanted.
fn gather<P: Plane>(
    from: &[P],
    planes: usize,
    order: &[[u32; CHUNK]],
    to: &mut [P],
    wanted: impl Fn(usize, &[u32; CHUNK]) -> bool + Sync,
) {
    let tasks = to.par_chunks_mut(GRAIN * planes).zip(order.par_chunks(GRAIN));
    tasks.enumerate().for_each(|(task, (to, chunks))| {
        for (k, (to, lanes)) in to.chunks_exact_mut(planes).zip(chunks).enumerate() {
            if !wanted(task * GRAIN + k, lanes) {
                continue;
            }
            if lanes[0] % CHUNK as u32 == 0 && (0..CHUNK).all(|l| lanes[l] == lanes[0].wrapping_add(l as u32)) {
                to.copy_from_slice(&from[lanes[0] as usize / CHUNK * planes..][..planes]);
                continue;
            }
            for (l, &place) in lanes.iter().enumerate() {
                let place = if place == PAD { lanes[0] } else { place } as usize;
                let source = &from[place / CHUNK * planes..][..planes];
                for (to, from) in to.iter_mut().zip(source) {
                    to.values_mut()[l] = from.values()[place % CHUNK];
                }
            }
        }
    });
}
