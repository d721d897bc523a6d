//! The transfers backwards, particle by particle, in f64: P2G and G2P change places.
//!
//! Of what a loss owes to the nodes' velocities, particles give to nodes what they read from them (the adjoint of G2P); of what it owes to the nodes' momentum
//! and mass, they read what they gave (that of P2G). Weights move along with particles, so that both also tell what the loss owes to where these are.
#![expect(non_snake_case, reason = "symbols follow Hu et al. 2018")]

use crate::spline::{first_distance, slopes, weights};

/// Nodes around a particle.
pub const AROUND: usize = 27;

/// A particle's place among the nodes around it, z fastest.
#[derive(Clone, Copy, Debug)]
pub struct Stencil {
    weights: [[f64; 3]; 3],
    /// Derivatives of the weights by the place [1/m].
    slopes: [[f64; 3]; 3],
    /// Distance to the first node [cells].
    first: [f64; 3],
}

/// A quantity of a particle that grows along each axis with the distance from it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Affine {
    /// At the particle.
    pub at: [f64; 3],
    /// Row by row.
    pub rows: [f64; 9],
}

/// One of the nodes around a particle, as this sees it.
#[derive(Clone, Copy)]
struct Seen {
    /// Its weight, and the weight's derivative by the particle's place [1/m].
    weight: f64,
    slope: [f64; 3],
    /// The way to it [cells].
    way: [f64; 3],
    /// What an affine quantity comes to there.
    value: [f64; 3],
}

impl Stencil {
    /// Of a particle at fraction `f` of its cell, with cells of width `h` [m].
    pub fn new(f: [f64; 3], h: f64) -> Self {
        Self {
            weights: f.map(weights),
            slopes: f.map(|f| slopes(f).map(|slope| slope / h)),
            first: f.map(first_distance),
        }
    }

    /// Shows the nodes around the particle, z fastest, and what an affine quantity of it comes to there.
    #[inline(always)]
    fn each(&self, quantity: &Affine, mut see: impl FnMut(usize, Seen)) {
        let [x, y, z] = self.weights;
        let [dx, dy, dz] = self.slopes;
        let way = |d: usize, i: usize| self.first[d] + i as f64;
        let grown = |from: [f64; 3], d: usize, i: usize| -> [f64; 3] {
            [0, 1, 2].map(|c| from[c] + quantity.rows[3 * c + d] * way(d, i))
        };
        for i in 0..3 {
            let of_x = grown(quantity.at, 0, i);
            for j in 0..3 {
                let (xy, of_xy) = (x[i] * y[j], grown(of_x, 1, j));
                let (slope_x, slope_y) = (dx[i] * y[j], x[i] * dy[j]);
                for k in 0..3 {
                    let seen = Seen {
                        weight: xy * z[k],
                        slope: [slope_x * z[k], slope_y * z[k], xy * dz[k]],
                        way: [way(0, i), way(1, j), way(2, k)],
                        value: grown(of_xy, 2, k),
                    };
                    see(9 * i + 3 * j + k, seen);
                }
            }
        }
    }

    /// P2G: gives each node around the particle momentum and mass, of `momentum` that grows by so much a cell, and `mass`.
    #[inline(always)]
    pub fn scatter(&self, momentum: &Affine, mass: f64, mut give: impl FnMut(usize, [f64; 4])) {
        self.each(momentum, |n, Seen { weight, value: [x, y, z], .. }| {
            give(n, [weight * x, weight * y, weight * z, weight * mass]);
        });
    }

    /// The adjoint of [`scatter`](Self::scatter): from cotangents of the nodes' momentum and mass to those of `momentum`, and of the particle's place [1/m].
    #[inline(always)]
    pub fn scatter_back(
        &self,
        h: f64,
        momentum: &Affine,
        mass: f64,
        cotangent: impl Fn(usize) -> [f64; 4],
    ) -> (Affine, [f64; 3]) {
        let (mut back, mut place) = (Affine::default(), [0.0; 3]);
        self.each(momentum, |n, Seen { weight, slope, way, value }| {
            let [x, y, z, m] = cotangent(n);
            let owed = x * value[0] + y * value[1] + z * value[2] + m * mass;
            let weighed = [weight * x, weight * y, weight * z];
            for i in 0..3 {
                back.at[i] += weighed[i];
                (0..3).for_each(|j| back.rows[3 * i + j] += weighed[i] * way[j]);
                place[i] += slope[i] * owed;
            }
        });
        // The way to a node becomes shorter as the particle moves there.
        for j in 0..3 {
            place[j] -= (0..3).map(|i| back.at[i] * momentum.rows[3 * i + j]).sum::<f64>() / h;
        }
        (back, place)
    }

