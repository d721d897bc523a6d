//! Plans: what a scene calls for and why, parameters, bounds, and what is refused.
#![allow(clippy::result_large_err, reason = "see the crate's own allowance")]

mod common;

use barchan_core::plan::Effect;
use barchan_core::{Error, Options, Plan, Precision, Result, Scene, Stage};

/// An elastic block of 16³ particles and more, on a floor.
fn scene(rest: &str) -> Scene {
    let text = format!(
        "name = 'plan'
        world = {{ cell = 0.02, min = [0, 0, 0], max = [1, 0.4, 1], walls = {{ z_min = 'stick', y_min = 'periodic', y_max = 'periodic' }} }}
        time = {{ end = 1 }}
        [[material]]
        name = 'm'
        law = 'elastic'
        density = 1000
        [[body]]
        name = 'block'
        material = 'm'
        shape = {{ box = {{ min = [0, 0, 0], max = [0.16, 0.16, 0.16] }} }}
        {rest}"
    );
    Scene::from_str(&text, "plan.toml", "").unwrap()
}

fn plan(scene: &Scene) -> Result<Plan> {
    Plan::assemble(&common::registry(), scene, &Options::default()).map(|(plan, ..)| plan)
}

fn with(overrides: &[&str]) -> Result<Plan> {
    let mut scene = scene("");
    scene.set(overrides).unwrap();
    plan(&scene)
}

fn names(effects: &[Effect]) -> Vec<&str> {
    effects.iter().map(|e| e.name.as_str()).collect()
}

