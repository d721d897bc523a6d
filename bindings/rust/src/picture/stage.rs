//! From where a scene is seen in perspective, and what of it.

use super::camera::Camera;
use super::places;
use barchan_core::coupling::Aabb;
use barchan_core::plan::{ROBOT_COUPLING, TOOL_COUPLING};
use barchan_core::scene::{Motion, PictureView, Scene, Wall};
use barchan_core::{Coupling, Error, Result, Simulation, Spot, Vec3};
use serde::{Deserialize, Serialize};

/// The width of a picture in perspective over its height.
const ASPECT: f64 = 5.0 / 3.0;
/// From what is seen towards the camera: 28° high where there are robots, else 35°, to look into hollows.
const BESIDE: Vec3 = [0.57, -0.82, 0.53];
const ABOVE: Vec3 = [0.57, -0.82, 0.70];
/// What is seen around bodies, as a share of their width; ground that is wider than so many times that, or that comes and goes
/// with its agents, is left to go on beyond the picture, and its camera follows the first robot.
const AROUND: f64 = 0.3;
const FAR_WIDER: f64 = 2.0;

/// A view in perspective of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Stage {
    /// Columns and rows.
    pub size: [usize; 2],
    camera: Camera,
    /// A body, and where it was when the camera was set up [m].
    follow: Option<(String, Vec3)>,
    /// Does height colour the ground?
    pub by_height: bool,
    /// The world's box [m], and which of its sides hold ground: x_min, x_max, y_min, y_max, z_min.
    pub min: Vec3,
    pub max: Vec3,
    pub walls: [bool; 5],
}

impl Stage {
    /// The stage of a scene with particles as they are now, so many columns wide; none if it is seen from the top.
    pub(super) fn new(simulation: &Simulation, spots: &[Spot], width: usize) -> Option<Self> {
        let scene = &simulation.plan().scene;
        if scene.picture_view() != PictureView::Perspective {
            return None;
        }
        let size = [width, (width as f64 / ASPECT).round() as usize];
        let given = scene.output.picture.camera.clone().unwrap_or_default();
        let fov = given.fov_deg.to_radians();
        let ground = spots.iter().map(|spot| Aabb { min: spot.position, max: spot.position });
        let ground = ground.reduce(|a, b| a.union(&b));
        let followed = given.follow.clone().or_else(|| {
            let robot = scene.robot.iter().find(|robot| !robot.fixed)?;
            let (near, ground) = (around(simulation, &robot.name)?, ground?);
            let wide = |b: &Aabb| (b.max[0] - b.min[0]).max(b.max[1] - b.min[1]);
            let goes_on = scene.levels.reach > 0 || wide(&ground) > FAR_WIDER * wide(&near);
            goes_on.then(|| robot.name.clone())
        });
        let subject = match &followed {
            Some(name) => around(simulation, name),
            None if !scene.robot.is_empty() => {
                let all = scene.robot.iter().filter_map(|robot| around(simulation, &robot.name));
                all.reduce(|a, b| a.union(&b))
            }
            None => None,
        };
        let subject = match (subject, ground) {
            // No more air is shown beside ground than there must be.
            (Some(near), Some(ground)) => shared(near, ground),
            (Some(near), None) => near,
            (None, _) => everything(scene, simulation, ground),
        };
        let from = if scene.robot.is_empty() && given.follow.is_none() { ABOVE } else { BESIDE };
        let own = Camera::around(subject.min, subject.max, from, fov, size[0] as f64 / size[1] as f64);
        let camera = match (given.position, given.target) {
            (Some(position), target) => Camera { position, target: target.unwrap_or(own.target), fov },
            (None, Some(target)) => own.moved(std::array::from_fn(|d| target[d] - own.target[d])),
            (None, None) => own,
        };
        let walls = &scene.world.walls;
        let holds = |wall: Wall| wall != Wall::Open;
        Some(Self {
            size,
            camera,
            follow: followed.and_then(|name| Some((name.clone(), place_of(simulation, &name)?))),
            by_height: scene.body.iter().any(|body| scene.is_bed(body)),
            min: scene.world.min,
            max: scene.world.max,
            walls: [walls.x_min, walls.x_max, walls.y_min, walls.y_max, walls.z_min].map(holds),
        })
    }

    /// Where the body is that the camera follows, if there is one.
    pub(super) fn followed(&self, simulation: &Simulation) -> Option<Vec3> {
        self.follow.as_ref().and_then(|(name, _)| place_of(simulation, name))
    }

    /// The camera as it is now.
    pub(super) fn camera(&self, simulation: &Simulation) -> Camera {
        let moved = self.follow.as_ref().zip(self.followed(simulation));
        let moved = moved.map(|((_, start), now)| [now[0] - start[0], now[1] - start[1], 0.0]);
        self.camera.moved(moved.unwrap_or_default())
    }

    /// The world's box, in a periodic one about the body that the camera follows.
    pub(super) fn bed(&self, simulation: &Simulation) -> [Vec3; 2] {
        let (mut bed, world) = ([self.min, self.max], &simulation.plan().scene.world);
        if let Some(now) = self.followed(simulation) {
            for d in (0..3).filter(|d| world.is_periodic(*d)) {
                let half = 0.5 * (self.max[d] - self.min[d]);
                (bed[0][d], bed[1][d]) = (now[d] - half, now[d] + half);
            }
        }
        bed
    }
}

