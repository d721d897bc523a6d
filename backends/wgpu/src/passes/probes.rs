//! What crosses the sections of probes, what walls take, sums over regions, single particles, heights of the ground, and how far particles and points are apart.

use crate::passes::binding::{
    CELLS, DIRECTORY, Draft, Found, GRID, Groups, HANDED, IDS, LISTS, NODES, OWNERS, RECORD, REST, RIMS, Role, STATUS,
    Uniform, Use, WATCH, blocks, on_listed, written,
};
use crate::passes::conditions::chosen;
use crate::passes::grid::sums_of_tiles;
use crate::passes::rims::hand_on;
use barchan_core::Plan;
use barchan_core::plan::PlannedMaterial;
use barchan_grid::wgsl;
use std::fmt::Write as _;

const DIGITS: &str = include_str!("../wgsl/digits.wgsl");
const PROBED: &str = include_str!("../wgsl/probed.wgsl");

const LOOKED: Use = ("looked", "u32", Role::Sought, true);
/// The same where many add to it.
const SOUGHT: Use = ("probed", "atomic<u32>", Role::Sought, true);

/// What has crossed sections in a step.
pub(crate) fn flux(plan: &Plan, sleeps: bool) -> Draft {
    let body = chosen(include_str!("../wgsl/flux.wgsl"), &[("sleeps", sleeps)]);
    let mut uses = vec![RECORD, REST, IDS, LISTS, CELLS, STATUS, PROBED_IN_STEPS];
    uses.extend(sleeps.then_some(OWNERS));
    Draft {
        name: "flux",
        entry: "see_crossed",
        body: [counts(plan).as_str(), DIGITS, PROBED, if sleeps { wgsl::OF_SLEEPERS } else { "" }, &body].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(plan.cell_widths.len() > 1),
        checked: true,
    }
}

/// Where what crosses sections and what parts of walls take is summed.
const PROBED_IN_STEPS: Use = ("probed", "atomic<u32>", Role::Crossed, true);

/// For passes that find what parts of walls take; they bind [`PROBED_IN_STEPS`].
fn parts(plan: &Plan) -> String {
    [counts(plan).as_str(), DIGITS, PROBED, include_str!("../wgsl/wall_parts.wgsl")].concat()
}

/// What parts of walls take in a step.
pub(crate) fn pressed(plan: &Plan, sleeps: bool) -> Draft {
    let levels = plan.cell_widths.len() > 1;
    let body = chosen(include_str!("../wgsl/pressed.wgsl"), &[("sleeps", sleeps), ("levels", levels)]);
    let asleep = if sleeps { [wgsl::WATCH_WORDS, wgsl::OF_SLEEPERS].concat() } else { String::new() };
    let take_up = if levels { include_str!("../wgsl/take_up.wgsl") } else { "" };
    let mut uses = vec![RECORD, LISTS, CELLS, NODES, STATUS, PROBED_IN_STEPS];
    uses.extend(sleeps.then_some([OWNERS, WATCH]).into_iter().flatten());
    Draft {
        name: "press on walls",
        entry: "see_pressed",
        body: [&parts(plan), take_up, wgsl::REACHES_WALL, wgsl::WALL, &asleep, &body].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(levels),
        checked: true,
    }
}

/// What parts of walls take through rims.
pub(crate) fn pressed_rims(plan: &Plan) -> Draft {
    on_listed(
        Found::Rims,
        Draft {
            name: "press on walls at rims",
            entry: "see_rims",
            body: [
                &parts(plan),
                &sums_of_tiles(1),
                &hand_on(),
                include_str!("../wgsl/velocity_at.wgsl"),
                include_str!("../wgsl/pressed_rims.wgsl"),
            ]
            .concat(),
            uses: vec![written(LISTS), GRID, STATUS, DIRECTORY, RIMS, written(HANDED), PROBED_IN_STEPS],
            uniform: Uniform::None,
            groups: Groups::NodeBlocks,
            checked: true,
        },
    )
}

/// The pass in which images take the velocities of nodes before a wall that lets go, where probes ask what parts of it take.
pub(crate) fn also_pressed(plan: &Plan, draft: Draft) -> Draft {
    let uses = draft.uses.into_iter().chain([PROBED_IN_STEPS]).collect();
    Draft { body: parts(plan) + &draft.body, uses, ..draft }
}

/// How many sections there are, parts of walls, and both.
fn counts(plan: &Plan) -> String {
    let (sections, parts) = (plan.scene.sections().count(), plan.scene.wall_parts().count());
    let all = sections + parts;
    format!("const SECTIONS: u32 = {sections}u;\nconst PARTS: u32 = {parts}u;\nconst PROBED: u32 = {all}u;\n")
}

/// Sums over regions, between steps.
pub(crate) fn sums(materials: &[PlannedMaterial]) -> Draft {
    let mut text = "fn has_def_grad(law: u32) -> bool { switch law { ".to_owned();
    for (law, planned) in materials.iter().enumerate() {
        let _ = write!(text, "case {law}u: {{ return {}; }} ", planned.material.strain_planes() == 9);
    }
    text += "default: { return false; } } }\n";
    Draft {
        name: "sums",
        entry: "sum_regions",
        body: [&text, DIGITS, PROBED, include_str!("../wgsl/sums.wgsl")].concat(),
        uses: vec![RECORD, REST, IDS, LISTS, CELLS, SOUGHT],
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

/// How far particles are from points, between steps.
pub(crate) fn apart() -> Draft {
    Draft {
        name: "apart",
        entry: "sum_distances",
        body: [DIGITS, PROBED, include_str!("../wgsl/apart.wgsl")].concat(),
        uses: vec![RECORD, IDS, LISTS, CELLS, SOUGHT],
        uniform: Uniform::None,
        groups: Groups::Blocks,
        checked: true,
    }
}

/// The particles nearest to points, between steps.
pub(crate) fn nearest() -> Draft {
    Draft {
        name: "nearest",
        entry: "find_nearest",
        body: [DIGITS, PROBED, include_str!("../wgsl/nearest.wgsl")].concat(),
        uses: vec![RECORD, IDS, LISTS, CELLS, SOUGHT],
        uniform: Uniform::None,
        groups: Groups::Blocks,
        checked: true,
    }
}
