//! Particles in memory, and how they are sorted.
//!
//! Each list (one material) lies in chunks of 16 particles, structure of arrays within the chunk. Blocks own whole chunks, so
//! threads never share one; the last chunk of a block's run is padded with massless particles.

use crate::memory::{Line, Shared, lines};
use barchan_core::plan::PlannedMaterial;
use barchan_core::stiffness::{self, Need, Stiffness};
use barchan_core::{Error, ParticleList, Result, Spot};
use barchan_grid::adapt::Parcel;
use barchan_grid::block::{self, CELLS};
use barchan_grid::bounds::Bounds;
use barchan_grid::particles::{MASS, MOTION, Particles, Run, STRAIN, VOLUME};
use barchan_grid::rest::ASLEEP;
use barchan_grid::transfer::{Law, MAX_STATE, Scalar};
use barchan_lanes::CHUNK;
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

    /// The particles as the transfers see them.
    pub(crate) fn view(&self) -> Particles<T> {
        Particles {
            cell: self.cell.as_ptr().cast::<i32>().cast_mut(),
            offset: self.offset.as_ptr().cast::<T::Offset>().cast_mut(),
            motion: self.motion.as_ptr().cast::<T>().cast_mut(),
            rest: self.rest.as_ptr().cast::<T>().cast_mut(),
            rest_planes: self.rest_planes,
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
    /// Is any lane of a chunk in the range of cells, from the first to the last along each axis?
    pub(crate) fn is_any_within(&self, chunk: usize, [first, last]: &[[i32; 3]; 2]) -> bool {
        let mut inside = [true; CHUNK];
        for d in 0..3 {
            let cells = &self.cell[chunk * 3 + d].0;
            for lane in 0..CHUNK {
                inside[lane] &= (first[d] <= cells[lane]) & (cells[lane] <= last[d]);
            }
        }
        inside != [false; CHUNK]
    }
    pub(crate) fn offset_of(&self, chunk: usize, lane: usize) -> [f64; 3] {
        std::array::from_fn(|d| T::offset_to_f64(self.offset[chunk * 3 + d].0[lane]))
    }
    /// Where a particle is, in cells `h` wide [m].
    pub(crate) fn position_of(&self, chunk: usize, lane: usize, h: f64) -> [f64; 3] {
        let (cell, offset) = (self.cell_of(chunk, lane), self.offset_of(chunk, lane));
        std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * h)
    }
    /// Kinetic energy of a particle and of what its C carries, in cells `h` wide [J].
    pub(crate) fn kinetic_of(&self, chunk: usize, lane: usize, h: f64) -> f64 {
        let motion = self.motion_of(chunk, lane);
        let square = |values: &[f64]| values.iter().map(|y| y * y).sum::<f64>();
        0.5 * self.mass_of(chunk, lane) * (square(&motion[..3]) + 0.25 * h * h * square(&motion[3..]))
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
        let (mut strain, mut state) = ([stiffness::Plane::default(); 9], [stiffness::Plane::default(); MAX_STATE]);
        let planes = self.strain_planes();
        let n_state = self.law.table.n_state;
        let values = strain[..planes].iter_mut().chain(&mut state[..n_state]);
        for (plane, value) in values.zip(STRAIN..) {
            plane.0 = self.rest_plane(chunk, value).map(|x| x.to_f64() as f32);
        }
        let id = |lane: usize| Some(u64::from(self.id[chunk][lane]));
        let moduli = law.moduli(&strain, &state, count, id)?;
        let density = |lane: usize| self.mass_of(chunk, lane) / self.volume0_of(chunk, lane);
        Ok((0..).zip(moduli).fold(Need::default(), |need, (lane, m)| need.or(m.need(h, density(lane)))))
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

    /// One chunk, to be written to.
    ///
    /// # Safety
    /// The chunk must exist, and nobody else may look at it meanwhile.
    #[expect(clippy::mut_from_ref, reason = "several threads write to chunks of their own")]
    unsafe fn chunk(&self, chunk: usize) -> Chunk<'_, T> {
        /// So many planes of each chunk.
        unsafe fn planes<W>(all: &[W], chunk: usize, count: usize) -> &mut [W] {
            // SAFETY: the caller vouches for the chunk.
            unsafe { std::slice::from_raw_parts_mut(all.as_ptr().cast_mut().add(chunk * count), count) }
        }
        // SAFETY: the caller vouches for the chunk.
        unsafe {
            Chunk {
                id: &mut planes(&self.id, chunk, 1)[0],
                body: &mut planes(&self.body, chunk, 1)[0],
                cell: planes(&self.cell, chunk, 3),
                offset: planes(&self.offset, chunk, 3),
                motion: planes(&self.motion, chunk, MOTION),
                rest: planes(&self.rest, chunk, self.rest_planes),
            }
        }
    }

    /// Puts particles into the lanes of a run, in their order, and pads it.
    fn fill<P: Borrow<Parcel>>(&self, run: Run, parcel: impl Fn(usize) -> P + Sync) {
        (0..run.chunks()).into_par_iter().for_each(|k| {
            // SAFETY: the run is the caller's own, and each task has a chunk of its own.
            let mut chunk = unsafe { self.chunk(run.first + k) };
            let here = k * CHUNK..run.count.min((k + 1) * CHUNK);
            here.clone().for_each(|i| chunk.put(parcel(i).borrow(), i % CHUNK));
            chunk.pad(here.len(), self.identity);
        });
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

    /// Pads each run.
    fn pad(&mut self) {
        let list = &*self;
        list.runs.par_iter().filter(|run| run.count % CHUNK > 0).for_each(|run| {
            // SAFETY: runs have chunks of their own.
            unsafe { list.chunk(run.first + run.count / CHUNK) }.pad(run.count % CHUNK, list.identity);
        });
    }

    fn take_in(&mut self, list: &ParticleList, counts: impl Iterator<Item = usize>) {
        let chunks = self.lay_out(counts);
        self.resize(chunks);
        let mut first = 0;
        for &run in &self.runs {
            self.fill(run, |i| Parcel::of(list, first + i));
            first += run.count;
        }
    }

    /// Where a particle is and how large.
    fn spot(&self, (chunk, lane): (usize, usize), cell_width: f64) -> Spot {
        Spot {
            position: self.position_of(chunk, lane, cell_width),
            volume0: self.volume0_of(chunk, lane),
            material: self.material as u32,
        }
    }

    fn give_out(&self, level: usize, cell_width: f64, places: impl Iterator<Item = (usize, usize)>) -> ParticleList {
        let mut out = self.empty_copy(level, cell_width);
        for (chunk, lane) in places {
            self.copy_to(&mut out, chunk, lane);
        }
        out
    }

    /// A list like this one without particles.
    pub(crate) fn empty_copy(&self, level: usize, cell_width: f64) -> ParticleList {
        let planes = self.strain_planes();
        ParticleList::empty(level, self.material, cell_width, planes, self.rest_planes - STRAIN - planes)
    }

    /// Adds a copy of one particle to a list.
    pub(crate) fn copy_to(&self, out: &mut ParticleList, chunk: usize, lane: usize) {
        out.id.push(u64::from(self.id[chunk][lane]));
        out.body.push(self.body[chunk][lane]);
        out.cell.push(self.cell_of(chunk, lane));
        out.offset.push(self.offset_of(chunk, lane));
        let motion = self.motion_of(chunk, lane);
        out.velocity.push([motion[0], motion[1], motion[2]]);
        out.affine.push(std::array::from_fn(|i| motion[3 + i]));
        out.mass.push(self.mass_of(chunk, lane));
        out.volume0.push(self.volume0_of(chunk, lane));
        for (p, plane) in out.strain.iter_mut().chain(&mut out.state).enumerate() {
            plane.push(self.rest_of(chunk, lane, STRAIN + p));
        }
    }
}

/// Sixteen lanes of a list.
struct Chunk<'a, T: Scalar> {
    id: &'a mut [u32; CHUNK],
    body: &'a mut [u16; CHUNK],
    cell: &'a mut [Line<i32>],
    offset: &'a mut [Line<T::Offset>],
    motion: &'a mut [Line<T>],
    rest: &'a mut [Line<T>],
}

