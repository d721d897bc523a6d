//! Scenes put together from their parts, for the many small ones that tests need.

use barchan::Vec3;
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Walls that join every side with the one across.
pub const PERIODIC: &str = r#"
x_min = "periodic"
x_max = "periodic"
y_min = "periodic"
y_max = "periodic"
z_min = "periodic"
z_max = "periodic"
"#;

/// Gravity, its growth, cell width [m], extent [m], walls and time: what every scene begins with.
#[derive(Clone, Debug)]
pub struct Head<'a> {
    /// Gravity [m/s²].
    pub gravity: Vec3,
    /// Time over which it grows [s].
    pub gravity_ramp: f64,
    /// Cell width [m].
    pub cell: f64,
    /// Least corner [m].
    pub min: Vec3,
    /// Greatest corner [m].
    pub max: Vec3,
    /// Entries of `world.walls`, such as `z_min = "slip"`.
    pub walls: &'a str,
    /// Entries of `world`, such as `leaving = "clamp"`.
    pub world: &'a str,
    /// Entries of `time` besides `end`, such as `step = 1e-3`.
    pub time: String,
}

impl<'a> Head<'a> {
    /// Free space around the origin, 4 m in every direction, without gravity.
    pub fn space(cell: f64) -> Self {
        Self { gravity: [0.0; 3], min: [-4.0; 3], max: [4.0; 3], ..Self::cells(cell, [0; 3], "") }
    }

    /// A box of so many cells from the origin, with gravity.
    pub fn cells(cell: f64, cells: [u32; 3], walls: &'a str) -> Self {
        Self {
            gravity: [0.0, 0.0, -9.81],
            gravity_ramp: 0.0,
            cell,
            min: [0.0; 3],
            max: cells.map(|n| cell * f64::from(n)),
            walls,
            world: "",
            time: String::new(),
        }
    }

    /// With other entries of `time`.
    #[must_use]
    pub fn time(self, time: impl Display) -> Self {
        Self { time: time.to_string(), ..self }
    }

    /// The scene's text, with what stands in it.
    pub fn with(&self, parts: &[String]) -> String {
        let Self { gravity, gravity_ramp, cell, min, max, walls, world, time } = self;
        format!(
            "name = \"case\"\ngravity = {gravity:?}\ngravity_ramp = {gravity_ramp}\n\
             [world]\ncell = {cell}\nmin = {min:?}\nmax = {max:?}\n{world}\n\
             [world.walls]\n{walls}\n[time]\nend = 100.0\n{time}\n{}",
            parts.concat()
        )
    }
}

/// A material called after its law.
pub fn material(law: &str, density: f64, parameters: &str) -> String {
    format!("[[material]]\nname = \"{law}\"\nlaw = \"{law}\"\ndensity = {density}\nparameters = {{ {parameters} }}\n")
}

/// The same, with damping of elastic strain [s].
pub fn damped(law: &str, density: f64, parameters: &str, damping: f64) -> String {
    format!("{}damping = {damping:e}\n", material(law, density, parameters))
}

/// A box of a material; `more` holds further keys.
pub fn block(law: &str, min: Vec3, max: Vec3, more: &str) -> String {
    body(law, &format!("box = {{ min = {min:?}, max = {max:?} }}"), more)
}

/// A body of any shape, as in a scene file; `more` holds further keys.
pub fn body(law: &str, shape: &str, more: &str) -> String {
    format!("[[body]]\nmaterial = \"{law}\"\nshape = {{ {shape} }}\n{more}\n")
}

/// A tool; shape, contact and motion as in a scene file.
pub fn tool(name: &str, position: Vec3, shape: &str, contact: &str, motion: &str) -> String {
    format!(
        "[[tool]]\nname = \"{name}\"\nposition = {position:?}\nshape = {{ {shape} }}\ncontact = {contact}\nmotion = {motion}\n"
    )
}

/// A box by half its sides, as a tool's shape.
pub fn half(half: Vec3) -> String {
    format!("box = {{ half = {half:?} }}")
}

/// A box of sand on a slip floor between periodic sides: `cells` wide in x and y, `depth` cells deep.
pub fn bed(cell: f64, cells: [u32; 2], depth: u32, room: u32, parameters: &str) -> (Head<'static>, Vec<String>) {
    let walls =
        "x_min = \"periodic\"\nx_max = \"periodic\"\ny_min = \"periodic\"\ny_max = \"periodic\"\nz_min = \"stick\"";
    let head = Head::cells(cell, [cells[0], cells[1], depth + room], walls).time("safety = 0.5");
    let side = |n: u32| cell * f64::from(n);
    let sand = block("sand", [0.0; 3], [side(cells[0]), side(cells[1]), side(depth)], "");
    (head, vec![material("sand", 1500.0, parameters), sand])
}

/// A tool's motion at a steady velocity.
pub fn driven(velocity: Vec3) -> String {
    format!("{{ velocity = {{ linear = {velocity:?} }} }}")
}

