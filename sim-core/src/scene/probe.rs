//! Probes: what a run measures while it goes on.

use super::Scene;
use super::check::AXES;
use crate::{Aabb, Error, Result, Vec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// A measurement that is taken while a run goes on, into `probes.csv` and `summary.json`. One of `flux`, `within`, `surface`, `wall`, `nearest` and `chamfer` says
/// of what; `material`, `body` and `level` leave out other particles.
#[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Probe {
    /// Name: what its columns begin with.
    pub name: String,
    /// Simulated seconds from one value to the next; absent: `output.interval`.
    #[serde(default)]
    pub interval: Option<f64>,
    /// What has crossed a section since the start: mass, rest volume, momentum and particles, along its normal and against it. Every crossing within a step
    /// counts.
    #[serde(default)]
    pub flux: Option<Section>,
    /// What is in a region: particles, mass, rest volume, the share of the region that this fills, mean velocity and mean Cauchy stress.
    #[serde(default)]
    pub within: Option<Region>,
    /// Height of the surface of the ground, as [`Simulation::heights`](crate::Simulation::heights) says it. Of all materials and bodies.
    #[serde(default)]
    pub surface: Option<SurfaceProbe>,
    /// Impulse and force of the ground on a wall, or on a part of it. Of all materials and bodies.
    #[serde(default)]
    pub wall: Option<WallPart>,
    /// The particle nearest to a point [m]: where it is, its velocity, density and pressure.
    #[serde(default)]
    pub nearest: Option<Vec3>,
    /// How far the particles are from the points of a file, and these from the particles: a CSV file with x, y, z [m] in each line, after a header or not.
    #[serde(default)]
    pub chamfer: Option<PathBuf>,
    /// Only particles of this material.
    #[serde(default)]
    pub material: Option<String>,
    /// Only particles of this body.
    #[serde(default)]
    pub body: Option<String>,
    /// Only particles of this level, 0 the finest.
    #[serde(default)]
    pub level: Option<u32>,
}

/// A flat piece of a plane, with a side that counts as its front.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Section {
    /// A rectangle across an axis, in front of which that axis grows.
    Rectangle {
        /// Least corner [m].
        min: Vec3,
        /// Greatest corner [m]: the same along one axis.
        max: Vec3,
    },
    /// A disc.
    Disc {
        /// Its middle [m].
        center: Vec3,
        /// Out of its front; of any length.
        normal: Vec3,
        /// Radius [m].
        radius: f64,
    },
}

impl Section {
    /// A point of it and the unit normal out of its front.
    pub fn plane(&self) -> (Vec3, Vec3) {
        match *self {
            Self::Rectangle { min, max } => {
                let across = (0..3).find(|&d| min[d] == max[d]).unwrap_or(2);
                (min, std::array::from_fn(|d| if d == across { 1.0 } else { 0.0 }))
            }
            Self::Disc { center, normal, .. } => {
                let norm = normal.iter().map(|n| n * n).sum::<f64>().sqrt();
                (center, normal.map(|n| n / norm))
            }
        }
    }

    /// Does the part of its plane at this point belong to it?
    pub fn holds(&self, x: Vec3) -> bool {
        match *self {
            Self::Rectangle { min, max } => (0..3).all(|d| min[d] == max[d] || (min[d] <= x[d] && x[d] < max[d])),
            Self::Disc { center, radius, .. } => {
                (0..3).map(|d| (x[d] - center[d]).powi(2)).sum::<f64>() < radius * radius
            }
        }
    }

    /// A box around it.
    pub fn bounds(&self) -> Aabb {
        match *self {
            Self::Rectangle { min, max } => Aabb { min, max },
            Self::Disc { center, radius, .. } => {
                let (_, n) = self.plane();
                let half = n.map(|n| radius * (1.0 - n * n).max(0.0).sqrt());
                Aabb { min: from(center, half, -1.0), max: from(center, half, 1.0) }
            }
        }
    }
}

