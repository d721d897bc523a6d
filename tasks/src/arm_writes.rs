//! ArmWrites: an arm of seven joints writes into sand with a rod.
//!
//! # Source
//! UBSoft (CoRL 2024), real-world experiment: an arm writes "CoRL" into sand. There it is no task: the loss is ours. It
//! does not ask for a surface, since the groove that a rod leaves depends on how sand falls back into it: it asks that
//! there is one along all lines, and none elsewhere.

use crate::arm::{Arm, INTERVAL, Track};
use crate::base::{Base, Size};
use crate::reward::Scale;
use crate::surface::from_line;
use crate::tooling::points;
use crate::view::View;
use barchan_core::registry::TaskSetup;
use barchan_core::task::{Episode, Limits, Outcome, Part, Seen, Watch};
use barchan_core::{Registry, Result, Scene, Simulation, Task};
use std::sync::Arc;

const DOC: &str = "An arm of seven joints is to write 'CoRL' into sand with a rod. Success: more than half of the lines are grooves, the rest of the sand is about as it \
                   was, and the rod is out of it.";
const FILE: &str = include_str!("../scenes/arm-writes.toml");
/// Positions of the joints while the scene's own path is followed.
const TRACK: &str = include_str!("../scenes/tasks/arm-writes.csv");
const ARM: Arm = Arm { robot: "arm", link: "arm/rod", joints: 7, most: 0.03 };

/// The whole word is worth a thousand, as the whole heap is in SmoothSurface.
const SCALE: Scale = Scale { alpha: 1000.0, beta: 0.0 };
/// Distance between the points of a line that are looked at [m].
const APART: f64 = 0.01;
/// A groove counts in full from this depth on [m]: a third of how deep the rod goes along the scene's own path, since
/// sand falls back.
const DEPTH: f64 = 0.005;
/// Points that are further from all lines than this are to stay as they are [m]: the rod's radius, and the ridges beside
/// its groove.
const BESIDE: f64 = 0.04;
/// Heights that are looked at all over the bed, along x and y.
const MAP: [usize; 2] = [28, 16];
/// Success: so much of the lines, and off lines so much of the groove's depth on average.
/// Not all lines can be: where they are near one another, sand from the later one fills the earlier one.
const DRAWN: f64 = 0.5;
const STRAY: f64 = 0.2;
/// Control steps: the scene's own path.
const HORIZON: u64 = 1500;

/// What is changed in the scene's file for a small size: one level of cells of 12.5 mm, sand half as deep and softer. The
/// arm stands 7 mm higher, as contact begins so much further off the rod in larger cells.
const LITE: [&str; 7] = [
    "world.cell=0.0125",
    "world.min=[0.2, -0.1625, 0.05]",
    "world.max=[0.75, 0.1625, 0.3625]",
    "levels.count=1",
    "robot.arm.position=[0.0, 0.0, 0.107]",
    "material.sand.parameters.young_modulus=1e5",
    "body.bed.shape.box={ min = [0.2, -0.1625, 0.05], max = [0.75, 0.1625, 0.1] }",
];

/// Registers the task.
///
/// # Errors
/// If its names are taken.
pub(crate) fn register(registry: &mut Registry) -> Result<()> {
    crate::base::register(registry, "ArmWrites", DOC, vec![View::parameter("heights")], ArmWrites::new)
}

struct ArmWrites {
    base: Base,
    view: View,
    /// The lines that are to be written, seen from above [m].
    lines: Arc<Vec<Vec<[f64; 2]>>>,
}

impl ArmWrites {
    fn new(setup: &TaskSetup<'_>, size: Size) -> Result<Self> {
        let range = |name: &str, low: f64, high: f64| Limits { name: name.to_owned(), low, high };
        let ranges = vec![
            range("friction angle of the sand [deg]", 35.0, 45.0),
            range("density of the sand [kg/m³]", 900.0, 1100.0),
        ];
        let base = Base::new(setup, FILE, size.of(&[][..], &LITE[..]), ranges)?;
        let robot = base.scene.robot.iter().find(|robot| robot.name == ARM.robot);
        let path = robot.and_then(|robot| robot.motion.as_ref()?.path.as_ref()).ok_or_else(|| {
            let what = format!("the task has a robot '{}' write along its path, and the scene has none", ARM.robot);
            setup.unfit(what, "add motion.path to it, as the built-in scene 'arm-writes' has it".to_owned())
        })?;
        // Where it writes, the rod is at its lowest.
        let tip = path.frames.iter().map(|frame| frame.position[2]).fold(f64::INFINITY, f64::min);
        let writes = |z: f64| z < tip + 1e-3;
        let lines = path.frames.chunk_by(|a, b| writes(a.position[2]) == writes(b.position[2]));
        let lines = lines.filter(|frames| writes(frames[0].position[2]));
        let lines = lines.map(|frames| frames.iter().map(|frame| [frame.position[0], frame.position[1]]).collect());
        Ok(Self { view: View::new(&base.scene, setup.parameters, 0.08), lines: Arc::new(lines.collect()), base })
    }
}

