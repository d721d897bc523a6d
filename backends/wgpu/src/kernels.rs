//! The passes: their WGSL, what they bind, and their pipelines.

use crate::batch::MANY;
use crate::device::Gpu;
use crate::layout::{BESIDE, BESIDE_BY, LEFT_HOME, RECORD as RECORD_PLANES, ROUNDS, TOGETHER};
use crate::material;
use crate::memory::{MAX_SLOTS, MAX_STEPS, NEAR_BLOCK};
use crate::schedule::{ContactPasses, passes};
use crate::stiffness::{is_asked_on_device, is_asked_on_host};
use crate::world::{
    OFTEN_DRIFT, SELDOM_DRIFT, SORT_AGE, SORT_DRIFT, SORT_OFTEN, SORT_SELDOM, STIFFNESS_AGE, most_drift,
};
use barchan_core::coupling::DeviceLaw;
use barchan_core::levels::{Agent, MERGE_BEHIND, SPLIT_AHEAD};
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::{Leaving, Motion, Wall};
use barchan_core::{Plan, Result, Stage};
use barchan_grid::adapt::finest_volumes;
use barchan_grid::bounds::Bounds;
use barchan_grid::rest::{NEAR_TOOL, RESTED};
use std::fmt::Write as _;

/// Planes of particles, and what a sort lays out anew: there are two of each, one of which a sort writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sorted {
    Record,
    Ids,
    Rest,
    Lists,
    Cells,
    /// What is known of the rest of blocks.
    Watch,
}

/// A buffer as a pass sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Now(Sorted),
    Next(Sorted),
    Grid,
    Status,
    Flags,
    Directory,
    Sums,
    Keys,
    Loose,
    Order,
    /// Each particle's block and mass.
    Owners,
    Pairs,
    /// Poses and motions of bodies, for each step of a submission.
    Bodies,
    /// What each node block gives to each body, and how particles press on it at each node.
    Partials,
    /// What each step gave to each body.
    Impulses,
    /// Free bodies, their states in each step of a submission, and the nodes inside them.
    Lent,
    /// Nodes at rims of levels, and who gives to them.
    Rims,
    /// What each block hands to the next coarser level.
    Handed,
    /// What nodes keep that two levels share in subcycling.
    Shared,
    /// Boxes around bodies whose law runs on the host.
    Around,
    /// Blocks of nodes in them, there and back.
    Near,
    /// Boxes of blocks near tools, in which nothing sleeps.
    Tools,
    /// Soft bodies that levels follow.
    Soft,
    /// Tiles of unbounded ground that are live.
    Live,
    /// Blocks that only some passes visit; see `listed.wgsl`.
    Listed,
    /// Workgroups of the passes of a step, as the last sort has counted them.
    Groups,
}

/// One binding: its name and type in WGSL, the buffer, and whether it is written.
type Use = (&'static str, &'static str, Role, bool);

const RECORD: Use = ("record", "vec4<u32>", Role::Now(Sorted::Record), false);
const REST: Use = ("rest", "vec4<f32>", Role::Now(Sorted::Rest), false);
const LISTS: Use = ("lists", "vec4<i32>", Role::Now(Sorted::Lists), false);
const CELLS: Use = ("cells", "u32", Role::Now(Sorted::Cells), false);
const GRID: Use = ("grid", "vec4<f32>", Role::Grid, true);
const NODES: Use = ("grid", "vec4<f32>", Role::Grid, false);
const STATUS: Use = ("status", "atomic<u32>", Role::Status, true);
const FLAGS: Use = ("flags", "u32", Role::Flags, false);
const DIRECTORY: Use = ("directory", "vec2<u32>", Role::Directory, false);
const SUMS: Use = ("sums", "vec2<u32>", Role::Sums, false);
const KEYS: Use = ("keys", "vec2<u32>", Role::Keys, false);
const LOOSE: Use = ("loose", "u32", Role::Loose, false);
const ORDER: Use = ("order", "u32", Role::Order, false);
const OWNERS: Use = ("owners", "vec2<u32>", Role::Owners, false);
const IDS: Use = ("ids", "vec2<u32>", Role::Now(Sorted::Ids), false);
const COUNTS: Use = ("counts", "u32", Role::Next(Sorted::Cells), false);
/// The same once they are starts.
const NEW_CELLS: Use = ("cells", "u32", Role::Next(Sorted::Cells), false);
const NEW_LISTS: Use = ("lists", "vec4<i32>", Role::Next(Sorted::Lists), true);
const RIMS: Use = ("rims", "vec4<u32>", Role::Rims, false);
const HANDED: Use = ("handed", "vec4<f32>", Role::Handed, false);
const KEPT: Use = ("shared_nodes", "vec4<f32>", Role::Shared, true);
const OWN: Use = ("shared_nodes", "vec4<f32>", Role::Shared, false);
const LIVE: Use = ("live", "vec2<i32>", Role::Live, false);
const LISTED: Use = ("listed", "u32", Role::Listed, false);
const LENT_BODIES: Use = ("lent", "vec4<u32>", Role::Lent, true);
const PAIRS: Use = ("pairs", "vec4<f32>", Role::Pairs, true);
const WATCH: Use = ("watch", "atomic<u32>", Role::Now(Sorted::Watch), true);

const fn written(binding: Use) -> Use {
    (binding.0, binding.1, binding.2, true)
}

/// For a pass that writes particles, in some order, where the next sort would.
fn particles_to_next() -> Vec<Use> {
    let next = [next("new_record", RECORD), next("new_ids", IDS), next("new_rest", REST)];
    [ORDER, RECORD, IDS, REST].into_iter().chain(next).chain([STATUS]).collect()
}

/// Of the set of buffers that does not hold the particles.
const fn next(name: &'static str, binding: Use) -> Use {
    let Role::Now(sorted) = binding.2 else { panic!("only what is sorted has a next") };
    (name, binding.1, Role::Next(sorted), true)
}

const fn atomic(binding: Use) -> Use {
    (binding.0, "atomic<u32>", binding.2, true)
}

/// How many workgroups a pass takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Groups {
    /// One.
    One,
    /// One a layer.
    Layers,
    /// One for this many layers.
    LayersBy(u32),
    /// One a block with particles.
    Blocks,
    /// One a block of nodes.
    NodeBlocks,
    /// So many.
    Exactly(u32),
    /// One a block of nodes near bodies.
    Near,
    /// One for this many blocks with particles.
    BlocksBy(u32),
    /// One for this many particles.
    ParticlesBy(u32),
    /// One for this many places of the directory.
    PlacesBy(u32),
    /// One for each that the last sort has found on the levels whose step it is.
    Found(Found),
}

/// What a sort counts on levels, for the passes of a step to visit nothing else. It lists rims, givers, walled ones, and those that share nodes with a finer level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Found {
    Blocks,
    NodeBlocks,
    /// Blocks of nodes with some at the rim of their level.
    Rims,
    /// Blocks, and once more those whose particles give to shared nodes.
    Givers,
    /// Blocks, or blocks of nodes of the same number, to which walls or the edge of live ground give something.
    Walled,
    /// In fours those at rims and, subcycled, those that share nodes with the next finer level and that walls are behind.
    RimsInFours,
    /// One more than there are free bodies in the scenes, and behind them the same in eights.
    BodiesAndRims,
}

impl Found {
    /// How many kinds there are, and how many lists.
    pub(crate) const ALL: usize = 7;
    pub(crate) const LISTED: usize = 4;
    /// The first that is listed.
    const FIRST_LIST: usize = 2;
}

/// A table that a pass reads besides.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Uniform {
    None,
    /// The materials' parameters.
    Params,
    /// What the coupling's law reads, stored if it is too much for a uniform; are all of its loops counted?
    Table {
        stored: bool,
        counted: bool,
    },
    /// The boxes of levels.
    Regions,
}

/// A pass.
#[derive(Debug)]
pub(crate) struct Kernel {
    pub(crate) name: &'static str,
    pub(crate) pipeline: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
    /// Buffers in the order of their bindings, and which part of each.
    pub(crate) roles: Vec<(Role, usize)>,
    pub(crate) uniform: Uniform,
    pub(crate) groups: Groups,
}

/// Storage buffers that any adapter lets a pass bind.
const LEAST_BINDINGS: usize = 8;

/// In how many buffers the planes of particles stand: one each where passes may bind so many, so that a binding's greatest size bounds particles
/// alone, and not particles times planes; else all in one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Parts {
    record: usize,
    rest: usize,
}

impl Parts {
    /// Of particles with so many vectors of strain and history.
    pub(crate) fn new(limits: &wgpu::Limits, vectors: usize) -> Self {
        // A sort reads all planes, and writes all.
        let most = LEAST_BINDINGS + 2 * (RECORD_PLANES - 1) + 2 * (vectors - 1);
        if limits.max_storage_buffers_per_shader_stage as usize >= most {
            Self { record: RECORD_PLANES, rest: vectors }
        } else {
            Self { record: 1, rest: 1 }
        }
    }

    /// Of what plays this role.
    pub(crate) fn of(self, role: Role) -> usize {
        match role {
            Role::Now(sorted) | Role::Next(sorted) => self.of_sorted(sorted),
            _ => 1,
        }
    }

    pub(crate) fn of_sorted(self, sorted: Sorted) -> usize {
        match sorted {
            Sorted::Record => self.record,
            Sorted::Rest => self.rest,
            _ => 1,
        }
    }

    /// The WGSL by which a pass reads and writes the vectors of particles by their numbers.
    fn accessors(self, &(name, ty, role, write): &Use) -> String {
        let (Role::Now(sorted) | Role::Next(sorted)) = role else { return String::new() };
        if !matches!(sorted, Sorted::Record | Sorted::Rest) {
            return String::new();
        }
        let parts = self.of_sorted(sorted);
        let each = |line: &dyn Fn(String) -> String| match parts {
            1 => line(format!("{name}[vector(q, k)]")),
            // What the number is, is known when a pass is compiled.
            _ => {
                let case = |k: usize| if k + 1 < parts { format!("case {k}u: {{") } else { "default: {".to_owned() };
                let cases: String =
                    (0..parts).map(|k| format!("{} {} }}\n", case(k), line(format!("{name}_{k}[q]")))).collect();
                format!("switch k {{\n{cases}}}\n")
            }
        };
        let mut text = format!("fn {name}_of(q: u32, k: u32) -> {ty} {{\n{}}}\n", each(&|at| format!("return {at};")));
        if write {
            let body = each(&|at| format!("{at} = value;"));
            let _ = writeln!(text, "fn set_{name}(q: u32, k: u32, value: {ty}) {{\n{body}}}");
        }
        text
    }
}

/// What a scene and the adapter fix for all passes.
#[derive(Debug)]
pub(crate) struct Setting {
    constants: String,
    pub(crate) parts: Parts,
}

/// All passes that a scene calls for: what they are made from, or as a device has compiled them.
#[derive(Debug)]
pub(crate) struct Set<K> {
    /// In the order of a sort.
    pub(crate) sort: Vec<K>,
    /// Who sleeps in a step, if anything ever does.
    pub(crate) watch: Option<K>,
    pub(crate) p2g: K,
    /// What rims hand to the next coarser level.
    pub(crate) restrict: Option<K>,
    /// From tiles to velocities.
    pub(crate) grid: Vec<K>,
    /// Velocities of nodes that two levels share and of those at rims, if there is subcycling.
    pub(crate) solve: Option<K>,
    /// Velocities behind walls that let go.
    pub(crate) mirror: Vec<K>,
    /// Velocities at rims.
    pub(crate) prolong: Option<K>,
    /// Velocities behind mirrors; are they found early, if no body comes near walls? Other worlds of a batch may have such bodies.
    pub(crate) reflect: Option<K>,
    pub(crate) mirrored: bool,
    pub(crate) g2p: K,
    pub(crate) stress: K,
    /// Sums of what walls gave and sleep took.
    pub(crate) collect: Vec<K>,
    /// Where soft bodies are that levels follow.
    pub(crate) soft: Option<[K; 2]>,
    /// Rounds of split and merge, if there are several levels.
    pub(crate) adapt: Option<AdaptSet<K>>,
}

