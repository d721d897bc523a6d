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
    /// It does not carry this load with the pressure that is asked for sideways [Pa].
    Sides(f64),
}

/// Steps of Newton's method at most, and how near a solution is, in parts of the load. A law of Hencky needs one, others a few.
const MOST_ROUNDS: usize = 40;
const SOLVED: f64 = 1e-9;
const GOOD_ENOUGH: f64 = 1e-7;
/// By how much a compression is changed to see what that does, in parts of it.
const NUDGE: f64 = 1e-6;

/// Strain and history planes of a material that is pressed along z until it carries each of `loads` [Pa]: held sideways, or pressed there by `k0` of that.
pub(crate) fn under(planned: &PlannedMaterial, loads: &[f64], k0: Option<f64>) -> Result<Vec<Vec<f64>>, Unsettled> {
    // Most ground is flat: particles of a layer share their load.
    let mut different = loads.to_vec();
    different.sort_unstable_by(f64::total_cmp);
    different.dedup();
    let mut press = Press::new(planned);
    let mut solved: Vec<Vec<f64>> = vec![Vec::with_capacity(different.len()); press.planes()];
    for batch in different.chunks(BATCH) {
        match k0 {
            None => press.solve(batch)?,
            Some(k0) => press.solve_sides(batch, k0)?,
        }
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

    /// Finds the strains that carry so many loads at once, with `k0` of them along x and y: by Newton's method, since no bracket holds for all laws.
    fn solve_sides(&mut self, loads: &[f64], k0: f64) -> Result<(), Unsettled> {
        let most = -LEAST_STRETCH.ln();
        // Along z, and along x and y.
        let mut at: Vec<[f64; 2]> = loads.iter().map(|load| [if *load > 0.0 { FIRST } else { 0.0 }; 2]).collect();
        for round in 0.. {
            let missing: Vec<[f64; 2]> = {
                let carried = self.pressures(&at)?;
                carried.iter().zip(loads).map(|(p, load)| [p[0] - load, p[1] - k0 * load]).collect()
            };
            let is_near = |i: usize, off: f64| missing[i][0].abs() + missing[i][1].abs() <= off * loads[i];
            let open: Vec<usize> = (0..loads.len()).filter(|&i| loads[i] > 0.0 && !is_near(i, SOLVED)).collect();
            if open.is_empty() || round == MOST_ROUNDS {
                return match open.into_iter().find(|&i| !is_near(i, GOOD_ENOUGH)) {
                    Some(i) => Err(Unsettled::Sides(loads[i])),
                    None => Ok(()),
                };
            }
            let nudge = |at: &[f64; 2]| NUDGE * at[0].abs().max(at[1].abs()).max(FIRST);
            let mut slopes = Vec::with_capacity(2);
            for along in 0..2 {
                let mut nudged = at.clone();
                nudged.iter_mut().zip(&at).for_each(|(nudged, at)| nudged[along] += nudge(at));
                slopes.push(self.pressures(&nudged)?);
            }
            for i in open {
                let by = nudge(&at[i]);
                let slope = |of: usize, along: usize| {
                    let now = missing[i][of] + loads[i] * if of == 0 { 1.0 } else { k0 };
                    (slopes[along][i][of] - now) / by
                };
                let [[a, b], [c, d]] = [0, 1].map(|of| [0, 1].map(|along| slope(of, along)));
                let [r, s] = missing[i];
                let determinant = a * d - b * c;
                at[i][0] -= (d * r - b * s) / determinant;
                at[i][1] -= (a * s - c * r) / determinant;
                if !at[i].iter().all(|e| e.abs() <= most) {
                    return Err(Unsettled::Sides(loads[i]));
                }
            }
        }
        Ok(())
    }

    /// Pressure along z at so many compressions, which are minus the logarithms of the stretch [Pa]. Strain and history that go
    /// with it are left in the planes.
    fn pressure(&mut self, compressions: &[f64]) -> Result<Vec<f64>, Unsettled> {
        let upright: Vec<[f64; 2]> = compressions.iter().map(|e| [*e, 0.0]).collect();
        Ok(self.pressures(&upright)?.into_iter().map(|[upright, _]| upright).collect())
    }

    /// Pressure along z and along x [Pa], at compressions along z, and along x and y. Strain and history that go with it are left in the planes.
    fn pressures(&mut self, compressions: &[[f64; 2]]) -> Result<Vec<[f64; 2]>, Unsettled> {
        let n = compressions.len();
        let is_gradient = self.trial.len() == 9;
        let diagonal = if is_gradient { [0, 4, 8] } else { [0, 1, 2] };
        for (plane, along) in diagonal.into_iter().zip([1, 1, 0]) {
            for (place, e) in self.trial[plane].0.iter_mut().zip(compressions) {
                *place = (-if is_gradient { e[along] } else { 2.0 * e[along] }).exp();
            }
        }
        let material = &self.planned.material;
        let parameters = &self.planned.parameters;
        let trial = Matter { count: n, parameters, strain: &self.trial, state: &self.state_in };
        let answer = Answer { strain: &mut self.strain, kirchhoff: &mut self.kirchhoff, state: &mut self.state_out };
        let mut buffer = ErrorBuffer::default();
        let status = material.update(&trial, None, answer, &mut buffer);
        let status = status.ok_or_else(|| Unsettled::Error(self.without_update()))?;
        buffer.check(status, material, "update_f64", |_| u64::MAX).map_err(Unsettled::Error)?;
        Ok((0..n).map(|i| [2, 0].map(|plane| -self.kirchhoff[plane].0[i])).collect())
    }
}
