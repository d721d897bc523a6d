//! A rigid body of the scene: what it is, how it moves, what it answers.

use crate::Refusal;
use crate::mass::Filling;
use crate::motion::{KeyframePath, Pose, rotation_from};
use crate::sdf::Sdf;
use barchan_core::contact::{System, Twist};
use barchan_core::scene::{Contact, Motion, Servo, Tool};
use barchan_core::surface::Mesh;
use barchan_core::{BodyState, Error, Placement, Result, Scene, Vec3};
use glam::{DMat3, DVec3};
use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};
use std::sync::{Arc, OnceLock};

#[derive(Clone)]
pub(crate) struct Body {
    pub(super) name: String,
    /// About the reference point.
    pub(crate) shape: Sdf,
    /// The same for pictures, once one is made.
    pub(super) mesh: OnceLock<Arc<Mesh>>,
    pub(super) contact: Contact,
    pub(super) mover: Mover,
    /// Greatest distance of a surface point from the reference point [m].
    pub(crate) extent: f64,
    pub(crate) state: State,
    /// Pose at the start of the step under way.
    pub(super) from: Pose,
    /// Pose at its end, for driven bodies.
    pub(super) target: Pose,
    pub(super) ignored_position: bool,
}

/// What changes from step to step.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct State {
    pub(crate) pose: Pose,
    pub(crate) twist: Twist,
    /// What an agent last asked of a body driven by velocity.
    pub(super) command: Twist,
    /// About the centre of mass, for free bodies [kg m²/s]. The state, of which the angular velocity is made: in free flight
    /// it is this that stays.
    pub(super) angular_momentum: DVec3,
    /// Is it there?
    pub(super) present: bool,
}

impl State {
    /// Are all numbers finite, and is the rotation one? Turning a body for long leaves it one to many digits.
    pub(super) fn is_sound(&self) -> bool {
        self.pose.position.is_finite()
            && (self.pose.rotation.length() - 1.0).abs() < 1e-6
            && self.twist.is_finite()
            && self.command.is_finite()
            && self.angular_momentum.is_finite()
    }
}

#[derive(Clone)]
pub(super) enum Mover {
    Fixed,
    Path(KeyframePath),
    Velocity,
    Free { mass: f64, inertia: DMat3, inverse_inertia: DMat3 },
    Servo(Guided),
}

/// A body that a force pushes along an axis, on which a guide keeps it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guided {
    pub(crate) servo: Servo,
    /// Unit vector along which the force acts and the body moves.
    pub(crate) axis: DVec3,
    /// Inertia against it [kg].
    pub(crate) mass: f64,
}

impl Guided {
    /// The velocity after a step of `dt` from `time` [s] without contact: damping at its end, so that no step is too long for it.
    fn pushed(&self, velocity: DVec3, time: f64, dt: f64) -> DVec3 {
        let gained = self.servo.force_at(time) * dt / self.mass;
        (velocity + gained * self.axis) / (1.0 + self.servo.damping * dt / self.mass)
    }
}

/// What a body that answers the ground's impulses sets against them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Answering {
    /// Mass [kg].
    pub(super) mass: f64,
    /// Inertia about the centre of mass, world frame [kg m²]; none in a guide, which lets nothing turn.
    pub(super) inertia: DMat3,
    /// The only direction in which it moves, if a guide keeps it.
    pub(super) axis: Option<DVec3>,
}

impl Answering {
    /// What it has out of balance at the twist `at`, with what contact gives it, if it would move by `free` alone [N s, N m s].
    pub(super) fn residual(&self, free: &Twist, at: &Twist, system: &System) -> Vector6<f64> {
        let force = self.mass * (free.linear - at.linear);
        let torque = self.inertia * (free.angular - at.angular);
        Vector6::from(system.impulse) + vector6(force, torque)
    }