impl Task for ArmWrites {
    fn name(&self) -> &str {
        &self.base.name
    }
    fn doc(&self) -> &str {
        DOC
    }
    fn scene(&self, seed: u64) -> Result<Scene> {
        let mut scene = self.base.scene(seed);
        if let [angle, density] = self.base.drawn(seed)[..] {
            scene.material[0].parameters.insert("friction_angle_deg".to_owned(), angle);
            scene.material[0].density = density;
        }
        Ok(scene)
    }
    fn actions(&self) -> Vec<Limits> {
        ARM.actions()
    }
    fn observations(&self) -> Vec<Part> {
        self.view.parts().into_iter().chain([ARM.part()]).collect()
    }
    fn interval(&self) -> f64 {
        INTERVAL
    }
    fn horizon(&self) -> u64 {
        HORIZON
    }
    fn ranges(&self) -> Vec<Limits> {
        self.base.ranges()
    }
    fn reset(&self, world: &Simulation, _seed: u64) -> Result<Box<dyn Episode>> {
        let bounds = world.plan().scene.world_box();
        let on_lines: Vec<[f64; 2]> = self.lines.iter().flat_map(|line| along(line)).collect();
        let [low, high] = [bounds.min, bounds.max].map(|[x, y, _]| [x, y]);
        let mut looked_at = points(low, high, MAP);
        looked_at.retain(|point| self.lines.iter().all(|line| from_line(line, *point) > BESIDE));
        let off_lines = looked_at.len();
        looked_at.extend(on_lines);
        let bed = world.heights(&looked_at)?;
        let level = bed.iter().flatten().sum::<f64>() / bed.iter().flatten().count().max(1) as f64;
        let [targets, _] = ARM.state(world)?;
        Ok(Box::new(Writing {
            view: self.view.clone(),
            targets,
            track: Track::new(TRACK),
            points: looked_at,
            off_lines,
            bed: bed.into_iter().map(|height| height.unwrap_or(level)).collect(),
            left: 1.0,
        }))
    }
}

/// Points of a line, evenly apart along each of its parts.
fn along(line: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let of_part = |part: &[[f64; 2]]| {
        let (a, b) = (part[0], part[1]);
        let count = ((b[0] - a[0]).hypot(b[1] - a[1]) / APART).round().max(1.0);
        (0..count as usize)
            .map(move |k| [0, 1].map(|d| a[d] + (b[d] - a[d]) * (k as f64 + 0.5) / count))
            .collect::<Vec<_>>()
    };
    line.windows(2).flat_map(of_part).collect()
}

struct Writing {
    view: View,
    /// Joints' targets [rad].
    targets: Vec<f64>,
    track: Track,
    /// Where heights are looked at [m]: so many off the lines, then those on them.
    points: Vec<[f64; 2]>,
    off_lines: usize,
    /// Heights there at the start [m].
    bed: Vec<f64>,
    /// What is left to be done after the last control step: all of it is 1.
    left: f64,
}

impl Writing {
    /// The share of the lines that is drawn, and how far the ground off them is from where it was, by a groove's depth.
    fn drawn(&self, heights: &[Option<f64>]) -> [f64; 2] {
        let sunk = heights.iter().zip(&self.bed).map(|(height, bed)| (bed - height.unwrap_or(*bed)) / DEPTH);
        let sunk: Vec<f64> = sunk.collect();
        let (off, on) = sunk.split_at(self.off_lines);
        let mean = |all: &[f64], of_one: fn(f64) -> f64| {
            all.iter().map(|sunk| of_one(*sunk)).sum::<f64>() / all.len().max(1) as f64
        };
        [mean(on, |sunk| sunk.clamp(0.0, 1.0)), mean(off, f64::abs)]
    }
}

impl Episode for Writing {
    fn act(&mut self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        ARM.act(world, &mut self.targets, action)
    }
    fn watch(&self, world: &Simulation) -> Watch {
        let mut watch = self.view.watch(ARM.position(world));
        watch.heights.extend(&self.points);
        watch
    }
    fn observe(&mut self, world: &Simulation, seen: &Seen) -> Result<Outcome> {
        let heights = &seen.heights[self.view.heights()..];
        let [drawn, stray] = self.drawn(heights);
        let left = 1.0 - drawn + stray;
        let reward = SCALE.reward(left - self.left, HORIZON);
        self.left = left;
        let out = ARM.tool(world)?.position[2] - self.bed.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut observation = self.view.numbers(world, seen);
        observation.extend(ARM.state(world)?.into_iter().flatten());
        observation.extend(&self.targets);
        Ok(Outcome {
            observation,
            reward,
            success: drawn > DRAWN && stray < STRAY && out > ROD,
            terminated: false,
            info: vec![
                ("share of the lines that is drawn", drawn),
                ("what the rest has moved, by the groove's depth", stray),
            ],
        })
    }
    fn heuristic(&mut self, world: &Simulation) -> Option<Vec<f64>> {
        Some(ARM.follow(&self.track, world.time(), &self.targets))
    }
}

/// Height of the middle of the link with the rod above the rod's tip [m].
const ROD: f64 = 0.075;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_a_line_are_evenly_apart() {
        let near = along(&[[0.0, 0.0], [0.03, 0.0], [0.03, 0.011]]);
        let wanted = [[0.005, 0.0], [0.015, 0.0], [0.025, 0.0], [0.03, 0.0055]];
        assert_eq!(near.len(), wanted.len());
        for (point, wanted) in near.iter().zip(wanted) {
            assert!((point[0] - wanted[0]).hypot(point[1] - wanted[1]) < 1e-12, "{point:?}");
        }
    }
}
