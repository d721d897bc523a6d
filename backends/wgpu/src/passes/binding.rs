//! Buffers as passes see them, and how a pass is made from its text.

use crate::device::Gpu;
use crate::device::kernel::Pipeline;
pub(crate) use crate::device::kernel::{
    FIRST_BINDING, Found, Groups, Kernel, LEAST_BINDINGS, Parts, Role, Sorted, Uniform,
};
use std::fmt::Write as _;

/// One binding: its name and type in WGSL, the buffer, and whether it is written.
pub(crate) type Use = (&'static str, &'static str, Role, bool);
pub(crate) const RECORD: Use = ("record", "vec4<u32>", Role::Now(Sorted::Record), false);
pub(crate) const REST: Use = ("rest", "vec4<f32>", Role::Now(Sorted::Rest), false);
pub(crate) const LISTS: Use = ("lists", "vec4<i32>", Role::Now(Sorted::Lists), false);
pub(crate) const CELLS: Use = ("cells", "u32", Role::Now(Sorted::Cells), false);
pub(crate) const GRID: Use = ("grid", "vec4<f32>", Role::Grid, true);
pub(crate) const NODES: Use = ("grid", "vec4<f32>", Role::Grid, false);
pub(crate) const STATUS: Use = ("status", "atomic<u32>", Role::Status, true);
pub(crate) const FLAGS: Use = ("flags", "u32", Role::Flags, false);
pub(crate) const DIRECTORY: Use = ("directory", "vec2<u32>", Role::Directory, false);
pub(crate) const SUMS: Use = ("sums", "vec2<u32>", Role::Sums, false);
pub(crate) const KEYS: Use = ("keys", "vec2<u32>", Role::Keys, false);
pub(crate) const LOOSE: Use = ("loose", "u32", Role::Loose, false);
pub(crate) const ORDER: Use = ("order", "u32", Role::Order, false);
pub(crate) const OWNERS: Use = ("owners", "vec2<u32>", Role::Owners, false);
pub(crate) const IDS: Use = ("ids", "vec2<u32>", Role::Now(Sorted::Ids), false);
pub(crate) const COUNTS: Use = ("counts", "u32", Role::Next(Sorted::Cells), false);
/// The same once they are starts.
pub(crate) const NEW_CELLS: Use = ("cells", "u32", Role::Next(Sorted::Cells), false);
pub(crate) const NEW_LISTS: Use = ("lists", "vec4<i32>", Role::Next(Sorted::Lists), true);
pub(crate) const RIMS: Use = ("rims", "vec4<u32>", Role::Rims, false);
pub(crate) const HANDED: Use = ("handed", "vec4<f32>", Role::Handed, false);
pub(crate) const KEPT: Use = ("shared_nodes", "vec4<f32>", Role::Shared, true);
pub(crate) const OWN: Use = ("shared_nodes", "vec4<f32>", Role::Shared, false);
pub(crate) const LIVE: Use = ("live", "vec2<i32>", Role::Live, false);
pub(crate) const LISTED: Use = ("listed", "u32", Role::Listed, false);
pub(crate) const ANSWERING: Use = ("answering", "vec4<u32>", Role::Answering, true);
pub(crate) const PAIRS: Use = ("pairs", "vec4<f32>", Role::Pairs, true);
pub(crate) const WATCH: Use = ("watch", "atomic<u32>", Role::Now(Sorted::Watch), true);

pub(crate) const fn written(binding: Use) -> Use {
    (binding.0, binding.1, binding.2, true)
}

/// For a pass that writes particles, in some order, where the next sort would.
pub(crate) fn particles_to_next() -> Vec<Use> {
    let next = [next("new_record", RECORD), next("new_ids", IDS), next("new_rest", REST)];
    [ORDER, RECORD, IDS, REST].into_iter().chain(next).chain([STATUS]).collect()
}

/// Of the set of buffers that does not hold the particles.
pub(crate) const fn next(name: &'static str, binding: Use) -> Use {
    let Role::Now(sorted) = binding.2 else {
        panic!("tables of passes in this crate ask for the next of what is sorted only")
    };
    (name, binding.1, Role::Next(sorted), true)
}

pub(crate) const fn atomic(binding: Use) -> Use {
    (binding.0, "atomic<u32>", binding.2, true)
}

