//! Quadratic B-splines.

use barchan_lanes::Real;

/// Weights of nodes c - 1, c, c + 1 for a particle at fraction `f` of cell c, along one axis. They sum to one.
///
/// # Source
/// Steffen, Kirby, Berzins 2008, with the nodes at cell centres.
#[inline(always)]
pub fn weights<V: Real>(f: V) -> [V; 3] {
    let half = V::splat(0.5);
    let left = V::one() - f;
    let middle = half - f;
    [half * left * left, (-middle).mul_add(middle, V::splat(0.75)), half * f * f]
}

/// Derivatives of the [`weights`] by `f`.
#[inline(always)]
pub fn slopes<V: Real>(f: V) -> [V; 3] {
    [f - V::one(), V::one() - f - f, f]
}

/// Distance in cells from a particle at fraction `f` of cell c to node c - 1; the next nodes are 1 and 2 cells further.
#[inline(always)]
pub fn first_distance<V: Real>(f: V) -> V {
    V::splat(-0.5) - f
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Partition of unity and first-order consistency are what linear momentum and affine fields rest on; faces, centres
    /// and the neighbourhood of both are where a wrong knot would show.
    #[test]
    fn weights_sum_to_one_and_reproduce_position() {
        for i in 0..=1000 {
            let f = f64::from(i) / 1000.0;
            let w = weights(f);
            let d = first_distance(f);
            assert!((w.iter().sum::<f64>() - 1.0).abs() < 4e-16);
            assert!(w.iter().all(|&w| w >= 0.0));
            let mean: f64 = (0..3).map(|i| w[i] * (d + i as f64)).sum();
            assert!(mean.abs() < 4e-16, "sum of w (x_i - x_p) is {mean}");
            let second: f64 = (0..3).map(|i| w[i] * (d + i as f64).powi(2)).sum();
            assert!((second - 0.25).abs() < 4e-16, "D is h^2/4, got {second} h^2");
        }
    }
}