    /// By how much the twist has to change for balance; `None` if that has no solution.
    pub(super) fn answer(&self, residual: &Vector6<f64>, system: &System) -> Option<Twist> {
        if let Some(axis) = self.axis {
            let contact = DMat3::from_cols_array_2d(&[0, 1, 2].map(|i| [0, 1, 2].map(|j| system.matrix[j][i])));
            let along = axis.dot(DVec3::new(residual[0], residual[1], residual[2]));
            let step = along / (self.mass + axis.dot(contact * axis));
            return step.is_finite().then_some(Twist { linear: step * axis, angular: DVec3::ZERO });
        }
        let contact = Matrix6::from_fn(|i, j| system.matrix[i][j]);
        let own = Matrix6::from_fn(|i, j| match (i / 3, j / 3) {
            (0, 0) if i == j => self.mass,
            (1, 1) => self.inertia.col(j % 3)[i % 3],
            _ => 0.0,
        });
        let matrix = own + contact;
        let step = if system.symmetric { matrix.cholesky()?.solve(residual) } else { matrix.lu().solve(residual)? };
        Some(Twist { linear: DVec3::new(step[0], step[1], step[2]), angular: DVec3::new(step[3], step[4], step[5]) })
    }

    /// What an impulse adds to its velocity [m/s].
    pub(super) fn gains(&self, impulse: DVec3) -> DVec3 {
        let felt = self.axis.map_or(impulse, |axis| axis.dot(impulse) * axis);
        felt / self.mass
    }

    /// Twice its kinetic energy at a twist [J].
    pub(super) fn twice_energy(&self, twist: &Twist) -> f64 {
        self.mass * twist.linear.length_squared() + twist.angular.dot(self.inertia * twist.angular)
    }
}

pub(super) fn vector6(a: DVec3, b: DVec3) -> Vector6<f64> {
    Vector6::new(a.x, a.y, a.z, b.x, b.y, b.z)
}

impl Body {
    /// Can it ever move?
    pub(super) fn moves(&self) -> bool {
        !matches!(self.mover, Mover::Fixed)
    }

    pub(crate) fn new(tool: &Tool, scene: &Scene, path: &str) -> Result<Self> {
        let shape = Sdf::from_shape(&tool.shape, &scene.folder, &format!("{path}.shape"))?;
        Self::from_shape(&tool.in_world(&scene.world), shape).map_err(|refusal| refusal.at(path))
    }

    fn from_shape(tool: &Tool, mut shape: Sdf) -> Result<Self, Refusal> {
        check_contact(tool.contact)?;
        let mut pose = Pose { position: vector(tool.position, "position")?, rotation: rotation_from(tool.rotation)? };
        let (mut command, mut angular_momentum) = (Twist::default(), DVec3::ZERO);
        let mut ignored_position = false;
        let mover = match &tool.motion {
            Motion::Fixed => Mover::Fixed,
            Motion::Keyframes { frames, interpolation } => {
                let path = KeyframePath::new(frames, *interpolation, pose.rotation)?;
                let start = path.pose(0.0);
                ignored_position = pose.position != DVec3::ZERO && pose.position != start.position;
                pose = start;
                Mover::Path(path)
            }
            Motion::Velocity { linear, angular } => {
                command =
                    Twist { linear: vector(*linear, "motion.linear")?, angular: vector(*angular, "motion.angular")? };
                Mover::Velocity
            }
            Motion::Free { mass, linear, angular, restitution } => {
                if !(*mass > 0.0 && mass.is_finite()) {
                    return Err(Refusal::new(format!("the mass is {mass}"), "give a positive mass in kg"));
                }
                if !(0.0..=1.0).contains(restitution) {
                    return Err(Refusal::new(format!("the restitution is {restitution}"), "give a number from 0 to 1"));
                }
                let filling = Filling::of(&shape)?;
                let inertia = filling.inertia * (mass / filling.volume);
                command =
                    Twist { linear: vector(*linear, "motion.linear")?, angular: vector(*angular, "motion.angular")? };
                pose.position = pose.apply(filling.centre);
                shape = shape.seen_from(filling.centre);
                angular_momentum = turned(inertia, &pose) * command.angular;
                Mover::Free { mass: *mass, inertia, inverse_inertia: inertia.inverse() }
            }
            Motion::Servo(servo) => {
                let axis = vector(servo.axis, "motion.axis")?;
                let axis = axis
                    .try_normalize()
                    .ok_or_else(|| Refusal::new("motion.axis is zero", "give the direction in which the force acts"))?;
                Mover::Servo(Guided { servo: *servo, axis, mass: servo.inertia() })
            }
        };
        let extent = shape.extent();
        let present = tool.is_present(0.0);
        let state = State { pose, twist: command, command, angular_momentum, present };
        Ok(Self {
            name: tool.name.clone(),
            shape,
            mesh: OnceLock::new(),
            contact: tool.contact,
            mover,
            extent,
            state,
            from: pose,
            target: pose,
            ignored_position,
        })
    }

