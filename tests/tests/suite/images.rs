//! Bodies that have gone over a side of a periodic world: they meet the ground as its images lie there.

use barchan::{Options, Simulation, Vec3};
use barchan_tests::scenes::{everywhere, norm, run_to, scene, within};

/// Length of the world along x and y [m]: 16 cells.
const PERIOD: f64 = 0.5;

/// A bed so many cells deep, and what stands in it, at x.
fn bed(depth: u32, x: f64, body: &dyn Fn(f64) -> String) -> String {
    let top = f64::from(depth) / 32.0;
    format!(
        r#"
name = "ring"
world = {{ cell = 0.03125, min = [0, 0, 0], max = [{PERIOD}, {PERIOD}, 1], walls = {{ x_min = "periodic", x_max = "periodic", y_min = "periodic", y_max = "periodic", z_min = "stick" }} }}
time = {{ end = 1, step = 1e-3 }}
material = [{{ name = "sand", law = "sand", density = 1600, parameters = {{ young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35 }} }}]
[[body]]
name = "bed"
material = "sand"
shape = {{ box = {{ min = [0, 0, 0], max = [{PERIOD}, {PERIOD}, {top}] }} }}
settled = true
{}
"#,
        body(x)
    )
}

/// A ball of 1 kg that falls into the bed, and one that is pulled through it.
fn balls(top: f64) -> impl Fn(f64) -> String {
    let ball = |name: &str, at: Vec3, motion: &str| {
        format!(
            "[[tool]]\nname = \"{name}\"\nposition = {at:?}\nshape = {{ sphere = {{ radius = 0.0625 }} }}\ncontact = {{ coulomb = {{ friction = 0.4 }} }}\nmotion = {motion}\n"
        )
    };
    move |x| {
        ball("falls", [x, 0.125, top + 0.0625], "{ free = { mass = 1.0, linear = [0.5, 0.0, -1.0] } }")
            + &ball("ploughs", [x, 0.375, top], "{ velocity = { linear = [1.0, 0.0, 0.0] } }")
    }
}

/// A quadruped that drops onto the bed; it is as long as the world.
fn dog(top: f64) -> impl Fn(f64) -> String {
    move |x| {
        format!(
            "[[robot]]\nname = \"dog\"\nmodel = \"quadruped\"\nposition = [{x}, 0.25, {}]\nvelocity = [0.5, 0, -0.5]\njoints = {{ \"*_thigh_joint\" = 0.8, \"*_calf_joint\" = -1.6 }}\nmotor = [{{ kp = 100, kd = 3 }}]\n",
            top + 0.32
        )
    }
}