/// Is there the body that the camera is to follow?
///
/// # Errors
/// [`Error::Unknown`] with those that there are.
pub(super) fn check(simulation: &Simulation) -> Result<()> {
    let camera = simulation.plan().scene.output.picture.camera.as_ref();
    let Some(name) = camera.and_then(|camera| camera.follow.as_ref()) else { return Ok(()) };
    if simulation.couplings().iter().any(|coupling| coupling.has_body(name)) {
        return Ok(());
    }
    Err(Error::Unknown {
        path: "output.picture.camera.follow".to_owned(),
        kind: "body",
        name: name.clone(),
        known: simulation.couplings().iter().flat_map(|coupling| coupling.bodies()).map(|body| body.name).collect(),
    })
}

fn place_of(simulation: &Simulation, name: &str) -> Option<Vec3> {
    let all = simulation.couplings().iter().filter(|coupling| coupling.has_body(name));
    all.flat_map(|coupling| coupling.bodies()).find(|body| body.name == name).map(|body| body.position)
}

/// A body, or a robot with all of its links, and some of what is around it.
fn around(simulation: &Simulation, name: &str) -> Option<Aabb> {
    let is_part = |other: &str| other.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'));
    let of = |coupling: &dyn Coupling| -> Vec<Aabb> {
        let bounds = coupling.extents();
        coupling.bodies().iter().zip(bounds).filter(|(body, _)| is_part(&body.name)).map(|(_, one)| one).collect()
    };
    let all = simulation.couplings().iter().flat_map(|coupling| of(coupling.as_ref()));
    let Aabb { min, max } = all.reduce(|a, b| a.union(&b))?;
    let more = AROUND * (max[0] - min[0]).max(max[1] - min[1]).max(max[2] - min[2]);
    Some(Aabb {
        min: [min[0] - more, min[1] - more, min[2] - 0.2 * more],
        max: [max[0] + more, max[1] + more, max[2] + 0.1 * more],
    })
}

/// As much of `near` as lies above or in the ground, seen from above; all of it if nothing does.
fn shared(near: Aabb, ground: Aabb) -> Aabb {
    let mut both = near;
    for d in 0..2 {
        let (low, high) = (near.min[d].max(ground.min[d]), near.max[d].min(ground.max[d]));
        if low < high {
            (both.min[d], both.max[d]) = (low, high);
        }
    }
    both
}

/// The ground with what stands on it, and the way that tools go, within reason.
fn everything(scene: &Scene, simulation: &Simulation, ground: Option<Aabb>) -> Aabb {
    let world = Aabb { min: scene.world.min, max: scene.world.max };
    let mut all = ground.unwrap_or(world);
    if scene.world.walls.z_min != Wall::Open {
        all.min[2] = world.min[2];
    }
    let size: [f64; 2] = std::array::from_fn(|d| all.max[d] - all.min[d]);
    let most = all.max[2] + 0.5 * size[0].max(size[1]);
    if !scene.body.iter().any(|body| scene.is_bed(body)) {
        // A body on its own spreads when it lands.
        for d in 0..2 {
            let more = 0.2 * size[d];
            (all.min[d], all.max[d]) = ((all.min[d] - more).max(world.min[d]), (all.max[d] + more).min(world.max[d]));
        }
    }
    all = simulation.plan().reaches.iter().fold(all, |all, reach| all.union(reach));
    let named = |coupling: &dyn Coupling| {
        let names = coupling.bodies().into_iter().map(|body| body.name);
        names.zip(coupling.extents()).collect::<Vec<_>>()
    };
    let own = simulation.couplings().iter().filter(|one| [TOOL_COUPLING, ROBOT_COUPLING].contains(&one.name()));
    let extents: Vec<(String, Aabb)> = own.flat_map(|one| named(one.as_ref())).collect();
    for tool in &scene.tool {
        let Some((_, bounds)) = extents.iter().find(|(name, _)| *name == tool.name) else { continue };
        let start = match &tool.motion {
            Motion::Keyframes { frames, .. } => frames.first().map_or(tool.position, |frame| frame.position),
            _ => tool.position,
        };
        for place in std::iter::once(start).chain(places(tool, scene.time.end)) {
            let there = Aabb {
                min: std::array::from_fn(|d| bounds.min[d] + place[d] - start[d]),
                max: std::array::from_fn(|d| bounds.max[d] + place[d] - start[d]),
            };
            let seen = there.intersection(&world);
            if (0..3).all(|d| seen.min[d] <= seen.max[d]) {
                all = all.union(&seen);
            }
        }
    }
    let others = simulation.couplings().iter().filter(|one| ![TOOL_COUPLING, ROBOT_COUPLING].contains(&one.name()));
    for bounds in others.filter(|one| !one.is_field()).flat_map(|one| one.bounds()) {
        let seen = bounds.intersection(&world);
        if (0..3).all(|d| seen.min[d] <= seen.max[d]) {
            all = all.union(&seen);
        }
    }
    all.max[2] = all.max[2].min(most);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_core::Options;

    /// Symptom: a dog walked out of the pictures of `quadruped-dunes`, since its live ground was little wider than itself.
    #[test]
    fn a_robot_on_ground_without_bounds_is_followed() {
        let scene = crate::tasks::scene("quadruped-dunes", &["robot[0].velocity=[2.0, 0.0, 0.0]"]).unwrap();
        let mut simulation = Simulation::new(&crate::registry(), &scene, &Options::default()).unwrap();
        let stage = Stage::new(&simulation, &simulation.spots(), 400).unwrap();
        let (before, start) = (stage.camera(&simulation), place_of(&simulation, "dog").unwrap());
        for _ in 0..20 {
            simulation.step().unwrap();
        }
        let (after, now) = (stage.camera(&simulation), place_of(&simulation, "dog").unwrap());
        assert!(now[0] - start[0] > 0.005, "{start:?} {now:?}");
        let moved = after.target[0] - before.target[0];
        assert!((moved - (now[0] - start[0])).abs() < 1e-12, "{moved}");
    }
}