fn from(center: Vec3, half: Vec3, times: f64) -> Vec3 {
    std::array::from_fn(|d| center[d] + times * half[d])
}

/// A part of space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Region {
    /// A box along the axes.
    Box {
        /// Least corner [m].
        min: Vec3,
        /// Greatest corner [m].
        max: Vec3,
    },
    /// A sphere.
    Sphere {
        /// Its middle [m].
        center: Vec3,
        /// Radius [m].
        radius: f64,
    },
    /// An upright cylinder.
    Cylinder {
        /// Its middle [m].
        center: Vec3,
        /// Radius [m].
        radius: f64,
        /// Half its height [m].
        half_height: f64,
    },
}

impl Region {
    /// Its middle, and half its width along the axes [m].
    pub fn middle(&self) -> (Vec3, Vec3) {
        match *self {
            Self::Box { min, max } => {
                (std::array::from_fn(|d| 0.5 * (min[d] + max[d])), std::array::from_fn(|d| 0.5 * (max[d] - min[d])))
            }
            Self::Sphere { center, radius } => (center, [radius; 3]),
            Self::Cylinder { center, radius, half_height } => (center, [radius, radius, half_height]),
        }
    }

    /// Is a point in it? Its surface is not.
    pub fn contains(&self, x: Vec3) -> bool {
        let (center, half) = self.middle();
        let [x, y, z]: Vec3 = std::array::from_fn(|d| (x[d] - center[d]) / half[d]);
        match self {
            Self::Box { .. } => x.abs() < 1.0 && y.abs() < 1.0 && z.abs() < 1.0,
            Self::Sphere { .. } => x * x + y * y + z * z < 1.0,
            Self::Cylinder { .. } => x * x + y * y < 1.0 && z.abs() < 1.0,
        }
    }

    /// A box around it.
    pub fn bounds(&self) -> Aabb {
        let (center, half) = self.middle();
        Aabb { min: from(center, half, -1.0), max: from(center, half, 1.0) }
    }

    /// [m³]
    pub fn volume(&self) -> f64 {
        let (_, [a, b, c]) = self.middle();
        match self {
            Self::Box { .. } => 8.0 * a * b * c,
            Self::Sphere { .. } => 4.0 / 3.0 * std::f64::consts::PI * a * b * c,
            Self::Cylinder { .. } => 2.0 * std::f64::consts::PI * a * b * c,
        }
    }
}

/// Where the height of the surface is measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum SurfaceProbe {
    /// At points: a column each, and mean, least and greatest.
    Points(Vec<[f64; 2]>),
    /// Along a line, likewise.
    Line {
        /// Where it begins, x and y [m].
        from: [f64; 2],
        /// Where it ends [m].
        to: [f64; 2],
        /// Points on it, both ends included.
        points: u32,
    },
    /// On a patch of ground: mean, least and greatest height of as many points as are asked for.
    Patch {
        /// Least x and y [m].
        min: [f64; 2],
        /// Greatest x and y [m].
        max: [f64; 2],
        /// Points along x and along y, each in the middle of its share of the patch.
        points: [u32; 2],
        /// Adds the share of points above this height [m].
        #[serde(default)]
        above: Option<f64>,
    },
}

impl SurfaceProbe {
    /// Its points, x and y [m]: those of a patch row by row, x first.
    pub fn places(&self) -> Vec<[f64; 2]> {
        match self {
            Self::Points(points) => points.clone(),
            Self::Line { from, to, points } => {
                let along = |i: u32| f64::from(i) / f64::from((points - 1).max(1));
                let at = |i: u32| [0, 1].map(|d| from[d] + along(i) * (to[d] - from[d]));
                (0..*points).map(at).collect()
            }
            Self::Patch { min, max, points, .. } => {
                let along = |d: usize, i: u32| min[d] + (f64::from(i) + 0.5) / f64::from(points[d]) * (max[d] - min[d]);
                (0..points[1]).flat_map(|j| (0..points[0]).map(move |i| [along(0, i), along(1, j)])).collect()
            }
        }
    }
}

