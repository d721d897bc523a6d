//! Splitting particles into finer ones and merging them into coarser ones.
//!
//! A particle is a cube of side a = (V0 J)^(1/3) with inertia a²/12 per mass, and its C is the velocity gradient within
//! it. By these measures a split changes neither mass, momentum, angular momentum nor any energy, and a merge never
//! raises energy. Strain merges as the V0-weighted mean of the Hencky strain. For laws that are linear in it, the force
//! on the grid stays the same; elastic energy cannot rise; and where yield surfaces are convex in it, the mean does not
//! yield.
//!
//! # Source
//! Affine particles: Jiang et al. 2015. Least squares for C: Yue et al. 2015, with the particles' own inertia.

pub mod adjoint;

use crate::transfer::MAX_STATE;
use barchan_abi as abi;
use nalgebra::{Matrix3, SymmetricEigen, Vector3};

/// Children of a split.
pub const CHILDREN: usize = 8;
/// A merge may discard this share of the particles' kinetic energy, and of what it takes to lift them by their own size.
const DISCARD: f64 = 1e-3;
/// Third moments about the middle that a surface bears, over the cube of the side and the tolerance: eight cubes without one have
/// 0.13, without two at one face 0.23 or more, and one too many 0.28.
const LOPSIDED: f64 = 0.2;

/// One particle, away from any list.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// Position relative to any origin that the caller chooses [m].
    pub x: Vector3<f64>,
    /// Velocity [m/s].
    pub v: Vector3<f64>,
    /// Velocity gradient [1/s].
    pub c: Matrix3<f64>,
    /// Mass [kg].
    pub mass: f64,
    /// Rest volume [m³].
    pub volume0: f64,
    /// Strain planes: b_e (6) or F (9).
    pub strain: [f64; 9],
    /// History.
    pub state: [f64; MAX_STATE],
}

/// What a law says about its particles' planes.
#[derive(Clone, Copy, Debug)]
pub struct Planes<'a> {
    /// Is strain F rather than b_e?
    pub is_gradient: bool,
    /// `BARCHAN_MERGE_*` rule of each history variable.
    pub merge: &'a [u32],
}

/// Why particles are not merged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Refusal {
    /// They move apart or against each other.
    Velocity,
    /// One is inverted or not finite.
    Strain,
    /// Their histories differ.
    History,
    /// The surface would move.
    Surface,
}

impl Refusal {
    /// For the ledger.
    pub fn name(self) -> &'static str {
        match self {
            Self::Velocity => "velocities differ",
            Self::Strain => "strain is broken",
            Self::History => "histories differ",
            Self::Surface => "the surface would move",
        }
    }
}

/// Change of conserved quantities by an event, computed with the particles' own inertia.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Change {
    /// Kinetic energy [J].
    pub kinetic: f64,
    /// Angular momentum [kg m²/s].
    pub angular: Vector3<f64>,
}

impl Particle {
    /// Side of the cube that the particle fills [m].
    pub fn side(&self, planes: Planes<'_>) -> f64 {
        (self.volume0 * self.volume_ratio(planes).max(0.0)).cbrt()
    }

    /// J, of the elastic part.
    fn volume_ratio(&self, planes: Planes<'_>) -> f64 {
        if planes.is_gradient { self.gradient().determinant() } else { self.left_stretch().determinant().sqrt() }
    }

    fn gradient(&self) -> Matrix3<f64> {
        Matrix3::from_row_slice(&self.strain)
    }

    /// b_e from its six planes xx yy zz xy xz yz.
    fn left_stretch(&self) -> Matrix3<f64> {
        let [xx, yy, zz, xy, xz, yz, ..] = self.strain;
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }

    /// Hencky strain ½ log(F Fᵀ), if F is not inverted.
    fn hencky(&self, planes: Planes<'_>) -> Option<Matrix3<f64>> {
        let b = if planes.is_gradient {
            let f = self.gradient();
            if f.determinant() <= 0.0 {
                return None;
            }
            f * f.transpose()
        } else {
            self.left_stretch()
        };
        if !b.iter().all(|x| x.is_finite()) {
            return None;
        }
        let eigen = SymmetricEigen::new(b);
        let logs = eigen.eigenvalues.map(|e| 0.5 * e.ln());
        logs.iter().all(|x| x.is_finite()).then(|| with_eigenvalues(&eigen, logs))
    }

