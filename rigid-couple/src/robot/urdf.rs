//! URDF files: a tree of links and joints.
//!
//! Every link stays a body of its own, also behind a fixed joint. What has no meaning for a robot here is left out: transmissions, sensors, Gazebo's
//! extensions. What cannot be used is refused with the element and its line; of `<visual>` elements, it is a warning (`visual.rs`).

use super::model::{Drive, Freedom, Joint, Link, RobotModel};
use super::visual::Visual;
use crate::Refusal;
use crate::mass::{Filling, outer};
use crate::mesh::{DistanceGrid, Triangles};
use crate::motion::Pose;
use crate::sdf::{MeshPart, Part, Primitive, Sdf};
use crate::surface::mesh_of;
use barchan_core::scene::{CollisionMeshes, fits};
use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};
use roxmltree::{Document, Node};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Inertia of a motor as its joint feels it where nothing else is said [kg m² or kg]. URDF has no word for it, and joints of light links, such as wrists and
/// fingers, are stiff without it.
pub const ARMATURE: f64 = 0.01;
/// What principal moments of inertia may lack to be those of a body, as a share of the greatest: files round them.
const ROUNDING: f64 = 0.02;
/// A hull that holds so many times what its mesh does fills hollows that ground may be meant to get into.
const HOLLOW: f64 = 1.5;

/// Where a robot comes from, and what may be mended.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// The URDF's text.
    pub text: &'a str,
    /// Its name for messages.
    pub file: &'a str,
    /// Folder that its meshes are looked for in, and the folders around it for `package://`.
    pub folder: &'a Path,
    /// Make inertias that no body has those of the nearest one instead of refusing them.
    pub mends: bool,
    /// What collision meshes stand for.
    pub meshes: &'a CollisionMeshes,
}

#[cfg(test)]
impl<'a> Source<'a> {
    /// A test's text, as a scene has it that says nothing more.
    pub(super) fn of(text: &'a str) -> Self {
        Self { text, file: "r.urdf", folder: Path::new("."), mends: false, meshes: &CollisionMeshes::Hull }
    }
}

impl RobotModel {
    /// Reads a robot.
    ///
    /// # Errors
    /// If the file is not XML, an element lacks something or has something that cannot be used, links form no tree, a mesh cannot be read.
    pub fn read(source: &Source<'_>) -> Result<Self, Refusal> {
        let document = Document::parse(source.text).map_err(|e| {
            Refusal::new(
                format!("{}: it is not XML: {e}", source.file),
                "give a URDF file; xacro files are to be expanded first",
            )
        })?;
        Reader { source, document: &document, warnings: Vec::new(), hollow: Vec::new() }.model()
    }
}

pub(super) struct Reader<'a> {
    source: &'a Source<'a>,
    pub(super) document: &'a Document<'a>,
    pub(super) warnings: Vec<String>,
    /// Links whose hulls hold much more than their meshes.
    hollow: Vec<String>,
}

pub(super) type Xml<'a> = Node<'a, 'a>;

/// A joint before its place in the tree is known.
struct Edge<'a> {
    node: Xml<'a>,
    name: &'a str,
    kind: &'a str,
    parent: &'a str,
    child: &'a str,
}

impl<'a> Reader<'a> {
    pub(super) fn fault(&self, node: Xml<'_>, what: &str, mend: &str) -> Refusal {
        let line = self.document.text_pos_at(node.range().start).row;
        let name = node.attribute("name").map(|name| format!(" '{name}'")).unwrap_or_default();
        Refusal::new(format!("{}:{line}: <{}>{name}: {what}", self.source.file, node.tag_name().name()), mend)
    }

