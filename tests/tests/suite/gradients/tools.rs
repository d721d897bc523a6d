//! Gradients through tools: by where they are, how they move, and what they felt.

use super::{AWAKE, H, Noise, Vec3, by_number, difference, dot, simulation, weights, within};
use barchan::gradient::{BodyCotangents, PoseCotangent};
use barchan::{Cotangents, Precision, Tape, Wrench};
use barchan_tests::sketch::{Head, block, box_mesh, half, material, tool};

/// How the tool of a case moves.
#[derive(Clone, Copy, Debug)]
enum Motion {
    Velocity,
    /// Through keyframes, smoothly or not.
    Path(&'static str),
    /// As the ground lets it, so many times as fast a spin.
    Free(f64),
    /// Pushed by a force against damping, with a mass that it gives or that follows the force.
    Servo {
        own_mass: bool,
    },
}

/// A tool in stirred ground.
struct Case<'a> {
    law: (&'a str, &'a str),
    walls: &'a str,
    shape: String,
    contact: &'a str,
    motion: Motion,
    position: Vec3,
    /// Does the tool move within levels, in wider ground?
    nested: bool,
}

/// What is changed: all of these by so much along directions of their own.
#[derive(Clone, Copy, Default)]
struct By {
    position: f64,
    rotation: f64,
    linear: f64,
    angular: f64,
    keyframe: [f64; 4],
    ground: f64,
    parameter: f64,
    poisson: f64,
    gravity: f64,
    friction: f64,
    mass: f64,
    force: f64,
}

const STEPS: u32 = 10;
/// Young's modulus of the ground [Pa].
const YOUNG: f64 = 2e4;
/// Of a free tool and of one that is pushed [kg], and the force [N].
const MASS: f64 = 2.5;
const FORCE: f64 = 60.0;
const TURN: Vec3 = [0.3, -0.2, 0.25];
const LINEAR: Vec3 = [0.3, -0.2, -1.1];
const ANGULAR: Vec3 = [1.5, -2.0, 4.0];
/// The directions.
pub(super) const WAY: Vec3 = [0.6, -0.5, 0.8];

pub(super) fn along(from: Vec3, by: f64) -> Vec3 {
    std::array::from_fn(|d| from[d] + by * WAY[d])
}

pub(super) fn inner(a: Vec3, b: Vec3) -> f64 {
    (0..3).map(|d| a[d] * b[d]).sum()
}

pub(super) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|d| a[(d + 1) % 3] * b[(d + 2) % 3] - a[(d + 2) % 3] * b[(d + 1) % 3])
}

/// A vector turned by a quaternion.
pub(super) fn rotated([w, x, y, z]: [f64; 4], v: Vec3) -> Vec3 {
    let axis = [x, y, z];
    let (once, twice) = (cross(axis, v), cross(axis, cross(axis, v)));
    std::array::from_fn(|d| v[d] + 2.0 * (w * once[d] + twice[d]))
}

/// The quaternion of a rotation vector.
pub(super) fn turned([x, y, z]: Vec3) -> [f64; 4] {
    let angle = (x * x + y * y + z * z).sqrt();
    let share = if angle > 0.0 { (0.5 * angle).sin() / angle } else { 0.5 };
    [(0.5 * angle).cos(), share * x, share * y, share * z]
}

/// One rotation on top of another.
pub(super) fn on_top(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let ([p, x, y, z], [q, u, v, w]) = (a, b);
    [
        p * q - x * u - y * v - z * w,
        p * u + q * x + y * w - z * v,
        p * v + q * y + z * u - x * w,
        p * w + q * z + x * v - y * u,
    ]
}

