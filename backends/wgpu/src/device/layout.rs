//! Conversion between particles on the host and their layout on the device: sorted by block, cell and law, and within
//! those in their former order.

use crate::device::kernel::Sorted;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Error, ParticleList, ParticleState, Result, Spot, Vec3};
use barchan_grid::block::{REACH, offset};
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// Vectors of four in a particle's record.
pub(crate) const RECORD: usize = 6;
/// Where words of stress stand in it: vectors and places there; see `deform.wgsl`.
pub(crate) const STRESS: [(usize, usize); 6] = [(1, 0), (1, 1), (1, 2), (5, 0), (5, 1), (5, 2)];
/// Vectors of four in an entry of the lists; see `common.wgsl`.
pub(crate) const ENTRY: usize = 10;
/// Of a particle's tag: it has left its home, or is beside it. So far beyond its home, in counts, it is beside it and still counts as in it: its
/// weights are off by half the square of that (2^-12 cells), less than f32 rounds. Else particles at rest between two cells would come and go.
pub(crate) const LEFT_HOME: u32 = 1 << 25;
pub(crate) const BESIDE: u32 = 1 << 26;
pub(crate) const BESIDE_BY: u32 = 1 << 20;

/// Laws that a particle's tag can tell apart.
pub(crate) const MAX_LAWS: usize = 16;
/// Vectors of four that hold so many values of strain and history and, in their last place, rest volume.
pub(crate) fn vectors_for(values: usize) -> usize {
    (values + 1).div_ceil(4)
}

/// So many particles are not worth another thread.
const FEW: usize = 1024;
/// So many particles of a cell stand together, and so many times they take turns with those of their block's other cells; see `rounds.wgsl`.
pub(crate) const TOGETHER: usize = 4;
pub(crate) const ROUNDS: usize = 8;
/// Blocks' coordinates lie between minus this and this.
const FAR: i32 = 1 << 23;
/// Particles that the sort's order can tell apart.
const MAX_PARTICLES: usize = 1 << 28;

type Block = [i32; 3];

/// Where the particles' homes are.
#[derive(Clone, Debug, Default)]
pub(crate) struct Homes {
    /// Blocks with particles, in the order of their coordinates.
    pub(crate) blocks: Vec<Block>,
    /// Where the particles of each cell begin, counted cell by cell, and the end.
    pub(crate) cells: Vec<u32>,
    /// The particle at each place of the memory: list and number.
    pub(crate) order: Vec<(usize, usize)>,
}

/// Periodic axes: first block and number of blocks, 0 where the axis is not.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Periods {
    pub(crate) first: Block,
    pub(crate) count: Block,
}

impl Periods {
    pub(crate) fn wrap(&self, mut block: Block) -> Block {
        for d in 0..3 {
            if self.count[d] > 0 {
                block[d] = self.first[d] + (block[d] - self.first[d]).rem_euclid(self.count[d]);
            }
        }
        block
    }
}

fn in_block(cell: Block) -> usize {
    let [x, y, z] = cell.map(|c| (c & 3) as usize);
    x * 16 + y * 4 + z
}

impl Homes {
    /// Homes where the particles are.
    pub(crate) fn fresh(lists: &[ParticleList], periods: &Periods) -> Self {
        // Block, cell, list and number in one, since many are sorted.
        let packed = |l: usize, i: usize, cell: Block| {
            let block = periods.wrap(cell.map(|c| c >> 2)).map(|b| (b + FAR) as u32);
            let block = block.into_iter().fold(0, |all, b| all << 24 | u128::from(b));
            (block << 6 | in_block(cell) as u128) << 48 | (l as u128) << 32 | i as u128
        };
        let mut all: Vec<u128> = Vec::new();
        for (l, list) in lists.iter().enumerate() {
            all.par_extend(list.cell.par_iter().enumerate().map(|(i, &cell)| packed(l, i, cell)));
        }
        all.par_sort_unstable();
        let unpacked = |one: &u128| {
            let along = |axis: usize| (one >> (102 - 24 * axis)) as i32 & 0xff_ffff;
            let block = [0, 1, 2].map(|axis| along(axis) - FAR);
            (block, (one >> 48) as usize & 63, (one >> 32) as usize & 0xffff, *one as u32 as usize)
        };
        Self::of(&all.par_iter().map(unpacked).collect::<Vec<_>>())
    }