fn start(toml: &str, options: &Options) -> Simulation {
    Simulation::new(&barchan::registry(), &scene(toml), options).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

/// Where bodies are, and what the ground does to them [N], after a while; x from where they began.
fn after(toml: &str, x: f64, options: &Options) -> (Vec<Vec3>, Vec<Vec3>) {
    let mut world = start(toml, options);
    run_to(&mut world, 0.1);
    let places = world.bodies().iter().map(|body| [body.position[0] - x, body.position[1], body.position[2]]).collect();
    (places, world.wrenches().iter().map(|wrench| wrench.force).collect())
}

/// Bodies that answer, and those that are led, sink as far and feel the same in the middle of a periodic world, across its sides, and three worlds further, whether the
/// law runs on the host (the bed is shallow: a wall is near) or on the device.
#[test]
fn bodies_meet_images_of_the_ground_beyond_periodic_sides() {
    for options in everywhere() {
        // On a device particles give to a node in an order that depends on where blocks stand.
        let [places_within, forces_within] = if options.backend == "cpu" { [1e-12, 1e-9] } else { [1e-6, 1e-2] };
        for depth in [4_u32, 8] {
            let top = f64::from(depth) / 32.0;
            for (what, body) in [("balls", &balls(top) as &dyn Fn(f64) -> String), ("dog", &dog(top))] {
                let (places, forces) = after(&bed(depth, 0.25, body), 0.25, &options);
                let most = forces.iter().map(norm).fold(0.0, f64::max);
                assert!(most > 10.0, "{what}: nothing met the ground: {most} N");
                for x in [0.25 + 3.0 * PERIOD, PERIOD, -2.0 * PERIOD] {
                    let (there, felt) = after(&bed(depth, x, body), x, &options);
                    let apart = |a: &[Vec3], b: &[Vec3]| {
                        let off = a.iter().zip(b).map(|(a, b)| norm([a[0] - b[0], a[1] - b[1], a[2] - b[2]]));
                        off.fold(0.0, f64::max)
                    };
                    let case =
                        format!("{what} from {x} m, {depth} cells deep, {} {:?}", options.backend, options.precision);
                    within(&format!("{case}: places [m]"), apart(&places, &there), places_within);
                    within(&format!("{case}: forces, relative"), apart(&forces, &felt) / most, forces_within);
                }
            }
        }
    }
}

/// Symptom: of two bodies side by side one fell through the ground, if it was a period further: a block of nodes near both was the first one's image for both. Each meets the
/// image that is nearest to it.
#[test]
fn bodies_side_by_side_meet_images_each_of_its_own() {
    let ball = |name: &str, x: f64, motion: &str| {
        format!(
            "[[tool]]\nname = \"{name}\"\nposition = [{x}, 0.25, 0.17]\nshape = {{ sphere = {{ radius = 0.06 }} }}\nmotion = {motion}\n"
        )
    };
    for options in everywhere() {
        let within_forces = if options.backend == "cpu" { 1e-6 } else { 1e-2 };
        for depth in [4_u32, 8] {
            for motion in ["{ free = { mass = 1.0 } }", "{ velocity = { linear = [0.0, 0.0, -0.2] } }"] {
                let high = f64::from(depth) / 32.0 - 0.125;
                let beside = |off: f64| {
                    let pair = |x: f64| ball("one", x, motion) + &ball("other", x + 0.125 + off, motion);
                    let text = bed(depth, 0.1875, &pair).replace("0.17]", &format!("{}]", 0.17 + high));
                    let (mut places, forces) = after(&text, 0.0, &options);
                    places[1][0] -= off;
                    (places, forces)
                };
                let (places, forces) = beside(0.0);
                let most = forces.iter().map(norm).fold(0.0, f64::max);
                assert!(forces.iter().all(|force| force[2] > 0.2 * most && most > 2.0), "both press: {forces:?}");
                for off in [PERIOD, -2.0 * PERIOD] {
                    let (there, felt) = beside(off);
                    let case = format!(
                        "{off} m off, {depth} cells deep, {motion}, {} {:?}",
                        options.backend, options.precision
                    );
                    let apart = |a: &[Vec3], b: &[Vec3]| {
                        let off = a.iter().zip(b).map(|(a, b)| norm([a[0] - b[0], a[1] - b[1], a[2] - b[2]]));
                        off.fold(0.0, f64::max)
                    };
                    within(&format!("{case}: places [m]"), apart(&places, &there), 1e-6);
                    within(&format!("{case}: forces, relative"), apart(&forces, &felt) / most, within_forces);
                }
            }
        }
    }
}

/// Ground that fell asleep wakes under a body that comes from beyond a side, and the height of the ground there is that of its image.
#[test]
fn ground_wakes_under_a_body_from_beyond_and_has_a_height_there() {
    let ball = |x: f64| {
        format!(
            "[[tool]]\nname = \"ball\"\nposition = [{x}, 0.25, 0.6]\nshape = {{ sphere = {{ radius = 0.0625 }} }}\nmotion = {{ velocity = {{ linear = [0.0, 0.0, -1.0] }} }}\n"
        )
    };
    for options in everywhere() {
        let mut toml = bed(8, 1.75, &ball);
        if options.backend == "wgpu" {
            toml += "[sleep]\nspeed = 1e-3\n";
        }
        let mut world = start(&toml, &options);
        run_to(&mut world, 0.15);
        let level = world.heights(&[[0.25, 0.25], [1.75, 0.25], [-0.5, 1.0]]).unwrap();
        let of = |height: Option<f64>| height.unwrap();
        within("beyond a side and here [m]", (of(level[1]) - of(level[0])).abs(), 1e-9);
        within("at a side and in the middle [m]", (of(level[2]) - of(level[0])).abs(), 2e-3);
        run_to(&mut world, 0.4);
        let pressed = world.heights(&[[0.25, 0.25]]).unwrap()[0].unwrap();
        let hollow = of(level[0]) - pressed;
        println!("{}: a hollow of {hollow:.3} m", options.backend);
        assert!(hollow > 0.05, "{hollow}");
    }
}
