//! The scenes that come with Barchan, and benchmark tasks.
//!
//! This crate knows the core only: scenes name their materials, couplings and backends, and the registry finds them. A task has a file of its own.

mod arm;
mod arm_scoops;
mod arm_writes;
mod base;
mod dig_a_hole;
mod dune_walk;
mod effector;
mod ground;
mod humanoid;
mod humanoid_stand;
mod humanoid_walk;
mod legged;
mod press_mould;
mod quadruped_walk;
mod reward;
mod sand_painting;
mod scoop_out;
mod smooth_surface;
mod stepping;
mod surface;
mod tooling;
mod trot;
mod view;
mod walk;

use barchan_core::{Error, Registry, Result, Scene};

/// Registers all tasks, each in two sizes.
///
/// # Errors
/// If one of their names is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    sand_painting::register(registry)?;
    scoop_out::register(registry)?;
    dig_a_hole::register(registry)?;
    smooth_surface::register(registry)?;
    press_mould::register(registry)?;
    arm_scoops::register(registry)?;
    arm_writes::register(registry)?;
    quadruped_walk::register(registry)?;
    dune_walk::register(registry)?;
    humanoid_stand::register(registry)?;
    humanoid_walk::register(registry)
}

/// The scenes that are files, by name.
const FILES: [(&str, &str); 29] = [
    ("letters", include_str!("../scenes/letters.toml")),
    ("cube-drop", include_str!("../scenes/cube-drop.toml")),
    ("scoop", include_str!("../scenes/scoop.toml")),
    ("dig", include_str!("../scenes/dig.toml")),
    ("pile-smooth", include_str!("../scenes/pile-smooth.toml")),
    ("snow-press", include_str!("../scenes/snow-press.toml")),
    ("jelly-drop", include_str!("../scenes/jelly-drop.toml")),
    ("pour", include_str!("../scenes/pour.toml")),
    ("hopper", include_str!("../scenes/hopper.toml")),
    ("footing", include_str!("../scenes/footing.toml")),
    ("retaining-wall", include_str!("../scenes/retaining-wall.toml")),
    ("ball-in-pit", include_str!("../scenes/ball-in-pit.toml")),
    ("quadruped-stand", include_str!("../scenes/quadruped-stand.toml")),
    ("quadruped-trot", include_str!("../scenes/quadruped-trot.toml")),
    ("quadruped-dunes", include_str!("../scenes/quadruped-dunes.toml")),
    ("quadruped-eight-levels", include_str!("../scenes/quadruped-eight-levels.toml")),
    ("arm-writes", include_str!("../scenes/arm-writes.toml")),
    ("arm-scoops", include_str!("../scenes/arm-scoops.toml")),
    ("humanoid-stand", include_str!("../scenes/humanoid-stand.toml")),
    ("humanoid-step", include_str!("../scenes/humanoid-step.toml")),
    ("column-collapse", include_str!("../scenes/gallery/column-collapse.toml")),
    ("poured-heap", include_str!("../scenes/gallery/poured-heap.toml")),
    ("hopper-discharge", include_str!("../scenes/gallery/hopper-discharge.toml")),
    ("sphere-impact", include_str!("../scenes/gallery/sphere-impact.toml")),
    ("plate-in-sand", include_str!("../scenes/gallery/plate-in-sand.toml")),
    ("block-on-incline", include_str!("../scenes/gallery/block-on-incline.toml")),
    ("oedometer", include_str!("../scenes/gallery/oedometer.toml")),
    ("shear-box", include_str!("../scenes/gallery/shear-box.toml")),
    ("standing-wave", include_str!("../scenes/gallery/standing-wave.toml")),
];

/// Grids that the cube drop comes on: cells along 1.28 m, and particles along the bed in x and y.
///
/// # Source
/// 32, 128 and 256: the counts of UBSoft (CoRL 2024), Table 1, are lattices half a cell apart, 0.2 m deep: 41²·10, 190²·40
/// and 381²·80. Its count for 64 is no lattice; 88·89·20 = 156,640 is the nearest (156,620 in the paper).
const CUBE_DROPS: [(&str, usize, [usize; 2]); 3] =
    [("cube-drop-32", 32, [41, 41]), ("cube-drop-128", 128, [190, 190]), ("cube-drop-256", 256, [381, 381])];

/// Names of all built-in scenes.
pub fn names() -> impl Iterator<Item = &'static str> {
    FILES.iter().map(|(name, _)| *name).chain(CUBE_DROPS.iter().map(|(name, ..)| *name))
}

/// Name and TOML text of each built-in scene that is a file.
pub fn scenes() -> &'static [(&'static str, &'static str)] {
    &FILES
}