/// What the device does in a round of split and merge.
#[derive(Debug)]
pub(crate) struct AdaptSet<K> {
    /// Finds the particles that it may concern, and copies them.
    pub(crate) find: [K; 4],
    /// Which cells are at least half full.
    pub(crate) fill: K,
    /// Marks those that are to go.
    pub(crate) remove: K,
    /// Stress of those that have come in.
    pub(crate) stress: K,
}

impl<K> Set<K> {
    fn map<L>(self, make: impl Fn(K) -> L) -> Set<L> {
        let all = |passes: Vec<K>| passes.into_iter().map(&make).collect();
        Set {
            sort: all(self.sort),
            watch: self.watch.map(&make),
            p2g: make(self.p2g),
            restrict: self.restrict.map(&make),
            grid: all(self.grid),
            solve: self.solve.map(&make),
            mirror: all(self.mirror),
            prolong: self.prolong.map(&make),
            reflect: self.reflect.map(&make),
            mirrored: self.mirrored,
            g2p: make(self.g2p),
            stress: make(self.stress),
            collect: all(self.collect),
            soft: self.soft.map(|passes| passes.map(&make)),
            adapt: self.adapt.map(|adapt| AdaptSet {
                find: adapt.find.map(&make),
                fill: make(adapt.fill),
                remove: make(adapt.remove),
                stress: make(adapt.stress),
            }),
        }
    }

    /// Where soft bodies are after a step.
    pub(crate) fn soft(&self) -> impl Iterator<Item = &K> {
        self.soft.iter().flatten()
    }
}

/// The passes as a device has compiled them.
#[derive(Debug)]
pub(crate) struct Kernels {
    pub(crate) step_layout: wgpu::BindGroupLayout,
    /// For passes that are made later.
    pub(crate) setting: Setting,
    /// Workgroups for free bodies in passes that begin with them.
    free_room: usize,
    pub(crate) set: Set<Kernel>,
}

/// What the WGSL of a pass is made from.
struct Draft {
    name: &'static str,
    entry: &'static str,
    body: String,
    uses: Vec<Use>,
    uniform: Uniform,
    groups: Groups,
    /// Are indices checked? Leaving it out is for passes whose indices are in range by construction.
    checked: bool,
}

impl Draft {
    /// Does its table stand in a storage buffer?
    fn is_table_stored(&self, worlds: usize) -> bool {
        self.uniform == Uniform::Params && worlds > 1 || matches!(self.uniform, Uniform::Table { stored: true, .. })
    }

    /// Storage buffers that it binds.
    fn bindings(&self, worlds: usize) -> usize {
        self.uses.len() + usize::from(self.is_table_stored(worlds))
    }
}

/// Vectors of four that hold a particle's strain, history and, in their last place, rest volume.
pub(crate) fn rest_vectors(materials: &[PlannedMaterial]) -> usize {
    let most = materials.iter().map(|m| m.material.values()).max();
    // Without a material passes are made for a symmetric strain, and nobody runs them.
    vectors_for(most.unwrap_or(6))
}

/// The same for so many values of strain and history.
pub(crate) fn vectors_for(values: usize) -> usize {
    (values + 1).div_ceil(4)
}

impl Kernels {
    /// The passes of a plan for so many worlds, which begin with so many particles in all.
    pub(crate) fn new(gpu: &Gpu, plan: &Plan, worlds: usize, particles: usize) -> Result<Self> {
        let device = &gpu.device;
        let step_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("step"),
            entries: &[
                entry(0, wgpu::BufferBindingType::Uniform, true),
                entry(1, wgpu::BufferBindingType::Uniform, false),
            ],
        });
        let constants = constants(plan) + &layer_constants(plan, worlds);
        let setting = Setting { constants, parts: Parts::new(&gpu.limits, rest_vectors(&plan.materials)) };
        let set = drafts(plan, worlds, particles)?.map(|draft| build(gpu, &step_layout, &setting, worlds, draft));
        Ok(Self { set, free_room: worlds * free_bodies(plan), setting, step_layout })
    }
}

/// What a plan's passes are made from.
fn drafts(plan: &Plan, worlds: usize, particles: usize) -> Result<Set<Draft>> {
    let separations = separations(plan);
    let walls: Vec<Wall> = (0..3).flat_map(|axis| plan.scene.world.walls.pair(axis)).collect();
    let has_walls = walls.iter().any(|w| !matches!(w, Wall::Open | Wall::Periodic));
    let laws = laws(plan, worlds)?;
    let levels = plan.cell_widths.len() > 1;
    let subcycled = plan.substeps > 1;
    let sleeps = may_sleep(plan);
    let unbounded = plan.terrain.is_some();
    let mirrored = mirrors_early(plan);
    let finish = if !separations.is_empty() {
        Finish::Sums
    } else if mirrored && !levels {
        Finish::Mirrored
    } else {
        Finish::Velocities
    };
    let mut grid = vec![sum_tiles(finish, levels, subcycled, sleeps)];
    grid.extend(separations.iter().map(|&axis| separate(axis, false, levels)));
    if !separations.is_empty() {
        grid.push(velocities(levels));
    }
    if unbounded {
        grid.push(hold(levels));
    }
    let mut collect: Vec<_> = (has_walls || unbounded).then(|| collect(mirrored)).into_iter().collect();
    collect.extend(sleeps.then(sum_sleep));
    Ok(Set {
        sort: sort(plan, worlds),
        watch: sleeps.then(|| watch(levels)),
        p2g: p2g([sleeps, mirrored, levels, subcycled, stiffens(plan)], particles),
        restrict: (levels && !subcycled).then(restrict),
        grid,
        solve: subcycled.then(|| rims_alone(true)),
        mirror: separations.iter().rev().map(|&axis| separate(axis, true, levels)).collect(),
        prolong: (levels && !subcycled).then(|| rims_alone(false)),
        // What holding the edge takes is booked there, too.
        reflect: (has_mirrors(plan) && (!mirrored || levels) || unbounded).then(|| reflect(sleeps, levels, mirrored)),
        mirrored,
        g2p: g2p(plan, &laws, sleeps, [particles, worlds * plan.cell_widths.len()]),
        stress: stress(&laws),
        collect,
        soft: (levels && !softs(plan).is_empty()).then(|| soft(&softs(plan))),
        adapt: levels.then(|| adapt(plan, &laws, worlds)),
    })
}

/// The passes of a plan, a line each.
pub(crate) fn describe(plan: &Plan) -> Result<Vec<String>> {
    let set = drafts(plan, 1, plan.particle_count)?;
    let mut lines: Vec<String> = set.sort.iter().map(|draft| line("every 20 steps or sooner", draft)).collect();
    // In the slot with which all levels begin, and in which one ends, there is a call of every stage.
    for call in plan.schedule.step.iter().filter(|call| call.slot == 0) {
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
    let adapt = set.adapt.iter().flat_map(|a| a.find.iter().chain([&a.fill, &a.remove, &a.stress]));
    lines.extend(adapt.map(|draft| line("where levels move or particles leave theirs", draft)));
    lines.push(line("after an upload", &set.stress));
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
        let law = DeviceLaw::default();
        let free = Free { bodies: 1, across: 2 };
        let kinds = [false, true].into_iter().filter(|&rims| !rims || plan.cell_widths.len() > 1);
        lines.extend(kinds.map(|rims| {
            let motion = free_draft([plan.substeps > 1, may_sleep(plan), rims], &law, 1, [1, 1], free);
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
                    "a free body, one more, and one for eight blocks of nodes at rims, shared, or at walls,",
            }
        ),
    };
    let names = |write: bool| {
        let names: Vec<_> = draft.uses.iter().filter(|u| u.3 == write).map(|u| u.0).collect();
        if names.is_empty() { "nothing".to_owned() } else { names.join(", ") }
    };
    format!("{}, {when}: {groups}; reads {}; writes {}", draft.name, names(false), names(true))
}

/// Contact with driven bodies on the device, so many in each of the worlds, whose tables have so many vectors, of which the last are the
/// materials': how particles press, the law, then the sums of impulses, level by level.
pub(crate) fn contact(
    gpu: &Gpu,
    kernels: &Kernels,
    law: &DeviceLaw,
    [bodies, vectors, materials]: [usize; 3],
    [worlds, levels]: [usize; 2],
) -> [Kernel; 3] {
    let count = format!("const BODIES: u32 = {bodies}u;\n");
    let body = include_str!("wgsl/body.wgsl");
    let (stored, table) = coupling_table([worlds, levels], vectors, law.samples.len());
    let bodies_now: Use = ("bodies", "vec4<f32>", Role::Bodies, false);
    let partials: Use = ("partials", "vec4<f32>", Role::Partials, false);
    let impulses: Use = ("impulses", "vec4<f32>", Role::Impulses, true);
    let of_bodies = [&count, body, include_str!("wgsl/press_driven.wgsl")].concat();
    let press =
        press_draft("press", law, &of_bodies, [vectors, materials], [worlds, levels], [bodies_now, written(partials)]);
    let (text, own) = of_own_mass(kernels.set.solve.is_some(), include_str!("wgsl/contact.wgsl"));
    let mirrors = include_str!("wgsl/mirrors.wgsl");
    let law = Draft {
        name: "contact",
        entry: "contact",
        body: [&count, body, mirrors, &table, &law.wgsl, text.as_str()].concat(),
        uses: [LISTS, GRID, bodies_now, written(partials), STATUS].into_iter().chain(own).collect(),
        uniform: Uniform::Table { stored, counted: law.counted },
        groups: node_blocks(levels > 1),
        checked: true,
    };
    let sums = Draft {
        name: "impulse",
        entry: "impulse_on_bodies",
        body: count + include_str!("wgsl/impulse.wgsl"),
        uses: vec![partials, impulses, STATUS],
        uniform: Uniform::None,
        groups: Groups::Exactly((bodies * worlds * levels) as u32),
        checked: true,
    };
    [press, law, sums].map(|draft| build(gpu, &kernels.step_layout, &kernels.setting, worlds, draft))
}

/// How particles press on bodies; `of_bodies` says where these are, and where the forces go.
fn press_draft<const N: usize>(
    name: &'static str,
    law: &DeviceLaw,
    of_bodies: &str,
    [vectors, materials]: [usize; 2],
    shape: [usize; 2],
    uses: [Use; N],
) -> Draft {
    let of_materials = format!("const MATERIALS: u32 = {materials}u;\nconst MODULI: u32 = {}u;\n", vectors - materials);
    let (stored, table) = coupling_table(shape, vectors, law.samples.len());
    Draft {
        name,
        entry: "press",
        body: [
            &of_materials,
            include_str!("wgsl/pressed.wgsl"),
            &table,
            &law.wgsl,
            of_bodies,
            include_str!("wgsl/rounds.wgsl"),
            include_str!("wgsl/press.wgsl"),
        ]
        .concat(),
        uses: [LISTS, CELLS, RECORD, STATUS].into_iter().chain(uses).collect(),
        uniform: Uniform::Table { stored, counted: law.counted },
        groups: node_blocks(shape[1] > 1),
        checked: true,
    }
}

/// How many free bodies there are in each world, and blocks around each of them along an axis on the finest level, at most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Free {
    pub(crate) bodies: usize,
    pub(crate) across: usize,
}

impl Free {
    /// Blocks around a body on a level.
    pub(crate) fn rooms(self) -> usize {
        self.across.saturating_pow(3)
    }
}

/// Free bodies in each world of a scene.
pub(crate) fn free_bodies(plan: &Plan) -> usize {
    plan.scene.tool.iter().filter(|tool| matches!(tool.motion, Motion::Free { .. })).count()
}

/// Blocks at rims that a workgroup takes up in the pass of free bodies and rims.
const RIMS_BESIDE: u32 = 8;

