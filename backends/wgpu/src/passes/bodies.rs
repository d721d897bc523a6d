//! Contact with bodies, and the motion of those that answer.

use crate::device::Gpu;
use crate::device::memory::Answering;
use crate::device::memory::{MAX_SLOTS, NEAR_BLOCK};
use crate::passes::Kernels;
use crate::passes::binding::{
    ANSWERING, CELLS, Draft, Found, GRID, Groups, Kernel, LISTS, NODES, OWN, RECORD, RIMS, Role, STATUS, Uniform, Use,
    build, build_for, exchange, node_blocks, written,
};
use crate::passes::binding::{Setting, compose};
use crate::passes::coupling_check::workgroup_bytes;
use crate::passes::couplings::Laws;
use crate::passes::rims::at_rims;
use crate::passes::scene::coupling_table;
use barchan_core::contact;
use barchan_grid::rest::NEAR_TOOL;
use barchan_grid::wgsl;

/// Contact with driven bodies on the device, so many in each of the worlds, whose tables have so many vectors, of which the last are the
/// materials', beside those that answer: how particles press, the law, then the sums of impulses, level by level.
pub(crate) fn contact(
    gpu: &Gpu,
    kernels: &Kernels,
    laws: &Laws,
    counts: [usize; 3],
    shape: [usize; 2],
    room: Answering,
) -> [Kernel; 3] {
    let drafts = contact_drafts(kernels.set.solve.is_some(), laws, counts, shape, room);
    drafts.map(|draft| build(gpu, &kernels.step_layout, &kernels.setting, shape[0], draft))
}

pub(crate) fn contact_drafts(
    subcycled: bool,
    laws: &Laws,
    [bodies, vectors, materials]: [usize; 3],
    [worlds, levels]: [usize; 2],
    room: Answering,
) -> [Draft; 3] {
    let count = format!("const BODIES: u32 = {bodies}u;\n");
    let body = include_str!("../wgsl/body.wgsl");
    let (stored, table) = coupling_table([worlds, levels], vectors, laws.samples.len());
    let bodies_now: Use = ("bodies", "vec4<f32>", Role::Bodies, false);
    let partials: Use = ("partials", "vec4<f32>", Role::Partials, false);
    let impulses: Use = ("impulses", "vec4<f32>", Role::Impulses, true);
    let of_bodies = [&count, body, contact::wgsl::PRESS_DRIVEN].concat();
    let press =
        press_draft("press", laws, &of_bodies, [vectors, materials], [worlds, levels], [bodies_now, written(partials)]);
    let (text, own) = of_own_mass(subcycled, contact::wgsl::CONTACT);
    let mirrors = wgsl::MIRRORS;
    // Where levels take steps of their own, leashes keep bodies that answer away from driven ones' nodes.
    let beside = room.groups > 0 && !subcycled;
    let keeper = if beside {
        let of_answering = include_str!("../wgsl/answering.wgsl");
        answering_counts(room, laws) + of_answering + include_str!("../wgsl/contact_beside_answering.wgsl")
    } else {
        include_str!("../wgsl/contact_alone.wgsl").to_owned()
    };
    let contact = Draft {
        name: "contact",
        entry: "contact",
        body: [&count, body, mirrors, &table, &laws.wgsl, &keeper, text.as_str()].concat(),
        uses: [LISTS, GRID, bodies_now, written(partials), STATUS]
            .into_iter()
            .chain(own)
            .chain(beside.then_some(ANSWERING))
            .collect(),
        uniform: Uniform::Table { stored, counted: laws.counted },
        groups: node_blocks(levels > 1),
        checked: true,
    };
    let sums = Draft {
        name: "impulse",
        entry: "impulse_on_bodies",
        body: count + include_str!("../wgsl/impulse.wgsl"),
        uses: vec![partials, impulses, STATUS],
        uniform: Uniform::None,
        groups: Groups::Exactly((bodies * worlds * levels) as u32),
        checked: true,
    };
    [press, contact, sums]
}

/// From so many worlds on a device is busy with blocks near bodies, however few threads each has.
const BUSY: usize = 32;

/// Threads of a workgroup that find how particles press. In few worlds a block's particles wait for as many threads as there can be; in many, blocks wait for one another, and
/// those that no body is near are done with the sooner the fewer threads they have. A software adapter runs all of the text for each eight threads, wanted or not.
pub(crate) fn pressing(is_software: bool, worlds: usize) -> String {
    format!("const PRESSING: u32 = {}u;\n", if is_software || worlds >= BUSY { 64 } else { 256 })
}

