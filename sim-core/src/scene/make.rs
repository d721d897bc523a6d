//! Scenes in code: constructors that take what a scene file must say. All else is as a file leaves it, and every field can be set.

use super::{
    Body, Contact, CouplingSpec, Keyframe, MaterialSpec, Motion, Motor, Placed, Robot, Scene, Servo, Shape, Surface,
    Terrain, Time, Tool, Wall, Walls, Within, World, Zone, no_rotation, one,
};
use crate::Vec3;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use std::ops::Range;
use std::path::PathBuf;

/// What is left of a table that says only what it must: so defaults stand in one place, with the keys of the file.
fn with_defaults<T: DeserializeOwned>(required: Value) -> T {
    serde_json::from_value(required).expect("the keys that a table must have are given")
}

impl Scene {
    /// A scene without ground and tools, under gravity, that lasts so many seconds.
    ///
    /// ```
    /// use barchan_core::scene::{Body, MaterialSpec, Scene, Shape, Tool, Wall, World};
    ///
    /// let world = World::new(0.02, [0.0; 3], [0.4; 3]).with_walls(Wall::Slip);
    /// let scene = Scene::new("drop", world, 0.5)
    ///     .with(MaterialSpec::new("jelly", "neo_hookean", 1000.0).with("young_modulus", 2e4))
    ///     .with(Body::new("jelly", Shape::cuboid([0.12; 3], [0.28; 3])))
    ///     .with(Tool::new("ball", Shape::sphere(0.04)).at([0.2, 0.2, 0.34]).free(0.5));
    /// assert_eq!(scene.gravity, [0.0, 0.0, -9.81]);
    /// # Ok::<(), barchan_core::Error>(())
    /// ```
    pub fn new(name: impl Into<String>, world: World, end: f64) -> Self {
        let required = json!({
            "name": "",
            "world": { "cell": 1.0, "min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 1.0] },
            "time": { "end": 1.0 },
        });
        Self { name: name.into(), world, time: Time::new(end), ..with_defaults(required) }
    }

    /// With a material, a body, a tool or a coupling more.
    #[must_use]
    pub fn with(mut self, part: impl Into<Part>) -> Self {
        match part.into() {
            Part::Material(material) => self.material.push(material),
            Part::Body(body) => self.body.push(body),
            Part::Tool(tool) => self.tool.push(tool),
            Part::Robot(robot) => self.robot.push(*robot),
            Part::Coupling(coupling) => self.coupling.push(coupling),
        }
        self
    }
}

/// What a scene is put together from.
#[derive(Clone, Debug)]
pub enum Part {
    /// A material, by the name that bodies use.
    Material(MaterialSpec),
    /// A soft body.
    Body(Body),
    /// A rigid tool or body.
    Tool(Tool),
    /// A robot of links and joints.
    Robot(Box<Robot>),
    /// Another coupling.
    Coupling(CouplingSpec),
}

impl From<MaterialSpec> for Part {
    fn from(material: MaterialSpec) -> Self {
        Self::Material(material)
    }
}
impl From<Body> for Part {
    fn from(body: Body) -> Self {
        Self::Body(body)
    }
}
impl From<Tool> for Part {
    fn from(tool: Tool) -> Self {
        Self::Tool(tool)
    }
}
impl From<Robot> for Part {
    fn from(robot: Robot) -> Self {
        Self::Robot(Box::new(robot))
    }
}
impl From<CouplingSpec> for Part {
    fn from(coupling: CouplingSpec) -> Self {
        Self::Coupling(coupling)
    }
}

impl Robot {
    /// A robot that comes with the program, the frame of its base at the world's origin, without motors.
    pub fn built_in(name: impl Into<String>, model: impl Into<String>) -> Self {
        Self { name: name.into(), model: Some(model.into()), ..with_defaults(json!({ "name": "" })) }
    }
    /// A robot of a URDF file, likewise.
    pub fn from_urdf(name: impl Into<String>, urdf: impl Into<PathBuf>) -> Self {
        Self { name: name.into(), urdf: Some(urdf.into()), ..with_defaults(json!({ "name": "" })) }
    }
    /// With its base there [m].
    #[must_use]
    pub fn at(self, position: Vec3) -> Self {
        Self { position, ..self }
    }
    /// With motors of these gains in all joints [N m/rad, N m s/rad].
    #[must_use]
    pub fn with_motors(mut self, kp: f64, kd: f64) -> Self {
        self.motor.push(Motor { kp: Some(kp), kd: Some(kd), ..with_defaults(json!({})) });
        self
    }
}

impl World {
    /// Cells of that width between two corners [m], open on all sides.
    pub fn new(cell: f64, min: Vec3, max: Vec3) -> Self {
        let required = json!({ "cell": 1.0, "min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 1.0] });
        Self { cell, min, max, ..with_defaults(required) }
    }
    /// With these walls, or the same on all sides.
    #[must_use]
    pub fn with_walls(self, walls: impl Into<Walls>) -> Self {
        Self { walls: walls.into(), ..self }
    }
}

impl From<Wall> for Walls {
    /// The same on all sides.
    fn from(wall: Wall) -> Self {
        Self { x_min: wall, x_max: wall, y_min: wall, y_max: wall, z_min: wall, z_max: wall }
    }
}

impl Time {
    /// So many seconds, in steps as long as is stable.
    pub fn new(end: f64) -> Self {
        Self { end, ..with_defaults(json!({ "end": 1.0 })) }
    }
}

impl MaterialSpec {
    /// A law of the registry with its own parameters, and a density at rest [kg/m³].
    pub fn new(name: impl Into<String>, law: impl Into<String>, density: f64) -> Self {
        let required = json!({ "name": "", "law": "", "density": 1.0 });
        Self { name: name.into(), law: law.into(), density, ..with_defaults(required) }
    }
    /// With another value of a parameter; an angle in degrees ends in `_deg`.
    #[must_use]
    pub fn with(mut self, parameter: impl Into<String>, value: f64) -> Self {
        self.parameters.insert(parameter.into(), value);
        self
    }
}

impl Body {
    /// A body at rest of a material of the scene.
    pub fn new(material: impl Into<String>, shape: Shape) -> Self {
        let required = json!({ "material": "", "shape": { "sphere": { "radius": 1.0 } } });
        Self { material: material.into(), shape, ..with_defaults(required) }
    }
    /// With a name, for messages and for levels that follow it.
    #[must_use]
    pub fn named(self, name: impl Into<String>) -> Self {
        Self { name: name.into(), ..self }
    }
    /// Moving at a velocity [m/s].
    #[must_use]
    pub fn moving(self, velocity: Vec3) -> Self {
        Self { velocity, ..self }
    }
    /// With another material in a part of it.
    #[must_use]
    pub fn with_zone(mut self, zone: Zone) -> Self {
        self.zone.push(zone);
        self
    }
}

impl Zone {
    /// Of a material of the scene, deeper than this below the body's surface [m].
    pub fn below(material: impl Into<String>, depth: f64) -> Self {
        Self { material: material.into(), below: Some(depth), within: None, picture: None }
    }
    /// Of a material of the scene, between two corners [m].
    pub fn within(material: impl Into<String>, min: Vec3, max: Vec3) -> Self {
        Self { material: material.into(), below: None, within: Some(Within { min, max }), picture: None }
    }
}

impl Shape {
    /// A box between two corners [m], for bodies.
    pub fn cuboid(min: Vec3, max: Vec3) -> Self {
        Self::Box { min: Some(min), max: Some(max), half: None, center: None }
    }
    /// A box of half extents about the origin [m], for tools.
    pub fn half(half: Vec3) -> Self {
        Self::Box { min: None, max: None, half: Some(half), center: None }
    }
    /// A sphere about the origin [m].
    pub fn sphere(radius: f64) -> Self {
        Self::Sphere { center: [0.0; 3], radius }
    }
    /// A cylinder along z about the origin, by radius and half its height [m].
    pub fn cylinder(radius: f64, half_height: f64) -> Self {
        Self::Cylinder { center: [0.0; 3], radius, half_height }
    }
    /// All within `radius` of a segment along z about the origin, by half its length [m].
    pub fn capsule(radius: f64, half_height: f64) -> Self {
        Self::Capsule { center: [0.0; 3], radius, half_height }
    }
    /// The half space below a plane through the origin, by the normal out of it, for tools.
    pub fn plane(normal: Vec3) -> Self {
        Self::Plane { point: [0.0; 3], normal }
    }
    /// Ground between two corners of its plan [m] and from `bottom` up to a surface, whose heights are above the world's origin [m].
    pub fn terrain(min: [f64; 2], max: [f64; 2], bottom: f64, surface: Surface) -> Self {
        Self::Terrain(Terrain { min, max, bottom, origin: [0.0; 3], surface })
    }
    /// A closed mesh in metres, from a file (OBJ, STL or DAE).
    pub fn mesh(file: impl Into<PathBuf>) -> Self {
        Self::Mesh { file: file.into(), scale: one(), center: [0.0; 3], rotation: no_rotation() }
    }
    /// The same shape elsewhere [m]: the centre of a sphere, cylinder, capsule or mesh, and a point of a plane; a box, a height field and a terrain by
    /// their corners.
    #[must_use]
    pub fn at(mut self, place: Vec3) -> Self {
        let shift = |x: &mut Vec3| (0..3).for_each(|d| x[d] += place[d]);
        match &mut self {
            Self::Box { min, max, half, center } => {
                [min, max].into_iter().flatten().for_each(shift);
                if half.is_some() {
                    shift(center.get_or_insert_default());
                }
            }
            Self::Sphere { center, .. }
            | Self::Cylinder { center, .. }
            | Self::Capsule { center, .. }
            | Self::Mesh { center, .. } => shift(center),
            Self::Plane { point, .. } => shift(point),
            Self::HeightField { min, max, bottom, heights, .. } => {
                [min, max].into_iter().for_each(|x| (0..2).for_each(|d| x[d] += place[d]));
                *bottom += place[2];
                heights.iter_mut().flatten().for_each(|z| *z += place[2]);
            }
            Self::Terrain(Terrain { min, max, bottom, origin, .. }) => {
                [min, max].into_iter().for_each(|x| (0..2).for_each(|d| x[d] += place[d]));
                *bottom += place[2];
                shift(origin);
            }
            Self::Union(parts) | Self::Difference(parts) | Self::Intersection(parts) => {
                parts.iter_mut().for_each(|part| shift(&mut part.position));
            }
        }
        self
    }
}

impl Placed {
    /// A shape at a place [m] within a union.
    pub fn new(shape: Shape, position: Vec3) -> Self {
        Self { shape, position, rotation: no_rotation() }
    }
}

impl Tool {
    /// A tool that stays at the world's origin, with friction.
    pub fn new(name: impl Into<String>, shape: Shape) -> Self {
        let required = json!({ "name": "", "shape": { "sphere": { "radius": 1.0 } } });
        Self { name: name.into(), shape, ..with_defaults(required) }
    }
    /// Starting at a place [m].
    #[must_use]
    pub fn at(self, position: Vec3) -> Self {
        Self { position, ..self }
    }
    /// Starting with an orientation, a quaternion (w, x, y, z).
    #[must_use]
    pub fn turned(self, rotation: [f64; 4]) -> Self {
        Self { rotation, ..self }
    }
    /// With another law of contact.
    #[must_use]
    pub fn touching(self, contact: Contact) -> Self {
        Self { contact, ..self }
    }
    /// Driven at a velocity [m/s], which an agent may change.
    #[must_use]
    pub fn driven(self, linear: Vec3) -> Self {
        Self { motion: Motion::Velocity { linear, angular: [0.0; 3] }, ..self }
    }
    /// Free, with a mass [kg].
    #[must_use]
    pub fn free(self, mass: f64) -> Self {
        Self { motion: Motion::Free { mass, linear: [0.0; 3], angular: [0.0; 3], restitution: 0.0 }, ..self }
    }
    /// There from one time to another [s].
    #[must_use]
    pub fn during(self, times: Range<f64>) -> Self {
        Self { from: times.start, until: times.end.is_finite().then_some(times.end), ..self }
    }
    /// Pushed along an axis by a force [N] and held in all other directions.
    #[must_use]
    pub fn pushed(self, axis: Vec3, force: f64) -> Self {
        let servo = Servo { force: Some(force), ..with_defaults(json!({ "axis": axis })) };
        Self { motion: Motion::Servo(servo), ..self }
    }
    /// Moving in another way.
    #[must_use]
    pub fn moving(self, motion: Motion) -> Self {
        Self { motion, ..self }
    }
}

impl Contact {
    /// Coulomb friction.
    pub fn friction(friction: f64) -> Self {
        Self::Coulomb { friction }
    }
}

impl Keyframe {
    /// A place [m] at a time [s], turned as before.
    pub fn new(time: f64, position: Vec3) -> Self {
        Self { time, position, rotation: None }
    }
}

impl CouplingSpec {
    /// A coupling of a kind of the registry, with its own parameters.
    pub fn new(kind: impl Into<String>) -> Self {
        Self { kind: kind.into(), ..with_defaults(json!({ "kind": "" })) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scene in code is the scene that a file says, key by key: constructors and files have the same defaults.
    #[test]
    fn a_scene_in_code_is_that_of_a_file() {
        let file = r#"
name = "drag"
world = { cell = 0.0125, min = [0, 0, 0], max = [0.5, 0.3, 0.3], walls = { z_min = "stick" } }
time = { end = 0.5 }
material = [{ name = "sand", law = "sand", density = 1600, parameters = { young_modulus = 2e5 } }]
body = [{ name = "bed", material = "sand", velocity = [0, 0, -1], shape = { box = { min = [0, 0, 0], max = [0.5, 0.3, 0.1] } } }]
tool = [
    { name = "blade", position = [0.12, 0.15, 0.11], shape = { box = { half = [0.0125, 0.05, 0.06] } }, contact = { coulomb = { friction = 0.4 } }, motion = { velocity = { linear = [0.4, 0, 0] } } },
    { name = "ball", rotation = [0, 1, 0, 0], shape = { sphere = { radius = 0.02, center = [0, 0, 0.2] } }, motion = { free = { mass = 2 } } },
    { name = "rod", shape = { union = [{ shape = { capsule = { radius = 0.02, half_height = 0.1 } }, position = [0, 0, 0.2] }] }, motion = { keyframes = { frames = [{ time = 0, position = [0, 0, 1] }] } } },
    { name = "floor", shape = { plane = { normal = [0, 0, 1], point = [0, 0, -1] } }, contact = "slip" },
    { name = "pile", shape = { cylinder = { radius = 0.1, half_height = 0.1 } } },
    { name = "stone", shape = { mesh = { file = "stone.obj" } } },
]
coupling = [{ kind = "current" }]
"#;
        let read: Scene = toml::from_str(file).unwrap();
        let walls = Walls { z_min: Wall::Stick, ..Walls::default() };
        let frames = vec![Keyframe::new(0.0, [0.0, 0.0, 1.0])];
        let made = Scene::new("drag", World::new(0.0125, [0.0; 3], [0.5, 0.3, 0.3]).with_walls(walls), 0.5)
            .with(MaterialSpec::new("sand", "sand", 1600.0).with("young_modulus", 2e5))
            .with(Body::new("sand", Shape::cuboid([0.0; 3], [0.5, 0.3, 0.1])).named("bed").moving([0.0, 0.0, -1.0]))
            .with(
                Tool::new("blade", Shape::half([0.0125, 0.05, 0.06]))
                    .at([0.12, 0.15, 0.11])
                    .touching(Contact::friction(0.4))
                    .driven([0.4, 0.0, 0.0]),
            )
            .with(Tool::new("ball", Shape::sphere(0.02).at([0.0, 0.0, 0.2])).turned([0.0, 1.0, 0.0, 0.0]).free(2.0))
            .with(
                Tool::new("rod", Shape::Union(vec![Placed::new(Shape::capsule(0.02, 0.1), [0.0, 0.0, 0.2])]))
                    .moving(Motion::Keyframes { frames, interpolation: Default::default() }),
            )
            .with(Tool::new("floor", Shape::plane([0.0, 0.0, 1.0]).at([0.0, 0.0, -1.0])).touching(Contact::Slip))
            .with(Tool::new("pile", Shape::cylinder(0.1, 0.1)))
            .with(Tool::new("stone", Shape::mesh("stone.obj")))
            .with(CouplingSpec::new("current"));
        assert_eq!(made.difference(&read), None);
    }
}
