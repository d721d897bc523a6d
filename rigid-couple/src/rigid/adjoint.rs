//! The motion of tools and free bodies backwards.
//!
//! Of a body that answers, velocity v and angular velocity ω are its state besides where it is. A step is v_f = v + dt g; contact finds the twist V with M (V_f − V) + J = 0; then it moves by V, and turns by
//! the angular velocity half-way (implicit midpoint), with the angular momentum L = I V that contact has left it. Rapier turns it by a little less than that says (`Turn`).

use super::body::{Body, Guided, Mover, turned};
use crate::mass::outer;
use crate::motion::{Pose, cross_matrix, turn_slopes};
use barchan_core::Wrench;
use barchan_core::contact::Twist;
use barchan_core::contact::adjoint::BodyInStep;
use barchan_core::gradient::{BodyCotangents, BodyGradient};
use barchan_core::scene::Contact;
use glam::{DMat3, DQuat, DVec3};

/// How far a body turns in a step, and how that changes with its angular velocity: rapier takes so many parts of the step, and turns by 2 atan(ω t / 2) in each, of the length t.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turn {
    /// Axis times angle [rad].
    vector: DVec3,
    slopes: DMat3,
}

impl Turn {
    pub(super) fn of(spin: DVec3, dt: f64, parts: usize) -> Self {
        let (speed, axis, parts) = (spin.length(), spin.normalize_or_zero(), parts as f64);
        let half = 0.5 * speed * dt / parts;
        let along = dt / (1.0 + half * half);
        let across = if half > 0.0 { dt * half.atan() / half } else { dt };
        let slopes = DMat3::from_diagonal(DVec3::splat(across)) + outer(axis, axis) * (along - across);
        Self { vector: across * spin, slopes }
    }

    /// Its rotation behind the step.
    pub(super) fn after(&self, rotation: DQuat) -> DQuat {
        (DQuat::from_scaled_axis(self.vector) * rotation).normalize()
    }
}

/// Adds to what is owed to a vector.
fn add(to: &mut barchan_core::Vec3, by: DVec3) {
    (0..3).for_each(|d| to[d] += by[d]);
}

impl Body {
    /// The step's last part, in which a body that answers moves by the twist that contact has left it, and a free one turns as `turn` says: from what is owed to its state there to what is owed to
    /// where it was, and to that twist, which is returned. Driven bodies are where they were told.
    pub(super) fn advance_back(&self, dt: f64, turn: &Turn, owed: &mut BodyCotangents) -> Twist {
        let [of_place, mut of_turn] = [owed.pose.position, owed.pose.rotation].map(DVec3::from_array);
        let [of_velocity, of_spin] = [owed.velocity, owed.angular_velocity].map(DVec3::from_array);
        let linear = of_velocity + dt * of_place;
        let Mover::Free { inertia, inverse_inertia, .. } = self.mover else {
            return if self.answering().is_some() { Twist { linear, angular: DVec3::ZERO } } else { Twist::default() };
        };
        let (pose, momentum) = (self.state.pose, self.state.angular_momentum);
        // ω = R I⁻¹ Rᵀ L: what is owed to it goes to L, and to a small turn of R.
        let spin_back = |pose: &Pose, owed: DVec3| {
            let inverse = turned(inverse_inertia, pose);
            let of_momentum = inverse * owed;
            (of_momentum, (inverse * momentum).cross(owed) - momentum.cross(of_momentum))
        };
        let after = Pose { rotation: turn.after(pose.rotation), ..pose };
        let (mut of_momentum, more) = spin_back(&after, of_spin);
        of_turn += more;
        // R' = exp(turn(ω_m)) R.
        let midway = self.midway_spin(dt);
        let of_midway = turn.slopes.transpose() * (turn_slopes(turn.vector).transpose() * of_turn);
        of_turn = DQuat::from_scaled_axis(turn.vector).conjugate() * of_turn;
        // ω_m = I⁻¹ L at exp(dt ω_m / 2) R, which ω_m itself changes.
        let half = 0.5 * dt * midway;
        let there = pose.advanced(&Twist { linear: DVec3::ZERO, angular: midway }, 0.5 * dt);
        let turning = turned(inverse_inertia, &there) * cross_matrix(momentum) - cross_matrix(midway);
        let own = DMat3::IDENTITY - turning * turn_slopes(half) * (0.5 * dt);
        let (more_momentum, more) = spin_back(&there, own.transpose().inverse() * of_midway);
        of_momentum += more_momentum;
        of_turn += DQuat::from_scaled_axis(half).conjugate() * more;
        // L = R I Rᵀ V.
        let angular = turned(inertia, &pose) * of_momentum;
        of_turn += momentum.cross(of_momentum) - self.state.twist.angular.cross(angular);
        owed.pose.rotation = of_turn.to_array();
        Twist { linear, angular }
    }