    /// Homes as a sort of this backend left them: for each block, the particles of each cell of each list.
    pub(crate) fn restored(lists: &[ParticleList], level: usize, blocks: &[([i32; 5], Vec<u32>)]) -> Option<Self> {
        let mut next = vec![0; lists.len()];
        let mut all = Vec::new();
        for ([_, _, x, y, z], counts) in blocks.iter().filter(|([_, l, ..], _)| *l == level as i32) {
            if counts.len() != 64 * lists.len() {
                return None;
            }
            for (cell, counts) in counts.chunks_exact(lists.len()).enumerate() {
                for (l, &count) in counts.iter().enumerate() {
                    all.extend((next[l]..next[l] + count as usize).map(|i| ([*x, *y, *z], cell, l, i)));
                    next[l] += count as usize;
                }
            }
        }
        let complete = next.iter().zip(lists).all(|(next, list)| *next == list.len());
        let within = |&([bx, by, bz], cell, l, i): &(Block, usize, usize, usize)| {
            let _ = cell;
            let at: [i32; 3] = lists[l].cell[i];
            [bx, by, bz].into_iter().zip(at).all(|(b, c)| (-2..6).contains(&(c - 4 * b)))
        };
        let sorted = all.windows(2).all(|pair| pair[0] < pair[1]);
        (complete && sorted && all.iter().all(within)).then(|| Self::of(&all))
    }

    fn of(all: &[(Block, usize, usize, usize)]) -> Self {
        let mut homes = Self::default();
        for block in all.chunk_by(|a, b| a.0 == b.0) {
            homes.blocks.push(block[0].0);
            let first = homes.order.len();
            let starts = (0..64).map(|cell| (first + block.partition_point(|p| p.1 < cell)) as u32);
            homes.cells.extend(starts);
            homes.order.resize(first + block.len(), (0, 0));
            for (p, slot) in block.iter().zip(slots(&homes.cells[homes.cells.len() - 64..], block.len())) {
                homes.order[first + slot] = (p.2, p.3);
            }
        }
        homes.cells.push(homes.order.len() as u32);
        homes
    }

    /// The starts of a block's cells, and how many particles it holds.
    fn starts(&self, block: usize) -> (&[u32], usize) {
        let of_block = &self.cells[64 * block..=64 * block + 64];
        (&of_block[..64], (of_block[64] - of_block[0]) as usize)
    }

    /// How many blocks there are whose nodes particles reach.
    pub(crate) fn node_blocks(&self, periods: &Periods) -> usize {
        let around = |b: &Block| {
            let b = *b;
            (0..27).map(move |n| periods.wrap(std::array::from_fn(|d| b[d] + offset(n)[d])))
        };
        let mut nodes: Vec<Block> = self.blocks.iter().flat_map(around).collect();
        nodes.par_sort_unstable();
        nodes.dedup();
        nodes.len()
    }

    /// The home of each particle, block and cell, in the order of memory.
    fn worlds_of(&self) -> Vec<(Block, usize)> {
        let of_block = |(b, block): (usize, &Block)| {
            let (starts, count) = self.starts(b);
            let (slots, mut worlds_of) = (slots(starts, count), vec![(*block, 0); count]);
            for cell in 0..64 {
                slots[in_cell(starts, count, cell)].iter().for_each(|slot| worlds_of[*slot].1 = cell);
            }
            worlds_of
        };
        self.blocks.par_iter().enumerate().flat_map_iter(of_block).collect()
    }