    /// Kinetic energy and angular momentum with inertia a²/12 per mass.
    fn motion(&self, side: f64) -> Change {
        let inertia = side * side / 12.0;
        let curl = Vector3::new(
            self.c[(2, 1)] - self.c[(1, 2)],
            self.c[(0, 2)] - self.c[(2, 0)],
            self.c[(1, 0)] - self.c[(0, 1)],
        );
        Change {
            kinetic: 0.5 * self.mass * (self.v.norm_squared() + inertia * self.c.norm_squared()),
            angular: self.mass * (self.x.cross(&self.v) + inertia * curl),
        }
    }
}

fn with_eigenvalues(eigen: &SymmetricEigen<f64, nalgebra::Const<3>>, values: Vector3<f64>) -> Matrix3<f64> {
    let q = eigen.eigenvectors;
    q * Matrix3::from_diagonal(&values) * q.transpose()
}

/// Eight children in the octants of the particle's cube: v_k = v + C (x_k - x); mass and volume are an eighth, and
/// everything else is copied. `scale` in (0, 1] pulls them together, to stay clear of a tool; it does not change mass
/// and momentum.
pub fn split(parent: &Particle, planes: Planes<'_>, scale: f64) -> [Particle; CHILDREN] {
    let quarter = 0.25 * scale * parent.side(planes);
    std::array::from_fn(|k| {
        let sign = |d: usize| if k >> d & 1 == 1 { quarter } else { -quarter };
        let offset = Vector3::new(sign(0), sign(1), sign(2));
        Particle {
            x: parent.x + offset,
            v: parent.v + parent.c * offset,
            mass: parent.mass / CHILDREN as f64,
            volume0: parent.volume0 / CHILDREN as f64,
            ..*parent
        }
    })
}

/// One particle in place of several. Mass, momentum, V0 and centre of mass stay. C is the least-squares fit to the
/// particles' velocities and gradients, and strain the mean Hencky strain. `gravity` [m/s²] decides which motion is
/// negligible. Histories may differ by `tolerance`, relative to their magnitude or 1. With `surface`, the cube must end
/// where the particles do, however they are turned: along each axis the mean distance of matter from the middle must
/// agree to `tolerance`, on average to half of it, and matter must lie evenly about the middle. With 0.1, eight cubes
/// of which one is missing pass; with two missing they do not.
///
/// The merged cube is wider than particles that overlap, and with their C it would have more energy than they have. So
/// where they are narrower than the cube, C is fitted as if they were as wide. Their spin stays, and energy never
/// rises.
///
/// # Errors
/// A [`Refusal`] if too much would be lost.
pub fn merge(
    particles: &[Particle],
    planes: Planes<'_>,
    gravity: f64,
    tolerance: f64,
    surface: bool,
) -> Result<(Particle, Change), Refusal> {
    let mass: f64 = particles.iter().map(|p| p.mass).sum();
    let volume0: f64 = particles.iter().map(|p| p.volume0).sum();
    let mean =
        |of: &dyn Fn(&Particle) -> Vector3<f64>| particles.iter().map(|p| of(p) * p.mass).sum::<Vector3<f64>>() / mass;
    let (x, v) = (mean(&|p| p.x), mean(&|p| p.v));
    // What is refused most often and found most cheaply comes first.
    let sides: Vec<f64> = particles.iter().map(|p| p.side(planes)).collect();
    if !sides.iter().all(|side| *side > 0.0) {
        return Err(Refusal::Strain);
    }
    let mut spread = Matrix3::zeros();
    for (p, side) in particles.iter().zip(&sides) {
        let arm = p.x - x;
        spread += (arm * arm.transpose() + Matrix3::from_diagonal_element(side * side / 12.0)) * (p.mass / mass);
    }
    if !spread.iter().all(|s| s.is_finite()) {
        return Err(Refusal::Strain);
    }
    // Of the merged cube; with the mean Hencky strain it has this volume at most.
    let inertia = sides.iter().map(|side| side.powi(3)).sum::<f64>().cbrt().powi(2) / 12.0;
    if surface {
        let arms: Vec<Vector3<f64>> = particles.iter().map(|p| p.x - x).collect();
        let side = (12.0 * inertia).sqrt();
        if lopsidedness(particles, &arms) > LOPSIDED * tolerance * side.powi(3) {
            return Err(Refusal::Surface);
        }
    }
    let spread = SymmetricEigen::new(spread);
    if surface {
        let widths = spread.eigenvalues.map(|e| (e / inertia).sqrt());
        let is_unlike = widths.iter().any(|width| (width - 1.0).abs() > tolerance);
        let has_gaps = (widths.mean() - 1.0).abs() > 0.5 * tolerance;
        if is_unlike || has_gaps {
            return Err(Refusal::Surface);
        }
    }
    let state = merged_history(particles, planes, volume0, tolerance)?;

    let mut flow = Matrix3::zeros();
    let mut before = Change::default();
    for (p, side) in particles.iter().zip(&sides) {
        let (arm, inertia, share) = (p.x - x, side * side / 12.0, p.mass / mass);
        flow += ((p.v - v) * arm.transpose() + p.c * inertia) * share;
        let motion = p.motion(*side);
        before.kinetic += motion.kinetic;
        before.angular += motion.angular;
    }
    let c = flow * with_eigenvalues(&spread, spread.eigenvalues.map(|e| 1.0 / e.max(inertia)));
    let lost: f64 = particles.iter().map(|p| 0.5 * p.mass * (p.v - v - c * (p.x - x)).norm_squared()).sum();
    // Not `>`: NaN must be refused too.
    let allowed = DISCARD * (before.kinetic + mass * gravity * volume0.cbrt());
    if lost.partial_cmp(&allowed).is_none_or(std::cmp::Ordering::is_gt) {
        return Err(Refusal::Velocity);
    }

    let mut hencky = Matrix3::zeros();
    for p in particles {
        hencky += p.hencky(planes).ok_or(Refusal::Strain)? * (p.volume0 / volume0);
    }
    let eigen = SymmetricEigen::new(hencky);
    let factor = if planes.is_gradient { 1.0 } else { 2.0 };
    let stretch = with_eigenvalues(&eigen, eigen.eigenvalues.map(|e| (factor * e).exp()));
    let mut strain = [0.0; 9];
    if planes.is_gradient {
        strain.copy_from_slice(stretch.transpose().as_slice());
    } else {
        let entries = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
        strain.iter_mut().zip(entries).for_each(|(plane, at)| *plane = stretch[at]);
    }
    let merged = Particle { x, v, c, mass, volume0, strain, state };
    let after = merged.motion(merged.side(planes));
    Ok((merged, Change { kinetic: after.kinetic - before.kinetic, angular: after.angular - before.angular }))
}

