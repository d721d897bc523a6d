//! Contacts of rigid bodies among themselves and with the world's walls, by rapier.
//!
//! Made only where a scene has a free body. Rapier sees no gravity, no damping, no sleep and no ground: the bodies' velocities
//! come in with all that done, and rapier changes them where rigid bodies touch.

use crate::motion::Pose;
use crate::sdf::{HeightField, MeshPart, Part, Primitive, Sdf};
use barchan_core::contact::Twist;
use barchan_core::scene::{Contact, Wall, World};
use glam::{DMat3, DQuat, DVec3};
use rapier3d_f64::math::Pose as RapierPose;
use rapier3d_f64::prelude::{
    CoefficientCombineRule, Collider, ColliderBuilder, MassProperties, PhysicsWorld, RigidBody, RigidBodyBuilder,
    RigidBodyHandle, RigidBodyType, SharedShape,
};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Rapier's world, with one of its bodies for each tool of the scene.
pub struct RigidWorld {
    physics: PhysicsWorld,
    handles: Vec<RigidBodyHandle>,
}

/// How a body moves, as far as rapier is concerned.
#[derive(Clone, Copy, Debug)]
pub enum Role {
    /// It stays.
    Fixed,
    /// It goes where it is told.
    Driven,
    /// It is moved by contacts.
    Free {
        /// Mass [kg].
        mass: f64,
        /// Inertia about the centre of mass, body frame [kg m²].
        inertia: DMat3,
        /// Coefficient of restitution.
        restitution: f64,
    },
}

fn is_finite(pose: &RapierPose) -> bool {
    pose.translation.is_finite() && pose.rotation.is_finite()
}

fn to_rapier(pose: &Pose) -> RapierPose {
    RapierPose::from_parts(pose.position, pose.rotation)
}

impl RigidWorld {
    /// A world with walls and no bodies. `size` is the longest side of the smallest free body [m], which sets the scale of
    /// rapier's tolerances.
    pub fn new(world: &World, size: f64) -> Self {
        let mut physics = PhysicsWorld { gravity: DVec3::ZERO, ..PhysicsWorld::default() };
        let parameters = &mut physics.integration_parameters;
        parameters.length_unit = size;
        parameters.normalized_max_linear_velocity = f64::MAX;
        // Steps are short against any body, and the clamp of continuous detection would change a free flight.
        parameters.max_ccd_substeps = 0;
        let w = &world.walls;
        for (axis, walls) in [[w.x_min, w.x_max], [w.y_min, w.y_max], [w.z_min, w.z_max]].into_iter().enumerate() {
            for (wall, point, inwards) in [(walls[0], world.min, 1.0), (walls[1], world.max, -1.0)] {
                let friction = match wall {
                    Wall::Open | Wall::Periodic => continue,
                    Wall::Slip => 0.0,
                    Wall::Stick => 1.0,
                    Wall::Separate { friction } => friction,
                };
                let normal = DVec3::AXES[axis] * inwards;
                let place = RapierPose::from_translation(DVec3::AXES[axis] * point[axis]);
                physics.colliders.insert(collider(SharedShape::halfspace(normal), place, friction, 0.0));
            }
        }
        Self { physics, handles: Vec::new() }
    }

    /// Adds the next tool of the scene.
    pub fn add(&mut self, shape: &Sdf, pose: &Pose, contact: Contact, role: Role) {
        let (kind, restitution) = match role {
            Role::Fixed => (RigidBodyType::Fixed, 0.0),
            Role::Driven => (RigidBodyType::KinematicPositionBased, 0.0),
            Role::Free { restitution, .. } => (RigidBodyType::Dynamic, restitution),
        };
        let mut body = RigidBodyBuilder::new(kind)
            .pose(to_rapier(pose))
            .can_sleep(false)
            .gyroscopic_forces_enabled(false)
            .allow_fast_rotation(true);
        if let Role::Free { mass, inertia, .. } = role {
            body = body.additional_mass_properties(MassProperties::with_inertia_matrix(DVec3::ZERO, mass, inertia));
        }
        let handle = self.physics.bodies.insert(body);
        let friction = match contact {
            Contact::Coulomb { friction } => friction,
            Contact::Slip => 0.0,
            Contact::Stick => 1.0,
        };
        for part in shape.parts() {
            let (shape, place) = solid(part, matches!(role, Role::Free { .. }));
            let collider = collider(shape, place, friction, restitution);
            self.physics.colliders.insert_with_parent(collider, handle, &mut self.physics.bodies);
        }
        self.handles.push(handle);
    }