    /// Where each particle stands, and its block, cell by cell.
    pub(crate) fn places(&self) -> Vec<(usize, Block)> {
        self.places_in(|_| true)
    }

    /// The same of particles of some blocks.
    pub(crate) fn places_in(&self, is_wanted: impl Fn(&Block) -> bool + Sync) -> Vec<(usize, Block)> {
        let of_block = |(b, block): (usize, &Block)| {
            let ((starts, count), block) = (self.starts(b), *block);
            let first = starts[0] as usize;
            slots(starts, count).into_iter().map(move |slot| (first + slot, block))
        };
        self.blocks.par_iter().enumerate().filter(|(_, block)| is_wanted(block)).flat_map_iter(of_block).collect()
    }

    /// Least and greatest block, if there is any.
    pub(crate) fn extent(&self) -> Option<(Block, Block)> {
        let least =
            |f: fn(i32, i32) -> i32| self.blocks.iter().copied().reduce(|a, b| std::array::from_fn(|d| f(a[d], b[d])));
        Some((least(i32::min)?, least(i32::max)?))
    }
}

/// A cell's particles, counted cell by cell from its block's first one: by the starts of the block's cells, and how many it holds.
fn in_cell(starts: &[u32], count: usize, cell: usize) -> Range<usize> {
    let first = |cell: usize| starts.get(cell).map_or(count, |start| (start - starts[0]) as usize);
    first(cell)..first(cell + 1)
}

/// Where the particles of a block stand, cell by cell, counted from its first one.
fn slots(starts: &[u32], count: usize) -> Vec<usize> {
    let mut slots = vec![0; count];
    let mut next = 0..count;
    for round in 0..=ROUNDS {
        if next.is_empty() {
            break;
        }
        for cell in 0..64 {
            let cell = in_cell(starts, count, cell);
            let begin = cell.start + TOGETHER * round;
            let end = if round == ROUNDS { cell.end } else { cell.end.min(begin + TOGETHER) };
            (begin..end).zip(&mut next).for_each(|(i, slot)| slots[i] = slot);
        }
    }
    slots
}

/// Planes of all particles as the device holds them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Planes<'a> {
    /// Six vectors a particle, in the order of [`vector`]; see `common.wgsl`.
    pub(crate) record: Cow<'a, [[u32; 4]]>,
    pub(crate) ids: Cow<'a, [[u32; 2]]>,
    pub(crate) rest: Cow<'a, [[f32; 4]]>,
}

/// Where vector `k` of particle `q` stands in the record.
pub(crate) fn vector(q: usize, k: usize, slots: usize) -> usize {
    k * slots + q
}

const TWO_32: f64 = 4_294_967_296.0;

fn refuse(what: String) -> Error {
    Error::Body { path: "particles".into(), what, mend: "hand back particles of a simulation of the same scene".into() }
}

/// A particle of a list, with the words of stress that it is known to have, and with the block and the cell that are its home.
struct Ours<'a> {
    list: &'a ParticleList,
    stress: Option<&'a [u32]>,
    i: usize,
    engine: (Block, usize),
    planned: &'a PlannedMaterial,
}

