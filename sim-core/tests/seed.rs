//! Seeding: counts, places, volumes, and what is refused.
#![allow(clippy::result_large_err, reason = "see the crate's own allowance")]

mod common;

use barchan_core::solid::Solid;
use barchan_core::{Error, Options, ParticleList, Plan, Precision, Result, Scene, Vec3};
use std::sync::Arc;

/// A world of 2 x 2 x 1 m with 4 cm cells, particles 2 cm apart, and one body.
fn scene(body: &str) -> Scene {
    let text = format!(
        "name = 'seed'
        world = {{ cell = 0.04, min = [-1, -1, 0], max = [1, 1, 1] }}
        time = {{ end = 1 }}
        material = [{{ name = 'm', law = 'elastic', density = 1000 }}]
        [[body]]
        material = 'm'
        {body}"
    );
    Scene::from_str(&text, "seed.toml", "").unwrap()
}

fn particles_of(scene: &Scene, options: &Options) -> Result<ParticleList> {
    let (plan, mut state, _) = Plan::assemble(&common::registry(), scene, options)?;
    assert_eq!(plan.particle_count, state.lists[0].len());
    Ok(state.lists.remove(0))
}

fn particles(body: &str) -> ParticleList {
    particles_of(&scene(body), &Options::default()).unwrap()
}

fn center(list: &ParticleList) -> Vec3 {
    std::array::from_fn(|d| (0..list.len()).map(|i| list.position(i)[d]).sum::<f64>() / list.len() as f64)
}

#[test]
fn a_box_holds_a_whole_number_of_spacings_a_side() {
    let list = particles("shape = { box = { min = [-0.5, -0.5, 0.0], max = [0.5, 0.5, 0.2] } }");
    assert_eq!(list.len(), 50 * 50 * 10);
    let first = list.position(0);
    for d in 0..3 {
        assert!((first[d] - [-0.49, -0.49, 0.01][d]).abs() < 1e-12, "{first:?}");
    }
    // Total volume is that of the box to rounding of f32, and mass is density times it.
    let volume: f64 = list.volume0.iter().sum();
    assert!((volume / 0.2 - 1.0).abs() < 1e-6, "{volume}");
    assert!((list.mass.iter().sum::<f64>() / 200.0 - 1.0).abs() < 1e-6);
    assert_eq!(list.id, (0..25_000).collect::<Vec<_>>());
    assert!(list.strain[0].iter().all(|x| *x == 1.0) && list.strain[3].iter().all(|x| *x == 0.0));
    assert!(list.state[0].iter().all(|x| *x == f64::from(0.1_f32)), "values are those of an f32 run");
}