#[test]
fn a_plan_holds_what_is_called_for_and_why() {
    let plan = plan(&scene("")).unwrap();
    let ground = [Stage::SORT, Stage::SLEEP, Stage::P2G, Stage::GRID_UPDATE, Stage::LIMIT, Stage::G2P];
    assert_eq!(plan.schedule.stages(), ground);
    assert_eq!(
        names(&plan.effects),
        [
            "soft ground, f32",
            "ground at rest sleeps",
            "material m",
            "gravity",
            "periodic y",
            "wall z_min",
            "pressure pictures"
        ]
    );
    assert_eq!(plan.effects[2].because, "body[0].material = \"m\"");
    assert_eq!(plan.effects[2].adds, "law elastic (built-in): update_f32, 6 strain planes, 1 state plane");
    assert_eq!((plan.cell_min, plan.cell_max), ([0; 3], [50, 20, 50]));
    assert_eq!(plan.materials[0].parameters, [1e6, 0.2, 0.5, f64::INFINITY]);
    assert_eq!(plan.particle_count, 4096);
    // 12 cell, 12 offset, 8 id, 2 body, 12 velocity, 36 affine, 4 mass, 4 volume, 28 strain and state; 2³ blocks.
    assert_eq!(plan.memory, (4096 * 118, 8 * 9 * 1024));
    let text = plan.to_string();
    for part in [
        "particles 4096",
        "stages    when due: sort\n          each step: sleep -> P2G -> grid update -> limit -> G2P\n",
        "world.walls.z_min = \"stick\"",
    ] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn tools_bring_contact_and_free_ones_both_ways() {
    let tool = "[[tool]]\nname = 'plate'\nposition = [0.5, 0.2, 0.5]\nshape = { box = { half = [0.1, 0.1, 0.1] } }";
    let driven = plan(&scene(tool)).unwrap();
    let kinds: Vec<_> = driven.couplings.iter().map(|c| (c.kind.as_str(), c.name.as_str())).collect();
    assert_eq!(kinds, [("rigid", "rigid")]);
    assert!(driven.has(Stage::CONTACT) && !driven.two_way());
    assert!(names(&driven.effects).contains(&"contact with tool plate"));
    assert!(driven.warnings.contains(&"boxes do not turn".to_owned()));
    let free = plan(&scene(&format!("{tool}\nmotion = {{ free = {{ mass = 1 }} }}"))).unwrap();
    assert!(free.two_way());
    let both = free.effects.iter().find(|e| e.name == "two-way coupling").unwrap();
    assert_eq!(both.because, "tool 'plate' moves freely");
}

#[test]
fn what_is_declared_but_unused_is_no_part_of_the_plan() {
    let rest = "[[material]]\nname = 'spare'\nlaw = 'fluid'\ndensity = 1\n[[coupling]]\nkind = 'rigid'";
    let plan = plan(&scene(rest)).unwrap();
    assert_eq!(plan.materials.len(), 1);
    assert!(plan.couplings.is_empty() && !plan.has(Stage::CONTACT));
    let unused: Vec<_> = plan.effects.iter().filter(|e| e.adds == "costs nothing").collect();
    assert_eq!(unused[0].name, "declared but unused: material spare");
    assert_eq!(unused[1].name, "declared but unused: coupling rigid");
    // The law of an unused material must still exist.
    let error = with(&["material[0].law=granite"]).unwrap_err().to_string();
    assert_eq!(error, "--set: material[0].law: no material is called 'granite'; known are: elastic, fluid, silent");
}

#[test]
fn an_empty_scene_has_no_stages_and_a_finite_step() {
    let scene = Scene::from_str(
        "name = 'empty'\nworld = { cell = 0.1, min = [0, 0, 0], max = [1, 1, 1] }\ntime = { end = 1 }",
        "empty.toml",
        "",
    )
    .unwrap();
    let plan = plan(&scene).unwrap();
    assert!(plan.schedule.stages().is_empty() && plan.particle_count == 0 && plan.memory == (0, 0));
    assert!(plan.bound.dt.is_infinite() && plan.dt > 0.0 && plan.dt <= 0.05);
}

#[test]
fn parameters_are_held_to_the_law() {
    for (setting, path, message) in [
        ("material[0].parameters.young_modulos=1", "young_modulos", "did you mean `young_modulus`?"),
        (
            "material[0].parameters.hue=1",
            "hue",
            "it has young_modulus, poisson_ratio, friction_angle, friction_angle_deg, strength",
        ),
        ("material[0].parameters.young_modulus_deg=1", "young_modulus_deg", "has no parameter"),
        ("material[0].parameters.young_modulus=0", "young_modulus", "is 0; must be in (0, 1000000000000] Pa"),
        ("material[0].parameters.poisson_ratio=0.5", "poisson_ratio", "is 0.5; must be in (-1, 0.5)"),
        ("material[0].parameters.poisson_ratio=nan", "poisson_ratio", "is NaN"),
        ("material[0].parameters.friction_angle_deg=95", "friction_angle_deg", "is 95 deg, that is 1.658"),
        (
            "material[0].parameters={ friction_angle = 0.5, friction_angle_deg = 30 }",
            "friction_angle_deg",
            "gives friction_angle a second time",
        ),
    ] {
        let error = with(&[setting]).expect_err(setting).to_string();
        assert!(error.starts_with(&format!("--set: material[0].parameters.{path}: ")), "{error}");
        assert!(error.contains(message) && !error.ends_with(" 1"), "{error}");
    }
    let error = with(&["material[0].parameters={ young_modulus = 2e11, poisson_ratio = 0.45 }"]).unwrap_err();
    assert!(
        error.to_string().contains("law 'elastic' refuses these parameters together: invalid parameter: too stiff")
    );

    let plan = with(&["material[0].parameters={ friction_angle_deg = 30, strength = inf }"]).unwrap();
    assert!((plan.materials[0].parameters[2] - std::f64::consts::FRAC_PI_6).abs() < 1e-15);
}

#[test]
fn the_bound_is_that_of_an_isolated_particle() {
    // (h / c_p) sqrt((1 - nu) / (1 + nu)): factors 0.816, 0.734, 0.616, 0.585 at these ratios.
    for (nu, factor) in [(0.2, 0.816), (0.3, 0.734), (0.45, 0.616), (0.489, 0.586)] {
        let plan = with(&[&format!("material[0].parameters={{ poisson_ratio = {nu} }}")]).unwrap();
        let p_wave = 1e6 * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu));
        let expected = 0.02 / f64::sqrt(p_wave / 1000.0) * factor;
        assert!((plan.bound.dt / expected - 1.0).abs() < 1e-3, "{nu}: {} for {expected}", plan.bound.dt);
        assert_eq!(plan.bound.by, "stiffness of material 'm'");
        assert!((plan.dt - 0.6 * plan.bound.dt).abs() < 1e-12);
    }
    // A fluid is held to what its moduli say, too, as runs hold it: a lone particle that swells is as stiff as three times its bulk.
    let plan = with(&["material[0].law=fluid"]).unwrap();
    let p_wave: f64 = 1e6 * 0.8 / (1.2 * 0.6);
    assert!((plan.bound.dt / (0.02 / (p_wave / 1000.0).sqrt()) - f64::sqrt(0.8 / 1.2)).abs() < 1e-6);
}

