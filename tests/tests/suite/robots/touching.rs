//! Robots that touch themselves, and tools that move.

use super::{moved, root, space, totals};
use barchan::{Coupling, Scene, Vec3};
use barchan_rigid::robot::Robots;
use glam::DVec3;

fn place(robots: &Robots, name: &str) -> DVec3 {
    let body = robots.bodies().into_iter().find(|body| body.name == name);
    DVec3::from_array(body.unwrap_or_else(|| panic!("no body '{name}'")).position)
}

/// A quadruped afloat brings its front feet together: they stop where they touch if it may touch itself, and else pass through each other. Its momentum stays what it is.
#[test]
fn feet_of_a_robot_meet_or_pass_as_the_scene_says() {
    let gap_after = |more: &str| {
        let scene = space(
            0.0,
            &format!(
                "[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nvelocity = [0.1, 0.2, 0.3]\nangular_velocity = [0.2, 0, 0.1]\njoints = {{ \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }}\nmotor = [{{ kp = 60, kd = 2 }}]\nmotion = {{ frames = [{{ time = 0, joints = {{ FL_hip_joint = 0 }} }}, {{ time = 0.5, joints = {{ FL_hip_joint = -0.7, FR_hip_joint = 0.7 }} }}] }}\n{more}"
            ),
        );
        let mut robots = Robots::new(&scene).unwrap();
        let start = totals(&robots);
        let (mut least, mut drift) = (f64::INFINITY, 0.0_f64);
        for step in 0..1600 {
            moved(&mut robots, 5e-4 * f64::from(step), 5e-4);
            // Along the robot's own y axis, left is positive.
            let across = robots.robots()[0].base().rotation * DVec3::Y;
            least = least.min((place(&robots, "dog/FL_foot") - place(&robots, "dog/FR_foot")).dot(across));
            let now = totals(&robots);
            (0..2).for_each(|i| drift = drift.max((now[i] - start[i]).length() / start[i].length()));
        }
        let state = Coupling::robots(&robots).remove(0);
        let foot = state.links.iter().find(|link| link.name == "dog/FL_foot").unwrap();
        let pressed = DVec3::from_array(foot.felt().force).length();
        assert!(drift < 1e-12, "momentum is off by {drift}");
        (least, pressed)
    };
    let ((apart, pressed), (passed, _)) = (gap_after("self_collision = true"), gap_after(""));
    println!(
        "feet of 22 mm stay {apart:.4} m apart (0.044 - 0.001), pressed with {pressed:.0} N; or pass to {passed:.3}"
    );
    assert!(apart > 0.043 && pressed > 1.0, "{apart}, {pressed}");
    assert!(passed < 0.0, "{passed}");
}

/// A platform that rises and moves sideways on keyframes carries the robot that stands on it.
#[test]
fn a_moving_platform_carries_a_robot() {
    let text = "name = \"lift\"\nworld = { cell = 0.01, min = [-5, -2, -2], max = [5, 2, 3] }\ntime = { end = 3 }\n[[tool]]\nname = \"platform\"\nshape = { box = { half = [1, 1, 0.1] } }\ncontact = { coulomb = { friction = 0.8 } }\nmotion = { keyframes = { interpolation = \"linear\", frames = [{ time = 0, position = [0, 0, -0.1] }, { time = 10, position = [3, 0, 0.9] }] } }\n[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nposition = [0, 0, 0.325]\ncontact = { coulomb = { friction = 0.8 } }\njoints = { \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }\nmotor = [{ kp = 250, kd = 5 }]";
    let mut robots = Robots::new(&Scene::from_str(text, "lift.toml", root()).unwrap()).unwrap();
    let dt = 5e-4;
    (0..4000).for_each(|step| moved(&mut robots, f64::from(step) * dt, dt));
    let velocity: Vec3 = robots.bodies()[0].velocity;
    let off = (DVec3::from_array(velocity) - DVec3::new(0.3, 0.0, 0.1)).length();
    // The platform's top has risen to 0.2 m; the trunk stands 0.31 m above it.
    let height = place(&robots, "dog").z - 0.2;
    println!("moves with the platform but for {off:.1e} m/s (5e-3), {height:.3} m above it");
    assert!(off < 5e-3 && (0.29..0.33).contains(&height), "{velocity:?}, {height}");
    let state = Coupling::robots(&robots).remove(0);
    let weight: f64 = 9.81 * robots.bodies().iter().map(|body| body.mass).sum::<f64>();
    let borne: f64 = state.links.iter().flat_map(|link| &link.rigid).map(|point| point.force[2]).sum();
    assert!((borne / weight - 1.0).abs() < 0.02, "{borne} of {weight} N");
    assert!(robots.warnings(0.01).iter().all(|warning| !warning.contains("platform")));
}

/// Links that overlap where the robot starts are left alone, and named.
#[test]
fn links_that_overlap_at_the_start_are_named() {
    let cross =
        "joints = { FL_hip_joint = -0.5, FR_hip_joint = 0.5, \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }";
    let scene =
        space(0.0, &format!("[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nself_collision = true\n{cross}"));
    let robots = Robots::new(&scene).unwrap();
    let warnings = robots.warnings(0.01);
    assert!(warnings.iter().any(|w| w.contains("overlap at the start") && w.contains("FL_")), "{warnings:?}");
}