/// A body that neither walls nor its strength hold stands in layers that are moved along the axes on which it is free; one of other ground, or of the whole world, on a lattice.
#[test]
fn what_flows_apart_is_staggered_along_its_free_axes() {
    let places = |gravity: &str, parameters: &str, min: Vec3, max: Vec3, more: &str| {
        let text = format!(
            "name = 'seed'
            gravity = [0, 0, {gravity}]
            world = {{ cell = 0.04, min = [0, 0, 0], max = [1, 1, 1] }}
            time = {{ end = 1 }}
            material = [{{ name = 'm', law = 'elastic', density = 1000, parameters = {parameters} }}]
            [[body]]
            material = 'm'
            shape = {{ box = {{ min = {min:?}, max = {max:?} }} }}
            {more}"
        );
        let scene = Scene::from_str(&text, "seed.toml", "").unwrap();
        let list = particles_of(&scene, &Options { precision: Precision::F64, ..Options::default() }).unwrap();
        let volume: f64 = list.volume0.iter().sum();
        let whole: f64 = (0..3).map(|d| max[d] - min[d]).product();
        assert!((volume / whole - 1.0).abs() < 1e-9, "{volume} of {whole}");
        assert!((0..3).all(|d| (center(&list)[d] - 0.5 * (min[d] + max[d])).abs() < 1e-9), "{:?}", center(&list));
        // How far particles are from lattice points, at most, along each axis, in spacings.
        let off = |d: usize| {
            let along = |i: usize| (list.position(i)[d] / 0.02 - 0.5).fract().abs();
            (0..list.len()).map(|i| along(i).min(1.0 - along(i))).fold(0.0, f64::max) > 0.1
        };
        (0..list.len()).for_each(|i| assert!((0..3).all(|d| (min[d]..max[d]).contains(&list.position(i)[d]))));
        [off(0), off(1), off(2)]
    };
    let [sand, rock, fluid] = ["{ strength = 0 }", "{}", "{ strength = 0, friction_angle = 0 }"];
    let (low, high) = ([0.4, 0.4, 0.0], [0.6, 0.6, 0.2]);
    assert_eq!(places("-9.81", sand, low, high, ""), [true, true, false]);
    assert_eq!(places("-9.81", sand, [0.4, 0.0, 0.0], [0.6, 1.0, 0.22], ""), [true, false, false]);
    assert_eq!(places("-9.81", sand, [0.0; 3], [1.0, 1.0, 0.2], ""), [false; 3]);
    assert_eq!(places("0", sand, low, high, ""), [false; 3]);
    assert_eq!(places("-9.81", rock, low, high, ""), [false; 3]);
    assert_eq!(places("-9.81", sand, low, high, "sampling = 'lattice'"), [false; 3]);
    assert_eq!(places("-9.81", rock, low, high, "sampling = 'stagger'"), [true, true, false]);
    // Of a low body only the edges flow.
    assert_eq!(places("-9.81", sand, [0.1, 0.1, 0.0], [0.9, 0.9, 0.08], ""), [false; 3]);
    // A fluid flows however low it is, and so does what hangs.
    assert_eq!(places("-9.81", fluid, [0.1, 0.1, 0.0], [0.9, 0.9, 0.08], ""), [true, true, false]);
    assert_eq!(places("-9.81", sand, [0.0, 0.0, 0.6], [1.0, 1.0, 1.0], ""), [true, true, false]);
    // What a tank holds stays in balance on a lattice, until something stirs it; sand does not flow there.
    let drain = "[[sink]]\nshape = { box = { min = [0, 0, -0.2], max = [0.2, 0.2, 0] } }";
    let blade = "[[tool]]\nname = 'blade'\nposition = [0.5, 0.5, 0.6]\nshape = { sphere = { radius = 0.1 } }\nmotion = { velocity = {} }";
    let tank = [1.0, 1.0, 0.2];
    assert_eq!(places("-9.81", fluid, [0.0; 3], tank, ""), [false; 3]);
    for stirred in [drain, blade, "velocity = [0.1, 0, 0]"] {
        assert_eq!(places("-9.81", fluid, [0.0; 3], tank, stirred), [true, true, false], "{stirred}");
        assert_eq!(places("-9.81", sand, [0.0; 3], tank, stirred), [false; 3], "{stirred}");
    }
    let still = blade.replace("{ velocity = {} }", "'fixed'");
    assert_eq!(places("-9.81", fluid, [0.0; 3], tank, &still), [false; 3]);
}

/// Where sides are no whole spacings, points stand nearer to the faces, and none is moved out: as many stay as on a lattice.
#[test]
fn what_is_staggered_stays_in_its_body() {
    let count = |sampling: &str, more: &str| {
        let shape =
            format!("shape = {{ box = {{ min = [0, 0, 0], max = [0.112, 0.095, 0.2] }} }}\nsampling = '{sampling}'");
        let mut scene = scene(&shape);
        scene.set(&[more]).unwrap();
        let (_, state, _) = Plan::assemble(&common::registry(), &scene, &Options::default()).unwrap();
        let mass: f64 = state.lists.iter().flat_map(|list| &list.mass).sum();
        (state.lists.iter().map(ParticleList::len).sum::<usize>(), (1e6 * mass).round())
    };
    for more in ["seed=3", "levels.count=2"] {
        assert_eq!(count("stagger", more), count("lattice", more), "{more}");
    }
}