/// How particles press on free bodies, and the pass of their contact and their motion; and does that pass do what is to be done at rims, too? So it is
/// if no body `roams`, which is to come near coarser levels, and if the adapter lets a pass bind so much and its workgroups be so wide.
pub(crate) fn free(
    gpu: &Gpu,
    kernels: &Kernels,
    law: &DeviceLaw,
    [vectors, materials]: [usize; 2],
    shape: [usize; 2],
    free: Free,
    roams: bool,
) -> ([Kernel; 2], bool) {
    let (subcycled, sleeps) = (kernels.set.solve.is_some(), kernels.set.watch.is_some());
    let draft = |rims| free_draft([subcycled, sleeps, rims], law, vectors, shape, free);
    let (layout, setting) = (&kernels.step_layout, &kernels.setting);
    let of_bodies =
        [&free_counts(free, law), include_str!("wgsl/lent.wgsl"), include_str!("wgsl/press_free.wgsl")].concat();
    let press = press_draft("press on free bodies", law, &of_bodies, [vectors, materials], shape, [LENT_BODIES]);
    let press = build(gpu, layout, setting, shape[0], press);
    // Walls that let go come between bodies and rims.
    let is_apart =
        roams || shape[1] == 1 || !kernels.set.mirror.is_empty() || shape[0] * free.bodies > kernels.free_room;
    let with_rims = draft(true);
    let limits = &gpu.limits;
    let fits = with_rims.bindings(shape[0]) <= limits.max_storage_buffers_per_shader_stage as usize
        && 64 * RIMS_BESIDE <= limits.max_compute_invocations_per_workgroup.min(limits.max_compute_workgroup_size_x);
    if is_apart || !fits {
        return ([press, build(gpu, layout, setting, shape[0], draft(false))], false);
    }
    ([press, build_for(gpu, layout, setting, shape[0], with_rims)], true)
}

fn free_counts(free: Free, law: &DeviceLaw) -> String {
    format!(
        "const FREES: u32 = {}u;\nconst ROOMS: u32 = {}u;\nconst MAX_SLOTS: u32 = {MAX_SLOTS}u;\nconst REACH: f32 = {:?};\n",
        free.bodies,
        free.rooms(),
        law.reach,
    )
}

/// `rims`: with what is done at rims, for bodies that meet the finest level alone.
fn free_draft(
    [subcycled, sleeps, rims]: [bool; 3],
    law: &DeviceLaw,
    vectors: usize,
    [worlds, levels]: [usize; 2],
    free: Free,
) -> Draft {
    let tools: Use = ("tools", "vec4<i32>", Role::Tools, true);
    let counts = free_counts(free, law) + &format!("const NEAR_TOOL: f32 = {NEAR_TOOL:?};\n");
    let (stored, table) = coupling_table([worlds, levels], vectors, law.samples.len());
    let awake = if sleeps { include_str!("wgsl/free_awake.wgsl") } else { "" };
    // Nodes of the finest level are no finer one's.
    let (text, own) = of_own_mass(subcycled && !rims, &include_str!("wgsl/free.wgsl").replace("$STAY_AWAKE", awake));
    let alone = Draft {
        name: "free bodies",
        entry: "free_bodies",
        // Eleven columns of 65 rows; see `free.wgsl`.
        body: [&exchange(715), &counts, include_str!("wgsl/lent.wgsl"), &table, &law.wgsl, &text].concat(),
        uses: [GRID, DIRECTORY, LENT_BODIES, STATUS].into_iter().chain(own).chain(sleeps.then_some(tools)).collect(),
        uniform: Uniform::Table { stored, counted: law.counted },
        groups: Groups::Exactly((worlds * free.bodies) as u32 + 1),
        checked: true,
    };
    if !rims {
        return Draft { body: alone.body + include_str!("wgsl/free_alone.wgsl"), ..alone };
    }
    let of_rims = at_rims(subcycled, RIMS_BESIDE);
    let further: Vec<_> = of_rims.uses.into_iter().filter(|rim| alone.uses.iter().all(|own| own.2 != rim.2)).collect();
    Draft {
        name: "free bodies, rims",
        entry: "free_and_rims",
        body: alone.body + &of_rims.body + include_str!("wgsl/free_and_rims.wgsl"),
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
    let near: Use = ("near", "vec4<u32>", Role::Near, false);
    let around: Use = ("around", "vec4<i32>", Role::Around, false);
    let block = format!("const NEAR_BLOCK: u32 = {NEAR_BLOCK}u;\n");
    let mirrors = include_str!("wgsl/mirrors.wgsl");
    let (gather, own) =
        of_own_mass(kernels.set.solve.is_some(), &(mirrors.to_owned() + include_str!("wgsl/gather.wgsl")));
    let rounds = include_str!("wgsl/rounds.wgsl");
    let draft = |name, body: &str, uses, groups| Draft {
        name,
        entry: name,
        body: block.clone() + body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    let build = |draft| build(gpu, &kernels.step_layout, &kernels.setting, worlds, draft);
    let gather = [
        draft(
            "gather",
            &gather,
            [LISTS, NODES, around, written(near), STATUS].into_iter().chain(own).collect(),
            Groups::NodeBlocks,
        ),
        draft(
            "gather_particles",
            &(rounds.to_owned() + include_str!("wgsl/gather_particles.wgsl")),
            vec![LISTS, CELLS, RECORD, around, written(near), STATUS],
            Groups::Blocks,
        ),
    ];
    let scatter = draft("scatter_near", include_str!("wgsl/scatter_near.wgsl"), vec![GRID, near, STATUS], Groups::Near);
    NearKernels { gather: gather.map(build), scatter: build(scatter) }
}

/// The text of a pass in which bodies meet nodes, with what these weigh for them, and what it binds besides. Subcycled, a node may be two
/// levels'.
fn of_own_mass(subcycled: bool, text: &str) -> (String, Vec<Use>) {
    if !subcycled {
        return (text.replace("$MASS", "node.w"), Vec::new());
    }
    (include_str!("wgsl/own.wgsl").to_owned() + &text.replace("$MASS", "own_mass(g, n, node)"), vec![RIMS, OWN])
}

/// Vectors of four that hold a world's material parameters.
pub(crate) fn parameter_vectors(plan: &Plan) -> usize {
    plan.materials.iter().flat_map(parameters_of).count().div_ceil(4).max(1)
}

/// Is what couplings' laws read stored? A uniform holds so much everywhere, and not what differs from world to world.
pub(crate) fn is_stored(worlds: usize, vectors: usize, samples: usize) -> bool {
    worlds > 1 || 16 * (vectors + samples) > 65_536
}

/// What couplings' laws read: so many vectors for each world, and behind them samples that all worlds share. Is it stored?
fn coupling_table([worlds, levels]: [usize; 2], vectors: usize, samples: usize) -> (bool, String) {
    let stored = is_stored(worlds, vectors, samples);
    let space = space(stored);
    let (tables, first) = table_of_worlds([worlds, levels], vectors);
    let of_samples = format!("fn coupling_sample(i: u32) -> vec4<f32> {{ return contact_table[{tables}u + i]; }}\n");
    let text = format!(
        "@group(0) @binding(1) var<{space}> contact_table: array<vec4<f32>, {}>;\n\
         fn coupling_table(i: u32) -> vec4<f32> {{ return contact_table[{first}i]; }}\n{}",
        tables + samples,
        if samples > 0 { of_samples } else { String::new() }
    );
    (stored, text)
}

/// The address space of a table.
fn space(stored: bool) -> &'static str {
    if stored { "storage, read" } else { "uniform" }
}

/// A table of so many vectors for each world: vectors in all, and what leads to the world's own.
fn table_of_worlds([worlds, levels]: [usize; 2], vectors: usize) -> (usize, String) {
    let first = if worlds > 1 { format!("layer_now / {levels}u * {vectors}u + ") } else { String::new() };
    (worlds * vectors, first)
}

fn entry(binding: u32, ty: wgpu::BufferBindingType, has_dynamic_offset: bool) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset, min_binding_size: None },
        count: None,
    }
}

/// First storage binding of a pass: before it stand the extent and the materials' parameters.
pub(crate) const FIRST_BINDING: u32 = 2;

fn build(gpu: &Gpu, step_layout: &wgpu::BindGroupLayout, setting: &Setting, worlds: usize, draft: Draft) -> Kernel {
    let bound = draft.bindings(worlds);
    // What WebGPU promises everywhere.
    assert!(bound <= LEAST_BINDINGS, "pass {} binds {bound} storage buffers", draft.name);
    build_for(gpu, step_layout, setting, worlds, draft)
}

/// A pass that may bind more than adapters promise.
fn build_for(gpu: &Gpu, step_layout: &wgpu::BindGroupLayout, setting: &Setting, worlds: usize, draft: Draft) -> Kernel {
    let device = &gpu.device;
    let stored = draft.is_table_stored(worlds);
    let mut entries = vec![entry(0, wgpu::BufferBindingType::Uniform, false)];
    let mut text = format!("{}{}", setting.constants, include_str!("wgsl/common.wgsl"));
    if draft.uniform != Uniform::None {
        let ty = if stored {
            wgpu::BufferBindingType::Storage { read_only: true }
        } else {
            wgpu::BufferBindingType::Uniform
        };
        entries.push(entry(1, ty, false));
    }
    let mut roles = Vec::new();
    for one @ &(name, ty, role, write) in &draft.uses {
        let parts = setting.parts.of(role);
        for part in 0..parts {
            let binding = FIRST_BINDING + roles.len() as u32;
            roles.push((role, part));
            entries.push(entry(binding, wgpu::BufferBindingType::Storage { read_only: !write }, false));
            let access = if write { "read_write" } else { "read" };
            let number = if parts > 1 { format!("_{part}") } else { String::new() };
            let _ = writeln!(text, "@group(0) @binding({binding}) var<storage, {access}> {name}{number}: array<{ty}>;");
        }
        text += &setting.parts.accessors(one);
    }
    text.push_str(&draft.body);
    let mut checks = wgpu::ShaderRuntimeChecks::checked();
    // Passes that read a table hold what plugins may have written.
    checks.force_loop_bounding = match draft.uniform {
        Uniform::Params => draft.checked,
        Uniform::Table { counted, .. } => !counted,
        _ => false,
    };
    checks.bounds_checks = draft.checked;
    let descriptor =
        wgpu::ShaderModuleDescriptor { label: Some(draft.name), source: wgpu::ShaderSource::Wgsl(text.into()) };
    // SAFETY: without plugins' text, or if that says so of its own, all loops count to a bound that they find at their start, or walk a list that has no circles;
    // a pass whose indices are not checked says why they are in range.
    let module = unsafe { device.create_shader_module_trusted(descriptor, checks) };
    let layout = device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(draft.name), entries: &entries });
    let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(draft.name),
        bind_group_layouts: &[Some(&layout), Some(step_layout)],
        immediate_size: 0,
    });
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(draft.name),
        layout: Some(&pipeline_layout),
        module: &module,
        entry_point: Some(draft.entry),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    Kernel { name: draft.name, pipeline, layout, roles, uniform: draft.uniform, groups: draft.groups }
}

/// Are there walls behind which nodes are images?
fn has_mirrors(plan: &Plan) -> bool {
    (0..3).flat_map(|axis| plan.scene.world.walls.pair(axis)).any(|wall| matches!(wall, Wall::Slip | Wall::Stick))
}

/// Are nodes behind mirrors found with the others? So it is where nothing but bodies that keep away from walls comes between the grid and the particles, and
/// where, on levels, no step is halted any more once the grid's turn has come. If a body comes near walls after all, another pass does it again.
fn mirrors_early(plan: &Plan) -> bool {
    let fits = if plan.cell_widths.len() > 1 {
        plan.substeps > 1 && plan.scene.tool.iter().all(|tool| matches!(tool.motion, Motion::Free { .. }))
    } else {
        !plan.has(Stage::CONTACT)
    };
    has_mirrors(plan) && fits && !may_sleep(plan) && plan.terrain.is_none() && separations(plan).is_empty()
}

/// Axes with a wall that lets go.
fn separations(plan: &Plan) -> Vec<usize> {
    let lets_go = |axis: &usize| plan.scene.world.walls.pair(*axis).iter().any(|w| matches!(w, Wall::Separate { .. }));
    (0..3).filter(lets_go).collect()
}

/// Does ground at rest sleep? Only where a scene says so: to watch over it is another pass, which small worlds feel, and most ground that is
/// worked on hardly sleeps.
pub(crate) fn may_sleep(plan: &Plan) -> bool {
    plan.slow > 0.0 && (plan.scene.sleep.on.is_some() || plan.scene.sleep.speed.is_some())
}

/// Boxes of each level but the coarsest: as many as there are agents.
pub(crate) fn boxes(plan: &Plan) -> usize {
    plan.agents.len().max(1)
}

