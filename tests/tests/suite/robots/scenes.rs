//! The built-in scenes with robots, each for a short time on coarse cells.

use barchan::{Options, RobotState, Simulation};
use barchan_tests::scenes::{lean, run_to};
use glam::DVec3;

/// A built-in scene, coarse.
fn coarse(name: &str, overrides: &[&str]) -> Simulation {
    let scene = barchan::tasks::scene(name, overrides).unwrap();
    Simulation::new(&barchan::registry(), &scene, &Options { threads: 2, ..Options::default() }).unwrap()
}

fn robot(s: &Simulation) -> RobotState {
    s.robots().remove(0)
}

fn centre(s: &Simulation, link: &str) -> DVec3 {
    let body = s.bodies().into_iter().find(|body| body.name == link);
    DVec3::from_array(body.unwrap_or_else(|| panic!("no body '{link}'")).position)
}

/// Mean push of the ground on a robot up to a time, over its weight.
fn borne(s: &mut Simulation, until: f64) -> f64 {
    let weight = 9.81 * s.bodies().iter().map(|body| body.mass).sum::<f64>();
    let (mut impulse, from) = (0.0, s.time());
    while s.time() < until {
        let dt = s.step().unwrap().dt;
        impulse += dt * robot(s).links.iter().map(|link| link.felt().force[2]).sum::<f64>();
    }
    impulse / (s.time() - from) / weight
}

/// What holds for all feet is said once, with the name of each.
#[test]
fn what_holds_for_all_feet_is_said_once() {
    let plan = coarse("quadruped-trot", &["levels.half=8"]).plan().warnings.clone();
    let feet = ["FL", "FR", "RL", "RR"].map(|leg| format!("'dog/{leg}_foot'")).join(", ");
    for said in [
        format!("links {feet} are 2.8 cells thick: forces of the ground on them"),
        format!("between the lowest points of {feet} and the rim below them"),
    ] {
        let times = plan.iter().filter(|warning| warning.contains(&said)).count();
        assert_eq!(times, 1, "'{said}' in {plan:#?}");
    }
    assert_eq!(plan.iter().filter(|warning| warning.contains("foot")).count(), 2, "{plan:#?}");
}

/// A humanoid that is held by its joints alone stands upright, and the sand bears its weight.
#[test]
fn humanoid_stand_is_borne_by_the_sand() {
    let mut s = coarse("humanoid-stand", &["world.cell=0.03125"]);
    run_to(&mut s, 0.7);
    let before = robot(&s);
    let push = borne(&mut s, 1.2);
    let state = robot(&s);
    let crept = (DVec3::from_array(state.position) - DVec3::from_array(before.position)).length();
    println!(
        "borne by {push:.3} of its weight (1 +- 0.03), crept {crept:.1e} m (5e-3), leaning by {:.2} degrees (3)",
        lean(&state)
    );
    assert!((push - 1.0).abs() < 0.03 && crept < 5e-3 && lean(&state) < 3.0, "{push}, {crept}, {state:?}");
}

/// A humanoid puts its right foot 0.2 m forward; the left one stays, and it does not fall.
#[test]
fn humanoid_step_puts_a_foot_forward() {
    let mut s = coarse("humanoid-step", &["world.cell=0.03125"]);
    let feet = |s: &Simulation| {
        let named = |side: &str| {
            s.bodies()
                .into_iter()
                .filter(|b| b.name.contains(side) && b.name.contains("foot"))
                .map(|b| b.position[0])
                .next_back()
        };
        [named("right").unwrap(), named("left").unwrap()]
    };
    run_to(&mut s, 0.5);
    let start = feet(&s);
    run_to(&mut s, 2.4);
    let end = feet(&s);
    let (step, slip) = (end[0] - start[0], end[1] - start[1]);
    println!(
        "right foot {step:.3} m on (0.15), left {slip:.3} m (0.03), leaning by {:.1} degrees (10)",
        lean(&robot(&s))
    );
    assert!(step > 0.15 && slip.abs() < 0.03 && lean(&robot(&s)) < 10.0);
}