#[test]
fn a_fast_tool_bounds_the_step_to_a_fraction_of_a_cell() {
    let tool = "[[tool]]\nname = 'plate'\nposition = [0.5, 0.2, 0.5]\nshape = { box = { half = [0.1, 0.1, 0.1] } }
        motion = { velocity = { linear = [100, 0, 0] } }";
    let plan = plan(&scene(tool)).unwrap();
    assert!((plan.bound.dt - 0.4 * 0.02 / 100.0).abs() < 1e-15);
    assert_eq!(plan.bound.by, "coupling 'rigid': speed of a tool");
}

#[test]
fn a_step_above_the_bound_is_refused_cut_or_allowed() {
    // Ten times over: E = 1e9 Pa with a step that suits 1e7.
    let stiff = ["material[0].parameters.young_modulus=1e9", "time.step=1.5e-4"];
    let Err(Error::TimeStep { step: 0, dt, bound, by }) = with(&stiff) else { panic!("must be refused") };
    assert!(dt == 1.5e-4 && dt > 9.0 * bound && by == "stiffness of material 'm'");
    let cut = with(&[&stiff[..], &["time.over_bound=substep"]].concat()).unwrap();
    assert!(cut.dt <= 0.6 * cut.bound.dt && ((1.5e-4 / cut.dt).round() * cut.dt - 1.5e-4).abs() < 1e-18);
    assert!(cut.warnings.iter().any(|w| w.contains("each step is cut")), "{:?}", cut.warnings);
    let allowed = with(&[&stiff[..], &["time.over_bound=allow"]].concat()).unwrap();
    assert_eq!(allowed.dt, 1.5e-4);
    assert!(allowed.warnings.iter().any(|w| w.contains("energy is watched")));
}

#[test]
fn missing_callbacks_are_named_with_what_would_mend_it() {
    let error = with(&["material[0].law=silent"]).unwrap_err().to_string();
    assert!(error.contains("material 'silent' (built-in) has no tangent_moduli_f32"), "{error}");
    assert!(error.contains("set time.step"), "{error}");
    let plan = with(&["material[0].law=silent", "time.step=1e-4"]).unwrap();
    assert!(plan.warnings.iter().any(|w| w.contains("gives no tangent moduli")));
    let mut scene = scene("");
    scene.set(&["material[0].law=silent", "time.step=1e-4"]).unwrap();
    let options = Options { precision: Precision::F64, ..Options::default() };
    let error = Plan::assemble(&common::registry(), &scene, &options).err().unwrap().to_string();
    assert!(error.contains("has no update_f64; needed because the run is in f64"), "{error}");
    let error = plan_error_of_unknown_coupling();
    assert_eq!(error, "coupling[0].kind: no coupling is called 'magnet'; known are: rigid");
}

fn plan_error_of_unknown_coupling() -> String {
    let error = plan(&scene("[[coupling]]\nkind = 'magnet'")).unwrap_err().to_string();
    error
        .split_once(": ")
        .map(|(place, rest)| {
            assert!(place.starts_with("plan.toml:"), "{place}");
            rest.to_owned()
        })
        .unwrap()
}

#[test]
fn hard_materials_warn() {
    let warned = |setting: &str, text: &str| {
        let warnings = with(&[setting]).unwrap().warnings;
        warnings.iter().any(|w| w.contains(text))
    };
    assert!(warned("material[0].parameters.poisson_ratio=0.4985", "Poisson's ratio 0.4985 is above 0.49"));
    assert!(!warned("material[0].parameters.poisson_ratio=0.48", "Poisson"));
    assert!(warned("material[0].parameters.friction_angle_deg=42.3", "no shear failure in plane strain"));
    assert!(!warned("material[0].parameters.friction_angle_deg=42.1", "plane strain"));
}

