//! Distances, meshes and mass properties.

use crate::{Random, refusal, within};
use barchan_core::scene::Shape;
use barchan_core::solid::Solid;
use barchan_rigid::mass::Filling;
use barchan_rigid::mesh::{MeshSolid, TriangleMesh};
use barchan_rigid::motion::Pose;
use barchan_rigid::sdf::{MeshPart, Part, Primitive, Sdf};
use glam::{DQuat, DVec3};
use std::path::Path;
use std::sync::Arc;

fn shape(text: &str) -> Sdf {
    #[derive(serde::Deserialize)]
    struct Holder {
        shape: Shape,
    }
    let holder: Holder = toml::from_str(&format!("shape = {text}")).unwrap_or_else(|e| panic!("{e}: {text}"));
    Sdf::from_shape(&holder.shape, Path::new("."), "shape").unwrap()
}

const EXACT: [(&str, &str); 6] = [
    ("sphere", "{ sphere = { radius = 0.3, center = [0.1, 0, 0] } }"),
    ("box", "{ box = { half = [0.1, 0.2, 0.3] } }"),
    ("cylinder", "{ cylinder = { radius = 0.2, half_height = 0.3 } }"),
    ("capsule", "{ capsule = { radius = 0.2, half_height = 0.3 } }"),
    ("plane", "{ plane = { point = [0, 0.1, 0], normal = [1, 2, 3] } }"),
    (
        "turned box",
        "{ union = [{ shape = { box = { half = [0.1, 0.2, 0.3] } }, position = [0.1, 0, 0.2], rotation = [0.8, 0.2, -0.4, 0.4] }] }",
    ),
];

/// A corner box of side 0.2 × 0.4 × 0.6, as twelve triangles.
fn box_mesh(half: DVec3) -> Vec<[DVec3; 3]> {
    let corner = |i: usize| half * DVec3::from_array([0, 1, 2].map(|d| if i >> d & 1 == 1 { 1.0 } else { -1.0 }));
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).map(|t| t.map(corner)).collect()
}

fn mesh_sdf(mesh: TriangleMesh) -> Sdf {
    let grid = barchan_rigid::mesh::DistanceGrid::sample(&mesh);
    Sdf::new(vec![Part::new(Primitive::Mesh(Arc::new(MeshPart { mesh, grid })), Pose::IDENTITY)])
}

#[test]
fn distances_have_known_values() {
    // A distance that is off by a factor or a sign shifts every contact: values that can be worked out by hand.
    let cases = [
        (0, [0.1, 0.4, 0.0], 0.1),
        (0, [0.1, 0.0, 0.1], -0.2),
        (1, [0.4, 0.0, 0.0], 0.3),
        (1, [0.4, 0.6, 0.0], 0.5),
        (1, [0.05, 0.1, 0.2], -0.05),
        (2, [0.5, 0.0, 0.7], 0.5),
        (2, [0.0, 0.05, 0.25], -0.05),
        (2, [0.0, 0.15, 0.1], -0.05),
        (3, [0.4, 0.0, 0.1], 0.2),
        (3, [0.0, 0.3, 0.7], 0.3),
        (4, [0.0, 0.1, 14f64.sqrt()], 3.0),
    ];
    let worst = cases.map(|(i, x, expected)| (shape(EXACT[i].1).surface(x.into()).distance - expected).abs());
    within("distance [m]", worst.into_iter().fold(0.0, f64::max), 1e-15);
}

#[test]
fn normals_are_gradients_and_lead_to_the_surface() {
    // A normal that is not the distance's gradient makes friction act along the wrong plane; a distance that is exact has
    // x − φ n on the surface.
    let mut random = Random(1);
    for (name, text) in EXACT {
        let sdf = shape(text);
        let (mut gradient_error, mut foot_error) = (0f64, 0f64);
        for _ in 0..2000 {
            let x = 0.6 * random.vector();
            let surface = sdf.surface(x);
            let normal = surface.normal.unwrap();
            let d = 1e-6;
            let slope =
                |axis: DVec3| (sdf.surface(x + d * axis).distance - sdf.surface(x - d * axis).distance) / (2.0 * d);
            let gradient = DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z));
            // Points whose neighbours belong to another face have no gradient to compare with.
            if (gradient.length() - 1.0).abs() < 1e-5 {
                gradient_error = gradient_error.max((gradient - normal).length());
            }
            foot_error = foot_error.max(sdf.surface(x - surface.distance * normal).distance.abs());
        }
        within(&format!("{name}: normal against differences"), gradient_error, 1e-4);
        within(&format!("{name}: distance left at the foot point [m]"), foot_error, 1e-14);
    }
}