    /// The adjoint of G2P: from cotangents of a particle's new velocity and of its new C to those of the nodes' velocities, which go to `give`, and of the place at which
    /// it reads these, `velocity` [1/m].
    #[inline(always)]
    pub fn gather_back(
        &self,
        h: f64,
        cotangent: &Affine,
        velocity: impl Fn(usize) -> [f64; 3],
        mut give: impl FnMut(usize, [f64; 3]),
    ) -> [f64; 3] {
        // C = 4/h Σ w u (way)ᵀ.
        let per_cell = Affine { at: cotangent.at, rows: cotangent.rows.map(|c| 4.0 / h * c) };
        let (mut place, mut read) = ([0.0; 3], [0.0; 3]);
        self.each(&per_cell, |n, Seen { weight, slope, value, .. }| {
            let u = velocity(n);
            give(n, [weight * value[0], weight * value[1], weight * value[2]]);
            let owed = u[0] * value[0] + u[1] * value[1] + u[2] * value[2];
            for d in 0..3 {
                place[d] += slope[d] * owed;
                read[d] += weight * u[d];
            }
        });
        for j in 0..3 {
            place[j] -= (0..3).map(|i| read[i] * per_cell.rows[3 * i + j]).sum::<f64>() / h;
        }
        place
    }
}

