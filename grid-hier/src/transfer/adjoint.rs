//! The transfers backwards, in f64, as many particles at once as there are lanes: P2G and G2P change places.
//!
//! Of what a loss owes to the nodes' velocities, particles give to nodes what they read from them (the adjoint of G2P); of what it owes to the nodes' momentum
//! and mass, they read what they gave (that of P2G). Weights move along with particles, so that both also tell what the loss owes to where these are.
//!
//! Particles that are worked on together stand in one cell, so that they have the nodes around them in common.
#![expect(non_snake_case, reason = "symbols follow Hu et al. 2018")]

use crate::spline::{first_distance, slopes, weights};
use barchan_lanes::{CHUNK, Lanes, Real, tabulate};

/// Nodes around a particle.
pub const AROUND: usize = 27;

/// A particle's place among the nodes around it.
#[derive(Clone, Copy, Debug)]
pub struct Stencil<R> {
    weights: [[R; 3]; 3],
    /// Derivatives of the weights by the place [1/m].
    slopes: [[R; 3]; 3],
    /// Distance to the first node [cells].
    first: [R; 3],
}

/// A quantity of a particle that grows along each axis with the distance from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine<R> {
    /// At the particle.
    pub at: [R; 3],
    /// Row by row.
    pub rows: [R; 9],
}

/// What the nodes around a particle hold, z fastest: of each three numbers that belong to its directions, and one.
pub type Tile<R> = [[R; 4]; AROUND];

/// Sums over the nodes of a row along z, of which those over a plane are made, and of these those over all 27.
#[derive(Clone, Copy)]
struct Sums<R> {
    /// What they hold, weighed.
    node: [R; 4],
    /// The same of three, times the way to the node along each axis [cells].
    ways: [[R; 3]; 3],
    /// The product of what they hold with what an affine quantity comes to there, weighed.
    product: R,
    /// The same with the derivative of the weight along each axis [1/m].
    slopes: [R; 3],
}

/// Adds a multiple.
#[inline(always)]
fn add<R: Real, const N: usize>(sum: &mut [R; N], factor: R, other: &[R; N]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum = factor.mul_add(*other, *sum);
    }
}

#[inline(always)]
fn scaled<R: Real>([a, b, c]: [R; 3], factor: R) -> [R; 3] {
    [a * factor, b * factor, c * factor]
}

impl<R: Real> Affine<R> {
    /// Its column `d`.
    #[inline(always)]
    fn column(&self, d: usize) -> [R; 3] {
        [self.rows[d], self.rows[3 + d], self.rows[6 + d]]
    }
}

impl<R: Real> Sums<R> {
    #[inline(always)]
    fn none() -> Self {
        let zero = R::zero();
        Self { node: [zero; 4], ways: [[zero; 3]; 3], product: zero, slopes: [zero; 3] }
    }

    /// What is owed to the particle's place [1/m], of sums with `quantity`.
    #[inline(always)]
    fn moved(&self, h: f64, quantity: &Affine<R>) -> [R; 3] {
        let shorter = R::splat(-1.0 / h);
        // The way to a node becomes shorter as the particle moves there.
        tabulate!(3, |d| {
            let [a, b, c] = quantity.column(d);
            let along = a.mul_add(self.node[0], b.mul_add(self.node[1], c * self.node[2]));
            shorter.mul_add(along, self.slopes[d])
        })
    }
}

impl<R: Real> Stencil<R> {
    /// Of a particle at fraction `f` of its cell, with cells of width `h` [m].
    #[inline(always)]
    pub fn new(f: [R; 3], h: f64) -> Self {
        let per_cell = R::splat(1.0 / h);
        Self {
            weights: [weights(f[0]), weights(f[1]), weights(f[2])],
            slopes: [scaled(slopes(f[0]), per_cell), scaled(slopes(f[1]), per_cell), scaled(slopes(f[2]), per_cell)],
            first: tabulate!(3, |d| first_distance(f[d])),
        }
    }

    /// The way to node `i` along axis `d` [cells].
    #[inline(always)]
    fn way(&self, d: usize, i: usize) -> R {
        self.first[d] + R::splat(i as f64)
    }

    /// What an affine quantity comes to at the first node of row `i`, `j`.
    #[inline(always)]
    fn first_of_row(&self, quantity: &Affine<R>, i: usize, j: usize) -> [R; 3] {
        let mut value = quantity.at;
        add(&mut value, self.way(0, i), &quantity.column(0));
        add(&mut value, self.way(1, j), &quantity.column(1));
        add(&mut value, self.first[2], &quantity.column(2));
        value
    }

