//! Which effects a scene calls for, and why.

use super::agents::Boxes;
use super::{Effect, Plan, PlannedCoupling, SCENE_COUPLINGS, TOOL_COUPLING};
use crate::ParticleState;
use crate::flow::SINK_STEPS;
use crate::levels::TILE;
use crate::scene::{Export, Leaving, Motion, PictureView, Probe, Tool, Wall, plain};

use barchan_abi as abi;

fn listed(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    match items.as_slice() {
        [first, second, third, .., _] => format!("{first}, {second}, {third}, … ({} in all)", items.len()),
        _ => items.join(", "),
    }
}

/// An entry of a list by its name, or by its number if it has none.
fn called(list: &str, i: usize, name: &str) -> String {
    if name.is_empty() { format!("{list}[{i}]") } else { format!("{list} '{name}'") }
}

fn wall_text(wall: Wall) -> String {
    match wall {
        Wall::Separate { friction } => format!("{{ separate = {{ friction = {friction} }} }}"),
        other => format!("\"{}\"", format!("{other:?}").to_lowercase()),
    }
}

impl Export {
    /// The usual ending of such files' names.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Npz => "npz",
            Self::Vtk => "vtu",
        }
    }
}

impl Plan {
    pub(super) fn list_effects(&self, particles: &ParticleState, live: usize) -> Vec<Effect> {
        let scene = &self.scene;
        let mut effects = Vec::new();
        let mut add = |name: String, because: String, adds: String| {
            effects.push(Effect { name: plain(&name), because: plain(&because), adds: plain(&adds) });
        };
        let ground = self.particle_count > 0 || !scene.inflow.is_empty();
        if ground {
            add(
                format!("soft ground, {}", self.precision),
                listed(
                    scene
                        .body
                        .iter()
                        .enumerate()
                        .map(|(i, body)| called("body", i, &body.name))
                        .chain(scene.inflow.iter().enumerate().map(|(i, source)| called("source", i, &source.name))),
                ),
                "sort, P2G, grid update, G2P".to_owned(),
            );
        }
        if ground && self.slow > 0.0 {
            let because = match scene.sleep.on {
                Some(_) => "sleep.on = true",
                None if scene.sleep.speed.is_some() => "sleep.speed",
                None => {
                    "gravity, and no law that flows with time: sleep.on = false keeps all awake (so does wgpu, unless asked)"
                }
            };
            let rest = format!("blocks that stay below {:.1e} m/s are left out of every pass", self.slow);
            add("ground at rest sleeps".to_owned(), because.to_owned(), rest);
        }
        if ground && self.cell_widths.len() > 1 {
            let boxes = self.list_boxes(particles);
            let mut counts = vec![0; self.cell_widths.len()];
            particles.lists.iter().for_each(|list| counts[list.level as usize] += list.len());
            let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
            add(
                format!("{} levels", self.cell_widths.len()),
                format!(
                    "levels.count = {} around {}",
                    scene.levels.count,
                    listed(boxes.iter().map(|one| one.name.clone()))
                ),
                format!(
                    "adapt, restrict, prolong; {} particles, finest first; boxes of {}³ cells or more",
                    counts.join(" + "),
                    2 * self.agents.iter().map(|agent| agent.half).min().unwrap_or(scene.levels.half)
                ),
            );
            for Boxes { name, because, sizes } in boxes {
                add(format!("boxes around {name}"), because, sizes);
            }
        }
        if self.terrain.is_some() {
            let tile = f64::from(TILE) * self.cell_widths[self.cell_widths.len() - 1];
            let tiles: i64 = self.regions.tiles_of_world().iter().map(|[a, b]| i64::from(b - a + 1)).product();
            add(
                "unbounded ground".to_owned(),
                format!("levels.reach = {}", scene.levels.reach),
                format!(
                    "archive; {live} of {tiles} tiles of {tile} m live, the others are what the bodies' shapes say or what agents have left"
                ),
            );
        }
        if self.substeps > 1 {
            add(
                "subcycling".to_owned(),
                "levels.subcycle = true".to_owned(),
                format!("{} steps of the finest level in one of the coarsest", self.substeps),
            );
        }
        for planned in &self.materials {
            let users = scene.body.iter().enumerate().flat_map(|(i, body)| {
                let own = (body.material == planned.name).then(|| format!("body[{i}]"));
                let zones = body.zone.iter().enumerate().filter(|(_, zone)| zone.material == planned.name);
                own.into_iter().chain(zones.map(move |(j, _)| format!("body[{i}].zone[{j}]")))
            });
            let sources = scene.inflow.iter().enumerate().filter(|(_, source)| source.material == planned.name);
            let users = users.chain(sources.map(|(i, _)| format!("source[{i}]")));
            let law = &planned.material;
            let planes = |n: usize, what: &str| format!("{n} {what} plane{}", if n == 1 { "" } else { "s" });
            add(
                format!("material {}", planned.name),
                listed(users.map(|user| format!("{user}.material = \"{}\"", planned.name))),
                format!(
                    "law {} ({}): update_{}, {}, {}{}",
                    law.name,
                    law.origin,
                    self.precision,
                    planes(law.strain_planes(), "strain"),
                    planes(law.states.len(), "state"),
                    if law.has(abi::BARCHAN_CAP_HARDENS) { ", moduli at every step" } else { "" },
                ),
            );
            if planned.damping.is_some()
                && let Some(spec) = scene.material.iter().find(|spec| spec.name == planned.name)
            {
                add(
                    format!("damping of material {}", planned.name),
                    format!("damping = {} s", spec.damping),
                    "a stress that follows the elastic rate of strain, and what it dissipates".to_owned(),
                );
            }
        }
        if ground && scene.gravity != [0.0; 3] {
            add("gravity".to_owned(), format!("gravity = {:?}", scene.gravity), "one addition a node".to_owned());
        }
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            for (side, wall) in ["min", "max"].into_iter().zip(scene.world.walls.pair(axis)) {
                let key = format!("world.walls.{name}_{side}");
                match wall {
                    Wall::Open => {}
                    Wall::Periodic if side == "max" => {}
                    Wall::Periodic => add(
                        format!("periodic {name}"),
                        format!("{key} = \"periodic\""),
                        "blocks wrap around".to_owned(),
                    ),
                    wall => add(
                        format!("wall {name}_{side}"),
                        format!("{key} = {}", wall_text(wall)),
                        "ghost nodes folded back in blocks at the wall".to_owned(),
                    ),
                }
            }
        }
        for tool in &scene.tool {
            let (motion, adds) = match &tool.motion {
                Motion::Fixed => ("fixed", "contact on nodes near it"),
                Motion::Keyframes { .. } => ("keyframes", "contact on nodes near it; path at every step"),
                Motion::Velocity { .. } => ("velocity", "contact on nodes near it; moved at every step"),
                Motion::Free { .. } => ("free", "contact on nodes near it; rigid-body step"),
                Motion::Servo(_) => ("servo", "contact on nodes near it; moved along its axis"),
            };
            let times = match (tool.from, tool.until) {
                (0.0, None) => String::new(),
                (from, None) => format!(", from {from} s on"),
                (from, Some(until)) => format!(", from {from} s until {until} s"),
            };
            add(format!("contact with tool {}", tool.name), format!("its motion is {motion}{times}"), adds.to_owned());
        }
        if self.two_way() {
            let moves = |tool: &Tool| match tool.motion {
                Motion::Servo(_) => format!("tool '{}' is pushed by a force", tool.name),
                _ => format!("tool '{}' moves freely", tool.name),
            };
            add(
                "two-way coupling".to_owned(),
                listed(scene.tool.iter().filter(|tool| tool.answers()).map(moves)),
                "impulses of nodes summed on bodies".to_owned(),
            );
        }
        for robot in &scene.robot {
            let from = robot.model.as_ref().map(|model| format!("model = \"{model}\""));
            let from = from.or_else(|| Some(format!("urdf = \"{}\"", robot.urdf.as_ref()?.display())));
            add(
                format!("robot {}", robot.name),
                format!("robot.{}", from.unwrap_or_default()),
                "contact on nodes near its links; its joints solved in every step".to_owned(),
            );
        }
        for PlannedCoupling { kind, name } in
            self.couplings.iter().filter(|one| !SCENE_COUPLINGS.contains(&one.kind.as_str()))
        {
            add(
                format!("coupling {name}"),
                format!("coupling.kind = \"{kind}\""),
                "contact on nodes near it".to_owned(),
            );
        }
        if let Some(task) = &scene.task {
            add(
                format!("task {}", task.name),
                format!("task.name = \"{}\"", task.name),
                "nothing to a step: an agent plays it".to_owned(),
            );
        }
        for (i, source) in scene.inflow.iter().enumerate() {
            let Some((count, period, rate)) = self.flows.as_ref().map(|flows| flows.rate_of(i)) else { continue };
            add(
                called("source", i, &source.name),
                format!("source[{i}] of {}", source.material),
                format!(
                    "{rate:.4} kg/s: up to {count} particles every {:.3} ms, with a sort of all particles",
                    1e3 * period
                ),
            );
        }
        for (i, sink) in scene.outflow.iter().enumerate() {
            add(
                called("sink", i, &sink.name),
                format!("sink[{i}]"),
                format!("a look at the particles near it every {SINK_STEPS} steps, and a sort of all if any is in it"),
            );
        }
        match scene.world.leaving {
            Leaving::Error => {}
            Leaving::Clamp => {
                add("clamping".to_owned(), "world.leaving = \"clamp\"".to_owned(), "impulse booked".to_owned())
            }
            Leaving::Delete => {
                add("deletion".to_owned(), "world.leaving = \"delete\"".to_owned(), "mass booked".to_owned())
            }
        }
        let output = &scene.output;
        let every = format!("output.interval = {}", output.interval);
        if output.picture.on {
            let cut = format!("{:?}", output.picture.cut).to_lowercase();
            let view = match scene.picture_view() {
                PictureView::Top => "a top view",
                PictureView::Perspective => "a view in perspective",
            };
            add(format!("{cut} pictures"), every.clone(), format!("{view} and a vertical cut, outside the step"));
        }
        if let Some(format) = output.export {
            let holds = match &output.export_fields {
                Some(fields) => format!("a particle file with {}", listed(fields.iter().cloned())),
                None => "a particle file with all fields".to_owned(),
            };
            add(format!("{} export", format.extension()), every, format!("{holds}, outside the step"));
        }
        if let Some(surface) = &output.surface {
            add(
                "surface mesh".to_owned(),
                format!("output.surface.interval = {}", surface.interval),
                format!("a mesh on cells of {} m, outside the step", surface.spacing.unwrap_or(scene.world.cell)),
            );
        }
        if let Some(map) = &output.height_map {
            add(
                "height map".to_owned(),
                format!("output.height_map.interval = {}", map.interval),
                format!("columns of {} m, outside the step", map.spacing.unwrap_or(scene.world.cell)),
            );
        }
        if let Some(interval) = output.trace.interval {
            add(
                "trace".to_owned(),
                format!("output.trace.interval = {interval}"),
                "a row, with sums over all particles, outside the step".to_owned(),
            );
        }
        if let Some(interval) = output.snapshot_interval {
            add(
                "snapshots".to_owned(),
                format!("output.snapshot_interval = {interval}"),
                "a copy of all particles, outside the step".to_owned(),
            );
        }
        for (i, probe) in scene.probe.iter().enumerate() {
            let (kind, adds) = match probe {
                Probe { flux: Some(_), .. } => ("flux", "particles near its section are looked at in every step"),
                Probe { within: Some(_), .. } => ("within", "a sum over particles"),
                Probe { surface: Some(_), .. } => ("surface", "a look at the particles under its points"),
                Probe { wall: Some(_), .. } => ("wall", "impulses of a wall, summed in every step"),
                Probe { nearest: Some(_), .. } => ("nearest", "a look at the particles near its point"),
                _ => ("chamfer", "a look at all particles"),
            };
            let because = format!("probe[{i}].{kind}, every {} s", scene.probe_interval(probe));
            add(format!("probe {}", probe.name), because, adds.to_owned());
        }
        for material in scene.material.iter().filter(|m| self.materials.iter().all(|p| p.name != m.name)) {
            add(
                format!("declared but unused: material {}", material.name),
                "no body and no source names it".to_owned(),
                "costs nothing".to_owned(),
            );
        }
        if scene.tools_apart().next().is_none() && scene.coupling.iter().any(|c| c.kind == TOOL_COUPLING) {
            add(
                format!("declared but unused: coupling {TOOL_COUPLING}"),
                if scene.tool.is_empty() {
                    "the scene has no tool"
                } else {
                    "its tools are solved with robots or one another"
                }
                .to_owned(),
                "costs nothing".to_owned(),
            );
        }
        effects
    }
}
