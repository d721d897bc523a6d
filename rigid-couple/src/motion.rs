//! Poses, and paths through poses at given times.

use crate::Refusal;
use barchan_core::contact::Twist;
use barchan_core::scene::{Interpolation, Keyframe};
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Where a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Its origin [m].
    pub position: DVec3,
    /// Its orientation.
    pub rotation: DQuat,
}

impl Pose {
    /// The world's own frame.
    pub const IDENTITY: Self = Self { position: DVec3::ZERO, rotation: DQuat::IDENTITY };

    /// A point of the frame, seen from outside [m].
    pub fn apply(&self, x: DVec3) -> DVec3 {
        self.position + self.rotation * x
    }
    /// A frame within this frame, seen from outside.
    #[must_use]
    pub fn then(&self, inner: &Self) -> Self {
        Self { position: self.apply(inner.position), rotation: (self.rotation * inner.rotation).normalize() }
    }
    /// Its orientation as (w, x, y, z).
    pub(crate) fn quaternion(&self) -> [f64; 4] {
        let turn = self.rotation;
        [turn.w, turn.x, turn.y, turn.z]
    }
    /// The same so far on [m].
    #[must_use]
    pub fn moved(&self, by: DVec3) -> Self {
        Self { position: self.position + by, ..*self }
    }
    /// The pose after moving for `dt` at a constant twist.
    #[must_use]
    pub fn advanced(&self, twist: &Twist, dt: f64) -> Self {
        let turn = DQuat::from_scaled_axis(twist.angular * dt);
        Self { position: self.position + twist.linear * dt, rotation: (turn * self.rotation).normalize() }
    }
    /// The constant twist that leads from here to `to` in `dt`, the shorter way round.
    pub fn chord(&self, to: &Self, dt: f64) -> Twist {
        let linear = (to.position - self.position) / dt;
        Twist { linear, angular: rotation_vector(to.rotation * self.rotation.conjugate()) / dt }
    }
}

/// a ×, as a matrix.
pub(crate) fn cross_matrix(a: DVec3) -> DMat3 {
    DMat3::from_cols(a.cross(DVec3::X), a.cross(DVec3::Y), a.cross(DVec3::Z))
}

/// How the rotation by a vector changes with it: the small turn about the world's axes on top of it that a small change makes [rad/rad] (the left Jacobian of the rotations;
/// Solà et al. 2018, *A micro Lie theory for state estimation in robotics*, eq. 145).
pub(crate) fn turn_slopes(vector: DVec3) -> DMat3 {
    let angle = vector.length();
    let cross = cross_matrix(vector);
    // (1 - cos a) / a² and (a - sin a) / a³.
    let (first, second) = if angle < 1e-3 {
        (0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0)
    } else {
        let half = (0.5 * angle).sin() / angle;
        (2.0 * half * half, (angle - angle.sin()) / angle.powi(3))
    };
    DMat3::IDENTITY + cross * first + cross * cross * second
}

/// Axis times angle of a rotation, the shorter way round [rad]; accurate for the smallest angles too.
pub(crate) fn rotation_vector(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let sine = q.xyz().length();
    // 2 asin(s) / s -> 2 for small s.
    q.xyz() * if sine < 1e-9 { 2.0 } else { 2.0 * sine.atan2(q.w) / sine }
}

/// The unit quaternion of a scene's (w, x, y, z).
///
/// # Errors
/// If it is zero or not finite.
pub fn rotation_from([w, x, y, z]: [f64; 4]) -> Result<DQuat, Refusal> {
    let q = DQuat::from_xyzw(x, y, z, w);
    let length = q.length();
    if length.is_finite() && length > 1e-6 {
        Ok(q.normalize())
    } else {
        let what = format!("the rotation ({w}, {x}, {y}, {z}) is no quaternion");
        Err(Refusal::new(what, "give (w, x, y, z); (1, 0, 0, 0) turns nothing"))
    }
}

/// A path through keyframes. It rests before the first and after the last.
#[derive(Clone, Debug)]
pub struct KeyframePath {
    times: Vec<f64>,
    poses: Vec<Pose>,
    /// Rotation from each keyframe to the next: axis times angle [rad].
    turns: Vec<DVec3>,
    /// Velocity of the position at each keyframe [m/s].
    velocities: Vec<DVec3>,
    /// Angular speed at each keyframe along the turn before and after it [rad/s].
    rates: Vec<f64>,
    interpolation: Interpolation,
}

