//! Split and merge backwards: from what a loss owes to the particles behind them to what it owes to those before.
//!
//! Masses and rest volumes are what they are. Which particles split and merge, and into how many, is no part of it. Functions of symmetric tensors are differentiated through divided
//! differences, so that equal eigenvalues are no special case.

use super::{CHILDREN, Particle, Planes, with_eigenvalues};
use crate::transfer::MAX_STATE;
use barchan_abi as abi;
use nalgebra::{Const, Matrix3, SymmetricEigen, Vector3};

/// What a loss owes to a particle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cotangent {
    /// By its position [1/m].
    pub x: Vector3<f64>,
    /// By its velocity [s/m].
    pub v: Vector3<f64>,
    /// By its velocity gradient [s].
    pub c: Matrix3<f64>,
    /// By its strain planes, where one of b_e off the diagonal stands for two entries.
    pub strain: [f64; 9],
    /// By its history.
    pub state: [f64; MAX_STATE],
}

impl Default for Cotangent {
    fn default() -> Self {
        Self {
            x: Vector3::zeros(),
            v: Vector3::zeros(),
            c: Matrix3::zeros(),
            strain: [0.0; 9],
            state: [0.0; MAX_STATE],
        }
    }
}

impl Particle {
    /// J = sqrt(det b) or det F backwards: what is owed to the strain planes, from what is owed to J.
    fn volume_ratio_back(&self, planes: Planes<'_>, owed: f64, strain: &mut [f64; 9]) {
        let ratio = owed * self.volume_ratio(planes);
        if planes.is_gradient {
            let inverse = self.gradient().try_inverse().unwrap_or_default();
            strain.iter_mut().enumerate().for_each(|(e, sum)| *sum += ratio * inverse[(e % 3, e / 3)]);
        } else {
            let inverse = self.left_stretch().try_inverse().unwrap_or_default();
            add_symmetric(&(inverse * (0.5 * ratio)), strain);
        }
    }

    /// ½ log b backwards, from what is owed to it.
    fn hencky_back(&self, planes: Planes<'_>, owed: &Matrix3<f64>, strain: &mut [f64; 9]) {
        let gradient = planes.is_gradient.then(|| self.gradient());
        let b = gradient.map_or_else(|| self.left_stretch(), |f| f * f.transpose());
        let eigen = SymmetricEigen::new(b);
        // (ln x − ln y) / (x − y)
        let slope = |x: f64, y: f64| 0.5 * if x == y { 1.0 / x } else { ((x - y) / y).ln_1p() / (x - y) };
        let of_b = spectral_back(&eigen, owed, slope);
        match gradient {
            // b = F Fᵀ.
            Some(f) => {
                let of_f = of_b * f * 2.0;
                strain.iter_mut().enumerate().for_each(|(e, sum)| *sum += of_f[(e / 3, e % 3)]);
            }
            None => add_symmetric(&of_b, strain),
        }
    }
}

/// Adds what is owed to the entries of a symmetric tensor to its six planes.
fn add_symmetric(owed: &Matrix3<f64>, strain: &mut [f64; 9]) {
    let entries = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
    for (plane, (i, j)) in strain.iter_mut().zip(entries) {
        *plane += if i == j { owed[(i, i)] } else { owed[(i, j)] + owed[(j, i)] };
    }
}

/// What is owed to the entries of b = Σ e_i q_i q_iᵀ, of which f(b) = Σ f(e_i) q_i q_iᵀ was made. `slope` is (f(x) − f(y)) / (x − y), and the derivative of f where both are the same.
fn spectral_back(
    eigen: &SymmetricEigen<f64, Const<3>>,
    owed: &Matrix3<f64>,
    slope: impl Fn(f64, f64) -> f64,
) -> Matrix3<f64> {
    let (q, e) = (eigen.eigenvectors, eigen.eigenvalues);
    let along = q.transpose() * (owed + owed.transpose()) * 0.5 * q;
    q * Matrix3::from_fn(|i, j| slope(e[i], e[j]) * along[(i, j)]) * q.transpose()
}

