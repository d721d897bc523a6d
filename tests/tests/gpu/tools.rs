//! Driven tools of all shapes: they feel what they feel on the CPU.

use super::{apart, cpu, gpu, left, off, on_gpu, passes_of, take};
use barchan::worlds::Worlds;
use barchan::{Scene, Simulation, Vec3};
use barchan_tests::scenes::{norm, rows, scene, within};
use barchan_tests::sketch::{Head, block, box_mesh, driven, half, material, tool};
use std::path::{Path, PathBuf};

/// A blade drawn through sand, and a cube that falls on it: forces and places as on the CPU.
#[test]
fn tools_feel_what_they_feel_on_the_cpu() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let toml = Head::cells(0.02, [20, 12, 16], walls).time("step = 2.5e-4").with(&[
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [0.4, 0.24, 0.1], ""),
        tool(
            "blade",
            [0.1, 0.12, 0.12],
            &half([0.02, 0.06, 0.06]),
            "{ coulomb = { friction = 0.3 } }",
            &driven([0.4, 0.0, 0.0]),
        ),
        tool(
            "cube",
            [0.3, 0.12, 0.135],
            &half([0.03, 0.03, 0.03]),
            "{ coulomb = { friction = 0.5 } }",
            "{ free = { mass = 0.4, linear = [0.0, 0.0, -0.5] } }",
        ),
    ]);
    let (mut gpu, mut cpu) = (gpu(&toml), cpu(&toml));
    let impulse = |sim: &mut Simulation| {
        let mut sum = [0.0; 3];
        for _ in 0..160 {
            let dt = sim.step().unwrap_or_else(|e| panic!("{e}")).dt;
            for d in 0..3 {
                sum[d] += sim.wrenches()[0].force[d] * dt;
            }
        }
        sum
    };
    let (g, c) = (impulse(&mut gpu), impulse(&mut cpu));
    println!("impulse on the blade: {g:?} and {c:?} N s");
    within("impulse on the blade, relative", off(g, c) / norm(c), 0.02);
    let (g, c) = (gpu.bodies()[1].position, cpu.bodies()[1].position);
    within("place of the cube, in cells", off(g, c) / 0.02, 0.01);
}

/// An octahedron with such half axes [m], as a mesh. Returns the file.
fn octahedron(folder: &Path, half: Vec3) -> PathBuf {
    let mut obj = String::new();
    for d in 0..3 {
        for sign in [1.0, -1.0] {
            let corner: Vec3 = std::array::from_fn(|e| if d == e { sign * half[d] } else { 0.0 });
            obj += &format!("v {} {} {}\n", corner[0], corner[1], corner[2]);
        }
    }
    for (x, y, z) in (0..8).map(|n| (n & 1, n >> 1 & 1, n >> 2)) {
        let (y, z) = if (x + y + z) % 2 == 0 { (3 + y, 5 + z) } else { (5 + z, 3 + y) };
        obj += &format!("f {} {y} {z}\n", 1 + x);
    }
    let file = folder.join("octahedron.obj");
    std::fs::write(&file, obj).unwrap();
    file
}

