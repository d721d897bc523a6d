//! What every backend sums over particles on the host, and how it names those that are not finite.

use crate::batch::{Matter, Plane};
use crate::ledger::Ledger;
use crate::material::ErrorBuffer;
use crate::plan::PlannedMaterial;
use crate::{Error, Vec3};
use barchan_abi as abi;

/// Particles that a material is asked about at once.
pub const BATCH: usize = 64;

/// Kinetic energy of a particle and of what its affine matrix carries, in cells `h` wide [J].
pub fn kinetic(mass: f64, velocity: &[f64], affine: &[f64], h: f64) -> f64 {
    let square = |values: &[f64]| values.iter().map(|y| y * y).sum::<f64>();
    0.5 * mass * (square(velocity) + 0.25 * h * h * square(affine))
}

/// Adds a particle's mass, momenta, kinetic and potential energy. `h`: cell width [m]; `affine` is row-major [1/s].
pub fn add_particle(
    ledger: &mut Ledger,
    (mass, position): (f64, Vec3),
    (velocity, affine): (&[f64], &[f64]),
    h: f64,
    gravity: Vec3,
) {
    let (m, x, v, c) = (mass, position, velocity, affine);
    let quarter = 0.25 * h * h;
    ledger.particles += 1;
    ledger.mass += m;
    for d in 0..3 {
        let (a, b) = ((d + 1) % 3, (d + 2) % 3);
        ledger.momentum[d] += m * v[d];
        // x × v, and the spin that C carries about the particle.
        ledger.angular_momentum[d] += m * (x[a] * v[b] - x[b] * v[a] + quarter * (c[3 * b + a] - c[3 * a + b]));
        ledger.potential -= m * gravity[d] * x[d];
    }
    ledger.kinetic += kinetic(m, v, c, h);
}

/// Elastic energy and counts of the particles of one material, batch by batch.
#[derive(Debug)]
pub struct MaterialSums<'a> {
    planned: &'a PlannedMaterial,
    counts: [u64; abi::BARCHAN_N_COUNTERS],
}

impl<'a> MaterialSums<'a> {
    /// None so far. The ledger's elastic energy is NaN if the material gives none.
    pub fn new(planned: &'a PlannedMaterial, ledger: &mut Ledger) -> Self {
        if planned.material.table.energy_f64.is_none() {
            ledger.elastic = f64::NAN;
        }
        Self { planned, counts: [0; abi::BARCHAN_N_COUNTERS] }
    }

    /// Adds the first particles of some planes of strain and history, as many as there are rest volumes [m³].
    pub fn add(
        &mut self,
        ledger: &mut Ledger,
        strain: &[Plane<f64, BATCH>],
        state: &[Plane<f64, BATCH>],
        volume0: &[f64],
    ) {
        let law = &self.planned.material;
        let matter = Matter { count: volume0.len(), parameters: &self.planned.parameters, strain, state };
        let (mut energy, mut message) = (Plane::default(), ErrorBuffer::default());
        if let Some(status) = law.energy(&matter, &mut energy, &mut message) {
            for (e, volume) in energy.0.iter().zip(volume0) {
                ledger.elastic += if status == abi::BARCHAN_OK { e * volume } else { f64::NAN };
            }
        }
        let mut here = [0; abi::BARCHAN_N_COUNTERS];
        if law.counts(&matter, &mut here, &mut message) == Some(abi::BARCHAN_OK) {
            self.counts.iter_mut().zip(here).for_each(|(sum, count)| *sum += count);
        }
    }

    /// Writes the counts.
    pub fn end(self, ledger: &mut Ledger) {
        for (what, index) in [
            ("yielding", abi::BARCHAN_COUNT_YIELDING),
            ("stress-free at the apex", abi::BARCHAN_COUNT_APEX),
            ("with a floored stretch", abi::BARCHAN_COUNT_FLOORED),
            ("with a clamped state", abi::BARCHAN_COUNT_CLAMPED),
        ] {
            ledger.count(&format!("{} particles {what} now", self.planned.name), self.counts[index]);
        }
    }
}

/// The search for NaN and infinity among particles: how many have any, and the one of least number.
#[derive(Clone, Debug, Default)]
pub struct NonFinite {
    first: Option<(u64, &'static str, usize, f64)>,
    count: u64,
}

impl NonFinite {
    /// Looks at a particle of a material: velocity and affine matrix, then mass, rest volume, strain (so many values) and history.
    pub fn see(
        &mut self,
        (id, material): (u64, usize),
        (velocity, affine): (&[f64], &[f64]),
        rest: impl Iterator<Item = f64>,
        strain_planes: usize,
    ) {
        let named = |name: &'static str| move |value: &f64| (name, *value);
        let moves = velocity.iter().map(named("velocity")).chain(affine.iter().map(named("affine")));
        let field = |i: usize| match i {
            0 => "mass",
            1 => "volume0",
            i if i < 2 + strain_planes => "strain",
            _ => "history",
        };
        let rest = rest.enumerate().map(|(i, value)| (field(i), value));
        if let Some((field, value)) = moves.chain(rest).find(|(_, value)| !value.is_finite()) {
            self.count += 1;
            if self.first.is_none_or(|first| id < first.0) {
                self.first = Some((id, field, material, value));
            }
        }
    }

    /// Was there any?
    pub fn any(&self) -> bool {
        self.count > 0
    }

    /// The error that says so, if there was any, found before step number `step` and at a time [s].
    pub fn error(&self, step: u64, time: f64, materials: &[PlannedMaterial]) -> Option<Error> {
        self.first.map(|(particle, field, material, value)| Error::NonFinite {
            step,
            time,
            field,
            particle,
            list: materials[material].label(),
            value,
            count: self.count,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_particle_of_least_number_is_named_with_its_first_field() {
        let mut search = NonFinite::default();
        let still = [0.0; 9];
        let mut see = |id, velocity: [f64; 3], rest: &[f64]| {
            search.see((id, 0), (&velocity, &still), rest.iter().copied(), 6);
        };
        see(7, [0.0, f64::NAN, 0.0], &[f64::NAN; 9]);
        see(3, [0.0; 3], &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, f64::INFINITY, f64::NAN]);
        see(5, [0.0; 3], &[1.0, f64::NAN]);
        see(1, [0.0; 3], &[1.0; 9]);
        assert_eq!((search.first, search.count), (Some((3, "strain", 0, f64::INFINITY)), 3));
    }
}