impl<T: Scalar> Chunk<'_, T> {
    /// Puts a particle into a lane.
    fn put(&mut self, parcel: &Parcel, lane: usize) {
        self.id[lane] = parcel.id;
        self.body[lane] = parcel.body;
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

    /// Turns the lanes behind the first `used` into massless particles at rest in the last one's cell. `identity`: undeformed strain.
    fn pad(&mut self, used: usize, identity: &[f64]) {
        for lane in used..CHUNK {
            self.id[lane] = PAD;
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
    pub(crate) fn download(&self, level: usize) -> impl Iterator<Item = ParticleList> {
        self.lists.iter().map(move |list| list.give_out(level, self.cell_width, list.places()))
    }

    /// The particles for which `wanted` holds, as [`download`](Self::download) gives them.
    pub(crate) fn download_where<'a>(
        &'a self,
        level: usize,
        wanted: &'a (dyn Fn(&Spot) -> bool + Sync),
    ) -> impl Iterator<Item = ParticleList> + 'a {
        self.lists.iter().map(move |list| {
            let here: Vec<Vec<(usize, usize)>> = list
                .runs
                .par_iter()
                .map(|run| run.places().filter(|place| wanted(&list.spot(*place, self.cell_width))).collect())
                .collect();
            list.give_out(level, self.cell_width, here.into_iter().flatten())
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
            list.fill(run, |i| here[i]);
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
    pub(crate) fn sort(
        &mut self,
        bounds: &Bounds,
        leaving: barchan_core::scene::Leaving,
        holes: bool,
    ) -> Result<Departures> {
        // 1. Who leaves the world, who changes the block?
        let n_blocks = self.lists.first().map_or(0, |list| list.runs.len());
        let this = &*self;
        let found: Vec<(Vec<Mover>, bool, Departures, bool)> =
            (0..n_blocks).into_par_iter().map(|b| this.find_movers(b, bounds, leaving)).collect();
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

    /// Looks at one block's particles: those that belong elsewhere, whether any stays, those outside the world, and whether
    /// one is too far away to be keyed.
    fn find_movers(
        &self,
        b: usize,
        bounds: &Bounds,
        leaving: barchan_core::scene::Leaving,
    ) -> (Vec<Mover>, bool, Departures, bool) {
        use barchan_core::scene::Leaving;
        let home = self.blocks.get(b).copied();
        let (mut movers, mut stays, mut gone, mut far) = (Vec::new(), false, Departures::default(), false);
        for (l, list) in self.lists.iter().enumerate() {
            let view = list.view();
            let run = list.runs[b];
            for i in 0..run.count {
                let (chunk, lane) = (run.first + i / CHUNK, i % CHUNK);
                let mut at = [0; 3];
                for d in 0..3 {
                    // SAFETY: the chunk is this block's own, and this call alone works on the block.
                    let cell = unsafe { &mut *view.cell(chunk, d).add(lane) };
                    let inside = (bounds.min[d]..bounds.max[d]).contains(cell);
                    if !inside && bounds.periodic[d] {
                        *cell = bounds.min[d] + (*cell - bounds.min[d]).rem_euclid(bounds.max[d] - bounds.min[d]);
                    } else if !inside && list.id[chunk][lane] != PAD {
                        match leaving {
                            Leaving::Error => {}
                            Leaving::Delete => {
                                gone.deleted += 1;
                                gone.deleted_mass += list.mass_of(chunk, lane);
                                // SAFETY: as above. The mark is read when the list is laid out.
                                unsafe { *list.id.as_ptr().add(chunk).cast::<u32>().add(lane).cast_mut() = PAD };
                            }
                            // SAFETY: as above.
                            Leaving::Clamp => unsafe {
                                let low = *cell < bounds.min[d];
                                *cell = if low { bounds.min[d] } else { bounds.max[d] - 1 };
                                let edge = if low { 0.0 } else { 1.0 - f64::from(f32::EPSILON) };
                                *view.offset(chunk, d).add(lane) = T::offset_from_f64(edge).unwrap_or_default();
                                let v = &mut *view.motion(chunk, d).add(lane);
                                let outward = if low { v.to_f64() < 0.0 } else { v.to_f64() > 0.0 };
                                if outward {
                                    gone.impulse[d] -= v.to_f64() * list.mass_of(chunk, lane);
                                    *v = T::default();
                                }
                                gone.clamped += 1;
                            },
                        }
                    }
                    at[d] = *cell;
                }
                let id = list.id[chunk][lane];
                if id == PAD {
                    continue;
                }
                if leaving == Leaving::Error
                    && bounds.is_beyond(at, list.offset_of(chunk, lane))
                    && gone.refused.is_none_or(|(first, _)| id < first)
                {
                    gone.refused = Some((id, list.position_of(chunk, lane, self.cell_width)));
                }
                match block::key(block::of_cell(at)) {
                    Some(key) if Some(key) == home => stays = true,
                    Some(key) => movers.push((key, l as u16, (chunk * CHUNK + lane) as u32)),
                    None => far = true,
                }
            }
        }
        (movers, stays, gone, far)
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
        let order = Shared(self.order.as_mut_ptr().cast::<u32>());
        (0..blocks.len()).into_par_iter().for_each(|b| {
            let mut next = in_cells[b];
            let mut start = (runs[b].first * CHUNK) as u32;
            for next in &mut next {
                start += std::mem::replace(next, start);
            }
            each(b, &mut |local, place, n| {
                for (l, &cell) in local[..n].iter().enumerate() {
                    if cell != ELSEWHERE {
                        // SAFETY: the run's lanes are this block's own.
                        unsafe { *order.at(next[cell as usize] as usize) = (place + l) as u32 };
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
            list.pad();
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
        let scratch = self.scratch.as_mut_ptr();
        let order = &self.order;
        permute(&mut list.id, 1, order, scratch.cast());
        permute(&mut list.body, 1, order, scratch.cast());
        permute(&mut list.cell, 3, order, scratch.cast());
        permute(&mut list.offset, 3, order, scratch.cast());
        let (mut narrow, mut wide) = ((&mut list.motion, MOTION), (&mut list.rest, list.rest_planes));
        if narrow.1 > wide.1 {
            std::mem::swap(&mut narrow, &mut wide);
        }
        permute(narrow.0, narrow.1, order, scratch.cast());
        // The widest group and the scratch may change places, which saves the way back; but not if that leaves too little for a
        // longer list, nor if few chunks have changed.
        if wide.0.capacity() >= most.max(needed) && wide.0.len() == needed && 2 * changed > chunks {
            gather(wide.0.as_mut_ptr(), wide.1, order, scratch.cast(), |_, _| true);
            std::mem::swap(wide.0, &mut self.scratch);
        } else {
            permute(wide.0, wide.1, order, scratch.cast());
        }
        if old_chunks != chunks {
            list.resize(chunks);
        }
        list.pad();
    }
}

/// A plane's storage for 16 lanes of plain words.
trait Plane: Send + Sync {
    type Word: Copy + Send + Sync;
}
impl<W: Copy + Send + Sync> Plane for Line<W> {
    type Word = W;
}
impl<W: Copy + Send + Sync> Plane for [W; CHUNK] {
    type Word = W;
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
fn permute<P: Plane>(group: &mut [P], planes: usize, order: &[[u32; CHUNK]], scratch: *mut P) {
    let moves = |chunk: usize, lanes: &[u32; CHUNK]| !is_own(chunk, lanes);
    gather(group.as_mut_ptr(), planes, order, scratch, moves);
    let (from, to) = (Shared(scratch.cast::<P::Word>()), Shared(group.as_mut_ptr().cast::<P::Word>()));
    order.par_chunks(GRAIN).enumerate().for_each(|(task, chunks)| {
        for (k, lanes) in chunks.iter().enumerate() {
            let at = (task * GRAIN + k) * planes * CHUNK;
            if moves(task * GRAIN + k, lanes) {
                // SAFETY: each task writes chunks of its own; the group has room for all chunks of the order.
                unsafe { std::ptr::copy_nonoverlapping(from.at(at), to.at(at), planes * CHUNK) };
            }
        }
    });
}

/// Collects the particles of those chunks of the new order that are wanted.
fn gather<P: Plane>(
    group: *mut P,
    planes: usize,
    order: &[[u32; CHUNK]],
    to: *mut P,
    wanted: impl Fn(usize, &[u32; CHUNK]) -> bool + Sync,
) {
    let (from, to) = (Shared(group.cast::<P::Word>()), Shared(to.cast::<P::Word>()));
    order.par_chunks(GRAIN).enumerate().for_each(|(task, chunks)| {
        for (k, lanes) in chunks.iter().enumerate() {
            let chunk = task * GRAIN + k;
            if !wanted(chunk, lanes) {
                continue;
            }
            if lanes[0] % CHUNK as u32 == 0 && (0..CHUNK).all(|l| lanes[l] == lanes[0].wrapping_add(l as u32)) {
                // SAFETY: places are lanes of existing chunks; the scratch holds the whole group; each task writes chunks of
                // its own.
                unsafe {
                    let source = from.at(lanes[0] as usize * planes);
                    std::ptr::copy_nonoverlapping(source, to.at(chunk * planes * CHUNK), planes * CHUNK);
                }
                continue;
            }
            for (l, &place) in lanes.iter().enumerate() {
                let place = if place == PAD { lanes[0] } else { place } as usize;
                let source = place / CHUNK * planes * CHUNK + place % CHUNK;
                for p in 0..planes {
                    // SAFETY: as above.
                    unsafe { *to.at((chunk * planes + p) * CHUNK + l) = *from.at(source + p * CHUNK) };
                }
            }
        }
    });
}
