//! What a robot is told or given from outside: commands to its joints, blows, and another place.

use super::joints::{Gains, Order};
use super::model::Drive;
use super::touching::Obstacle;
use super::{Robot, State};
use crate::Refusal;
use crate::motion::rotation_from;
use crate::rigid::body::vector;
use barchan_core::contact::Twist;
use barchan_core::{Command, Placement, Scene, Vec3};
use glam::{DQuat, DVec3};
use nalgebra::DVector;

/// How far beyond a joint's limits it may be put [rad or m].
const GIVEN: f64 = 0.01;

impl Robot {
    /// Takes a command to its joints.
    ///
    /// # Errors
    /// If it takes no such commands, or they do not fit its joints.
    pub(super) fn act(&mut self, command: &Command) -> Result<(), Refusal> {
        if self.is_tool {
            let what = format!("it moves by what acts on it, and {} is asked for", command.name());
            return Err(Refusal::new(what, "give it a motion = { velocity = {} }"));
        }
        let (targets, rates, torques, holds) = match command {
            Command::JointTargets(targets) => (Some(targets), None, None, true),
            Command::JointTorques(torques) => (None, None, Some(torques), false),
            Command::JointMotion { targets, rates, torques } => {
                (targets.as_ref(), rates.as_ref(), torques.as_ref(), true)
            }
            other => {
                let what = format!("it is moved by its joints, and {} is asked for", other.name());
                return Err(Refusal::new(what, "give joint targets or joint torques"));
            }
        };
        let drives = &self.model.drives;
        let has_none = |of: fn(&Gains) -> f64| !drives.is_empty() && self.gains.iter().all(|gains| of(gains) == 0.0);
        if targets.is_some() && has_none(|gains| gains.kp) {
            let what = "no motor of it has kp, so that joint targets move nothing";
            return Err(Refusal::new(
                what,
                "give the robot a [[robot.motor]] with kp and kd in the scene, or give joint torques",
            ));
        }
        if rates.is_some() && has_none(|gains| gains.kd) {
            let what = "no motor of it has kd, so that joint rates move nothing";
            return Err(Refusal::new(
                what,
                "give the robot a [[robot.motor]] with kd in the scene, or give joint torques",
            ));
        }
        let holding = drives.iter().zip(&self.gains).find(|(_, gains)| holds && targets.is_none() && gains.kp != 0.0);
        if let Some((drive, _)) = holding {
            let what = format!("the motor of joint '{}' has kp, and no joint targets are given", drive.name);
            return Err(Refusal::new(what, "give joint targets, too, or the joint a motor with kp = 0"));
        }
        for numbers in [targets, rates, torques].into_iter().flatten() {
            self.check_numbers(numbers)?;
        }
        let number = |of: Option<&Vec<f64>>, d: usize| of.map_or(0.0, |numbers| numbers[d]);
        let order = |(d, drive): (usize, &Drive)| Order {
            target: number(targets, d).clamp(drive.limits[0], drive.limits[1]),
            rate: number(rates, d),
            torque: number(torques, d),
            holds,
        };
        self.state.orders = Some(drives.iter().enumerate().map(order).collect());
        Ok(())
    }

    /// Are there as many numbers as joints, and all finite?
    fn check_numbers(&self, numbers: &[f64]) -> Result<(), Refusal> {
        let (drives, mend) = (&self.model.drives, "give a finite number for each of its joints");
        if numbers.len() != drives.len() {
            let what = format!("there are {} numbers for its {} joints", numbers.len(), drives.len());
            return Err(Refusal::new(what, mend));
        }
        match numbers.iter().zip(drives).find(|(x, _)| !x.is_finite()) {
            Some((x, drive)) => Err(Refusal::new(format!("the number for joint '{}' is {x}", drive.name), mend)),
            None => Ok(()),
        }
    }