#[test]
fn undefined_normals_are_none() {
    // A made-up direction on the medial axis would throw nodes out sideways.
    for (text, x) in [(EXACT[0].1, [0.1, 0.0, 0.0]), (EXACT[3].1, [0.0, 0.0, 0.1])] {
        let surface = shape(text).surface(x.into());
        assert!(surface.normal.is_none() && surface.distance < 0.0, "{text}: {surface:?}");
    }
}

#[test]
fn union_is_its_nearest_part() {
    // A handle that shadows its blade, or a blade its handle, lets sand through: the union's distance is the smaller one.
    let sdf = shape(
        "{ union = [{ shape = { sphere = { radius = 0.1 } }, position = [0.2, 0, 0] }, { shape = { box = { half = [0.1, 0.1, 0.1] } } }] }",
    );
    let (a, b) =
        (shape("{ sphere = { radius = 0.1, center = [0.2, 0, 0] } }"), shape("{ box = { half = [0.1, 0.1, 0.1] } }"));
    let mut random = Random(2);
    let mut worst = 0f64;
    for _ in 0..1000 {
        let x = 0.4 * random.vector();
        let (u, a, b) = (sdf.surface(x), a.surface(x), b.surface(x));
        let nearest = if a.distance < b.distance { a } else { b };
        worst =
            worst.max((u.distance - nearest.distance).abs() + (u.normal.unwrap() - nearest.normal.unwrap()).length());
    }
    within("union against its parts", worst, 1e-14);
    assert_eq!(sdf.bounds(&Pose::IDENTITY, 0.0).max, [0.1f64.max(0.2 + 0.1), 0.1, 0.1]);
}

#[test]
fn height_field_of_a_plane_is_that_plane() {
    // Sand must rest on a slope as on a plane: heights z = 0.5 x + 0.25 y sampled on a grid, exact distance near the top.
    let rows: Vec<Vec<f64>> = (0..5)
        .map(|j| (0..9).map(|i| 0.5 * (i as f64 * 0.25 - 1.0) + 0.25 * (j as f64 * 0.5 - 1.0)).collect())
        .collect();
    let sdf =
        shape(&format!("{{ height_field = {{ min = [-1, -1], max = [1, 1], bottom = -3, heights = {rows:?} }} }}"));
    let normal = DVec3::new(-0.5, -0.25, 1.0).normalize();
    let mut random = Random(3);
    let mut worst = 0f64;
    for _ in 0..1000 {
        let foot = 0.5 * random.vector();
        let foot = DVec3::new(foot.x, foot.y, 0.5 * foot.x + 0.25 * foot.y);
        let distance = 0.2 * random.number();
        let surface = sdf.surface(foot + distance * normal);
        worst = worst.max((surface.distance - distance).abs() + (surface.normal.unwrap() - normal).length());
    }
    within("height field against plane", worst, 1e-14);
    assert!((sdf.surface(DVec3::new(0.0, 0.0, -2.9)).distance + 0.1).abs() < 1e-14);
    assert!((sdf.surface(DVec3::new(1.2, 0.0, -1.0)).distance - 0.2).abs() < 1e-14);
}

#[test]
fn mesh_box_is_the_analytic_box() {
    // A mesh tool must feel like the primitive of the same shape: 1 % of a cell, with 8 cells along the longest side, away from
    // edges; there the samples round the edge off by up to half their spacing.
    let half = DVec3::new(0.1, 0.2, 0.3);
    let (mesh, exact) = (mesh_sdf(TriangleMesh::new(box_mesh(half)).unwrap()), shape(EXACT[1].1));
    let cell = 0.6 / 8.0;
    let mut random = Random(4);
    let (mut flat, mut turned, mut anywhere) = (0f64, 0f64, 0f64);
    for _ in 0..20000 {
        let x = 0.35 * random.vector();
        let (a, b) = (mesh.surface(x), exact.surface(x));
        let error = (a.distance - b.distance).abs();
        if b.distance < 0.01 {
            anywhere = anywhere.max(error);
        }
        let q = (x.abs() - half).to_array();
        let mut sorted = q;
        sorted.sort_by(f64::total_cmp);
        // Beside one face: the next one is at least two samples further away.
        if b.distance.abs() < cell && sorted[2] - sorted[1] > 0.03 && sorted[1] < -0.02 {
            flat = flat.max(error);
            turned = turned.max((a.normal.unwrap() - b.normal.unwrap()).length());
        }
    }
    within("mesh box beside faces [cells]", flat / cell, 0.01);
    within("its normal", turned, 0.01);
    within("mesh box inside and just outside, edges too [cells]", anywhere / cell, 0.0625);
}