    /// The step's first part, from `time` over `dt` [s], as [`Coupling::begin_back`](barchan_core::Coupling::begin_back) says; `felt` is the mean wrench in it.
    pub(super) fn begin_back(
        &self,
        [time, dt]: [f64; 2],
        step: &BodyInStep,
        felt: &Wrench,
        owed: &mut BodyCotangents,
        told: &mut BodyGradient,
    ) -> DVec3 {
        if matches!(self.contact, Contact::Coulomb { .. }) {
            told.friction += step.friction;
        }
        let after = DVec3::from_array(owed.pose.position);
        let after_turn = DVec3::from_array(owed.pose.rotation);
        let mut twist = step.twist;
        if self.answering().is_none() {
            // It moves as it is told behind the step, too.
            twist.linear += DVec3::from_array(owed.velocity);
            twist.angular += DVec3::from_array(owed.angular_velocity);
        }
        (owed.velocity, owed.angular_velocity) = ([0.0; 3], [0.0; 3]);
        let Twist { linear, angular } = twist;
        let mut of_gravity = DVec3::ZERO;
        let [impulse, angular_impulse] = [felt.force, felt.torque].map(|mean| dt * DVec3::from_array(mean));
        match &self.mover {
            Mover::Fixed => {}
            Mover::Path(path) => {
                let mut frames: Vec<DVec3> = told.keyframes.iter().copied().map(DVec3::from_array).collect();
                frames.resize(path.len(), DVec3::ZERO);
                // Poses are the path's, and the velocity is the way between them over dt.
                path.position_back(time, step.position - linear / dt, &mut frames);
                path.position_back(time + dt, after + linear / dt, &mut frames);
                told.keyframes = frames.into_iter().map(|frame| frame.to_array()).collect();
                *owed = BodyCotangents { impulse: owed.impulse, ..BodyCotangents::default() };
                return of_gravity;
            }
            Mover::Velocity => {
                let turn = dt * self.state.command.angular;
                add(&mut told.linear, linear + dt * after);
                add(&mut told.angular, angular + dt * (turn_slopes(turn).transpose() * after_turn));
                owed.pose.rotation = (DQuat::from_scaled_axis(turn).conjugate() * after_turn).to_array();
            }
            Mover::Free { mass, inertia, inverse_inertia } => {
                // M of what is owed to V_f is what is owed to the balance. I (ω_f − V) = −τ.
                let (inertia, inverse) =
                    (turned(*inertia, &self.state.pose), turned(*inverse_inertia, &self.state.pose));
                let (of_balance, of_turning) = (linear / *mass, inverse * angular);
                let missing = inverse * -angular_impulse;
                add(
                    &mut owed.pose.rotation,
                    (-angular_impulse).cross(of_turning) - missing.cross(inertia * of_turning),
                );
                told.mass -= (of_balance.dot(impulse) + of_turning.dot(angular_impulse)) / mass;
                of_gravity = dt * linear;
                (owed.velocity, owed.angular_velocity) = (linear.to_array(), angular.to_array());
            }
            Mover::Servo(Guided { servo, axis, mass }) => {
                let (along, damped) = (axis.dot(linear), 1.0 + servo.damping * dt / mass);
                let pushed = servo.force_at(time) * dt / mass;
                // v_f = (v + F dt / m) / (1 + c dt / m), and what comes of it.
                let free = axis.dot(self.state.twist.linear) - axis.dot(impulse) / mass;
                let of_mass = along * (free * servo.damping * dt / mass - pushed) / (mass * damped)
                    - along / mass * axis.dot(impulse) / mass;
                told.mass += of_mass;
                told.force += along * servo.share_at(time) * dt / (mass * damped);
                if servo.mass.is_none() {
                    told.force += of_mass * mass / servo.whole();
                }
                owed.velocity = (along / damped * *axis).to_array();
            }
        }
        add(&mut owed.pose.position, step.position);
        add(&mut owed.pose.rotation, step.rotation);
        of_gravity
    }
}
