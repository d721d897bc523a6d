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
    /// If numbers are not finite, do not fit its joints or are beyond their limits, what should move is fixed, or it would be outside the world or behind a wall that it meets. Then
    /// it stays as it is.
    pub(super) fn place(&mut self, placement: &Placement, scene: &Scene) -> Result<(), Refusal> {
        let Placement { position, rotation, velocity, angular_velocity, joints, joint_rates } = placement;
        if self.guided.is_some() {
            return Err(Refusal::new("a guide keeps it where it is", "give it a motion = { free = {} }"));
        }
        if !self.floating && [velocity, angular_velocity].iter().any(|given| given.is_some_and(|v| v != [0.0; 3])) {
            return Err(Refusal::new("its base is fixed, and has no velocity", "leave out fixed = true"));
        }
        let given = |given: &Option<Vec3>, key: &str| given.map(|given| vector(given, key)).transpose();
        let [position, velocity, angular] = [
            given(position, "the position")?,
            given(velocity, "the velocity")?,
            given(angular_velocity, "the angular velocity")?,
        ];
        let rotation = rotation.map(rotation_from).transpose()?;
        [joints, joint_rates].into_iter().flatten().try_for_each(|numbers| self.check_numbers(numbers))?;
        // What has been read may be a little beyond, since stops give.
        let positions = joints.iter().flatten().zip(&self.model.drives);
        positions.into_iter().try_for_each(|(x, drive)| drive.check_position(*x, GIVEN))?;
        self.check_walls(position, scene)?;

        self.take_over().ok_or_else(lost)?;
        let model = self.model.clone();
        let before = self.step.places[0].twist(&self.step.rates);
        let mut state = State { owed: 0.0, sensed: self.state.sensed.afresh(), ..self.state.clone() };
        // The base's centre of mass, seen from its frame's origin.
        let arm = |turned: DQuat| turned * model.links[0].centre;
        let linear = velocity.unwrap_or_else(|| before.at(-arm(state.base.rotation)));
        let angular = angular.unwrap_or(before.angular);
        state.base.position = position.unwrap_or(state.base.position);
        state.base.rotation = rotation.unwrap_or(state.base.rotation);
        let (of_base, of_joints) = state.rates.split_at_mut(self.base_rates());
        if self.floating {
            let at_centre = Twist { linear, angular }.at(arm(state.base.rotation));
            of_base[..3].copy_from_slice(&at_centre.to_array());
            of_base[3..].copy_from_slice(&angular.to_array());
        }
        if let Some(rates) = joint_rates {
            of_joints.copy_from_slice(rates);
        }
        if let Some(joints) = joints {
            state.positions.clone_from(joints);
        }
        let orders = self.path.orders(0.0, 0.0);
        let step = Self::at_rest(&model, self.floating, &self.solids, &state, orders)
            .ok_or_else(|| Refusal::new("its joints cannot be solved there", "give other positions of its joints"))?;
        let kept = (std::mem::replace(&mut self.state, state), std::mem::replace(&mut self.step, step));
        if !self.is_within_reach(scene) {
            (self.state, self.step) = kept;
            return Err(Refusal::outside(&scene.world));
        }
        Ok(())
    }

    /// Would its base be on the same sides of the world's walls there as at its start? It meets those alone before which it began.
    fn check_walls(&self, position: Option<DVec3>, scene: &Scene) -> Result<(), Refusal> {
        let Some(position) = position else { return Ok(()) };
        let met = |walls: &[Obstacle]| walls.iter().map(|wall| *wall.bounds()).collect::<Vec<_>>();
        if met(&Obstacle::walls(&scene.world, position)) == met(&self.walls) {
            return Ok(());
        }
        let what = "its base would be on the other side of a wall of the world than at the start";
        Err(Refusal::new(what, "start it on that side"))
    }
}

fn lost() -> Refusal {
    Refusal::new("its motion is lost", "start from the last snapshot")
}