/// The adjoint of [`split`](super::split).
pub fn split_back(parent: &Particle, planes: Planes<'_>, scale: f64, owed: &[Cotangent; CHILDREN]) -> Cotangent {
    let side = parent.side(planes);
    let quarter = 0.25 * scale * side;
    let mut back = Cotangent::default();
    let mut of_quarter = 0.0;
    for (k, child) in owed.iter().enumerate() {
        let signs = Vector3::from_fn(|d, _| if k >> d & 1 == 1 { 1.0 } else { -1.0 });
        back.x += child.x;
        back.v += child.v;
        back.c += child.c + child.v * (signs * quarter).transpose();
        of_quarter += signs.dot(&(child.x + parent.c.transpose() * child.v));
        back.strain.iter_mut().zip(child.strain).for_each(|(sum, own)| *sum += own);
        back.state.iter_mut().zip(child.state).for_each(|(sum, own)| *sum += own);
    }
    // a³ = V0 J.
    let of_side = 0.25 * scale * of_quarter;
    parent.volume_ratio_back(planes, of_side * side / (3.0 * parent.volume_ratio(planes)), &mut back.strain);
    back
}

/// The adjoint of [`merge`](super::merge), of particles that it takes.
pub fn merge_back(particles: &[Particle], planes: Planes<'_>, owed: &Cotangent) -> Vec<Cotangent> {
    let mass: f64 = particles.iter().map(|p| p.mass).sum();
    let volume0: f64 = particles.iter().map(|p| p.volume0).sum();
    let mean =
        |of: &dyn Fn(&Particle) -> Vector3<f64>| particles.iter().map(|p| of(p) * p.mass).sum::<Vector3<f64>>() / mass;
    let (x, v) = (mean(&|p| p.x), mean(&|p| p.v));
    // Volumes, and inertias per mass.
    let volumes: Vec<f64> = particles.iter().map(|p| p.volume0 * p.volume_ratio(planes)).collect();
    let inertia_of = |volume: f64| volume.cbrt().powi(2) / 12.0;
    let volume: f64 = volumes.iter().sum();
    let inertia = inertia_of(volume);
    let (mut spread, mut flow) = (Matrix3::zeros(), Matrix3::zeros());
    for (p, volume) in particles.iter().zip(&volumes) {
        let (arm, own, share) = (p.x - x, inertia_of(*volume), p.mass / mass);
        spread += (arm * arm.transpose() + Matrix3::from_diagonal_element(own)) * share;
        flow += ((p.v - v) * arm.transpose() + p.c * own) * share;
    }
    let spread = SymmetricEigen::new(spread);
    // C = flow · g(spread), with g(e) = 1 / max(e, inertia).
    let fitted = with_eigenvalues(&spread, spread.eigenvalues.map(|e| 1.0 / e.max(inertia)));
    let of_flow = owed.c * fitted;
    let of_fitted = flow.transpose() * owed.c;
    let slope = |x: f64, y: f64| {
        let (wide, narrow) = (x.max(inertia), y.max(inertia));
        let ratio = if x == y { f64::from(u8::from(x >= inertia)) } else { (wide - narrow) / (x - y) };
        -ratio / (wide * narrow)
    };
    let of_spread = spectral_back(&spread, &of_fitted, slope);
    let of_inertia: f64 = (0..3)
        .filter(|i| spread.eigenvalues[*i] < inertia)
        .map(|i| {
            let q = spread.eigenvectors.column(i);
            -(q.transpose() * of_fitted * q)[(0, 0)] / (inertia * inertia)
        })
        .sum();
    let of_volume = of_inertia * 2.0 / 3.0 * inertia / volume;

    let of_hencky = hencky_owed(particles, planes, volume0, &owed.strain);
    let mut backs = vec![Cotangent::default(); particles.len()];
    let mut of_middle = owed.x;
    for ((p, own_volume), back) in particles.iter().zip(&volumes).zip(&mut backs) {
        let (arm, own, share) = (p.x - x, inertia_of(*own_volume), p.mass / mass);
        let of_arm = (of_spread * arm * 2.0 + of_flow.transpose() * (p.v - v)) * share;
        back.x = of_arm;
        of_middle -= of_arm;
        back.v = (owed.v + of_flow * arm) * share;
        back.c = of_flow * (share * own);
        let of_own = share * (of_spread.trace() + of_flow.dot(&p.c));
        let of_ratio = p.volume0 * (of_volume + of_own * 2.0 / 3.0 * own / own_volume);
        p.volume_ratio_back(planes, of_ratio, &mut back.strain);
        p.hencky_back(planes, &(of_hencky * (p.volume0 / volume0)), &mut back.strain);
    }
    for (p, back) in particles.iter().zip(&mut backs) {
        back.x += of_middle * (p.mass / mass);
    }
    history_back(particles, planes, volume0, &owed.state, &mut backs);
    backs
}

