//! The passes of a plan, in words.

use crate::device::kernel::{Found, Groups};
use crate::device::memory::Answering;
use crate::passes::binding::Draft;
use crate::passes::bodies::answer_draft;
use crate::passes::couplings::Laws;
use crate::passes::drafts;
use crate::passes::laws::is_asked_on_host;
use crate::passes::probes::{apart, nearest, sample, sums};
use crate::passes::scene::{free_bodies, may_sleep, rest_vectors};
use crate::schedule::{ContactPasses, passes};
use barchan_core::scene::Probe;
use barchan_core::{Plan, Result, Stage};
use barchan_grid::limits::STIFFNESS_AGE;

/// The passes of a plan, a line each.
pub(crate) fn describe(plan: &Plan) -> Result<Vec<String>> {
    let set = drafts(plan, 1, plan.particle_count)?;
    let mut lines: Vec<String> = set.sort.iter().map(|draft| line("every 20 steps or sooner", draft)).collect();
    // In the slot with which all levels begin, and in which one ends, there is a call of every stage.
    for call in plan.schedule.of_slot(0) {
        if call.stage == Stage::CONTACT {
            lines.extend(describe_contact(plan));
        }
        let often = if plan.substeps > 1 { "every step of a level" } else { "every step" };
        let own = passes(&set, ContactPasses::default(), &plan.schedule, call);
        lines.extend(own.into_iter().map(|(_, draft)| line(often, draft)));
    }
    lines.extend(set.soft().map(|draft| line("every step", draft)));
    let seldom = set.reflect.iter().filter(|_| set.mirrored && plan.substeps > 1);
    lines.extend(seldom.map(|draft| line("every step in which bodies may come near walls, after theirs", draft)));
    lines.extend(set.collect.iter().map(|draft| line("every submission", draft)));
    lines.extend(set.adapt().map(|draft| line("where levels move or particles leave theirs", draft)));
    lines.push(line("after an upload", &set.stress));
    let asks = |ask: fn(&Probe) -> bool| plan.scene.probe.iter().any(ask);
    if asks(|probe| probe.within.is_some()) {
        lines.push(line("for probes of regions", &sums(&plan.materials)));
    }
    if asks(|probe| probe.nearest.is_some() || probe.chamfer.is_some()) {
        lines.extend([apart(), nearest()].map(|draft| line("for probes of single particles and clouds", &draft)));
    }
    if plan.scene.task.is_some() {
        lines.push(line("for what a task wants to see", &sums(&plan.materials)));
        lines.push(line("for what a task wants to see", &sample()));
    }
    for planned in plan.materials.iter().filter(|planned| is_asked_on_host(planned)) {
        let megabytes = 16.0 * rest_vectors(&plan.materials) as f64 * plan.particle_count as f64 / 1e6;
        lines.push(format!(
            "stiffness, every {STIFFNESS_AGE} steps: material '{}' has no wgsl_stiffness, so all strains and histories are copied to the host ({megabytes:.1} MB), which takes longer than the steps; its author can mend that",
            planned.name
        ));
    }
    Ok(lines)
}

fn describe_contact(plan: &Plan) -> Vec<String> {
    let mut lines = vec!["contact, every step: on the device, but for free bodies near walls or others and for couplings without a law in WGSL: for these nodes near bodies go to the host and back".to_owned()];
    if free_bodies(plan) > 0 {
        let laws = Laws::none();
        let room = Answering { groups: 1, bodies: 1, together: 1, words: 1, told: 0, rates: 0, rooms: 8, widest: 8 };
        let kinds = [false, true].into_iter().filter(|&rims| !rims || plan.cell_widths.len() > 1);
        lines.extend(kinds.map(|rims| {
            let motion = answer_draft([plan.substeps > 1, may_sleep(plan), rims], &laws, 1, [1, 1], room);
            let of_rims = if plan.substeps > 1 { "solve" } else { "prolong" };
            let when = if rims {
                format!(", in place of that and {of_rims}, if levels follow them all and a pass may bind so much and be so wide")
            } else {
                String::new()
            };
            line(&format!("every step with free bodies, but near walls and other bodies{when}"), &motion)
        }));
    }
    lines
}

/// One pass: when, how many workgroups, and the buffers it binds.
fn line(when: &str, draft: &Draft) -> String {
    let groups = match draft.groups {
        Groups::One => "one workgroup".to_owned(),
        Groups::Layers => "a workgroup a layer".to_owned(),
        Groups::LayersBy(n) => format!("a workgroup for {n} layers"),
        Groups::Exactly(count) => format!("{count} workgroups"),
        Groups::Blocks => "a workgroup a block with particles".to_owned(),
        Groups::NodeBlocks => "a workgroup a block of nodes".to_owned(),
        Groups::Near => "a workgroup a block of nodes near bodies".to_owned(),
        Groups::BlocksBy(n) => format!("a workgroup for {n} blocks"),
        Groups::ParticlesBy(n) => format!("a workgroup for {n} particles"),
        Groups::PlacesBy(n) => format!("a workgroup for {n} places of the directory"),
        Groups::Found(found) => format!(
            "a workgroup {} of the levels whose step it is",
            match found {
                Found::Blocks => "a block with particles",
                Found::NodeBlocks => "a block of nodes",
                Found::Rims => "a block of nodes at rims",
                Found::Givers => "a block with particles, and another where these give to nodes that levels share,",
                Found::Walled => "a block at walls",
                Found::RimsInFours =>
                    "for four blocks of nodes at rims or shared with the next finer level or, where mirrors are found with these, at walls",
                Found::BodiesAndRims =>
                    "a group of bodies that answer, one more, and one for eight blocks of nodes at rims, shared, or at walls,",
            }
        ),
    };
    let names = |write: bool| {
        let names: Vec<_> = draft.uses.iter().filter(|u| u.3 == write).map(|u| u.0).collect();
        if names.is_empty() { "nothing".to_owned() } else { names.join(", ") }
    };
    format!("{}, {when}: {groups}; reads {}; writes {}", draft.name, names(false), names(true))
}
