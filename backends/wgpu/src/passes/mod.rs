//! The passes: their WGSL, what they bind, and their pipelines.

pub(crate) mod adapt;
pub(crate) mod binding;
pub(crate) mod bodies;
pub(crate) mod conditions;
pub(crate) mod coupling_check;
pub(crate) mod couplings;
pub(crate) mod g2p;
pub(crate) mod grid;
pub(crate) mod laws;
pub mod material;
pub(crate) mod p2g;
pub(crate) mod probes;
pub(crate) mod rims;
pub(crate) mod scene;
pub(crate) mod since_sort;
pub(crate) mod sleep;
pub(crate) mod sort;
pub(crate) mod unrolled;
mod wgsl_words;

use crate::device::Gpu;
use crate::device::memory::Answering;
use crate::passes::adapt::adapt;
use crate::passes::binding::{Draft, Kernel, Parts, Setting, build, compose, entry};
use crate::passes::bodies::{answer_draft, pressing};
use crate::passes::couplings::Laws;
use crate::passes::g2p::{g2p, soft, stress};
use crate::passes::grid::{Finish, collect, hold, reflect, separate, sum_tiles, velocities};
use crate::passes::laws::laws;
use crate::passes::p2g::p2g;
use crate::passes::probes::{also_pressed, flux, heights, nearest, pressed, pressed_rims, sample, sums};
use crate::passes::rims::{restrict, rims_alone};
use crate::passes::scene::{
    constants, free_bodies, has_mirrors, layer_constants, may_sleep, mirrors_early, rest_vectors, separations, softs,
    stiffens,
};
use crate::passes::sleep::{sum_sleep, watch};
use crate::passes::sort::sort;
use barchan_core::scene::Wall;
use barchan_core::{Coupling, Plan, Result, Stage};

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
    /// What crosses the sections of probes, if there are any.
    pub(crate) flux: Option<K>,
    /// What parts of walls take, if probes ask for it: at once, and through rims.
    pub(crate) pressed: Option<K>,
    pub(crate) pressed_rims: Option<K>,
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
    pub(crate) fn map<L>(self, make: impl Fn(K) -> L) -> Set<L> {
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
            flux: self.flux.map(&make),
            pressed: self.pressed.map(&make),
            pressed_rims: self.pressed_rims.map(&make),
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

    /// Every one of them.
    fn all(&self) -> impl Iterator<Item = &K> {
        let step = self.sort.iter().chain(&self.watch).chain([&self.p2g]).chain(&self.restrict).chain(&self.grid);
        let rims = self.solve.iter().chain(&self.mirror).chain(&self.prolong).chain(&self.reflect);
        let seldom = self.collect.iter().chain(self.soft()).chain(self.adapt());
        let probes = self.flux.iter().chain(&self.pressed).chain(&self.pressed_rims);
        step.chain(rims).chain([&self.g2p, &self.stress]).chain(probes).chain(seldom)
    }

    /// Those of rounds of split and merge.
    pub(crate) fn adapt(&self) -> impl Iterator<Item = &K> {
        self.adapt.iter().flat_map(|a| a.find.iter().chain([&a.fill, &a.remove, &a.stress]))
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
    pub(crate) free_room: usize,
    pub(crate) set: Set<Kernel>,
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
        let is_software = gpu.adapter_info.device_type == wgpu::DeviceType::Cpu;
        let constants = constants(plan) + &layer_constants(plan, worlds) + &pressing(is_software, worlds);
        let setting = Setting { constants, parts: Parts::new(&gpu.limits, rest_vectors(&plan.materials)) };
        let set = drafts(plan, worlds, particles)?.map(|draft| build(gpu, &step_layout, &setting, worlds, draft));
        Ok(Self { set, free_room: worlds * free_bodies(plan), setting, step_layout })
    }
}