#[test]
fn mesh_distance_far_away_is_extrapolated() {
    // B50: a query outside the sampled box returned garbage in other codes; far away only the box's own size may be off.
    let half = DVec3::new(0.1, 0.2, 0.3);
    let (mesh, exact) = (mesh_sdf(TriangleMesh::new(box_mesh(half)).unwrap()), shape(EXACT[1].1));
    let mut random = Random(5);
    let mut worst = 0f64;
    for _ in 0..1000 {
        let x = random.vector().normalize() * 10.0;
        let (a, b) = (mesh.surface(x), exact.surface(x));
        assert!(a.normal.unwrap().dot(b.normal.unwrap()) > 0.99);
        worst = worst.max((a.distance / b.distance - 1.0).abs());
    }
    within("relative distance error at 10 m", worst, 2e-3);
}

#[test]
fn meshes_that_are_no_solid_are_refused() {
    // What a sweep leaves beside where it began is joined, and a hole is none of that.
    let beside = |by: f64| {
        // Its corners lie between two cells of a millionth of its side.
        let mut corners = box_mesh(DVec3::splat(0.5 + 0.25e-6));
        let x = corners[0][0];
        corners[0][0] = x + DVec3::new(0.0, by, 0.0);
        TriangleMesh::new(corners)
    };
    assert!(beside(7e-18).is_ok() && beside(1e-8).is_ok());
    assert!(beside(1e-3).unwrap_err().what.contains("not closed"));

    // B50: an open or inverted mesh has no inside; a simulation with it would leak or push inwards, so the reason and the edge
    // are told.
    let good = box_mesh(DVec3::ONE);
    let mut open = good.clone();
    open.remove(3);
    let message = TriangleMesh::new(open).unwrap_err();
    assert!(message.what.contains("not closed: the edge [") && message.mend.contains("close the hole"), "{message:?}");
    let inverted = good.iter().map(|&[a, b, c]| [a, c, b]);
    let message = TriangleMesh::new(inverted).unwrap_err();
    assert!(message.what.contains("inside out"), "{message:?}");
    let mut mixed = good.clone();
    mixed[0].swap(0, 1);
    let message = TriangleMesh::new(mixed).unwrap_err();
    assert!(message.what.contains("two triangles run the same way along the edge ["), "{message:?}");
    // In other units than metres it is a size at which products of lengths overflow, or vanish.
    for scale in [1e300, 1e120, 1e-120, 1e-300] {
        let message = TriangleMesh::new(good.iter().map(|t| t.map(|x| scale * x))).unwrap_err();
        assert!(message.what.contains("longest side is") && message.mend.contains("scale"), "{message:?}");
    }
    let mut infinite = good;
    infinite[0][0].x = f64::NAN;
    assert!(TriangleMesh::new(infinite).unwrap_err().what.contains("NaN"));
}

