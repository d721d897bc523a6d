//! Scene files: every error names file, line and key path, and says what would mend it.
#![allow(clippy::result_large_err, reason = "see the crate's own allowance")]

use barchan_core::scene::{Motion, PictureView, Sampling, Shape, Wall, fits};
use barchan_core::{Error, Scene};
use proptest::prelude::*;

/// A scene with one of everything that is checked. Tests change one line of it.
const SCENE: &str = r#"name = "all"
seed = 7

[world]
cell = 0.02
min = [0.0, 0.0, 0.0]
max = [0.8, 0.4, 0.4]

[world.walls]
x_min = "slip"
x_max = "slip"
y_min = "periodic"
y_max = "periodic"
z_min = { separate = { friction = 0.3 } }

[time]
end = 1.0
step = 1e-4
safety = 0.6

[output]
interval = 0.05
snapshot_interval = 0.5
picture = { pixels = 640, cut_y = 0.2 }

[[material]]
name = "sand"
law = "sand"
density = 1600.0
parameters = { young_modulus = 1e6, friction_angle_deg = 32.0 }

[[material]]
name = "jelly"
law = "neo_hookean"
density = 1000.0

[[body]]
name = "bed"
material = "sand"
spacing = 0.01
shape = { box = { min = [0.0, 0.0, 0.0], max = [0.8, 0.4, 0.2] } }

[[body]]
name = "ball"
material = "jelly"
sampling = "jitter"
shape = { sphere = { center = [0.4, 0.2, 0.3], radius = 0.05 } }

[[body]]
name = "hill"
material = "jelly"
[body.shape.height_field]
min = [0.0, 0.0]
max = [0.2, 0.2]
bottom = 0.2
heights = [[0.2, 0.21],
  [0.22, 0.2]]

[[tool]]
name = "cube"
shape = { box = { half = [0.05, 0.05, 0.05] } }
position = [0.4, 0.2, 0.3]
rotation = [2.0, 0.0, 0.0, 0.0]
contact = { coulomb = { friction = 0.5 } }
motion = { free = { mass = 2.0, restitution = 0.1 } }

[[tool]]
name = "blade"
shape = { union = [ { shape = { capsule = { radius = 0.02, half_height = 0.05 } } } ] }
position = [0.1, 0.2, 0.3]
[tool.motion.keyframes]
frames = [
  { time = 0.0, position = [0.1, 0.2, 0.3] },
  { time = 0.5, position = [0.6, 0.2, 0.3] },
]
"#;

fn read(text: &str) -> Result<Scene, Error> {
    Scene::from_str(text, "all.toml", "")
}

/// Line (from 1) on which `needle` stands.
fn line_of(text: &str, needle: &str) -> usize {
    text[..text.find(needle).expect("the needle is in the scene")].matches('\n').count() + 1
}

#[test]
fn the_whole_scene_is_good_and_its_numbers_arrive() {
    let scene = read(SCENE).unwrap();
    assert_eq!(scene.gravity, [0.0, 0.0, -9.81]);
    assert_eq!(scene.world.walls.z_min, Wall::Separate { friction: 0.3 });
    assert_eq!(scene.body[1].sampling, Sampling::Jitter);
    assert_eq!(scene.tool[0].rotation, [1.0, 0.0, 0.0, 0.0], "quaternions become unit ones");
    assert_eq!(scene.warnings(), Vec::<String>::new());
}