    /// Takes a blow on one of its bodies: an impulse through that one's centre of mass [N s], and an angular impulse [N m s].
    ///
    /// # Errors
    /// If they are not finite, or nothing of it can move that way.
    pub(crate) fn take_blow(&mut self, body: usize, linear: Vec3, angular: Vec3) -> Result<(), Refusal> {
        let [linear, angular] = [linear, angular].map(DVec3::from_array);
        if !(linear.is_finite() && angular.is_finite()) {
            return Err(Refusal::new("the impulse is not finite", "give finite numbers"));
        }
        self.take_over().ok_or_else(lost)?;
        let mut gained = DVector::zeros(self.step.rates.len());
        self.step.places[self.solids[body]].add_wrench(linear, angular, &mut gained);
        if gained.iter().all(|x| *x == 0.0) && (linear, angular) != (DVec3::ZERO, DVec3::ZERO) {
            let what = format!("'{}' cannot move that way", self.body_name(body));
            return Err(Refusal::new(what, "push what is free, or a link that joints let go"));
        }
        let factor = self.step.mass.clone().cholesky().ok_or_else(lost)?;
        self.step.rates += factor.solve(&gained);
        self.state.rates.copy_from_slice(self.step.rates.as_slice());
        Ok(())
    }

    /// Puts it elsewhere, or lets it move otherwise, as far as `placement` says so.
    ///
    /// # Errors
    /// If numbers are not finite, do not fit its joints or are beyond their limits, what should move is fixed, or it would be outside the world. Then it stays as it is.
    pub(super) fn place(&mut self, placement: &Placement, scene: &Scene) -> Result<(), Refusal> {
        let Placement { position, rotation, velocity, angular_velocity, joints, joint_rates } = placement;
        if self.guided.is_some() {
            return Err(Refusal::new("a guide keeps it where it is", "give it a motion = { free = {} }"));
        }
        if !self.floating && [velocity, angular_velocity].iter().any(|given| given.is_some_and(|v| v != [0.0; 3])) {
            return Err(Refusal::new("its base is fixed, and has no velocity", "leave out fixed = true"));
        }
        self.take_over().ok_or_else(lost)?;
        let (model, first) = (self.model.clone(), self.base_rates());
        let before = self.step.places[0].twist(&self.step.rates);
        let mut state = State { owed: 0.0, sensed: self.state.sensed.afresh(), ..self.state.clone() };
        // The base's centre of mass, seen from its frame's origin.
        let arm = |turned: DQuat| turned * model.links[0].centre;
        let linear = before.at(-arm(self.state.base.rotation));
        if let Some(rotation) = rotation {
            state.base.rotation = rotation_from(*rotation)?;
        }
        if let Some(position) = position {
            state.base.position = vector(*position, "the position")?;
        }
        if let Some(joints) = joints {
            self.check_numbers(joints)?;
            // What has been read may be a little beyond, since stops give.
            let beyond =
                |(x, drive): &(&f64, &Drive)| !(drive.limits[0] - GIVEN..=drive.limits[1] + GIVEN).contains(*x);
            if let Some((x, drive)) = joints.iter().zip(&model.drives).find(beyond) {
                let what = format!("{x} is beyond the limits of joint '{}'", drive.name);
                let [low, high] = drive.limits;
                return Err(Refusal::new(what, format!("give a position from {low} to {high}")));
            }
            state.positions.clone_from(joints);
        }
        if let Some(rates) = joint_rates {
            self.check_numbers(rates)?;
            state.rates[first..].copy_from_slice(rates);
        }
        if self.floating {
            let given =
                |given: &Option<Vec3>, key: &str, kept: DVec3| given.map_or(Ok(kept), |given| vector(given, key));
            let angular = given(angular_velocity, "the angular velocity", before.angular)?;
            let linear = given(velocity, "the velocity", linear)?;
            let at_centre = Twist { linear, angular }.at(arm(state.base.rotation));
            state.rates[..3].copy_from_slice(&at_centre.to_array());
            state.rates[3..6].copy_from_slice(&angular.to_array());
        }
        let orders = self.path.orders(0.0, 0.0);
        let step = Self::at_rest(&model, self.floating, &self.solids, &state, orders)
            .ok_or_else(|| Refusal::new("its joints cannot be solved there", "give other positions of its joints"))?;
        let kept = (std::mem::replace(&mut self.state, state), std::mem::replace(&mut self.step, step));
        if !self.is_within_reach(scene) {
            (self.state, self.step) = kept;
            return Err(Refusal::outside(&scene.world));
        }
        self.walls = Obstacle::walls(&scene.world, self.state.base.position);
        Ok(())
    }
}

fn lost() -> Refusal {
    Refusal::new("its motion is lost", "start from the last snapshot")
}
