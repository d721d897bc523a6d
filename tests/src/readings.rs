//! What is read of particles is what a copy of all of them holds.

use crate::scenes::{norm, within};
use barchan::{Aabb, Fields, Reading, Simulation, Vec3};
use std::collections::BTreeMap;

/// Holds readings of a region, and of all, to a copy of all particles.
///
/// # Panics
/// If a particle or a value is missing, or is another one.
pub fn hold(simulation: &Simulation, region: Aabb) {
    let all = Fields {
        exact: false,
        velocity: true,
        affine: true,
        mass: true,
        volume0: true,
        id: true,
        body: true,
        material: true,
        level: true,
    };
    let read = |region: Option<Aabb>, fields: Fields| simulation.read(region, fields).unwrap_or_else(|e| panic!("{e}"));
    let state = simulation.particles();
    for region in [None, Some(region)] {
        let inside = |x| region.is_none_or(|region| region.contains(x));
        let reading: Reading = read(region, all);
        let exact = read(region, Fields { exact: true, id: true, ..Fields::default() });
        let place: BTreeMap<u64, usize> = reading.id.iter().copied().zip(0..).collect();
        let mut count = 0;
        let mut off = 0.0f64;
        for list in &state.lists {
            for k in (0..list.len()).filter(|k| inside(list.position(*k))) {
                let i = place[&list.id[k]];
                count += 1;
                let at = reading.at(i);
                let apart: Vec3 = std::array::from_fn(|d| at[d] - list.position(k)[d]);
                off = off.max(norm(apart));
                assert_eq!(reading.velocity[i], list.velocity[k].map(|x| x as f32));
                assert_eq!(reading.affine[i], list.affine[k].map(|x| x as f32));
                assert_eq!((reading.mass[i], reading.volume0[i]), (list.mass[k] as f32, list.volume0[k] as f32));
                assert_eq!((reading.body[i], reading.material[i]), (list.body[k], list.material as u16));
                assert_eq!(u32::from(reading.level[i]), list.level);
                assert_eq!((exact.id[i], exact.exact[i]), (list.id[k], list.position(k)));
            }
        }
        assert_eq!((reading.len(), exact.len(), place.len()), (count, count, count));
        assert!(exact.position.is_empty() && exact.velocity.is_empty() && exact.mass.is_empty());
        assert!(count > 0 && (region.is_none() || count < simulation.particle_count()), "{count} particles");
        within("distance of places in f32 [m]", off, 2e-7);
    }
}