/// What the number of layers fixes, and the rule of sorts.
fn layer_constants(plan: &Plan, worlds: usize) -> String {
    let levels = plan.cell_widths.len();
    let layers = worlds * levels;
    let (subcycled, most_drift, free) = (plan.substeps > 1, most_drift(plan), worlds * free_bodies(plan));
    let mirrored = mirrors_early(plan);
    format!(
        "const LAYERS: u32 = {layers}u;\nconst LEVELS: u32 = {levels}u;\nconst SUBCYCLED: bool = {subcycled};\nconst MIRRORED: bool = {mirrored};\nconst MAX_STEPS: u32 = {MAX_STEPS}u;\nconst FREE_ROOM: u32 = {free}u;\nconst RIMS_BESIDE: u32 = {RIMS_BESIDE}u;\n\
         const SORT_AGE: u32 = {SORT_AGE}u;\nconst SORT_OFTEN: u32 = {SORT_OFTEN}u;\nconst SORT_SELDOM: u32 = {SORT_SELDOM}u;\n\
         const TOGETHER: u32 = {TOGETHER}u;\nconst ROUNDS: u32 = {ROUNDS}u;\n\
         const LEFT_HOME: u32 = {LEFT_HOME}u;\nconst BESIDE: u32 = {BESIDE}u;\nconst BESIDE_BY: u32 = {BESIDE_BY}u;\n\
         const SORT_DRIFT: f32 = {SORT_DRIFT:?};\nconst SELDOM_DRIFT: f32 = {SELDOM_DRIFT:?};\nconst OFTEN_DRIFT: f32 = {OFTEN_DRIFT:?};\nconst MAX_DRIFT: f32 = {most_drift:?};\n"
    )
}

/// What the scene fixes.
pub(crate) fn constants(plan: &Plan) -> String {
    let walls = [0, 1, 2].map(|axis| plan.scene.world.walls.pair(axis));
    let kind = |wall: Wall| match wall {
        Wall::Slip => 1u32,
        Wall::Stick => 2,
        Wall::Open | Wall::Periodic | Wall::Separate { .. } => 0,
    };
    let friction = |wall: Wall| match wall {
        Wall::Separate { friction } => friction as f32,
        _ => -1.0,
    };
    let (min, max) = (plan.cell_min, plan.cell_max);
    let periodic = |d: usize| walls[d][0] == Wall::Periodic;
    let ints = |name: &str, v: [i32; 3]| format!("const {name} = vec3<i32>({}, {}, {});\n", v[0], v[1], v[2]);
    let bounds = Bounds::new(plan, 0);
    let counts = |name: &str, parts: [f64; 3]| {
        let [x, y, z] = parts.map(|part| (part * (1_u64 << 32) as f64) as u32);
        format!("const {name} = vec3<u32>({x}u, {y}u, {z}u);\n")
    };
    let kinds = |name: &str, end: usize| {
        let k = walls.map(|axis| kind(axis[end]));
        format!("const {name} = vec3<u32>({}u, {}u, {}u);\n", k[0], k[1], k[2])
    };
    let frictions = |name: &str, end: usize| {
        let f = walls.map(|axis| friction(axis[end]));
        format!("const {name} = vec3<f32>({:?}, {:?}, {:?});\n", f[0], f[1], f[2])
    };
    let any_wall = |name: &str, end: usize| {
        let w = walls.map(|axis| !matches!(axis[end], Wall::Open | Wall::Periodic));
        format!("const {name} = vec3<bool>({}, {}, {});\n", w[0], w[1], w[2])
    };
    let h = plan.cell_widths[0] as f32;
    [
        ints("WORLD_MIN", min),
        ints("WORLD_MAX", max),
        ints("SIDE_LOW", bounds.sides.map(|side| side[0].0)),
        ints("SIDE_HIGH", bounds.sides.map(|side| side[1].0)),
        counts("SIDE_LOW_PART", bounds.sides.map(|side| side[0].1)),
        counts("SIDE_HIGH_PART", bounds.sides.map(|side| side[1].1)),
        ints("PERIOD_MIN", min.map(|c| c.div_euclid(4))),
        ints("PERIOD", std::array::from_fn(|d| if periodic(d) { (max[d] - min[d]) / 4 } else { 0 })),
        kinds("LOW", 0),
        kinds("HIGH", 1),
        any_wall("HAS_LOW_WALL", 0),
        any_wall("HAS_HIGH_WALL", 1),
        frictions("LOW_FRICTION", 0),
        frictions("HIGH_FRICTION", 1),
        format!("const H: f32 = {h:?};\nconst PER_CELL: f32 = {:?};\n", 4.0 / h),
        format!("const NODE_MOVE: f32 = {:?};\n", crate::batch::NODE_MOVE),
        format!("const REST: u32 = {}u;\n", rest_vectors(&plan.materials)),
        format!("const GRAVITY_GROWS: bool = {};\n", plan.scene.gravity_ramp > 0.0),
        format!("// Particles that leave: {:?}\n", plan.scene.world.leaving),
        if may_sleep(plan) {
            format!("const SLOW: f32 = {:?};\nconst RESTED: u32 = {RESTED}u;\n", plan.slow as f32)
        } else {
            String::new()
        },
    ]
    .concat()
}

/// What passes know of the rest of blocks.
const WATCH_WORDS: &str = include_str!("wgsl/watch_words.wgsl");

/// Puts texts in places that stay empty where nothing sleeps.
fn with_sleep(sleeps: bool, body: &str, texts: &[(&str, &str)]) -> String {
    texts.iter().fold(body.to_owned(), |body, (place, text)| body.replace(place, if sleeps { text } else { "" }))
}

/// Who sleeps in a step.
fn watch(levels: bool) -> Draft {
    let tied =
        "if any(rims[g].xyz != vec3<u32>(0u)) || rims[extent.node_room + b].x != 0u {\natomicStore(&tied, 1u);\n}";
    let body = include_str!("wgsl/watch.wgsl").replace("$TIED", if levels { tied } else { "" });
    let tools: Use = ("tools", "vec4<i32>", Role::Tools, false);
    let mut uses = vec![written(RECORD), written(OWNERS), CELLS, LISTS, WATCH, tools, STATUS];
    uses.extend(levels.then_some(RIMS));
    Draft {
        name: "watch",
        entry: "watch_blocks",
        body: [&body, WATCH_WORDS, include_str!("wgsl/watch_booked.wgsl"), include_str!("wgsl/rhythm.wgsl")].concat(),
        uses,
        uniform: Uniform::None,
        groups: blocks(levels),
        checked: true,
    }
}

/// What sleep took, and kept gravity from.
fn sum_sleep() -> Draft {
    Draft {
        name: "sleep",
        entry: "sum_sleep",
        body: [include_str!("wgsl/watch_sum.wgsl"), WATCH_WORDS, include_str!("wgsl/watch_booked.wgsl")].concat(),
        uses: vec![WATCH, STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}

/// Where there are several levels, P2G also sums parent cells for rims. Subcycled, further workgroups visit blocks once more that give to nodes which
/// two levels share, and leave forces out.
fn p2g([sleeps, mirrored, levels, subcycled, stiffens]: [bool; 5], particles: usize) -> Draft {
    // Where there are few, the memory waits for nobody else; many are faster with the registers that another takes.
    let ahead = if particles < MANY { 2 } else { 1 };
    let at_rim = match (levels, subcycled) {
        (false, _) => "",
        (true, false) => "at_rim = u32(lists[here * ENTRY + OF_RIMS].w) & 1u;",
        (true, true) => "at_rim = select(u32(lists[here * ENTRY + OF_RIMS].w) & 1u, 0u, is_still);",
    };
    let xy = Half {
        rows: &[("s", 1), ("t", 5), ("r0", 2), ("r1", 3)],
        add: add_momentum(XY, |node, w| format!("{node} = fma(vec2<f32>({w}), u, {node});")),
    };
    let zm = Half {
        rows: &[("s", 1), ("r2", 4)],
        add: add_momentum(ZM, |node, w| format!("{node} = vec2<f32>(fma({w}, u, {node}.x), fma({w}, m, {node}.y));")),
    };
    let zero = |n: usize| format!("a{n} = vec2<f32>(0.0);\n");
    let body = include_str!("wgsl/p2g.wgsl")
        .replace("$ZERO", &each_node(|n, _| format!("var {}", zero(n))))
        .replace("$CLEAR", &each_node(|n, _| zero(n)))
        .replace("$OWN_XY", &xy.own(ahead, "left |= select(0u, 1u << min(done, 31u), has_left);\n"))
        .replace("$OWN_ZM", &zm.own(ahead, ""))
        .replace("$GUESTS_XY", &xy.guests())
        .replace("$GUESTS_ZM", &zm.guests())
        .replace("$FOLD", &[0, 1, 2].map(fold).concat())
        .replace("$FLUSH", &flush())
        .replace("$IS_STIFF", if stiffens { "is_stiff = is_too_stiff(layer);" } else { "" })
        .replace("$HALT_IF_STIFF", if stiffens { HALT_IF_STIFF } else { "" })
        .replace("$KEPT_NEED", if sleeps { "atomicLoad(&status[need_word(step.number + 1u, layer)])" } else { "0u" })
        .replace("$GIVES", if sleeps { "gives(b, layer)" } else { "1u" })
        .replace("$BOOK_LAST", if mirrored { BOOK_LAST } else { "" })
        .replace("$BOOKED", if sleeps { "select(total, 0.0, is_frozen != 0u)" } else { "total" })
        .replace("$BLOCK", if subcycled { GIVER } else { "let b = group.y * extent.row + group.x;" })
        .replace("$STILL", if subcycled { "if is_still {\nstress = 0.0;\ngravity = vec3<f32>(0.0);\n}" } else { "" })
        .replace("$IF_MOVED", if subcycled { " && !is_still" } else { "" })
        .replace("$AT_RIM", at_rim)
        .replace("$TILE", if subcycled { TILE_OR_STILL } else { "grid[base + t] = node;" })
        .replace("$PARENT_CELLS", if levels { PARENT_CELLS } else { "" });
    let settle = if subcycled { "if !is_still {\nsettle(b);\n}" } else { "settle(b);" };
    let body = with_sleep(sleeps, &body, &[("$SETTLE", settle)]);
    let watch = if sleeps { [WATCH_WORDS, include_str!("wgsl/watch_p2g.wgsl")].concat() } else { String::new() };
    let mut uses = vec![RECORD, CELLS, written(LISTS), GRID, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    uses.extend(levels.then_some(written(HANDED)));
    uses.extend(subcycled.then_some(LISTED));
    let if_levels = |text: &'static str| if levels { text } else { "" };
    Draft {
        name: "P2G",
        entry: "p2g",
        body: [
            body.as_str(),
            &watch,
            if_levels(include_str!("wgsl/parent_cells.wgsl")),
            if_levels(include_str!("wgsl/handed.wgsl")),
            if subcycled {
                concat!(include_str!("wgsl/listed.wgsl"), include_str!("wgsl/blocks_now.wgsl"))
            } else {
                ""
            },
            include_str!("wgsl/rounds.wgsl"),
            include_str!("wgsl/reaches_wall.wgsl"),
            include_str!("wgsl/wall.wgsl"),
            include_str!("wgsl/rhythm.wgsl"),
            if stiffens { include_str!("wgsl/too_stiff.wgsl") } else { "" },
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: if subcycled { Groups::Found(Found::Givers) } else { blocks(levels) },
        // A workgroup goes on only if its block is one of those that hold particles, for which the sort, or the host before it
        // wrote them, has made room in all planes. G2P keeps a particle's cell within three bits an axis; one outside the 6x6x6
        // cells of the tile is never an index, and leavers beyond the list's end are only counted.
        checked: false,
    }
}

/// The next step's needs come into the word in which those of the step before the last have been; those asleep, which nobody asks, go on needing
/// what they did.
const HALT_IF_STIFF: &str = "if is_first {
            atomicStore(&status[need_word(step.number, layer)], $KEPT_NEED);
        }
        if is_stiff {
            if is_first {
                atomicStore(&status[HALT_STEP], step.number);
                atomicStore(&status[HALTED], TOO_STIFF);
            }
            return 0u;
        }";

/// What the step before would give, it has given, since another follows.
const BOOK_LAST: &str =
    "let given = bitcast<f32>(lists[b * ENTRY + WALL][thread]) + bitcast<f32>(lists[b * ENTRY + PENDING][thread]);
            lists[b * ENTRY + WALL][thread] = bitcast<i32>(given);
            lists[b * ENTRY + PENDING].w = i32(step.number);";

/// A workgroup's block, or, behind all of them, one that gives to nodes which two levels share.
const GIVER: &str = "let which = group.y * extent.row + group.x;
    let own_blocks = blocks_now();
    let is_still = which >= own_blocks;
    let number = max(which, own_blocks) - own_blocks;
    let b = select(which, listed_block(GIVING, number), is_still);";

const TILE_OR_STILL: &str = "if is_still {
            handed[of_still_tile(number) + t] = node;
        } else {
            grid[base + t] = node;
        }";

const PARENT_CELLS: &str = "
    // 5. Parent cells, for rims.
    if workgroupUniformLoad(&at_rim) != 0u {
        sum_parent_cells(b, thread, count);
    }";

fn each_node(text: impl Fn(usize, [usize; 3]) -> String) -> String {
    (0..27).map(|n| text(n, [n / 9, n / 3 % 3, n % 3])).collect()
}

/// Momentum along x and y as seen from the first node, and what each step along x, y and z adds.
const XY: &str = "
    let m = s.w;
    let ax = m * width * r0.yzw + stress * vec3<f32>(t.x, t.z, s.x);
    let ay = m * width * r1.yzw + stress * vec3<f32>(t.z, t.y, s.y);
    let base = vec2<f32>(fma(m, r0.x + gravity.x, dot(ax, d)), fma(m, r1.x + gravity.y, dot(ay, d)));
    let by_x = vec2<f32>(ax.x, ay.x);
    let by_y = vec2<f32>(ax.y, ay.y);
    let by_z = vec2<f32>(ax.z, ay.z);
";
/// Likewise along z.
const ZM: &str = "
    let m = s.w;
    let az = m * width * r2.yzw + stress * s.xyz;
    let base = fma(m, r2.x + gravity.z, dot(az, d));
    let by_x = az.x;
    let by_y = az.y;
    let by_z = az.z;
";

/// One of the two threads that own a cell.
struct Half {
    /// What it reads of a particle besides its place: names and numbers of vectors.
    rows: &'static [(&'static str, u32)],
    /// Adds the particle to the sums of the 27 nodes around.
    add: String,
}