impl Ours<'_> {
    /// A vector of its record.
    fn record(&self, k: usize) -> [u32; 4] {
        let (list, i) = (self.list, self.i);
        let mut vector = match k {
            0 => self.place(),
            1 => [0, 0, 0, (list.mass[i] as f32).to_bits()],
            2..5 => {
                let c = &list.affine[i][3 * (k - 2)..][..3];
                [list.velocity[i][k - 2], c[0], c[1], c[2]].map(|x| (x as f32).to_bits())
            }
            _ => [0; 4],
        };
        for ((_, d), word) in STRESS.iter().zip(self.stress.into_iter().flatten()).filter(|((of, _), _)| *of == k) {
            vector[*d] = *word;
        }
        vector
    }

    /// Where it is in its cell, and its tag.
    fn place(&self) -> [u32; 4] {
        let (list, i, (block, home)) = (self.list, self.i, self.engine);
        let (mut tag, mut place) = (0u32, [0u32; 4]);
        let mut shift = [0; 3];
        for d in 0..3 {
            // An offset of almost one rounds to the next cell's zero.
            let counts = (list.offset[i][d] * TWO_32).round_ties_even();
            let (cell, counts) =
                if counts >= TWO_32 { (list.cell[i][d] + 1, 0) } else { (list.cell[i][d], counts as u32) };
            place[d] = counts;
            // Periodic axes: the home is in the world, the particle may be beyond.
            let local = (cell - 4 * block[d]) & 3;
            let drifted = cell - 4 * block[d];
            let local = if (-2..6).contains(&drifted) { drifted } else { local };
            tag = tag << 3 | (local + 2) as u32;
            shift[d] = local - (home >> (4 - 2 * d) & 3) as i32;
        }
        place[3] = tag | list.material << 9 | tag_of_home(home) << 16 | away(shift, place);
        place
    }

    /// A vector of its strain, history and, last in the last one, rest volume.
    fn rest(&self, v: usize, vectors: usize) -> [f32; 4] {
        let (list, i) = (self.list, self.i);
        let identity = self.planned.material.strain_identity();
        let value = |k: usize| {
            let strain = list.strain.get(k).zip(identity.get(k)).map(|(plane, one)| plane[i] - one);
            let state = || k.checked_sub(list.strain.len()).and_then(|k| list.state.get(k)).map(|plane| plane[i]);
            let volume = || if k == 4 * vectors - 1 { list.volume0[i] } else { 0.0 };
            strain.or_else(state).unwrap_or_else(volume) as f32
        };
        std::array::from_fn(|d| value(4 * v + d))
    }
}

impl<'a> Planes<'a> {
    /// Planes of all particles of a level, with their words of stress if these are kept.
    pub(crate) fn of(
        lists: &[ParticleList],
        kept: Option<&[Vec<u32>]>,
        homes: &Homes,
        materials: &[PlannedMaterial],
        vectors: usize,
    ) -> Result<Self> {
        let slots = lists.iter().map(ParticleList::len).sum();
        if let Some(id) = lists.iter().flat_map(|list| &list.id).find(|id| **id > u64::from(u32::MAX)) {
            return Err(refuse(format!("a particle has the number {id}, which is {} or greater", 1u64 << 32)));
        }
        let worlds_of = homes.worlds_of();
        let particle = |(q, engine): (usize, (Block, usize))| {
            let (l, i) = homes.order[q];
            let stress = kept.map(|kept| &kept[l][STRESS.len() * i..][..STRESS.len()]);
            Ours { list: &lists[l], stress, i, engine, planned: &materials[l] }
        };
        let all: Vec<Ours<'_>> = worlds_of.into_par_iter().enumerate().with_min_len(FEW).map(particle).collect();
        let mut record = vec![[0; 4]; RECORD * slots];
        let mut ids = vec![[0; 2]; slots];
        let mut rest = vec![[0.0; 4]; vectors * slots];
        fn fill<T: Send>(plane: &mut [T], all: &[Ours<'_>], of: impl Fn(&Ours<'_>) -> T + Sync) {
            let pairs = plane.par_iter_mut().zip(all).with_min_len(FEW);
            pairs.for_each(|(value, one)| *value = of(one));
        }
        let slots = slots.max(1);
        record.par_chunks_mut(slots).enumerate().for_each(|(k, plane)| fill(plane, &all, |one| one.record(k)));
        fill(&mut ids, &all, |one| [one.list.id[one.i] as u32, u32::from(one.list.body[one.i])]);
        let of_rest = rest.par_chunks_mut(slots).enumerate();
        of_rest.for_each(|(v, plane)| fill(plane, &all, |one| one.rest(v, vectors)));
        Ok(Self { record: record.into(), ids: ids.into(), rest: rest.into() })
    }

