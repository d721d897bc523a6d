//! What a robot's links look like: the `<visual>` elements of a URDF.
//!
//! A robot works without them: what cannot be drawn is a warning, and the link's collision shape is drawn instead.

use super::dynamics::Place;
use super::model::{Link, RobotModel};
use super::urdf::{Reader, Xml};
use crate::mesh::coloured_corners;
use crate::motion::Pose;
use crate::surface::placed;
use crate::{Refusal, surface};
use barchan_core::surface::{Mesh, Surface};
use glam::DVec3;
use roxmltree::Node;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::SystemTime;

/// A part of what a link looks like.
#[derive(Clone, Debug)]
pub struct Visual {
    /// Its triangles [m].
    pub mesh: Arc<Mesh>,
    /// Where they are in the link's frame.
    pub place: Pose,
    /// Colour, sRGB from 0 to 1, if the file says one.
    pub colour: Option<[f32; 3]>,
}

impl RobotModel {
    /// What it looks like with its links at these places.
    pub fn surfaces(&self, places: &[Place]) -> Vec<Surface> {
        let of_link = |(link, place): (&Link, &Place)| -> Vec<Surface> {
            let part = |visual: &Visual| placed(&visual.mesh, &place.frame.then(&visual.place), visual.colour);
            link.visuals.iter().map(part).collect()
        };
        self.links.iter().zip(places).flat_map(of_link).collect()
    }
}

/// Meshes of one colour each.
type Coloured<M> = Vec<(Option<[f32; 3]>, M)>;

/// A file as it was when it was read, and the scale along each axis.
type Key = (PathBuf, Option<SystemTime>, [u64; 3]);

/// Meshes that some robot holds now: robots of a kind, in many worlds, share them.
static HELD: Mutex<Option<HashMap<Key, Coloured<Weak<Mesh>>>>> = Mutex::new(None);

/// Triangles of a mesh's file, by colour.
fn read(file: &Path, scale: DVec3) -> Result<Coloured<Arc<Mesh>>, Refusal> {
    let modified = std::fs::metadata(file).and_then(|data| data.modified()).ok();
    let key: Key = (file.to_owned(), modified, scale.to_array().map(f64::to_bits));
    let held = || HELD.lock().unwrap_or_else(PoisonError::into_inner);
    let known = held().get_or_insert_default().get(&key).and_then(|meshes| {
        meshes.iter().map(|(colour, mesh)| Some((*colour, mesh.upgrade()?))).collect::<Option<Vec<_>>>()
    });
    if let Some(meshes) = known {
        return Ok(meshes);
    }
    let mut meshes = Vec::new();
    for (colour, triangles) in coloured_corners(file)? {
        if triangles.iter().flatten().any(|x| !x.is_finite()) {
            return Err(Refusal::new(format!("{}: a vertex is not finite", file.display()), "repair the file"));
        }
        meshes.push((colour, surface::mesh(triangles.into_iter().map(|t| t.map(|x| x * scale)).collect())));
    }
    let mut held = held();
    let all = held.get_or_insert_default();
    all.retain(|_, meshes| meshes.iter().all(|(_, mesh)| mesh.strong_count() > 0));
    all.insert(key, meshes.iter().map(|(colour, mesh)| (*colour, Arc::downgrade(mesh))).collect());
    Ok(meshes)
}

impl<'a> Reader<'a> {
    /// What a link looks like; nothing if it is to be drawn as its collision shape.
    pub(super) fn visuals(&mut self, link: Xml<'a>) -> Vec<Visual> {
        let mut all = Vec::new();
        for visual in link.children().filter(|child| child.has_tag_name("visual")) {
            match self.visual(visual) {
                Ok(parts) => all.extend(parts),
                Err(refusal) => {
                    self.warnings.push(format!("{}; pictures show the link's collision shape", refusal.what));
                    return Vec::new();
                }
            }
        }
        all
    }

    fn visual(&self, visual: Xml<'a>) -> Result<Vec<Visual>, Refusal> {
        let place = self.origin(visual)?;
        let kind = self.geometry(visual)?;
        let colour = self.colour(visual)?;
        if kind.has_tag_name("mesh") {
            let (file, scale) = (self.mesh_file(kind)?, self.mesh_scale(kind)?);
            let meshes = read(&file, scale).map_err(|refusal| self.fault(kind, &refusal.what, &refusal.mend))?;
            // White is what many files say who leave it to the mesh.
            let own = colour.filter(|colour| *colour != [1.0; 3]);
            let part = |(its, mesh)| Visual { mesh, place, colour: own.or(its).or(colour) };
            return Ok(meshes.into_iter().map(part).collect());
        }
        let mesh = surface::mesh(surface::primitive(&self.primitive(kind)?));
        Ok(vec![Visual { mesh, place, colour }])
    }

    /// The colour of a visual element, by itself or by the name of a material of the robot.
    fn colour(&self, visual: Xml<'a>) -> Result<Option<[f32; 3]>, Refusal> {
        let Some(material) = visual.children().find(|child| child.has_tag_name("material")) else { return Ok(None) };
        let of = |node: Node<'a, 'a>| node.children().find(|child| child.has_tag_name("color"));
        let name = material.attribute("name");
        let shared = || {
            let materials = self.document.root_element().children().filter(|node| node.has_tag_name("material"));
            materials.filter(|node| node.attribute("name") == name).find_map(of)
        };
        let Some(colour) = of(material).or_else(shared) else { return Ok(None) };
        let rgba = self.numbers::<4>(colour, "rgba")?;
        Ok(rgba.map(|rgba| std::array::from_fn(|c| rgba[c].clamp(0.0, 1.0) as f32)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::RobotModel;
    use super::super::urdf::Source;

    fn read(visual: &str) -> RobotModel {
        let text = format!(
            "<robot name='r'><material name='red'><color rgba='1 0 0 1'/></material><link name='a'>
             <inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial>{visual}
             <collision><geometry><box size='1 2 3'/></geometry></collision></link></robot>"
        );
        RobotModel::read(&Source::of(&text)).unwrap_or_else(|e| panic!("{}", e.what))
    }

    #[test]
    fn a_visual_has_its_shape_place_and_colour() {
        let model = read(
            "<visual><origin xyz='0 0 2'/><geometry><sphere radius='0.5'/></geometry><material name='red'/></visual>",
        );
        let [visual] = &model.links[0].visuals[..] else { panic!("there is one") };
        assert_eq!((visual.place.position.z, visual.colour), (2.0, Some([1.0, 0.0, 0.0])));
        let far = visual.mesh.corners.iter().flatten().map(|p| p[2]).fold(0.0, f32::max);
        assert!((far - 0.5).abs() < 1e-6 && model.warnings.is_empty(), "{far}, {:?}", model.warnings);
    }

    #[test]
    fn what_cannot_be_drawn_is_a_warning_and_the_collision_shape_is_drawn() {
        let lost = "<visual><geometry><mesh filename='lost.stl'/></geometry></visual>";
        for (visual, warnings) in [("", 0), (lost, 1)] {
            let model = read(visual);
            assert_eq!(model.warnings.len(), warnings, "{:?}", model.warnings);
            assert!(model.warnings.iter().all(|w| w.contains("lost.stl") && w.contains("collision shape")));
            assert_eq!(model.links[0].visuals[0].mesh.corners.len(), 12);
        }
    }
}
