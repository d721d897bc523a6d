//! Buffers by what they are to passes, and a pass as a device has compiled it.

use crate::device::layout::RECORD;
use std::fmt;
use std::sync::{Arc, LazyLock};

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
    /// Bodies that answer, their states in each step of a submission, and the nodes that they grip.
    Answering,
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
    /// Sections of probes, and what has crossed them.
    Crossed,
    /// Regions that are asked about, and the sums over them.
    Sought,
}

impl Sorted {
    /// What it holds, for messages; no two are called alike.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Record => "records of particles",
            Self::Ids => "names of particles",
            Self::Rest => "strain of particles",
            Self::Lists => "lists of blocks",
            Self::Cells => "starts of cells",
            Self::Watch => "rest of blocks",
        }
    }
}

impl Role {
    /// What it holds, likewise.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Grid => "nodes and tiles",
            Self::Status => "status",
            Self::Flags => "marks of blocks",
            Self::Directory => "directory of blocks",
            Self::Sums => "sums of blocks",
            Self::Keys => "keys of the sort",
            Self::Loose => "cells of the sort",
            Self::Order => "order of the sort",
            Self::Owners => "blocks and masses of particles",
            Self::Pairs => "pairs at walls",
            Self::Bodies => "poses of bodies",
            Self::Partials => "parts of impulses",
            Self::Impulses => "impulses",
            Self::Answering => "bodies that answer and nodes inside them",
            Self::Rims => "rims of levels",
            Self::Handed => "what rims hand on",
            Self::Shared => "nodes that levels share",
            Self::Around => "boxes around bodies",
            Self::Near => "nodes near bodies",
            Self::Tools => "boxes near tools",
            Self::Soft => "soft bodies that levels follow",
            Self::Live => "live tiles",
            Self::Listed => "lists of blocks at rims and walls",
            Self::Groups => "workgroups of passes",
            Self::Crossed => "what crosses sections",
            Self::Sought => "sums over regions",
            Self::Now(sorted) | Self::Next(sorted) => sorted.name(),
        }
    }
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
    /// One more than there are free bodies in the scenes, a group each, and behind them the same in eights.
    BodiesAndRims,
}

impl Found {
    /// How many kinds there are, and how many lists.
    pub(crate) const ALL: usize = 7;
    pub(crate) const LISTED: usize = 4;
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

type Made = LazyLock<wgpu::ComputePipeline, Box<dyn FnOnce() -> wgpu::ComputePipeline + Send>>;

/// What a device makes of a pass's text. That takes a device's compiler up to seconds, so threads that are idle see to it, one pass each; whoever needs it first
/// waits for it, or makes it if nobody has begun. Nobody begins once it is dropped, and what has begun is waited for, so that a process ends without a driver at work.
pub(crate) struct Pipeline(Option<Arc<Made>>);

impl Pipeline {
    pub(crate) fn begin(make: impl FnOnce() -> wgpu::ComputePipeline + Send + 'static) -> Self {
        let made: Arc<Made> = Arc::new(LazyLock::new(Box::new(make)));
        let ahead = Arc::downgrade(&made);
        rayon::spawn(move || {
            if let Some(made) = ahead.upgrade() {
                LazyLock::force(&made);
            }
        });
        Self(Some(made))
    }

    /// The pipeline, once it has been made.
    pub(crate) fn made(&self) -> &wgpu::ComputePipeline {
        self.0.as_deref().expect("it is there until it is dropped")
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        if let Some(Err(begun)) = self.0.take().map(Arc::try_unwrap) {
            LazyLock::force(&begun);
        }
    }
}

impl fmt::Debug for Pipeline {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pipeline").finish_non_exhaustive()
    }
}

/// A pass.
#[derive(Debug)]
pub(crate) struct Kernel {
    pub(crate) name: &'static str,
    pub(crate) pipeline: Pipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
    /// Buffers in the order of their bindings, and which part of each.
    pub(crate) roles: Vec<(Role, usize)>,
    pub(crate) uniform: Uniform,
    pub(crate) groups: Groups,
}

/// Storage buffers that any adapter lets a pass bind.
pub(crate) const LEAST_BINDINGS: usize = 8;

/// In how many buffers the planes of particles stand: one each where passes may bind so many, so that a binding's greatest size bounds particles
/// alone, and not particles times planes; else all in one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Parts {
    pub(crate) record: usize,
    pub(crate) rest: usize,
}

impl Parts {
    /// Of particles with so many vectors of strain and history.
    pub(crate) fn new(limits: &wgpu::Limits, vectors: usize) -> Self {
        // A sort reads all planes, and writes all.
        let most = LEAST_BINDINGS + 2 * (RECORD - 1) + 2 * (vectors - 1);
        if limits.max_storage_buffers_per_shader_stage as usize >= most {
            Self::apart(vectors)
        } else {
            Self::together()
        }
    }

    /// Each plane in a binding of its own.
    pub(crate) fn apart(vectors: usize) -> Self {
        Self { record: RECORD, rest: vectors }
    }

    /// All planes in one.
    pub(crate) fn together() -> Self {
        Self { record: 1, rest: 1 }
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
}

/// First storage binding of a pass: before it stand the extent and the materials' parameters.
pub(crate) const FIRST_BINDING: u32 = 2;