/// The adjoint of [`deformed`](super::deformed): adds to the cotangent of G, and returns that of the strain, as many planes as there are.
pub fn deformed_back(G: &[f64; 9], strain: &[f64], trial: &[f64], of_G: &mut [f64; 9]) -> [f64; 9] {
    let M: [f64; 9] = std::array::from_fn(|e| G[e] + if e % 4 == 0 { 1.0 } else { 0.0 });
    let mut of_strain = [0.0; 9];
    let product = |a: &[f64; 9], b: &[f64; 9]| -> [f64; 9] {
        std::array::from_fn(|e| (0..3).map(|k| a[e / 3 * 3 + k] * b[3 * k + e % 3]).sum())
    };
    let transposed = |a: &[f64; 9]| -> [f64; 9] { std::array::from_fn(|e| a[e % 3 * 3 + e / 3]) };
    if let (Some(F), Some(T)) = (strain.first_chunk::<9>(), trial.first_chunk::<9>()) {
        // T = M F.
        product(T, &transposed(F)).iter().zip(of_G).for_each(|(x, sum)| *sum += x);
        return product(&transposed(&M), T);
    }
    // T = M b Mᵀ. A plane off the diagonal stands for two entries.
    let full = |planes: &[f64], off: f64| {
        let [xx, yy, zz, xy, xz, yz] = std::array::from_fn(|p| planes[p] * if p < 3 { 1.0 } else { off });
        [xx, xy, xz, xy, yy, yz, xz, yz, zz]
    };
    let (b, T) = (full(strain, 1.0), full(trial, 0.5));
    let TM = product(&T, &M);
    product(&TM, &b).iter().zip(of_G).for_each(|(x, sum)| *sum += 2.0 * x);
    let back = product(&transposed(&M), &TM);
    let places = [0, 4, 8, 1, 2, 5];
    for (p, (to, from)) in of_strain.iter_mut().zip(places).enumerate() {
        *to = back[from] * if p < 3 { 1.0 } else { 2.0 };
    }
    of_strain
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transfer::deformed;

    /// Numbers without a pattern.
    fn some<const N: usize>(seed: u64) -> [f64; N] {
        std::array::from_fn(|i| ((seed + i as u64) as f64 * 12.9898).sin() * 0.7)
    }

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(x, y)| x * y).sum()
    }

    /// Derivative of `f` along `along`, to the fourth order of the step.
    fn slope<const N: usize>(f: impl Fn([f64; N]) -> f64, at: [f64; N], along: [f64; N]) -> f64 {
        let step = 1e-3;
        let moved = |by: f64| f(std::array::from_fn(|i| at[i] + by * step * along[i]));
        (8.0 * (moved(1.0) - moved(-1.0)) - (moved(2.0) - moved(-2.0))) / (12.0 * step)
    }

    #[test]
    fn what_particles_give_has_its_adjoint() {
        let (h, f) = (0.3, [0.2, 0.55, 0.9]);
        let cotangents: [[f64; 4]; AROUND] = std::array::from_fn(|n| some(100 + 7 * n as u64));
        // Place, velocity and rows.
        let mass = 0.8;
        let loss = |x: [f64; 15]| {
            let momentum = Affine { at: [x[3], x[4], x[5]], rows: std::array::from_fn(|e| x[6 + e]) };
            let place = std::array::from_fn(|d| f[d] + x[d] / h);
            let mut sum = 0.0;
            Stencil::new(place, h).scatter(&momentum, mass, |n, given| sum += dot(&given, &cotangents[n]));
            sum
        };
        let mut at: [f64; 15] = some(1);
        at[..3].fill(0.0);
        let momentum = Affine { at: [at[3], at[4], at[5]], rows: std::array::from_fn(|e| at[6 + e]) };
        let (back, place) = Stencil::new(f, h).scatter_back(h, &momentum, mass, |n| cotangents[n]);
        let along: [f64; 15] = some(50);
        let given = dot(&place, &along[..3]) + dot(&back.at, &along[3..6]) + dot(&back.rows, &along[6..15]);
        let found = slope(loss, at, along);
        assert!((given - found).abs() < 1e-9 * found.abs().max(1.0), "{given} {found}");
    }

    #[test]
    fn what_particles_read_has_its_adjoint() {
        let (h, f) = (0.3, [0.7, 0.45, 0.1]);
        let velocities: [[f64; 3]; AROUND] = std::array::from_fn(|n| some(200 + 5 * n as u64));
        let changes: [[f64; 3]; AROUND] = std::array::from_fn(|n| some(300 + 5 * n as u64));
        let cotangent = Affine { at: some(3), rows: some(9) };
        let way: [f64; 3] = some(40);
        let loss = |x: [f64; 1]| {
            let stencil = Stencil::new(std::array::from_fn(|d| f[d] + x[0] * way[d] / h), h);
            let mut read = Affine::default();
            stencil.each(&Affine::default(), |n, Seen { weight, way, .. }| {
                for i in 0..3 {
                    let u = velocities[n][i] + x[0] * changes[n][i];
                    read.at[i] += weight * u;
                    (0..3).for_each(|j| read.rows[3 * i + j] += 4.0 / h * weight * u * way[j]);
                }
            });
            dot(&read.at, &cotangent.at) + dot(&read.rows, &cotangent.rows)
        };
        let mut owed = 0.0;
        let place = Stencil::new(f, h).gather_back(
            h,
            &cotangent,
            |n| velocities[n],
            |n, given| owed += dot(&given, &changes[n]),
        );
        let (given, found) = (owed + dot(&place, &way), slope(loss, [0.0], [1.0]));
        assert!((given - found).abs() < 1e-9 * found.abs().max(1.0), "{given} {found}");
    }

    #[test]
    fn what_motion_makes_of_strain_has_its_adjoint() {
        for planes in [6, 9] {
            let cotangent: [f64; 9] = some(60);
            let loss = |x: [f64; 18]| {
                let G: [f64; 9] = std::array::from_fn(|e| x[e]);
                dot(&deformed(&G, &x[9..9 + planes])[..planes], &cotangent)
            };
            let (at, along): ([f64; 18], [f64; 18]) = (some(70), some(90));
            let G: [f64; 9] = std::array::from_fn(|e| at[e]);
            let mut of_G = [0.0; 9];
            let of_strain = deformed_back(&G, &at[9..9 + planes], &cotangent[..planes], &mut of_G);
            let given = dot(&of_G, &along[..9]) + dot(&of_strain[..planes], &along[9..9 + planes]);
            let found = slope(loss, at, along);
            assert!((given - found).abs() < 1e-9 * found.abs().max(1.0), "{planes} planes: {given} {found}");
        }
    }
}