    /// What the planes of a buffer hold.
    pub(crate) fn bytes(&self, sorted: Sorted) -> &[u8] {
        match sorted {
            Sorted::Record => bytemuck::cast_slice(&self.record),
            Sorted::Ids => bytemuck::cast_slice(&self.ids),
            Sorted::Rest => bytemuck::cast_slice(&self.rest),
            Sorted::Lists | Sorted::Cells | Sorted::Watch => &[],
        }
    }

    /// What a device has handed out of so many particles: records, ids, then the rest.
    pub(crate) fn of_words(words: &'a [u32], count: usize) -> Self {
        let (record, rest) = words.split_at(4 * RECORD * count);
        let (ids, rest) = rest.split_at(2 * count);
        Self {
            record: Cow::Borrowed(bytemuck::cast_slice(record)),
            ids: Cow::Borrowed(bytemuck::cast_slice(ids)),
            rest: Cow::Borrowed(bytemuck::cast_slice(rest)),
        }
    }

    /// A copy that stays.
    pub(crate) fn into_owned(self) -> Planes<'static> {
        Planes {
            record: self.record.into_owned().into(),
            ids: self.ids.into_owned().into(),
            rest: self.rest.into_owned().into(),
        }
    }

    /// Particles of a level with cells of that width, one list a material, in the order of their places; each with its block.
    pub(crate) fn lists(
        &self,
        places: &[(usize, Block)],
        materials: &[PlannedMaterial],
        (level, cell_width): (usize, f64),
        slots: usize,
    ) -> Vec<ParticleList> {
        let list = |(m, planned): (usize, &PlannedMaterial)| {
            let own: Vec<_> = places.iter().copied().filter(|&(q, _)| self.law(q) == m).collect();
            let (strain, states) = (planned.material.strain_planes(), planned.material.states.len());
            self.list(&own, ParticleList::empty(level, m, cell_width, strain, states), planned, slots)
        };
        materials.par_iter().enumerate().map(list).collect()
    }

    /// The empty list with particles of one material, plane by plane.
    fn list(
        &self,
        places: &[(usize, Block)],
        mut list: ParticleList,
        planned: &PlannedMaterial,
        slots: usize,
    ) -> ParticleList {
        fn fill<T: Send>(plane: &mut Vec<T>, places: &[(usize, Block)], of: impl Fn(usize, Block) -> T + Sync) {
            plane.par_extend(places.par_iter().with_min_len(FEW).map(|&(q, block)| of(q, block)));
        }
        let record = |q: usize, k: usize| self.record[vector(q, k, slots)];
        let real = |bits: u32| f64::from(f32::from_bits(bits));
        let value = |q: usize, k: usize| f64::from(self.rest[k / 4 * slots + q][k % 4]);
        rayon::scope(|scope| {
            let ParticleList { id, body, cell, offset, velocity, affine, mass, volume0, strain, state, .. } = &mut list;
            let planes = strain.len();
            scope.spawn(move |_| fill(id, places, |q, _| u64::from(self.ids[q][0])));
            scope.spawn(move |_| fill(body, places, |q, _| self.body(q)));
            scope.spawn(move |_| fill(cell, places, |q, block| self::cell(record(q, 0), block)));
            scope.spawn(move |_| fill(offset, places, |q, _| offset_in_cell(record(q, 0))));
            let velocity_of = move |q: usize, _| std::array::from_fn(|d| real(record(q, 2 + d)[0]));
            scope.spawn(move |_| fill(velocity, places, velocity_of));
            let affine_of = move |q: usize, _| std::array::from_fn(|e| real(record(q, 2 + e / 3)[1 + e % 3]));
            scope.spawn(move |_| fill(affine, places, affine_of));
            scope.spawn(move |_| fill(mass, places, |q, _| real(record(q, 1)[3])));
            scope.spawn(move |_| fill(volume0, places, |q, _| self.volume0(q, slots)));
            for (k, (plane, one)) in strain.iter_mut().zip(planned.material.strain_identity()).enumerate() {
                scope.spawn(move |_| fill(plane, places, |q, _| one + value(q, k)));
            }
            for (k, plane) in state.iter_mut().enumerate() {
                scope.spawn(move |_| fill(plane, places, |q, _| value(q, planes + k)));
            }
        });
        list
    }

    /// The words of stress of each particle, one list a material, in the order of their places.
    pub(crate) fn stresses(&self, places: &[(usize, Block)], materials: usize, slots: usize) -> Vec<Vec<u32>> {
        let words = |q: usize| STRESS.map(|(k, d)| self.record[vector(q, k, slots)][d]);
        let of_law = |law: usize| {
            places.iter().filter(|(q, _)| self.law(*q) == law).flat_map(|(q, _)| words(*q)).collect::<Vec<_>>()
        };
        (0..materials).into_par_iter().map(of_law).collect()
    }

    /// Where a particle is, and how large, in cells of that width. Of the planes it needs the records' first and the last.
    pub(crate) fn spot(&self, q: usize, block: Block, cell_width: f64, slots: usize) -> Spot {
        let position = position(self.record[q], block, cell_width);
        Spot { position, volume0: self.volume0(q, slots), material: self.law(q) as u32 }
    }

    fn volume0(&self, q: usize, slots: usize) -> f64 {
        f64::from(self.rest[volume(self.rest.len(), q, slots)][3])
    }

    /// Index of a particle's body in the scene.
    pub(crate) fn body(&self, q: usize) -> u16 {
        self.ids[q][1] as u16
    }

    /// A particle's law.
    pub(crate) fn law(&self, q: usize) -> usize {
        law_of(self.record[q][3])
    }

    /// For each block, the particles of each cell of each list: what [`Homes::restored`] takes.
    pub(crate) fn counts(&self, homes: &Homes, lists: usize, level: usize) -> Vec<([i32; 5], Vec<u32>)> {
        let of_block = |(b, [x, y, z]): (usize, &Block)| {
            let (starts, count) = homes.starts(b);
            let slots = slots(starts, count);
            let mut counts = vec![0; 64 * lists];
            for cell in 0..64 {
                for slot in &slots[in_cell(starts, count, cell)] {
                    counts[cell * lists + self.law(starts[0] as usize + slot)] += 1;
                }
            }
            ([0, level as i32, *x, *y, *z], counts)
        };
        homes.blocks.iter().enumerate().map(of_block).collect()
    }
}

