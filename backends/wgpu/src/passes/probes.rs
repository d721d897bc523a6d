//! What crosses the sections of probes, what walls take, sums over regions, single particles, and heights of the ground.

use crate::passes::binding::{
    CELLS, Draft, Groups, IDS, LISTS, NODES, OWNERS, RECORD, REST, Role, STATUS, Uniform, Use, blocks,
};
use crate::passes::conditions::chosen;
use barchan_core::Plan;
use barchan_core::plan::PlannedMaterial;
use barchan_grid::wgsl;
use std::fmt::Write as _;

const DIGITS: &str = include_str!("../wgsl/digits.wgsl");
const PROBED: &str = include_str!("../wgsl/probed.wgsl");

const LOOKED: Use = ("looked", "u32", Role::Sought, true);

/// What has crossed sections in a step.
pub(crate) fn flux(plan: &Plan, sleeps: bool) -> Draft {
    let probed: Use = ("probed", "atomic<u32>", Role::Crossed, true);
    let body = chosen(include_str!("../wgsl/flux.wgsl"), &[("sleeps", sleeps)]);
    let mut uses = vec![RECORD, REST, IDS, LISTS, CELLS, STATUS, probed];
    uses.extend(sleeps.then_some(OWNERS));
    Draft {
        name: "flux",
        entry: "see_crossed",
        body: [counts(plan).as_str(), DIGITS, PROBED, if sleeps { wgsl::WATCH_WORDS } else { "" }, &body].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(plan.cell_widths.len() > 1),
        checked: true,
    }
}

/// What parts of walls take in a step.
pub(crate) fn pressed(plan: &Plan, sleeps: bool) -> Draft {
    let probed: Use = ("probed", "atomic<u32>", Role::Crossed, true);
    let body = chosen(include_str!("../wgsl/pressed.wgsl"), &[("sleeps", sleeps)]);
    let watch = if sleeps { wgsl::WATCH_WORDS } else { "" };
    let mut uses = vec![RECORD, LISTS, CELLS, NODES, STATUS, probed];
    uses.extend(sleeps.then_some(OWNERS));
    Draft {
        name: "press on walls",
        entry: "see_pressed",
        body: [counts(plan).as_str(), DIGITS, PROBED, wgsl::REACHES_WALL, wgsl::WALL, watch, &body].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(plan.cell_widths.len() > 1),
        checked: true,
    }
}

/// How many sections there are, parts of walls, and both.
fn counts(plan: &Plan) -> String {
    let (sections, parts) = (plan.scene.sections().count(), plan.scene.wall_parts().count());
    let all = sections + parts;
    format!("const SECTIONS: u32 = {sections}u;\nconst PARTS: u32 = {parts}u;\nconst PROBED: u32 = {all}u;\n")
}

/// Sums over regions, between steps.
pub(crate) fn sums(materials: &[PlannedMaterial]) -> Draft {
    let probed: Use = ("probed", "atomic<u32>", Role::Sought, true);
    let mut text = "fn has_def_grad(law: u32) -> bool { switch law { ".to_owned();
    for (law, planned) in materials.iter().enumerate() {
        let _ = write!(text, "case {law}u: {{ return {}; }} ", planned.material.strain_planes() == 9);
    }
    text += "default: { return false; } } }\n";
    Draft {
        name: "sums",
        entry: "sum_regions",
        body: [&text, DIGITS, PROBED, include_str!("../wgsl/sums.wgsl")].concat(),
        uses: vec![RECORD, REST, IDS, LISTS, CELLS, probed],
        uniform: Uniform::None,
        groups: Groups::Blocks,
        checked: true,
    }
}

/// Copies what is asked for of single particles, between steps.
pub(crate) fn sample() -> Draft {
    Draft {
        name: "sample",
        entry: "sample",
        body: include_str!("../wgsl/sample.wgsl").to_owned(),
        uses: vec![RECORD, LISTS, CELLS, LOOKED],
        uniform: Uniform::None,
        groups: Groups::Blocks,
        checked: true,
    }
}

/// Heights of the ground at points, between steps.
pub(crate) fn heights() -> Draft {
    Draft {
        name: "heights",
        entry: "find_heights",
        body: include_str!("../wgsl/heights.wgsl").to_owned(),
        uses: vec![RECORD, REST, LISTS, CELLS, LOOKED],
        uniform: Uniform::None,
        groups: Groups::Blocks,
        checked: true,
    }
}