/// The built-in scene of that name, with overrides such as `world.cell=0.02` applied.
///
/// # Errors
/// [`Error::Unknown`] listing the names; [`Error::Scene`] if an override cannot be used.
pub fn scene(name: &str, overrides: &[impl AsRef<str>]) -> Result<Scene> {
    let file = |name: &str, overrides: &[String]| {
        let (_, text) = FILES.iter().find(|(n, _)| *n == name)?;
        Some(Scene::from_str_with(text, &format!("{name}.toml (built in)"), "", overrides))
    };
    let mut all: Vec<String> = Vec::new();
    let base = match CUBE_DROPS.iter().find(|(n, ..)| *n == name) {
        Some(&(_, cells, lattice)) => {
            all.extend(cube_drop(name, cells, lattice));
            "cube-drop"
        }
        None => name,
    };
    all.extend(overrides.iter().map(|text| text.as_ref().to_owned()));
    file(base, &all).unwrap_or_else(|| {
        Err(Error::Unknown {
            path: "scene".to_owned(),
            kind: "scene",
            name: name.to_owned(),
            known: names().map(str::to_owned).collect(),
        })
    })
}

/// What the cube drop on `cells` along 1.28 m changes in the scene's file. The bed lies in the middle of the least whole
/// number of cells that holds it.
fn cube_drop(name: &str, cells: usize, lattice: [usize; 2]) -> [String; 6] {
    let cell = 1.28 / cells as f64;
    let bed = lattice.map(|n| n as f64 * cell / 2.0);
    let world = lattice.map(|n| n.div_ceil(2) as f64 * cell);
    let gap: [f64; 2] = std::array::from_fn(|d| (world[d] - bed[d]) / 2.0);
    [
        format!("name={name}"),
        format!("world.cell={cell}"),
        format!("world.max=[{}, {}, 0.8]", world[0], world[1]),
        format!("body.bed.spacing={}", cell / 2.0),
        format!(
            "body.bed.shape.box={{ min = [{}, {}, 0.0], max = [{}, {}, 0.2] }}",
            gap[0],
            gap[1],
            gap[0] + bed[0],
            gap[1] + bed[1]
        ),
        format!("tool.cube.position=[{}, {}, 0.262]", world[0] / 2.0, world[1] / 2.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use barchan_core::scene::{Motion, Shape};

    const AS_IT_IS: [&str; 0] = [];

    #[test]
    fn every_scene_can_be_used_and_has_its_own_name() {
        for name in names() {
            let scene = scene(name, &AS_IT_IS).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(scene.name, name);
            assert!(!scene.doc.is_empty());
        }
    }

    #[test]
    fn cube_drops_hold_the_papers_particles() {
        for (name, count) in [("cube-drop-32", 16_810), ("cube-drop-128", 1_444_000), ("cube-drop-256", 11_612_880)] {
            let scene = scene(name, &AS_IT_IS).unwrap();
            let Shape::Box { min: Some(min), max: Some(max), .. } = scene.body[0].shape else { panic!("no box") };
            let along = |d: usize| ((max[d] - min[d]) / scene.body[0].spacing.unwrap()).round() as usize;
            assert_eq!(along(0) * along(1) * along(2), count, "{name}");
        }
    }

    #[test]
    fn overrides_come_after_the_scenes_own() {
        let scene = scene("cube-drop-32", &["tool.cube.motion.free.mass=5", "time.end=0.1"]).unwrap();
        assert!(matches!(scene.tool[0].motion, Motion::Free { mass: 5.0, .. }));
        assert_eq!((scene.time.end, scene.world.cell), (0.1, 0.04));
    }

    #[test]
    fn an_unknown_scene_is_answered_with_the_known_ones() {
        let error = scene("leters", &AS_IT_IS).unwrap_err().to_string();
        assert!(error.contains("'leters'") && error.contains("letters, cube-drop"), "{error}");
    }

    #[test]
    fn the_stirrer_keeps_its_speed_and_stays_in_the_bed() {
        let scene = scene("letters", &AS_IT_IS).unwrap();
        let Motion::Keyframes { frames, .. } = &scene.tool[0].motion else { panic!("not keyframed") };
        assert!(frames.last().unwrap().time < scene.time.end);
        for pair in frames.windows(2) {
            let moved: f64 = (0..3).map(|d| (pair[1].position[d] - pair[0].position[d]).powi(2)).sum();
            let speed = moved.sqrt() / (pair[1].time - pair[0].time);
            let down = pair.iter().all(|f| f.position[2] < 0.16);
            assert!(speed < if down { 0.51 } else { 1.3 }, "{speed} m/s at {} s", pair[0].time);
            assert!((0..2).all(|d| 0.05 < pair[1].position[d] && pair[1].position[d] < [1.16, 0.35][d]));
        }
    }
}