    fn model(mut self) -> Result<RobotModel, Refusal> {
        let root = self.document.root_element();
        if root.tag_name().name() != "robot" {
            return Err(self.fault(root, "a URDF begins with <robot>", "give a URDF file"));
        }
        let named = |tag: &'static str| root.children().filter(move |node| node.has_tag_name(tag));
        let mut links: Vec<(&str, Xml<'a>)> = Vec::new();
        for node in named("link") {
            let name = self.text(node, "name")?;
            if links.iter().any(|(other, _)| *other == name) {
                return Err(self.fault(node, "another link has this name", "rename one of them"));
            }
            links.push((name, node));
        }
        if links.is_empty() {
            return Err(self.fault(root, "it has no <link>", "give it one"));
        }
        let edges = self.edges(named("joint"), &links)?;
        let mut roots = links.iter().filter(|(name, _)| edges.iter().all(|edge| edge.child != *name));
        let Some(&(first, first_node)) = roots.next() else {
            return Err(self.fault(
                root,
                "every link is another's child: there is no base",
                "break the loop of joints",
            ));
        };
        if let Some((_, node)) = roots.next() {
            let what = format!("neither this nor '{first}' is a child of a joint, so that there are two bases");
            return Err(self.fault(*node, &what, "join them by a joint, or remove one"));
        }
        // A link called "world" to which the robot floats is nothing of its own.
        let floats = edges.iter().find(|edge| edge.parent == first && edge.kind == "floating");
        let base = match floats {
            Some(edge)
                if edges.iter().filter(|edge| edge.parent == first).count() == 1 && !self.is_solid(first_node) =>
            {
                edge.child
            }
            _ => first,
        };
        let mut tree = Tree { links: Vec::new(), drives: Vec::new(), mimics: Vec::new() };
        self.grow(base, None, &links, &edges, &mut tree)?;
        self.resolve(&mut tree)?;
        let touches = |mesh: &Xml<'a>| {
            mesh.has_tag_name("mesh") && mesh.ancestors().any(|around| around.has_tag_name("collision"))
        };
        let files = root.descendants().filter(touches).map(|mesh| self.mesh_file(mesh)).collect::<Result<_, _>>()?;
        self.check_inertias(&mut tree, &links)?;
        self.check_exact(root, &tree.links)?;
        self.warn_of_hollow();
        let model = RobotModel {
            name: root.attribute("name").unwrap_or("robot").to_owned(),
            collision_meshes: self.source.meshes.clone(),
            links: tree.links,
            drives: tree.drives,
            files,
            warnings: std::mem::take(&mut self.warnings),
        };
        if model.mass() <= 0.0 {
            return Err(Refusal::new(
                format!("{}: the robot has no mass", self.source.file),
                "give its links an <inertial>",
            ));
        }
        if let Some(name) = model.moves_nothing() {
            // Of a planar joint there are several.
            let is_it = |edge: &&Edge<'_>| {
                name.strip_prefix(edge.name).is_some_and(|end| end.is_empty() || end.starts_with('/'))
            };
            let edge = edges.iter().find(is_it);
            return Err(self.fault(
                edge.map_or(root, |edge| edge.node),
                &format!("joint '{name}' moves no link with mass or shape"),
                "give a link that hangs on it an <inertial>, or make the joint fixed",
            ));
        }
        Ok(model)
    }

    /// Has it mass or a shape?
    fn is_solid(&self, link: Xml<'_>) -> bool {
        link.children().any(|node| node.has_tag_name("inertial") || node.has_tag_name("collision"))
    }

    fn edges(
        &self,
        joints: impl Iterator<Item = Xml<'a>>,
        links: &[(&str, Xml<'a>)],
    ) -> Result<Vec<Edge<'a>>, Refusal> {
        let mut edges: Vec<Edge<'a>> = Vec::new();
        for node in joints {
            let end = |tag: &str| {
                let link = self.child(node, tag)?;
                let name = self.text(link, "link")?;
                match links.iter().any(|(known, _)| *known == name) {
                    true => Ok(name),
                    false => {
                        Err(self.fault(node, &format!("its {tag} '{name}' is no link of the robot"), "name a link"))
                    }
                }
            };
            let edge = Edge {
                node,
                name: self.text(node, "name")?,
                kind: self.text(node, "type")?,
                parent: end("parent")?,
                child: end("child")?,
            };
            if edges.iter().any(|other| other.name == edge.name) {
                return Err(self.fault(node, "another joint has this name", "rename one of them"));
            }
            if let Some(other) = edges.iter().find(|other| other.child == edge.child) {
                let what = format!("'{}' is already the child of '{}': joints form a loop", edge.child, other.name);
                return Err(self.fault(node, &what, "open the loop; only trees can be simulated"));
            }
            edges.push(edge);
        }
        Ok(edges)
    }

    /// Adds a link and what hangs on it.
    fn grow(
        &mut self,
        name: &str,
        parent: Option<(usize, &Edge<'a>)>,
        links: &[(&str, Xml<'a>)],
        edges: &[Edge<'a>],
        tree: &mut Tree,
    ) -> Result<(), Refusal> {
        let Some((_, node)) = links.iter().find(|(known, _)| *known == name) else { return Ok(()) };
        let mut above = parent.map(|(number, _)| number);
        let mut joint = Joint::fixed("");
        if let Some((_, edge)) = parent {
            let mut joints = self.joints(edge, tree)?;
            joint = joints.pop().unwrap_or(joint);
            for between in joints {
                tree.links.push(Link::frame(&format!("{name}/{}", between.name), above, between));
                above = Some(tree.links.len() - 1);
            }
        }
        let link = self.link(name, *node, above, joint)?;
        tree.links.push(link);
        let own = tree.links.len() - 1;
        if edges.iter().any(|edge| edge.parent == name && edge.child == tree.links[0].name) {
            return Err(self.fault(
                *node,
                "its joints lead back to the base: they form a loop",
                "open the loop; only trees can be simulated",
            ));
        }
        for edge in edges.iter().filter(|edge| edge.parent == name) {
            self.grow(edge.child, Some((own, edge)), links, edges, tree)?;
        }
        Ok(())
    }

    /// A joint, or those that a planar one is made of.
    fn joints(&self, edge: &Edge<'a>, tree: &mut Tree) -> Result<Vec<Joint>, Refusal> {
        let node = edge.node;
        let origin = self.origin(node)?;
        let axis = match node.children().find(|child| child.has_tag_name("axis")) {
            Some(axis) => self.numbers::<3>(axis, "xyz")?.map_or(DVec3::X, DVec3::from_array),
            None => DVec3::X,
        };
        let unit = || axis.try_normalize().ok_or_else(|| self.fault(node, "its axis is zero", "give a direction"));
        let mut moving =
            |name: String, freedom: Freedom, origin: Pose, axis: DVec3, limits: [f64; 2]| -> Result<Joint, Refusal> {
                let joint = Joint { drive: tree.drives.len(), ..Joint::moving(&name, freedom, origin, axis) };
                tree.drives.push(self.drive(node, name, freedom == Freedom::Revolute, limits)?);
                Ok(joint)
            };
        Ok(match edge.kind {
            "fixed" => vec![Joint { origin, ..Joint::fixed(edge.name) }],
            "revolute" | "prismatic" => {
                let limit = self.child(node, "limit")?;
                let end = |key: &str| Ok(self.number(limit, key)?.unwrap_or(0.0));
                let limits = [end("lower")?, end("upper")?];
                if limits[0] > limits[1] {
                    return Err(self.fault(
                        limit,
                        &format!("lower = {} is above upper = {}", limits[0], limits[1]),
                        "swap them",
                    ));
                }
                let freedom = if edge.kind == "revolute" { Freedom::Revolute } else { Freedom::Prismatic };
                let mut joint = moving(edge.name.to_owned(), freedom, origin, unit()?, limits)?;
                if let Some(mimic) = node.children().find(|child| child.has_tag_name("mimic")) {
                    joint.ratio = self.number(mimic, "multiplier")?.unwrap_or(1.0);
                    joint.offset = self.number(mimic, "offset")?.unwrap_or(0.0);
                    let line = self.fault(
                        mimic,
                        "the joint that it names is none that moves, or mimics another",
                        "name one that is driven",
                    );
                    tree.mimics.push((joint.drive, self.text(mimic, "joint")?.to_owned(), line));
                }
                vec![joint]
            }
            "continuous" => vec![moving(edge.name.to_owned(), Freedom::Revolute, origin, unit()?, UNLIMITED)?],
            "planar" => {
                let normal = unit()?;
                let first = normal.any_orthonormal_vector();
                let along = |end: &str| format!("{}/{end}", edge.name);
                vec![
                    moving(along("x"), Freedom::Prismatic, origin, first, UNLIMITED)?,
                    moving(along("y"), Freedom::Prismatic, Pose::IDENTITY, normal.cross(first), UNLIMITED)?,
                    moving(along("turn"), Freedom::Revolute, Pose::IDENTITY, normal, UNLIMITED)?,
                ]
            }
            "floating" => {
                let mend = "let a link without mass and shape be its only parent, and the robot's base its child";
                return Err(self.fault(node, "only a base floats", mend));
            }
            other => {
                let mend = "use revolute, continuous, prismatic, fixed, planar or floating";
                return Err(self.fault(node, &format!("type = \"{other}\" is unknown"), mend));
            }
        })
    }

    fn drive(&self, node: Xml<'a>, name: String, turns: bool, limits: [f64; 2]) -> Result<Drive, Refusal> {
        let of = |tag: &str, key: &str| match node.children().find(|child| child.has_tag_name(tag)) {
            Some(child) => match self.number(child, key)? {
                Some(value) if value < 0.0 => Err(self.fault(child, &format!("{key} is {value}"), "give 0 or more")),
                value => Ok(value),
            },
            None => Ok(None),
        };
        // Many files write 0 where they mean that nothing is known.
        let most = |value: Option<f64>| value.filter(|value| *value > 0.0).unwrap_or(f64::INFINITY);
        Ok(Drive {
            name,
            turns,
            limits,
            effort: most(of("limit", "effort")?),
            speed: most(of("limit", "velocity")?),
            damping: of("dynamics", "damping")?.unwrap_or(0.0),
            friction: of("dynamics", "friction")?.unwrap_or(0.0),
            armature: ARMATURE,
        })
    }

    /// Joints that mimic others move with them, as far as both may.
    fn resolve(&mut self, tree: &mut Tree) -> Result<(), Refusal> {
        let mimics = std::mem::take(&mut tree.mimics);
        let mut kept: Vec<Option<usize>> = Vec::new();
        let mut count = 0;
        for drive in 0..tree.drives.len() {
            let is_own = mimics.iter().all(|(own, ..)| *own != drive);
            kept.push(is_own.then_some(count));
            count += usize::from(is_own);
        }
        let named = |name: &str| tree.drives.iter().position(|drive| drive.name == name);
        let mut to = kept.clone();
        let mut follows = Vec::new();
        for (own, name, fault) in mimics {
            let Some((leader, number)) = named(&name).and_then(|leader| Some((leader, kept[leader]?))) else {
                return Err(fault);
            };
            to[own] = Some(number);
            follows.push((own, leader));
        }
        follows.into_iter().for_each(|(own, leader)| self.stop_with(tree, own, leader));
        for joint in tree.links.iter_mut().map(|link| &mut link.joint).filter(|joint| joint.freedom != Freedom::Fixed) {
            joint.drive = to[joint.drive].unwrap_or_default();
        }
        let mut number = 0;
        tree.drives.retain(|_| {
            number += 1;
            kept[number - 1].is_some()
        });
        Ok(())
    }

    /// A drive goes only as far as one that follows it may.
    fn stop_with(&mut self, tree: &mut Tree, follower: usize, leader: usize) {
        let mut moving = tree.links.iter().map(|link| &link.joint).filter(|joint| joint.freedom != Freedom::Fixed);
        let joint = moving.find(|joint| joint.drive == follower);
        let (own, led) = (&tree.drives[follower], &tree.drives[leader]);
        // Many files give those that follow no limits of their own, or zeros.
        let Some(joint) = joint.filter(|joint| joint.ratio != 0.0 && own.limits[0] < own.limits[1]) else { return };
        let ends = own.limits.map(|end| (end - joint.offset) / joint.ratio);
        let [least, most] = [led.limits[0].max(ends[0].min(ends[1])), led.limits[1].min(ends[0].max(ends[1]))];
        let (own, name) = (&own.name, &led.name);
        if least > most {
            self.warnings.push(format!(
                "joint '{own}' has limits that leave '{name}', which it follows, no position; they are ignored"
            ));
        } else if least > led.limits[0] + SAME_LIMIT || most < led.limits[1] - SAME_LIMIT {
            self.warnings.push(format!(
                "joint '{name}' stops at {least:.4} and {most:.4}, where '{own}', which follows it, reaches its limits"
            ));
            tree.drives[leader].limits = [least, most];
        }
    }

    fn link(&mut self, name: &str, node: Xml<'a>, parent: Option<usize>, joint: Joint) -> Result<Link, Refusal> {
        let mut link = Link { name: name.to_owned(), ..Link::frame(name, parent, joint) };
        if let Some(inertial) = node.children().find(|child| child.has_tag_name("inertial")) {
            let place = self.origin(inertial)?;
            let mass = self.child(inertial, "mass")?;
            link.mass = self.required(mass, "value")?;
            if link.mass < 0.0 {
                return Err(self.fault(node, &format!("its mass is {}", link.mass), "give 0 or more"));
            }
            let tensor = self.child(inertial, "inertia")?;
            let [xx, xy, xz, yy, yz, zz] =
                ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"].map(|key| self.number(tensor, key));
            let value = |entry: Result<Option<f64>, Refusal>| entry.map(Option::unwrap_or_default);
            let [xx, xy, xz, yy, yz, zz] = [value(xx)?, value(xy)?, value(xz)?, value(yy)?, value(yz)?, value(zz)?];
            let own = DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz));
            let turn = DMat3::from_quat(place.rotation);
            (link.centre, link.inertia) = (place.position, turn * own * turn.transpose());
        }
        let mut parts = Vec::new();
        for collision in node.children().filter(|child| child.has_tag_name("collision")) {
            let place = self.origin(collision)?;
            let primitive = self.solid(name, collision)?;
            parts.push(Part::new(primitive, place));
        }
        link.shape = (!parts.is_empty()).then(|| Sdf::new(parts).seen_from(link.centre));
        link.visuals = self.visuals(node);
        if let Some(shape) = link.shape.as_ref().filter(|_| link.visuals.is_empty()) {
            let place = Pose { position: link.centre, ..Pose::IDENTITY };
            link.visuals = vec![Visual { mesh: mesh_of(shape), place, colour: None }];
        }
        Ok(link)
    }

    /// Could the bodies that move have the inertias that they are given? A link may not, such as a camera of which only the mass is known: what counts
    /// is a link that moves and all that is fixed to it. To be mended, it takes that of the nearest body.
    fn check_inertias(&mut self, tree: &mut Tree, links: &[(&str, Xml<'a>)]) -> Result<(), Refusal> {
        let moves = |link: &Link| link.parent.is_none() || link.joint.freedom != Freedom::Fixed;
        // Where each link is in that which it is fixed to.
        let mut within: Vec<(usize, Pose)> = Vec::new();
        for (i, link) in tree.links.iter().enumerate() {
            within.push(match link.parent {
                Some(parent) if !moves(link) => (within[parent].0, within[parent].1.then(&link.joint.origin)),
                _ => (i, Pose::IDENTITY),
            });
        }
        let movers: Vec<usize> = (0..tree.links.len()).filter(|&i| moves(&tree.links[i])).collect();
        for mover in movers {
            let parts = || {
                tree.links.iter().zip(&within).filter(|(_, (to, _))| *to == mover).map(|(link, (_, pose))| (link, pose))
            };
            let mass: f64 = parts().map(|(link, _)| link.mass).sum();
            if mass == 0.0 {
                continue;
            }
            let centre = parts().map(|(link, pose)| link.mass * pose.apply(link.centre)).sum::<DVec3>() / mass;
            let inertia = parts().fold(DMat3::ZERO, |sum, (link, pose)| {
                let (turn, arm) = (DMat3::from_quat(pose.rotation), pose.apply(link.centre) - centre);
                let moved = DMat3::from_diagonal(DVec3::splat(arm.length_squared())) - outer(arm, arm);
                sum + turn * link.inertia * turn.transpose() + link.mass * moved
            });
            let Some(what) = nonphysical(inertia) else { continue };
            let name = tree.links[mover].name.as_str();
            let node =
                links.iter().find(|(known, _)| *known == name).map_or(self.document.root_element(), |(_, node)| *node);
            let fault = self.fault(
                node,
                &what,
                "correct its <inertia>, or set mend_inertias = true in the scene, which raises what is too small",
            );
            if !self.source.mends {
                return Err(fault);
            }
            self.warnings.push(format!("{}; it was mended", fault.what));
            tree.links[mover].inertia += mended(inertia) - inertia;
        }
        Ok(())
    }

    /// What a link touches with by a collision element.
    fn solid(&mut self, link: &str, collision: Xml<'a>) -> Result<Primitive, Refusal> {
        let kind = self.geometry(collision)?;
        if !kind.has_tag_name("mesh") {
            return self.primitive(kind);
        }
        let file = self.mesh_file(kind)?;
        let fault = |refusal: Refusal| self.fault(kind, &refusal.what, &refusal.mend);
        let triangles = Triangles::read(&file, self.mesh_scale(kind)?).map_err(fault)?;
        let is_exact = self.source.meshes.are_exact(link);
        let hulled = |refusal: Refusal| Refusal {
            mend: format!(
                "{}; or take its convex hull: name the others: collision_meshes = {{ exact_links = [\"NAME\", …] }}",
                refusal.mend
            ),
            ..refusal
        };
        let mesh = if is_exact { triangles.mesh().map_err(hulled) } else { triangles.hull() }.map_err(fault)?;
        // What a mesh with holes holds, nobody can tell.
        let own = if is_exact { None } else { triangles.mesh().ok() };
        let share = own.map_or(1.0, |own| Filling::of_mesh(&mesh).volume / Filling::of_mesh(&own).volume);
        if share > HOLLOW {
            let file = file.file_name().unwrap_or_default().display();
            self.hollow.push(format!("'{link}' ({file}, {share:.1} times)"));
        }
        let grid = DistanceGrid::sample(&mesh);
        Ok(Primitive::Mesh(Arc::new(MeshPart { mesh, grid })))
    }

    /// Is there a link with a collision mesh for each name of those whose meshes are to be exact?
    fn check_exact(&self, root: Xml<'a>, links: &[Link]) -> Result<(), Refusal> {
        let CollisionMeshes::ExactLinks(patterns) = self.source.meshes else { return Ok(()) };
        let has_mesh = |link: &&Link| {
            let mut parts = link.shape.iter().flat_map(|shape| shape.parts());
            parts.any(|part| matches!(part.primitive, Primitive::Mesh(_)))
        };
        let names: Vec<&str> = links.iter().filter(has_mesh).map(|link| &*link.name).collect();
        let Some(pattern) = patterns.iter().find(|pattern| !names.iter().any(|name| fits(pattern, name))) else {
            return Ok(());
        };
        let what = format!("collision_meshes: no link with a collision mesh is called '{pattern}'");
        let mend = match &names[..] {
            [] => "leave collision_meshes out: no link has one".to_owned(),
            names => format!("those with one are: {}", names.join(", ")),
        };
        Err(self.fault(root, &what, &mend))
    }

    fn warn_of_hollow(&mut self) {
        if !self.hollow.is_empty() {
            self.warnings.push(format!(
                "convex hulls stand for collision meshes and hold much more than these, so that nothing gets into their hollows: {}; if that matters, set collision_meshes = \"exact\", or {{ exact_links = [\"NAME\", …] }} for some links",
                self.hollow.join(", ")
            ));
        }
    }

    /// What takes a mesh's unit to metres, along each axis.
    pub(super) fn mesh_scale(&self, mesh: Xml<'a>) -> Result<DVec3, Refusal> {
        Ok(self.numbers::<3>(mesh, "scale")?.map_or(DVec3::ONE, DVec3::from_array))
    }

    /// The shape that a collision or visual element holds.
    pub(super) fn geometry(&self, element: Xml<'a>) -> Result<Xml<'a>, Refusal> {
        let geometry = self.child(element, "geometry")?;
        geometry
            .children()
            .find(Node::is_element)
            .ok_or_else(|| self.fault(geometry, "it is empty", "give a box, sphere, cylinder, capsule or mesh"))
    }

    /// A shape that is no mesh.
    pub(super) fn primitive(&self, kind: Xml<'a>) -> Result<Primitive, Refusal> {
        let length = |key: &str| {
            let value = self.required(kind, key)?;
            if value > 0.0 {
                Ok(value)
            } else {
                Err(self.fault(kind, &format!("{key} is {value}"), "give a positive length"))
            }
        };
        Ok(match kind.tag_name().name() {
            "box" => {
                let size =
                    self.numbers::<3>(kind, "size")?.map(DVec3::from_array).filter(|size| size.min_element() > 0.0);
                let Some(size) = size else {
                    return Err(self.fault(kind, "its size is missing or not positive", "give three positive lengths"));
                };
                Primitive::Box { half: 0.5 * size }
            }
            "sphere" => Primitive::Sphere { radius: length("radius")? },
            "cylinder" => Primitive::Cylinder { radius: length("radius")?, half_height: 0.5 * length("length")? },
            "capsule" => Primitive::Capsule { radius: length("radius")?, half_height: 0.5 * length("length")? },
            other => {
                let mend = "use box, sphere, cylinder, capsule or mesh";
                return Err(self.fault(kind, &format!("'{other}' is no shape that is known"), mend));
            }
        })
    }

    /// The URDF's folder, and those around it, as its path says it and as links in the file system lead there.
    fn around(&self) -> Vec<PathBuf> {
        // A path may begin in the folder that the program runs in.
        let here = Path::new(".").join(self.source.folder).components().collect::<PathBuf>();
        let roots = [std::path::absolute(&here), here.canonicalize()];
        let all = roots.iter().flatten().flat_map(|root| root.ancestors());
        all.map(Path::to_owned).collect()
    }

    /// Where a mesh lies: beside the URDF, or in a package around it.
    pub(super) fn mesh_file(&self, mesh: Xml<'a>) -> Result<PathBuf, Refusal> {
        let name = self.text(mesh, "filename")?;
        let Some(rest) = name.strip_prefix("package://").or_else(|| name.strip_prefix("model://")) else {
            return Ok(self.source.folder.join(name.strip_prefix("file://").unwrap_or(name)));
        };
        let around = self.around();
        around.iter().map(|folder| folder.join(rest)).find(|file| file.exists()).ok_or_else(|| {
            let here = around.first().map_or(self.source.folder, PathBuf::as_path);
            self.fault(
                mesh,
                &format!("{name} is in no folder around {}", here.display()),
                "put the package's folder beside one of those, or write a path from the URDF's folder",
            )
        })
    }

    pub(super) fn origin(&self, node: Xml<'a>) -> Result<Pose, Refusal> {
        let Some(origin) = node.children().find(|child| child.has_tag_name("origin")) else {
            return Ok(Pose::IDENTITY);
        };
        let position = self.numbers::<3>(origin, "xyz")?.map_or(DVec3::ZERO, DVec3::from_array);
        let [roll, pitch, yaw] = self.numbers::<3>(origin, "rpy")?.unwrap_or_default();
        let rotation = DQuat::from_rotation_z(yaw) * DQuat::from_rotation_y(pitch) * DQuat::from_rotation_x(roll);
        Ok(Pose { position, rotation })
    }

    pub(super) fn child(&self, node: Xml<'a>, tag: &str) -> Result<Xml<'a>, Refusal> {
        let missing = || self.fault(node, &format!("it has no <{tag}>"), &format!("add <{tag}>"));
        node.children().find(|child| child.has_tag_name(tag)).ok_or_else(missing)
    }

    fn text(&self, node: Xml<'a>, key: &str) -> Result<&'a str, Refusal> {
        let missing = || self.fault(node, &format!("it has no {key}"), &format!("add {key}=\"…\""));
        node.attribute(key).filter(|text| !text.trim().is_empty()).ok_or_else(missing)
    }

    fn required(&self, node: Xml<'a>, key: &str) -> Result<f64, Refusal> {
        self.number(node, key)?
            .ok_or_else(|| self.fault(node, &format!("it has no {key}"), &format!("add {key}=\"…\"")))
    }

    fn number(&self, node: Xml<'a>, key: &str) -> Result<Option<f64>, Refusal> {
        Ok(self.numbers::<1>(node, key)?.map(|[value]| value))
    }

    pub(super) fn numbers<const N: usize>(&self, node: Xml<'a>, key: &str) -> Result<Option<[f64; N]>, Refusal> {
        let Some(text) = node.attribute(key) else { return Ok(None) };
        let numbers: Option<Vec<f64>> =
            text.split_whitespace().map(|word| word.parse().ok().filter(|x: &f64| x.is_finite())).collect();
        match numbers.and_then(|numbers| numbers.try_into().ok()) {
            Some(numbers) => Ok(Some(numbers)),
            None => Err(self.fault(node, &format!("{key} = \"{text}\""), &format!("give {N} finite numbers"))),
        }
    }
}

/// Principal moments of inertia and their axes.
fn principal(inertia: DMat3) -> SymmetricEigen<f64, nalgebra::Const<3>> {
    SymmetricEigen::new(Matrix3::from_fn(|i, j| inertia.col(j)[i]))
}

/// Why no body has this inertia.
fn nonphysical(inertia: DMat3) -> Option<String> {
    let moments = principal(inertia).eigenvalues;
    let (most, sum) = (moments.max(), moments.sum());
    // Of the second moments of a body, which are half the sum less each, none is negative.
    let least = moments.map(|one| 0.5 * sum - one).min();
    let [a, b, c] = [0, 1, 2].map(|i| moments[i]);
    (least < -ROUNDING * most || moments.min() < 0.0).then(|| {
        format!(
            "with what is fixed to it, it has principal moments of inertia of {a:.3e}, {b:.3e} and {c:.3e} kg m², which no body has: one is negative, or greater than the others together"
        )
    })
}

/// The inertia of the nearest body.
fn mended(inertia: DMat3) -> DMat3 {
    let eigen = principal(inertia);
    let (sum, most) = (eigen.eigenvalues.sum(), eigen.eigenvalues.abs().max());
    let seconds = eigen.eigenvalues.map(|one| (0.5 * sum - one).max(1e-3 * most));
    let total = seconds.sum();
    let mended =
        eigen.eigenvectors * Matrix3::from_diagonal(&seconds.map(|one| total - one)) * eigen.eigenvectors.transpose();
    DMat3::from_cols_array(&std::array::from_fn(|i| mended[(i % 3, i / 3)]))
}

/// The tree as it grows.
struct Tree {
    links: Vec<Link>,
    drives: Vec<Drive>,
    /// Drives that mimic others: the drive, the other joint's name, and what to say if there is none.
    mimics: Vec<(usize, String, Refusal)>,
}

/// By so much less, limits are the same.
const SAME_LIMIT: f64 = 1e-6;
/// Limits of a joint without stops.
const UNLIMITED: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

impl Joint {
    pub(super) fn moving(name: &str, freedom: Freedom, origin: Pose, axis: DVec3) -> Self {
        Self { name: name.to_owned(), freedom, origin, axis, drive: 0, ratio: 1.0, offset: 0.0 }
    }

    pub(super) fn fixed(name: &str) -> Self {
        Self::moving(name, Freedom::Fixed, Pose::IDENTITY, DVec3::X)
    }
}

impl Link {
    /// One without mass and shape.
    pub(super) fn frame(name: &str, parent: Option<usize>, joint: Joint) -> Self {
        Self {
            name: name.to_owned(),
            parent,
            joint,
            mass: 0.0,
            centre: DVec3::ZERO,
            inertia: DMat3::ZERO,
            shape: None,
            visuals: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Source;
    use crate::robot::RobotModel;

    /// A joint stops where one that follows it reaches its limits; what leaves it no position, and zeros, are no limits.
    #[test]
    fn a_joint_goes_as_far_as_those_that_follow_it() {
        let link = |name: &str| {
            format!(
                "<link name='{name}'><inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
            )
        };
        let joint = |name: &str, child: &str, limits: &str, more: &str| {
            format!(
                "<joint name='{name}' type='revolute'><parent link='a'/><child link='{child}'/><axis xyz='0 0 1'/><limit effort='1' velocity='1' {limits}/>{more}</joint>"
            )
        };
        let limits_with = |limits: &str, multiplier: f64| {
            let follower = joint(
                "follower",
                "c",
                limits,
                &format!("<mimic joint='leader' multiplier='{multiplier}' offset='0.5'/>"),
            );
            let leader = joint("leader", "b", "lower='-1' upper='2'", "");
            let text = format!("<robot name='r'>{}{}{}{follower}{leader}</robot>", link("a"), link("b"), link("c"));
            let model = RobotModel::read(&Source::of(&text)).unwrap_or_else(|e| panic!("{}", e.what));
            (model.drives[0].limits, model.warnings)
        };
        for (limits, multiplier, wanted, says) in [
            ("lower='-9' upper='9'", 2.0, [-1.0, 2.0], ""),
            ("lower='-0.5' upper='2.5'", 2.0, [-0.5, 1.0], "'leader' stops at -0.5000 and 1.0000, where 'follower'"),
            ("lower='-0.5' upper='2.5'", -1.0, [-1.0, 1.0], "'leader' stops at -1.0000 and 1.0000"),
            ("lower='7' upper='8'", 1.0, [-1.0, 2.0], "no position; they are ignored"),
            ("", 1.0, [-1.0, 2.0], ""),
        ] {
            let (found, warnings) = limits_with(limits, multiplier);
            assert_eq!(found, wanted, "{limits}, {multiplier}");
            let said = warnings.join("");
            assert!(if says.is_empty() { said.is_empty() } else { said.contains(says) }, "{limits}: {said}");
        }
    }
}