    /// Puts a body where it is at the start of the step, if it is not there: what rapier has not moved itself is off by more than rounding.
    pub fn place(&mut self, body: usize, pose: &Pose) {
        let handle = self.handles[body];
        let now = self.physics.bodies[handle].position();
        let turned = (now.rotation - pose.rotation).length().min((now.rotation + pose.rotation).length());
        let moved = (now.translation - pose.position).length();
        if turned > 1e-9 || moved > 1e-9 * (1.0 + pose.position.length()) {
            self.physics.bodies[handle].set_position(to_rapier(pose), true);
        }
    }

    /// Tells where a driven body is at the end of the step.
    pub fn send(&mut self, body: usize, pose: &Pose) {
        self.physics.bodies[self.handles[body]].set_next_kinematic_position(to_rapier(pose));
    }

    /// Sets a free body's velocity at the start of the step.
    pub fn throw(&mut self, body: usize, twist: &Twist) {
        let body = &mut self.physics.bodies[self.handles[body]];
        body.set_linvel(twist.linear, true);
        body.set_angvel(twist.angular, true);
    }

    /// Everything that changes from step to step.
    pub fn physics(&self) -> &PhysicsWorld {
        &self.physics
    }

    /// Takes up what [`physics`](Self::physics) gave in a world with the same bodies.
    ///
    /// Rapier trusts what it reads. Checked here is what can be seen from outside: that bodies and colliders are those of this
    /// world, and finite. Its lists and trees are its own; [`step`](Self::step) finds out about them, but for a tree forged into
    /// a circle, in which rapier runs until memory ends.
    ///
    /// # Errors
    /// A text saying what is wrong.
    pub fn restore(&mut self, saved: PhysicsWorld) -> Result<(), String> {
        let ours = &self.physics;
        if saved.bodies.len() != ours.bodies.len() || saved.colliders.len() != ours.colliders.len() {
            return Err(format!(
                "its rigid solver holds {} bodies of {} parts, and the scene makes {} of {}",
                saved.bodies.len(),
                saved.colliders.len(),
                ours.bodies.len(),
                ours.colliders.len()
            ));
        }
        for (i, &handle) in self.handles.iter().enumerate() {
            let (body, own) = (saved.bodies.get(handle), &ours.bodies[handle]);
            let fits = |b: &RigidBody| {
                b.body_type() == own.body_type()
                    && b.colliders() == own.colliders()
                    && [b.linvel(), b.angvel()].iter().all(|v| v.is_finite())
                    && is_finite(b.position())
                    && is_finite(b.next_position())
            };
            if !body.is_some_and(fits) {
                return Err(format!("its rigid solver's body {i} is not the scene's, or not finite"));
            }
        }
        for (handle, own) in ours.colliders.iter() {
            let fits = |c: &Collider| {
                c.parent() == own.parent()
                    && c.shape().shape_type() == own.shape().shape_type()
                    && is_finite(c.position())
            };
            if !saved.colliders.get(handle).is_some_and(fits) {
                return Err("a part of its rigid solver's bodies is not the scene's, or not finite".to_owned());
            }
        }
        // Gravity, tolerances and joints are the scene's to say.
        self.physics = PhysicsWorld {
            gravity: ours.gravity,
            integration_parameters: ours.integration_parameters,
            islands: saved.islands,
            broad_phase: saved.broad_phase,
            narrow_phase: saved.narrow_phase,
            bodies: saved.bodies,
            colliders: saved.colliders,
            ..PhysicsWorld::default()
        };
        self.pace(saved.integration_parameters.dt);
        Ok(())
    }

    /// Moves all bodies by `dt` [s].
    ///
    /// # Errors
    /// What rapier said when it gave up, which it does by panicking: with a state that was tampered with, or no longer finite.
    /// The world is of no use then until it is restored.
    pub fn step(&mut self, dt: f64) -> Result<(), String> {
        self.pace(dt);
        catch_unwind(AssertUnwindSafe(|| self.physics.step())).map_err(|panic| {
            let text = panic.downcast_ref::<String>().cloned();
            text.or_else(|| panic.downcast_ref::<&str>().map(ToString::to_string)).unwrap_or_default()
        })
    }