/// A side of the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// That of least x.
    XMin,
    /// That of greatest x.
    XMax,
    /// That of least y.
    YMin,
    /// That of greatest y.
    YMax,
    /// The floor.
    ZMin,
    /// The ceiling.
    ZMax,
}

impl Side {
    /// Its axis, and which end of that.
    pub fn axis(self) -> (usize, usize) {
        ((self as usize) / 2, (self as usize) % 2)
    }
}

/// A wall, or a part of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WallPart {
    /// Which wall.
    pub side: Side,
    /// Only what lies within a box, seen along the wall's axis: its least corner [m]. Whole cells count, by their middles.
    #[serde(default)]
    pub min: Option<Vec3>,
    /// Its greatest corner [m].
    #[serde(default)]
    pub max: Option<Vec3>,
}

impl WallPart {
    /// Least and greatest corner [m]: infinite where none is given.
    pub fn corners(&self) -> [Vec3; 2] {
        [self.min.unwrap_or([f64::NEG_INFINITY; 3]), self.max.unwrap_or([f64::INFINITY; 3])]
    }
}

/// More points than anyone reads.
const MOST_POINTS: u64 = 1 << 20;
/// Columns of a probe's single points.
const MOST_COLUMNS: usize = 256;

impl Scene {
    /// Simulated seconds from one value of a probe to the next.
    pub fn probe_interval(&self, probe: &Probe) -> f64 {
        probe.interval.unwrap_or(self.output.interval)
    }

    /// The sections of probes, in their order, each with the number of its probe.
    pub fn sections(&self) -> impl Iterator<Item = (usize, Section)> {
        self.probe.iter().enumerate().filter_map(|(i, probe)| probe.flux.map(|section| (i, section)))
    }

    /// The parts of walls of probes, in their order, each with the number of its probe.
    pub fn wall_parts(&self) -> impl Iterator<Item = (usize, WallPart)> {
        self.probe.iter().enumerate().filter_map(|(i, probe)| probe.wall.map(|part| (i, part)))
    }

    pub(super) fn check_probe(&self, path: &str, probe: &Probe) -> Result<()> {
        let Probe { flux, within, surface, wall, nearest, chamfer, .. } = probe;
        let kinds = [
            ("flux", flux.is_some()),
            ("within", within.is_some()),
            ("surface", surface.is_some()),
            ("wall", wall.is_some()),
            ("nearest", nearest.is_some()),
            ("chamfer", chamfer.is_some()),
        ];
        let given: Vec<&str> = kinds.iter().filter(|(_, given)| *given).map(|(kind, _)| *kind).collect();
        self.require(
            given.len() == 1,
            path,
            if given.is_empty() { "measures nothing".to_owned() } else { format!("has {}", given.join(" and ")) },
            "give one of flux, within, surface, wall, nearest and chamfer; another probe may measure the other",
        )?;
        self.require(
            !probe.name.contains(|c: char| c == ',' || c == '"' || c.is_control()),
            &format!("{path}.name"),
            "has a comma, a quote or a control character",
            "use letters, digits, blanks, - and _: columns begin with it",
        )?;
        if let Some(interval) = probe.interval {
            self.positive(&format!("{path}.interval"), interval)?;
        }
        self.check_filter(path, probe)?;
        match probe {
            Probe { flux: Some(section), .. } => self.check_section(&format!("{path}.flux"), section),
            Probe { within: Some(region), .. } => self.check_region(&format!("{path}.within"), region),
            Probe { surface: Some(surface), .. } => self.check_surface_probe(&format!("{path}.surface"), surface),
            Probe { wall: Some(part), .. } => self.check_wall_part(&format!("{path}.wall"), part),
            _ => Ok(()),
        }
    }