#[test]
fn obj_and_stl_files_become_the_same_solid() {
    // A tool exported from a modeller: either format, quads or triangles, file units scaled to metres.
    let folder = tempfile::tempdir().unwrap();
    let half = DVec3::new(0.5, 1.0, 1.5);
    let (obj, stl) = (folder.path().join("box.obj"), folder.path().join("box.STL"));
    let mut text = String::new();
    for i in 0..8 {
        let x = half * DVec3::from_array([0, 1, 2].map(|d| if i >> d & 1 == 1 { 1.0 } else { -1.0 }));
        text += &format!("v {} {} {}\n", x.x, x.y, x.z);
    }
    text += "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n";
    std::fs::write(&obj, text).unwrap();
    let triangles: Vec<_> = box_mesh(half)
        .iter()
        .map(|t| stl_io::Triangle {
            normal: stl_io::Normal::new([0.0; 3]),
            vertices: t.map(|x| stl_io::Vertex::new(x.as_vec3().to_array())),
        })
        .collect();
    stl_io::write_stl(&mut std::fs::File::create(&stl).unwrap(), triangles.iter()).unwrap();
    for file in [&obj, &stl] {
        let mesh = TriangleMesh::read(file, 0.1).unwrap();
        let filling = Filling::of_mesh(&mesh);
        within(&format!("volume of {}", file.display()), (filling.volume / 0.006 - 1.0).abs(), 1e-7);
        let solid = MeshSolid::new(&mesh);
        assert!(solid.contains([0.0, 0.0, 0.1499]) && !solid.contains([0.0, 0.0, 0.1501]));
        assert!(solid.contains([0.0; 3]) && !solid.contains([0.06, 0.0, 0.0]));
        assert!((solid.bounds().max[2] - 0.15).abs() < 1e-8);
    }
    let negative = TriangleMesh::read(&obj, -1.0).unwrap_err();
    assert!(negative.what.contains("scale is -1"), "{negative:?}");
    let missing = refusal("[[tool]]\nname = 'duck'\nshape = { mesh = { file = 'no-such-duck.obj' } }");
    assert!(missing.contains("tool[0].shape") && missing.contains("no-such-duck.obj"), "{missing}");
    let unknown = TriangleMesh::read(&folder.path().join("box.blend"), 1.0).unwrap_err();
    assert!(unknown.what.contains("none of .obj, .stl and .dae"), "{unknown:?}");
}

#[test]
fn mass_properties_agree_with_sums_over_elements() {
    // A wrong inertia makes a body tumble at the wrong rate. Closed forms against the sum that unions use: the union of a shape
    // with itself is that shape.
    for (name, text) in EXACT.iter().filter(|(name, _)| *name != "plane") {
        let sdf = shape(text);
        let parts = [sdf.parts(), sdf.parts()].concat();
        let (closed, summed) = (Filling::of(&sdf).unwrap(), Filling::of(&Sdf::new(parts)).unwrap());
        within(&format!("{name}: volume"), (summed.volume / closed.volume - 1.0).abs(), 2e-3);
        within(&format!("{name}: centre [m]"), (summed.centre - closed.centre).length(), 1e-4);
        let difference = (summed.inertia - closed.inertia).to_cols_array().iter().fold(0f64, |a, b| a.max(b.abs()));
        within(&format!("{name}: inertia"), difference / closed.inertia.x_axis.x, 4e-3);
    }
}

#[test]
fn mesh_mass_properties_are_exact() {
    // Polyhedral integrals of a box far from the origin against its closed form; cancellation would show here.
    let half = DVec3::new(0.1, 0.2, 0.3);
    let away = DVec3::new(100.0, -50.0, 30.0);
    let mesh = TriangleMesh::new(box_mesh(half).into_iter().map(|t| t.map(|x| x + away))).unwrap();
    let (mesh, exact) = (Filling::of_mesh(&mesh), Filling::of(&shape(EXACT[1].1)).unwrap());
    within("volume", (mesh.volume / exact.volume - 1.0).abs(), 1e-12);
    within("centre [m]", (mesh.centre - away).length(), 1e-12);
    let difference = (mesh.inertia - exact.inertia).to_cols_array().iter().fold(0f64, |a, b| a.max(b.abs()));
    within("inertia", difference / exact.inertia.x_axis.x, 1e-11);
}

#[test]
fn round_meshes_are_round() {
    // A modeller's ball of 10,000 triangles against the analytic ball: what differs is the facets (1.3e-3 of the radius) and the
    // sampling; beyond that, sand would feel bumps. Sampling it takes seconds at most; the bound is wide,
    // since other programs share the machine.
    let (rings, sides, radius) = (50, 100, 0.1);
    let at = |i: usize, j: usize| {
        let (theta, phi) =
            (std::f64::consts::PI * i as f64 / rings as f64, std::f64::consts::TAU * (j % sides) as f64 / sides as f64);
        // At the poles the sine is not zero to the last bit, and all sides must meet in one vertex.
        let sine = if i == 0 || i == rings { 0.0 } else { theta.sin() };
        radius * DVec3::new(sine * phi.cos(), sine * phi.sin(), theta.cos())
    };
    let quads = (0..rings).flat_map(|i| (0..sides).map(move |j| (i, j)));
    let triangles = quads.flat_map(|(i, j)| {
        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
        [[a, b, c], [a, c, d]]
    });
    let start = std::time::Instant::now();
    let mesh = TriangleMesh::new(triangles).unwrap();
    let filling = Filling::of_mesh(&mesh);
    let sdf = mesh_sdf(mesh);
    within("seconds to sample 10,000 triangles", start.elapsed().as_secs_f64(), 60.0);
    within("volume", (filling.volume / (4.0 / 3.0 * std::f64::consts::PI * 1e-3) - 1.0).abs(), 4e-3);
    let mut random = Random(6);
    let (mut distance_error, mut turned) = (0f64, 0f64);
    for _ in 0..5000 {
        let direction = random.vector().normalize();
        // From a good way inside to the border of the sampled box outside.
        let distance = 0.018 * random.number() - 0.012;
        let surface = sdf.surface((radius + distance) * direction);
        distance_error = distance_error.max((surface.distance - distance).abs());
        turned = turned.max((surface.normal.unwrap() - direction).length());
    }
    within("distance [radii]", distance_error / radius, 3e-3);
    within("normal", turned, 0.06);
}