/// Pictures have to show where bodies get that flow apart or fly, and of others no more than they are.
#[test]
fn it_is_known_how_far_bodies_get() {
    let reaches = |sets: &[&str]| {
        let mut scene = scene("shape = { box = { min = [-0.1, -0.1, 0.0], max = [0.1, 0.1, 0.2] } }");
        scene.set(sets).unwrap();
        Plan::assemble(&common::registry(), &scene, &Options::default()).unwrap().0.reaches
    };
    assert!(reaches(&[]).is_empty(), "a rock stays");
    // A layer one particle thick has a radius of (0.2² · 0.2 / 0.02 / π)^½ = 0.357 m.
    let fluid = reaches(&["material[0].parameters={ strength = 0, friction_angle = 0 }"])[0];
    assert!((fluid.max[0] - 0.357).abs() < 0.01 && fluid.max[2] == 0.2, "{fluid:?}");
    let brief = reaches(&["material[0].parameters={ strength = 0, friction_angle = 0 }", "time.end=0.01"])[0];
    // As grains do, at least: by 1.6 (0.2 · 0.1)^½ m.
    assert!((brief.max[1] - 0.1 - 0.226).abs() < 1e-3, "{brief:?}");
    // Thrown up at 2 m/s, it is in the air for 2 v/g = 0.41 s, and gets to v²/2g = 0.2 m above where it was.
    let flies = reaches(&["body[0].velocity=[1, 0, 2]"])[0];
    assert!((flies.max[0] - 0.1 - 0.408).abs() < 1e-3 && (flies.max[2] - 0.2 - 0.204).abs() < 1e-3, "{flies:?}");
    assert_eq!(flies.min[0], -0.1);
}

#[test]
fn the_lattice_is_centred_where_sides_are_no_whole_spacings() {
    let list = particles("shape = { box = { min = [0, 0, 0], max = [0.105, 0.1, 0.1] } }");
    assert_eq!(list.len(), 5 * 5 * 5);
    assert!((center(&list)[0] - 0.0525).abs() < 1e-9);
}

#[test]
fn offsets_are_exact_in_fixed_point_and_faces_belong_to_the_upper_cell() {
    // Spacing and corner put every second particle on a face between cells.
    let scene = scene("spacing = 0.02\nshape = { box = { min = [-0.01, 0.03, 0.01], max = [0.07, 0.11, 0.09] } }");
    for precision in [Precision::F32, Precision::F64] {
        let list = particles_of(&scene, &Options { precision, ..Options::default() }).unwrap();
        assert_eq!(list.len(), 4 * 4 * 4);
        assert!(list.offset.as_flattened().iter().all(|offset| *offset == 0.0 || *offset == 0.5));
        let cells: Vec<_> = list.cell.iter().step_by(16).map(|cell| cell[0]).collect();
        assert_eq!(cells, [0, 0, 1, 1]);
    }
    // What is no multiple of a fixed-point step is rounded to one in f32, and kept in f64.
    let third = particles("spacing = 0.0133333\nshape = { box = { min = [0, 0, 0], max = [0.4, 0.4, 0.4] } }");
    assert!(third.offset.as_flattened().iter().all(|offset| (offset * 2_f64.powi(32)).fract() == 0.0));
}

#[test]
fn far_from_the_origin_the_offsets_are_the_same_bits() {
    let near = scene("sampling = 'jitter'\nshape = { box = { min = [0, 0.04, 0.2], max = [0.4, 0.4, 0.4] } }");
    let mut far = near.clone();
    far.set(&[
        // 10 km is 250 000 cells.
        "world.min=[9999, 9999, 0]",
        "world.max=[10001, 10001, 1]",
        "body[0].shape.box.min=[10000, 10000.04, 0.2]",
        "body[0].shape.box.max=[10000.4, 10000.4, 0.4]",
    ])
    .unwrap();
    let [near, far] = [near, far].map(|scene| particles_of(&scene, &Options::default()).unwrap());
    assert_eq!(near.offset, far.offset);
    assert!(near.cell.iter().zip(&far.cell).all(|(a, b)| [a[0] + 250_000, a[1] + 250_000, a[2]] == *b));
}