impl Half {
    /// Over the cell's own particles. So many are fetched before the present one is added; behind the last, the block's first. One that is no longer
    /// there weighs nothing, and `leaver` is done with it. Nothing here is left out where it is not needed: small worlds wait for branches more than
    /// for arithmetic.
    fn own(&self, ahead: usize, leaver: &str) -> String {
        let each =
            |line: &dyn Fn(&str, u32) -> String| -> String { self.rows.iter().map(|(v, k)| line(v, *k)).collect() };
        let declare = |n: usize| {
            format!("var p_{n} = vec4<u32>(0u);\n{}", each(&|v, _| format!("var {v}_{n} = vec4<f32>(0.0);\n")))
        };
        let fetch = |n: usize| {
            let rows = each(&|v, k| format!("{v}_{n} = bitcast<vec4<f32>>(record_of(at, {k}u));\n"));
            format!("{{\nlet at = select(start, next, rank < count);\np_{n} = record_of(at, 0u);\n{rows}}}\n")
        };
        let advance = "rank += 1u;\nnext += 1u;\n\
                       if rank % TOGETHER == 0u && rank <= ROUNDS * TOGETHER {\n\
                       next = ahead;\nahead = cells[round_at(here, round_of(rank) + u32(rank < ROUNDS * TOGETHER), own)];\n}\n";
        let shift = |n: usize| format!("p_{} = p_{n};\n{}", n - 1, each(&|v, _| format!("{v}_{} = {v}_{n};\n", n - 1)));
        let take = format!("let p = p_0;\n{}", each(&|v, _| format!("let {v} = {v}_0;\n")));
        let last = ahead - 1;
        [
            "var rank = 0u;\n".to_owned(),
            (0..ahead).map(declare).collect(),
            fetch(0),
            (1..ahead).map(|n| advance.to_owned() + &fetch(n)).collect(),
            format!("while rank < count + {last}u {{\n{take}"),
            (1..ahead).map(shift).collect(),
            advance.to_owned(),
            fetch(last),
            format!(
                "let is_beside = (p.w & BESIDE) != 0u;\n\
                 let f = fraction(p) + select(vec3<f32>(0.0), vec3<f32>(cell_of(p.w) - vec3<i32>(own_cell)), is_beside);\n\
                 let has_left = (p.w & LEFT_HOME) != 0u;\nlet part_here = select(1.0, 0.0, has_left);\n\
                 let done = rank - {ahead}u;\n{leaver}{}}}\n",
                self.add
            ),
        ]
        .concat()
    }

    /// Over those that have come from other cells.
    fn guests(&self) -> String {
        let fetch = |(v, k): &(&str, u32)| format!("let {v} = bitcast<vec4<f32>>(record_of(q, {k}u));\n");
        format!(
            "for (var q = next_leaver(&walk); q != NONE; q = next_leaver(&walk)) {{\nlet p = record_of(q, 0u);\n\
             let f = fraction(p);\nlet part_here = 1.0;\n{}{}}}\n",
            self.rows.iter().map(fetch).collect::<String>(),
            self.add
        )
    }
}

/// Adds the momentum u of a particle at place `f` of its cell, times `part_here`, as seen from each of the 27 nodes around: what it is at the first one and grows by
/// along the axes; and how, times a weight, it enters the node's sum.
fn add_momentum(momentum: &str, sum: fn(&str, &str) -> String) -> String {
    let mut text = format!(
        "let d = vec3<f32>(-0.5) - f;\n\
         let wx = weights(f.x) * part_here;\nlet wy = weights(f.y);\nlet wz = weights(f.z);\n{momentum}"
    );
    for i in 0..3 {
        for j in 0..3 {
            let _ = write!(text, "{{ let w = wx[{i}] * wy[{j}];\nvar u = base + {i}.0 * by_x + {j}.0 * by_y;\n");
            for k in 0..3 {
                let sum = sum(&format!("a{}", 9 * i + 3 * j + k), &format!("w * wz[{k}]"));
                let _ = writeln!(text, "{sum}{}", if k < 2 { " u += by_z;" } else { "" });
            }
            text.push_str("}\n");
        }
    }
    text
}

/// A pass over all blocks: `$BLOCK` of its text is the one that a workgroup works on.
fn on_all(draft: Draft) -> Draft {
    Draft { body: draft.body.replace("$BLOCK", "group.y * extent.row + group.x"), ..draft }
}

/// A pass over blocks that a sort has listed, likewise.
fn on_listed(found: Found, draft: Draft) -> Draft {
    let kind = found as usize - Found::FIRST_LIST;
    let block = format!("listed_block({kind}u, group.y * extent.row + group.x)");
    Draft {
        body: draft.body.replace("$BLOCK", &block) + include_str!("wgsl/listed.wgsl"),
        uses: draft.uses.into_iter().chain([LISTED]).collect(),
        groups: Groups::Found(found),
        ..draft
    }
}

/// A workgroup a block with particles.
fn blocks(levels: bool) -> Groups {
    if levels { Groups::Found(Found::Blocks) } else { Groups::Blocks }
}

/// A workgroup a block of nodes.
fn node_blocks(levels: bool) -> Groups {
    if levels { Groups::Found(Found::NodeBlocks) } else { Groups::NodeBlocks }
}

/// What rims hand to the next coarser level.
fn restrict() -> Draft {
    on_listed(
        Found::Rims,
        Draft {
            name: "restrict",
            entry: "restrict_rims",
            body: sums_of_tiles(1) + &hand_on() + include_str!("wgsl/restrict.wgsl"),
            uses: vec![written(LISTS), GRID, STATUS, DIRECTORY, RIMS, written(HANDED)],
            uniform: Uniform::None,
            groups: Groups::NodeBlocks,
            checked: true,
        },
    )
}

/// For passes in which rims hand something on.
fn hand_on() -> String {
    [
        exchange(256).as_str(),
        include_str!("wgsl/handed.wgsl"),
        include_str!("wgsl/hand_on.wgsl"),
        include_str!("wgsl/sum_of_block.wgsl"),
        include_str!("wgsl/mirrors.wgsl"),
        include_str!("wgsl/behind.wgsl"),
        include_str!("wgsl/wall.wgsl"),
    ]
    .concat()
}

/// For passes whose workgroups work on so many blocks at once.
fn abreast(blocks: u32) -> String {
    format!("const ABREAST: u32 = {blocks}u;\n{}", include_str!("wgsl/abreast.wgsl"))
}

/// For passes that need sums of tiles.
fn plain_sums(blocks: u32) -> String {
    abreast(blocks)
        + &include_str!("wgsl/grid.wgsl")
            .replace("$SUM_TILES", "grid[g * 64u + n] = sum_of_tiles(entry, n);")
            .replace("$TOUCHED", "")
            .replace("$IMAGE", "")
            .replace("$AT_RIM", "")
}

/// For passes that need sums of tiles at rims.
fn sums_of_tiles(blocks: u32) -> String {
    plain_sums(blocks) + include_str!("wgsl/rim_sums.wgsl")
}

/// Folds what lies behind the walls across an axis, every other plane by the one half of the threads and the rest by the other, a thread a row. The axis is
/// written out, so that compilers see which walls there are.
fn fold(axis: usize) -> String {
    let d = ["x", "y", "z"][axis];
    let node = |plane: &str| match axis {
        0 => format!("vec3<u32>(u32({plane}), row)"),
        1 => format!("vec3<u32>(row.x, u32({plane}), row.y)"),
        _ => format!("vec3<u32>(row, u32({plane}))"),
    };
    // Node and image are as far from the wall: the sum of their planes is known. Beyond the low wall lie the lower planes, beyond the high one the upper.
    let end = |kind: &str, bound: &str, first: &str, last: &str| {
        let (source, to) = (node("image"), node("sum - image"));
        format!(
            "{{\nlet sum = 2 * ({bound}.{d} - first_node.{d}) - 1;\n\
             if {kind}.{d} != 0u && sum >= 1 && sum <= 13 && !is_done {{\n\
             let signs = wall_signs({kind}.{d}, {axis});\n\
             for (var image = {first} + i32(part); image <= {last}; image += 2) {{\n\
             impulse += fold_node({source}, {to}, signs);\n}}\n}}\n}}\n"
        )
    };
    // What is behind a wall across an axis before has been folded already.
    let behind = |before: usize| {
        let b = ["x", "y"][before];
        format!(
            " || (LOW.{b} != 0u && first_node.{b} + i32(row.{b}) < least.{b}) || (HIGH.{b} != 0u && first_node.{b} + i32(row.{b}) >= end_node.{b})"
        )
    };
    let is_done: String = (0..axis).map(behind).collect();
    let low = end("LOW", "least", "max(sum - 7, 0)", "(sum - 1) / 2");
    let high = end("HIGH", "end_node", "(sum + 1) / 2", "min(sum, 7)");
    // Across a world narrower than this, both walls fold onto the same planes.
    let narrow = format!(
        "if LOW.{d} != 0u && HIGH.{d} != 0u && ((WORLD_MAX.{d} - WORLD_MIN.{d}) >> (LEVELS - 1u)) < 4 {{\nworkgroupBarrier();\n}}\n"
    );
    format!("{{\nlet is_done = false{is_done};\n{low}{narrow}{high}}}\nworkgroupBarrier();\n")
}

/// Adds the sums of the cell `at` to the tile: for one of its 27 nodes at a time, different cells touch different nodes. Places that differ along x alone are
/// found once.
fn flush() -> String {
    let place = |n: usize| format!("let t{n} = part * 512u + in_tile(at.x, at.y + {}u, at.z + {}u);\n", n / 3, n % 3);
    let add = |n: usize, [i, ..]: [usize; 3]| format!("tile[t{} + {}u] += a{n};\nworkgroupBarrier();\n", n % 9, 64 * i);
    (0..9).map(place).collect::<String>() + &each_node(add)
}