/// Where a particle's rest volume stands: last in the last of its vectors of strain and history.
fn volume(rest: usize, q: usize, slots: usize) -> usize {
    rest - slots + q
}

/// A tag's law.
pub(crate) fn law_of(tag: u32) -> usize {
    (tag >> 9 & 15) as usize
}

/// The tag of a particle that is in its home, by the number of the cell in the block.
fn tag_of_home(cell: usize) -> u32 {
    [cell >> 4, cell >> 2 & 3, cell & 3].into_iter().fold(0, |tag, c| tag << 3 | (c as u32 + 2))
}

/// What a tag says of a particle that is so many cells from its home, at some place of the cell.
fn away(shift: [i32; 3], place: [u32; 4]) -> u32 {
    let is_near = |(shift, count): (i32, u32)| match shift {
        0 => true,
        1 => count < BESIDE_BY,
        -1 => count >= 0u32.wrapping_sub(BESIDE_BY),
        _ => false,
    };
    if shift == [0; 3] {
        0
    } else if shift.into_iter().zip(place).all(is_near) {
        BESIDE
    } else {
        LEFT_HOME
    }
}

/// A particle's cell, by its place in the record and its block.
fn cell(place: [u32; 4], block: Block) -> [i32; 3] {
    // The tag counts it from two before the block's first one.
    std::array::from_fn(|d| 4 * block[d] + (place[3] >> (6 - 3 * d) & 7) as i32 - 2)
}

