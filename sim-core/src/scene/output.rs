//! What a run writes: pictures, the trace, particles, surfaces and heights of its ground, and how often.

use super::{Body, Scene, Shape, Terrain};
use crate::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What is written, and how often.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Simulated seconds between pictures.
    #[serde(default = "default_interval")]
    pub interval: f64,
    /// Particle files beside the pictures.
    #[serde(default)]
    pub export: Option<Export>,
    /// Fields that particle files hold besides the position; * stands for any text, as in `["velocity", "history*"]`. Absent: all.
    #[serde(default)]
    pub export_fields: Option<Vec<String>>,
    /// Meshes of the ground's surface, `surface/*.ply`.
    #[serde(default)]
    pub surface: Option<SurfaceOutput>,
    /// Maps of the ground's height, `height/*.npz`.
    #[serde(default)]
    pub height_map: Option<HeightOutput>,
    /// Simulated seconds between snapshots; absent: one at the end and one on interruption.
    #[serde(default)]
    pub snapshot_interval: Option<f64>,
    /// The trace, `trace.csv`.
    #[serde(default)]
    pub trace: Trace,
    /// Pictures.
    #[serde(default)]
    pub picture: Picture,
}

/// What the trace holds.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Trace {
    /// Simulated seconds between rows, which then hold the mean forces on bodies since the row before, and mass, energies and momentum of the
    /// ground besides; absent: a row for each step, without those.
    #[serde(default)]
    pub interval: Option<f64>,
    /// Columns to be written beside time and step, with or without their units; * stands for any text, as in `"dog/*_foot mean f*"`. Absent: all.
    #[serde(default)]
    pub columns: Option<Vec<String>>,
    /// At the run's end, write it as an archive of arrays too, `trace.npz`.
    #[serde(default)]
    pub npz: bool,
    /// And as a Parquet file, `trace.parquet`; only in programs that were built with the feature `parquet`.
    #[serde(default)]
    pub parquet: bool,
}

fn default_interval() -> f64 {
    0.05
}

impl Default for Output {
    fn default() -> Self {
        Self {
            interval: default_interval(),
            export: None,
            export_fields: None,
            surface: None,
            height_map: None,
            snapshot_interval: None,
            trace: Trace::default(),
            picture: Picture::default(),
        }
    }
}

/// A particle file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Export {
    /// Stanford polygon file, binary.
    Ply,
    /// NumPy archive.
    Npz,
    /// VTK unstructured points (.vtu).
    Vtk,
}

/// What pictures show.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Picture {
    /// Are pictures made at all?
    #[serde(default = "super::yes")]
    pub on: bool,
    /// Longest side in pixels, with the margins; a page with its legend is never less than 540 wide. The ground alone is 28 pixels narrower.
    #[serde(default = "default_pixels")]
    pub pixels: u32,
    /// Quantity that colours the vertical cut.
    #[serde(default)]
    pub cut: CutColour,
    /// How the scene is seen above the cut; absent: in perspective where there is a robot, a tool or a soft body that stands out
    /// of the ground, or a camera is given, and from the top otherwise.
    #[serde(default)]
    pub view: Option<PictureView>,
    /// Where pictures in perspective are taken from.
    #[serde(default)]
    pub camera: Option<Camera>,
    /// World y of the vertical cut [m]; absent: the middle.
    #[serde(default)]
    pub cut_y: Option<f64>,
    /// Draw where the boxes of nested levels end.
    #[serde(default = "super::yes")]
    pub levels: bool,
}

fn default_pixels() -> u32 {
    960
}

impl Default for Picture {
    fn default() -> Self {
        Self {
            on: true,
            pixels: default_pixels(),
            cut: CutColour::default(),
            view: None,
            camera: None,
            cut_y: None,
            levels: true,
        }
    }
}

/// How a picture shows a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PictureView {
    /// From straight above, as a map of heights.
    Top,
    /// By a camera.
    Perspective,
}

/// Where pictures in perspective are taken from. What is absent is chosen so that the robots, or else the ground and what stands on it, fill the picture,
/// seen from above, from greater x and lesser y: in front of a robot that faces along x, and on its right.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Where it stands [m].
    #[serde(default)]
    pub position: Option<Vec3>,
    /// What it looks at [m].
    #[serde(default)]
    pub target: Option<Vec3>,
    /// Angle between the left and the right side of the picture, from 1 to 150 [degrees].
    #[serde(default = "default_fov")]
    pub fov_deg: f64,
    /// A tool, a robot or a robot's link (`robot/link`) with which camera and target move along x and y. Absent: where the ground is far wider than
    /// the robots, the first robot; else the camera stands still.
    #[serde(default)]
    pub follow: Option<String>,
}

fn default_fov() -> f64 {
    32.0
}

impl Default for Camera {
    fn default() -> Self {
        Self { position: None, target: None, fov_deg: default_fov(), follow: None }
    }
}

impl Scene {
    /// How its pictures show it.
    pub fn picture_view(&self) -> PictureView {
        let picture = &self.output.picture;
        let stands_out = !self.robot.is_empty()
            || !self.tool.is_empty()
            || picture.camera.is_some()
            || !self.inflow.is_empty()
            || self.body.iter().any(|body| !self.is_bed(body));
        picture.view.unwrap_or(if stands_out { PictureView::Perspective } else { PictureView::Top })
    }

    /// Is a soft body ground: a box, a height field or a terrain that takes up half of the world or more, seen from above?
    pub fn is_bed(&self, body: &Body) -> bool {
        let (min, max) = match &body.shape {
            Shape::Box { min: Some(min), max: Some(max), .. } => ([min[0], min[1]], [max[0], max[1]]),
            Shape::HeightField { min, max, .. } | Shape::Terrain(Terrain { min, max, .. }) => (*min, *max),
            _ => return false,
        };
        let share = |d: usize| (max[d] - min[d]) / (self.world.max[d] - self.world.min[d]);
        share(0) * share(1) >= 0.5
    }
}

/// Quantity that colours the vertical cut.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CutColour {
    /// Pressure [Pa].
    #[default]
    Pressure,
    /// Speed [m/s].
    Speed,
}

/// A triangle mesh of the surface of all soft ground and bodies, as PLY.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SurfaceOutput {
    /// Simulated seconds between meshes.
    pub interval: f64,
    /// Width of the cells that the mesh is made on [m]; absent: the finest cell of the world.
    #[serde(default)]
    pub spacing: Option<f64>,
}

/// The height of the ground in square columns of the whole world, as NPZ.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HeightOutput {
    /// Simulated seconds between maps.
    pub interval: f64,
    /// Width of a column [m]; absent: the finest cell of the world.
    #[serde(default)]
    pub spacing: Option<f64>,
    /// Write each as a grey picture of 16 bits too.
    #[serde(default)]
    pub png: bool,
}