    /// P2G: adds to each node around the particle momentum and mass, of `momentum` that grows by so much a cell, and `mass`.
    #[inline(always)]
    pub fn scatter(&self, momentum: &Affine<R>, mass: R, tile: &mut Tile<R>) {
        for (row, nodes) in tile.chunks_exact_mut(3).enumerate() {
            let (i, j) = (row / 3, row % 3);
            let mut value = self.first_of_row(momentum, i, j);
            let weight = self.weights[0][i] * self.weights[1][j];
            for (k, node) in nodes.iter_mut().enumerate() {
                add(node, weight * self.weights[2][k], &[value[0], value[1], value[2], mass]);
                add(&mut value, R::one(), &momentum.column(2));
            }
        }
    }

    /// Sums over the nodes of `tile`, with what an affine quantity comes to there, beside a constant: weighed, the quantity is added to `owed` if that is given.
    #[inline(always)]
    fn sums(&self, tile: &Tile<f64>, quantity: &Affine<R>, constant: R, mut owed: Option<&mut Tile<R>>) -> Sums<R> {
        let mut all = Sums::none();
        for i in 0..3 {
            let mut plane = Sums::none();
            for j in 0..3 {
                let mut row = Sums::none();
                let mut value = self.first_of_row(quantity, i, j);
                let weight = self.weights[0][i] * self.weights[1][j];
                for k in 0..3 {
                    let n = 9 * i + 3 * j + k;
                    let [x, y, z, other] = tile[n];
                    let [x, y, z, other] = [R::splat(x), R::splat(y), R::splat(z), R::splat(other)];
                    let product = x.mul_add(value[0], y.mul_add(value[1], z.mul_add(value[2], other * constant)));
                    add(&mut row.node, self.weights[2][k], &[x, y, z, other]);
                    add(&mut row.ways[2], self.weights[2][k] * self.way(2, k), &[x, y, z]);
                    row.product = product.mul_add(self.weights[2][k], row.product);
                    row.slopes[2] = product.mul_add(self.slopes[2][k], row.slopes[2]);
                    if let Some(owed) = &mut owed {
                        let weight = weight * self.weights[2][k];
                        for (owed, value) in owed[n].iter_mut().zip(value) {
                            *owed = weight.mul_add(value, *owed);
                        }
                    }
                    add(&mut value, R::one(), &quantity.column(2));
                }
                let (weight, [x, y, z, _]) = (self.weights[1][j], row.node);
                add(&mut plane.node, weight, &row.node);
                add(&mut plane.ways[1], weight * self.way(1, j), &[x, y, z]);
                add(&mut plane.ways[2], weight, &row.ways[2]);
                plane.product = weight.mul_add(row.product, plane.product);
                plane.slopes[1] = self.slopes[1][j].mul_add(row.product, plane.slopes[1]);
                plane.slopes[2] = weight.mul_add(row.slopes[2], plane.slopes[2]);
            }
            let (weight, [x, y, z, _]) = (self.weights[0][i], plane.node);
            add(&mut all.node, weight, &plane.node);
            add(&mut all.ways[0], weight * self.way(0, i), &[x, y, z]);
            all.slopes[0] = self.slopes[0][i].mul_add(plane.product, all.slopes[0]);
            for d in 1..3 {
                add(&mut all.ways[d], weight, &plane.ways[d]);
                all.slopes[d] = weight.mul_add(plane.slopes[d], all.slopes[d]);
            }
        }
        all
    }

    /// The adjoint of [`scatter`](Self::scatter): from cotangents of the nodes' momentum and mass to those of `momentum`, and of the particle's place [1/m].
    #[inline(always)]
    pub fn scatter_back(&self, h: f64, momentum: &Affine<R>, mass: R, tile: &Tile<f64>) -> (Affine<R>, [R; 3]) {
        let sums = self.sums(tile, momentum, mass, None);
        let [x, y, z, _] = sums.node;
        let [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]] = sums.ways;
        (Affine { at: [x, y, z], rows: [xx, xy, xz, yx, yy, yz, zx, zy, zz] }, sums.moved(h, momentum))
    }

    /// The adjoint of G2P: from cotangents of a particle's new velocity and of its new C to those of the nodes' velocities, which are added to `owed`, and of the place at which
    /// it reads these, `velocities` [1/m].
    #[inline(always)]
    pub fn gather_back(&self, h: f64, cotangent: &Affine<R>, velocities: &Tile<f64>, owed: &mut Tile<R>) -> [R; 3] {
        // C = 4/h Σ w u (way)ᵀ.
        let mut per_cell = *cotangent;
        for row in &mut per_cell.rows {
            *row *= R::splat(4.0 / h);
        }
        self.sums(velocities, &per_cell, R::zero(), Some(owed)).moved(h, &per_cell)
    }
}

