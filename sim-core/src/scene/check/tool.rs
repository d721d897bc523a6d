//! What tools must hold.

use super::posed_bounds;
use crate::Result;
use crate::scene::{Contact, Motion, Scene, Servo, Shape, Tool};

impl Scene {
    pub(super) fn check_tool(&self, path: &str, tool: &Tool) -> Result<()> {
        self.check_shape(&format!("{path}.shape"), &tool.shape)?;
        self.require(
            !tool.shape.any(|shape| matches!(shape, Shape::Difference(_) | Shape::Intersection(_))),
            &format!("{path}.shape"),
            "differences and intersections are for soft bodies",
            "use a union of shapes or a mesh",
        )?;
        self.check_rotation(&format!("{path}.rotation"), &tool.rotation)?;
        if let Contact::Coulomb { friction } = tool.contact {
            self.not_negative(&format!("{path}.contact.coulomb.friction"), friction)?;
        }
        self.check_times(path, tool)?;
        match &tool.motion {
            Motion::Fixed | Motion::Velocity { .. } => Ok(()),
            Motion::Keyframes { frames, .. } => {
                let path = format!("{path}.motion.keyframes.frames");
                self.require(!frames.is_empty(), &path, "is empty", "give at least one keyframe")?;
                for (i, frame) in frames.iter().enumerate() {
                    let before = if i == 0 { f64::NEG_INFINITY } else { frames[i - 1].time };
                    self.rises(&format!("{path}[{i}].time"), before, frame.time)?;
                    if let Some(rotation) = &frame.rotation {
                        self.check_rotation(&format!("{path}[{i}].rotation"), rotation)?;
                    }
                }
                Ok(())
            }
            Motion::Free { mass, restitution, .. } => {
                let path = format!("{path}.motion.free");
                self.positive(&format!("{path}.mass"), *mass)?;
                self.require(
                    (0.0..=1.0).contains(restitution),
                    &format!("{path}.restitution"),
                    format!("is {restitution}"),
                    "must be from 0 to 1",
                )?;
                self.require(
                    !tool.shape.is_ground(),
                    &path,
                    "planes and terrains are ground, which cannot move freely",
                    "use a box, or motion = \"fixed\"",
                )
            }
            Motion::Servo(servo) => self.check_servo(&format!("{path}.motion.servo"), tool, servo),
        }
    }

    fn check_times(&self, path: &str, tool: &Tool) -> Result<()> {
        self.not_negative(&format!("{path}.from"), tool.from)?;
        if let Some(until) = tool.until {
            self.require(
                until > tool.from,
                &format!("{path}.until"),
                format!("is {until} s, and from is {} s", tool.from),
                "must be later than from",
            )?;
        }
        self.require(
            !tool.answers() || tool.from == 0.0 && tool.until.is_none(),
            &format!("{path}.{}", if tool.until.is_some() { "until" } else { "from" }),
            "is given to a tool that the ground moves",
            "leave it out, or use another motion: fixed tools, those on keyframes and those driven by velocity appear and vanish",
        )
    }

    fn check_servo(&self, path: &str, tool: &Tool, servo: &Servo) -> Result<()> {
        self.require(
            servo.axis.iter().any(|x| *x != 0.0),
            &format!("{path}.axis"),
            "is zero",
            "give the direction in which the force acts",
        )?;
        self.require(
            servo.force.is_some() != servo.pressure.is_some() && (servo.area.is_none() || servo.pressure.is_some()),
            path,
            "is given too much or too little",
            "give force [N], or pressure [Pa] with its area [m²], and not both",
        )?;
        self.require(
            servo.force.is_some() || servo.area.is_some() || tool.face(servo.axis, &self.world).is_some(),
            &format!("{path}.area"),
            "is absent, and only of a box that is not turned it is known, along one of its sides",
            "give the area that the pressure acts on [m²]",
        )?;
        if let Some(area) = servo.area {
            self.positive(&format!("{path}.area"), area)?;
        }
        self.not_negative(&format!("{path}.ramp"), servo.ramp)?;
        self.not_negative(&format!("{path}.damping"), servo.damping)?;
        if let Some(mass) = servo.mass {
            self.positive(&format!("{path}.mass"), mass)?;
        }
        self.require(
            matches!(tool.in_world(&self.world).motion, Motion::Servo(servo) if servo.inertia() > 0.0),
            &format!("{path}.mass"),
            "is absent, and without a force there is no weight to take it from",
            "give a mass in kg",
        )
    }

    /// A tool must reach into the world at its start or, if it has them, at some keyframe.
    pub(super) fn check_tool_place(&self, path: &str, tool: &Tool) -> Result<()> {
        let Some(bounds) = tool.shape.bounds() else { return Ok(()) };
        let (key, poses) = match &tool.motion {
            Motion::Keyframes { frames, .. } => (
                "motion.keyframes.frames",
                frames.iter().map(|f| (f.position, f.rotation.unwrap_or(tool.rotation))).collect(),
            ),
            _ => ("position", vec![(tool.position, tool.rotation)]),
        };
        let (world, reached) = (&self.world, self.reached_box());
        self.require(
            poses.iter().any(|&(position, rotation)| posed_bounds(bounds, position, rotation).meets(&reached)),
            &format!("{path}.{key}"),
            format!("tool '{}' is outside the world, from {:?} to {:?}", tool.name, world.min, world.max),
            "move the tool, or widen world.min and world.max",
        )
    }
}