/// A scoop 16 cm wide, as a tool's shape: a floor, a back and two cheeks, each 2.5 cells thick; sharp edges all round.
pub fn scoop(cell: f64) -> String {
    let wall = |half: Vec3, at: Vec3| format!("{{ shape = {{ box = {{ half = {half:?} }} }}, position = {at:?} }}");
    let t = 1.25 * cell;
    format!(
        "union = [{}, {}, {}, {}]",
        wall([0.08, 0.08, t], [0.0, 0.0, 0.0]),
        wall([t, 0.08, 0.08], [-0.08 + t, 0.0, 0.08]),
        wall([0.08, t, 0.06], [0.0, -0.08 + t, 0.06]),
        wall([0.08, t, 0.06], [0.0, 0.08 - t, 0.06]),
    )
}

/// Writes a box as a mesh, by half its sides, for bodies that do not lie along the axes. Returns the file.
///
/// # Panics
/// If it cannot be written.
pub fn box_mesh(folder: &Path, half: Vec3) -> PathBuf {
    let file = folder.join("box.obj");
    let mut obj = String::new();
    for i in 0..8 {
        let side = |bit: usize| if i >> bit & 1 == 0 { -half[bit] } else { half[bit] };
        obj += &format!("v {} {} {}\n", side(0), side(1), side(2));
    }
    for quad in [[1, 3, 4, 2], [5, 6, 8, 7], [1, 2, 6, 5], [3, 7, 8, 4], [1, 5, 7, 3], [2, 4, 8, 6]] {
        obj += &format!("f {} {} {}\nf {} {} {}\n", quad[0], quad[1], quad[2], quad[0], quad[2], quad[3]);
    }
    std::fs::write(&file, obj).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    file
}

/// A robot with a base of 2 kg on one leg, with a hip, a knee and a ball for a foot, as an URDF file in a folder; `shares` are what masses and inertias of its base and of its shank are
/// multiplied by.
pub fn hopper(folder: &Path, shares: [f64; 2]) -> PathBuf {
    let inertial = |mass: f64, about: f64, share: f64| {
        let [mass, x, y, z] = [mass, about, 1.4 * about, 0.8 * about].map(|x| x * share);
        format!(
            "<inertial><mass value=\"{mass:?}\"/><inertia ixx=\"{x:?}\" iyy=\"{y:?}\" izz=\"{z:?}\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>"
        )
    };
    let text = format!(
        r#"<robot name="hopper">
<link name="base">{}<collision><geometry><box size="0.16 0.12 0.06"/></geometry></collision></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="thigh"/><origin xyz="0.02 0.01 -0.03" rpy="0.1 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="0.42" effort="40" velocity="30"/><dynamics damping="0.02" friction="0.05"/></joint>
<link name="thigh">{}</link>
<joint name="knee" type="revolute"><parent link="thigh"/><child link="shank"/><origin xyz="0 0 -0.06"/><axis xyz="0.6 0.8 0"/>
<limit lower="-2" upper="2" effort="1.5" velocity="30"/></joint>
<link name="shank">{}<collision><origin xyz="0 0 -0.05"/><geometry><sphere radius="0.06"/></geometry></collision></link>
</robot>"#,
        inertial(2.0, 5e-3, shares[0]),
        inertial(0.5, 8e-4, 1.0),
        inertial(0.4, 6e-4, shares[1]),
    );
    let file = folder.join("hopper.urdf");
    std::fs::write(&file, text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    file
}

/// A stiff block, 8 cm high and in a mesh around the origin, on a plane that is tilted by `tilt` degrees against the grid, in gravity
/// at 30° to the plane; `more` holds further tables.
pub fn incline(tilt: f64, friction: f64, mesh: &Path, more: &str) -> String {
    let slope = f64::to_radians(30.0);
    let (s, c) = tilt.to_radians().sin_cos();
    // Along the plane, downhill, and out of it.
    let (t, n) = ([c, 0.0, s], [-s, 0.0, c]);
    let gravity: Vec3 = std::array::from_fn(|d| 9.81 * (slope.sin() * t[d] - slope.cos() * n[d]));
    let at = n.map(|x| 0.04 * x);
    let turn = -tilt.to_radians() / 2.0;
    let turn = [turn.cos(), 0.0, turn.sin(), 0.0];
    let head = Head { gravity, gravity_ramp: 0.2, min: [-1.0; 3], max: [3.0, 1.0, 3.0], ..Head::space(0.02) };
    head.time("safety = 0.5").with(&[
        material("hencky", 1000.0, "young_modulus = 2e6, poisson_ratio = 0.2"),
        body(
            "hencky",
            &format!("mesh = {{ file = {mesh:?}, center = {at:?}, rotation = {turn:?} }}"),
            "around_tools = false",
        ),
        tool(
            "plane",
            [0.0; 3],
            &format!("plane = {{ normal = {n:?} }}"),
            &format!("{{ coulomb = {{ friction = {friction} }} }}"),
            "\"fixed\"",
        ),
        more.to_owned(),
    ])
}
