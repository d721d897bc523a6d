//! Who merges with whom.

use super::Found;
use nalgebra::{Matrix3, Vector3};

/// Particles merge if together they are this part of the class that they merge into.
pub(super) const PORTION: std::ops::RangeInclusive<f64> = 0.5..=1.6;
/// Width of the neighbourhoods in which particles look for partners, in sides of the merged particle. They are cut by fixed sizes, so that
/// no result depends on the number of threads; their faces lie elsewhere each time.
pub(super) const NEIGHBOURHOOD: u32 = 8;
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

/// A candidate in its bin: class, list, body and bin first, so that those of a bin stand together, in the order of ids.
pub(super) type Binned = (u32, usize, u16, [i64; 3], u32, usize);

impl Candidate {
    /// In its bin, `sides` merged particles wide and moved by half of that along the axes of `shift`; `i` is its number.
    pub(super) fn binned(&self, i: usize, sides: u32, shift: usize) -> Binned {
        let side = self.side * f64::from(sides);
        let half = |d: usize| f64::from((shift >> d & 1) as u32) * 0.5;
        let bin = std::array::from_fn(|d| (self.x[d] / side + half(d)).floor() as i64);
        (self.found.class, self.found.list, self.body, bin, self.id, i)
    }
}

/// Particles of a neighbourhood that look for partners, by cubes of one side.
pub(super) struct Loose {
    /// Places, in sides of the merged particle.
    x: Vec<Vector3<f64>>,
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

impl Loose {
    /// The particles of a bin that is a neighbourhood; `shift` as they were binned.
    pub(super) fn new(candidates: &[Candidate], bin: &[Binned], shift: usize) -> Self {
        // In sides of the merged particle, with bins' faces at whole numbers.
        let width = i64::from(NEIGHBOURHOOD);
        let origin: [f64; 3] =
            std::array::from_fn(|d| (bin[0].3[d] * width - (shift >> d & 1) as i64 * width / 2) as f64);
        let one = |binned: &Binned| {
            let one = &candidates[binned.5];
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
        Self {
            x: number.iter().map(|&i| particles[i].0).collect(),
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
        let cube = Self::cube(&self.x[i]);
        let [x, y, z] = cube.map(|c| c.saturating_sub(1)..=(c + 1).min(NEIGHBOURHOOD as usize - 1));
        let rows = x.flat_map(move |x| y.clone().map(move |y| (x, y)));
        rows.map(move |(x, y)| {
            self.starts[Self::index([x, y, *z.start()])]..self.starts[Self::index([x, y, *z.end()]) + 1]
        })
    }

    /// Particles in the order in which they look for partners: those with the least choice first, and in the bin's order.
    pub(super) fn seeds(&self, only_surface: bool) -> Vec<usize> {
        let wanted = (0..self.x.len()).filter(|&i| !only_surface || self.surface[i]);
        let choice = |i: usize| -> usize {
            let x = self.x[i];
            self.around(i)
                .map(|run| self.x[run].iter().map(|y| usize::from((y - x).norm_squared() < 1.0)).sum::<usize>())
                .sum()
        };
        let mut seeds: Vec<(usize, usize, usize)> = wanted.map(|i| (choice(i), self.number[i], i)).collect();
        seeds.sort_unstable();
        seeds.into_iter().map(|(.., i)| i).collect()
    }

    /// Of the clusters about a particle's eight corners, with at least so much volume, the one most like the merged cube, and as bins lie
    /// where that is a tie; at the surface no less like it than `strict`. In the bin's order.
    pub(super) fn cluster(&self, seed: usize, least: f64, strict: f64) -> Option<Vec<usize>> {
        if !self.free[seed] {
            return None;
        }
        let is_near = |i: &usize| self.free[*i] && (self.x[*i] - self.x[seed]).norm_squared() < 1.0;
        let near: Vec<usize> = self.around(seed).flatten().filter(is_near).collect();
        if near.len() < 2 || self.sum(&near) < least {
            return None;
        }
        let mut best: Option<(f64, Vec<usize>)> = None;
        let mut members: Vec<usize> = Vec::with_capacity(near.len());
        for corner in 0..8 {
            let towards = |d: usize| if corner >> d & 1 == 1 { 0.25 } else { -0.25 };
            let mut centre = self.x[seed] + Vector3::from_fn(|d, _| towards(d));
            let mut volume = 0.0;
            // Turned matter has its cubes' centres elsewhere: go there.
            for _ in 0..2 {
                members.clear();
                members.extend(near.iter().filter(|&&i| (self.x[i] - centre).norm_squared() < REACH * REACH));
                let moment: Vector3<f64> = members.iter().map(|&i| self.x[i] * self.volume[i]).sum();
                volume = self.sum(&members);
                centre = moment / volume;
            }
            if members.len() < 2 || volume < least || volume > *PORTION.end() {
                continue;
            }
            let mut spread = Matrix3::zeros();
            for &i in &members {
                let arm = self.x[i] - centre;
                spread +=
                    (arm * arm.transpose() + Matrix3::from_diagonal_element(self.own[i])) * (self.volume[i] / volume);
            }
            let unlike_cube = (spread * (12.0 / volume.cbrt().powi(2)) - Matrix3::identity()).norm();
            let off_bin = centre.map(|x| x - x.floor() - 0.5).norm();
            let score = unlike_cube + (volume - 1.0).abs() + 0.1 * off_bin;
            let bearable = if members.iter().any(|&i| self.surface[i]) { strict } else { SHAPELESS };
            if unlike_cube <= bearable && best.as_ref().is_none_or(|(least, _)| score < *least) {
                best = Some((score, members.clone()));
            }
        }
        let (_, mut members) = best?;
        members.sort_unstable_by_key(|&i| self.number[i]);
        Some(members)
    }

    fn sum(&self, members: &[usize]) -> f64 {
        members.iter().map(|&i| self.volume[i]).sum()
    }
}