/// What is owed to the mean Hencky strain of which the merged particle's is made.
fn hencky_owed(particles: &[Particle], planes: Planes<'_>, volume0: f64, owed: &[f64; 9]) -> Matrix3<f64> {
    let hencky = |p: &Particle| p.hencky(planes).unwrap_or_default() * (p.volume0 / volume0);
    let eigen = SymmetricEigen::new(particles.iter().map(hencky).sum::<Matrix3<f64>>());
    let (factor, of_stretch) = if planes.is_gradient {
        (1.0, Matrix3::from_row_slice(owed))
    } else {
        let [xx, yy, zz, xy, xz, yz, ..] = *owed;
        let [xy, xz, yz] = [xy, xz, yz].map(|owed| 0.5 * owed);
        (2.0, Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz))
    };
    // (exp(k x) − exp(k y)) / (x − y)
    let slope = |x: f64, y: f64| {
        let at = (factor * y).exp();
        if x == y { factor * at } else { at * (factor * (x - y)).exp_m1() / (x - y) }
    };
    spectral_back(&eigen, &of_stretch, slope)
}

/// What is owed to histories, each variable by its rule.
fn history_back(
    particles: &[Particle],
    planes: Planes<'_>,
    volume0: f64,
    owed: &[f64; MAX_STATE],
    backs: &mut [Cotangent],
) {
    for (q, &rule) in planes.merge.iter().enumerate() {
        let logs = || particles.iter().map(|p| p.volume0 / volume0 * p.state[q].ln()).sum::<f64>();
        let per_log = (rule == abi::BARCHAN_MERGE_LOG_MEAN).then(|| logs().exp());
        for (p, back) in particles.iter().zip(backs.iter_mut()) {
            back.state[q] = owed[q] * p.volume0 / volume0 * per_log.map_or(1.0, |mean| mean / p.state[q]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{merge, split};
    use super::*;

    /// Numbers without a pattern, in [-1, 1).
    struct Numbers(u64);
    impl Numbers {
        fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
        fn particle(&mut self, planes: Planes<'_>, wide: f64) -> Particle {
            let mut strain: [f64; 9] = std::array::from_fn(|_| 0.05 * self.next());
            for diagonal in if planes.is_gradient { [0, 4, 8] } else { [0, 1, 2] } {
                strain[diagonal] += 1.0;
            }
            let mut state = [0.0; MAX_STATE];
            state[..2].fill_with(|| 0.5 + 0.1 * self.next());
            Particle {
                x: Vector3::from_fn(|_, _| wide * self.next()),
                v: Vector3::from_fn(|_, _| self.next()),
                c: Matrix3::from_fn(|_, _| self.next()),
                mass: 2.0 + self.next(),
                volume0: 0.2 + 0.1 * self.next(),
                strain,
                state,
            }
        }
        fn cotangent(&mut self) -> Cotangent {
            Cotangent {
                x: Vector3::from_fn(|_, _| self.next()),
                v: Vector3::from_fn(|_, _| self.next()),
                c: Matrix3::from_fn(|_, _| self.next()),
                strain: std::array::from_fn(|_| self.next()),
                state: std::array::from_fn(|q| if q < 2 { self.next() } else { 0.0 }),
            }
        }
    }

    const RULES: [u32; 2] = [abi::BARCHAN_MERGE_MEAN, abi::BARCHAN_MERGE_LOG_MEAN];
    const KINDS: [Planes<'static>; 2] =
        [Planes { is_gradient: false, merge: &RULES }, Planes { is_gradient: true, merge: &RULES }];

    fn owed_to(p: &Particle, owed: &Cotangent, planes: Planes<'_>) -> f64 {
        let strain = p.strain.iter().zip(owed.strain).take(if planes.is_gradient { 9 } else { 6 });
        let state = p.state.iter().zip(owed.state).map(|(x, y)| x * y).sum::<f64>();
        p.x.dot(&owed.x) + p.v.dot(&owed.v) + p.c.dot(&owed.c) + strain.map(|(x, y)| x * y).sum::<f64>() + state
    }

    fn along(p: &Particle, way: &Cotangent, by: f64) -> Particle {
        Particle {
            x: p.x + way.x * by,
            v: p.v + way.v * by,
            c: p.c + way.c * by,
            strain: std::array::from_fn(|e| p.strain[e] + by * way.strain[e]),
            state: std::array::from_fn(|q| p.state[q] + by * way.state[q]),
            ..*p
        }
    }

    fn slope(f: impl Fn(f64) -> f64) -> f64 {
        let h = 1e-3;
        (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
    }

    #[test]
    fn a_split_has_its_adjoint() {
        let mut numbers = Numbers(3);
        for planes in KINDS {
            let (parent, way) = (numbers.particle(planes, 1.0), numbers.cotangent());
            let owed = std::array::from_fn(|_| numbers.cotangent());
            let loss = |by: f64| -> f64 {
                let children = split(&along(&parent, &way, by), planes, 0.5);
                children.iter().zip(&owed).map(|(child, owed)| owed_to(child, owed, planes)).sum()
            };
            let back = split_back(&parent, planes, 0.5, &owed);
            let given = dot(&back, &way, planes);
            let found = slope(loss);
            assert!((given - found).abs() < 1e-8 * found.abs().max(1.0), "{planes:?}: {given} {found}");
        }
    }

    fn dot(a: &Cotangent, b: &Cotangent, planes: Planes<'_>) -> f64 {
        let strain = a.strain.iter().zip(b.strain).take(if planes.is_gradient { 9 } else { 6 });
        let state = a.state.iter().zip(b.state).map(|(x, y)| x * y).sum::<f64>();
        a.x.dot(&b.x) + a.v.dot(&b.v) + a.c.dot(&b.c) + strain.map(|(x, y)| x * y).sum::<f64>() + state
    }

    /// Physics: what comes back is the derivative of the merge, where particles are as wide as their cube and where they overlap.
    #[test]
    fn a_merge_has_its_adjoint() {
        let mut numbers = Numbers(11);
        for planes in KINDS {
            for wide in [1.0, 0.5, 0.1] {
                let particles: Vec<_> = (0..5).map(|_| numbers.particle(planes, wide)).collect();
                let ways: Vec<_> = (0..5).map(|_| numbers.cotangent()).collect();
                let owed = numbers.cotangent();
                let loss = |by: f64| {
                    let moved: Vec<_> = particles.iter().zip(&ways).map(|(p, way)| along(p, way, by)).collect();
                    let (one, _) = merge(&moved, planes, f64::INFINITY, f64::INFINITY, false).unwrap();
                    owed_to(&one, &owed, planes)
                };
                let backs = merge_back(&particles, planes, &owed);
                let given: f64 = backs.iter().zip(&ways).map(|(back, way)| dot(back, way, planes)).sum();
                let found = slope(loss);
                assert!((given - found).abs() < 1e-8 * found.abs().max(1.0), "{planes:?}, {wide}: {given} {found}");
            }
        }
    }
}
