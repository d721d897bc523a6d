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

/// What the nodes around a particle hold, z fastest: of each three numbers that belong to its directions, and one.
pub type Tile = [[f64; 4]; AROUND];

/// One of the nodes around a particle, as this sees it.
#[derive(Clone, Copy)]
struct Seen {
    /// Its weight, and the weight's derivative by the particle's place [1/m].
    weight: f64,
    slope: [f64; 3],
    /// The way to it [cells].
    way: [f64; 3],
    /// What an affine quantity comes to there, and a number that is the same everywhere.
    value: [f64; 4],
}

/// Adds a multiple. Four numbers are a register's.
#[inline(always)]
fn add(sum: &mut [f64; 4], factor: f64, four: &[f64; 4]) {
    for c in 0..4 {
        sum[c] += factor * four[c];
    }
}

/// Products, number by number.
#[inline(always)]
fn times(a: &[f64; 4], b: &[f64; 4]) -> [f64; 4] {
    std::array::from_fn(|c| a[c] * b[c])
}

impl Affine {
    /// Its columns.
    #[inline(always)]
    fn columns(&self) -> [[f64; 4]; 3] {
        [0, 1, 2].map(|d| [self.rows[d], self.rows[3 + d], self.rows[6 + d], 0.0])
    }
}

impl Stencil {
    /// Of a particle at fraction `f` of its cell, with cells of width `h` [m].
    #[inline(always)]
    pub fn new(f: [f64; 3], h: f64) -> Self {
        Self {
            weights: f.map(weights),
            slopes: f.map(|f| slopes(f).map(|slope| slope / h)),
            first: f.map(first_distance),
        }
    }

    /// Node `n` around the particle, and what an affine quantity of it comes to there, beside a constant.
    #[inline(always)]
    fn see(&self, quantity: &Affine, constant: f64, n: usize) -> Seen {
        let at = [n / 9, n / 3 % 3, n % 3];
        let way = [0, 1, 2].map(|d| self.first[d] + at[d] as f64);
        let [x, y, z] = [0, 1, 2].map(|d| self.weights[d][at[d]]);
        let [dx, dy, dz] = [0, 1, 2].map(|d| self.slopes[d][at[d]]);
        let columns = quantity.columns();
        let mut value = [quantity.at[0], quantity.at[1], quantity.at[2], constant];
        (0..3).for_each(|d| add(&mut value, way[d], &columns[d]));
        Seen { weight: x * y * z, slope: [dx * y * z, x * dy * z, x * y * dz], way, value }
    }

    /// P2G: adds to each node around the particle momentum and mass, of `momentum` that grows by so much a cell, and `mass`.
    #[inline(always)]
    pub fn scatter(&self, momentum: &Affine, mass: f64, tile: &mut Tile) {
        for (n, node) in tile.iter_mut().enumerate() {
            let Seen { weight, value, .. } = self.see(momentum, mass, n);
            add(node, weight, &value);
        }
    }

    /// The adjoint of [`scatter`](Self::scatter): from cotangents of the nodes' momentum and mass to those of `momentum`, and of the particle's place [1/m].
    #[inline(always)]
    pub fn scatter_back(&self, h: f64, momentum: &Affine, mass: f64, tile: &Tile) -> (Affine, [f64; 3]) {
        let (mut at, mut columns, mut moved) = ([0.0; 4], [[0.0; 4]; 3], [[0.0; 4]; 3]);
        for (n, node) in tile.iter().enumerate() {
            let Seen { weight, slope, way, value } = self.see(momentum, mass, n);
            let weighed = node.map(|owed| weight * owed);
            let owed = times(node, &value);
            add(&mut at, 1.0, &weighed);
            for d in 0..3 {
                add(&mut columns[d], way[d], &weighed);
                add(&mut moved[d], slope[d], &owed);
            }
        }
        let back = Affine { at: [at[0], at[1], at[2]], rows: std::array::from_fn(|e| columns[e % 3][e / 3]) };
        // The way to a node becomes shorter as the particle moves there.
        let place = std::array::from_fn(|d| {
            let shorter: f64 = (0..3).map(|i| back.at[i] * momentum.rows[3 * i + d]).sum();
            moved[d].iter().sum::<f64>() - shorter / h
        });
        (back, place)
    }