/// What a plan's passes are made from.
pub(crate) fn drafts(plan: &Plan, worlds: usize, particles: usize) -> Result<Set<Draft>> {
    let separations = separations(plan);
    let walls: Vec<Wall> = (0..3).flat_map(|axis| plan.scene.world.walls.pair(axis)).collect();
    let has_walls = walls.iter().any(|w| w.is_wall());
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
    grid.extend(separations.iter().map(|&axis| separate(axis, false, levels, false)));
    if !separations.is_empty() {
        grid.push(velocities(levels));
    }
    if unbounded {
        grid.push(hold(levels));
    }
    let presses = plan.has(Stage::PRESS);
    let mirror_back = |axis| match separate(axis, true, levels, presses) {
        draft if presses => also_pressed(plan, draft),
        draft => draft,
    };
    let mut collect: Vec<_> = (has_walls || unbounded).then(|| collect(mirrored)).into_iter().collect();
    collect.extend(sleeps.then(sum_sleep));
    Ok(Set {
        sort: sort(plan, worlds),
        watch: sleeps.then(|| watch(levels)),
        p2g: p2g([sleeps, mirrored, levels, subcycled, stiffens(plan)], particles),
        restrict: (levels && !subcycled).then(restrict),
        grid,
        solve: subcycled.then(|| rims_alone(true)),
        mirror: separations.iter().rev().map(|&axis| mirror_back(axis)).collect(),
        prolong: (levels && !subcycled).then(|| rims_alone(false)),
        // What holding the edge takes is booked there, too.
        reflect: (has_mirrors(plan) && (!mirrored || levels) || unbounded).then(|| reflect(sleeps, levels, mirrored)),
        mirrored,
        g2p: g2p(plan, &laws, sleeps, [particles, worlds * plan.cell_widths.len()]),
        flux: plan.has(Stage::FLUX).then(|| flux(plan, sleeps)),
        pressed: presses.then(|| pressed(plan, sleeps)),
        pressed_rims: (presses && levels && has_mirrors(plan)).then(|| pressed_rims(plan)),
        stress: stress(&laws),
        collect,
        soft: (levels && !softs(plan).is_empty()).then(|| soft(&softs(plan))),
        adapt: levels.then(|| adapt(plan, &laws, worlds)),
    })
}

/// A pass as WGSL.
#[derive(Clone, Debug)]
pub struct Shader {
    /// Name of the pass.
    pub name: &'static str,
    /// Its entry point.
    pub entry: &'static str,
    /// All of its text.
    pub wgsl: String,
}

/// The WGSL of all passes that so many worlds of a plan can ask for, which begin with so many particles in all. `apart`: for an adapter where each plane of
/// particles has a binding of its own. No adapter is needed.
///
/// # Errors
/// A law that cannot be put into a pass.
pub fn shaders(
    plan: &Plan,
    couplings: &[Box<dyn Coupling>],
    worlds: usize,
    particles: usize,
    apart: bool,
) -> Result<Vec<Shader>> {
    let set = drafts(plan, worlds, particles)?;
    let vectors = rest_vectors(&plan.materials);
    let parts = if apart { Parts::apart(vectors) } else { Parts::together() };
    let constants = constants(plan) + &layer_constants(plan, worlds) + &pressing(false, worlds);
    let setting = Setting { constants, parts };
    let (subcycled, shape) = (plan.substeps > 1, [worlds, plan.cell_widths.len()]);
    let mut contact: Vec<Draft> = bodies::near_drafts(subcycled).into();
    contact.extend([sums(&plan.materials), sample(), heights(), probes::apart(), nearest()]);
    if let Some(laws) = Laws::of(couplings) {
        let materials = plan.materials.len();
        let vectors = laws.table.len() + materials;
        let room = Answering::of(&laws.groups, |_| 64);
        contact.extend(bodies::contact_drafts(subcycled, &laws, [laws.bodies, vectors, materials], shape, room));
        if room.groups > 0 {
            contact.push(bodies::press_answering_draft(&laws, [vectors, materials], shape, room));
            let kinds = [false, true].into_iter().filter(|rims| !rims || shape[1] > 1);
            let motion = |rims| answer_draft([subcycled, may_sleep(plan), rims], &laws, vectors, shape, room);
            contact.extend(kinds.map(motion));
        }
    }
    let shader =
        |draft: &Draft| Shader { name: draft.name, entry: draft.entry, wgsl: compose(&setting, worlds, draft).text };
    Ok(set.all().chain(&contact).map(shader).collect())
}
