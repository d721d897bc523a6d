//! Finds clusters of particles that merge into one.

use super::Found;
use barchan_lanes::{CHUNK, Isa, Kernel, Lanes, Mask};
use nalgebra::{Matrix3, Vector3};
use std::ops::Range;

/// Particles merge if together they are this part of the class that they merge into.
pub(super) const PORTION: std::ops::RangeInclusive<f64> = 0.5..=1.6;
/// Width of the neighbourhoods in which particles look for partners, in sides of the merged particle. They are cut by fixed sizes, so that
/// no result depends on the number of threads; their faces lie elsewhere each time.
pub(super) const NEIGHBOURHOOD: u32 = 4;
/// How far from a cluster's centre its members may be, in sides of the merged particle: those of a lattice are √3/4 away, the next
/// ones 0.83.
const REACH: f64 = 0.65;
/// Clusters merge if they are no less like a cube than this, as the norm of their second moments over those of the cube of their
/// volume, less 1: a slab half as thick as wide has 1.02, two particles of a lattice 1.64.
const SHAPELESS: f64 = 1.1;

/// A particle that looks for partners.
pub(super) struct Candidate {
    pub(super) found: Found,
    pub(super) id: u32,
    pub(super) body: u16,
    /// Where it is [m].
    pub(super) x: [f64; 3],
    /// Rest volume [m³].
    pub(super) volume0: f64,
    /// Side of what it may become a part of [m].
    pub(super) side: f64,
    pub(super) at_surface: bool,
}

/// A candidate in its bin. Those of a bin stand together, in the order of ids.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Binned {
    /// Class, list, body and bin in one number, since many are sorted.
    bin: u128,
    id: u32,
    /// The candidate's number.
    pub(super) i: u32,
}

impl Binned {
    /// Are they in the same bin?
    pub(super) fn is_beside(&self, other: &Self) -> bool {
        self.bin == other.bin
    }

    /// Which of the candidates it is.
    pub(super) fn of<'a>(&self, candidates: &'a [Candidate]) -> &'a Candidate {
        &candidates[self.i as usize]
    }

    /// The bin along an axis.
    fn along(&self, axis: usize) -> i32 {
        (self.bin >> (64 - 32 * axis)) as u32 as i32 ^ i32::MIN
    }
}

impl Candidate {
    /// In its bin, `sides` merged particles wide and moved by half of that along the axes of `shift`; `i` is its number.
    pub(super) fn binned(&self, i: usize, sides: u32, shift: usize) -> Binned {
        let side = self.side * f64::from(sides);
        let half = |d: usize| f64::from((shift >> d & 1) as u32) * 0.5;
        let bin = (0..3).fold(0, |bin, d| {
            let along = (self.x[d] / side + half(d)).floor() as i32;
            // Negative ones come first.
            bin << 32 | u128::from((along ^ i32::MIN) as u32)
        });
        // No scene has 16 classes or 4096 materials.
        let kind = u128::from(self.found.class) << 28 | (self.found.list as u128) << 16 | u128::from(self.body);
        Binned { bin: kind << 96 | bin, id: self.id, i: i as u32 }
    }
}

/// Corners of a cube about a particle; the middle of the cube that it becomes a part of lies near one of them.
const CORNERS: usize = 8;

/// Places, a plane an axis, and behind them [`CHUNK`] that are near nothing.
#[derive(Default)]
struct Places([Vec<f64>; 3]);

/// Particles near one, with those about each of its corners.
#[derive(Default)]
pub(super) struct Near {
    particles: Vec<Neighbour>,
    /// Where the particles about each corner have their middle, axis by axis, and their volume.
    centre: [[f64; CORNERS]; 3],
    volume: [f64; CORNERS],
    /// For each of those near, the square of how far it is from where the middle at each corner was taken to be.
    square: Vec<[f64; CORNERS]>,
}

/// A particle near one: its index, place and volume.
struct Neighbour {
    i: usize,
    x: [f64; 3],
    volume: f64,
}

/// Particles of a neighbourhood that look for partners, by cubes of one side.
pub(super) struct Loose {
    /// Places, in sides of the merged particle.
    x: Places,
    /// Rest volumes over that of the merged particle, and the second moment of each as a cube, per mass.
    volume: Vec<f64>,
    own: Vec<f64>,
    /// Are they at the surface?
    surface: Vec<bool>,
    pub(super) free: Vec<bool>,
    /// Their numbers in the bin.
    pub(super) number: Vec<usize>,
    /// Where each cube's begin.
    starts: Vec<usize>,
}

impl Places {
    /// Adds one.
    fn push(&mut self, x: Vector3<f64>) {
        (0..3).for_each(|d| self.0[d].push(x[d]));
    }

