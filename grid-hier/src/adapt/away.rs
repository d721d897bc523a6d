//! Ground that goes out of reach merges once more, before it is archived.

use super::nearby::filled_by_cubes;
use super::{Adapt, Candidates, CopiedLevel, Material, PATIENCE, Parcel, Resampled, Round, least_volume, moved};
use crate::block;
use barchan_core::levels::TILE;
use barchan_core::{Coupling, ParticleList, Result};

/// So many times the tolerance holds for it.
const OUT_OF_REACH: f64 = 3.0;

impl Adapt {
    /// Merges what can be merged of the ground of a tile that goes out of reach, where nothing has to be as fine any more
    /// as it was; beyond the tile the ground goes on. Returns one list a level and material, and how many particles have
    /// merged into how many.
    ///
    /// # Errors
    /// Those of [`apply`](Self::apply).
    pub fn merged(
        &self,
        tile: [i32; 2],
        mut lists: Vec<ParticleList>,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<(Vec<ParticleList>, [u64; 2])> {
        let mut own = self.clone();
        (own.resampled, own.tolerance) = (Resampled::default(), OUT_OF_REACH * self.tolerance);
        let coarsest = self.widths.len() - 1;
        for (level, bounds) in own.bounds.iter_mut().enumerate() {
            for d in 0..2 {
                let [first, end] = [tile[d], tile[d] + 1].map(|t| (t * TILE) << (coarsest - level));
                (bounds.min[d], bounds.max[d], bounds.periodic[d], bounds.walled[d]) = (first, end, false, [true; 2]);
            }
        }
        for round in 1..=PATIENCE {
            own.rounds = round;
            let mut copied = own.by_class(&lists);
            let found = copied.iter().enumerate().flat_map(|(l, level)| own.find_on(l, level, Candidates::All));
            let found = Round { found: found.collect(), merges: true, levels: copied.len() };
            // Whether merged or not, all come to the level where they belong.
            own.apply(&mut copied.iter_mut().collect::<Vec<_>>(), &found, couplings)?;
            lists = copied.into_iter().flat_map(CopiedLevel::lists).collect();
        }
        for list in &mut lists {
            list.mass.iter_mut().chain(&mut list.volume0).for_each(|x| *x = self.precision.round(*x));
        }
        let done = &own.resampled;
        Ok((lists, [done.merged, done.merges]))
    }

    /// Particles on the levels that their sizes belong to: there a cell is as wide as what they merge into.
    fn by_class(&self, lists: &[ParticleList]) -> Vec<CopiedLevel> {
        let (coarsest, materials) = (self.widths.len() - 1, self.materials.len());
        let class = |body: u16, volume0: f64| {
            let finest = self.finest_volume[usize::from(body).min(self.finest_volume.len() - 1)];
            (1..=coarsest).take_while(|class| volume0 >= least_volume(finest, *class)).count()
        };
        let mut parcels = vec![Vec::new(); self.widths.len() * materials];
        for list in lists {
            for i in 0..list.len() {
                let to = class(list.body[i], list.volume0[i]);
                let parcel = moved(Parcel::of(list, i), list.level as usize, to);
                let key = block::key(block::of_cell(parcel.cell)).unwrap_or(u64::MAX);
                parcels[to * materials + list.material as usize].push((key, parcel));
            }
        }
        let list = |(n, mut parcels): (usize, Vec<(u64, Parcel)>)| {
            let (level, m) = (n / materials, n % materials);
            let Material { strain, rules } = &self.materials[m];
            let mut list = ParticleList::empty(level, m, self.widths[level], *strain, rules.len());
            parcels.sort_unstable_by_key(|(key, parcel)| (*key, parcel.id));
            Parcel::add_all(&parcels.iter().map(|(_, parcel)| parcel).collect::<Vec<_>>(), &mut list);
            list
        };
        let mut own = parcels.into_iter().enumerate().map(list);
        let copied =
            |width: &f64| CopiedLevel::new(own.by_ref().take(materials).collect(), filled_by_cubes(lists, *width));
        self.widths.iter().map(copied).collect()
    }
}