/// How particles press on bodies; `of_bodies` says where these are, and where the forces go.
pub(crate) fn press_draft<const N: usize>(
    name: &'static str,
    laws: &Laws,
    of_bodies: &str,
    [vectors, materials]: [usize; 2],
    shape: [usize; 2],
    uses: [Use; N],
) -> Draft {
    let of_materials = format!("const MATERIALS: u32 = {materials}u;\nconst MODULI: u32 = {}u;\n", vectors - materials);
    let (stored, table) = coupling_table(shape, vectors, laws.samples.len());
    Draft {
        name,
        entry: "press",
        body: [
            &of_materials,
            contact::wgsl::PRESSED,
            &table,
            &laws.wgsl,
            of_bodies,
            include_str!("../wgsl/rounds.wgsl"),
            contact::wgsl::PRESS,
        ]
        .concat(),
        uses: [LISTS, CELLS, RECORD, STATUS].into_iter().chain(uses).collect(),
        uniform: Uniform::Table { stored, counted: laws.counted },
        groups: node_blocks(shape[1] > 1),
        checked: true,
    }
}

/// Blocks at rims that a workgroup takes up in the pass of bodies that answer and rims.
pub(crate) const RIMS_BESIDE: u32 = 8;

/// How particles press on bodies that answer, and the pass of their contact and their motion; and does that pass do what is to be done at rims, too? So it is
/// if no body `roams`, which is to come near coarser levels, and if the adapter lets a pass bind so much and its workgroups be so wide.
pub(crate) fn answer(
    gpu: &Gpu,
    kernels: &Kernels,
    laws: &Laws,
    [vectors, materials]: [usize; 2],
    shape: [usize; 2],
    room: Answering,
    roams: bool,
) -> ([Kernel; 2], bool) {
    let (subcycled, sleeps) = (kernels.set.solve.is_some(), kernels.set.watch.is_some());
    let draft = |rims| answer_draft([subcycled, sleeps, rims], laws, vectors, shape, room);
    let (layout, setting) = (&kernels.step_layout, &kernels.setting);
    let press = build(gpu, layout, setting, shape[0], press_answering_draft(laws, [vectors, materials], shape, room));
    // Walls that let go come between bodies and rims.
    let is_apart =
        roams || shape[1] == 1 || !kernels.set.mirror.is_empty() || shape[0] * room.groups > kernels.free_room;
    let with_rims = draft(true);
    let limits = &gpu.limits;
    let fits = with_rims.bindings(shape[0]) <= limits.max_storage_buffers_per_shader_stage as usize
        && (room.together == 1 || fits_workgroups(gpu, &kernels.setting, shape[0], &with_rims))
        && 64 * RIMS_BESIDE <= limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x);
    if is_apart || !fits {
        return ([press, build(gpu, layout, setting, shape[0], draft(false))], false);
    }
    ([press, build_for(gpu, layout, setting, shape[0], with_rims)], true)
}

/// Does what a pass of several bodies keeps for a workgroup fit the adapter's memory for that?
pub(crate) fn fits_workgroups(gpu: &Gpu, setting: &Setting, worlds: usize, draft: &Draft) -> bool {
    let bytes = workgroup_bytes(&compose(setting, worlds, draft).text);
    bytes.is_none_or(|bytes| bytes <= u64::from(gpu.limits.max_compute_workgroup_storage_size))
}

pub(crate) fn press_answering_draft(laws: &Laws, counts: [usize; 2], shape: [usize; 2], room: Answering) -> Draft {
    let constants = answering_counts(room, laws);
    let of_bodies =
        [constants.as_str(), include_str!("../wgsl/answering.wgsl"), wgsl::MIRRORS, contact::wgsl::PRESS_ANSWERING]
            .concat();
    press_draft("press on answering bodies", laws, &of_bodies, counts, shape, [ANSWERING])
}

fn answering_counts(room: Answering, laws: &Laws) -> String {
    format!(
        "const GROUPS: u32 = {}u;\nconst ANSWERING: u32 = {}u;\nconst GROUP_BODIES: u32 = {}u;\nconst GROUP_WORDS: u32 = {}u;\nconst GROUP_TOLD: u32 = {}u;\n\
         const GROUP_RATES: u32 = {}u;\nconst MAX_SLOTS: u32 = {MAX_SLOTS}u;\nconst REACH: f32 = {:?};\n",
        room.groups, room.bodies, room.together, room.words, room.told, room.rates, laws.reach,
    )
}