    /// Sets the step, and what follows from it.
    fn pace(&mut self, dt: f64) {
        let parameters = &mut self.physics.integration_parameters;
        parameters.dt = dt;
        // Contacts as stiff as the step resolves: at rapier's 30 Hz, made for steps of 1/60 s, a box under one that is 200 times
        // as heavy sinks in by a tenth of its size.
        let stiffest = 0.125 / dt;
        parameters.contact_softness.natural_frequency = stiffest.max(30.0);
        parameters.static_contact_softness.natural_frequency = stiffest.max(60.0);
    }

    /// Where a body is, and how it moves.
    pub fn state(&self, body: usize) -> (Pose, Twist) {
        let body = &self.physics.bodies[self.handles[body]];
        let pose = Pose { position: body.translation(), rotation: *body.rotation() };
        (pose, Twist { linear: body.linvel(), angular: body.angvel() })
    }
}

fn collider(shape: SharedShape, place: RapierPose, friction: f64, restitution: f64) -> Collider {
    // The smoother surface decides how much friction there is, the bouncier one how much bounce.
    ColliderBuilder::new(shape)
        .position(place)
        .density(0.0)
        .friction(friction)
        .friction_combine_rule(CoefficientCombineRule::Min)
        .restitution(restitution)
        .restitution_combine_rule(CoefficientCombineRule::Max)
        .build()
}

/// A part as rapier sees it, and where it is.
fn solid(part: &Part, free: bool) -> (SharedShape, RapierPose) {
    let place = to_rapier(&part.pose);
    let shape = match &part.primitive {
        Primitive::Sphere { radius } => SharedShape::ball(*radius),
        Primitive::Box { half } => SharedShape::cuboid(half.x, half.y, half.z),
        Primitive::Cylinder { radius, half_height } => {
            // Rapier's cylinders stand along y.
            let upright = RapierPose::from_rotation(DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2));
            return (SharedShape::cylinder(*half_height, *radius), place * upright);
        }
        Primitive::Capsule { radius, half_height } => SharedShape::capsule_z(*half_height, *radius),
        Primitive::Plane => SharedShape::halfspace(DVec3::Z),
        Primitive::HeightField(field) => terrain(field),
        Primitive::Mesh(mesh) if free => convex_parts(mesh),
        Primitive::Mesh(mesh) => {
            let (vertices, triangles) = mesh.mesh.parts();
            SharedShape::trimesh(vertices.to_vec(), triangles.to_vec())
                .expect("a mesh without triangles is refused when it is made")
        }
    };
    (shape, place)
}

/// The upper surface of a height field.
fn terrain(field: &HeightField) -> SharedShape {
    let (rows, columns) = (field.heights.len(), field.heights[0].len());
    let at = |i: usize, n: usize, d: usize| field.min[d] + (field.max[d] - field.min[d]) * i as f64 / (n - 1) as f64;
    let vertices = (0..rows)
        .flat_map(|j| (0..columns).map(move |i| (i, j)))
        .map(|(i, j)| DVec3::new(at(i, columns, 0), at(j, rows, 1), field.heights[j][i]))
        .collect();
    let triangles = (0..rows - 1)
        .flat_map(|j| (0..columns - 1).map(move |i| j * columns + i))
        .flat_map(|a| {
            let (b, c, d) = (a + 1, a + columns, a + columns + 1);
            [[a, b, d], [a, d, c]].map(|t| t.map(|i| i as u32))
        })
        .collect();
    SharedShape::trimesh(vertices, triangles)
        .expect("a height field of fewer than two rows and columns is refused when it is read")
}

/// A mesh as convex bodies, which collide well in motion: its hull if that fits within 1 %, else a decomposition.
fn convex_parts(mesh: &MeshPart) -> SharedShape {
    let (vertices, triangles) = mesh.mesh.parts();
    let volume = crate::mass::Filling::of_mesh(&mesh.mesh).volume;
    SharedShape::convex_hull(vertices)
        .filter(|hull| hull.mass_properties(1.0).mass() < 1.01 * volume)
        .unwrap_or_else(|| SharedShape::convex_decomposition(vertices, triangles))
}