#[test]
fn round_shapes_hold_their_volume() {
    let tau = std::f64::consts::TAU;
    for (shape, volume) in [
        ("sphere = { center = [0, 0, 0.5], radius = 0.3 }", tau * 2.0 / 3.0 * 0.027),
        ("cylinder = { center = [0, 0, 0.5], radius = 0.3, half_height = 0.2 }", tau / 2.0 * 0.09 * 0.4),
        (
            "capsule = { center = [0, 0, 0.5], radius = 0.2, half_height = 0.2 }",
            tau * 2.0 / 3.0 * 0.008 + tau / 2.0 * 0.04 * 0.4,
        ),
        (
            // A wedge, 0 to 0.4 m high.
            "height_field = { min = [0, 0], max = [0.8, 0.8], bottom = 0, heights = [[0, 0.2, 0.4], [0, 0.2, 0.4]] }",
            0.8 * 0.8 * 0.2,
        ),
    ] {
        let list = particles(&format!("shape = {{ {shape} }}"));
        let seeded: f64 = list.volume0.iter().sum();
        assert!((seeded / volume - 1.0).abs() < 0.02, "{shape}: {seeded} for {volume}");
        let least = (0..list.len()).map(|i| list.position(i)[2]).fold(f64::INFINITY, f64::min);
        if shape.starts_with("height_field") {
            assert!((least - 0.01).abs() < 1e-9, "a height field stands on its bottom: {least}");
        } else {
            assert!((0..3).all(|d| (center(&list)[d] - [0.0, 0.0, 0.5][d]).abs() < 1e-9), "{shape}");
        }
    }
}

#[test]
fn heights_come_from_a_file_and_its_faults_have_lines() {
    let folder = tempfile::tempdir().unwrap();
    let mut scene = scene("shape = { height_field = { min = [0, 0], max = [0.8, 0.8], bottom = 0, file = 'h.csv' } }");
    scene.folder = folder.path().to_owned();
    let seed = |text: &str| {
        std::fs::write(folder.path().join("h.csv"), text).unwrap();
        particles_of(&scene, &Options::default())
    };
    assert_eq!(seed("# rows along y\n0.2, 0.2\n\n0.2; 0.2 # flat\n").unwrap().len(), 40 * 40 * 10);
    let error = seed("0.2, 0.2\n0.2, high\n").unwrap_err().to_string();
    assert!(error.contains("h.csv:2: heights: `high` is no number"), "{error}");
    let error = seed("0.2, 0.2\n0.2\n").unwrap_err().to_string();
    assert!(error.contains("body[0].shape.height_field.file[1]: has 1 heights, the first row 2"), "{error}");
    let error = seed("2, 2\n2, 2\n").unwrap_err().to_string();
    assert!(error.contains("reaches out of the world: z from 0 to 2"), "{error}");
    std::fs::remove_file(folder.path().join("h.csv")).unwrap();
    let error = particles_of(&scene, &Options::default()).unwrap_err().to_string();
    assert!(error.contains("h.csv: reading heights: No such file"), "{error}");
}

#[test]
fn jitter_is_the_seeds_alone_and_stays_in_its_lattice_cell() {
    let shape = "shape = { box = { min = [0, 0, 0], max = [0.4, 0.4, 0.4] } }";
    let body = format!("sampling = 'jitter'\n{shape}");
    let (lattice, jitter) = (particles(shape), particles(&body));
    assert_eq!(lattice.len(), jitter.len());
    assert_eq!(jitter, particles(&body), "the same seed gives the same bits");
    let mut mean = [0.0; 3];
    for i in 0..lattice.len() {
        for (d, mean) in mean.iter_mut().enumerate() {
            let moved = (jitter.position(i)[d] - lattice.position(i)[d]) / 0.02;
            assert!(moved.abs() <= 0.5 + 1e-9, "{moved}");
            *mean += moved / lattice.len() as f64;
        }
    }
    // Uniform in ±0.5: the mean of 8000 has a standard deviation of 0.0032.
    assert!(mean.iter().all(|m| m.abs() < 0.015), "{mean:?}");
    let mut other = scene(&body);
    other.seed = 1;
    assert_ne!(jitter.offset, particles_of(&other, &Options::default()).unwrap().offset);
}