    fn check_filter(&self, path: &str, probe: &Probe) -> Result<()> {
        if let Some(material) = &probe.material {
            self.check_material_name(&format!("{path}.material"), material)?;
        }
        if let Some(body) = &probe.body {
            let known = || self.body.iter().map(|body| body.name.clone());
            if known().all(|name| name != *body) {
                return Err(Error::Unknown {
                    path: self.place(&format!("{path}.body")),
                    kind: "body of this scene",
                    name: body.clone(),
                    known: known().filter(|name| !name.is_empty()).collect(),
                });
            }
        }
        if let Some(level) = probe.level {
            self.require(
                level < self.levels.count,
                &format!("{path}.level"),
                format!("is {level}, and there are {} levels", self.levels.count),
                "count from 0, the finest",
            )?;
        }
        let filters = probe.material.is_some() || probe.body.is_some() || probe.level.is_some();
        self.require(
            !filters || (probe.surface.is_none() && probe.wall.is_none()),
            path,
            "leaves out particles, but surfaces and walls feel all",
            "leave out material, body and level",
        )
    }

    fn check_section(&self, path: &str, section: &Section) -> Result<()> {
        match *section {
            Section::Rectangle { min, max } => {
                let flat = (0..3).filter(|&d| min[d] == max[d]).count();
                let falls = (0..3).find(|&d| min[d] > max[d]);
                if let Some(d) = falls {
                    let what = format!("{} goes from {} to {}", AXES[d], min[d], max[d]);
                    return Err(self.fault(&format!("{path}.rectangle.max"), what, "max must be min or above"));
                }
                self.require(
                    flat == 1,
                    &format!("{path}.rectangle"),
                    format!("{flat} of its sides have no length"),
                    "let min and max be equal along one axis, the one that is crossed",
                )
            }
            Section::Disc { normal, radius, .. } => {
                self.positive(&format!("{path}.disc.radius"), radius)?;
                let points = normal.iter().any(|n| *n != 0.0);
                self.require(
                    points,
                    &format!("{path}.disc.normal"),
                    "is zero",
                    "give the direction that counts as forwards",
                )
            }
        }
    }

    fn check_region(&self, path: &str, region: &Region) -> Result<()> {
        match *region {
            Region::Box { min, max } => (0..3).try_for_each(|d| {
                let what = format!("{} goes from {} to {}", AXES[d], min[d], max[d]);
                self.require(min[d] < max[d], &format!("{path}.box.max"), what, "max must be above min")
            }),
            Region::Sphere { radius, .. } => self.positive(&format!("{path}.sphere.radius"), radius),
            Region::Cylinder { radius, half_height, .. } => {
                self.positive(&format!("{path}.cylinder.radius"), radius)?;
                self.positive(&format!("{path}.cylinder.half_height"), half_height)
            }
        }
    }

    fn check_surface_probe(&self, path: &str, surface: &SurfaceProbe) -> Result<()> {
        let (points, most) = match surface {
            SurfaceProbe::Points(points) => (points.len() as u64, MOST_COLUMNS as u64),
            SurfaceProbe::Line { points, .. } => (u64::from(*points), MOST_COLUMNS as u64),
            SurfaceProbe::Patch { min, max, points, .. } => {
                self.check_rectangle(&format!("{path}.patch"), *min, *max)?;
                (u64::from(points[0]) * u64::from(points[1]), MOST_POINTS)
            }
        };
        self.require((1..=most).contains(&points), path, format!("has {points} points"), format!("must be 1 to {most}"))
    }

    fn check_wall_part(&self, path: &str, part: &WallPart) -> Result<()> {
        let (axis, end) = part.side.axis();
        let wall = self.world.walls.pair(axis)[end];
        let stands = !matches!(wall, super::Wall::Open | super::Wall::Periodic);
        self.require(stands, &format!("{path}.side"), "there is no wall", "name a side that has one in world.walls")?;
        let [min, max] = part.corners();
        (0..3).try_for_each(|d| {
            let what = format!("{} goes from {} to {}", AXES[d], min[d], max[d]);
            self.require(min[d] <= max[d], &format!("{path}.max"), what, "max must be min or above")
        })
    }
}