/// Norm of the mean third moments ⟨ξ ξ ξ⟩ of particles about their centre of mass [m³].
fn lopsidedness(particles: &[Particle], arms: &[Vector3<f64>]) -> f64 {
    let mass: f64 = particles.iter().map(|p| p.mass).sum();
    let pairs = particles.iter().zip(arms).flat_map(|a| particles.iter().zip(arms).map(move |b| (a, b)));
    // ⟨ξ ξ ξ⟩ : ⟨ξ ξ ξ⟩, pair by pair.
    let square: f64 = pairs.map(|((p, a), (q, b))| p.mass * q.mass * a.dot(b).powi(3)).sum();
    square.max(0.0).sqrt() / mass
}

/// History of several particles together, each variable by its rule.
fn merged_history(
    particles: &[Particle],
    planes: Planes<'_>,
    volume0: f64,
    tolerance: f64,
) -> Result<[f64; MAX_STATE], Refusal> {
    let mut state = particles[0].state;
    for (q, &rule) in planes.merge.iter().enumerate() {
        let values = || particles.iter().map(|p| p.state[q]);
        let (low, high) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
        let allowed = match rule {
            abi::BARCHAN_MERGE_REFUSE => 0.0,
            abi::BARCHAN_MERGE_LOG_MEAN => tolerance * high.abs(),
            _ => tolerance * high.abs().max(1.0),
        };
        if high - low > allowed || !(high - low).is_finite() {
            return Err(Refusal::History);
        }
        let weighted = |f: fn(f64) -> f64| particles.iter().map(|p| p.volume0 * f(p.state[q])).sum::<f64>() / volume0;
        state[q] = match rule {
            abi::BARCHAN_MERGE_REFUSE => low,
            abi::BARCHAN_MERGE_LOG_MEAN => weighted(f64::ln).exp(),
            _ => weighted(|x| x),
        };
    }
    Ok(state)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLANES: Planes<'static> = Planes { is_gradient: false, merge: &[abi::BARCHAN_MERGE_MEAN] };

    /// Numbers in [-1, 1) that differ for every call.
    struct Numbers(u64);
    impl Numbers {
        fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
        fn particle(&mut self) -> Particle {
            let (a, b, c) = (0.03 * self.next(), 0.03 * self.next(), 0.03 * self.next());
            Particle {
                x: Vector3::from_fn(|_, _| self.next()),
                v: Vector3::from_fn(|_, _| self.next()),
                c: Matrix3::from_fn(|_, _| self.next()),
                mass: 2.0 + self.next(),
                volume0: 0.2 + 0.1 * self.next(),
                strain: [1.0 + a, 1.0 + b, 1.0 + c, 0.5 * a, 0.5 * b, 0.5 * c, 0.0, 0.0, 0.0],
                state: [0.01; MAX_STATE],
            }
        }
    }

    fn totals(particles: &[Particle]) -> (f64, Vector3<f64>, Vector3<f64>, Change) {
        let mut sum = (0.0, Vector3::zeros(), Vector3::zeros(), Change::default());
        for p in particles {
            let motion = p.motion(p.side(PLANES));
            sum.0 += p.mass;
            sum.1 += p.x * p.mass;
            sum.2 += p.v * p.mass;
            sum.3.kinetic += motion.kinetic;
            sum.3.angular += motion.angular;
        }
        sum
    }

    /// A split changes nothing that is conserved, and a merge of the children gives the parent back.
    #[test]
    fn split_and_merge_is_the_identity() {
        let mut numbers = Numbers(1);
        for _ in 0..200 {
            let parent = numbers.particle();
            let children = split(&parent, PLANES, 1.0);
            let (before, after) = (totals(&[parent]), totals(&children));
            assert!((before.0 - after.0).abs() < 1e-14 && (before.1 - after.1).norm() < 1e-14);
            assert!((before.2 - after.2).norm() < 1e-14 && (before.3.angular - after.3.angular).norm() < 1e-14);
            assert!((before.3.kinetic - after.3.kinetic).abs() < 1e-14 * before.3.kinetic.max(1.0));
            let (back, change) = merge(&children, PLANES, 9.81, 0.1, true).unwrap();
            assert!((back.x - parent.x).norm() < 1e-13 && (back.v - parent.v).norm() < 1e-13);
            assert!((back.c - parent.c).norm() < 1e-12, "{} became {}", parent.c, back.c);
            assert!((0..6).all(|p| (back.strain[p] - parent.strain[p]).abs() < 1e-12));
            assert!(change.kinetic.abs() < 1e-12 && change.angular.norm() < 1e-12);
        }
    }

    /// Symptom: spinning particles that lie at one place gain energy as they merge, since their spin goes on in a larger cube. Physics:
    /// kinetic energy never rises in a merge, whatever the particles do and however near they are; mass, momentum and centre stay.
    #[test]
    fn merging_never_raises_kinetic_energy() {
        let mut numbers = Numbers(7);
        for round in 0..2000 {
            let mut cluster: Vec<_> = (0..5).map(|_| numbers.particle()).collect();
            let apart = [1.0, 0.3, 0.01, 0.0][round % 4];
            cluster.iter_mut().for_each(|p| p.x *= apart);
            // Gravity without end: nothing is refused for its motion.
            let (one, change) = merge(&cluster, PLANES, f64::INFINITY, 10.0, false).unwrap();
            let (before, after) = (totals(&cluster), totals(&[one]));
            assert!((before.0 - after.0).abs() < 1e-12 && (before.1 - after.1).norm() < 1e-12);
            assert!((before.2 - after.2).norm() < 1e-12);
            assert!(change.kinetic <= 1e-12, "a merge gave {} J", change.kinetic);
            if apart == 0.0 {
                let spin = before.3.angular.norm();
                assert!(
                    change.angular.norm() < 1e-3 * spin,
                    "particles at one place keep their spin: {}",
                    change.angular
                );
            }
        }
    }

    /// Unlike particles are refused: jets that meet, histories that differ, a ragged surface, an inverted one.
    #[test]
    fn unlike_particles_stay_apart() {
        let mut numbers = Numbers(3);
        let parent = Particle { c: Matrix3::zeros(), ..numbers.particle() };
        let children = split(&parent, PLANES, 1.0);
        let refusal = |change: &dyn Fn(usize, &mut Particle)| {
            let mut cluster = children;
            cluster.iter_mut().enumerate().for_each(|(k, p)| change(k, p));
            merge(&cluster, PLANES, 9.81, 0.1, true).unwrap_err()
        };
        assert_eq!(refusal(&|k, p| p.v.x += if (k ^ k >> 1) & 1 == 0 { 3.0 } else { -3.0 }), Refusal::Velocity);
        assert_eq!(refusal(&|k, p| p.state[0] = 0.2 * k as f64), Refusal::History);
        assert_eq!(refusal(&|k, p| p.x.z += if k == 7 { 0.3 } else { 0.0 }), Refusal::Surface);
        assert_eq!(refusal(&|_, p| p.strain[0] = f64::NAN), Refusal::Strain);
    }
}
