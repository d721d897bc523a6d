//! What a robot is made of: a tree of links and joints, as its URDF says it.

use super::urdf::Source;
use super::visual::Visual;
use crate::motion::Pose;
use crate::{Refusal, Sdf};
use barchan_core::scene::{self, CollisionMeshes, fits};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Robots that come with the program: name and URDF.
pub const BUILT_IN: [(&str, &str); 6] = [
    ("quadruped", include_str!("../../models/quadruped.urdf")),
    ("humanoid", include_str!("../../models/humanoid.urdf")),
    ("arm", include_str!("../../models/arm.urdf")),
    ("arm-rod", include_str!("../../models/arm-rod.urdf")),
    ("arm-shovel", include_str!("../../models/arm-shovel.urdf")),
    ("arm-scraper", include_str!("../../models/arm-scraper.urdf")),
];

/// How a link moves against its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Freedom {
    /// Not at all.
    Fixed,
    /// It turns about an axis through the joint's origin.
    Revolute,
    /// It slides along an axis.
    Prismatic,
}

/// The joint between a link and its parent.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name in the URDF; of the joints that a planar one is made of, with `/x`, `/y` and `/turn` behind it.
    pub name: String,
    /// How it moves.
    pub freedom: Freedom,
    /// The link's frame within its parent's where the joint's position is 0.
    pub origin: Pose,
    /// Unit axis, in the link's frame.
    pub axis: DVec3,
    /// Which of the robot's joint positions is its own: its position is `ratio` times that one and `offset` [rad or m].
    pub drive: usize,
    /// See [`drive`](Self::drive); 1 but for joints that mimic another.
    pub ratio: f64,
    /// See [`drive`](Self::drive).
    pub offset: f64,
}

/// A rigid part.
#[derive(Clone, Debug)]
pub struct Link {
    /// Name in the URDF.
    pub name: String,
    /// Its parent; none for the base.
    pub parent: Option<usize>,
    /// The joint to its parent; of the base, a fixed one at its origin.
    pub joint: Joint,
    /// Mass [kg].
    pub mass: f64,
    /// Centre of mass, in the link's frame [m].
    pub centre: DVec3,
    /// Inertia about the centre of mass, along the axes of the link's frame [kg m²].
    pub inertia: DMat3,
    /// Its collision shape, about the centre of mass.
    pub shape: Option<Sdf>,
    /// What it looks like; its collision shape where the URDF says nothing that can be drawn.
    pub visuals: Vec<Visual>,
}

/// A joint position that can be driven.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Name of the joint.
    pub name: String,
    /// Does it turn [rad, N m], or slide [m, N]?
    pub turns: bool,
    /// Least and greatest position [rad or m]; infinite where there is no stop.
    pub limits: [f64; 2],
    /// Greatest torque or force of its motor [N m or N].
    pub effort: f64,
    /// Greatest speed to which its motor drives it [rad/s or m/s].
    pub speed: f64,
    /// Torque against its motion for each unit of speed [N m s or N s/m].
    pub damping: f64,
    /// Torque of dry friction [N m or N].
    pub friction: f64,
    /// Inertia of the motor as the joint feels it [kg m² or kg].
    pub armature: f64,
}

impl Drive {
    /// Is a position within its limits, or no further than `slack` beyond them [rad or m]?
    ///
    /// # Errors
    /// If it is not.
    pub(super) fn check_position(&self, position: f64, slack: f64) -> Result<(), Refusal> {
        let [low, high] = self.limits;
        if (low - slack..=high + slack).contains(&position) {
            return Ok(());
        }
        let what = format!("{position} is beyond the limits of joint '{}'", self.name);
        Err(Refusal::new(what, format!("give a position from {low} to {high}")))
    }
}

/// A robot's tree. A parent stands before its links.
#[derive(Clone, Debug)]
pub struct RobotModel {
    /// Name in the URDF.
    pub name: String,
    /// What its collision meshes stand for.
    pub collision_meshes: CollisionMeshes,
    /// Links, the base first.
    pub links: Vec<Link>,
    /// Joint positions that can be driven, in the order of their joints in the tree.
    pub drives: Vec<Drive>,
    /// Files of the meshes by which it touches.
    pub files: Vec<PathBuf>,
    /// What was mended or left out on the way, for people.
    pub warnings: Vec<String>,
}

impl RobotModel {
    /// Mass of all links [kg].
    pub fn mass(&self) -> f64 {
        self.links.iter().map(|link| link.mass).sum()
    }