/// The sum over lanes of what nodes are given.
#[inline(always)]
pub fn sum_lanes<V: Lanes<Scalar = f64>>(tile: &Tile<V>) -> Tile<f64> {
    let mut sums = [[0.0; 4]; AROUND];
    for (sums, node) in sums.iter_mut().zip(tile) {
        // Behind this a group of four lanes has the four numbers.
        let mut rows = *node;
        V::transpose4(&mut rows);
        let [a, b, c, d] = rows;
        let mut groups = [0.0; CHUNK];
        (a + b + (c + d)).write(&mut groups);
        for group in groups[..V::COUNT].chunks_exact(4) {
            for (sum, own) in sums.iter_mut().zip(group) {
                *sum += own;
            }
        }
    }
    sums
}

#[inline(always)]
fn product<R: Real>(a: &[R; 9], b: &[R; 9]) -> [R; 9] {
    tabulate!(9, |e| {
        let (i, j) = (e / 3 * 3, e % 3);
        a[i].mul_add(b[j], a[i + 1].mul_add(b[3 + j], a[i + 2] * b[6 + j]))
    })
}

#[inline(always)]
fn transposed<R: Real>(a: &[R; 9]) -> [R; 9] {
    tabulate!(9, |e| a[e % 3 * 3 + e / 3])
}

/// A symmetric tensor, of which a plane off the diagonal is `off` times an entry.
#[inline(always)]
fn full<R: Real>(planes: &[R], off: f64) -> [R; 9] {
    let [xx, yy, zz, xy, xz, yz] = tabulate!(6, |p| if p < 3 { planes[p] } else { planes[p] * R::splat(off) });
    [xx, xy, xz, xy, yy, yz, xz, yz, zz]
}

/// The adjoint of [`deformed`](super::deformed): adds to the cotangent of G, and returns that of the strain, as many planes as there are.
#[inline(always)]
pub fn deformed_back<R: Real>(G: &[R; 9], strain: &[R], trial: &[R], of_G: &mut [R; 9]) -> [R; 9] {
    let mut M = *G;
    for d in 0..3 {
        M[4 * d] += R::one();
    }
    if let (Some(F), Some(T)) = (strain.first_chunk::<9>(), trial.first_chunk::<9>()) {
        // T = M F.
        add(of_G, R::one(), &product(T, &transposed(F)));
        return product(&transposed(&M), T);
    }
    // T = M b Mᵀ. A plane off the diagonal stands for two entries.
    let (b, T) = (full(strain, 1.0), full(trial, 0.5));
    let TM = product(&T, &M);
    add(of_G, R::splat(2.0), &product(&TM, &b));
    let [xx, xy, xz, _, yy, yz, _, _, zz] = product(&transposed(&M), &TM);
    let (two, none) = (R::splat(2.0), R::zero());
    [xx, yy, zz, two * xy, two * xz, two * yz, none, none, none]
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
        let cotangents: Tile<f64> = std::array::from_fn(|n| some(100 + 7 * n as u64));
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
        let velocities: Tile<f64> = std::array::from_fn(|n| some(200 + 5 * n as u64));
        let changes: Tile<f64> = std::array::from_fn(|n| some(300 + 5 * n as u64));
        let cotangent = Affine { at: some(3), rows: some(9) };
        let way: [f64; 3] = some(40);
        let loss = |x: [f64; 1]| {
            let stencil = Stencil::new(std::array::from_fn(|d| f[d] + x[0] * way[d] / h), h);
            let mut read = Affine { at: [0.0; 3], rows: [0.0; 9] };
            for n in 0..AROUND {
                let at = [n / 9, n / 3 % 3, n % 3];
                let weight: f64 = (0..3).map(|d| stencil.weights[d][at[d]]).product();
                for i in 0..3 {
                    let u = velocities[n][i] + x[0] * changes[n][i];
                    read.at[i] += weight * u;
                    (0..3).for_each(|j| read.rows[3 * i + j] += 4.0 / h * weight * u * stencil.way(j, at[j]));
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