/// Where it is in its cell, [0, 1).
fn offset_in_cell(place: [u32; 4]) -> [f64; 3] {
    std::array::from_fn(|d| f64::from(place[d]) / TWO_32)
}

/// Where a particle is, in cells of that width [m].
pub(crate) fn position(place: [u32; 4], block: Block, cell_width: f64) -> Vec3 {
    let (cell, offset) = (cell(place, block), offset_in_cell(place));
    std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * cell_width)
}

/// Refuses more particles than an adapter can number; `mend` says what to do instead.
pub(crate) fn check_count(particles: usize, mend: &'static str) -> Result<()> {
    if particles < MAX_PARTICLES {
        return Ok(());
    }
    Err(Error::Capacity {
        what: "particles on one adapter",
        asked: particles as u64,
        cap: MAX_PARTICLES as u64 - 1,
        mend,
    })
}

/// The lists of each level, finest first, one a material. Without materials, as many levels without a list as anyone asks for.
pub(crate) fn by_level<T>(lists: &[T], materials: usize) -> impl Iterator<Item = &[T]> {
    (0..).map_while(move |l| lists.get(l * materials..(l + 1) * materials))
}

/// The lists of a state, checked against the plan.
///
/// # Errors
/// If they are not one a level and material.
pub(crate) fn check(particles: &ParticleState, materials: &[PlannedMaterial], levels: usize) -> Result<()> {
    if particles.lists.len() != levels * materials.len() {
        return Err(refuse(format!(
            "{} lists where the plan has {} materials on {levels} levels",
            particles.lists.len(),
            materials.len()
        )));
    }
    for (list, planned) in particles.lists.iter().zip(materials.iter().cycle()) {
        let (strain, states) = (planned.material.strain_planes(), planned.material.states.len());
        if list.strain.len() != strain || list.state.len() != states {
            return Err(refuse(format!(
                "a list has {} strain and {} history planes where its material '{}' has {strain} and {states}",
                list.strain.len(),
                list.state.len(),
                planned.name
            )));
        }
        let far = |c: &i32| !(-4 * REACH + 8..4 * REACH - 8).contains(c);
        if list.cell.iter().flatten().any(far) {
            return Err(Error::Capacity {
                what: "distance from the origin in cells",
                asked: 4 * REACH as u64,
                cap: 4 * REACH as u64,
                mend: "use a coarser world.cell or move the scene towards the origin",
            });
        }
    }
    let fits = |(words, list): (&Vec<u32>, &ParticleList)| words.len() == STRESS.len() * list.len();
    match &particles.kept {
        Some(kept) if kept.len() != particles.lists.len() || !kept.iter().zip(&particles.lists).all(fits) => {
            Err(refuse("what is kept of them besides is not six words each".to_owned()))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_within_two_to_the_minus_twelve_cells_of_home_is_beside_it() {
        let by = |part: f64| (part * TWO_32) as u32;
        let (near, far) = (0.9 / 4096.0, 1.1 / 4096.0);
        let middle = by(0.5);
        assert_eq!(away([0, 0, 0], [middle; 4]), 0);
        assert_eq!(away([1, 0, 0], [by(near), middle, middle, 0]), BESIDE);
        assert_eq!(away([0, -1, 0], [middle, by(1.0 - near), middle, 0]), BESIDE);
        assert_eq!(away([1, 0, -1], [by(near), middle, by(1.0 - near), 0]), BESIDE);
        assert_eq!(away([1, 0, 0], [by(far), middle, middle, 0]), LEFT_HOME);
        assert_eq!(away([0, -1, 0], [middle, by(1.0 - far), middle, 0]), LEFT_HOME);
        assert_eq!(away([1, 0, -1], [by(near), middle, by(1.0 - far), 0]), LEFT_HOME);
        assert_eq!(away([2, 0, 0], [by(near), middle, middle, 0]), LEFT_HOME);
    }
}
