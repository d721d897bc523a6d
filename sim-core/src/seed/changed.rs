//! What of a tile has changed since it was seeded: what the archive of unbounded ground has to keep.

use super::{Plot, Terrain};
use crate::levels::Regions;
use crate::{Coupling, ParticleList, Result, Vec3, settle};
use std::collections::BTreeMap;

/// How far, in spacings, a particle may be from its seeded place and still count as not moved.
const UNMOVED: f64 = 0.1;
/// How much a particle's history may have changed and still count as unchanged, relative to the larger of 1 and its
/// value at the start.
const UNCHANGED: f64 = 1e-3;
/// Relative difference of masses and volumes that is rounding.
const ROUNDING: f64 = 1e-5;
/// By how much of itself the mass of changed ground may be corrected for what unchanged ground beside it has won or lost.
const CORRECTED: f64 = 1e-2;

/// A particle: its list, and its number there.
type Place = (usize, usize);

/// A cube of a body's lattice, as large as the coarsest particles.
#[derive(Default)]
struct Cube {
    /// The particles whose middle lies in it.
    now: Vec<Place>,
    /// Those that it was seeded with.
    then: Vec<Place>,
    /// Does it hold more or less, or has a particle moved, or another history?
    altered: bool,
    /// Could what it was seeded with stand in for its particles, one for each?
    matches: bool,
}

impl Cube {
    fn is_same(&self) -> bool {
        !self.altered && self.matches
    }
}

fn mass_of(lists: &[ParticleList], places: &[Place]) -> f64 {
    places.iter().map(|&(list, i)| lists[list].mass[i]).sum()
}

impl Terrain {
    /// What has to be kept of a tile, or `None` if it is as it was at the start, perhaps split and merged but otherwise unchanged. Cubes that have not changed are
    /// in it as they were seeded, in the resolution of the present regions; their particles take the numbers of those that were there. What mass they have
    /// won or lost by merging goes to changed ground of the same body and material.
    ///
    /// A cube as large as the coarsest particles has not changed if
    ///
    /// 1. it holds no more or less than at the start by more than `levels.tolerance` of a full one, which is what merging may move;
    /// 2. those of its particles that have never merged are off their seeded place by no more than a tenth of a spacing;
    /// 3. history is what it was but for 1/1000.
    ///
    /// # Errors
    /// As [`seed_tiles`](Self::seed_tiles).
    pub fn changed(
        &self,
        tile: [i32; 2],
        lists: Vec<ParticleList>,
        couplings: &[Box<dyn Coupling>],
        regions: &Regions,
    ) -> Result<Option<Vec<ParticleList>>> {
        let mut seeded = self.seed_tiles(&[tile], couplings, regions, &mut 0)?;
        let mut kept = lists;
        let all = |lists: &[ParticleList]| lists.iter().flat_map(|list| &list.mass).sum::<f64>();
        let at_start = all(&seeded);
        let same_mass = (all(&kept) - at_start).abs() <= ROUNDING * at_start;
        let compared: Vec<_> =
            self.plots.iter().map(|plot| self.compare(plot, regions.levels() - 1, &kept, &seeded)).collect();
        if same_mass && !compared.iter().flat_map(BTreeMap::values).any(|cube| cube.altered) {
            return Ok(None);
        }
        // Of all particles: which stay, and which come back.
        let mut stays: Vec<Vec<bool>> = kept.iter().map(|list| vec![true; list.len()]).collect();
        let mut comes: Vec<Vec<bool>> = seeded.iter().map(|list| vec![false; list.len()]).collect();
        for cubes in &compared {
            let (mut now, mut then) = (0.0, 0.0);
            for cube in cubes.values().filter(|cube| cube.is_same()) {
                now += mass_of(&kept, &cube.now);
                then += mass_of(&seeded, &cube.then);
            }
            let changed: Vec<Place> =
                cubes.values().filter(|cube| !cube.is_same()).flat_map(|cube| cube.now.iter().copied()).collect();
            let rest = mass_of(&kept, &changed);
            if (now - then).abs() > (CORRECTED * rest).max(ROUNDING * then) {
                continue;
            }
            for &(list, i) in &changed {
                let grown = 1.0 + (now - then) / rest;
                kept[list].mass[i] = self.precision.round(grown * kept[list].mass[i]);
                kept[list].volume0[i] = self.precision.round(grown * kept[list].volume0[i]);
            }
            for cube in cubes.values().filter(|cube| cube.is_same()) {
                cube.now.iter().for_each(|&(list, i)| stays[list][i] = false);
                for (&(list, i), &(of, number)) in cube.then.iter().zip(&cube.now) {
                    comes[list][i] = true;
                    seeded[list].id[i] = kept[of].id[number];
                }
            }
        }
        for (list, marks) in kept.iter_mut().zip(&stays).chain(seeded.iter_mut().zip(&comes)) {
            list.keep(marks);
        }
        for list in seeded {
            let same = |other: &&mut ParticleList| (other.level, other.material) == (list.level, list.material);
            match kept.iter_mut().find(same) {
                Some(other) => other.append(list),
                None => kept.push(list),
            }
        }
        Ok(Some(kept))
    }