    /// Adds those that are near nothing: now it can be looked into.
    fn close(&mut self) {
        self.0.iter_mut().for_each(|plane| plane.extend([f64::INFINITY; CHUNK]));
    }

    fn at(&self, i: usize) -> Vector3<f64> {
        Vector3::new(self.0[0][i], self.0[1][i], self.0[2][i])
    }

    /// Which of as many as there are lanes, from one on, lie nearer to a point than a distance, given as its square, as bits.
    #[inline(always)]
    fn nearer<V: Lanes<Scalar = f64>>(&self, first: usize, point: &Vector3<f64>, square: f64) -> u16 {
        let mut sum = V::zero();
        for d in 0..3 {
            let plane = &self.0[d][first..first + V::COUNT];
            // SAFETY: the slice has as many entries.
            let arm = unsafe { V::load(plane.as_ptr()) } - V::splat(point[d]);
            sum += arm * arm;
        }
        sum.lt(V::splat(square)).bits()
    }

    /// Likewise, of those of a run from `first` on.
    #[inline(always)]
    fn nearer_of_run<V: Lanes<Scalar = f64>>(&self, first: usize, run: &Range<usize>, point: &Vector3<f64>) -> u16 {
        let left = (run.end - first).min(V::COUNT);
        self.nearer::<V>(first, point, 1.0) & (u16::MAX >> (u16::BITS as usize - left))
    }
}

/// Counts, for each of some particles, those that lie less than a side away.
struct Choices<'a>(&'a Loose, &'a [usize]);

impl Kernel<f64> for Choices<'_> {
    type Output = Vec<usize>;

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) -> Vec<usize> {
        let Self(loose, of) = self;
        let mut choices = Vec::with_capacity(of.len());
        for &i in of {
            let (x, mut choice) = (loose.x.at(i), 0);
            for run in loose.around(i) {
                for first in run.clone().step_by(V::COUNT) {
                    choice += loose.x.nearer_of_run::<V>(first, &run, &x).count_ones() as usize;
                }
            }
            choices.push(choice);
        }
        choices
    }
}

/// Finds the free particles less than a side away from one.
struct FindNear<'a>(&'a Loose, usize, &'a mut Near);

impl Kernel<f64> for FindNear<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) {
        let Self(loose, seed, near) = self;
        let x = loose.x.at(seed);
        for run in loose.around(seed) {
            for first in run.clone().step_by(V::COUNT) {
                let mut bits = loose.x.nearer_of_run::<V>(first, &run, &x);
                while bits != 0 {
                    let i = first + bits.trailing_zeros() as usize;
                    bits &= bits - 1;
                    if loose.free[i] {
                        let x = loose.x.at(i).into();
                        near.particles.push(Neighbour { i, x, volume: loose.volume[i] });
                    }
                }
            }
        }
    }
}

/// Finds the particles about each corner of one at a place. Corners stand side by side in registers.
struct FindCorners<'a>(Vector3<f64>, &'a mut Near);

impl Kernel<f64> for FindCorners<'_> {
    type Output = ();

    #[inline(always)]
    fn run<V: Lanes<Scalar = f64>>(self) {
        let Self(x, near) = self;
        for d in 0..3 {
            for k in 0..CORNERS {
                near.centre[d][k] = x[d] + if k >> d & 1 == 1 { 0.25 } else { -0.25 };
            }
        }
        // Turned matter has its cubes' centres elsewhere: go there.
        for _ in 0..2 {
            near.square.clear();
            let (mut moment, mut volume) = ([[0.0; CORNERS]; 3], [0.0; CORNERS]);
            for one in &near.particles {
                let mut square = [0.0; CORNERS];
                for d in 0..3 {
                    for k in 0..CORNERS {
                        let arm = one.x[d] - near.centre[d][k];
                        square[k] += arm * arm;
                    }
                }
                // Adding nothing changes no bit.
                for d in 0..3 {
                    let own = one.x[d] * one.volume;
                    for k in 0..CORNERS {
                        moment[d][k] += if square[k] < REACH * REACH { own } else { 0.0 };
                    }
                }
                for k in 0..CORNERS {
                    volume[k] += if square[k] < REACH * REACH { one.volume } else { 0.0 };
                }
                near.square.push(square);
            }
            for d in 0..3 {
                for k in 0..CORNERS {
                    near.centre[d][k] = moment[d][k] / volume[k];
                }
            }
            near.volume = volume;
        }
    }
}

impl Near {
    /// Is one of those near about a corner?
    fn is_about(&self, n: usize, corner: usize) -> bool {
        self.square[n][corner] < REACH * REACH
    }