impl Case<'_> {
    fn text(&self, by: &By) -> String {
        let head = Head { gravity: [0.6, 0.0, -9.81 - by.gravity], ..Head::cells(H, self.world(), self.walls) };
        let motion = match self.motion {
            Motion::Velocity => {
                let (linear, angular) = (along(LINEAR, by.linear), along(ANGULAR, by.angular));
                format!("{{ velocity = {{ linear = {linear:?}, angular = {angular:?} }} }}")
            }
            Motion::Free(spin) => {
                let (linear, angular) = (along(LINEAR, by.linear), along(ANGULAR.map(|x| spin * x), by.angular));
                format!("{{ free = {{ mass = {:?}, linear = {linear:?}, angular = {angular:?} }} }}", MASS + by.mass)
            }
            Motion::Servo { own_mass } => {
                let mass = if own_mass { format!("mass = {:?},", MASS + by.mass) } else { String::new() };
                let force = FORCE + by.force;
                format!(
                    "{{ servo = {{ axis = [0.2, -0.1, -1.0], force = {force:?}, {mass} ramp = 6e-3, damping = 12.0 }} }}"
                )
            }
            Motion::Path(interpolation) => {
                let at = |k: usize, time: f64, far: f64| {
                    let on: Vec3 = std::array::from_fn(|d| self.position[d] + far * LINEAR[d]);
                    let turn = turned(std::array::from_fn(|d| TURN[d] + far * ANGULAR[d]));
                    let on = along(on, by.keyframe[k]);
                    format!("{{ time = {time:?}, position = {on:?}, rotation = {turn:?} }}")
                };
                let frames = [at(0, 0.0, 0.0), at(1, 3.5e-3, 4e-3), at(2, 7e-3, 6e-3), at(3, 9.2e-3, 1e-2)].join(", ");
                format!("{{ keyframes = {{ frames = [{frames}], interpolation = \"{interpolation}\" }} }}")
            }
        };
        let rotation = on_top(turned(along([0.0; 3], by.rotation)), turned(TURN));
        let place = if !matches!(self.motion, Motion::Path(_)) { along(self.position, by.position) } else { [0.0; 3] };
        let contact = self.contact.replace("0.3", &format!("{:?}", 0.3 + by.friction));
        let tool = tool("tool", place, &self.shape, &contact, &motion) + &format!("rotation = {rotation:?}\n");
        let (law, parameters) = self.law;
        let parameters = parameters.replace("0.45", &format!("{:?}", 0.45 + by.poisson));
        let parameters = format!("young_modulus = {:?}, {parameters}", YOUNG * (1.0 + by.parameter));
        let (ground, levels) = match self.nested {
            false => ([4.0 * H, 5.0 * H, 3.0 * H], String::new()),
            true => ([26.0 * H, 18.0 * H, 5.0 * H], "[levels]\ncount = 2\nhalf = 8\n".to_owned()),
        };
        let ground = block(law, [0.0; 3], ground, "");
        head.time("step = 1e-3").with(&[AWAKE.into(), levels, material(law, 1000.0, &parameters), ground, tool])
    }

    fn world(&self) -> [u32; 3] {
        if self.nested { [28, 20, 14] } else { [8, 8, 10] }
    }

    fn tape(&self, by: &By) -> Tape {
        let mut sim = simulation(&self.text(by), Precision::F64);
        let mut state = sim.particles();
        let mut noise = Noise::new(9);
        for (l, i) in by_number(&state) {
            let list = &mut state.lists[l];
            let [v, way]: [Vec3; 2] = [0; 2].map(|_| std::array::from_fn(|_| noise.draw()));
            list.velocity[i] = std::array::from_fn(|d| 0.4 * v[d] + by.ground * way[d]);
        }
        sim.set_particles(state).unwrap_or_else(|e| panic!("{e}"));
        sim.record(&barchan::registry(), 1e-3 * f64::from(STEPS)).unwrap_or_else(|e| panic!("{e}"))
    }

    /// What a loss looks at: particles, where the tool ends, how it is turned and how it moves there, and what it felt.
    fn loss(tape: &Tape) -> (f64, Cotangents) {
        let mut all = weights(tape.end().id.len());
        let (end, felt) = (tape.end(), tape.impulses()[0]);
        let tool = &end.bodies[0];
        let (axis, weight) = (rotated(tool.rotation, [0.3, 0.8, -0.5]), [0.7, -0.4, 0.9]);
        let pose = PoseCotangent { position: [0.3, -0.2, 0.5], rotation: cross(axis, weight) };
        let impulse = Wrench { force: [0.4, -0.3, 0.6], torque: [2.0, 3.0, -4.0] };
        // Of a driven one it is what that was told.
        let answers = tool.twist != [[0.0; 3]; 2];
        let [velocity, angular_velocity] =
            [[0.05, 0.02, -0.03], [0.003, -0.004, 0.005]].map(|owed| if answers { owed } else { [0.0; 3] });
        all.bodies = vec![BodyCotangents { pose, velocity, angular_velocity, impulse }];
        let loss = dot(&end.position, &all.position)
            + dot(&end.velocity, &all.velocity)
            + inner(tool.position, pose.position)
            + inner(axis, weight)
            + inner(tool.twist[0], velocity)
            + inner(tool.twist[1], angular_velocity)
            + inner(felt.force, impulse.force)
            + inner(felt.torque, impulse.torque);
        (loss, all)
    }

    /// Compares a gradient with differences of runs.
    fn compare(&self) {
        let tape = self.tape(&By::default());
        assert_eq!(tape.len(), STEPS as usize);
        let felt = tape.impulses()[0].force;
        assert!(inner(felt, felt) > 1e-6, "{}: the tool touches nothing", self.shape);
        let (_, loss) = Self::loss(&tape);
        let found = tape.pull_back(loss).unwrap_or_else(|e| panic!("{e}"));
        let mut noise = Noise::new(9);
        let mut ways = Vec::new();
        for _ in 0..tape.end().id.len() {
            (0..3).for_each(|_| _ = noise.draw());
            ways.push(std::array::from_fn(|_| noise.draw()));
        }
        let run = |by: By| Self::loss(&self.tape(&by)).0;
        let (pose, told) = (found.particles.bodies[0].pose, &found.bodies[0]);
        let young = found.parameters[0][0] * YOUNG;
        let mut compared = vec![
            (
                "ground",
                dot(&found.particles.velocity, &ways),
                difference(1e-6, |ground| run(By { ground, ..By::default() })),
                2e-6,
            ),
            ("gravity", -found.gravity[2], difference(1e-4, |gravity| run(By { gravity, ..By::default() })), 2e-6),
            // Laws tell their stiffness in f32, so that differences need long steps.
            ("young_modulus", young, difference(3e-4, |parameter| run(By { parameter, ..By::default() })), 2e-3),
        ];
        if self.law.1.contains("0.45") {
            let run = difference(3e-4, |poisson| run(By { poisson, ..By::default() }));
            compared.push(("poisson_ratio", found.parameters[0][1], run, 2e-3));
        }
        if self.contact == RUBBING {
            let run = difference(1e-5, |friction| run(By { friction, ..By::default() }));
            compared.push(("friction", told.friction, run, 2e-6));
        }
        let (speed, spin) = match self.motion {
            Motion::Velocity => (told.linear, told.angular),
            _ => (found.particles.bodies[0].velocity, found.particles.bodies[0].angular_velocity),
        };
        let moved = |position| run(By { position, ..By::default() });
        let turned = |rotation| run(By { rotation, ..By::default() });
        let faster = |linear| run(By { linear, ..By::default() });
        let spun = |angular| run(By { angular, ..By::default() });
        let heavier = |mass| run(By { mass, ..By::default() });
        let pushed = |force| run(By { force, ..By::default() });
        let place = [
            ("position", inner(pose.position, WAY), difference(1e-7, moved), 2e-6),
            ("rotation", inner(pose.rotation, WAY), difference(1e-6, turned), 2e-6),
        ];
        let motion = [
            ("linear", inner(speed, WAY), difference(1e-5, faster), 2e-6),
            ("angular", inner(spin, WAY), difference(1e-5, spun), 2e-6),
        ];
        match self.motion {
            Motion::Velocity => compared.extend([place, motion].concat()),
            Motion::Free(_) => {
                compared.extend([place, motion].concat());
                compared.push(("mass", told.mass, difference(1e-4, heavier), 2e-6));
            }
            Motion::Servo { own_mass } => {
                compared.extend(place);
                compared.push(("force", told.force, difference(1e-3, pushed), 2e-6));
                if own_mass {
                    compared.push(("mass", told.mass, difference(1e-4, heavier), 2e-6));
                }
            }
            Motion::Path(_) => {
                assert_eq!((pose, told.keyframes.len()), (PoseCotangent::default(), 4));
                compared.extend((0..4).map(|k| {
                    let moved = |by: f64| {
                        let mut all = By::default();
                        all.keyframe[k] = by;
                        run(all)
                    };
                    ("keyframe", inner(told.keyframes[k], WAY), difference(1e-7, moved), 2e-6)
                }));
            }
        }
        for (what, given, expected, tolerance) in compared {
            // Differences over more ground are rougher.
            let tolerance = if self.nested { 5.0 * tolerance } else { tolerance };
            let name = format!("{} {} {:?} {what}: {given:.9e} {expected:.9e}", self.law.0, self.shape, self.motion);
            within(&name, (given - expected).abs() / expected.abs().max(1e-3), tolerance);
        }
    }
}

