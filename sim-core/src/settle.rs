//! Ground that starts at rest: the strain in which a material carries the weight above it.
//!
//! Particles are where the settled ground has them. Mass, place and rest volume are those of ground that is not
//! settled, and the Kirchhoff stress along z is the weight of the ground above. So forces on nodes cancel to rounding,
//! and nothing moves at the start except where side walls do not hold it. (With the Cauchy stress in its place the
//! ground would be out of balance by the compression itself. Shrinking each particle's rest volume instead would make
//! particles of one body unlike.)

use crate::batch::{Answer, Matter, Plane};
use crate::material::ErrorBuffer;
use crate::plan::PlannedMaterial;
use crate::{Error, Result};

/// Ground that would have to be pressed to less of its height is refused.
pub(crate) const LEAST_STRETCH: f64 = 0.5;
/// Particles that a material is asked for at once.
const BATCH: usize = 64;
/// The first compression tried; it is doubled until it is enough.
const FIRST: f64 = 1e-8;
/// Halvings of the compression's bracket: to a relative 1e-12.
const HALVINGS: u32 = 40;

/// Why ground cannot be settled.
pub(crate) enum Unsettled {
    /// The material fails, or lacks a callback.
    Error(Error),
    /// It does not carry this load [Pa].
    Load(f64),
}

/// Strain and history planes of a material that is pressed along z, held sideways, until it carries each of `loads` [Pa].
pub(crate) fn under(planned: &PlannedMaterial, loads: &[f64]) -> Result<Vec<Vec<f64>>, Unsettled> {
    // Most ground is flat: particles of a layer share their load.
    let mut different = loads.to_vec();
    different.sort_unstable_by(f64::total_cmp);
    different.dedup();
    let mut press = Press::new(planned);
    let mut solved: Vec<Vec<f64>> = vec![Vec::with_capacity(different.len()); press.planes()];
    for batch in different.chunks(BATCH) {
        press.solve(batch)?;
        for (plane, values) in solved.iter_mut().zip(press.strain.iter().chain(&press.state_out)) {
            plane.extend_from_slice(&values.0[..batch.len()]);
        }
    }
    let places: Vec<usize> = loads.iter().map(|load| different.partition_point(|other| other < load)).collect();
    Ok(solved.iter().map(|plane| places.iter().map(|&at| plane[at]).collect()).collect())
}

/// A material between two plates.
struct Press<'a> {
    planned: &'a PlannedMaterial,
    trial: Vec<Plane<f64, BATCH>>,
    state_in: Vec<Plane<f64, BATCH>>,
    strain: Vec<Plane<f64, BATCH>>,
    state_out: Vec<Plane<f64, BATCH>>,
    kirchhoff: [Plane<f64, BATCH>; 6],
}

impl<'a> Press<'a> {
    fn new(planned: &'a PlannedMaterial) -> Self {
        let material = &planned.material;
        let filled = |values: &[f64]| values.iter().map(|v| Plane([*v; BATCH])).collect::<Vec<_>>();
        let trial: Vec<Plane<f64, BATCH>> = filled(material.strain_identity());
        let state_in = filled(&material.states.iter().map(|s| s.initial).collect::<Vec<_>>());
        Self {
            planned,
            strain: trial.clone(),
            state_out: state_in.clone(),
            trial,
            state_in,
            kirchhoff: [Plane([0.0; BATCH]); 6],
        }
    }

    fn without_update(&self) -> Error {
        let material = &self.planned.material;
        Error::Missing {
            kind: "material",
            name: material.name.clone(),
            origin: material.origin.clone(),
            what: "update_f64".to_owned(),
            why: "a body is settled, which asks for exact stress".to_owned(),
            mend: "leave settled out, or add the callback to the plugin".to_owned(),
        }
    }

    fn planes(&self) -> usize {
        self.strain.len() + self.state_out.len()
    }

    /// Finds the strains that carry so many loads at once.
    fn solve(&mut self, loads: &[f64]) -> Result<(), Unsettled> {
        let n = loads.len();
        let mut enough = vec![FIRST; n];
        loop {
            let carried = self.pressure(&enough)?;
            let mut all = true;
            for i in 0..n {
                // NaN is no support either.
                if carried[i] >= loads[i] {
                    continue;
                }
                all = false;
                enough[i] *= 2.0;
                if enough[i] > -LEAST_STRETCH.ln() {
                    return Err(Unsettled::Load(loads[i]));
                }
            }
            if all {
                break;
            }
        }
        let mut little: Vec<f64> = enough.iter().map(|e| if *e == FIRST { 0.0 } else { 0.5 * e }).collect();
        for _ in 0..HALVINGS {
            let middle: Vec<f64> = little.iter().zip(&enough).map(|(a, b)| 0.5 * (a + b)).collect();
            let carried = self.pressure(&middle)?;
            for i in 0..n {
                *(if carried[i] >= loads[i] { &mut enough[i] } else { &mut little[i] }) = middle[i];
            }
        }
        // Without a load there is no strain, not even a little.
        enough.iter_mut().zip(loads).filter(|(_, load)| **load <= 0.0).for_each(|(e, _)| *e = 0.0);
        self.pressure(&enough)?;
        Ok(())
    }

    /// Pressure along z at so many compressions, which are minus the logarithms of the stretch [Pa]. Strain and history that go
    /// with it are left in the planes.
    fn pressure(&mut self, compressions: &[f64]) -> Result<Vec<f64>, Unsettled> {
        let n = compressions.len();
        let is_gradient = self.trial.len() == 9;
        let zz = if is_gradient { 8 } else { 2 };
        for (place, e) in self.trial[zz].0.iter_mut().zip(compressions) {
            *place = (-if is_gradient { *e } else { 2.0 * e }).exp();
        }
        let material = &self.planned.material;
        let parameters = &self.planned.parameters;
        let trial = Matter { count: n, parameters, strain: &self.trial, state: &self.state_in };
        let answer = Answer { strain: &mut self.strain, kirchhoff: &mut self.kirchhoff, state: &mut self.state_out };
        let mut buffer = ErrorBuffer::default();
        let status = material.update(&trial, None, answer, &mut buffer);
        let status = status.ok_or_else(|| Unsettled::Error(self.without_update()))?;
        buffer.check(status, material, "update_f64", |_| u64::MAX).map_err(Unsettled::Error)?;
        Ok(self.kirchhoff[2].0[..n].iter().map(|tau| -tau).collect())
    }
}
