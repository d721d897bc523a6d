//! What a robot's sensors say.

use super::Robot;
use super::together::Felt;
use super::touching::forces;
use barchan_core::{LinkState, PointForce, RobotState, Wrench};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// What sensors keep of the last step.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Sensed {
    /// Gravity [m/s²].
    gravity: DVec3,
    /// Velocity of the base's frame before the step [m/s], and how much of the step has gone since [s].
    before: DVec3,
    #[serde(skip)]
    gone: f64,
    /// Mean acceleration of the base's frame less gravity, along the world's axes [m/s²].
    specific_force: DVec3,
    /// Bodies that touched what is rigid: where [m], and with what mean force [N].
    rigid: Vec<(usize, DVec3, DVec3)>,
}

impl Sensed {
    /// Before the first step.
    pub(super) fn at_start(gravity: DVec3) -> Self {
        Self { gravity, ..Self::default() }
    }

    /// As before the first step of all, where it has been put elsewhere.
    pub(super) fn afresh(&self) -> Self {
        Self::at_start(self.gravity)
    }
}

impl Robot {
    /// Velocity of the base's frame [m/s].
    fn base_velocity(&self) -> DVec3 {
        let base = &self.step.places[0];
        base.twist(&self.step.rates).at(base.frame.position - base.centre)
    }

    /// Takes note of how the base moves before a step of all levels under `gravity` [m/s²].
    pub(super) fn sense_start(&mut self, gravity: DVec3) {
        let before = self.base_velocity();
        self.state.sensed = Sensed { before, ..Sensed::at_start(gravity) };
    }

    /// Takes note of what rigid things do to its bodies in the step under way, with its rates as they are solved and before it moves.
    pub(super) fn sense_rigid(&mut self) {
        let (points, dt) = (&self.step.points, self.step.dt);
        let place = |body: usize| &self.step.places[self.solids[body]];
        let mut felt = Vec::new();
        for (body, touches) in points.touches.iter().enumerate().filter(|(_, touches)| !touches.is_empty()) {
            let twist = place(body).twist(&self.step.rates);
            felt.extend(forces(&points.nodes, touches, &twist, dt).map(|(at, force)| (body, at, force)));
        }
        for pair in &points.pairs {
            let twist = pair.place.twist(&self.step.rates);
            for (at, force) in forces(&points.nodes, &pair.touches, &twist, dt) {
                felt.extend([(pair.bodies[0], at, force), (pair.bodies[1], at, -force)]);
            }
        }
        self.state.sensed.rigid = felt;
    }

    /// Takes note of what other robots do to its bodies in a step, behind it.
    pub(super) fn sense_others(&mut self, felt: Vec<Felt>) {
        self.state.sensed.rigid.extend(felt);
    }

    /// Takes note of how the base moves before a step that a device takes: what is rigid is far off then.
    pub(super) fn sense_on_device(&mut self) {
        self.sense_start(self.state.sensed.gravity);
    }

    /// Takes note of the gravity of steps to come [m/s²].
    pub(super) fn sense_gravity(&mut self, gravity: DVec3) {
        self.state.sensed.gravity = gravity;
    }

    /// Takes note of how the base moves after a step of `dt` [s], or a further part of one where levels take steps of their own.
    pub(super) fn sense_end(&mut self, dt: f64) {
        let now = self.base_velocity();
        let sensed = &mut self.state.sensed;
        sensed.gone += dt;
        sensed.specific_force = (now - sensed.before) / sensed.gone - sensed.gravity;
    }

    /// What its sensors say; what the soft ground does is not known here.
    pub(super) fn sensors(&self) -> RobotState {
        let (base, sensed) = (self.state.base, &self.state.sensed);
        let along_base = |x: DVec3| (base.rotation.conjugate() * x).to_array();
        let link = |body: usize| {
            let (pose, twist) = (self.pose(body), self.twist(body));
            LinkState {
                name: self.body_name(body).to_owned(),
                centre: pose.position.to_array(),
                rotation: pose.quaternion(),
                velocity: twist.linear.to_array(),
                angular_velocity: twist.angular.to_array(),
                ground: Wrench::default(),
                rigid: (sensed.rigid.iter().filter(|felt| felt.0 == body))
                    .map(|(_, at, force)| PointForce { position: at.to_array(), force: force.to_array() })
                    .collect(),
            }
        };
        RobotState {
            name: self.name.clone(),
            position: base.position.to_array(),
            rotation: base.quaternion(),
            velocity: along_base(self.base_velocity()),
            angular_velocity: along_base(self.twist(0).angular),
            specific_force: along_base(sensed.specific_force),
            projected_gravity: along_base(sensed.gravity.normalize_or_zero()),
            links: (0..self.solids.len()).map(link).collect(),
        }
    }
}