/// Slope of a monotone cubic between secants `a` over the time `p` and `b` over `q`: zero where the path turns back or
/// rests, otherwise their weighted harmonic mean (Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 1984).
fn monotone_slope(a: f64, p: f64, b: f64, q: f64) -> f64 {
    if a * b <= 0.0 {
        return 0.0;
    }
    let (u, v) = (2.0 * q + p, q + 2.0 * p);
    (u + v) / (u / a + v / b)
}

/// How that slope changes with either secant.
fn monotone_slopes(a: f64, p: f64, b: f64, q: f64) -> [f64; 2] {
    if a * b <= 0.0 {
        return [0.0; 2];
    }
    let (u, v) = (2.0 * q + p, q + 2.0 * p);
    let part = (u + v) / (u / a + v / b).powi(2);
    [part * u / (a * a), part * v / (b * b)]
}

/// Cubic Hermite over [0, 1]: the share of the way done at `s`, and the weights of the slopes at both ends.
fn hermite(s: f64) -> (f64, f64, f64) {
    (s * s * (3.0 - 2.0 * s), s * (1.0 - s) * (1.0 - s), s * s * (s - 1.0))
}

/// Greatest slope, either way, of the cubic that [`hermite`] describes between `from` and `to`, of [0, 1]: its mean slope is `secant`, those at
/// its ends are `out` and `into`.
fn steepest(secant: f64, out: f64, into: f64, from: f64, to: f64) -> f64 {
    let slope = |s: f64| 6.0 * secant * s * (1.0 - s) + out * (1.0 - s) * (1.0 - 3.0 * s) + into * s * (3.0 * s - 2.0);
    // A parabola: greatest at an end or where its own slope is 0.
    let top = (3.0 * secant - 2.0 * out - into) / (3.0 * (2.0 * secant - out - into));
    [from, to, if from < top && top < to { top } else { from }].into_iter().map(|s| slope(s).abs()).fold(0.0, f64::max)
}

impl KeyframePath {
    /// A path through `frames`. A frame without rotation keeps the one before, the first one `start`.
    ///
    /// # Errors
    /// If there is no frame, times do not rise, or a number is not finite.
    pub fn new(frames: &[Keyframe], interpolation: Interpolation, start: DQuat) -> Result<Self, Refusal> {
        if frames.is_empty() {
            return Err(Refusal::new("there are no keyframes", "give at least one"));
        }
        let times: Vec<f64> = frames.iter().map(|f| f.time).collect();
        let rising = times.windows(2).all(|t| t[0] < t[1]);
        if !rising || times.iter().any(|t| !t.is_finite()) {
            return Err(Refusal::new(
                format!("the keyframes' times {times:?} do not rise"),
                "sort them and drop doubles",
            ));
        }
        let mut rotation = start;
        let mut poses = Vec::new();
        for frame in frames {
            let position = DVec3::from_array(frame.position);
            if !position.is_finite() {
                let what = format!("the keyframe at {} s is at {:?}", frame.time, frame.position);
                return Err(Refusal::new(what, "give three finite numbers"));
            }
            rotation = frame.rotation.map_or(Ok(rotation), rotation_from)?;
            poses.push(Pose { position, rotation });
        }
        let turns: Vec<DVec3> =
            poses.windows(2).map(|p| rotation_vector(p[1].rotation * p[0].rotation.conjugate())).collect();
        let mut velocities = vec![DVec3::ZERO; poses.len()];
        let mut rates = vec![0.0; poses.len()];
        for i in 1..poses.len() - 1 {
            let (p, q) = (times[i] - times[i - 1], times[i + 1] - times[i]);
            let before = (poses[i].position - poses[i - 1].position) / p;
            let after = (poses[i + 1].position - poses[i].position) / q;
            velocities[i] = DVec3::from_array(std::array::from_fn(|d| monotone_slope(before[d], p, after[d], q)));
            // A turn goes on without a halt only about one and the same axis.
            let (a, b) = (turns[i - 1].length(), turns[i].length());
            if turns[i - 1].dot(turns[i]) > (1.0 - 1e-9) * a * b {
                rates[i] = monotone_slope(a / p, p, b / q, q);
            }
        }
        Ok(Self { times, poses, turns, velocities, rates, interpolation })
    }

