//! Particles outside of any list.

use crate::particles::{MASS, MOTION, STRAIN, VOLUME};
use crate::resample::{Particle, Planes};
use crate::transfer::MAX_STATE;
use barchan_core::ParticleList;
use barchan_core::plan::PlannedMaterial;
use nalgebra::{Matrix3, Vector3};

/// One particle outside of any list, on its way to another place or level. It holds numbers of the run's precision
/// exactly.
#[derive(Clone, Debug)]
pub struct Parcel {
    /// Index of the list within the level.
    pub list: usize,
    /// Its number.
    pub id: u32,
    /// Index of its body in the scene.
    pub body: u16,
    /// Integer cell on its level.
    pub cell: [i32; 3],
    /// Position in the cell, in cells, [0, 1).
    pub offset: [f64; 3],
    /// Velocity [m/s] and affine matrix [1/s].
    pub motion: [f64; MOTION],
    /// Mass [kg], rest volume [m³], strain, history.
    pub rest: [f64; STRAIN + 9 + MAX_STATE],
}

impl Parcel {
    /// A copy of one particle of a list.
    pub fn of(list: &ParticleList, i: usize) -> Self {
        let (v, c) = (list.velocity[i], list.affine[i]);
        let mut parcel = Self {
            list: list.material as usize,
            id: list.id[i] as u32,
            body: list.body[i],
            cell: list.cell[i],
            offset: list.offset[i],
            motion: std::array::from_fn(|p| if p < 3 { v[p] } else { c[p - 3] }),
            rest: [0.0; STRAIN + 9 + MAX_STATE],
        };
        let planes = [&list.mass, &list.volume0].into_iter().chain(&list.strain).chain(&list.state);
        for (value, plane) in parcel.rest.iter_mut().zip(planes) {
            *value = plane[i];
        }
        parcel
    }

    /// Adds particles to a list of their material, plane by plane.
    pub fn add_all(parcels: &[&Self], list: &mut ParticleList) {
        rayon::scope(|scope| {
            let ParticleList { id, body, cell, offset, velocity, affine, mass, volume0, strain, state, .. } = list;
            let all = || parcels.iter();
            scope.spawn(move |_| id.extend(all().map(|parcel| u64::from(parcel.id))));
            scope.spawn(move |_| body.extend(all().map(|parcel| parcel.body)));
            scope.spawn(move |_| cell.extend(all().map(|parcel| parcel.cell)));
            scope.spawn(move |_| offset.extend(all().map(|parcel| parcel.offset)));
            scope.spawn(move |_| velocity.extend(all().map(|parcel| [0, 1, 2].map(|d| parcel.motion[d]))));
            let affine_of = |parcel: &&Self| std::array::from_fn(|p| parcel.motion[3 + p]);
            scope.spawn(move |_| affine.extend(all().map(affine_of)));
            for (k, plane) in [mass, volume0].into_iter().chain(strain).chain(state).enumerate() {
                scope.spawn(move |_| plane.extend(all().map(|parcel| parcel.rest[k])));
            }
        });
    }
}

/// A material's planes.
#[derive(Clone)]
pub(super) struct Material {
    pub(super) strain: usize,
    /// `BARCHAN_MERGE_*` rule of each history variable.
    pub(super) rules: Vec<u32>,
}

impl Material {
    /// Of a plan's.
    pub(super) fn of(planned: &PlannedMaterial) -> Self {
        Self {
            strain: planned.material.strain_planes(),
            rules: planned.material.states.iter().map(|state| state.merge).collect(),
        }
    }

    pub(super) fn planes(&self) -> Planes<'_> {
        Planes { is_gradient: self.strain == 9, merge: &self.rules }
    }

    /// A particle with its position relative to a cell of its level, of width `h` [m].
    pub(super) fn particle(&self, parcel: &Parcel, origin: [i32; 3], h: f64) -> Particle {
        let Self { strain: planes, rules } = self;
        let mut particle = Particle {
            x: Vector3::from_fn(|d, _| (f64::from(parcel.cell[d] - origin[d]) + parcel.offset[d]) * h),
            v: Vector3::from_column_slice(&parcel.motion[..3]),
            c: Matrix3::from_row_slice(&parcel.motion[3..]),
            mass: parcel.rest[MASS],
            volume0: parcel.rest[VOLUME],
            strain: [0.0; 9],
            state: [0.0; MAX_STATE],
        };
        particle.strain[..*planes].copy_from_slice(&parcel.rest[STRAIN..][..*planes]);
        particle.state[..rules.len()].copy_from_slice(&parcel.rest[STRAIN + planes..][..rules.len()]);
        particle
    }

    /// The other way round, with the number and body of another.
    pub(super) fn parcel(&self, p: &Particle, origin: [i32; 3], h: f64, like: &Parcel) -> Parcel {
        let Self { strain: planes, rules } = self;
        let mut parcel = like.clone();
        for d in 0..3 {
            let along = p.x[d] / h;
            parcel.cell[d] = origin[d] + along.floor() as i32;
            parcel.offset[d] = along - along.floor();
            parcel.motion[d] = p.v[d];
            for e in 0..3 {
                parcel.motion[3 + 3 * d + e] = p.c[(d, e)];
            }
        }
        parcel.rest[MASS] = p.mass;
        parcel.rest[VOLUME] = p.volume0;
        parcel.rest[STRAIN..][..*planes].copy_from_slice(&p.strain[..*planes]);
        parcel.rest[STRAIN + planes..][..rules.len()].copy_from_slice(&p.state[..rules.len()]);
        parcel
    }
}

/// A parcel with coordinates of level `from` in those of level `to`.
pub(super) fn moved(mut parcel: Parcel, from: usize, to: usize) -> Parcel {
    let finest = finest_cell(parcel.cell, parcel.offset, from);
    for d in 0..3 {
        // Shifts of cell and offset: exact but for the last bit of an offset that becomes coarser.
        let within = parcel.offset[d] * f64::from(1 << from) - f64::from(finest[d] - (parcel.cell[d] << from));
        let along = f64::from(finest[d] & ((1 << to) - 1)) + within;
        parcel.cell[d] = finest[d] >> to;
        parcel.offset[d] = along / f64::from(1 << to);
    }
    parcel
}

/// The finest level's cell that holds a particle.
pub(super) fn finest_cell(cell: [i32; 3], offset: [f64; 3], level: usize) -> [i32; 3] {
    std::array::from_fn(|d| {
        let within = (offset[d] * f64::from(1 << level)).floor() as i32;
        (cell[d] << level) + within.min((1 << level) - 1)
    })
}

/// A parcel as seen from a cell of a coarser level.
pub(super) fn coarsened(mut parcel: Parcel, from: usize, to: usize) -> Parcel {
    for d in 0..3 {
        let within = f64::from(parcel.cell[d] & ((1 << (to - from)) - 1)) + parcel.offset[d];
        parcel.cell[d] >>= to - from;
        parcel.offset[d] = within / f64::from(1 << (to - from));
    }
    parcel
}