/// Velocities at rims and, subcycled, of nodes that two levels share, so many blocks a workgroup, but for the pass's entry.
fn at_rims(subcycled: bool, blocks: u32) -> Draft {
    let take = "if (any_task & TAKES) != 0u {\nsolve_block(g, n, (all[abreast] & TAKES) != 0u);\n}";
    let reflect = "if (any_task & REFLECTS) != 0u {\nreflect(g, n, (all[abreast] & REFLECTS) != 0u);\n}";
    let own: String = if subcycled {
        [
            &sums_of_tiles(blocks),
            include_str!("wgsl/handed_to.wgsl"),
            SHARED_NODES,
            include_str!("wgsl/solve.wgsl"),
            include_str!("wgsl/mirror_node.wgsl"),
        ]
        .concat()
    } else {
        [&abreast(blocks), include_str!("wgsl/velocity_at.wgsl"), include_str!("wgsl/prolong_tasks.wgsl")].concat()
    };
    let mut uses = vec![DIRECTORY, written(LISTS), GRID, RIMS, STATUS, LISTED];
    if subcycled {
        uses.extend([HANDED, KEPT]);
    }
    Draft {
        name: if subcycled { "solve" } else { "prolong" },
        entry: "rims_alone",
        body: [
            &own,
            include_str!("wgsl/prolong.wgsl"),
            include_str!("wgsl/sum_of_block.wgsl"),
            include_str!("wgsl/mirrors.wgsl"),
            include_str!("wgsl/behind.wgsl"),
            include_str!("wgsl/image.wgsl"),
            include_str!("wgsl/wall.wgsl"),
            &include_str!("wgsl/rims.wgsl")
                .replace("$TAKE", if subcycled { take } else { "" })
                .replace("$REFLECT", if subcycled { reflect } else { "" }),
            include_str!("wgsl/listed.wgsl"),
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: Groups::Found(Found::RimsInFours),
        checked: true,
    }
}

/// In a pass of its own.
fn rims_alone(subcycled: bool) -> Draft {
    let draft = at_rims(subcycled, 4);
    Draft { body: [&exchange(256), &draft.body, include_str!("wgsl/rims_alone.wgsl")].concat(), ..draft }
}

/// Where threads hand something to one another; one for all that a pass does, since workgroup memory is scarce.
fn exchange(vectors: u32) -> String {
    format!("var<workgroup> exchange: array<vec4<f32>, {vectors}>;\n")
}

/// Vectors of four that hold the boxes of a world's levels, as they are now, and as split and merge see them before.
pub(crate) fn region_vectors(plan: &Plan) -> usize {
    4 * boxes(plan) * (plan.cell_widths.len() - 1)
}

/// The boxes of levels, and what lies in them.
fn regions(plan: &Plan, worlds: usize) -> String {
    let boxes = boxes(plan);
    let each = region_vectors(plan);
    let vectors = worlds * each;
    format!(
        "const BOXES: u32 = {boxes}u;\nconst PER_WORLD: u32 = {each}u;\nconst SPLIT_AHEAD: i32 = {SPLIT_AHEAD};\n\
         @group(0) @binding(1) var<uniform> regions: array<vec4<i32>, {vectors}>;\n{}",
        include_str!("wgsl/regions.wgsl")
    )
}

/// What the pass that sums tiles leaves at nodes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Finish {
    /// Momenta, for walls that let go.
    Sums,
    Velocities,
    /// Velocities, behind mirrors, too.
    Mirrored,
}

/// Of nodes behind mirrors, what their velocity is made of.
const IMAGE: &str = "let first = 4 * lists[entry].xyz;
    let layer = layer_of(min(g, extent.node_room - 1u));
    let behind = has_nodes_behind(layer, first);
    var image = Image(first + local, vec3<f32>(1.0), vec3<f32>(1.0), false);
    var there = tiles;
    var booked = vec4<f32>(0.0);
    if behind {
        image = image_of(layer, first + local);
        if image.is_other {
            there = tiles_at(layer, image.cell);
        }
        if n == 0u {
            booked = bitcast<vec4<f32>>(lists[entry + WALL]) + bitcast<vec4<f32>>(lists[entry + PENDING]);
        }
    }
    if n == 0u {
        mirrors = u32(behind);
    }";