    /// The adjoint of G2P: from cotangents of a particle's new velocity and of its new C to those of the nodes' velocities, which are added to `owed`, and of the place at which
    /// it reads these, `velocities` [1/m].
    #[inline(always)]
    pub fn gather_back(&self, h: f64, cotangent: &Affine, velocities: &Tile, owed: &mut Tile) -> [f64; 3] {
        // C = 4/h Σ w u (way)ᵀ.
        let per_cell = Affine { at: cotangent.at, rows: cotangent.rows.map(|c| 4.0 / h * c) };
        let (mut moved, mut read) = ([[0.0; 4]; 3], [0.0; 4]);
        for (n, (node, owed)) in velocities.iter().zip(owed).enumerate() {
            let Seen { weight, slope, value, .. } = self.see(&per_cell, 0.0, n);
            add(owed, weight, &value);
            add(&mut read, weight, node);
            let along = times(node, &value);
            for d in 0..3 {
                add(&mut moved[d], slope[d], &along);
            }
        }
        std::array::from_fn(|d| {
            let shorter: f64 = (0..3).map(|i| read[i] * per_cell.rows[3 * i + d]).sum();
            moved[d].iter().sum::<f64>() - shorter / h
        })
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
        let cotangents: Tile = std::array::from_fn(|n| some(100 + 7 * n as u64));
        // Place, velocity and rows.
        let mass = 0.8;
        let loss = |x: [f64; 15]| {
            let momentum = Affine { at: [x[3], x[4], x[5]], rows: std::array::from_fn(|e| x[6 + e]) };
            let place = std::array::from_fn(|d| f[d] + x[d] / h);
            let mut tile = [[0.0; 4]; AROUND];
            Stencil::new(place, h).scatter(&momentum, mass, &mut tile);
            dot(tile.as_flattened(), cotangents.as_flattened())
        };
        let mut at: [f64; 15] = some(1);
        at[..3].fill(0.0);
        let momentum = Affine { at: [at[3], at[4], at[5]], rows: std::array::from_fn(|e| at[6 + e]) };
        let (back, place) = Stencil::new(f, h).scatter_back(h, &momentum, mass, &cotangents);
        let along: [f64; 15] = some(50);
        let given = dot(&place, &along[..3]) + dot(&back.at, &along[3..6]) + dot(&back.rows, &along[6..15]);
        let found = slope(loss, at, along);
        assert!((given - found).abs() < 1e-9 * found.abs().max(1.0), "{given} {found}");
    }

    #[test]
    fn what_particles_read_has_its_adjoint() {
        let (h, f) = (0.3, [0.7, 0.45, 0.1]);
        let velocities: Tile = std::array::from_fn(|n| some(200 + 5 * n as u64));
        let changes: Tile = std::array::from_fn(|n| some(300 + 5 * n as u64));
        let cotangent = Affine { at: some(3), rows: some(9) };
        let way: [f64; 3] = some(40);
        let loss = |x: [f64; 1]| {
            let stencil = Stencil::new(std::array::from_fn(|d| f[d] + x[0] * way[d] / h), h);
            let mut read = Affine::default();
            for n in 0..AROUND {
                let Seen { weight, way, .. } = stencil.see(&Affine::default(), 0.0, n);
                for i in 0..3 {
                    let u = velocities[n][i] + x[0] * changes[n][i];
                    read.at[i] += weight * u;
                    (0..3).for_each(|j| read.rows[3 * i + j] += 4.0 / h * weight * u * way[j]);
                }
            }
            dot(&read.at, &cotangent.at) + dot(&read.rows, &cotangent.rows)
        };
        let mut owed = [[0.0; 4]; AROUND];
        let place = Stencil::new(f, h).gather_back(h, &cotangent, &velocities, &mut owed);
        let owed = dot(owed.as_flattened(), changes.as_flattened());
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