/// (text in the scene, what replaces it, the line's needle after that, key path, part of the message)
const FAULTS: &[(&str, &str, &str, &str, &str)] = &[
    ("seed = 7", "sede = 7", "sede", "sede", "unknown key `sede`; allowed here: name, doc, seed,"),
    ("seed = 7", "sede = 7", "sede", "sede", "did you mean `seed`?"),
    ("seed = 7", "seed = -7", "seed", "seed", "invalid value: integer `-7`"),
    ("seed = 7", "seed = ", "seed", "TOML", ""),
    ("name = \"all\"\n", "", "", "name", "this key is required"),
    ("name = \"all\"", "name = \"\"", "name", "name", "give a word without slashes"),
    ("name = \"all\"", "name = \"a/b\"", "name", "name", "give a word without slashes"),
    ("cell = 0.02", "cell = \"small\"", "cell", "world.cell", "expected a number"),
    ("cell = 0.02", "cell = 0.0", "cell", "world.cell", "must be above 0"),
    ("cell = 0.02", "cell = nan", "cell", "world.cell", "give a finite number"),
    ("cell = 0.02", "cell = 1e-12", "max = [0.8, 0.4, 0.4]", "world.max", "use larger cells"),
    ("cell = 0.02", "cel = 0.02", "cel ", "world.cel", "did you mean `cell`?"),
    ("max = [0.8, 0.4, 0.4]", "max = [0.8, 0.4, -inf]", "-inf", "world.max[2]", "give a finite number"),
    ("max = [0.8, 0.4, 0.4]", "max = [0.8, 0.4]", "max = [0.8, 0.4]", "world.max", "invalid length 2"),
    ("max = [0.8, 0.4, 0.4]", "max = [0.8, -0.4, 0.4]", "-0.4", "world.max", "must be above world.min"),
    ("max = [0.8, 0.4, 0.4]", "max = [0.81, 0.4, 0.4]", "0.81", "world.max", "the nearest are 0.8 and 0.82"),
    ("max = [0.8, 0.4, 0.4]", "max = [0.8, 0.42, 0.4]", "y_min", "world.walls.y_min", "0 and 0.48"),
    ("y_max = \"periodic\"", "y_max = \"slip\"", "y_min", "world.walls.y_min", "make both sides periodic or neither"),
    ("y_min = \"periodic\"", "y_min = \"slip\"", "y_max", "world.walls.y_max", "make both sides periodic or neither"),
    ("x_min = \"slip\"", "x_min = \"slop\"", "slop", "world.walls.x_min", "did you mean `slip`?"),
    ("friction = 0.3", "friction = -0.3", "z_min", "world.walls.z_min.separate.friction", "must be 0 or above"),
    ("end = 1.0", "end = -1.0", "end", "time.end", "must be above 0"),
    ("step = 1e-4", "step = 0.0", "step", "time.step", "must be above 0"),
    ("safety = 0.6", "safety = 1.5", "safety", "time.safety", "at most 1"),
    ("interval = 0.05", "interval = 0.0", "interval", "output.interval", "must be above 0"),
    ("snapshot_interval = 0.5", "snapshot_interval = -1", "snapshot", "output.snapshot_interval", "must be above 0"),
    ("pixels = 640", "pixels = 2", "pixels", "output.picture.pixels", "from 16 to 16384"),
    ("cut_y = 0.2", "cut_y = 2.0", "cut_y", "output.picture.cut_y", "inside the world, from 0 to 0.4"),
    ("cut_y = 0.2", "view = \"side\"", "view", "output.picture.view", "allowed here: top, perspective"),
    (
        "cut_y = 0.2",
        "view = \"top\", camera = {}",
        "camera",
        "output.picture.camera",
        "is given, and output.picture.view is \"top\"",
    ),
    ("cut_y = 0.2", "camera = { fov_deg = 0 }", "fov", "output.picture.camera.fov_deg", "must be from 1 to 150"),
    (
        "cut_y = 0.2",
        "camera = { position = [0, 0, 1], target = [0, 0, 1] }",
        "target",
        "output.picture.camera.target",
        "another place than camera.position",
    ),
    (
        "cut_y = 0.2",
        "camera = { positon = [0, 0, 1] }",
        "positon",
        "output.picture.camera.positon",
        "did you mean `position`?",
    ),
    (
        "cut_y = 0.2",
        "camera = { follow = \"blades\" }",
        "follow",
        "output.picture.camera.follow",
        "no tool or robot of this scene is called 'blades'; known are: cube, blade",
    ),
    ("density = 1600.0", "density = 0.0", "density = 0.0", "material[0].density", "must be above 0"),
    (
        "name = \"jelly\"",
        "name = \"sand\"",
        "name = \"sand\"\nlaw = \"neo",
        "material[1].name",
        "already the name of material[0]",
    ),
    ("name = \"jelly\"", "name = \"\"", "name = \"\"", "material[1].name", "is empty"),
    (
        "name = \"ball\"",
        "name = \"bed\"",
        "name = \"bed\"\nmaterial = \"jelly\"",
        "body[1].name",
        "already the name of body[0]",
    ),
    (
        "name = \"blade\"",
        "name = \"cube\"",
        "name = \"cube\"\nshape = { union",
        "tool[1].name",
        "already the name of tool[0]",
    ),
    ("spacing = 0.01", "spacing = 0.001", "spacing", "body[0].spacing", "must be from 0.2 to 1 cells"),
    ("spacing = 0.01", "spacing = 0.03", "spacing", "body[0].spacing", "must be from 0.2 to 1 cells"),
    ("max = [0.8, 0.4, 0.2]", "max = [0.8, 0.0, 0.2]", "shape = { box = { min", "body[0].shape.box.max", "no volume"),
    (
        "max = [0.8, 0.4, 0.2]",
        "max = [0.8, 0.5, 0.2]",
        "shape = { box = { min",
        "body[0].shape",
        "reaches out of the world: y from 0 to 0.5",
    ),
    (
        "max = [0.8, 0.4, 0.2] }",
        "half = [0.8, 0.4, 0.2] }",
        "shape = { box = { min",
        "body[0].shape.box",
        "give min and max, or half",
    ),
    ("box = { min", "bocks = { min", "bocks", "body[0].shape", "unknown choice `bocks`; allowed here: box, sphere,"),
    ("radius = 0.05 } }", "radius = 0.0 } }", "sphere", "body[1].shape.sphere.radius", "must be above 0"),
    (
        "radius = 0.05 } }",
        "radius = 0.05 }, plane = { normal = [0, 0, 1] } }",
        "sphere",
        "body[1].shape",
        "give exactly one of its choices",
    ),
    (
        "sphere = { center = [0.4, 0.2, 0.3], radius = 0.05 }",
        "plane = { normal = [0, 0, 1] }",
        "plane",
        "body[1].shape",
        "planes are for tools",
    ),
    (
        "sphere = { center = [0.4, 0.2, 0.3], radius = 0.05 }",
        "mesh = { file = \"a.stl\", scale = -1 }",
        "mesh",
        "body[1].shape.mesh.scale",
        "must be above 0",
    ),
    (
        "sphere = { center = [0.4, 0.2, 0.3], radius = 0.05 }",
        "cylinder = { radius = 0.1, half_height = 0 }",
        "cylinder",
        "body[1].shape.cylinder.half_height",
        "must be above 0",
    ),
    ("[0.22, 0.2]]", "[0.22]]", "[0.22]]", "body[2].shape.height_field.heights[1]", "rows must be equally long"),
    ("[0.22, 0.2]]", "[0.22, inf]]", "inf]]", "body[2].shape.height_field.heights[1][1]", "finite"),
    (
        "bottom = 0.2",
        "bottom = 0.3",
        "heights",
        "body[2].shape.height_field.heights",
        "nowhere rises above bottom = 0.3",
    ),
    (
        "bottom = 0.2",
        "bottom = 0.2\nfile = \"a.csv\"",
        "[body.shape.height_field]",
        "body[2].shape.height_field",
        "both or neither",
    ),
    (
        "max = [0.2, 0.2]",
        "max = [0.2, 0.0]",
        "max = [0.2, 0.0]",
        "body[2].shape.height_field.max",
        "max must be above min",
    ),
    ("half = [0.05, 0.05, 0.05]", "half = [0.05, 0.0, 0.05]", "half", "tool[0].shape.box.half", "must be above 0"),
    (
        "half = [0.05, 0.05, 0.05]",
        "half = [0.05, 0.0, 0.05], depth = 1",
        "half",
        "tool[0].shape.box.depth",
        "allowed here: min, max, half, center",
    ),
    (
        "rotation = [2.0, 0.0, 0.0, 0.0]",
        "rotation = [0.0, 0.0, 0.0, 0.0]",
        "rotation",
        "tool[0].rotation",
        "zero quaternion",
    ),
    (
        "position = [0.4, 0.2, 0.3]\nrotation",
        "position = [1.4, 0.2, 0.3]\nrotation",
        "position = [1.4",
        "tool[0].position",
        "tool 'cube' is outside the world",
    ),
    ("friction = 0.5", "friction = -0.5", "coulomb", "tool[0].contact.coulomb.friction", "must be 0 or above"),
    ("mass = 2.0", "mass = 0.0", "mass", "tool[0].motion.free.mass", "must be above 0"),
    ("restitution = 0.1", "restitution = 1.1", "restitution", "tool[0].motion.free.restitution", "from 0 to 1"),
    (
        "{ box = { half = [0.05, 0.05, 0.05] } }",
        "{ plane = { normal = [0, 0, 0] } }",
        "plane",
        "tool[0].shape.plane.normal",
        "direction out of the solid",
    ),
    (
        "{ box = { half = [0.05, 0.05, 0.05] } }",
        "{ plane = { normal = [0, 0, 1] } }",
        "mass",
        "tool[0].motion.free",
        "cannot move freely",
    ),
    ("radius = 0.02", "radius = -0.02", "union", "tool[1].shape.union[0].shape.capsule.radius", "must be above 0"),
    ("time = 0.5", "time = 0.0", "[0.6, 0.2, 0.3]", "tool[1].motion.keyframes.frames[1].time", "times must rise"),
    ("time = 0.5,", "", "[0.6, 0.2, 0.3]", "tool[1].motion.keyframes.frames[1].time", "this key is required"),
    (
        "position = [0.6, 0.2, 0.3]",
        "position = [0.6, 0.2, 0.3], rotation = [0, 0, 0, 0]",
        "[0.6, 0.2",
        "tool[1].motion.keyframes.frames[1].rotation",
        "zero quaternion",
    ),
];