#[test]
fn slivers_do_no_harm() {
    // Exporters leave triangles of no area where a vertex lies on another triangle's edge: the mesh is closed all the same, and
    // the sign of its distance must not depend on a normal that does not exist.
    let half = DVec3::new(0.1, 0.2, 0.3);
    let mut triangles = box_mesh(half);
    let [a, b, c] = triangles.remove(0);
    let middle = 0.5 * (a + b);
    triangles.extend([[a, middle, c], [middle, b, c], [a, b, middle]]);
    let (mesh, exact) = (mesh_sdf(TriangleMesh::new(triangles).unwrap()), shape(EXACT[1].1));
    let mut random = Random(11);
    let mut worst = 0f64;
    for _ in 0..5000 {
        let x = 0.35 * random.vector();
        let (a, b) = (mesh.surface(x).distance, exact.surface(x).distance);
        worst = worst.max(if b < 0.01 { (a - b).abs() } else { 0.0 });
    }
    within("distance [m]", worst, 5e-3);
}

#[test]
fn contact_rounds_edges_and_nothing_else() {
    // An edge that acts in steps lets a slot or a plate jump as it moves over the grid: near the surface the normal turns on a radius of a cell
    // and a half. Rounding only takes away, and faces stay where they are.
    let (cell, edge) = (0.02, 0.03);
    let mut random = Random(12);
    for (name, text) in &EXACT[1..3] {
        let sdf = shape(text);
        let (mut grown, mut moved, mut jump, mut turned, mut taken) = (0f64, 0f64, 0f64, 0f64, 0f64);
        for _ in 0..20_000 {
            let x = 0.4 * random.vector();
            let (sharp, (round, core)) = (sdf.surface(x), sdf.contact_surface(x, cell));
            assert!(!core, "nothing here is thin");
            grown = grown.max(sharp.distance - round.distance);
            // The foot on the sharp surface, and what of the other faces is near it.
            let foot = x - sharp.distance * sharp.normal.unwrap();
            let (others, along) = if *name == "box" {
                let q = (foot.abs() - DVec3::new(0.1, 0.2, 0.3)).to_array();
                let face = (0..3).max_by(|&a, &b| q[a].total_cmp(&q[b])).unwrap();
                ((0..3).filter(|&d| d != face).map(|d| q[d]).fold(f64::NEG_INFINITY, f64::max), sharp.distance.abs())
            } else {
                let q = [foot.x.hypot(foot.y) - 0.2, foot.z.abs() - 0.3];
                (q[0].min(q[1]), sharp.distance.abs())
            };
            if others < -edge && (sharp.distance > 0.0 || along < edge) {
                moved = moved.max((round.distance - sharp.distance).abs());
            } else if sharp.distance.abs() < 1e-3 {
                taken = taken.max(round.distance - sharp.distance);
            }
            let step = 1e-4 * random.vector();
            let (there, _) = sdf.contact_surface(x + step, cell);
            jump = jump.max((there.distance - round.distance).abs() / step.length());
            if round.distance.min(there.distance) > -0.5 * edge {
                turned = turned.max(there.normal.unwrap().distance(round.normal.unwrap()) / step.length());
            }
        }
        within(&format!("{name}: round surface beyond the sharp one [m]"), grown, 1e-14);
        within(&format!("{name}: faces away from edges moved by [m]"), moved, 1e-14);
        within(&format!("{name}: change of distance over a way"), jump, 1.0 + 1e-9);
        within(
            &format!("{name}: turn of the normal over a way [rad per radius at half depth]"),
            turned * 0.5 * edge,
            1.01,
        );
        println!("{name}: rounding takes up to {:.2} cells", taken / cell);
        assert!(taken > 0.2 * cell, "edges are round");
    }
}

