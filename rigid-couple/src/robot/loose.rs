//! A scene's tools that answer, beside robots or one another: each a robot of one body, so that what touches it is solved together with it.

use super::dynamics::rates_of;
use super::joints::{Gains, Order};
use super::model::{Drive, Freedom, Joint, Link, RobotModel};
use super::motion::JointPath;
use super::sense::Sensed;
use super::touching::{Body, Obstacle};
use super::visual::Visual;
use super::{Robot, State};
use crate::Refusal;
use crate::motion::Pose;
use crate::rigid::body::{self, Guided};
use crate::surface::mesh_of;
use crate::world::friction_of;
use barchan_core::scene::{CollisionMeshes, Motion, Tool};
use barchan_core::{Result, Scene};
use glam::{DMat3, DVec3};
use std::path::Path;
use std::sync::Arc;

impl Guided {
    /// What the motor of its guide is told at a time [s]: the force, and what bears its weight.
    pub(super) fn order(&self, time: f64, gravity: DVec3) -> Order {
        Order { torque: self.servo.force_at(time) - self.mass * gravity.dot(self.axis), ..Order::default() }
    }

    /// How fast the force alone can make it faster [m/s²].
    pub(super) fn most(&self) -> f64 {
        self.servo.whole().abs() / self.mass
    }
}

impl Robot {
    /// A tool that answers what it feels, and stands at `path` in the scene. A free one is a base without joints, its frame at its centre of mass, along the tool's axes;
    /// one that a force pushes slides on a fixed base.
    ///
    /// # Errors
    /// If its shape, mass or motion cannot be used.
    pub(super) fn loose(tool: &Tool, path: &str, scene: &Scene) -> Result<Self> {
        let body = body::Body::new(tool, scene, path)?;
        let (pose, twist, guided) = (body.state.pose, body.state.twist, body.guided());
        let free = body.free().zip(match tool.motion {
            Motion::Free { restitution, .. } => Some(restitution),
            _ => None,
        });
        let still = |refusal: Refusal| refusal.at(path);
        let not_loose = || still(Refusal::new("nothing that it feels moves it", "give it a motion = { free = {} }"));
        let ((mass, inertia), restitution) = match (free, guided) {
            (Some(free), _) => free,
            (None, Some(guided)) => ((guided.mass, DMat3::ZERO), 0.0),
            (None, None) => return Err(not_loose()),
        };
        let own = Link {
            name: tool.name.clone(),
            parent: None,
            joint: Joint::fixed(&tool.name),
            mass,
            centre: DVec3::ZERO,
            inertia,
            shape: Some(body.shape.clone()),
            visuals: vec![Visual { mesh: mesh_of(&body.shape), place: Pose::IDENTITY, colour: None }],
        };
        let (links, drives) = match guided {
            None => (vec![own], Vec::new()),
            Some(Guided { servo, axis, .. }) => {
                let base = Link::frame(&tool.name, None, Joint::fixed(&tool.name));
                let along = pose.rotation.conjugate() * axis;
                let joint = Joint::moving(&tool.name, Freedom::Prismatic, Pose::IDENTITY, along);
                let drive = Drive {
                    name: tool.name.clone(),
                    turns: false,
                    limits: [f64::NEG_INFINITY, f64::INFINITY],
                    effort: f64::INFINITY,
                    speed: f64::INFINITY,
                    damping: servo.damping,
                    friction: 0.0,
                    armature: 0.0,
                };
                (vec![base, Link { parent: Some(0), joint, ..own }], vec![drive])
            }
        };
        let solids = vec![links.len() - 1];
        let positions = vec![0.0; drives.len()];
        let gains = vec![Gains::default(); drives.len()];
        let model = RobotModel {
            name: tool.name.clone(),
            collision_meshes: CollisionMeshes::Exact,
            links,
            drives,
            files: Vec::new(),
            warnings: Vec::new(),
        };
        let motion = JointPath::new(None, &model, &pose, &positions, Path::new("")).map_err(still)?;
        let floating = guided.is_none();
        let mut rates = vec![0.0; rates_of(&model, floating)];
        if floating {
            rates[..3].copy_from_slice(&twist.linear.to_array());
            rates[3..].copy_from_slice(&twist.angular.to_array());
        }
        let gravity = DVec3::from_array(scene.gravity_at(0.0));
        let orders = guided.map(|guided| vec![guided.order(0.0, gravity)]);
        let sensed = Sensed::at_start(gravity);
        let state = State { base: pose, positions, rates, owed: 0.0, orders, clock: 0.0, held: None, sensed };
        let step = Self::at_rest(&model, floating, &solids, &state, motion.orders(0.0, 0.0)).ok_or_else(not_loose)?;
        Ok(Self {
            name: tool.name.clone(),
            floating,
            names: vec![tool.name.clone()],
            solids,
            bodies: vec![Some(Body::new(&body.shape))],
            extents: vec![body.extent],
            gains,
            path: motion,
            corrections: Vec::new(),
            friction: friction_of(tool.contact),
            restitution,
            is_tool: true,
            walls: if floating { Obstacle::walls(&scene.world, pose.position) } else { Vec::new() },
            guided,
            pairs: Vec::new(),
            state,
            step,
            model: Arc::new(model),
        })
    }
}