/// Shapes that are sampled are felt on the device as they are on the CPU: a plough of meshes drawn through sand, in a union and turned, a sole with bumps
/// pressed into it, and a box of another mesh that drops; and worlds of a batch, which share the samples and go many steps at once, are what they are alone.
#[test]
fn sampled_shapes_are_felt_on_the_device_as_on_the_cpu() {
    let folder = tempfile::tempdir().unwrap();
    let plough = octahedron(folder.path(), [0.05, 0.04, 0.06]);
    let cube = box_mesh(folder.path(), [0.03, 0.03, 0.03]);
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    // No node stands on a face or where normals change: there rounding decides.
    let with_speed = |speed: f64| {
        Head::cells(0.02, [28, 12, 16], walls).time("step = 2.5e-4").with(&[
            material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
            block("sand", [0.0; 3], [0.56, 0.24, 0.1], ""),
            tool(
                "plough",
                [0.1007, 0.1213, 0.1211],
                &format!(
                    "union = [{{ shape = {{ mesh = {{ file = {plough:?}, center = [0.01, 0.0, -0.02], rotation = [0.95, 0.1, 0.2, 0.1] }} }} }}, \
                     {{ shape = {{ mesh = {{ file = {plough:?}, scale = 0.8 }} }}, position = [-0.02, 0.01, 0.03] }}]"
                ),
                "{ coulomb = { friction = 0.3 } }",
                &driven([speed, 0.0, 0.0]),
            ),
            tool(
                "sole",
                [0.2017, 0.0513, 0.1207],
                "union = [{ shape = { height_field = { min = [-0.05, -0.03], max = [0.03, 0.04], bottom = -0.03, \
                 heights = [[0.01, 0.03, 0.0], [0.02, 0.01, 0.01]] } }, rotation = [0.1, 0.99, 0.1, 0.0] }]",
                "{ coulomb = { friction = 0.3 } }",
                &driven([0.1, 0.0, -0.4]),
            ),
            tool(
                "cube",
                [0.4231, 0.1237, 0.1352],
                &format!("mesh = {{ file = {cube:?} }}"),
                "{ coulomb = { friction = 0.5 } }",
                "{ free = { mass = 0.4, linear = [0.0, 0.0, -0.5], angular = [0.0, 1.0, 0.0] } }",
            ),
        ])
    };
    let (mut on_device, mut on_cpu) = (gpu(&with_speed(0.4)), cpu(&with_speed(0.4)));
    let impulse = |sim: &mut Simulation| {
        let mut sums = [[0.0; 3]; 2];
        for _ in 0..100 {
            let dt = sim.step().unwrap_or_else(|e| panic!("{e}")).dt;
            for (sum, wrench) in sums.iter_mut().zip(sim.wrenches()) {
                (0..3).for_each(|d| sum[d] += wrench.force[d] * dt);
            }
        }
        sums
    };
    for (g, c) in impulse(&mut on_device).into_iter().zip(impulse(&mut on_cpu)) {
        println!("impulse: {g:?} and {c:?} N s");
        within("impulse, relative", off(g, c) / norm(c), 1e-3);
    }
    let (at, there) = (on_device.bodies()[2].position, on_cpu.bodies()[2].position);
    within("place of the cube, in cells", off(at, there) / 0.02, 1e-3);
    within("distance of particles, in cells", apart(&rows(&on_device), &rows(&on_cpu)) / 0.02, 5e-3);
    // Nodes are gathered for a law on the host.
    assert_eq!([passes_of(&on_device, "gather"), passes_of(&on_device, "answering bodies")], [0, 100]);

    let scenes: Vec<Scene> = [0.4, -0.3].map(|speed| scene(&with_speed(speed))).into();
    let mut worlds = Worlds::new(&barchan::registry(), scenes, &on_gpu()).unwrap();
    worlds.steps(40).into_iter().for_each(|reports| assert_eq!(reports.unwrap().len(), 40));
    let ends: Vec<String> = worlds.iter().map(left).collect();
    for (speed, end) in [0.4, -0.3].into_iter().zip(ends) {
        let mut alone = gpu(&with_speed(speed));
        take(&mut alone, 40);
        assert!(end == left(&alone), "a world is not itself alone");
    }
}

/// A blade whose law runs on the device: many steps at once feel what single ones feel, and what the CPU feels.
#[test]
fn driven_tools_feel_the_same_in_many_steps_at_once() {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let frames = "{ keyframes = { frames = [{ time = 0.0, position = [0.1, 0.12, 0.12] }, \
                  { time = 0.05, position = [0.12, 0.12, 0.1], rotation = [0.98, 0.0, 0.2, 0.0] }] } }";
    let toml = Head::cells(0.02, [20, 12, 16], walls).time("step = 2.5e-4").with(&[
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [0.4, 0.24, 0.1], ""),
        tool("blade", [0.1, 0.12, 0.12], &half([0.02, 0.06, 0.06]), "{ coulomb = { friction = 0.3 } }", frames),
        tool(
            "rod",
            [0.3, 0.12, 0.13],
            "capsule = { radius = 0.03, half_height = 0.04 }",
            "\"slip\"",
            &driven([0.0, 0.2, -0.6]),
        ),
        tool(
            "drum",
            [0.2, 0.06, 0.11],
            "cylinder = { radius = 0.03, half_height = 0.03 }",
            "\"stick\"",
            &driven([0.0, 0.0, -0.3]),
        ),
    ]);
    let impulses = |sim: &mut Simulation, at_once: usize| {
        let (mut sum, mut taken) = ([[0.0; 6]; 3], 0);
        while taken < 160 {
            for report in sim.steps(at_once.min(160 - taken), f64::INFINITY).unwrap_or_else(|e| panic!("{e}")) {
                let wrenches = report.wrenches.unwrap_or_else(|| sim.wrenches());
                for (sum, w) in sum.iter_mut().zip(wrenches) {
                    sum.iter_mut().zip(w.force.iter().chain(&w.torque)).for_each(|(s, x)| *s += x * report.dt);
                }
                taken += 1;
            }
        }
        sum
    };
    let (mut many, mut single, mut cpu) = (gpu(&toml), gpu(&toml), cpu(&toml));
    let (m, s, c) = (impulses(&mut many, 64), impulses(&mut single, 1), impulses(&mut cpu, 1));
    for (i, name) in ["blade", "rod", "drum"].into_iter().enumerate() {
        for (what, part, scale) in
            [("impulse", 0..3, norm(&c[i][..3])), ("angular impulse", 3..6, 0.05 * norm(&c[i][..3]))]
        {
            let off = part.clone().map(|d| (m[i][d] - c[i][d]).powi(2)).sum::<f64>().sqrt();
            within(&format!("{what} on the {name}, relative"), off / scale, 5e-3);
            let off = part.map(|d| (m[i][d] - s[i][d]).powi(2)).sum::<f64>().sqrt();
            within(&format!("{what} on the {name}, many steps against single ones"), off / scale, 1e-3);
        }
    }
    within(
        "place of the blade [m]",
        norm(std::array::from_fn::<f64, 3, _>(|d| many.bodies()[0].position[d] - cpu.bodies()[0].position[d])),
        1e-9,
    );
}