#[test]
fn a_turning_body_moves_about_its_centre_of_mass() {
    let list = particles(
        "velocity = [1, 0, 0]\nangular_velocity = [0, 0, 2]\nshape = { box = { min = [0.2, 0.2, 0.2], max = [0.4, 0.4, 0.4] } }",
    );
    assert_eq!(list.affine[0], [0.0, -2.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    for i in 0..list.len() {
        let x = list.position(i);
        let expected = [1.0 - 2.0 * (x[1] - 0.3), 2.0 * (x[0] - 0.3), 0.0];
        for (v, expected) in list.velocity[i].iter().zip(expected) {
            assert!((v - expected).abs() < 1e-6);
            assert_eq!(*v, f64::from(*v as f32));
        }
    }
}

#[test]
fn particles_inside_tools_are_left_out() {
    let mut scene = scene(
        "shape = { box = { min = [0, 0, 0], max = [0.4, 0.4, 0.4] } }\n[[tool]]\nname = 't'\nshape = { box = { half = [0.1, 0.1, 0.1] } }\nposition = [0.2, 0.2, 0.4]",
    );
    assert_eq!(particles_of(&scene, &Options::default()).unwrap().len(), 20 * 20 * 20 - 10 * 10 * 5);
    scene.set(&["body[0].around_tools=false"]).unwrap();
    assert_eq!(particles_of(&scene, &Options::default()).unwrap().len(), 20 * 20 * 20);
    scene.set(&["body[0].around_tools=true", "tool.t.shape.box.half=[1, 1, 1]"]).unwrap();
    let error = particles_of(&scene, &Options::default()).unwrap_err().to_string();
    assert!(error.contains("body[0]: body has no particles: all 8000 are inside tools"), "{error}");
}

#[test]
fn bodies_without_particles_are_refused_by_name() {
    for (shape, why) in [
        ("box = { min = [0, 0, 0], max = [0.4, 0.4, 0.005] }", "its least side, 0.005 m, is below half the spacing"),
        ("sphere = { center = [0, 0, 0.5], radius = 0.004 }", "its least side, 0.008 m, is below half the spacing"),
        // Two points a side, whose corner is 0.87 spacings from the centre.
        ("sphere = { center = [0, 0, 0.5], radius = 0.016 }", "no point of a lattice of 0.02 m lies inside"),
    ] {
        let scene = scene(&format!("name = 'crumb'\nshape = {{ {shape} }}"));
        let error = particles_of(&scene, &Options::default()).unwrap_err().to_string();
        assert!(error.contains("body[0]: body 'crumb' has no particles") && error.contains(why), "{error}");
        assert!(error.starts_with("seed.toml:"), "{error}");
    }
}

#[test]
fn a_cap_on_memory_is_an_error_that_says_how_much() {
    let scene = scene("shape = { box = { min = [-1, -1, 0], max = [1, 1, 1] } }");
    let error = particles_of(&scene, &Options { max_bytes: Some(1 << 20), ..Options::default() }).unwrap_err();
    let Error::Capacity { asked, cap, .. } = error else { panic!("{error}") };
    assert!(asked > 500_000 * 200 && asked < 500_000 * 500 && cap == 1 << 20, "{asked}");
    // A number that no memory could hold is refused too, not multiplied around.
    let mut vast = scene;
    vast.set(&["world.cell=1e-6"]).unwrap();
    assert!(matches!(particles_of(&vast, &Options::default()), Err(Error::Capacity { .. })));
}

#[test]
fn meshes_need_a_reader_and_are_turned_scaled_and_moved() {
    struct Slab;
    impl Solid for Slab {
        fn bounds(&self) -> barchan_core::coupling::Aabb {
            barchan_core::coupling::Aabb { min: [0.0; 3], max: [0.4, 0.2, 0.1] }
        }
        fn contains(&self, x: Vec3) -> bool {
            self.bounds().contains(x)
        }
    }
    // A quarter turn about z takes x to y.
    let mut scene =
        scene("shape = { mesh = { file = 'slab.stl', center = [0.5, 0.1, 0.2], rotation = [1, 0, 0, 1] } }");
    // What a run was made from is noted, so the file has to be there.
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("slab.stl"), "a slab").unwrap();
    scene.folder = folder.path().to_owned();
    let error = particles_of(&scene, &Options::default()).unwrap_err().to_string();
    assert!(error.contains("body[0].shape: nothing registered reads meshes"), "{error}");
    let mut registry = common::registry();
    registry.set_mesh_reader(Arc::new(|file, scale| {
        assert!(file.ends_with("slab.stl") && scale == 1.0);
        Ok(Box::new(Slab))
    }));
    let (_, state, _) = Plan::assemble(&registry, &scene, &Options::default()).unwrap();
    let list = &state.lists[0];
    assert_eq!(list.len(), 20 * 10 * 5);
    for (d, expected) in [0.4, 0.3, 0.25].into_iter().enumerate() {
        assert!((center(list)[d] - expected).abs() < 1e-9, "{:?}", center(list));
    }
}

#[test]
fn a_million_particles_take_a_blink() {
    let scene = scene("shape = { box = { min = [-1, -1, 0], max = [1, 1, 1] } }\nspacing = 0.016");
    let start = std::time::Instant::now();
    let list = particles_of(&scene, &Options::default()).unwrap();
    let seconds = start.elapsed().as_secs_f64();
    println!("{} particles in {seconds:.3} s", list.len());
    assert_eq!(list.len(), 125 * 125 * 63);
    // 0.1 s when nothing else runs; the rest is for a busy machine.
    assert!(seconds < 1.5, "{seconds}");
}

/// A block of 0.2 m, 10 particles a side, with a hole of 0.08 m right through; two boxes that overlap; and what they have in common.
#[test]
fn bodies_are_put_together_from_shapes_to_the_particle() {
    let of = |how: &str, a: &str, b: &str| {
        let part = |half: &str| format!("{{ shape = {{ box = {{ half = {half} }} }}, position = [0.0, 0.0, 0.5] }}");
        particles(&format!("shape = {{ {how} = [{}, {}] }}", part(a), part(b))).len()
    };
    assert_eq!(of("difference", "[0.1, 0.1, 0.1]", "[0.04, 0.04, 0.2]"), 10 * 10 * 10 - 4 * 4 * 10);
    assert_eq!(of("union", "[0.1, 0.1, 0.1]", "[0.2, 0.1, 0.02]"), 10 * 10 * 10 + 10 * 10 * 2);
    assert_eq!(of("intersection", "[0.1, 0.1, 0.1]", "[0.2, 0.2, 0.02]"), 10 * 10 * 2);
    // Turned, a part is cut as it stands; on several levels, no cube is cut into that is not whole.
    let turned = "shape = { difference = [{ shape = { sphere = { radius = 0.3 } }, position = [0, 0, 0.5] }, { shape = { box = { half = [1, 1, 0.5] } }, position = [0, 0, 0.5], rotation = [0.7071067811865476, 0, 0.7071067811865476, 0] }] }";
    let error = particles_of(&scene(turned), &Options::default()).unwrap_err().to_string();
    assert!(error.contains("body[0]") && error.contains("no point"), "{error}");
    let fine = scene(
        "shape = { difference = [{ shape = { box = { half = [0.4, 0.4, 0.16] } }, position = [0, 0, 0.4] }, { shape = { sphere = { radius = 0.2 } }, position = [0, 0, 0.4] }] }",
    );
    let one = particles_of(&fine, &Options::default()).unwrap().mass.iter().sum::<f64>();
    let mut levels = fine.clone();
    levels.set(&["levels.count=3"]).unwrap();
    let (plan, state, _) = Plan::assemble(&common::registry(), &levels, &Options::default()).unwrap();
    let all: f64 = state.lists.iter().flat_map(|list| &list.mass).sum();
    assert!((all / one - 1.0).abs() < 1e-6, "{all} kg on three levels, {one} kg on one");
    assert!(plan.particle_count < particles_of(&fine, &Options::default()).unwrap().len());
}

/// Half of a symmetric scene is that scene: its particles are those of the whole on one side of the wall.
#[test]
fn clip_cuts_bodies_at_slip_walls_only() {
    let whole = scene("shape = { sphere = { center = [0, 0, 0.5], radius = 0.3 } }");
    let all = particles_of(&whole, &Options::default()).unwrap();
    let right: Vec<Vec3> = (0..all.len()).map(|i| all.position(i)).filter(|x| x[0] > 0.0).collect();
    let text = |clip: bool, wall: &str| {
        format!(
            "name = 'half'\nclip = {clip}\nworld = {{ cell = 0.04, min = [0, -1, 0], max = [1, 1, 1], walls = {{ x_min = '{wall}' }} }}\ntime = {{ end = 1 }}\nmaterial = [{{ name = 'm', law = 'elastic', density = 1000 }}]\nbody = [{{ material = 'm', shape = {{ sphere = {{ center = [0, 0, 0.5], radius = 0.3 }} }} }}]"
        )
    };
    let read = |clip, wall| Scene::from_str(&text(clip, wall), "half.toml", "");
    let half = particles_of(&read(true, "slip").unwrap(), &Options::default()).unwrap();
    assert_eq!(half.len(), right.len());
    for (i, x) in right.iter().enumerate() {
        let near = (0..3).all(|d| (half.position(i)[d] - x[d]).abs() < 1e-9);
        assert!(near, "{:?} where the whole has {x:?}", half.position(i));
    }
    for (clip, wall) in [(false, "slip"), (true, "stick"), (true, "open")] {
        let error = read(clip, wall).unwrap_err().to_string();
        assert!(error.contains("reaches out of the world"), "{clip} {wall}: {error}");
    }
}

#[test]
fn a_velocity_gradient_is_about_the_middle_and_in_the_affine_matrix() {
    let list = particles(
        "shape = { box = { min = [0, 0, 0], max = [0.2, 0.2, 0.2] } }\nvelocity = [1, 0, 0]\nangular_velocity = [0, 0, 2]\nvelocity_gradient = [0.5, 0, 3, 0, 0, 0, 0, 0, -0.5]",
    );
    for i in 0..list.len() {
        let [x, y, z] = list.position(i).map(|x| x - 0.1);
        let expected = [1.0 + 0.5 * x + 3.0 * z - 2.0 * y, 2.0 * x, -0.5 * z];
        assert!((0..3).all(|d| (list.velocity[i][d] - expected[d]).abs() < 1e-6), "{:?}", list.velocity[i]);
        assert_eq!(list.affine[i], [0.5, -2.0, 3.0, 2.0, 0.0, 0.0, 0.0, 0.0, -0.5]);
    }
}

/// It feels the wall or not as nodes happen to lie. At the wall, a cell before it, and where whole numbers of particles leave little, all is well.
#[test]
fn a_body_that_ends_within_a_cell_of_a_wall_is_warned_of() {
    let warned = |gap: f64| {
        let text = format!(
            "name = 'gap'\nworld = {{ cell = 0.04, min = [0, 0, 0], max = [0.8, 0.8, 0.8], walls = {{ x_min = 'slip', z_min = 'stick' }} }}\ntime = {{ end = 1 }}\nmaterial = [{{ name = 'm', law = 'elastic', density = 1000 }}]\nbody = [{{ material = 'm', shape = {{ box = {{ min = [{gap}, 0.02, 0], max = [{}, 0.42, 0.2] }} }} }}]",
            gap + 0.4
        );
        let scene = Scene::from_str(&text, "gap.toml", "").unwrap();
        scene.warnings().iter().filter(|warning| warning.contains("body[0]") && warning.contains("x_min")).count()
    };
    assert_eq!([0.0, 0.008, 0.02, 0.036, 0.04, 0.1].map(warned), [0, 0, 1, 1, 0, 0]);
}

/// Where bodies overlap, matter would be there twice. Bodies that touch, or stand in a hole of one another, do not.
#[test]
fn bodies_that_overlap_are_warned_of() {
    let warned = |other: &str| {
        let bed = "shape = { box = { min = [-0.5, -0.5, 0.0], max = [0.5, 0.5, 0.2] } }";
        let scene = scene(&format!("{bed}\n[[body]]\nmaterial = 'm'\nshape = {other}"));
        let (plan, ..) = Plan::assemble(&common::registry(), &scene, &Options::default()).unwrap();
        plan.warnings.into_iter().filter(|warning| warning.contains("overlaps")).collect::<Vec<_>>()
    };
    let inside = warned("{ box = { min = [0.1, 0.1, 0.1], max = [0.3, 0.3, 0.4] } }");
    assert_eq!(inside.len(), 1);
    assert!(inside[0].starts_with("body[1]: it overlaps body[0] in about 4.0e-3 m³"), "{inside:?}");
    let round = warned("{ sphere = { center = [0, 0, 0.3], radius = 0.2 } }");
    assert!(round[0].contains("in about 5.2e-3") || round[0].contains("in about 5.3e-3"), "{round:?}");
    assert_eq!(warned("{ box = { min = [0.1, 0.1, 0.2], max = [0.3, 0.3, 0.4] } }"), [""; 0]);
    assert_eq!(warned("{ sphere = { center = [0, 0, 0.41], radius = 0.2 } }"), [""; 0]);
}