#[test]
fn every_fault_names_line_and_key_path() {
    let mut wrong = Vec::new();
    for (from, to, needle, path, message) in FAULTS {
        assert!(SCENE.contains(from), "{from}");
        let text = SCENE.replacen(from, to, 1);
        let line = if needle.is_empty() { String::new() } else { format!(":{}", line_of(&text, needle)) };
        let error = read(&text).expect_err(to).to_string();
        if !error.starts_with(&format!("all.toml{line}: {path}: ")) || !error.contains(message) {
            wrong.push(format!("{to}\n  gave     {error}\n  expected all.toml{line}: {path}: … {message} …"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn a_tool_that_never_reaches_the_world_is_refused() {
    let mut scene = read(SCENE).unwrap();
    scene.set(&["tool.blade.motion.keyframes.frames[1].position=[9, 9, 9]"]).unwrap();
    let error = scene.set(&["tool.blade.motion.keyframes.frames[0].position=[9, 9, 9]"]).unwrap_err().to_string();
    assert!(error.contains("tool[1].motion.keyframes.frames: tool 'blade' is outside the world"), "{error}");
}

#[test]
fn an_unknown_material_lists_those_of_the_scene() {
    let error = read(&SCENE.replacen("material = \"sand\"", "material = \"snad\"", 1)).unwrap_err();
    let line = line_of(SCENE, "material = \"sand\"");
    assert_eq!(
        error.to_string(),
        format!(
            "all.toml:{line}: body[0].material: no material of this scene is called 'snad'; known are: sand, jelly"
        )
    );
}

#[test]
fn open_sides_may_lie_anywhere() {
    let scene = read(&SCENE.replacen("max = [0.8, 0.4, 0.4]", "max = [0.8, 0.4, 0.413]", 1)).unwrap();
    assert_eq!(scene.world.max[2], 0.413);
}

#[test]
fn overrides_reach_by_index_and_by_name_before_anything_is_checked() {
    let mut scene = read(SCENE).unwrap();
    scene
        .set(&[
            "world.cell=0.025",
            "body[0].spacing = 0.0125",
            "tool.cube.motion.free.mass=5",
            "tool.blade.motion=\"fixed\"",
            "material[0].parameters.friction_angle_deg=30",
            "output.picture.on=false",
            "time.over_bound=substep",
            "output.export=npz",
            "gravity=[0, 0, -1.62]",
        ])
        .unwrap();
    assert_eq!(scene.world.cell, 0.025);
    assert_eq!(scene.gravity, [0.0, 0.0, -1.62]);
    assert!(matches!(scene.tool[0].motion, Motion::Free { mass: 5.0, .. }));
    assert!(matches!(scene.tool[1].motion, Motion::Fixed));
    assert_eq!(scene.material[0].parameters["friction_angle_deg"], 30.0);
    assert!(!scene.output.picture.on && scene.output.picture.pixels == 640);

    // A word makes room for a choice with keys, and a key that was absent is made.
    scene.set(&["tool.blade.motion.free.mass=1", "world.walls.x_min.separate.friction=0.2"]).unwrap();
    assert!(matches!(scene.tool[1].motion, Motion::Free { mass: 1.0, .. }));
    assert_eq!(scene.world.walls.x_min, Wall::Separate { friction: 0.2 });
}

/// An angle in radians takes the place of the same in degrees, and the other way round: of two overrides the last counts.
#[test]
fn an_override_of_an_angle_replaces_its_other_form() {
    let friction = |sets: &[&str]| {
        let mut scene = read(SCENE).unwrap();
        let all: Vec<String> = sets.iter().map(|set| format!("material[0].parameters.{set}")).collect();
        scene.set(&all).unwrap();
        let given = |key: &str| scene.material[0].parameters.get(key).copied();
        [given("friction_angle"), given("friction_angle_deg")]
    };
    assert_eq!(friction(&["friction_angle=0.4"]), [Some(0.4), None]);
    assert_eq!(friction(&["friction_angle=0.4", "friction_angle_deg=30.0"]), [None, Some(30.0)]);
}

#[test]
fn overrides_that_lead_nowhere_are_refused_and_change_nothing() {
    for (text, path, message) in [
        ("world.cell", "world.cell", "has no `=`"),
        ("world.cell=", "world.cell", "is no TOML value"),
        ("world.cell=]", "world.cell", "is no TOML value"),
        ("world..cell=1", "world..cell", "is no key"),
        (
            "tool.knife.position=[0,0,0]",
            "tool.knife.position",
            "write tool[0].position=[0,0,0], or name one of cube, blade",
        ),
        (
            "body[9].spacing=0.01",
            "body[9].spacing",
            "`body` is a list of 3, and none is `[9]`; write body[0].spacing=0.01",
        ),
        ("body.1.spacing=0.01", "body.1.spacing", "write body[1].spacing=0.01"),
        ("body.spacing=0.01", "body.spacing", "write body[0].spacing=0.01"),
        ("bdoy[1].spacing=0.01", "bdoy[1].spacing", "write body[1].spacing=0.01"),
        ("body[x].spacing=0.01", "body[x].spacing", "is no key"),
        ("world[0]=1", "world[0]", "`world` is no list"),
        ("world.cell=-1", "world.cell", "must be above 0"),
        ("world.sell=1", "world.sell", "did you mean `cell`?"),
        ("body[1].shape.sphere.radius=wide", "body[1].shape.sphere.radius", "expected a number"),
    ] {
        let mut scene = read(SCENE).unwrap();
        let error = scene.set(&[text]).expect_err(text);
        let Error::Scene { file, line, path: found, .. } = &error else { panic!("{text}: {error}") };
        assert_eq!((file.as_str(), *line, found.as_str()), ("--set", 0, path), "{text}: {error}");
        assert!(error.to_string().contains(message), "{text}: {error}");
        assert_eq!(scene.to_toml().unwrap(), read(SCENE).unwrap().to_toml().unwrap());
    }
}

#[test]
fn errors_elsewhere_keep_their_line_after_an_override() {
    // The cell of 0.03 puts the world's side, which stands in the file, off the cells' faces.
    let error = Scene::from_str_with(SCENE, "all.toml", "", &["world.cell=0.03"]).unwrap_err();
    let line = line_of(SCENE, "max = [0.8, 0.4, 0.4]");
    assert!(error.to_string().starts_with(&format!("all.toml:{line}: world.max: ")), "{error}");
}

#[test]
fn toml_round_trip_keeps_every_bit() {
    let mut scene = read(SCENE).unwrap();
    scene.set(&["time.step=1.2345678901234567e-5", "world.walls.z_max=stick"]).unwrap();
    let text = scene.to_toml().unwrap();
    let again = read(&text).unwrap();
    assert_eq!(again.to_toml().unwrap(), text);
    assert_eq!(again.time.step, Some(1.234_567_890_123_456_7e-5));
    assert!(matches!(again.body[0].shape, Shape::Box { min: Some(_), half: None, .. }));
}

#[test]
fn spacing_and_volume_warn() {
    let mut scene = read(SCENE).unwrap();
    scene.set(&["body[0].spacing=0.018"]).unwrap();
    let warnings = scene.warnings();
    assert!(warnings[0].contains("body 'bed': spacing is 0.90 cells, 1.4 particles a cell"), "{warnings:?}");
    // 0.8 x 0.4 x 0.2 m holds 44 x 22 x 11 spacings of 18 mm.
    let share: f64 = 100.0 * (44.0 * 22.0 * 11.0 * 0.018_f64.powi(3) / (0.8 * 0.4 * 0.2) - 1.0);
    assert!(warnings[1].contains(&format!("hold {share:+.1} % of its volume")), "{warnings:?}");
}

#[test]
fn a_missing_file_is_named() {
    let error = Scene::from_file("/nowhere/at-all.toml").unwrap_err().to_string();
    assert!(error.starts_with("/nowhere/at-all.toml: reading the scene: "), "{error}");
}

#[test]
fn schema_describes_every_key_and_its_references_resolve() {
    let schema = Scene::schema();
    fn walk(node: &serde_json::Value, root: &serde_json::Value, path: &str, keys: &mut usize) {
        match node {
            serde_json::Value::Object(map) => {
                if let Some(reference) = map.get("$ref") {
                    let pointer = reference.as_str().unwrap().strip_prefix('#').unwrap();
                    assert!(root.pointer(pointer).is_some(), "{path}: {reference}");
                }
                if let Some(serde_json::Value::Object(properties)) = map.get("properties") {
                    for (key, property) in properties {
                        let required = map.get("required").and_then(|r| r.as_array());
                        let choice = required.is_some_and(|r| r.len() == 1) && properties.len() == 1;
                        let described = property.get("description").is_some() || map.get("description").is_some();
                        assert!(described && (choice || property.get("description").is_some()), "{path}.{key}");
                        *keys += 1;
                    }
                }
                map.iter().for_each(|(key, value)| walk(value, root, &format!("{path}/{key}"), keys));
            }
            serde_json::Value::Array(items) => items.iter().for_each(|item| walk(item, root, path, keys)),
            _ => {}
        }
    }
    let mut keys = 0;
    walk(&schema, &schema, "", &mut keys);
    assert!(keys > 80, "{keys}");
    assert_eq!(schema["type"], "object");
    let top: Vec<_> = schema["properties"].as_object().unwrap().keys().collect();
    let scene = toml::Value::try_from(read(SCENE).unwrap()).unwrap();
    assert!(scene.as_table().unwrap().keys().all(|key| top.contains(&key)));
}

/// `--resume FILE` without "=" reads the file as a scene.
#[test]
fn a_snapshot_or_other_bytes_in_place_of_a_scene_are_told_by_what_they_are() {
    let file = std::env::temp_dir().join(format!("barchan-no-scene-{}", std::process::id()));
    for (bytes, told) in [(&b"BARCHAN\x1a\x03\0\0\0"[..], "--resume="), (&b"\xff\xfe"[..], "UTF-8")] {
        std::fs::write(&file, bytes).unwrap();
        let error = Scene::from_file(&file).unwrap_err().to_string();
        assert!(error.contains(told) && error.contains("barchan-no-scene"), "{error}");
    }
    std::fs::remove_file(&file).unwrap();
}

proptest! {
    #[test]
    fn any_text_is_read_or_refused(text in "\\PC*") {
        let _ = read(&text);
        let mut scene = read(SCENE).unwrap();
        let _ = scene.set(&[text]);
    }

    #[test]
    fn any_line_may_be_broken(line in 0_usize..75, text in "[a-z_]{0,6}( = )?[-0-9.\\[\\]{}\"a-z, ]{0,12}") {
        let lines: Vec<_> = SCENE.lines().collect();
        let broken: Vec<_> = (0..lines.len()).map(|i| if i == line { text.as_str() } else { lines[i] }).collect();
        if let Err(error) = read(&broken.join("\n")) {
            prop_assert!(!error.to_string().is_empty());
        }
    }

    #[test]
    fn any_key_may_be_overridden(path in "(world|time|body|tool|output|material)(\\[[0-3]\\])?(\\.[a-z_]{1,8}){0,3}", value in "[-0-9.e\\[\\]{}\"a-z, =]{0,10}") {
        let mut scene = read(SCENE).unwrap();
        let _ = scene.set(&[format!("{path}={value}")]);
        prop_assert!(scene.check().is_ok());
    }
}

/// Seen from above alone, a cube is a square: what stands out of the ground is seen in perspective, a bed alone from the top.
#[test]
fn the_view_follows_from_what_the_scene_holds() {
    let head = "name = 'a'\nworld = { cell = 0.1, min = [0, 0, 0], max = [2, 2, 2] }\ntime = { end = 1 }\n\
                material = [{ name = 'm', law = 'sand', density = 1000 }]\n";
    let view = |rest: &str| Scene::from_str(&format!("{head}{rest}"), "a.toml", "").unwrap().picture_view();
    let bed = "[[body]]\nmaterial = 'm'\nshape = { box = { min = [0, 0, 0], max = [2, 2, 0.5] } }\n";
    let cube = "[[body]]\nmaterial = 'm'\nshape = { box = { min = [0.5, 0.5, 0.5], max = [1, 1, 1] } }\n";
    let tool = "[[tool]]\nname = 't'\nshape = { sphere = { radius = 0.2 } }\nposition = [1, 1, 1]\n";
    assert_eq!(view(bed), PictureView::Top);
    for rest in [cube, &format!("{bed}{cube}"), &format!("{bed}{tool}")] {
        assert_eq!(view(rest), PictureView::Perspective, "{rest}");
    }
    assert_eq!(view(&format!("output.picture.view = 'top'\n{bed}{tool}")), PictureView::Top);
    assert_eq!(view(&format!("output.picture.camera = {{ target = [1, 1, 0] }}\n{bed}")), PictureView::Perspective);
}

#[test]
fn stars_stand_for_any_text() {
    for (pattern, text) in [("a", "a"), ("*", ""), ("a*", "abc"), ("*c", "abc"), ("a*c*e", "abcde"), ("**", "x")] {
        assert!(fits(pattern, text), "{pattern} {text}");
    }
    for (pattern, text) in [("a", "ab"), ("a*", "ba"), ("*a", "ab"), ("ab*bc", "abc"), ("a*c*e", "abce1")] {
        assert!(!fits(pattern, text), "{pattern} {text}");
    }
}