const JELLY: (&str, &str) = ("neo_hookean", "poisson_ratio = 0.3");
/// Near to where its stiffness has no bound.
const RUBBER: (&str, &str) = ("neo_hookean", "poisson_ratio = 0.45");
const SAND: (&str, &str) = ("sand", "poisson_ratio = 0.3, friction_angle = 0.6");
const RUBBING: &str = "{ coulomb = { friction = 0.3 } }";
const FLOOR: &str = "z_min = \"stick\"\n";

/// Physics: gradients are derivatives, by where the tool is, how it turns and moves, by the ground, and of what the tool felt. Of every shape that is exact or sampled, thick and thin,
/// and every contact.
#[test]
fn gradients_go_through_driven_tools() {
    let bowl = "height_field = { min = [-0.08, -0.08], max = [0.08, 0.08], bottom = -0.06, heights = [[0.02, 0.05, 0.03], [0.04, 0.0, 0.03], [0.03, 0.05, 0.06]] }";
    let cases = [
        ("sphere = { radius = 0.07 }".to_owned(), RUBBING, JELLY),
        (half([0.08, 0.06, 0.07]), "\"stick\"", JELLY),
        (half([0.08, 0.09, 0.07]), RUBBING, SAND),
        // Thin, with a core that holds both ways.
        (half([0.085, 0.012, 0.08]), RUBBING, SAND),
        ("cylinder = { radius = 0.07, half_height = 0.06 }".to_owned(), "\"slip\"", JELLY),
        ("capsule = { radius = 0.05, half_height = 0.05 }".to_owned(), RUBBING, SAND),
        (bowl.to_owned(), RUBBING, JELLY),
        ("sphere = { radius = 0.07 }".to_owned(), "\"slip\"", RUBBER),
    ];
    for (shape, contact, law) in cases {
        let position = [2.1 * H, 2.4 * H, 3.6 * H];
        Case { law, walls: FLOOR, shape, contact, motion: Motion::Velocity, position, nested: false }.compare();
    }
}