/// `rims`: with what is done at rims, for bodies that meet the finest level alone.
pub(crate) fn answer_draft(
    [subcycled, sleeps, rims]: [bool; 3],
    laws: &Laws,
    vectors: usize,
    [worlds, levels]: [usize; 2],
    room: Answering,
) -> Draft {
    let tools: Use = ("tools", "vec4<i32>", Role::Tools, true);
    let counts = answering_counts(room, laws) + &format!("const NEAR_TOOL: f32 = {NEAR_TOOL:?};\n");
    let (stored, table) = coupling_table([worlds, levels], vectors, laws.samples.len());
    let awake = if sleeps { include_str!("../wgsl/answer_awake.wgsl") } else { "" };
    let group = include_str!("../wgsl/group.wgsl").replace("$STAY_AWAKE", awake);
    // Nodes of the finest level are no finer one's.
    let (text, own) = of_own_mass(subcycled && !rims, include_str!("../wgsl/answer.wgsl"));
    let parts = [
        // Eleven columns of 65 rows; see `answer.wgsl`.
        &exchange(715),
        &counts,
        include_str!("../wgsl/answering.wgsl"),
        &table,
        &laws.wgsl,
        contact::wgsl::SEARCH,
        &group,
        &laws.answer,
        &text,
    ];
    let alone = Draft {
        name: "answering bodies",
        entry: "answering_bodies",
        body: parts.concat(),
        uses: [GRID, ANSWERING, STATUS].into_iter().chain(own).chain(sleeps.then_some(tools)).collect(),
        uniform: Uniform::Table { stored, counted: laws.counted },
        groups: Groups::Exactly((worlds * room.groups) as u32 + 1),
        checked: true,
    };
    if !rims {
        return Draft { body: alone.body + include_str!("../wgsl/answer_alone.wgsl"), ..alone };
    }
    let of_rims = at_rims(subcycled, RIMS_BESIDE);
    let further: Vec<_> = of_rims.uses.into_iter().filter(|rim| alone.uses.iter().all(|own| own.2 != rim.2)).collect();
    Draft {
        name: "answering bodies, rims",
        entry: "answering_and_rims",
        body: alone.body + &of_rims.body + include_str!("../wgsl/answer_and_rims.wgsl"),
        uses: alone.uses.into_iter().chain(further).collect(),
        groups: Groups::Found(Found::BodiesAndRims),
        ..alone
    }
}

/// Contact whose law runs on the host.
pub(crate) struct NearKernels {
    /// Nodes near bodies come to the host, then particles.
    pub(crate) gather: [Kernel; 2],
    /// Nodes take what the law made of them.
    pub(crate) scatter: Kernel,
}

pub(crate) fn near(gpu: &Gpu, kernels: &Kernels, worlds: usize) -> NearKernels {
    let drafts = near_drafts(kernels.set.solve.is_some());
    let [nodes, particles, scatter] =
        drafts.map(|draft| build(gpu, &kernels.step_layout, &kernels.setting, worlds, draft));
    NearKernels { gather: [nodes, particles], scatter }
}

pub(crate) fn near_drafts(subcycled: bool) -> [Draft; 3] {
    let near: Use = ("near", "vec4<u32>", Role::Near, false);
    let around: Use = ("around", "vec4<i32>", Role::Around, false);
    let block = format!("const NEAR_BLOCK: u32 = {NEAR_BLOCK}u;\n");
    let mirrors = wgsl::MIRRORS;
    let (gather, own) = of_own_mass(subcycled, &(mirrors.to_owned() + include_str!("../wgsl/gather.wgsl")));
    let rounds = include_str!("../wgsl/rounds.wgsl");
    let draft = |name, body: &str, uses, groups| Draft {
        name,
        entry: name,
        body: block.clone() + body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    let [nodes, particles] = [
        draft(
            "gather",
            &gather,
            [LISTS, NODES, around, written(near), STATUS].into_iter().chain(own).collect(),
            Groups::NodeBlocks,
        ),
        draft(
            "gather_particles",
            &(rounds.to_owned() + include_str!("../wgsl/gather_particles.wgsl")),
            vec![LISTS, CELLS, RECORD, around, written(near), STATUS],
            Groups::Blocks,
        ),
    ];
    let scatter =
        draft("scatter_near", include_str!("../wgsl/scatter_near.wgsl"), vec![GRID, near, STATUS], Groups::Near);
    [nodes, particles, scatter]
}

/// The text of a pass in which bodies meet nodes, with what these weigh for them, and what it binds besides. Subcycled, a node may be two
/// levels'.
pub(crate) fn of_own_mass(subcycled: bool, text: &str) -> (String, Vec<Use>) {
    if !subcycled {
        return (text.replace("$MASS", "node.w"), Vec::new());
    }
    (include_str!("../wgsl/own.wgsl").to_owned() + &text.replace("$MASS", "own_mass(g, n, node)"), vec![RIMS, OWN])
}
