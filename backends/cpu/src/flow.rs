//! Inflow and outflow on this backend's stores; see `barchan_core::flow`.

use crate::engine::CpuEngine;
use barchan_core::{Newcomer, ParticleList, Plan, Result, Spot};
use barchan_grid::adapt::Parcel;
use barchan_grid::limits::LEAST_MASS;
use barchan_grid::transfer::Scalar;
use barchan_lanes::CHUNK;

impl<T: Scalar> CpuEngine<T> {
    /// Takes out the particles for which `gone` holds: their lanes are empty until the next sort, which is due at once.
    pub(crate) fn take_out_where(
        &mut self,
        time: f64,
        gone: &(dyn Fn(&Spot) -> bool + Sync),
    ) -> Result<Vec<ParticleList>> {
        self.flush_strain(time, &vec![true; self.levels.len()])?;
        let mut out = Vec::new();
        for (l, level) in self.levels.iter_mut().enumerate() {
            let h = level.h();
            for i in 0..level.store.lists.len() {
                let list = &level.store.lists[i];
                let places: Vec<(usize, usize)> = list.places().filter(|&place| gone(&list.spot(place, h))).collect();
                let taken = self.pool.install(|| list.give_out(l, h, &places));
                self.mass -= taken.mass.iter().sum::<f64>();
                if !places.is_empty() {
                    level.store.remove(i, places.iter().map(|&(chunk, lane)| chunk * CHUNK + lane));
                    (self.changed[l], self.age) = (true, None);
                }
                out.push(taken);
            }
        }
        Ok(out)
    }

    /// Takes newcomers in. They are in no block until the next sort, which is due at once.
    pub(crate) fn bring_in_newcomers(
        &mut self,
        plan: &Plan,
        time: f64,
        come: &[Newcomer],
        next_id: &mut u64,
    ) -> Result<Vec<ParticleList>> {
        self.flush_strain(time, &vec![true; self.levels.len()])?;
        let mend = "set source.limit or source.until, or raise world.cell";
        let mut first = u64::from(self.adapt.new_ids(come.len() as u64, *next_id, mend)?);
        *next_id = self.adapt.next_id;
        let lists = plan.newcomers(come, &self.adapt.regions, &mut first);
        for list in lists.iter().filter(|list| !list.is_empty()) {
            let parcels: Vec<Parcel> = (0..list.len()).map(|i| Parcel::of(list, i)).collect();
            let level = &mut self.levels[list.level as usize];
            level.store.push(&parcels.iter().collect::<Vec<_>>());
            let speeds = list.velocity.iter().flatten().map(|v| v.abs());
            level.particle_speed = speeds.fold(level.particle_speed, f64::max);
            self.mass += list.mass.iter().sum::<f64>();
            let least = list.mass.iter().fold(f64::INFINITY, |least, m| m.min(least)) * LEAST_MASS;
            self.least_mass = if self.least_mass > 0.0 { self.least_mass.min(least) } else { least };
            (self.changed[list.level as usize], self.age) = (true, None);
        }
        self.measure_stiffness()?;
        Ok(lists)
    }
}