/// The WGSL by which a pass reads and writes the vectors of particles by their numbers.
fn accessors(parts: Parts, &(name, ty, role, write): &Use) -> String {
    let (Role::Now(sorted) | Role::Next(sorted)) = role else { return String::new() };
    if !matches!(sorted, Sorted::Record | Sorted::Rest) {
        return String::new();
    }
    let parts = parts.of_sorted(sorted);
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

/// What a scene and the adapter fix for all passes.
#[derive(Debug)]
pub(crate) struct Setting {
    pub(crate) constants: String,
    pub(crate) parts: Parts,
}

/// What the WGSL of a pass is made from.
pub(crate) struct Draft {
    pub(crate) name: &'static str,
    pub(crate) entry: &'static str,
    pub(crate) body: String,
    pub(crate) uses: Vec<Use>,
    pub(crate) uniform: Uniform,
    pub(crate) groups: Groups,
    /// Are indices checked? Leaving it out is for passes whose indices are in range by construction.
    pub(crate) checked: bool,
}

impl Draft {
    /// Does its table stand in a storage buffer?
    pub(crate) fn is_table_stored(&self, worlds: usize) -> bool {
        self.uniform == Uniform::Params && worlds > 1 || matches!(self.uniform, Uniform::Table { stored: true, .. })
    }

    /// Storage buffers that it binds.
    pub(crate) fn bindings(&self, worlds: usize) -> usize {
        self.uses.len() + usize::from(self.is_table_stored(worlds))
    }
}

pub(crate) fn entry(binding: u32, ty: wgpu::BufferBindingType, has_dynamic_offset: bool) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset, min_binding_size: None },
        count: None,
    }
}

pub(crate) fn build(
    gpu: &Gpu,
    step_layout: &wgpu::BindGroupLayout,
    setting: &Setting,
    worlds: usize,
    draft: Draft,
) -> Kernel {
    let bound = draft.bindings(worlds);
    // What WebGPU promises everywhere.
    assert!(bound <= LEAST_BINDINGS, "pass {} binds {bound} storage buffers", draft.name);
    build_for(gpu, step_layout, setting, worlds, draft)
}

/// A pass as a device is to compile it.
pub(crate) struct Composed {
    pub(crate) text: String,
    entries: Vec<wgpu::BindGroupLayoutEntry>,
    /// What each binding is, and which part of it.
    roles: Vec<(Role, usize)>,
}

/// Puts what a scene fixes, what passes share and the bindings before a pass's own text.
pub(crate) fn compose(setting: &Setting, worlds: usize, draft: &Draft) -> Composed {
    let mut entries = vec![entry(0, wgpu::BufferBindingType::Uniform, false)];
    let mut text = format!("{}{}", setting.constants, include_str!("../wgsl/common.wgsl"));
    if draft.uniform != Uniform::None {
        let ty = if draft.is_table_stored(worlds) {
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
        text += &accessors(setting.parts, one);
    }
    text.push_str(&draft.body);
    Composed { text, entries, roles }
}

/// A pass that may bind more than adapters promise.
pub(crate) fn build_for(
    gpu: &Gpu,
    step_layout: &wgpu::BindGroupLayout,
    setting: &Setting,
    worlds: usize,
    draft: Draft,
) -> Kernel {
    let device = &gpu.device;
    let Composed { text, entries, roles } = compose(setting, worlds, &draft);
    let mut checks = wgpu::ShaderRuntimeChecks::checked();
    // Passes that read a table hold what plugins may have written.
    checks.force_loop_bounding = match draft.uniform {
        Uniform::Params => draft.checked,
        Uniform::Table { counted, .. } => !counted,
        _ => false,
    };
    checks.bounds_checks = draft.checked;
    let layout = device
        .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(draft.name), entries: &entries });
    let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(draft.name),
        bind_group_layouts: &[Some(&layout), Some(step_layout)],
        immediate_size: 0,
    });
    let (device, name, entry) = (device.clone(), draft.name, draft.entry);
    let pipeline = Pipeline::begin(move || {
        let descriptor =
            wgpu::ShaderModuleDescriptor { label: Some(name), source: wgpu::ShaderSource::Wgsl(text.into()) };
        // SAFETY: without plugins' text, or if that says so of its own, all loops count to a bound that they find at their start, go through
        // a word's bits, or walk a list that has no circles; a pass whose indices are not checked says why they are in range.
        let module = unsafe { device.create_shader_module_trusted(descriptor, checks) };
        device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(name),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            cache: None,
        })
    });
    Kernel { name: draft.name, pipeline, layout, roles, uniform: draft.uniform, groups: draft.groups }
}

/// A pass over blocks that a sort has listed.
pub(crate) fn on_listed(found: Found, draft: Draft) -> Draft {
    Draft {
        body: draft.body + include_str!("../wgsl/listed.wgsl"),
        uses: draft.uses.into_iter().chain([LISTED]).collect(),
        groups: Groups::Found(found),
        ..draft
    }
}

/// A workgroup a block with particles.
pub(crate) fn blocks(levels: bool) -> Groups {
    if levels { Groups::Found(Found::Blocks) } else { Groups::Blocks }
}

/// A workgroup a block of nodes.
pub(crate) fn node_blocks(levels: bool) -> Groups {
    if levels { Groups::Found(Found::NodeBlocks) } else { Groups::NodeBlocks }
}

/// For passes whose workgroups work on so many blocks at once.
pub(crate) fn abreast(blocks: u32) -> String {
    format!("const ABREAST: u32 = {blocks}u;\n{}", include_str!("../wgsl/abreast.wgsl"))
}

/// Where threads hand something to one another; one for all that a pass does, since workgroup memory is scarce.
pub(crate) fn exchange(vectors: u32) -> String {
    format!("var<workgroup> exchange: array<vec4<f32>, {vectors}>;\n")
}