/// Symptom: the box around a ball grows by up to three quarters as it turns, and levels follow a foot that only rolls. Physics: a ball's box stays as it is, a capsule's is that of the
/// balls at its ends, and for each radian no end of a box moves further than the shape's swing.
#[test]
fn boxes_of_round_shapes_fit_at_any_rotation() {
    let ends = |sdf: &Sdf, rotation: DQuat| {
        let bounds = sdf.bounds(&Pose { position: DVec3::ZERO, rotation }, 0.0);
        [bounds.min, bounds.max].concat()
    };
    let most = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0f64, |most, (a, b)| most.max((a - b).abs()));
    let ball = shape("{ sphere = { radius = 0.3 } }");
    let capsule = shape("{ capsule = { radius = 0.2, half_height = 0.3 } }");
    let at_ends = [-0.3, 0.3].map(|z| format!("{{ shape = {{ sphere = {{ radius = 0.2, center = [0, 0, {z}] }} }} }}"));
    let balls = shape(&format!("{{ union = [{}] }}", at_ends.join(", ")));
    assert_eq!(ball.swing(), 0.0);
    let mut random = Random(5);
    for _ in 0..100 {
        let [turn, further] = [0, 1].map(|_| 3.0 * random.vector());
        let rotation = DQuat::from_scaled_axis(turn);
        within("a ball's box, turned", most(&ends(&ball, rotation), &ends(&ball, DQuat::IDENTITY)), 1e-15);
        within(
            "a capsule's box, and that of its ends",
            most(&ends(&capsule, rotation), &ends(&balls, rotation)),
            1e-15,
        );
        for (name, text) in EXACT.iter().filter(|(name, _)| *name != "plane") {
            let sdf = shape(text);
            let turned = DQuat::from_scaled_axis(1e-4 * further) * rotation;
            let way = most(&ends(&sdf, rotation), &ends(&sdf, turned));
            within(
                &format!("{name}: way of an end over the swing"),
                way / (sdf.swing() * 1e-4 * further.length()),
                1.0 + 1e-9,
            );
        }
    }
}

/// Symptom: contact asks every part of a shape how far each particle is, most of which are too far from most parts. Physics: being told sooner that a surface is too far away changes
/// nothing of what is within reach.
#[test]
fn what_is_too_far_is_told_sooner_and_nothing_else_is() {
    let shovel = "{ union = [\
        { shape = { box = { half = [0.2, 0.15, 0.02] } }, position = [0, 0, 0], rotation = [0.9, 0.1, -0.3, 0.2] }, \
        { shape = { cylinder = { radius = 0.03, half_height = 0.2 } }, position = [-0.2, 0, 0.2] }, \
        { shape = { capsule = { radius = 0.02, half_height = 0.1 } }, position = [0.2, 0.1, 0.1], rotation = [0.7, 0, 0.7, 0] }, \
        { shape = { sphere = { radius = 0.05 } }, position = [0.1, -0.2, 0] }] }";
    let terrain = "{ height_field = { min = [-0.3, -0.3], max = [0.3, 0.3], bottom = -0.3, heights = [[0.0, 0.3, 0.1], [0.3, -0.1, 0.2], [0.0, 0.1, 0.3]] } }";
    let mut random = Random(13);
    let (mut far, mut all) = (0, 0);
    for text in EXACT.iter().map(|(_, text)| *text).chain([shovel, terrain]) {
        let sdf = shape(text);
        for n in 0..5000 {
            let (x, cell) = (0.5 * random.vector(), if n % 2 == 0 { 0.01 } else { 0.05 });
            let whole = sdf.contact_surface(x, cell);
            for within in [0.0, 0.5 * cell] {
                let told = sdf.contact_surface_within(x, cell, within);
                assert!(told.is_some() || whole.0.distance > within, "{text}: {x} is {:.4} m away", whole.0.distance);
                assert!(told.is_none_or(|told| told == whole || told.0.distance > within), "{text}: {x}");
                (far, all) = (far + usize::from(told.is_none()), all + 1);
            }
        }
    }
    println!("told sooner: {far} of {all}");
    assert!(2 * far > all, "most is told sooner");
}
