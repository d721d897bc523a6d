//! Every pass of the GPU backend is sound WGSL, whatever a plan asks for: no adapter is needed to find out.

use barchan::{Options, Plan, Precision, Scene};
use barchan_tests::scenes::options;
use barchan_tests::sketch::{Head, block, driven, half, material, tool};
use barchan_wgpu::shared::{CONSTANTS, LAYOUTS};
use barchan_wgpu::{Shader, shaders};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use wgpu::naga::front::wgsl;
use wgpu::naga::valid::{Capabilities, ValidationFlags, Validator};
use wgpu::naga::{Expression, Literal, Module, TypeInner};

const H: f64 = 0.05;

/// Sides of the world: images, walls that let go, images across periodic sides, none.
const WALLS: [&str; 5] = [
    "z_min = \"stick\"",
    "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"\nz_max = \"slip\"",
    "x_min = \"slip\"\nz_min = { separate = { friction = 0.4 } }\ny_max = { separate = { friction = 0.2 } }",
    "x_min = \"periodic\"\nx_max = \"periodic\"\nz_min = \"slip\"",
    "",
];
const LEVELS: [&str; 4] = [
    "",
    "[levels]\ncount = 2\nhalf = 8\nagents = [AGENTS]\n",
    "[levels]\ncount = 3\nhalf = 8\nsubcycle = true\nagents = [AGENTS]\n",
    "[levels]\ncount = 3\nhalf = 8\nreach = 4\nsubcycle = SUBCYCLE\nagents = [AGENTS]\n",
];
const LAWS: [(&str, &str); 7] = [
    ("sand", "young_modulus = 1e5"),
    ("snow", "young_modulus = 1e5"),
    ("liquid", ""),
    ("neo_hookean", "young_modulus = 1e5, poisson_ratio = 0.3"),
    ("fixed_corotated", "young_modulus = 1e5, poisson_ratio = 0.3"),
    ("hencky", "young_modulus = 1e5, poisson_ratio = 0.3"),
    ("von_mises", "young_modulus = 1e5, poisson_ratio = 0.3"),
];

/// Couplings from outside Barchan beside the tools: none, a field, bodies that grip, both, two that answer together, these and a field.
const COUPLINGS: [&str; 6] = [
    "",
    "[[coupling]]\nkind = \"current\"\nparameters = { rate = 0.5 }\n",
    "[[coupling]]\nkind = \"rollers\"\n",
    "[[coupling]]\nkind = \"rollers\"\n[[coupling]]\nkind = \"current\"\nparameters = { rate = 0.5 }\n",
    "[[coupling]]\nkind = \"dumbbell\"\nparameters = { position = [0.4, 0.4, 0.5] }\n",
    "[[coupling]]\nkind = \"current\"\nparameters = { rate = 0.5 }\n[[coupling]]\nkind = \"dumbbell\"\nparameters = { position = [0.4, 0.4, 0.5] }\n",
];

/// Of everything else, so many picks for each of these.
const PICKS: usize = 8;

/// A pick from each of some lists, another one for each number.
fn pick<T: Copy>(all: &[T], number: &mut usize) -> T {
    let one = all[*number % all.len()];
    *number /= all.len();
    one
}

/// A scene, how many worlds and particles its passes are made for, and whether planes have bindings of their own.
fn case(walls: &str, levels: &str, bodies: usize, number: usize) -> (String, usize, usize, bool) {
    // A large stride, so that neighbours differ in everything.
    let mut number = number * 7919 + 13;
    let n = &mut number;
    // Walls that let go look at all nodes along them in each step.
    let may_sleep = pick(&[false, true], n) && !walls.contains("separate");
    let sleep = format!("[sleep]\non = {may_sleep}\n");
    let leaving = pick(&["leaving = \"error\"", "leaving = \"clamp\"", "leaving = \"delete\""], n);
    let ((law, parameters), (other, others)) = (pick(&LAWS, n), pick(&LAWS, n));
    let damping = pick(&["", "damping = 1e-3\n"], n);
    let (worlds, many, apart) = (pick(&[1, 3], n), pick(&[false, true], n), pick(&[false, true], n));
    let (subcycle, soft) = (pick(&["false", "true"], n), pick(&[false, true], n));
    let couplings = pick(&COUPLINGS, n).to_owned();
    // What is to come within reach later stands as it has settled, and nothing lies on it.
    let unbounded = levels.contains("reach");
    let agents = match bodies {
        0 => "\"soft\"",
        _ if soft && !unbounded => "\"tool0\", \"soft\"",
        _ => "\"tool0\"",
    };
    let mut parts = vec![
        material(law, 1500.0, parameters) + damping,
        block(law, [0.0; 3], [1.6, 0.8, 0.2], if unbounded { "settled = true" } else { "" }),
        levels.replace("AGENTS", agents).replace("SUBCYCLE", subcycle),
        sleep,
        couplings,
    ];
    if !unbounded {
        parts.push(block(law, [0.6, 0.3, 0.25], [0.8, 0.5, 0.4], "name = \"soft\""));
    }
    if other != law && !unbounded {
        parts.push(material(other, 1200.0, others));
        parts.push(block(other, [0.2, 0.2, 0.25], [0.3, 0.3, 0.35], ""));
    }
    let (held, free) = (driven([0.1, 0.0, 0.0]), "{ free = { mass = 2.0 } }".to_owned());
    let motions = [vec![], vec![&held], vec![&free], vec![&free, &held]];
    let shapes = [half([0.06; 3]), "sphere = { radius = 0.08 }".to_owned()];
    for (t, motion) in motions[bodies].iter().enumerate() {
        let at = [1.0 + 0.3 * t as f64, 0.4, 0.32];
        parts.push(tool(&format!("tool{t}"), at, &shapes[t], "{ coulomb = { friction = 0.3 } }", motion));
    }
    let head = Head { world: leaving, ..Head::cells(H, [32, 16, 16], walls) };
    (head.time("step = 1e-5").with(&parts), worlds, if many { 2_000_000 } else { 1000 }, apart)
}