    /// Bounds on how fast the path is at any moment from `from` to `to` [s]: the greatest speed along each axis [m/s], and the greatest angular
    /// velocity [rad/s]. So no step within is faster, however it is cut.
    pub fn fastest(&self, from: f64, to: f64) -> (DVec3, DVec3) {
        let (mut linear, mut angular) = (DVec3::ZERO, DVec3::ZERO);
        // The pieces that have begun by `to` and have not ended at `from`.
        let first = self.times.partition_point(|&t| t <= from).saturating_sub(1);
        let end = self.times.partition_point(|&t| t < to);
        for i in first..end.min(self.times.len() - 1) {
            let span = self.times[i + 1] - self.times[i];
            let [from, to] = [from, to].map(|t| ((t - self.times[i]) / span).clamp(0.0, 1.0));
            let way = self.poses[i + 1].position - self.poses[i].position;
            let angle = self.turns[i].length();
            let rate = |way: f64, out: f64, into: f64| match self.interpolation {
                Interpolation::Linear => way.abs() / span,
                Interpolation::Smooth => steepest(way / span, out, into, from, to),
            };
            let (out, into) = (self.velocities[i], self.velocities[i + 1]);
            linear = linear.max(DVec3::from_array(std::array::from_fn(|d| rate(way[d], out[d], into[d]))));
            let turning = rate(angle, self.rates[i], self.rates[i + 1]);
            if turning > angular.length() {
                angular = self.turns[i] / angle * turning;
            }
        }
        (linear, angular)
    }

    /// From what is owed to the position at `time` [s] to what is owed to the keyframes' positions, which is added to `frames`.
    pub(crate) fn position_back(&self, time: f64, owed: DVec3, frames: &mut [DVec3]) {
        let i = self.times.partition_point(|&t| t <= time);
        if i == 0 || i == self.poses.len() {
            frames[i.saturating_sub(1)] += owed;
            return;
        }
        let span = self.times[i] - self.times[i - 1];
        let s = (time - self.times[i - 1]) / span;
        let (way, slopes) = match self.interpolation {
            Interpolation::Linear => (s, [0.0; 2]),
            Interpolation::Smooth => {
                let (way, out, into) = hermite(s);
                (way, [out * span, into * span])
            }
        };
        frames[i - 1] += (1.0 - way) * owed;
        frames[i] += way * owed;
        for (k, weight) in [(i - 1, slopes[0]), (i, slopes[1])] {
            if k == 0 || k + 1 == self.poses.len() || weight == 0.0 {
                continue;
            }
            let (p, q) = (self.times[k] - self.times[k - 1], self.times[k + 1] - self.times[k]);
            for d in 0..3 {
                let [x, y, z] = [k - 1, k, k + 1].map(|k| self.poses[k].position[d]);
                let [a, b] = monotone_slopes((y - x) / p, p, (z - y) / q, q).map(|slope| weight * owed[d] * slope);
                frames[k - 1][d] -= a / p;
                frames[k][d] += a / p - b / q;
                frames[k + 1][d] += b / q;
            }
        }
    }

    /// Number of its keyframes.
    pub(crate) fn len(&self) -> usize {
        self.times.len()
    }

    /// The pose at `time` [s]; at a keyframe's time exactly the keyframe's.
    pub fn pose(&self, time: f64) -> Pose {
        let i = self.times.partition_point(|&t| t <= time);
        if i == 0 {
            return self.poses[0];
        }
        if i == self.poses.len() {
            return self.poses[i - 1];
        }
        let (from, to) = (&self.poses[i - 1], &self.poses[i]);
        let span = self.times[i] - self.times[i - 1];
        let s = (time - self.times[i - 1]) / span;
        let (turn, angle) = (self.turns[i - 1], self.turns[i - 1].length());
        let (position, share) = match self.interpolation {
            Interpolation::Linear => (from.position.lerp(to.position, s), s),
            Interpolation::Smooth => {
                let (way, out, into) = hermite(s);
                let swing = (self.velocities[i - 1] * out + self.velocities[i] * into) * span;
                let twist = (self.rates[i - 1] * out + self.rates[i] * into) * span;
                let share = if angle > 0.0 { way + twist / angle } else { 0.0 };
                (from.position.lerp(to.position, way) + swing, share)
            }
        };
        Pose { position, rotation: (DQuat::from_scaled_axis(turn * share) * from.rotation).normalize() }
    }
}
