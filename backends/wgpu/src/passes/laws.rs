//! The materials' laws as one text.

use crate::passes::conditions::chosen;
use crate::passes::material;
use crate::passes::scene::{damps, parameter_vectors, parameters_of, rest_vectors, space, stiffens};
use crate::passes::unrolled::unrolled;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Plan, Result};
use std::fmt::Write as _;

/// The materials, and the update of a particle's strain and stress.
pub(crate) fn laws(plan: &Plan, worlds: usize) -> Result<String> {
    let materials: Vec<_> = plan.materials.iter().map(|m| &m.material).collect();
    let mut text = material::module(&materials)?;
    let vectors = parameter_vectors(plan);
    let levels = plan.cell_widths.len();
    let (space, all) = (space(worlds > 1), worlds * vectors);
    let _ = write!(
        text,
        "@group(0) @binding(1) var<{space}> params: array<vec4<f32>, {all}>;\n\
         fn barchan_param(base: u32, i: u32) -> f32 {{ return params[(base + i) >> 2u][(base + i) & 3u]; }}\n"
    );
    let mut base = 0;
    let switch = |cases: Vec<String>, name: &str, ty: &str| {
        // Without a material nobody asks.
        let none = || (format!("{ty}()"), &[][..]);
        let (last, rest) = cases.split_last().map_or_else(none, |(last, rest)| (last.clone(), rest));
        let rest: String = rest.iter().enumerate().map(|(i, c)| format!("case {i}u: {{ return {c}; }} ")).collect();
        format!("fn {name}(law: u32) -> {ty} {{ switch law {{ {rest}default: {{ return {last}; }} }} }}\n")
    };
    let bases = plan
        .materials
        .iter()
        .map(|m| {
            let at = base;
            base += parameters_of(m).count();
            if worlds > 1 { format!("layer_now / {levels}u * {}u + {at}u", 4 * vectors) } else { format!("{at}u") }
        })
        .collect();
    text += &switch(bases, "param_base", "u32");
    let full = plan.materials.iter().map(|m| (m.material.strain_planes() == 9).to_string()).collect();
    text += &switch(full, "has_def_grad", "bool");
    let rates = plan.materials.iter().map(|m| m.material.has(barchan_abi::BARCHAN_CAP_VEL_GRAD).to_string()).collect();
    text += &switch(rates, "wants_rate", "bool");

    let damps = damps(&plan.materials);
    if damps {
        let damped = plan.materials.iter().map(|m| m.damping.is_some().to_string()).collect();
        text += &switch(damped, "is_damped", "bool");
        let behind = plan.materials.iter().map(|m| format!("{}u", m.parameters.len())).collect();
        text += &switch(behind, "damping_at", "u32");
        text += include_str!("../wgsl/damping.wgsl");
    }

    // A particle's values, by number.
    let vectors = rest_vectors(&plan.materials);
    let value = |k: usize| format!("r{}[{}]", k / 4, k % 4);
    let states = |full: bool| {
        let of_kind = plan.materials.iter().filter(|m| (m.material.strain_planes() == 9) == full);
        of_kind.map(|m| m.material.states.len()).max().unwrap_or(0)
    };
    let (mut fields, mut fetch, mut load, mut store) = (String::new(), String::new(), String::new(), String::new());
    for k in 0..vectors {
        let _ = writeln!(fields, "r{k}: vec4<f32>,");
        let _ = writeln!(fetch, "held.r{k} = rest_of(q, {k}u);");
        let _ = writeln!(load, "var r{k} = held.r{k};");
        let _ = writeln!(store, "set_rest(q, {k}u, r{k});");
    }
    if stiffens(plan) {
        text += include_str!("../wgsl/stiffness.wgsl");
    }
    let _ = write!(
        text,
        "// A particle's strain, history and rest volume.\nstruct Held {{\n{fields}}}\n\
         fn held_by(q: u32) -> Held {{\nvar held: Held;\n{fetch}return held;\n}}\n\
         fn rest_volume(held: Held) -> f32 {{ return held.r{}.w; }}\n",
        vectors - 1
    );
    let any = |full: bool| plan.materials.iter().any(|m| (m.material.strain_planes() == 9) == full);
    let branch = |full: &str, symmetric: &str| match (any(true), any(false)) {
        (true, true) => format!("if has_def_grad(law) {{\n{full}}} else {{\n{symmetric}}}\n"),
        (true, false) => full.to_owned(),
        _ => symmetric.to_owned(),
    };
    let history = |full: bool, out: bool| -> String {
        let first = if full { 9 } else { 6 };
        (0..states(full))
            .map(|s| {
                if out {
                    format!("{} = state[{s}];\n", value(first + s))
                } else {
                    format!("state[{s}] = {};\n", value(first + s))
                }
            })
            .collect()
    };
    // Column by column; F lies row by row in memory.
    let columns = (0..9).map(|e| value(e % 3 * 3 + e / 3)).collect::<Vec<_>>().join(", ");
    let load_full = format!("strain = mat3x3<f32>({columns});\n{}", history(true, false));
    let sym = [0, 3, 4, 3, 1, 5, 4, 5, 2].map(value).join(", ");
    let load_sym = format!("strain = mat3x3<f32>({sym});\n{}", history(false, false));
    let kept = |i: usize, j: usize| {
        if i == j { format!("representable(strain[{j}][{i}])") } else { format!("without_dust(strain[{j}][{i}])") }
    };
    let store_full: String = (0..9).map(|e| format!("{} = {};\n", value(e), kept(e / 3, e % 3))).collect();
    let entries = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];
    let store_sym: String =
        entries.iter().enumerate().map(|(e, &(i, j))| format!("{} = {};\n", value(e), kept(i, j))).collect();
    let load = load + &branch(&load_full, &load_sym);
    let store = branch(&(store_full + &history(true, true)), &(store_sym + &history(false, true))) + &store;
    let conditions = [("damps", damps), ("stiffens", stiffens(plan)), ("def_grads", any(true)), ("lefts", any(false))];
    let deform = chosen(include_str!("../wgsl/deform.wgsl"), &conditions);
    text += &unrolled(&deform, &[("load", &load), ("store", &store)]);
    Ok(text)
}

/// Does a law's stiffness follow the state?
pub(crate) fn hardens(planned: &PlannedMaterial) -> bool {
    planned.material.has(barchan_abi::BARCHAN_CAP_HARDENS) && planned.material.table.tangent_moduli_f32.is_some()
}

/// Is such a law asked on the device, in each step?
pub(crate) fn is_asked_on_device(planned: &PlannedMaterial) -> bool {
    hardens(planned) && !planned.material.wgsl_stiffness.is_empty()
}

/// Is it asked on the host now and then, because it has no WGSL for that?
pub(crate) fn is_asked_on_host(planned: &PlannedMaterial) -> bool {
    hardens(planned) && planned.material.wgsl_stiffness.is_empty()
}