/// What can measure or do nothing is told, and what can is not.
#[test]
fn what_does_nothing_warns() {
    let warned = |settings: &[&str], text: &str| {
        let warnings = with(settings).unwrap().warnings;
        warnings.iter().filter(|w| w.contains(text)).count()
    };
    let beyond = [
        "{ name = 'p', surface = { points = [[0.1, 0.1], [1.1, 0.1]] } }",
        "{ name = 'p', within = { sphere = { center = [0.1, 0.1, 1.3], radius = 0.2 } } }",
        "{ name = 'p', flux = { rectangle = { min = [-0.1, 0, 0], max = [-0.1, 0.4, 1] } } }",
        "{ name = 'p', wall = { side = 'z_min', min = [1.2, 0, 0], max = [1.4, 0.4, 1] } }",
    ];
    let within = [
        // y is periodic.
        "{ name = 'p', surface = { points = [[0.1, 0.1], [0.9, 0.5]] } }",
        "{ name = 'p', within = { sphere = { center = [0.1, 0.1, 1.1], radius = 0.2 } } }",
        "{ name = 'p', flux = { rectangle = { min = [0, 0, 0], max = [0, 0.4, 1] } } }",
        "{ name = 'p', wall = { side = 'z_min', min = [0.2, 0, 5], max = [0.4, 0.4, 6] } }",
        "{ name = 'p', nearest = [2, 2, 2] }",
    ];
    for (probes, times) in [(&beyond[..], 1), (&within[..], 0)] {
        for probe in probes {
            assert_eq!(warned(&[&format!("probe=[{probe}]")], "probe 'p': its"), times, "{probe}");
        }
    }
    let flat = "world.walls={ z_min = 'stick' }";
    let slice = "world.plane_strain={ thickness_cells = 8 }";
    assert_eq!(warned(&[flat, slice, "gravity=[0, -1, -9]"], "gravity: its part along y, -1 m/s²"), 1);
    assert_eq!(warned(&[flat, slice, "gravity=[1, 0, -9]"], "gravity"), 0);
    assert_eq!(warned(&[flat, "gravity=[0, -1, -9]"], "gravity"), 0);
}

/// Ground that is too thin for a coarse level is told, with what would mend it; each mend does.
#[test]
fn a_level_with_less_than_four_cells_of_ground_warns() {
    // A pebble on a bed, 0.24 m deep, of which the finest level follows the pebble.
    let bed = |overrides: &[&str]| {
        let text = "name = 'bed'
            world = { cell = 0.02, min = [0, 0, 0], max = [0.96, 0.48, 0.96], walls = { z_min = 'stick' } }
            levels = { count = 3, half = 8, agents = ['pebble'] }
            time = { end = 1 }
            [[material]]
            name = 'm'
            law = 'elastic'
            density = 1000
            [[body]]
            name = 'bed'
            material = 'm'
            shape = { box = { min = [0, 0, 0], max = [0.96, 0.48, 0.24] } }
            [[body]]
            name = 'pebble'
            material = 'm'
            shape = { sphere = { center = [0.24, 0.24, 0.26], radius = 0.02 } }";
        let mut scene = Scene::from_str(text, "plan.toml", "").unwrap();
        scene.set(overrides).unwrap();
        plan(&scene).unwrap()
    };
    let warnings = |plan: &Plan| plan.warnings.iter().filter(|w| w.contains("level ")).cloned().collect::<Vec<_>>();
    let shallow = bed(&[]);
    let cells: Vec<f64> = shallow.ground_cells.iter().map(|cells| cells.unwrap()).collect();
    for (cells, wanted) in cells.iter().zip([12.0, 6.0, 3.0]) {
        assert!((cells - wanted).abs() < 1e-6, "{cells} cells instead of {wanted}");
    }
    let [warning] = &warnings(&shallow)[..] else { panic!("{:?}", shallow.warnings) };
    for part in ["level 2:", "3.00 cells of 0.08 m", "levels.count = 2", "world.cell to 0.015 or less"] {
        assert!(warning.contains(part), "'{part}' is not in: {warning}");
    }
    let text = shallow.to_string();
    assert!(text.contains("under each level's surface: 12.0, 6.0, 3.0") && text.contains(warning), "{text}");
    for mended in ["levels.count=2", "world.cell=0.015"] {
        assert_eq!(warnings(&bed(&[mended])), [""; 0], "{mended}");
    }
    assert_eq!(bed(&["levels.count=1"]).ground_cells, [None]);
}