/// The rod of an arm that writes follows its path, and the sand pushes it up.
#[test]
fn arm_writes_follows_its_path() {
    let mut s = coarse("arm-writes", &["world.cell=0.016", "levels.count=1"]);
    let rest = centre(&s, "arm/rod");
    let frames = s.plan().scene.robot[0].motion.as_ref().unwrap().path.as_ref().unwrap().frames.clone();
    let (mut worst, mut push) = (0.0_f64, 0.0_f64);
    for frame in frames.iter().filter(|frame| (0.3..1.5).contains(&frame.time)) {
        run_to(&mut s, frame.time);
        let way = DVec3::from_array(frame.position) - DVec3::from_array(frames[0].position);
        worst = worst.max((centre(&s, "arm/rod") - rest - way).length());
        push = push.max(robot(&s).links.iter().find(|link| link.name == "arm/rod").unwrap().ground.force[2]);
    }
    println!("rod up to {:.1} mm off its path (15), pushed up with {push:.0} N (3 to 200)", 1e3 * worst);
    assert!(worst < 0.015 && (3.0..200.0).contains(&push), "{worst}, {push}");
}

/// The blade of an arm that scoops lifts sand and cube out of the bed.
#[test]
fn arm_scoops_lifts_what_it_carries() {
    let mut s = coarse("arm-scoops", &["world.cell=0.016"]);
    let height = |s: &Simulation| {
        let all: Vec<f64> = s.spots().iter().filter(|spot| spot.material == 1).map(|spot| spot.position[2]).collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    let start = height(&s);
    run_to(&mut s, 2.6);
    let lifted = height(&s) - start;
    println!("cube lifted by {lifted:.3} m (0.1)");
    assert!(lifted > 0.1, "{lifted}");
}

/// A quadruped trots over dunes of which only what is around its feet is live: it comes on and does not fall, ground comes and goes with it, and none of its mass is lost.
#[test]
fn quadruped_dunes_come_and_go_under_a_trot() {
    let mut s = coarse(
        "quadruped-dunes",
        &["world.cell=0.03125", "levels.count=2", "levels.half=8", "material[0].parameters.young_modulus=2e5"],
    );
    let (start, live) = (s.ledger(), s.particle_count());
    run_to(&mut s, 0.5);
    let before = robot(&s);
    let mut tilt = 0.0_f64;
    while s.time() < 4.0 {
        let until = s.time() + 0.1;
        run_to(&mut s, until);
        tilt = tilt.max(lean(&robot(&s)));
    }
    let way = robot(&s).position[0] - before.position[0];
    let end = s.ledger();
    let kept = end.counts.get("tiles in the archive now").copied().unwrap_or(0);
    let off = (end.mass + end.deleted_mass - end.seeded_mass) / start.mass - 1.0;
    println!(
        "{way:.2} m on (1), tilt at most {tilt:.1} degrees (25), {} of {live} particles live; {kept} tiles in the archive; mass off by {off:.1e}",
        s.particle_count()
    );
    assert!(way > 1.0 && tilt < 25.0, "{way} m, {tilt} degrees");
    assert!((0.5..2.0).contains(&(s.particle_count() as f64 / live as f64)), "{} of {live}", s.particle_count());
    assert!(end.seeded_mass > 0.05 * start.mass, "no ground has come: {} kg", end.seeded_mass);
    assert!(kept > 0, "what feet have changed is not kept");
    assert!(off.abs() < 1e-6, "mass is off by {off}");
}

/// The paper's grid: eight levels of 32 cells a side around the base. The finest holds the robot, and the sand bears it.
#[test]
fn eight_levels_around_the_base_bear_a_quadruped() {
    let mut s = coarse("quadruped-eight-levels", &["time.end=0.5"]);
    let widths = &s.plan().cell_widths;
    assert!(
        widths.len() == 8 && (widths[0] - 10.0 / 128.0).abs() < 1e-12 && (widths[7] - 10.0).abs() < 1e-12,
        "{widths:?}"
    );
    let particles = s.particles();
    let on_level = |level: u32| particles.lists.iter().filter(|list| list.level == level).map(|list| list.len()).sum();
    let counts: Vec<usize> = (0..8).map(on_level).collect();
    run_to(&mut s, 0.25);
    let push = borne(&mut s, 0.5);
    println!(
        "particles by level {counts:?}; borne by {push:.3} of its weight (1 +- 0.05), leaning by {:.2} degrees",
        lean(&robot(&s))
    );
    assert!(
        counts[..3].iter().all(|count| *count > 10_000) && counts[4..].iter().all(|count| *count == 0),
        "{counts:?}"
    );
    assert!((push - 1.0).abs() < 0.05 && lean(&robot(&s)) < 3.0, "{push}");
}