fn sum_tiles(finish: Finish, levels: bool, subcycled: bool, sleeps: bool) -> Draft {
    let sum = match (levels, subcycled) {
        (false, _) => "sum_of(tiles, local)",
        (true, false) => "kept(g, n, sum_of(tiles, local) + given)",
        (true, true) => "kept_back(g, n, sum, tiles, local)",
    };
    // Subcycled, what rims hand on is not needed here, and both begin with the same sums.
    let hand_on_here = "let sum = sum_of(tiles, local);\nif workgroupUniformLoad(&at_rim) != 0u {\n\
                        let hands = is_slave(g, n) && !(MIRRORED && is_behind(layer_of(g), 4 * lists[entry].xyz + local));\n\
                        hand_on(g, entry, n, select(vec4<f32>(0.0), sum, hands));\n}\n";
    let at_rim = "at_rim = rims[min(g, extent.node_room - 1u)].z & HANDS_ON;";
    // Else it is, where blocks get any.
    let take_here = "var given = vec4<f32>(0.0);\nif workgroupUniformLoad(&takes) != 0u {\n\
                     find_givers(g, n);\nworkgroupBarrier();\ngiven = handed_to(n);\n}\n";
    let takes = "takes = rims[min(g, extent.node_room - 1u)].z & IS_GIVEN;";
    let if_subcycled = |text: &'static str| if subcycled { text } else { "" };
    let if_taken = |text: &'static str| if levels && !subcycled { text } else { "" };
    let find = format!("let node = velocity(g, {sum});\n");
    let text = match finish {
        Finish::Sums => format!("grid[g * 64u + n] = {sum};"),
        Finish::Velocities => find + "grid[g * 64u + n] = node;\nnote_speed(g, node, n);",
        Finish::Mirrored => {
            find + "var now = node;\n\
             if workgroupUniformLoad(&mirrors) != 0u {\nnow = reflect(g, entry, n, image, there, booked, node);\n}\n\
             grid[g * 64u + n] = now;\nnote_speed(g, node, n);"
        }
    };
    let mirrored = finish == Finish::Mirrored;
    let mirrors = if mirrored { images() + include_str!("wgsl/mirrored.wgsl") } else { String::new() };
    let rims = if levels { include_str!("wgsl/rim_sums.wgsl") } else { "" };
    let shared = if subcycled {
        [SHARED_NODES, include_str!("wgsl/keep_back.wgsl"), &hand_on()].concat()
    } else {
        String::new()
    };
    let mut uses = vec![LISTS, GRID, STATUS];
    if mirrored {
        uses = vec![written(LISTS), GRID, STATUS, DIRECTORY];
    }
    if levels {
        uses.extend([DIRECTORY, RIMS, HANDED]);
    }
    if subcycled {
        uses = vec![written(LISTS), GRID, STATUS, DIRECTORY, RIMS, written(HANDED), KEPT];
    }
    uses.extend(sleeps.then_some(WATCH));
    // Half of the threads find out while the first one looks whether there is such a block.
    let tied = if levels { "| u32(any(rims[min(g, extent.node_room - 1u)].xyz != vec3<u32>(0u)))" } else { "" };
    let touched = format!(
        "if n >= 32u && n < 59u {{\nlook_at(g, n - 32u);\n}}\nworkgroupBarrier();\n\
         if n == 0u && go != 0u {{\ngo = atomicLoad(&touched) {tied};\natomicStore(&watch[touched_word(g)], go);\n}}"
    );
    let body = abreast(1) + &with_sleep(sleeps, include_str!("wgsl/grid.wgsl"), &[("$TOUCHED", &touched)]);
    let watch = if sleeps { [WATCH_WORDS, include_str!("wgsl/watch_grid.wgsl")].concat() } else { String::new() };
    Draft {
        name: "grid",
        entry: "sum_tiles",
        body: body
            .replace("$SUM_TILES", &[if_subcycled(hand_on_here), if_taken(take_here), &text].concat())
            .replace("$AT_RIM", &[if_subcycled(at_rim), if_taken(takes)].concat())
            .replace("$IMAGE", if mirrored { IMAGE } else { "" })
            + &mirrors
            + rims
            + if_taken(include_str!("wgsl/handed_to.wgsl"))
            + &shared
            + &watch,
        uses,
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

const SHARED_NODES: &str = concat!(include_str!("wgsl/own.wgsl"), include_str!("wgsl/shared.wgsl"));

fn velocities(levels: bool) -> Draft {
    let body = plain_sums(1);
    Draft {
        name: "velocities",
        entry: "velocities",
        body: body + include_str!("wgsl/velocities.wgsl"),
        uses: vec![LISTS, GRID, STATUS],
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// Nodes at the edge of live ground are held at rest.
fn hold(levels: bool) -> Draft {
    Draft {
        name: "hold",
        entry: "hold",
        body: include_str!("wgsl/hold.wgsl").to_owned(),
        uses: vec![written(LISTS), GRID, RIMS, STATUS],
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// A wall that lets go decides; afterwards (`back`) images take their nodes' velocities. Nodes at rims are the next coarser level's business.
fn separate(axis: usize, back: bool, levels: bool) -> Draft {
    let is_slave = if levels { "(rims[g][n >> 5u] & (1u << (n & 31u))) != 0u" } else { "false" };
    let constants =
        format!("const AXIS: u32 = {axis}u;\nfn is_slave(g: u32, n: u32) -> bool {{ return {is_slave}; }}\n");
    Draft {
        name: if back { "mirror" } else { "separate" },
        entry: if back { "mirror_back" } else { "separate" },
        body: constants + include_str!("wgsl/separate.wgsl"),
        uses: [DIRECTORY, written(LISTS), GRID, PAIRS, STATUS].into_iter().chain(levels.then_some(RIMS)).collect(),
        uniform: Uniform::None,
        groups: node_blocks(levels),
        checked: true,
    }
}

/// For passes in which nodes behind mirrors take the velocities of their images, a block a workgroup.
fn images() -> String {
    [
        exchange(64).as_str(),
        include_str!("wgsl/mirrors.wgsl"),
        include_str!("wgsl/behind.wgsl"),
        include_str!("wgsl/image.wgsl"),
        include_str!("wgsl/sum_of_block.wgsl"),
        include_str!("wgsl/wall.wgsl"),
    ]
    .concat()
}

/// What folding gave to a block's nodes, and handing on to parents behind walls.
const PENDING: &str = "let blocks = atomicLoad(&status[BLOCKS]);
    let pending = bitcast<vec4<f32>>(lists[w * ENTRY + PENDING]);
    let before = bitcast<vec4<f32>>(lists[w * ENTRY + WALL]);";
const BOOK: &str = "if w < blocks && any(pending != vec4<f32>(0.0)) && is_live(u32(lists[w * ENTRY].w)) {
        lists[w * ENTRY + WALL] = bitcast<vec4<i32>>(before + pending);
    }
    if LEVELS > 1u && is_live(layer_of(w)) {
        let entry = (extent.block_room + w) * ENTRY;
        book(entry + WALL, bitcast<vec4<f32>>(lists[entry + PENDING]));
    }";

/// Velocities of nodes behind mirrors. Where these are found early if no body comes near walls (`mirrored`), what others give to walls is booked at once.
fn reflect(sleeps: bool, levels: bool, mirrored: bool) -> Draft {
    let touched = [("$IF_TOUCHED", " && atomicLoad(&watch[touched_word(w)]) != 0u")];
    let mut uses = vec![DIRECTORY, written(LISTS), GRID, STATUS];
    uses.extend(sleeps.then_some(WATCH));
    let draft = Draft {
        name: "reflect",
        entry: "reflect_nodes",
        body: [
            abreast(1).as_str(),
            &images(),
            &with_sleep(sleeps, include_str!("wgsl/reflect.wgsl"), &touched)
                .replace("$PENDING", if mirrored { "" } else { PENDING })
                .replace("$BOOK", if mirrored { "" } else { BOOK }),
            include_str!("wgsl/velocity_at.wgsl"),
            include_str!("wgsl/mirror_node.wgsl"),
            if sleeps { WATCH_WORDS } else { "" },
        ]
        .concat(),
        uses,
        uniform: Uniform::None,
        groups: Groups::NodeBlocks,
        checked: true,
    };
    // Where it is seldom asked for, all blocks are visited.
    if levels && !mirrored { on_listed(Found::Walled, draft) } else { on_all(draft) }
}

/// Sums over the 27 nodes around a particle, row by row. The first of three nodes along an axis stands in the near block, the last
/// in the far one, if that is another, and the middle one in either.
fn gather() -> String {
    let mut text = String::from(
        "var v = vec3<f32>(0.0);\nvar by_x = vec3<f32>(0.0);\nvar by_y = vec3<f32>(0.0);\nvar by_z = vec3<f32>(0.0);\n",
    );
    for n in 0..8 {
        let end = |bit: usize, axis: &str| format!("{}.{axis}", if n & bit == 0 { "near" } else { "far" });
        let _ = writeln!(text, "let g{n} = first_node(b, {}, {}, {});", end(4, "x"), end(2, "y"), end(1, "z"));
    }
    for (axis, stride) in [("x", 16), ("y", 4), ("z", 1)] {
        let _ = writeln!(text, "let leaves_{axis} = (base.{axis} & 3u) == 3u;");
        for i in 0..3 {
            let _ = writeln!(text, "let {axis}{i} = ((base.{axis} + {i}u) & 3u) * {stride}u;");
        }
    }
    let pick = |i: usize, axis: &str, near: String, far: String| match i {
        0 => near,
        1 => format!("select({near}, {far}, leaves_{axis})"),
        _ => far,
    };
    for i in 0..3 {
        text.push_str("{ var plain = vec3<f32>(0.0);\nvar along_y = vec3<f32>(0.0);\nvar along_z = vec3<f32>(0.0);\n");
        for n in 0..4 {
            let _ = writeln!(text, "let p{n} = {};", pick(i, "x", format!("g{n}"), format!("g{}", n + 4)));
        }
        for j in 0..3 {
            let _ = writeln!(text, "{{ let row = x{i} + y{j};");
            for n in 0..2 {
                let _ = writeln!(text, "let l{n} = {} + row;", pick(j, "y", format!("p{n}"), format!("p{}", n + 2)));
            }
            let at = |k: usize| format!("grid[{} + z{k}].xyz", pick(k, "z", "l0".into(), "l1".into()));
            let _ = write!(
                text,
                "let low = wz.x * {};\nlet high = wz.z * {};\nlet sum = fma(vec3<f32>(wz.y), {}, low + high);\n\
                 plain = fma(vec3<f32>(wy[{j}]), sum, plain);\nalong_z = fma(vec3<f32>(wy[{j}]), high - low, along_z);\n",
                at(0),
                at(2),
                at(1)
            );
            if j != 1 {
                let _ =
                    writeln!(text, "along_y = fma(vec3<f32>({}wy[{j}]), sum, along_y);", if j == 0 { "-" } else { "" });
            }
            text.push_str("}\n");
        }
        let _ = write!(
            text,
            "v = fma(vec3<f32>(wx[{i}]), plain, v);\nby_y = fma(vec3<f32>(wx[{i}]), along_y, by_y);\n\
             by_z = fma(vec3<f32>(wx[{i}]), along_z, by_z);\n"
        );
        if i != 1 {
            let _ = writeln!(text, "by_x = fma(vec3<f32>({}wx[{i}]), plain, by_x);", if i == 0 { "-" } else { "" });
        }
        text.push_str("}\n");
    }
    text
}

/// From so many particles on, G2P's threads take several each, so that workgroups start less often. For fewer the loop costs more than it saves.
const VERY_MANY: usize = 1 << 22;

/// Origin of the materials that come with the project.
const BUILT_IN: &str = "built-in";

fn g2p(plan: &Plan, laws: &str, sleeps: bool, [particles, layers]: [usize; 2]) -> Draft {
    // Particles of blocks asleep stay as they are. To ask for the block's state would keep all waiting (a sixth of the pass on an H200), so that
    // the mass is marked.
    let texts = [
        ("$FIRST", "first_block = owner.x;"),
        ("$IF_AWAKE", " && (owner.y & OF_SLEEPERS) == 0u"),
        ("$NOTE_SPEED", "note_speed(b, v);"),
        // The last lines tell of the first block.
        (
            "$ELSE",
            " else if is_live(layer_now) && owner.x != first_block {\n\
             note_happened(owner.x, STEPPED);\n}",
        ),
        (
            "$NOTE_FIRST",
            "if is_live(first_layer) {\n\
             atomicOr(&watch[watch_word(first_block, HAPPENED)], select(STEPPED, STEPPED | FAST, atomicLoad(&is_fast) != 0u));\n}\n\
             if atomicLoad(&greatest_move) == 0u {\nreturn;\n}",
        ),
    ];
    let asks = layers > 1 || sleeps;
    let (by_workgroup, each, next) = if particles < VERY_MANY {
        (128, "let q = first + thread;\nif q < extent.particles", "")
    } else {
        (
            512,
            "let end = min(first + BY_WORKGROUP, extent.particles);\nfor (var q = first + thread; q < end; q += 128u)",
            "ask(q + 128u);",
        )
    };
    let of_one = if asks {
        [
            ("$ASKING", include_str!("wgsl/asking.wgsl")),
            ("$ASK", "ask(first + thread);"),
            ("$OWN_BLOCK", "owner.x"),
            ("$OF_PARTICLE", "let mass = bitcast<f32>(owner.y);\nlet p = place;"),
            ("$NEXT", next),
        ]
    } else {
        [
            ("$ASKING", ""),
            ("$ASK", ""),
            ("$OWN_BLOCK", "owners[q].x"),
            ("$OF_PARTICLE", "let mass = bitcast<f32>(owners[q].y);\nlet p = record_of(q, 0u);"),
            ("$NEXT", ""),
        ]
    };
    let body = with_sleep(sleeps, include_str!("wgsl/g2p.wgsl"), &texts).replace("$GATHER", &gather());
    let of_needs = [
        ("$NEED_VARIABLE", "var<workgroup> greatest_need: atomic<u32>;"),
        (
            "$SEE_NEED",
            "if layer_now != first_layer {\n\
             atomicMax(&status[need_word(step.number, layer_now)], need_now);\n\
             } else if need_now > atomicLoad(&greatest_need) {\n\
             atomicMax(&greatest_need, need_now);\n}",
        ),
        ("$NOTE_NEED", "atomicMax(&status[need_word(step.number, first_layer)], atomicLoad(&greatest_need));"),
    ];
    let of_damping = [
        ("$DAMPED_SUMS", include_str!("wgsl/damped.wgsl")),
        ("$SEE_DAMPED", "see_damped(layer_now == first_layer);"),
        ("$NOTE_DAMPED", "damped_by[thread] = damped_there;"),
        ("$BOOK_DAMPED", "book_all_damped(first_layer);"),
    ];
    let (stiffens, damps) = (stiffens(plan), damps(&plan.materials));
    let body = of_damping.iter().fold(body, |body, (at, text)| body.replace(at, if damps { text } else { "" }));
    let body = of_needs.iter().fold(body, |body, (at, text)| body.replace(at, if stiffens { text } else { "" }));
    let body = of_one.iter().fold(body, |body, (at, text)| body.replace(at, text));
    let body = format!("const BY_WORKGROUP: u32 = {by_workgroup}u;\n") + &body.replace("$EACH", each);
    let watch = if sleeps { [WATCH_WORDS, include_str!("wgsl/watch_g2p.wgsl")].concat() } else { String::new() };
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

fn stress(laws: &str) -> Draft {
    Draft {
        name: "stress",
        entry: "stress_of_all",
        body: include_str!("wgsl/stress.wgsl").to_owned() + laws,
        uses: vec![written(RECORD), written(REST), STATUS],
        uniform: Uniform::Params,
        groups: Groups::ParticlesBy(128),
        checked: true,
    }
}

/// Soft bodies that levels follow, in the order of agents.
pub(crate) fn softs(plan: &Plan) -> Vec<u16> {
    let soft = |agent: &Agent| if let Agent::Soft(body) = agent { Some(*body) } else { None };
    plan.agents.iter().filter_map(soft).collect()
}

/// The cells around soft bodies after a step, and whether levels must move before the next one.
fn soft(bodies: &[u16]) -> [Draft; 2] {
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
    let measure = constants.clone() + &number + include_str!("wgsl/soft.wgsl");
    let uses = vec![RECORD, IDS, OWNERS, LISTS, softs, STATUS];
    [
        draft("soft bodies", "measure", measure, uses, Groups::ParticlesBy(128)),
        draft(
            "follow",
            "watch_soft",
            constants + include_str!("wgsl/soft_watch.wgsl"),
            vec![softs, STATUS],
            Groups::One,
        ),
    ]
}

/// `mirrored`: the last step's gifts still wait for the next one.
fn collect(mirrored: bool) -> Draft {
    let pending = "if u32(lists[entry + PENDING].w) < done {\nsum += vec4<f32>(bitcast<vec3<f32>>(lists[entry + PENDING].xyz), 0.0);\n}\n\
                   lists[entry + PENDING] = vec4<i32>(0);";
    let done = "let done = select(NONE, atomicLoad(&status[HALT_STEP]), atomicLoad(&status[HALTED]) != 0u);\n";
    Draft {
        name: "wall impulse",
        entry: "collect",
        body: include_str!("wgsl/collect.wgsl")
            .replace("$PENDING", &if mirrored { [done, pending].concat() } else { String::new() }),
        uses: vec![written(LISTS), STATUS],
        uniform: Uniform::None,
        groups: Groups::Layers,
        checked: true,
    }
}

/// Does the device ask laws how stiff their particles are?
pub(crate) fn stiffens(plan: &Plan) -> bool {
    plan.materials.iter().any(is_asked_on_device)
}

/// Is any material damped?
pub(crate) fn damps(materials: &[PlannedMaterial]) -> bool {
    materials.iter().any(|m| m.damping.is_some())
}

/// What passes read of a material: its parameters, and behind them its damping if it has any.
pub(crate) fn parameters_of(m: &PlannedMaterial) -> impl Iterator<Item = f64> + '_ {
    m.parameters.iter().copied().chain(m.damping.iter().flat_map(|damping| [damping.lambda, damping.mu]))
}

/// The materials, and the update of a particle's strain and stress.
fn laws(plan: &Plan, worlds: usize) -> Result<String> {
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
        text += include_str!("wgsl/damping.wgsl");
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
    let volume = format!("r{}.w", vectors - 1);
    let mut need = String::new();
    if stiffens(plan) {
        let stiffness = "stiffness_of_material(law, strain, param_base(law), &state)";
        let stiffness = if damps { format!("with_damping(law, {stiffness})") } else { stiffness.to_owned() };
        let asked = format!("need_of({stiffness}, mass, {volume})");
        need = format!("need_now = 0u;\nif gives_stiffness(law) {{\nneed_now = {asked};\n}}");
        text += include_str!("wgsl/stiffness.wgsl");
    }
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
    let damp = format!(
        "if is_damped(law) && dt > 0.0 {{\n\
         out.kirchhoff = damp(law, out.kirchhoff, trial, out.strain, g, step_part, {volume});\n}}"
    );
    text += &include_str!("wgsl/deform.wgsl")
        .replace("$FIELDS", &fields)
        .replace("$UNDAMPED", if damps { "damped_now = 0.0;" } else { "" })
        .replace("$DAMP", if damps { &damp } else { "" })
        .replace("$FETCH", &fetch)
        .replace("$VOLUME", &volume)
        .replace("$NEED", &need)
        .replace("$LOAD", &(load + "var strain: mat3x3<f32>;\nvar state: array<f32, BARCHAN_MAX_STATE>;\n" + &branch(&load_full, &load_sym)))
        .replace("$TRIAL", &branch("trial = strain + g + g * strain;\n", "let half = strain + g * strain;\nlet back = transpose(g);\ntrial = half + half * back + g + back + g * back;\n"))
        .replace("$STORE", &(branch(&(store_full + &history(true, true)), &(store_sym + &history(false, true))) + &store));
    Ok(text)
}

fn sort(plan: &Plan, worlds: usize) -> Vec<Draft> {
    let levels = plan.cell_widths.len() > 1;
    const COMMON: &str = include_str!("wgsl/sort.wgsl");
    let draft = |name, entry, body: &str, uses: Vec<Use>, groups| Draft {
        name,
        entry,
        body: COMMON.to_owned() + body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    // With several levels, some passes know their regions.
    let knowing = |draft: Draft, helpers: &str| {
        if !levels {
            return draft;
        }
        Draft { body: draft.body + &regions(plan, worlds) + helpers, uniform: Uniform::Regions, ..draft }
    };
    let only_with_levels = |text: &'static str| if levels { text } else { "" };
    let check = only_with_levels(
        " else if due && !is_placed(layer, cell, vec3<i32>(record_of(q, 0u).xyz >> vec3<u32>(31u))) {\n\
         atomicStore(&status[sum_word(layer, ASTRAY)], 1u);\n}",
    );
    let rim = only_with_levels("reached |= u32(reached == 0u && on && takes_from_rim(layer, block));");
    let leaving = plan.scene.world.leaving;
    let is_error = leaving == Leaving::Error;
    // What becomes of a particle outside the world; where particles change, or what they gave is noted, passes write.
    let leave = match leaving {
        Leaving::Error => {
            "atomicMin(&status[WHO], q);\natomicStore(&status[HALT_STEP], step.number);\natomicStore(&status[HALTED], LEFT_WORLD);"
        }
        // One that keeps its home is put back when its layer is due.
        Leaving::Clamp => "if due {\nmine += put_back(q, layer, block, &local);\n}",
        Leaving::Delete => {
            "set_record(q, 0u, vec4<u32>(record_of(q, 0u).xyz, tag | GONE));\nmine.w += bitcast<f32>(record_of(q, 1u).w);\n\
             atomicAdd(&status[sum_word(layer, LEFT)], 1u);\ncontinue;"
        }
    };
    // Whom the world ends for at a face of cells is put back there, or goes; an error is one at the side itself. Those of layers that are not
    // due stand in their homes.
    let outside = if is_error {
        "due && is_beyond(layer, cell, record_of(q, 0u).xyz)"
    } else {
        "any(((cell < world_min(layer)) | (cell >= world_max(layer))) & (PERIOD == vec3<i32>(0)))"
    };
    let unless_error = |text: &'static str| if is_error { "" } else { text };
    let mark_text = include_str!("wgsl/sort_mark.wgsl")
        .replace("$CHECK", check)
        .replace("$OUTSIDE", outside)
        .replace("$LEAVE", leave)
        .replace("$BEGIN", unless_error("var mine = vec4<f32>(0.0);"))
        .replace("$END", unless_error("note_left(b, thread, mine);"));
    let changed = |binding: Use| if is_error { binding } else { written(binding) };
    let sleeps = may_sleep(plan);
    // Where particles come or go, nobody goes on sleeping.
    let words = if sleeps { WATCH_WORDS } else { "" };
    let fresh = "if thread < WATCHED {\n\
                 atomicStore(&watch[watch_word(w, thread)], select(select(0u, NONE, thread == DECIDED), 1u, thread == RESTS));\n}";
    let link_text = with_sleep(sleeps, include_str!("wgsl/sort_link.wgsl"), &[("$FRESH", fresh)]);
    let stir = "fn stir(at: u32) {\nif at != NONE && directory[at].x != NONE {\n\
                note_happened(directory[at].x, STIRRED);\n}\n}\n";
    let texts = [
        ("$GONE", "stir(place_in_box(layer, block));"),
        ("$COME", "if any((local >> vec3<u32>(2u)) != vec3<i32>(0)) {\nstir(at);\n}"),
    ];
    let count_text = with_sleep(sleeps, include_str!("wgsl/sort_count.wgsl"), &texts) + if sleeps { stir } else { "" };
    let with_watch = |mut uses: Vec<Use>| {
        uses.extend(sleeps.then_some(next("watch", WATCH)));
        uses
    };
    let old_lists = ("old_lists", "vec4<i32>", Role::Now(Sorted::Lists), false);
    let unbounded = plan.terrain.is_some();
    let (helpers, edge, find) = if unbounded {
        (include_str!("wgsl/sort_edge.wgsl"), "atomicLoad(&edge)", "find_edge(layer, block, n);")
    } else {
        ("", "0u", "")
    };
    let rim_text = [
        include_str!("wgsl/listed.wgsl"),
        include_str!("wgsl/reaches_wall.wgsl"),
        include_str!("wgsl/mirrors.wgsl"),
        include_str!("wgsl/behind.wgsl"),
        helpers,
    ]
    .concat()
        + &include_str!("wgsl/sort_rim.wgsl").replace("$EDGE", edge).replace("$FIND", find);
    let rims = knowing(
        draft(
            "rims",
            "find_rims",
            &rim_text,
            [DIRECTORY, NEW_LISTS, written(RIMS), STATUS, written(LISTED)]
                .into_iter()
                .chain(unbounded.then_some(LIVE))
                .collect(),
            Groups::NodeBlocks,
        ),
        "",
    );
    let mut passes = vec![
        Draft {
            name: "due",
            entry: "due",
            body: [include_str!("wgsl/rhythm.wgsl"), include_str!("wgsl/sort_due.wgsl")].concat(),
            uses: vec![STATUS],
            uniform: Uniform::None,
            groups: Groups::LayersBy(64),
            checked: true,
        },
        knowing(
            draft(
                "mark",
                "mark",
                &(unless_error(include_str!("wgsl/sort_leave.wgsl")).to_owned() + &mark_text),
                vec![changed(RECORD), changed(LISTS), CELLS, atomic(FLAGS), STATUS],
                Groups::Blocks,
            ),
            include_str!("wgsl/sort_check.wgsl"),
        ),
        knowing(
            draft(
                "survey",
                "survey",
                &include_str!("wgsl/sort_survey.wgsl").replace("$RIM", rim),
                vec![FLAGS, written(DIRECTORY), written(SUMS), STATUS],
                Groups::PlacesBy(1024),
            ),
            include_str!("wgsl/rim_reach.wgsl"),
        ),
        draft("total", "total_blocks", include_str!("wgsl/sort_total.wgsl"), vec![written(SUMS), STATUS], Groups::One),
        draft(
            "number",
            "number",
            include_str!("wgsl/sort_number.wgsl"),
            vec![written(DIRECTORY), SUMS, NEW_LISTS, STATUS],
            Groups::PlacesBy(1024),
        ),
        draft(
            "link",
            "link",
            &(link_text + words),
            with_watch(vec![DIRECTORY, NEW_LISTS, written(COUNTS), STATUS]),
            Groups::NodeBlocks,
        ),
        draft(
            "count",
            "count_cells",
            &(count_text + words),
            with_watch(vec![RECORD, old_lists, CELLS, DIRECTORY, atomic(COUNTS), written(KEYS), STATUS]),
            Groups::Blocks,
        ),
        draft(
            "sum cells",
            "sum_cells",
            include_str!("wgsl/sort_sums.wgsl"),
            vec![COUNTS, written(SUMS), STATUS],
            Groups::BlocksBy(64),
        ),
        draft(
            "sum blocks",
            "sum_blocks",
            include_str!("wgsl/sort_before.wgsl"),
            vec![written(SUMS), STATUS],
            Groups::One,
        ),
        draft(
            "starts",
            "starts",
            concat!(include_str!("wgsl/rounds.wgsl"), include_str!("wgsl/sort_starts.wgsl")),
            vec![written(NEW_CELLS), SUMS, STATUS],
            Groups::Blocks,
        ),
        draft(
            "scatter",
            "scatter",
            include_str!("wgsl/sort_scatter.wgsl"),
            vec![RECORD, COUNTS, KEYS, written(LOOSE), STATUS],
            Groups::ParticlesBy(128),
        ),
        draft(
            "rank",
            "rank",
            concat!(include_str!("wgsl/rounds.wgsl"), include_str!("wgsl/sort_rank.wgsl")),
            vec![NEW_CELLS, KEYS, LOOSE, RECORD, written(ORDER), written(OWNERS), STATUS],
            Groups::ParticlesBy(128),
        ),
        draft("move", "move_rest", include_str!("wgsl/sort_move.wgsl"), particles_to_next(), Groups::ParticlesBy(128)),
    ];
    if sleeps {
        let old_watch = ("old_watch", WATCH.1, WATCH.2, WATCH.3);
        let text = include_str!("wgsl/watch_carry.wgsl").to_owned() + words;
        let uses = with_watch(vec![old_lists, DIRECTORY, old_watch, STATUS]);
        passes.push(draft("carry", "carry", &text, uses, Groups::BlocksBy(64)));
    }
    if levels {
        let placed = include_str!("wgsl/sort_placed.wgsl");
        let listed = include_str!("wgsl/listed.wgsl").to_owned() + include_str!("wgsl/sort_list.wgsl");
        let groups: Use = ("groups", "u32", Role::Groups, true);
        let uses = vec![written(LISTED), groups, NEW_LISTS, STATUS];
        passes.extend([
            rims,
            draft("lists", "list_blocks", &listed, uses, Groups::One),
            draft("placed", "placed", placed, vec![STATUS], Groups::One),
        ]);
    }
    if !is_error {
        // Before blocks are numbered anew.
        let at = passes.iter().position(|pass| pass.name == "survey").expect("a sort has it");
        let left = include_str!("wgsl/sort_left.wgsl");
        passes.insert(at, draft("left", "sum_left", left, vec![LISTS, STATUS], Groups::Layers));
    }
    if leaving == Leaving::Delete {
        passes.push(draft("gone", "gone", include_str!("wgsl/sort_gone.wgsl"), vec![STATUS], Groups::One));
    }
    passes
}

/// Rounds of split and merge.
fn adapt(plan: &Plan, laws: &str, worlds: usize) -> AdaptSet<Draft> {
    const COMMON: &str = include_str!("wgsl/sort.wgsl");
    let draft = |name, entry, body: &str, uses: Vec<Use>, groups| Draft {
        name,
        entry,
        body: COMMON.to_owned() + body,
        uses,
        uniform: Uniform::None,
        groups,
        checked: true,
    };
    let volumes = finest_volumes(plan);
    let volume = |b: usize| format!("{:?}", volumes[b] as f32);
    let last = volumes.len() - 1;
    let cases: String = (0..last).map(|b| format!("case {b}u: {{ return {}; }} ", volume(b))).collect();
    // f32 may decide otherwise than the host by no more than some roundings.
    let constants = format!(
        "const MERGE_BEHIND: i32 = {MERGE_BEHIND};\nconst LESS: f32 = 0.99999;\nconst MORE: f32 = 1.00001;\n\
         fn finest_volume(body: u32) -> f32 {{ switch body {{ {cases}default: {{ return {}; }} }} }}\n",
        volume(last)
    );
    let find = draft(
        "find",
        "find_concerned",
        &(regions(plan, worlds) + &constants + include_str!("wgsl/adapt_find.wgsl")),
        vec![RECORD, REST, IDS, LISTS, CELLS, written(LOOSE), written(SUMS), STATUS],
        Groups::Blocks,
    );
    let filled: Use = ("filled", "vec4<u32>", Role::Handed, true);
    AdaptSet {
        find: [
            Draft { uniform: Uniform::Regions, ..find },
            draft(
                "sum found",
                "sum_blocks",
                include_str!("wgsl/sort_before.wgsl"),
                vec![written(SUMS), STATUS],
                Groups::One,
            ),
            draft(
                "list",
                "list_found",
                concat!(include_str!("wgsl/rounds.wgsl"), include_str!("wgsl/adapt_list.wgsl")),
                vec![RECORD, LISTS, CELLS, LOOSE, SUMS, written(ORDER), next("new_record", RECORD), STATUS],
                Groups::Blocks,
            ),
            draft(
                "copy",
                "copy_found",
                include_str!("wgsl/adapt_copy.wgsl"),
                particles_to_next(),
                Groups::ParticlesBy(128),
            ),
        ],
        fill: draft(
            "fill",
            "fill",
            concat!(include_str!("wgsl/rounds.wgsl"), include_str!("wgsl/adapt_fill.wgsl")),
            vec![LISTS, CELLS, REST, filled, STATUS],
            Groups::Blocks,
        ),
        remove: draft(
            "remove",
            "remove",
            include_str!("wgsl/adapt_remove.wgsl"),
            vec![ORDER, written(RECORD), STATUS],
            Groups::ParticlesBy(128),
        ),
        stress: Draft {
            name: "stress of new",
            entry: "stress_of_new",
            body: include_str!("wgsl/adapt_stress.wgsl").to_owned() + laws,
            uses: vec![written(RECORD), written(REST), STATUS],
            uniform: Uniform::Params,
            groups: Groups::ParticlesBy(128),
            checked: true,
        },
    }
}
