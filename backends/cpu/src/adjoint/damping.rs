//! Damping of materials backwards: the stress λ tr(D) I + 2 μ D of the elastic part D of the rate of strain, as `barchan_grid::transfer` has it.

use super::parameter_slopes;
use barchan_core::plan::PlannedMaterial;
use barchan_core::stiffness::{Damping, Stiffness};
use barchan_core::{Plan, Result};
use barchan_grid::transfer::ENTRIES;

/// How a material's damping changes with each of its parameters.
pub(super) type Slopes = Vec<Damping>;

/// What damping sees of a particle: G = dt C, and strain before and after flow, as planes of the law's kind.
pub(super) struct Seen<'a> {
    pub(super) dt: f64,
    pub(super) rates: [f64; 9],
    pub(super) trial: &'a [f64],
    pub(super) strain: &'a [f64],
}

/// What is owed to that, and to the damping.
pub(super) struct Owed {
    pub(super) rates: [f64; 9],
    pub(super) trial: [f64; 9],
    pub(super) strain: [f64; 9],
    pub(super) damping: Damping,
}

/// b of strain planes, and backwards what is owed to these.
fn left_cauchy_green(strain: &[f64]) -> [f64; 6] {
    match strain.first_chunk::<9>() {
        Some(f) => ENTRIES.map(|(i, j)| (0..3).map(|k| f[3 * i + k] * f[3 * j + k]).sum()),
        None => std::array::from_fn(|e| strain[e]),
    }
}

fn left_cauchy_green_back(strain: &[f64], owed: [f64; 6]) -> [f64; 9] {
    let mut back = [0.0; 9];
    match strain.first_chunk::<9>() {
        Some(f) => {
            for ((i, j), owed) in ENTRIES.into_iter().zip(owed) {
                for k in 0..3 {
                    back[3 * i + k] += owed * f[3 * j + k];
                    back[3 * j + k] += owed * f[3 * i + k];
                }
            }
        }
        None => back[..6].copy_from_slice(&owed),
    }
    back
}

impl Seen<'_> {
    /// D, from 2 dt D = G + Gᵀ + G Gᵀ − m (b* − b) with m = 3 / tr b, and b, b* and m.
    fn elastic_rate(&self) -> ([f64; 6], [[f64; 6]; 2], f64) {
        let (g, b, trial) = (&self.rates, left_cauchy_green(self.strain), left_cauchy_green(self.trial));
        let flow = 3.0 / (b[0] + b[1] + b[2]);
        let rate = std::array::from_fn(|e| {
            let (i, j) = ENTRIES[e];
            let square: f64 = (0..3).map(|k| g[3 * i + k] * g[3 * j + k]).sum();
            0.5 / self.dt * (g[3 * i + j] + g[3 * j + i] + square + flow * (b[e] - trial[e]))
        });
        (rate, [b, trial], flow)
    }

    /// The Kirchhoff stress that damping adds.
    pub(super) fn stress(&self, damping: Damping) -> [f64; 6] {
        let (rate, ..) = self.elastic_rate();
        let pressure = damping.lambda * (rate[0] + rate[1] + rate[2]);
        std::array::from_fn(|e| 2.0 * damping.mu * rate[e] + if e < 3 { pressure } else { 0.0 })
    }

    /// The adjoint of that.
    pub(super) fn stress_back(&self, damping: Damping, owed: [f64; 6]) -> Owed {
        let (rate, [b, trial], flow) = self.elastic_rate();
        let (swelling, of_pressure) = (rate[0] + rate[1] + rate[2], owed[0] + owed[1] + owed[2]);
        let of_damping =
            Damping { lambda: swelling * of_pressure, mu: 2.0 * (0..6).map(|e| rate[e] * owed[e]).sum::<f64>() };
        let of_twice: [f64; 6] = std::array::from_fn(|e| {
            let pressure = if e < 3 { damping.lambda * of_pressure } else { 0.0 };
            0.5 / self.dt * (2.0 * damping.mu * owed[e] + pressure)
        });
        let mut rates = [0.0; 9];
        for ((i, j), owed) in ENTRIES.into_iter().zip(of_twice) {
            rates[3 * i + j] += owed;
            rates[3 * j + i] += owed;
            for k in 0..3 {
                rates[3 * i + k] += owed * self.rates[3 * j + k];
                rates[3 * j + k] += owed * self.rates[3 * i + k];
            }
        }
        let of_flow: f64 = (0..6).map(|e| of_twice[e] * (b[e] - trial[e])).sum();
        let of_b: [f64; 6] =
            std::array::from_fn(|e| flow * of_twice[e] - if e < 3 { of_flow * flow * flow / 3.0 } else { 0.0 });
        Owed {
            rates,
            trial: left_cauchy_green_back(self.trial, of_twice.map(|owed| -flow * owed)),
            strain: left_cauchy_green_back(self.strain, of_b),
            damping: of_damping,
        }
    }
}

/// How the damping of each of a plan's materials changes with its parameters. Laws tell their moduli in f32, so that differences begin with long steps.
pub(super) fn slopes(plan: &Plan) -> Result<Vec<Slopes>> {
    let of_material = |planned: &PlannedMaterial| {
        let spec = plan.scene.material.iter().find(|spec| spec.name == planned.name);
        let Some(time) = spec.map(|spec| spec.damping).filter(|_| planned.damping.is_some()) else {
            return Ok(vec![Damping { lambda: 0.0, mu: 0.0 }; planned.parameters.len()]);
        };
        let damping = |parameters: &[f64]| {
            let changed = PlannedMaterial { damping: None, parameters: parameters.to_vec(), ..planned.clone() };
            // A parameter may stand where long steps make no material.
            let at_rest = Stiffness::of(&changed).and_then(|law| law.at_rest().ok());
            Ok(at_rest.map(|moduli| Damping::new(time, &moduli)).map(|Damping { lambda, mu }| [lambda, mu]))
        };
        let slopes = parameter_slopes(planned, (0.02, 8), damping)?.into_iter();
        Ok(slopes.map(|[lambda, mu]| Damping { lambda, mu }).collect())
    };
    plan.materials.iter().map(of_material).collect()
}
