//! A scene's free tools beside robots: each a robot of one link without joints, so that robots that touch it are solved together with it.

use super::dynamics::rates_of;
use super::model::{Joint, Link, RobotModel};
use super::motion::JointPath;
use super::sense::Sensed;
use super::touching::{Body, Obstacle};
use super::visual::Visual;
use super::{Robot, State};
use crate::Refusal;
use crate::motion::Pose;
use crate::rigid::body;
use crate::surface::mesh_of;
use crate::world::friction_of;
use barchan_core::scene::{Motion, Tool};
use barchan_core::{Result, Scene};
use glam::DVec3;
use std::path::Path;
use std::sync::Arc;

impl Robot {
    /// A free tool, which stands at `path` in the scene, among `tools` that do not answer; its link's frame is at its centre of mass, along the tool's axes.
    ///
    /// # Errors
    /// If its shape, mass or motion cannot be used.
    pub(super) fn loose(tool: &Tool, path: &str, scene: &Scene, tools: &[Obstacle]) -> Result<Self> {
        let body = body::Body::new(tool, scene, path)?;
        let (Motion::Free { restitution, .. }, Some((mass, inertia))) = (&tool.motion, body.free()) else {
            return Err(Refusal::new("it is not free", "give it a motion = { free = {} }").at(path));
        };
        let (pose, twist) = (body.state.pose, body.state.twist);
        let visuals = vec![Visual { mesh: mesh_of(&body.shape), place: Pose::IDENTITY, colour: None }];
        let link = Link {
            name: tool.name.clone(),
            parent: None,
            joint: Joint::fixed(&tool.name),
            mass,
            centre: DVec3::ZERO,
            inertia,
            shape: Some(body.shape.clone()),
            visuals,
        };
        let model = RobotModel { name: tool.name.clone(), links: vec![link], drives: Vec::new(), warnings: Vec::new() };
        let still = |refusal: Refusal| refusal.at(path);
        let motion = JointPath::new(None, &model, &pose, &[], Path::new("")).map_err(still)?;
        let mut rates = vec![0.0; rates_of(&model, true)];
        rates[..3].copy_from_slice(&twist.linear.to_array());
        rates[3..].copy_from_slice(&twist.angular.to_array());
        let mut obstacles = Obstacle::walls(&scene.world, pose.position);
        obstacles.extend_from_slice(tools);
        let sensed = Sensed::at_start(DVec3::from_array(scene.gravity_at(0.0)));
        let state = State { base: pose, positions: Vec::new(), rates, orders: None, clock: 0.0, held: None, sensed };
        let step = Self::at_rest(&model, true, &[0], &state, Vec::new())
            .ok_or_else(|| still(Refusal::new("it has no mass", "give it one")))?;
        Ok(Self {
            name: tool.name.clone(),
            floating: true,
            names: vec![tool.name.clone()],
            solids: vec![0],
            bodies: vec![Some(Body::new(&body.shape))],
            extents: vec![body.extent],
            gains: Vec::new(),
            path: motion,
            corrections: Vec::new(),
            friction: friction_of(tool.contact),
            restitution: *restitution,
            is_tool: true,
            obstacles,
            pairs: Vec::new(),
            state,
            step,
            model: Arc::new(model),
        })
    }
}