    /// The cubes of a plot that hold anything, or did.
    fn compare(
        &self,
        plot: &Plot,
        coarsest: usize,
        now: &[ParticleList],
        then: &[ParticleList],
    ) -> BTreeMap<[i64; 3], Cube> {
        let mut cubes: BTreeMap<[i64; 3], Cube> = BTreeMap::new();
        let spacing = self.scene.spacing(&self.scene.body[plot.index]);
        let side = spacing * f64::from(1 << coarsest);
        let cube_of = |x: Vec3| plot.lattice(x, side).map(|middle| middle.floor() as i64);
        for (l, list) in then.iter().enumerate() {
            plot.own(list).for_each(|i| cubes.entry(cube_of(list.position(i))).or_default().then.push((l, i)));
        }
        let planned = &self.materials[plot.material];
        for (l, list) in now.iter().enumerate() {
            let here: Vec<usize> = plot.own(list).collect();
            let loads = self.loads(here.iter().map(|&i| list.position(i)));
            let settled = settle::under(planned, &loads, self.scene.body[plot.index].k0).ok();
            for (n, &i) in here.iter().enumerate() {
                let x = list.position(i);
                let cube = cubes.entry(cube_of(x)).or_default();
                cube.now.push((l, i));
                let single = (list.volume0[i] / spacing.powi(3) - 1.0).abs() <= ROUNDING;
                let history = |settled: &Vec<Vec<f64>>| {
                    let planes = settled.iter().skip(planned.material.strain_planes()).zip(&list.state);
                    planes
                        .map(|(then, now)| (now[i], then[n]))
                        .all(|(now, then)| (now - then).abs() <= UNCHANGED * then.abs().max(1.0))
                };
                cube.altered |= single && !self.is_in_place(plot, x) || !settled.as_ref().is_some_and(history);
            }
        }
        let filled = [now, then].map(|lists| plot.filling(side, lists));
        let most = self.scene.levels.tolerance * side.powi(3);
        for (at, cube) in &mut cubes {
            let [fills, filled] = filled.each_ref().map(|filling| filling.get(at).copied().unwrap_or(0.0));
            let volume = |lists: &[ParticleList], places: &[Place]| {
                places.iter().map(|&(l, i)| lists[l].volume0[i]).sum::<f64>()
            };
            let whole = volume(now, &cube.now) - volume(then, &cube.then);
            cube.altered |= (fills - filled).abs() > most;
            cube.matches = whole.abs() <= most && (1..=cube.now.len()).contains(&cube.then.len());
        }
        cubes
    }

    /// Does a particle of the finest class stand where one is seeded?
    fn is_in_place(&self, plot: &Plot, x: Vec3) -> bool {
        let spacing = self.scene.spacing(&self.scene.body[plot.index]);
        let number = plot.lattice(x, spacing).map(f64::floor);
        if (0..3).any(|d| !(0.0..plot.axes[d].count as f64).contains(&number[d])) {
            return false;
        }
        let site = self.cube_site(plot, number.map(|n| n as u64), 0);
        (0..3).all(|d| (site[d].position - x[d]).abs() <= UNMOVED * spacing)
    }
}

impl Plot {
    /// Which of a list's particles are its own.
    fn own<'a>(&self, list: &'a ParticleList) -> impl Iterator<Item = usize> + use<'a> {
        let (index, is_own) = (self.index, list.material as usize == self.material);
        (0..list.len()).filter(move |&i| is_own && usize::from(list.body[i]) == index)
    }

    /// Where a point is on its lattice, from the lattice's corner, in cubes with sides of that length [m].
    fn lattice(&self, x: Vec3, side: f64) -> [f64; 3] {
        std::array::from_fn(|d| (x[d] - self.axes[d].site(-0.5).position) / side)
    }

    /// Rest volume of its particles, each a cube, in the cubes of its lattice with sides of that length [m³].
    fn filling(&self, side: f64, lists: &[ParticleList]) -> BTreeMap<[i64; 3], f64> {
        let mut filling = BTreeMap::new();
        for list in lists {
            for i in self.own(list) {
                let (middle, half) = (self.lattice(list.position(i), side), 0.5 * list.volume0[i].cbrt() / side);
                // Along each axis: first cube, and how much of the particle lies in it and in each of the next ones.
                let parts: [(i64, Vec<f64>); 3] = middle.map(|middle| {
                    let (low, high) = (middle - half, middle + half);
                    let first = low.floor();
                    let ends = (0..).map(|k| first + f64::from(k)).take_while(|start| *start < high);
                    (first as i64, ends.map(|start| (high.min(start + 1.0) - low.max(start)) / (2.0 * half)).collect())
                });
                for (a, p) in (0..).zip(&parts[0].1) {
                    for (b, q) in (0..).zip(&parts[1].1) {
                        for (c, r) in (0..).zip(&parts[2].1) {
                            let cube = [parts[0].0 + a, parts[1].0 + b, parts[2].0 + c];
                            *filling.entry(cube).or_insert(0.0) += p * q * r * list.volume0[i];
                        }
                    }
                }
            }
        }
        filling
    }
}