/// Likewise within levels: of tools that these follow, driven and free, and of one that reaches from a level into the next.
#[test]
fn gradients_of_tools_go_through_levels() {
    let sphere = "sphere = { radius = 0.07 }".to_owned();
    for (shape, motion) in [
        (sphere, Motion::Free(1.0)),
        (half([0.1, 0.05, 0.07]), Motion::Velocity),
        (half([0.55, 0.05, 0.07]), Motion::Velocity),
    ] {
        let position = [10.1 * H, 9.3 * H, 5.7 * H];
        Case { law: JELLY, walls: FLOOR, shape, contact: RUBBING, motion, position, nested: true }.compare();
    }
}

/// Likewise by keyframes, through which a path is straight or smooth.
#[test]
fn gradients_go_to_keyframes() {
    for interpolation in ["linear", "smooth"] {
        let shape = "sphere = { radius = 0.07 }".to_owned();
        let position = [2.1 * H, 2.4 * H, 3.6 * H];
        let motion = Motion::Path(interpolation);
        Case { law: JELLY, walls: FLOOR, shape, contact: RUBBING, motion, position, nested: false }.compare();
    }
}

/// Likewise where ends are joined and the tool reaches across them, beside a wall that lets go and one that slips; and of a mesh.
#[test]
fn gradients_of_tools_go_through_walls_and_joined_ends() {
    let walls =
        "z_min = { separate = { friction = 0.3 } }\nx_min = \"slip\"\ny_min = \"periodic\"\ny_max = \"periodic\"\n";
    let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
    let mesh = format!("mesh = {{ file = {:?} }}", box_mesh(folder.path(), [0.08, 0.06, 0.07]));
    for shape in ["sphere = { radius = 0.09 }".to_owned(), half([0.07, 0.06, 0.08]), mesh] {
        let position = [1.0 * H, 0.3 * H, 2.7 * H];
        Case { law: JELLY, walls, shape, contact: RUBBING, motion: Motion::Velocity, position, nested: false }
            .compare();
    }
}

/// Likewise through tools that the ground moves: free ones, thrown and spinning, whose balance with the ground and whose tumbling go back as well, and those that a force pushes along a guide.
#[test]
fn gradients_go_through_bodies_that_the_ground_moves() {
    let motions =
        [Motion::Free(1.0), Motion::Free(25.0), Motion::Servo { own_mass: true }, Motion::Servo { own_mass: false }];
    let shapes = [
        ("sphere = { radius = 0.07 }".to_owned(), RUBBING, JELLY),
        (half([0.1, 0.05, 0.07]), RUBBING, SAND),
        (half([0.06, 0.09, 0.08]), "\"stick\"", JELLY),
    ];
    for motion in motions {
        for (shape, contact, law) in shapes.clone() {
            let position = [2.1 * H, 2.4 * H, 3.9 * H];
            Case { law, walls: FLOOR, shape, contact, motion, position, nested: false }.compare();
        }
    }
}