    /// Where this body is at the end of a step from `time`, if it is driven.
    pub(super) fn driven_pose(&self, time: f64, dt: f64) -> Option<Pose> {
        match &self.mover {
            Mover::Fixed => Some(self.state.pose),
            Mover::Path(path) => Some(path.pose(time + dt)),
            Mover::Velocity => Some(self.state.pose.advanced(&self.state.command, dt)),
            Mover::Free { .. } | Mover::Servo(_) => None,
        }
    }

    /// Takes up in its velocity what acts on it in a step of `dt` from `time` [s] besides contact, if it is not driven.
    pub(super) fn accelerate(&mut self, gravity: DVec3, time: f64, dt: f64) {
        match &self.mover {
            Mover::Servo(guided) => self.state.twist.linear = guided.pushed(self.state.twist.linear, time, dt),
            _ => self.state.twist.linear += gravity * dt,
        }
    }

    /// What it sets against the ground's impulses, if it answers them.
    pub(super) fn answering(&self) -> Option<Answering> {
        match &self.mover {
            Mover::Free { mass, inertia, .. } => {
                Some(Answering { mass: *mass, inertia: turned(*inertia, &self.state.pose), axis: None })
            }
            Mover::Servo(Guided { axis, mass, .. }) => {
                Some(Answering { mass: *mass, inertia: DMat3::ZERO, axis: Some(*axis) })
            }
            Mover::Fixed | Mover::Path(_) | Mover::Velocity => None,
        }
    }

    /// Takes up an impulse [N s] and an angular impulse [N m s], as far as it answers them.
    pub(super) fn gain(&mut self, [impulse, angular]: [DVec3; 2]) {
        if let Some(answering) = self.answering() {
            self.state.twist.linear += answering.gains(impulse);
        }
        if self.is_free() {
            self.state.angular_momentum += angular;
            self.state.twist.angular = self.spin(&self.state.pose);
        }
    }

    /// Puts it elsewhere, or lets it move otherwise, as far as `placement` says so, if it is free; one that is driven by velocity may be put elsewhere.
    ///
    /// # Errors
    /// If numbers are not finite, or it does not move that way. Then it stays as it is.
    pub(super) fn place(&mut self, placement: &Placement) -> Result<(), Refusal> {
        let Placement { position, rotation, velocity, angular_velocity, joints, joint_rates } = placement;
        if joints.is_some() || joint_rates.is_some() {
            return Err(Refusal::new(
                "it has no joints, and positions or rates of joints are asked for",
                "leave them out",
            ));
        }
        let is_driven = matches!(self.mover, Mover::Velocity);
        if !self.is_free() && !is_driven {
            let what = "it stays, or moves as its keyframes or its guide say";
            return Err(Refusal::new(what, "give it a motion = { free = {} } or { velocity = {} }"));
        }
        if is_driven && (velocity.is_some() || angular_velocity.is_some()) {
            return Err(Refusal::new("it moves as it is told, and a velocity is asked for", "give it a twist"));
        }
        let mut state = self.state;
        if let Some(position) = position {
            state.pose.position = vector(*position, "the position")?;
        }
        if let Some(rotation) = rotation {
            state.pose.rotation = rotation_from(*rotation)?;
        }
        if let Some(velocity) = velocity {
            state.twist.linear = vector(*velocity, "the velocity")?;
        }
        if let Some(angular) = angular_velocity {
            state.twist.angular = vector(*angular, "the angular velocity")?;
        }
        if let Mover::Free { inertia, .. } = self.mover {
            state.angular_momentum = turned(inertia, &state.pose) * state.twist.angular;
        }
        self.state = state;
        Ok(())
    }