fn passes(text: &str, worlds: usize, particles: usize, apart: bool) -> Result<Vec<Shader>, String> {
    let with = Options { backend: "wgpu".into(), ..options(Precision::F32) };
    let scene = Scene::from_str(text, "case", "").map_err(|e| e.to_string())?;
    let mut registry = barchan::registry();
    barchan_seam_coupling::register(&mut registry).map_err(|e| e.to_string())?;
    let (plan, _, couplings) = Plan::assemble(&registry, &scene, &with).map_err(|e| e.to_string())?;
    shaders(&plan, &couplings, worlds, particles, apart).map_err(|e| e.to_string())
}

/// The names that Rust and a pass share, all of which must mean the same in both.
fn shared(module: &Module) -> Result<BTreeSet<&'static str>, String> {
    let mut names = BTreeSet::new();
    for (_, constant) in module.constants.iter() {
        let Some((name, value)) = CONSTANTS.iter().find(|(name, _)| constant.name.as_deref() == Some(name)) else {
            continue;
        };
        let said = match module.global_expressions[constant.init] {
            Expression::Literal(Literal::U32(x)) => i64::from(x),
            Expression::Literal(Literal::I32(x)) => i64::from(x),
            ref other => return Err(format!("{name} is no whole number but {other:?}")),
        };
        if said != *value {
            return Err(format!("{name} is {said} in WGSL and {value} in Rust"));
        }
        names.insert(*name);
    }
    for (_, ty) in module.types.iter() {
        let Some(layout) = LAYOUTS.iter().find(|layout| ty.name.as_deref() == Some(layout.name)) else { continue };
        let TypeInner::Struct { members, span } = &ty.inner else {
            return Err(format!("{} is no struct", layout.name));
        };
        let said: Vec<_> = members.iter().map(|m| (m.name.as_deref().unwrap_or(""), m.offset as usize)).collect();
        if said != layout.members || *span as usize > layout.size {
            return Err(format!("{} is {said:?} of {span} bytes in WGSL and {layout:?} in Rust", layout.name));
        }
        names.insert(layout.name);
    }
    Ok(names)
}

/// Symptoms guarded against: a scene that nobody has tried asks for passes that do not fit together, which a user finds out when a driver refuses them; and
/// a number or a layout that is changed in Rust and not in WGSL, which nobody finds out.
#[test]
fn every_pass_that_a_plan_can_ask_for_is_sound() {
    let mut cases = Vec::new();
    for walls in WALLS {
        for levels in LEVELS {
            // Of levels that follow nobody there is one.
            for bodies in 0..4 {
                // Those are refused: nothing below ground that comes within reach, nobody to follow there, walls that let go of subcycled ground.
                let is_unbounded = levels.contains("reach") && (bodies == 0 || walls != WALLS[0]);
                let lets_go = levels.contains("subcycle = true") && walls.contains("separate");
                if !is_unbounded && !lets_go {
                    let first = cases.len();
                    cases.extend((first..first + PICKS).map(|number| case(walls, levels, bodies, number)));
                }
            }
        }
    }
    let check = |(text, worlds, particles, apart): &(String, usize, usize, bool)| {
        let all = passes(text, *worlds, *particles, *apart).map_err(|e| format!("{e}\n{text}"))?;
        let mut known = BTreeSet::new();
        for shader in &all {
            let refuse = |what: String| -> ! { panic!("pass '{}': {what}\n{text}", shader.name) };
            let module = wgsl::parse_str(&shader.wgsl).unwrap_or_else(|e| refuse(e.emit_to_string(&shader.wgsl)));
            let valid = Validator::new(ValidationFlags::all(), Capabilities::all()).validate(&module);
            valid.unwrap_or_else(|e| refuse(e.emit_to_string(&shader.wgsl)));
            known.extend(shared(&module).unwrap_or_else(|what| refuse(what)));
            assert!(module.entry_points.iter().any(|point| point.name == shader.entry), "no {} in it", shader.entry);
        }
        Ok::<_, String>((all.iter().map(|shader| shader.name).collect::<BTreeSet<_>>(), known))
    };
    let checked: Vec<_> = cases.par_iter().map(check).collect();
    let refused: Vec<&String> = checked.iter().filter_map(|names| names.as_ref().err()).collect();
    assert!(refused.is_empty(), "{} scenes are refused, the first: {}", refused.len(), refused[0]);
    let (names, known): (Vec<BTreeSet<&str>>, Vec<BTreeSet<&str>>) = checked.into_iter().flatten().unzip();
    let known: BTreeSet<&str> = known.into_iter().flatten().collect();
    for name in CONSTANTS.iter().map(|(name, _)| *name).chain(LAYOUTS.iter().map(|layout| layout.name)) {
        assert!(known.contains(name), "no pass has {name}, which Rust takes for shared");
    }
    let mut seen: BTreeMap<&str, usize> = BTreeMap::new();
    names.iter().flatten().for_each(|name| *seen.entry(name).or_default() += 1);
    println!("{} plans; how many of them ask for each pass: {seen:?}", cases.len());
    // The rarest of them are there.
    for name in [
        "answering bodies, rims",
        "press on answering bodies",
        "contact",
        "solve",
        "prolong",
        "restrict",
        "watch",
        "hold",
    ] {
        assert!(seen.contains_key(name), "no plan asks for '{name}': {seen:?}");
    }
}
