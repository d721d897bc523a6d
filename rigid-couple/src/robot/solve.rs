//! Rates that balance: of a robot alone, or of robots that touch one another.

use super::dynamics::Place;
use barchan_core::contact::{Search, System};
use glam::DVec3;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Iterations after which rates are taken as they are, and the size of the last step at convergence, relative to the speed of the whole.
const MAX_ITERATIONS: usize = 40;
const TOLERANCE: f64 = 1e-10;
/// Weight of contact points in the robots' at which the iteration starts, and the factor by which it grows once the last step was relatively small.
const LIGHT: f64 = 10.0;
const HEAVIER: f64 = 4.0;
const SMALL: f64 = 0.03;

/// What is out of balance at some rates, and by how much it falls for each unit of them.
pub(super) struct Balance {
    pub residual: DVector<f64>,
    pub matrix: DMatrix<f64>,
}

/// Rates that balance.
pub(super) struct Balanced {
    pub rates: DVector<f64>,
    /// Has the iteration found them, or has it only come near?
    pub converged: bool,
}

/// What is solved as one in a step.
pub(super) trait Whole {
    /// Its mass matrix.
    fn mass_matrix(&self) -> &DMatrix<f64>;
    /// What no iteration changes: M v₀ + dt (gravity − bias).
    fn driven(&self) -> &DVector<f64>;
    /// Rates before the step.
    fn before(&self) -> &DVector<f64>;
    /// Its mass [kg].
    fn mass(&self) -> f64;
    /// The mass of all contact points [kg]; 0 if there is none.
    fn points(&self) -> f64;
    /// What joints and rigid contacts give at some rates, and by how much that falls; with contact points of `weight`, and their secant if `tangent` is not asked for.
    fn own_impulses(&self, rates: &DVector<f64>, weight: f64, tangent: bool) -> Balance;
    /// What rounding leaves out of balance after a step of the secant's from `rates`, where that matters.
    fn left(&self, rates: &DVector<f64>, weight: f64, step: &DVector<f64>) -> Option<DVector<f64>> {
        let _ = (rates, weight, step);
        None
    }

    /// Rates that balance without soft ground, by Newton's method, as [`barchan_core::contact`] solves: contact points first count as lighter than they are, which
    /// finds those that touch; how far a step goes is [`Search`]'s to say; the last one takes the contact law as it is, which is dissipative even where
    /// the iteration has not converged.
    fn balance_alone(&self) -> Option<Balanced> {
        let (mass, driven, ground) = (self.mass_matrix(), self.driven(), self.points());
        if driven.is_empty() {
            // What stands still has nothing to balance.
            return Some(Balanced { rates: driven.clone(), converged: true });
        }
        let off_at = |rates: &DVector<f64>, own: &Balance| driven - mass * rates + &own.residual;
        let secant_step = |rates: &DVector<f64>, weight: f64| {
            let own = self.own_impulses(rates, weight, false);
            let factor = (mass + &own.matrix).cholesky()?;
            let step = factor.solve(&off_at(rates, &own));
            Some(mended(step, &factor, |step| self.left(rates, weight, step)))
        };
        let mut weight = if ground == 0.0 { 1.0 } else { (LIGHT * self.mass() / ground).min(1.0) };
        let mut rates = self.before().clone();
        let mut own = self.own_impulses(&rates, weight, true);
        let mut converged = false;
        for iteration in 1..=MAX_ITERATIONS {
            let off = off_at(&rates, &own);
            let newton = (mass + &own.matrix).lu().solve(&off).filter(|step| step.dot(&off) >= 0.0);
            let step = match newton {
                Some(step) => step,
                None => secant_step(&rates, weight)?,
            };
            let scale = energy(mass, &rates).max(energy(mass, self.before())).sqrt();
            let size = energy(mass, &step).sqrt();
            converged = weight == 1.0 && size <= TOLERANCE * scale;
            if converged || iteration == MAX_ITERATIONS {
                rates += if ground == 0.0 { step } else { secant_step(&rates, 1.0)? };
                break;
            }
            let part;
            (part, (rates, own)) = Search::along(step.dot(&off), |part| {
                let tried = &rates + part * &step;
                let own = self.own_impulses(&tried, weight, true);
                let left = step.dot(&off_at(&tried, &own));
                ((tried, own), left)
            });
            if part * size <= SMALL * scale && weight < 1.0 {
                weight = (HEAVIER * weight).min(1.0);
                own = self.own_impulses(&rates, weight, true);
            }
        }
        Some(Balanced { rates, converged })
    }
}

/// A step, and what it leaves out of balance solved for once more.
pub(super) fn mended(
    mut step: DVector<f64>,
    factor: &Cholesky<f64, Dyn>,
    left: impl FnOnce(&DVector<f64>) -> Option<DVector<f64>>,
) -> DVector<f64> {
    if let Some(left) = left(&step) {
        step += factor.solve(&left);
    }
    step
}

/// vᵀ M v.
pub(super) fn energy(mass: &DMatrix<f64>, rates: &DVector<f64>) -> f64 {
    rates.dot(&(mass * rates))
}

/// Adds what contact on a link gives the rates, and by how much that falls.
pub(super) fn add_system(place: &Place, system: &System, residual: &mut DVector<f64>, matrix: &mut DMatrix<f64>) {
    let [fx, fy, fz, tx, ty, tz] = system.impulse;
    place.add_wrench(DVec3::new(fx, fy, fz), DVec3::new(tx, ty, tz), residual);
    place.add_matrix(&system.matrix, matrix);
}
