//! Grid to particles.

use crate::passes::binding::{
    Draft, Groups, IDS, LISTS, NODES, OWNERS, RECORD, REST, Role, STATUS, Uniform, Use, WATCH, written,
};
use crate::passes::conditions::chosen;
use crate::passes::scene::{damps, stiffens};
use crate::passes::unrolled::{gather, unrolled};
use barchan_core::Plan;
use barchan_grid::wgsl;
use barchan_grid::wgsl::G2P;

/// From so many particles on, G2P's threads take several each, so that workgroups start less often. For fewer the loop costs more than it saves.
pub(crate) const VERY_MANY: usize = 1 << 22;
/// Origin of the materials that come with the project.
pub(crate) const BUILT_IN: &str = "built-in";

pub(crate) fn g2p(plan: &Plan, laws: &str, sleeps: bool, [particles, layers]: [usize; 2]) -> Draft {
    let (asks, several) = (layers > 1 || sleeps, particles >= VERY_MANY);
    let (stiffens, damps) = (stiffens(plan), damps(&plan.materials));
    let conditions =
        [("sleeps", sleeps), ("asks", asks), ("several", several), ("stiffens", stiffens), ("damps", damps)];
    let by_workgroup = if several { 512 } else { 128 };
    let body = unrolled(&chosen(G2P, &conditions), &[("gather", &gather())]);
    let body = [
        format!("const BY_WORKGROUP: u32 = {by_workgroup}u;\n").as_str(),
        if asks { include_str!("../wgsl/asking.wgsl") } else { "" },
        if damps { concat!(include_str!("../wgsl/digits.wgsl"), include_str!("../wgsl/damped.wgsl")) } else { "" },
        &body,
    ]
    .concat();
    let watch = if sleeps { [wgsl::WATCH_WORDS, wgsl::OF_SLEEPERS, wgsl::WATCH_G2P].concat() } else { String::new() };
    let mut uses = vec![written(RECORD), written(REST), OWNERS, LISTS, NODES, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    Draft {
        name: "G2P",
        entry: "g2p",
        body: body + &watch + laws,
        uses,
        uniform: Uniform::Params,
        groups: Groups::ParticlesBy(by_workgroup),
        // Particles and the nodes around their blocks are those that a sort has found. What plugins wrote may ask for anything.
        checked: plan.materials.iter().any(|m| m.material.origin != BUILT_IN),
    }
}

pub(crate) fn stress(laws: &str) -> Draft {
    Draft {
        name: "stress",
        entry: "stress_of_all",
        body: include_str!("../wgsl/stress.wgsl").to_owned() + laws,
        uses: vec![written(RECORD), written(REST), STATUS],
        uniform: Uniform::Params,
        groups: Groups::ParticlesBy(128),
        checked: true,
    }
}

/// The cells around soft bodies after a step, and whether levels must move before the next one.
pub(crate) fn soft(bodies: &[u16]) -> [Draft; 2] {
    let cases: String =
        bodies.iter().enumerate().map(|(i, body)| format!("case {body}u: {{ return {i}u; }} ")).collect();
    let constants = format!("const SOFTS: u32 = {}u;\n", bodies.len());
    let number = format!("fn number_of(body: u32) -> u32 {{ switch body {{ {cases}default: {{ return NONE; }} }} }}\n");
    let softs: Use = ("softs", "atomic<i32>", Role::Soft, true);
    let draft = |name, entry, body: String, uses, groups| Draft {
        name,
        entry,
        body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    let measure = constants.clone() + &number + include_str!("../wgsl/soft.wgsl");
    let uses = vec![RECORD, IDS, OWNERS, LISTS, softs, STATUS];
    [
        draft("soft bodies", "measure", measure, uses, Groups::ParticlesBy(128)),
        draft(
            "follow",
            "watch_soft",
            constants + include_str!("../wgsl/soft_watch.wgsl"),
            vec![softs, STATUS],
            Groups::One,
        ),
    ]
}