    /// Those about a corner.
    fn about(&self, corner: usize) -> impl Iterator<Item = &Neighbour> {
        self.particles.iter().enumerate().filter(move |(n, _)| self.is_about(*n, corner)).map(|(_, one)| one)
    }

    fn centre(&self, corner: usize) -> Vector3<f64> {
        Vector3::from_fn(|d, _| self.centre[d][corner])
    }

    /// Are the particles about two corners the same?
    fn are_same(&self, a: usize, b: usize) -> bool {
        // As a rule their middles tell.
        (self.volume[a], self.centre(a)) == (self.volume[b], self.centre(b))
            && (0..self.square.len()).all(|n| self.is_about(n, a) == self.is_about(n, b))
    }
}

impl Loose {
    /// The particles of a bin that is a neighbourhood; `shift` as they were binned.
    pub(super) fn new(candidates: &[Candidate], bin: &[Binned], shift: usize) -> Self {
        // In sides of the merged particle, with bins' faces at whole numbers.
        let width = f64::from(NEIGHBOURHOOD);
        let origin: [f64; 3] =
            std::array::from_fn(|d| f64::from(bin[0].along(d)) * width - (shift >> d & 1) as f64 * width / 2.0);
        let one = |binned: &Binned| {
            let one = binned.of(candidates);
            let x = Vector3::from_fn(|d, _| one.x[d] / one.side - origin[d]);
            (x, one.volume0 / one.side.powi(3), one.at_surface)
        };
        let particles: Vec<(Vector3<f64>, f64, bool)> = bin.iter().map(one).collect();
        let mut starts = vec![0; (NEIGHBOURHOOD as usize).pow(3) + 1];
        let cubes: Vec<usize> = particles.iter().map(|(x, ..)| Self::index(Self::cube(x))).collect();
        cubes.iter().for_each(|cube| starts[cube + 1] += 1);
        (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
        let mut number: Vec<usize> = (0..particles.len()).collect();
        number.sort_by_key(|&i| cubes[i]);
        let volume: Vec<f64> = number.iter().map(|&i| particles[i].1).collect();
        let mut x = Places::default();
        number.iter().for_each(|&i| x.push(particles[i].0));
        x.close();
        Self {
            x,
            own: volume.iter().map(|volume| volume.cbrt().powi(2) / 12.0).collect(),
            volume,
            surface: number.iter().map(|&i| particles[i].2).collect(),
            free: vec![true; particles.len()],
            number,
            starts,
        }
    }

    fn cube(x: &Vector3<f64>) -> [usize; 3] {
        // What rounding puts outside belongs to the outermost cubes.
        std::array::from_fn(|d| (x[d].max(0.0) as usize).min(NEIGHBOURHOOD as usize - 1))
    }

    fn index(cube: [usize; 3]) -> usize {
        (cube[0] * NEIGHBOURHOOD as usize + cube[1]) * NEIGHBOURHOOD as usize + cube[2]
    }

    /// Runs of particles that may be less than a side away from one.
    fn around(&self, i: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
        let cube = Self::cube(&self.x.at(i));
        let [x, y, z] = cube.map(|c| c.saturating_sub(1)..=(c + 1).min(NEIGHBOURHOOD as usize - 1));
        let rows = x.flat_map(move |x| y.clone().map(move |y| (x, y)));
        rows.map(move |(x, y)| {
            self.starts[Self::index([x, y, *z.start()])]..self.starts[Self::index([x, y, *z.end()]) + 1]
        })
    }

    /// Particles in the order in which they look for partners: those with the least choice first, and in the bin's order.
    pub(super) fn seeds(&self, isa: Isa, only_surface: bool) -> Vec<usize> {
        let wanted: Vec<usize> = (0..self.free.len()).filter(|&i| !only_surface || self.surface[i]).collect();
        let choices = isa.run(Choices(self, &wanted));
        let mut seeds: Vec<(usize, usize, usize)> =
            choices.into_iter().zip(wanted).map(|(choice, i)| (choice, self.number[i], i)).collect();
        seeds.sort_unstable();
        seeds.into_iter().map(|(.., i)| i).collect()
    }

    /// Of the clusters about a particle's eight corners, with at least so much volume, the one most like the merged cube, and as bins lie
    /// where that is a tie; at the surface no less like it than `strict`. In the bin's order. `near` is overwritten.
    pub(super) fn cluster(
        &self,
        isa: Isa,
        seed: usize,
        least: f64,
        strict: f64,
        near: &mut Near,
    ) -> Option<Vec<usize>> {
        if !self.free[seed] {
            return None;
        }
        near.particles.clear();
        isa.run(FindNear(self, seed, near));
        if near.particles.len() < 2 || near.particles.iter().map(|one| one.volume).sum::<f64>() < least {
            return None;
        }
        isa.run(FindCorners(self.x.at(seed), near));
        let mut best: Option<(f64, usize)> = None;
        for corner in 0..CORNERS {
            let (centre, volume) = (near.centre(corner), near.volume[corner]);
            let is_wanted = volume >= least && volume <= *PORTION.end() && near.about(corner).nth(1).is_some();
            let off_bin = centre.map(|x| x - x.floor() - 0.5).norm();
            let (off_size, off_bin) = ((volume - 1.0).abs(), 0.1 * off_bin);
            // What scores no better however it is shaped need not be looked at.
            let is_behind = best.is_some_and(|(least, _)| off_size + off_bin >= least);
            if !is_wanted || is_behind || (0..corner).any(|other| near.are_same(corner, other)) {
                continue;
            }
            let mut spread = Matrix3::zeros();
            for one in near.about(corner) {
                let arm = Vector3::from(one.x) - centre;
                let own = Matrix3::from_diagonal_element(self.own[one.i]);
                spread += (arm * arm.transpose() + own) * (one.volume / volume);
            }
            let unlike_cube = (spread * (12.0 / volume.cbrt().powi(2)) - Matrix3::identity()).norm();
            let score = unlike_cube + off_size + off_bin;
            let at_surface = near.about(corner).any(|one| self.surface[one.i]);
            let bearable = if at_surface { strict } else { SHAPELESS };
            if unlike_cube <= bearable && best.is_none_or(|(least, _)| score < least) {
                best = Some((score, corner));
            }
        }
        let mut members: Vec<usize> = near.about(best?.1).map(|one| one.i).collect();
        members.sort_unstable_by_key(|&i| self.number[i]);
        Some(members)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Particles of one neighbourhood, some of them taken, at places in [0, 8)³.
    fn loose() -> Loose {
        let mut state = 1u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let candidate = |i: u32| Candidate {
            found: Found { level: 0, list: 0, place: 0, class: 0, home: 0, action: super::super::Action::Merge },
            id: i,
            body: 0,
            x: [8.0 * number(), 3.0 * number(), 2.0 * number()],
            volume0: 0.1 + 0.05 * number(),
            side: 1.0,
            at_surface: false,
        };
        let candidates: Vec<Candidate> = (0..500).map(candidate).collect();
        let bin: Vec<Binned> = candidates.iter().enumerate().map(|(i, one)| one.binned(i, NEIGHBOURHOOD, 0)).collect();
        let mut loose = Loose::new(&candidates, &bin, 0);
        (0..500).step_by(7).for_each(|i| loose.free[i] = false);
        loose
    }

    /// Who is near, and what is about corners, is the same to the last bit on every instruction set, and what plain loops find.
    #[test]
    fn instruction_sets_find_the_same_neighbours() {
        let loose = loose();
        let all: Vec<usize> = (0..loose.free.len()).collect();
        let distance = |i: usize, j: usize| (loose.x.at(i) - loose.x.at(j)).norm_squared();
        let choice = |&i: &usize| all.iter().filter(|&&j| distance(i, j) < 1.0).count();
        let choices: Vec<usize> = all.iter().map(choice).collect();
        for isa in Isa::available() {
            assert_eq!(isa.run(Choices(&loose, &all)), choices);
            for &i in &all {
                let mut near = Near::default();
                isa.run(FindNear(&loose, i, &mut near));
                let found: Vec<usize> = near.particles.iter().map(|one| one.i).collect();
                let wanted: Vec<usize> =
                    all.iter().copied().filter(|&j| loose.free[j] && distance(i, j) < 1.0).collect();
                assert_eq!(found, wanted);
                isa.run(FindCorners(loose.x.at(i), &mut near));
                for corner in 0..CORNERS {
                    let towards = |d: usize| if corner >> d & 1 == 1 { 0.25 } else { -0.25 };
                    let mut centre = loose.x.at(i) + Vector3::from_fn(|d, _| towards(d));
                    let mut about = Vec::new();
                    for _ in 0..2 {
                        let is_about = |j: &usize| (loose.x.at(*j) - centre).norm_squared() < REACH * REACH;
                        about = wanted.iter().copied().filter(is_about).collect();
                        let moment: Vector3<f64> = about.iter().map(|&j| loose.x.at(j) * loose.volume[j]).sum();
                        centre = moment / about.iter().map(|&j| loose.volume[j]).sum::<f64>();
                    }
                    assert!(near.about(corner).map(|one| one.i).eq(about));
                    let bits = |x: Vector3<f64>| [0, 1, 2].map(|d| x[d].to_bits());
                    assert!(centre.x.is_nan() || bits(near.centre(corner)) == bits(centre));
                }
            }
        }
    }
}
