//! Damping of materials backwards: the stress λ tr(D) I + 2 μ D of the elastic part D of the rate of strain, as `barchan_grid::transfer` has it.

use barchan_abi as abi;
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

/// How the damping of each of a plan's materials changes with its parameters, by differences to the fourth order: laws tell their moduli in f32, so of longer and longer steps the two are taken
/// that agree best.
pub(super) fn slopes(plan: &Plan) -> Result<Vec<Slopes>> {
    let none = Damping { lambda: 0.0, mu: 0.0 };
    let of_material = |planned: &PlannedMaterial| {
        let mut slopes = vec![none; planned.parameters.len()];
        let spec = plan.scene.material.iter().find(|spec| spec.name == planned.name);
        let Some(time) = spec.map(|spec| spec.damping).filter(|_| planned.damping.is_some()) else { return Ok(slopes) };
        for (i, slope) in slopes.iter_mut().enumerate() {
            if planned.material.parameters[i].flags & abi::BARCHAN_PARAM_DIFFERENTIABLE == 0 {
                continue;
            }
            let value = planned.parameters[i];
            let scale = if value == 0.0 { 1.0 } else { value.abs() };
            let at = |by: f64| {
                let mut changed = PlannedMaterial { damping: None, ..planned.clone() };
                changed.parameters[i] = value + by;
                let at_rest = Stiffness::of(&changed).map(|law| law.at_rest()).transpose();
                at_rest.map(|moduli| moduli.map_or([0.0; 2], |moduli| numbers(Damping::new(time, &moduli))))
            };
            let difference = |k: i32| -> Result<[f64; 2]> {
                let step = 0.02 * scale * 0.5f64.powi(k);
                let [a, b, c, d] = [at(step)?, at(-step)?, at(2.0 * step)?, at(-2.0 * step)?];
                Ok([0, 1].map(|n| (8.0 * (a[n] - b[n]) - (c[n] - d[n])) / (12.0 * step)))
            };
            // A parameter may stand where the longest steps make no material.
            let found: Vec<[f64; 2]> = (0..8).filter_map(|k| difference(k).ok()).collect();
            let apart = |pair: &[[f64; 2]]| (0..2).map(|n| (pair[0][n] - pair[1][n]).abs()).sum::<f64>();
            let best = found.windows(2).min_by(|a, b| apart(a).total_cmp(&apart(b)));
            if let Some([[lambda, mu], _]) = best {
                *slope = Damping { lambda: *lambda, mu: *mu };
            }
        }
        Ok(slopes)
    };
    plan.materials.iter().map(of_material).collect()
}

fn numbers(damping: Damping) -> [f64; 2] {
    [damping.lambda, damping.mu]
}