    /// The first drive that moves no link with mass or shape, if there is one.
    pub(super) fn moves_nothing(&self) -> Option<&str> {
        let mut moves = vec![false; self.drives.len()];
        for link in self.links.iter().filter(|link| link.mass > 0.0 || link.shape.is_some()) {
            let up = |link: &&Link| link.parent.map(|parent| &self.links[parent]);
            let joints = std::iter::successors(Some(link), up).map(|link| &link.joint);
            joints.filter(|joint| joint.freedom != Freedom::Fixed).for_each(|joint| moves[joint.drive] = true);
        }
        let still = moves.iter().position(|moves| !moves)?;
        Some(&self.drives[still].name)
    }

    /// The number of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }
}

impl RobotModel {
    /// What a scene's robot is made of; a file is looked for in `folder`.
    ///
    /// # Errors
    /// If the file or the model's name cannot be used.
    pub fn of(robot: &scene::Robot, folder: &Path) -> Result<Self, Refusal> {
        let (text, file): (String, PathBuf) = match (&robot.urdf, &robot.model) {
            (Some(urdf), _) => {
                let file = folder.join(urdf);
                let text = std::fs::read_to_string(&file).map_err(|e| {
                    Refusal::new(
                        format!("{}: {e}", file.display()),
                        "give the path of a URDF file, from the scene's folder",
                    )
                })?;
                (text, file)
            }
            (None, name) => {
                let name = name.as_deref().unwrap_or_default();
                let known = BUILT_IN.iter().find(|(known, _)| *known == name);
                let (_, text) = known.ok_or_else(|| {
                    let names: Vec<&str> = BUILT_IN.iter().map(|(name, _)| *name).collect();
                    Refusal::new(
                        format!("there is no model '{name}'"),
                        format!("known are: {}; or give a urdf", names.join(", ")),
                    )
                })?;
                ((*text).to_owned(), PathBuf::from(format!("{name}.urdf")))
            }
        };
        let name = file.display().to_string();
        let folder = file.parent().unwrap_or(folder);
        let mut model = Self::read(&Source {
            text: &text,
            file: &name,
            folder,
            mends: robot.mend_inertias,
            meshes: &robot.collision_meshes,
        })?;
        model.weigh(&robot.masses)?;
        Ok(model)
    }

    /// Gives links other masses [kg]; their inertias grow with these.
    fn weigh(&mut self, masses: &BTreeMap<String, f64>) -> Result<(), Refusal> {
        // Of the others no inertia is known.
        let heavy: Vec<usize> = (0..self.links.len()).filter(|&link| self.links[link].mass > 0.0).collect();
        let names: Vec<&str> = heavy.iter().map(|&link| self.links[link].name.as_str()).collect();
        let found = by_name(masses, &names, ["link", "link with a mass of its own"])?;
        for (&link, mass) in heavy.iter().zip(found).filter_map(|(link, mass)| Some((link, mass?))) {
            let link = &mut self.links[link];
            if !(mass.is_finite() && mass > 0.0) {
                let what = format!("masses: {mass} kg is no mass of link '{}'", link.name);
                return Err(Refusal::new(what, "give finite masses above 0"));
            }
            link.inertia *= mass / link.mass;
            link.mass = mass;
        }
        Ok(())
    }
}

/// What is given to each of `names`. Whole names count before patterns, and of these those that say more, whatever their order. `kinds` says what is named, and what
/// may be.
///
/// # Errors
/// If a name or pattern fits none, or two that say as much give one of them different numbers.
pub(super) fn by_name(
    given: &BTreeMap<String, f64>,
    names: &[&str],
    kinds: [&str; 2],
) -> Result<Vec<Option<f64>>, Refusal> {
    let says = |name: &str| (!name.contains('*'), name.chars().filter(|c| *c != '*').count());
    let mut all: Vec<(&String, f64)> = given.iter().map(|(name, value)| (name, *value)).collect();
    all.sort_by_key(|(name, _)| says(name));
    let mut set_by: Vec<Option<(&String, f64)>> = vec![None; names.len()];
    for (pattern, value) in all {
        let mut any = false;
        for (name, set_by) in names.iter().zip(&mut set_by).filter(|(name, _)| fits(pattern, name)) {
            any = true;
            if let Some((other, before)) = set_by.replace((pattern, value))
                && says(other) == says(pattern)
                && before != value
            {
                let what =
                    format!("'{other}' and '{pattern}' fit {} '{name}' alike, and give {before} and {value}", kinds[0]);
                return Err(Refusal::new(what, "give its name, or patterns that do not fit it both"));
            }
        }
        if !any {
            let what = format!("no {} fits '{pattern}'", kinds[1]);
            return Err(Refusal::new(what, format!("known are: {}", names.join(", "))));
        }
    }
    Ok(set_by.into_iter().map(|set_by| Some(set_by?.1)).collect())
}
