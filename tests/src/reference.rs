//! A plain MLS-MPM in f64: nodes in a map, particles one by one, no blocks, no lanes, no tricks. What the engine is held to.
//!
//! Nodes at cell centres, quadratic B-splines, APIC with D = h²/4, gravity scattered with the momentum, walls as mirrors. Strain
//! is advanced at the start of a step with the step that moved the particles, so that stress belongs to the present positions.
//! Laws are written out here again, from the papers, with nalgebra's eigen-decomposition.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use std::collections::BTreeMap;

type V = Vector3<f64>;
type M = Matrix3<f64>;

/// A constitutive law of the reference.
#[derive(Clone, Copy, Debug)]
pub enum Law {
    /// tau = mu (b - I) + lambda ln J I.
    NeoHookean {
        /// Lamé's first parameter [Pa].
        lambda: f64,
        /// Shear modulus [Pa].
        mu: f64,
    },
    /// Drucker-Prager sand after Klar et al. 2016 with the volume correction of Tampubolon et al. 2017.
    Sand {
        /// Lamé's first parameter [Pa].
        lambda: f64,
        /// Shear modulus [Pa].
        mu: f64,
        /// Slope of the cone.
        alpha: f64,
    },
}

/// A particle of the reference.
#[derive(Clone, Debug)]
pub struct Particle {
    /// Position [m].
    pub x: V,
    /// Velocity [m/s].
    pub v: V,
    /// Affine matrix [1/s].
    pub c: M,
    /// Left Cauchy-Green tensor of the elastic part.
    pub b: M,
    /// Volume correction.
    pub vc: f64,
    /// Mass [kg].
    pub m: f64,
    /// Rest volume [m³].
    pub volume0: f64,
}

/// What lies at both ends of an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ends {
    /// Nothing.
    Open,
    /// The ends are joined.
    Periodic,
    /// Mirrors that reflect the normal component.
    Slip,
    /// Mirrors that reflect all components.
    Stick,
}

/// The reference simulation.
#[derive(Clone, Debug)]
pub struct Reference {
    /// Cell width [m].
    pub h: f64,
    /// Cells of the world per axis; the world starts at the origin.
    pub cells: [i64; 3],
    /// Walls per axis.
    pub ends: [Ends; 3],
    /// Gravity [m/s²].
    pub gravity: V,
    /// The law.
    pub law: Law,
    /// The particles.
    pub particles: Vec<Particle>,
    /// Step over which C has carried the particles but not yet their strain [s].
    pub strain_dt: f64,
}

impl Reference {
    /// One step of `dt` seconds.
    pub fn step(&mut self, dt: f64) {
        let (h, strain_dt, law) = (self.h, self.strain_dt, self.law);
        let mut nodes: BTreeMap<[i64; 3], (V, f64)> = BTreeMap::new();
        for p in &mut self.particles {
            let g = M::identity() + p.c * strain_dt;
            let tau = law.update(g * p.b * g.transpose(), p);
            let a = p.m * p.c - dt * p.volume0 * 4.0 / (h * h) * tau;
            for (cell, w, d) in stencil(p.x, h) {
                let momentum = w * (p.m * (p.v + dt * self.gravity) + a * d);
                let (image, signs) = fold(&self.cells, &self.ends, cell);
                let node = nodes.entry(image).or_insert((V::zeros(), 0.0));
                node.0 += momentum.component_mul(&signs);
                node.1 += w * p.m;
            }
        }
        for p in &mut self.particles {
            let (mut v, mut c) = (V::zeros(), M::zeros());
            for (cell, w, d) in stencil(p.x, h) {
                let (image, signs) = fold(&self.cells, &self.ends, cell);
                let (momentum, mass) = nodes[&image];
                let u = (momentum / mass).component_mul(&signs);
                v += w * u;
                c += w * 4.0 / (h * h) * u * d.transpose();
            }
            (p.v, p.c) = (v, c);
            p.x += dt * v;
            for d in 0..3 {
                if self.ends[d] == Ends::Periodic {
                    p.x[d] = p.x[d].rem_euclid(self.cells[d] as f64 * h);
                }
            }
        }
        self.strain_dt = dt;
    }
}

/// Cells, weights and distances [m] of the 27 nodes around a point.
fn stencil(x: V, h: f64) -> Vec<([i64; 3], f64, V)> {
    let cell = (x / h).map(f64::floor);
    let f = x / h - cell;
    let weight = |f: f64, i: i64| match i {
        -1 => 0.5 * (1.0 - f).powi(2),
        0 => 0.75 - (f - 0.5).powi(2),
        _ => 0.5 * f * f,
    };
    let mut out = Vec::with_capacity(27);
    for i in -1..=1 {
        for j in -1..=1 {
            for k in -1..=1 {
                let offset = V::new(i as f64, j as f64, k as f64);
                let w = weight(f.x, i) * weight(f.y, j) * weight(f.z, k);
                let d = (offset.add_scalar(0.5) - f) * h;
                out.push(([cell.x as i64 + i, cell.y as i64 + j, cell.z as i64 + k], w, d));
            }
        }
    }
    out
}

/// The node that a node beyond a wall is the image of, and the signs of its velocity components.
fn fold(cells: &[i64; 3], ends: &[Ends; 3], mut cell: [i64; 3]) -> ([i64; 3], V) {
    let mut signs = V::repeat(1.0);
    for d in 0..3 {
        let n = cells[d];
        if (0..n).contains(&cell[d]) {
            continue;
        }
        match ends[d] {
            Ends::Open => {}
            Ends::Periodic => cell[d] = cell[d].rem_euclid(n),
            wall => {
                cell[d] = if cell[d] < 0 { -1 - cell[d] } else { 2 * n - 1 - cell[d] };
                for e in 0..3 {
                    if wall == Ends::Stick || e == d {
                        signs[e] = -signs[e];
                    }
                }
            }
        }
    }
    (cell, signs)
}

impl Law {
    /// Takes the trial strain, sets the particle's strain and history, returns Kirchhoff stress.
    fn update(&self, trial: M, p: &mut Particle) -> M {
        match *self {
            Self::NeoHookean { lambda, mu } => {
                p.b = trial;
                let ln_j = 0.5 * trial.determinant().ln();
                mu * (trial - M::identity()) + M::identity() * (lambda * ln_j)
            }
            Self::Sand { lambda, mu, alpha } => {
                let eigen = SymmetricEigen::new(trial);
                let eps = eigen.eigenvalues.map(|b| 0.5 * b.ln()).add_scalar(p.vc / 3.0);
                let trace = eps.sum();
                let dev = eps.add_scalar(-trace / 3.0);
                let (new, vc) = if trace >= 0.0 {
                    (V::zeros(), trace)
                } else {
                    let gamma = dev.norm() + (3.0 * lambda + 2.0 * mu) / (2.0 * mu) * alpha * trace;
                    (if gamma > 0.0 { eps - dev * (gamma / dev.norm()) } else { eps }, 0.0)
                };
                p.vc = vc;
                let u = eigen.eigenvectors;
                p.b = u * M::from_diagonal(&new.map(|e| (2.0 * e).exp())) * u.transpose();
                u * M::from_diagonal(&(2.0 * mu * new).add_scalar(lambda * new.sum())) * u.transpose()
            }
        }
    }
}