    /// Its mass [kg] and its inertia about the centre of mass, body frame [kg m²], if it is free.
    pub(crate) fn free(&self) -> Option<(f64, DMat3)> {
        match self.mover {
            Mover::Free { mass, inertia, .. } => Some((mass, inertia)),
            _ => None,
        }
    }

    /// What pushes it, if a force does.
    pub(crate) fn guided(&self) -> Option<Guided> {
        match self.mover {
            Mover::Servo(guided) => Some(guided),
            _ => None,
        }
    }

    /// Does it stay where it is?
    pub(crate) fn is_fixed(&self) -> bool {
        matches!(self.mover, Mover::Fixed)
    }

    /// Do contacts among rigid bodies move it?
    pub(super) fn is_free(&self) -> bool {
        matches!(self.mover, Mover::Free { .. })
    }

    /// The angular velocity that the angular momentum makes at `pose`.
    pub(super) fn spin(&self, pose: &Pose) -> DVec3 {
        match self.mover {
            Mover::Free { inverse_inertia, .. } => turned(inverse_inertia, pose) * self.state.angular_momentum,
            _ => self.state.twist.angular,
        }
    }

    /// The angular velocity half-way through the coming step, by the implicit midpoint rule: turning with it keeps the energy
    /// of a tumbling body to second order.
    pub(super) fn midway_spin(&self, dt: f64) -> DVec3 {
        // Each round gains a factor |ω| dt / 2, which is a few per cent at most.
        (0..6).fold(self.state.twist.angular, |angular, _| {
            self.spin(&self.state.pose.advanced(&Twist { linear: DVec3::ZERO, angular }, 0.5 * dt))
        })
    }

    pub(super) fn lost(&self, what: &str) -> Error {
        Refusal::new(format!("its {what} is no longer finite"), "lower time.step, or start from the last snapshot")
            .at(&format!("tool '{}'", self.name))
    }

    pub(super) fn report(&self, gravity: DVec3) -> BodyState {
        let State { pose, twist, angular_momentum, .. } = self.state;
        let mut state = BodyState {
            name: self.name.clone(),
            position: pose.position.to_array(),
            rotation: pose.quaternion(),
            velocity: twist.linear.to_array(),
            angular_velocity: twist.angular.to_array(),
            mass: f64::INFINITY,
            kinetic_energy: 0.0,
            potential_energy: 0.0,
            momentum: [0.0; 3],
            angular_momentum: [0.0; 3],
        };
        if let Some(Answering { mass, .. }) = self.answering() {
            let momentum = mass * twist.linear;
            state.mass = mass;
            state.kinetic_energy = 0.5 * (momentum.dot(twist.linear) + angular_momentum.dot(twist.angular));
            // What a servo pushes with is not its weight.
            state.potential_energy = if self.is_free() { -mass * gravity.dot(pose.position) } else { 0.0 };
            state.momentum = momentum.to_array();
            state.angular_momentum = (pose.position.cross(momentum) + angular_momentum).to_array();
        }
        state
    }
}

/// A tensor of the body's frame, seen from the world.
pub(super) fn turned(tensor: DMat3, pose: &Pose) -> DMat3 {
    let rotation = DMat3::from_quat(pose.rotation);
    rotation * tensor * rotation.transpose()
}

pub(crate) fn vector(value: Vec3, key: &str) -> Result<DVec3, Refusal> {
    let v = DVec3::from_array(value);
    if v.is_finite() { Ok(v) } else { Err(Refusal::new(format!("{key} is {value:?}"), "give three finite numbers")) }
}

fn check_contact(contact: Contact) -> Result<(), Refusal> {
    match contact {
        Contact::Coulomb { friction } if !(friction >= 0.0 && friction.is_finite()) => {
            Err(Refusal::new(format!("contact.friction is {friction}"), "give 0 or more, or contact = \"stick\""))
        }
        _ => Ok(()),
    }
}
