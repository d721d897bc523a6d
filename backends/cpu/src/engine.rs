//! The step.

use crate::grid::{Bounds, Grid};
use crate::memory::Shared;
use crate::store::{Departures, Store};
use barchan_abi as abi;
use barchan_core::backend::{Bound, Timing};
use barchan_core::coupling::Aabb;
use barchan_core::material::{ErrorBuffer, stable_step};
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::Leaving;
use barchan_core::{
    Coupling, Engine, Error, Ledger, Measured, NodeBatch, ParticleState, Plan, Result, Scene, StepReport,
};
use barchan_grid::block::{self, CELLS, NODES, NONE, SIDE, TILE};
use barchan_grid::particles::{MASS, Run, STRAIN, VOLUME};
use barchan_grid::transfer::{BATCH, Fault, GridToParticles, ParticlesToGrid, Rates, Scalar, Step, Survey};
use barchan_grid::wall::Mirror;
use barchan_lanes::{Float, Isa, Kernel, LANES, Lanes};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Steps after which particles are sorted again, if they have moved at all: a late sort costs the transfers more than it saves.
const SORT_AGE: u32 = 20;
/// A sort that finds nobody far from home is not worth its time.
const SORT_DRIFT: f64 = 0.4;
/// The halo allows for this much drift since the last sort, in cells.
const MAX_DRIFT: f64 = 1.0;
/// No particle may move further in a step, in cells: fixed-point positions and the halo rely on it.
const MAX_MOVE: f64 = 0.5;
/// Strain is applied in parts that deform by no more than this.
const MAX_DEFORMATION: f64 = 0.5;
/// More parts than any motion needs that the grid gave: nodes move by half a cell at most.
const MAX_PARTS: f64 = 1000.0;
/// Every so manieth block measures how much of P2G its materials take.
const TIMED_BLOCKS: usize = 16;

/// Steps between measurements of the stiffness of materials that harden: it takes about as long as a transfer, and strain
/// changes little in between.
const STIFFNESS_AGE: u32 = 10;

/// A pass that is timed.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Pass {
    Sort,
    P2G,
    Grid,
    Contact,
    G2P,
}

impl Pass {
    const fn name(self) -> &'static str {
        match self {
            Self::Sort => "sort",
            Self::P2G => "P2G",
            Self::Grid => "grid",
            Self::Contact => "contact",
            Self::G2P => "G2P",
        }
    }
}

/// Time spent in each pass, and in each material within P2G.
#[derive(Default)]
struct Clocks {
    passes: BTreeMap<Pass, (Duration, u64)>,
    /// Nanoseconds in each material's callback and in P2G as a whole, over the blocks that measure.
    materials: Vec<u64>,
    sampled: u64,
}

impl Clocks {
    fn add(&mut self, pass: Pass, since: Instant) {
        let entry = self.passes.entry(pass).or_default();
        entry.0 += since.elapsed();
        entry.1 += 1;
    }
}

/// One level of one world on the CPU.
pub(crate) struct CpuEngine<T: Scalar> {
    pool: rayon::ThreadPool,
    isa: Isa,
    materials: Vec<PlannedMaterial>,
    bounds: Bounds,
    leaving: Leaving,
    scene: Scene,
    /// Gravity of the present step [m/s²].
    gravity: [f64; 3],
    store: Store<T>,
    grid: Grid<T>,
    /// Steps since the last sort; `None` before the first one.
    age: Option<u32>,
    /// Upper bound of any particle's move since then, in cells.
    drift: f64,
    /// Step over which C has carried the particles but not yet their strain [s].
    strain_dt: f64,
    /// Greatest Frobenius norm of C [1/s].
    deformation_rate: f64,
    /// Greatest node speed of the last step, along an axis [m/s].
    max_speed: f64,
    /// Greatest speed of any particle along an axis [m/s]. Bounds the next step: unlike the nodes', it is part of a snapshot.
    particle_speed: f64,
    /// Nodes lighter than this carry nothing that a particle could feel [kg].
    least_mass: f64,
    /// Stiffness bound when it was measured last, and the steps since then.
    stiffness: Bound,
    stiffness_age: u32,
    /// Did NaN or infinity come in with the particles?
    spoilt: bool,
    /// Does any material harden, so that the bound follows the state?
    hardens: bool,
    steps: u64,
    /// Mass of all particles that ever came in [kg].
    mass: f64,
    departures: Departures,
    shortened: u64,
    parted: u64,
    wall_impulse: [f64; 3],
    gravity_impulse: [f64; 3],
    batch: NodeBatch,
    batch_nodes: Vec<u32>,
    clocks: Clocks,
}

impl<T: Scalar> CpuEngine<T> {
    pub(crate) fn new(plan: &Plan, particles: ParticleState) -> Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(plan.threads).build().map_err(|e| Error::Io {
            file: "threads".into(),
            what: "starting worker threads",
            source: std::io::Error::other(e),
        })?;
        let mut engine = Self {
            pool,
            isa: Isa::current(),
            materials: plan.materials.clone(),
            bounds: Bounds::new(plan),
            leaving: plan.scene.world.leaving,
            scene: plan.scene.clone(),
            gravity: plan.gravity,
            store: Store::new(&plan.materials, plan.cell_widths[0]),
            grid: Grid::default(),
            age: None,
            drift: 0.0,
            strain_dt: 0.0,
            deformation_rate: 0.0,
            max_speed: 0.0,
            particle_speed: 0.0,
            least_mass: 0.0,
            stiffness: Bound { dt: f64::INFINITY, by: "nothing".into() },
            stiffness_age: 0,
            spoilt: false,
            hardens: plan.materials.iter().any(|m| m.material.has(abi::BARCHAN_CAP_HARDENS)),
            steps: 0,
            mass: 0.0,
            departures: Departures::default(),
            shortened: 0,
            parted: 0,
            wall_impulse: [0.0; 3],
            gravity_impulse: [0.0; 3],
            batch: NodeBatch::default(),
            batch_nodes: Vec::new(),
            clocks: Clocks { materials: vec![0; plan.materials.len()], ..Clocks::default() },
        };
        engine.upload(particles)?;
        Ok(engine)
    }

    /// Sorts, and rebuilds the grid if blocks have come or gone.
    fn sort(&mut self) -> Result<()> {
        let clock = Instant::now();
        let (store, grid, bounds, leaving) = (&mut self.store, &mut self.grid, &self.bounds, self.leaving);
        let departures = self.pool.install(|| {
            let departures = store.sort(bounds, leaving)?;
            if departures.refused.is_none() {
                grid.rebuild(store.blocks.clone(), bounds);
            }
            Ok::<_, Error>(departures)
        })?;
        if let Some((l, chunk, lane)) = departures.refused {
            let (list, h) = (&self.store.lists[l], self.store.cell_width);
            let (cell, offset) = (list.cell_of(chunk, lane), list.offset_of(chunk, lane));
            return Err(Error::LeftWorld {
                step: self.steps,
                particle: u64::from(list.id[chunk][lane]),
                position: std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * h),
            });
        }
        self.departures.clamped += departures.clamped;
        self.departures.deleted += departures.deleted;
        self.departures.deleted_mass += departures.deleted_mass;
        for d in 0..3 {
            self.wall_impulse[d] += departures.impulse[d];
        }
        self.age = Some(0);
        self.drift = 0.0;
        self.clocks.add(Pass::Sort, clock);
        Ok(())
    }

    /// Mass, momentum and stress of every block's particles into the block's tile. Strain is up to date afterwards.
    fn particles_to_grid(&mut self, dt: f64) -> Result<()> {
        let clock = Instant::now();
        let parts = (self.deformation_rate * self.strain_dt / MAX_DEFORMATION).ceil();
        if parts > MAX_PARTS {
            return Err(self.find_non_finite().unwrap_or(Error::TimeStep {
                step: self.steps,
                dt: self.strain_dt,
                bound: MAX_PARTS * MAX_DEFORMATION / self.deformation_rate,
                by: "the deformation rate that particles were given".into(),
            }));
        }
        let step = Step {
            h: self.store.cell_width,
            dt,
            strain_dt: self.strain_dt,
            strain_parts: (parts as u32).max(1),
            gravity: self.gravity,
        };
        self.parted += u64::from(step.strain_parts > 1);
        let (isa, lists, grid, mirrors) = (self.isa, &self.store.lists, &self.grid, &self.bounds.mirrors);
        let tiles = Shared(self.grid.tiles.as_ptr().cast_mut());
        let walls = mirrors.kind.iter().flatten().any(|&kind| kind != Mirror::Open);
        let blocks = grid.occupied.len();
        let mut impulses = vec![[0.0; 3]; if walls { blocks } else { 0 }];
        let impulse_of = Shared(impulses.as_mut_ptr());
        let images = Shared(self.grid.images.as_ptr().cast_mut());
        let n_materials = self.clocks.materials.len();
        let fault = self.pool.install(|| {
            (0..blocks)
                .into_par_iter()
                .map(|b| {
                    // SAFETY: each block has a tile of its own.
                    let tile = unsafe { &mut *tiles.at(b) };
                    let mut spent = [0u64; 2];
                    let timed = b % TIMED_BLOCKS == 0;
                    let begun = timed.then(Instant::now);
                    let mut shares = if timed { vec![0u64; n_materials] } else { Vec::new() };
                    let mut fault = None;
                    isa.run::<T, _>(Clear(tile));
                    for (l, list) in lists.iter().enumerate() {
                        let run = list.runs[b];
                        if run.count == 0 {
                            continue;
                        }
                        let mut message = ErrorBuffer::default();
                        let outcome = isa.run::<T, _>(ParticlesToGrid {
                            particles: list.view(),
                            run,
                            origin: grid.origin(b),
                            law: &list.law,
                            step: &step,
                            tile,
                            error: message.as_raw(),
                            material_time: timed.then(|| &mut spent[0]),
                        });
                        if let Err(f) = outcome {
                            fault = fault.or(Some((b, l, f, message)));
                        }
                        if timed {
                            shares[list.material] += std::mem::take(&mut spent[0]);
                        }
                    }
                    if walls && grid.mirrored[b] {
                        // SAFETY: each block has an entry of its own.
                        unsafe {
                            *impulse_of.at(b) = mirrors.fold(tile, grid.origin(b), &mut *images.at(b));
                        }
                    }
                    (fault, shares, begun.map_or(0, |t| t.elapsed().as_nanos() as u64))
                })
                .reduce(
                    || (None, Vec::new(), 0),
                    |a, b| {
                        let first = match (a.0, b.0) {
                            (Some(x), Some(y)) => Some(if x.0 <= y.0 { x } else { y }),
                            (x, y) => x.or(y),
                        };
                        let shares = if a.1.is_empty() {
                            b.1
                        } else if b.1.is_empty() {
                            a.1
                        } else {
                            a.1.iter().zip(&b.1).map(|(x, y)| x + y).collect()
                        };
                        (first, shares, a.2 + b.2)
                    },
                )
        });
        // Strain has been carried along, so a repetition of this pass must not carry it again.
        self.strain_dt = 0.0;
        let (fault, shares, nanoseconds) = fault;
        for (sum, share) in self.clocks.materials.iter_mut().zip(shares) {
            *sum += share;
        }
        self.clocks.sampled += nanoseconds;
        if let Some((_, list, fault, message)) = fault {
            return Err(self.explain(list, fault, &message));
        }
        for impulse in impulses {
            for d in 0..3 {
                self.wall_impulse[d] += impulse[d];
            }
        }
        self.clocks.add(Pass::P2G, clock);
        Ok(())
    }

    /// Turns a fault of a transfer into what a user can act upon.
    fn explain(&self, list: usize, fault: Fault, message: &ErrorBuffer) -> Error {
        if let Some(error) = self.find_non_finite() {
            return error;
        }
        let l = &self.store.lists[list];
        match fault {
            Fault::Material { status, chunk } => {
                let id = |i: u64| {
                    l.id.get(chunk + i as usize / LANES).map_or(u64::MAX, |ids| u64::from(ids[i as usize % LANES]))
                };
                let planned = &self.materials[l.material];
                match message.check(status, &planned.material, "update", id) {
                    Err(error) => error,
                    Ok(()) => unreachable!("a fault carries a status that is not OK"),
                }
            }
            // The particle is finite, so its momentum has overflowed.
            Fault::NonFinite { chunk, lane } => self.non_finite("momentum", list, chunk, lane, f64::INFINITY, 1),
            Fault::Strayed { chunk } => self.non_finite("cell", list, chunk, 0, f64::NAN, 1),
        }
    }

    fn non_finite(&self, field: &'static str, list: usize, chunk: usize, lane: usize, value: f64, count: u64) -> Error {
        let list = &self.store.lists[list];
        Error::NonFinite {
            step: self.steps,
            time: 0.0,
            field,
            particle: u64::from(list.id[chunk][lane]),
            list: self.materials[list.material].name.clone(),
            value,
            count,
        }
    }

    /// The particle of least id with a NaN or infinite value.
    fn find_non_finite(&self) -> Option<Error> {
        let mut first: Option<(u32, &'static str, usize, usize, usize, f64)> = None;
        let mut count = 0;
        for (l, list) in self.store.lists.iter().enumerate() {
            let planes = list.strain_planes();
            for (chunk, lane) in list.places() {
                let motion = list.motion_of(chunk, lane);
                let fields = motion.iter().enumerate().map(|(p, &x)| (if p < 3 { "velocity" } else { "affine" }, x));
                let rest = (0..STRAIN + planes + list.law.table.n_state).map(|p| {
                    let field = match p {
                        0 => "mass",
                        1 => "volume0",
                        p if p < STRAIN + planes => "strain",
                        _ => "history",
                    };
                    (field, list.rest_of(chunk, lane, p))
                });
                if let Some((field, value)) = fields.chain(rest).find(|(_, x)| !x.is_finite()) {
                    count += 1;
                    let id = list.id[chunk][lane];
                    if first.is_none_or(|f| id < f.0) {
                        first = Some((id, field, l, chunk, lane, value));
                    }
                }
            }
        }
        first.map(|(_, field, l, chunk, lane, value)| self.non_finite(field, l, chunk, lane, value, count))
    }

    /// Sums tiles into nodes, lets walls that let go decide, and turns momentum into velocity.
    fn update_grid(&mut self) {
        let clock = Instant::now();
        let (isa, grid, least) = (self.isa, &self.grid, T::from_f64(self.least_mass));
        let nodes = Shared(self.grid.nodes.as_ptr().cast_mut());
        let separate = !self.bounds.separations.is_empty();
        let sum = |convert: bool| {
            (0..grid.keys.len())
                .into_par_iter()
                .map(|g| {
                    // SAFETY: each task has a node block of its own.
                    let nodes = unsafe { &mut *nodes.at(g) };
                    isa.run::<T, _>(SumTiles { nodes, tiles: &grid.tiles, around: &grid.tiles_around[g] });
                    if convert { isa.run::<T, _>(Velocities { nodes, least }) } else { T::default() }
                })
                .reduce(T::default, |a, b| greater(a, b))
        };
        let speed = self.pool.install(|| sum(!separate));
        self.max_speed = speed.to_f64();
        if separate {
            self.separate(least);
        }
        self.clocks.add(Pass::Grid, clock);
    }

    /// The grid update at walls that let go of the ground.
    fn separate(&mut self, least: T) {
        let nodes = Shared(self.grid.nodes.as_mut_ptr().cast::<[T; 4]>());
        let separations = &self.bounds.separations;
        for pairs in &mut self.grid.pairs {
            for pair in pairs {
                // SAFETY: pairs name two different nodes of the grid, and this loop alone works on them.
                let (node, image) =
                    unsafe { (&mut *nodes.at(pair.node as usize), &mut *nodes.at(pair.image as usize)) };
                pair.image_mass = image[3].to_f64();
                let (presses, impulse) = separations[pair.separation as usize].0.fold(node, image);
                pair.presses = presses;
                for d in 0..3 {
                    self.wall_impulse[d] += impulse[d];
                }
            }
        }
        let (isa, blocks) = (self.isa, Shared(self.grid.nodes.as_mut_ptr()));
        let count = self.grid.keys.len();
        let speed = self.pool.install(|| {
            (0..count)
                .into_par_iter()
                // SAFETY: each task has a node block of its own.
                .map(|g| isa.run::<T, _>(Velocities { nodes: unsafe { &mut *blocks.at(g) }, least }))
                .reduce(T::default, |a, b| greater(a, b))
        });
        self.max_speed = speed.to_f64();
    }

    /// Gives images behind walls that let go the velocity of their nodes.
    fn mirror_separated(&mut self) {
        let nodes = Shared(self.grid.nodes.as_mut_ptr().cast::<[T; 4]>());
        for pair in self.grid.pairs.iter().rev().flatten() {
            let separation = &self.bounds.separations[pair.separation as usize].0;
            // SAFETY: as in `separate`.
            unsafe {
                let node = *nodes.at(pair.node as usize);
                let (image, impulse) = separation.unfold(&node, pair.presses, pair.image_mass);
                *nodes.at(pair.image as usize) = image;
                for d in 0..3 {
                    self.wall_impulse[d] += impulse[d];
                }
            }
        }
    }

    /// P2G and the grid update, repeated with a shorter step while nodes would carry particles too far. Returns the step.
    fn ground_to_nodes(&mut self, time: f64, mut dt: f64) -> Result<f64> {
        let walls_before = self.wall_impulse;
        loop {
            self.particles_to_grid(dt).map_err(|error| at_time(error, time))?;
            self.update_grid();
            if !self.max_speed.is_finite() {
                let error = self.find_non_finite().unwrap_or_else(|| Error::NonFinite {
                    step: self.steps,
                    time,
                    field: "node velocity",
                    particle: 0,
                    list: String::new(),
                    value: self.max_speed,
                    count: 0,
                });
                return Err(at_time(error, time));
            }
            let moves = self.max_speed * dt / self.store.cell_width;
            if moves <= MAX_MOVE {
                return Ok(dt);
            }
            // Too fast for this step: take a shorter one. The impulse of gravity and stress shrinks with it.
            dt *= (0.9 * MAX_MOVE / moves).max(0.1);
            self.wall_impulse = walls_before;
            self.shortened += 1;
        }
    }

    /// Hands the nodes near each coupling's bodies to it, and takes back their velocities.
    fn contact(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<()> {
        if couplings.is_empty() {
            return Ok(());
        }
        let clock = Instant::now();
        let h = self.store.cell_width;
        for coupling in couplings {
            coupling.before_step(time, dt)?;
            let boxes = coupling.bounds();
            self.gather(&boxes);
            self.batch.cell_width = h;
            coupling.contact(dt, &mut self.batch)?;
            let nodes = self.grid.nodes.as_mut_ptr().cast::<[T; 4]>();
            for (&at, u) in self.batch_nodes.iter().zip(&self.batch.velocity) {
                // SAFETY: `gather` took the index from this grid.
                let node = unsafe { &mut *nodes.add(at as usize) };
                for d in 0..3 {
                    node[d] = T::from_f64(u[d]);
                    self.max_speed = greater(self.max_speed, u[d].abs());
                }
            }
        }
        self.clocks.add(Pass::Contact, clock);
        Ok(())
    }

    /// Collects the nodes inside any of the boxes, in the grid's order.
    fn gather(&mut self, boxes: &[Aabb]) {
        self.batch.clear();
        self.batch_nodes.clear();
        let h = self.store.cell_width;
        let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
        for (g, (&key, nodes)) in self.grid.keys.iter().zip(&self.grid.nodes).enumerate() {
            let first = block::of_key(key).map(|b| b * SIDE);
            let extent = Aabb { min: first.map(centre), max: first.map(|c| centre(c + SIDE - 1)) };
            if !boxes.iter().any(|b| b.meets(&extent)) {
                continue;
            }
            for n in 0..CELLS {
                let node = &nodes[4 * n..4 * n + 4];
                let mass = node[3].to_f64();
                if mass <= self.least_mass {
                    continue;
                }
                let local = [(n / 16) as i32, (n / 4 % 4) as i32, (n % 4) as i32];
                let x = std::array::from_fn(|d| centre(first[d] + local[d]));
                if boxes.iter().any(|b| b.contains(x)) {
                    self.batch.position.push(x);
                    self.batch.mass.push(mass);
                    self.batch.velocity.push([node[0].to_f64(), node[1].to_f64(), node[2].to_f64()]);
                    self.batch_nodes.push((g * CELLS + n) as u32);
                }
            }
        }
    }

    /// New velocities and affine matrices, and the move.
    fn grid_to_particles(&mut self, dt: f64) {
        let clock = Instant::now();
        let step = Step { h: self.store.cell_width, dt, strain_dt: 0.0, strain_parts: 1, gravity: self.gravity };
        let (isa, lists, grid, mirrors) = (self.isa, &self.store.lists, &self.grid, &self.bounds.mirrors);
        let tiles = Shared(self.grid.tiles.as_ptr().cast_mut());
        let walls = mirrors.kind.iter().flatten().any(|&kind| kind != Mirror::Open);
        let mut impulses = vec![[0.0; 3]; if walls { grid.occupied.len() } else { 0 }];
        let impulse_of = Shared(impulses.as_mut_ptr());
        let greatest = self.pool.install(|| {
            (0..grid.occupied.len())
                .into_par_iter()
                .map(|b| {
                    // SAFETY: each block has a tile of its own; its momentum has been summed and is no longer needed.
                    let tile = unsafe { &mut *tiles.at(b) };
                    isa.run::<T, _>(FillTile { tile, nodes: &grid.nodes, around: &grid.nodes_around[b] });
                    if grid.mirrored[b] {
                        // SAFETY: each block has an entry of its own.
                        unsafe { *impulse_of.at(b) = mirrors.unfold(tile, grid.origin(b), &grid.images[b]) };
                    }
                    let mut greatest = Rates::default();
                    for list in lists {
                        let run = list.runs[b];
                        if run.count > 0 {
                            let rates = isa.run::<T, _>(GridToParticles {
                                particles: list.view(),
                                run,
                                origin: grid.origin(b),
                                step: &step,
                                tile,
                            });
                            greatest = faster(greatest, rates);
                        }
                    }
                    greatest
                })
                .reduce(Rates::default, faster)
        });
        for impulse in impulses {
            for d in 0..3 {
                self.wall_impulse[d] += impulse[d];
            }
        }
        self.take_rates(greatest);
        self.strain_dt = dt;
        self.clocks.add(Pass::G2P, clock);
    }

    /// Asks every material for its stiffness and keeps the least stable step.
    fn measure_stiffness(&mut self) -> Result<()> {
        self.stiffness_age = 0;
        self.stiffness = Bound { dt: f64::INFINITY, by: "nothing".into() };
        for list in &self.store.lists {
            let planned = &self.materials[list.material];
            let Some(moduli) = planned.material.table.tangent_moduli_f32 else { continue };
            let planes = list.strain_planes();
            let params: Vec<f32> = planned.parameters.iter().map(|&p| p as f32).collect();
            let blocks = list.runs.iter().filter(|run| run.count > 0);
            // A law that does not harden is as stiff everywhere as at its first particle.
            let hardens = planned.material.has(abi::BARCHAN_CAP_HARDENS);
            let runs: Vec<_> = if hardens { blocks.collect() } else { blocks.take(1).collect() };
            // Stiffness is asked of matter at rest.
            const NO_RATE: [[f32; LANES]; 9] = [[0.0; LANES]; 9];
            type Planes<const N: usize> = [[f32; LANES]; N];
            type Scratch = (Planes<9>, Planes<{ barchan_grid::transfer::MAX_STATE }>, ErrorBuffer);
            let chunk_bound = |chunk: usize, count: usize, (strain, state, message): &mut Scratch| -> Result<f64> {
                let mut out = [[0f32; LANES]; 2];
                for (p, plane) in strain[..planes].iter_mut().enumerate() {
                    *plane = list.rest_plane(chunk, STRAIN + p).map(|x| x.to_f64() as f32);
                }
                for (q, plane) in state[..list.law.table.n_state].iter_mut().enumerate() {
                    *plane = list.rest_plane(chunk, STRAIN + planes + q).map(|x| x.to_f64() as f32);
                }
                let batch = abi::BarchanBatchF32 {
                    struct_size: size_of::<abi::BarchanBatchF32>(),
                    n: LANES,
                    stride: LANES,
                    dt: 0.0,
                    reserved: 0,
                    params: params.as_ptr(),
                    strain_trial: strain.as_ptr().cast(),
                    vel_grad: NO_RATE.as_ptr().cast(),
                    state_in: state.as_ptr().cast(),
                    strain: std::ptr::null_mut(),
                    kirchhoff: std::ptr::null_mut(),
                    state_out: std::ptr::null_mut(),
                };
                // SAFETY: the planes that this callback reads, and the two that it writes, hold 16 values each.
                let status = unsafe { moduli(&batch, out.as_mut_ptr().cast(), message.as_raw()) };
                message.check(status, &planned.material, "tangent_moduli", |i| {
                    // A callback may name any number.
                    usize::try_from(i).ok().and_then(|i| list.id[chunk].get(i)).map_or(u64::MAX, |&id| u64::from(id))
                })?;
                // The minimum would lose a NaN, and with it the bound.
                let wrong = |lane: usize| !out.iter().all(|m| m[lane].is_finite() && m[lane] > 0.0);
                if let Some(lane) = (0..count).find(|&lane| wrong(lane)) {
                    let moduli = [out[0][lane], out[1][lane]];
                    return Err(Error::MaterialFailed {
                        material: planned.name.clone(),
                        origin: planned.material.origin.clone(),
                        callback: "tangent_moduli",
                        message: format!("the moduli are {moduli:?} Pa; they must be finite and above 0"),
                        particle: Some(u64::from(list.id[chunk][lane])),
                    });
                }
                let (mass, volume0) = (list.rest_plane(chunk, MASS), list.rest_plane(chunk, VOLUME));
                let step = |lane: usize| {
                    let density = mass[lane].to_f64() / volume0[lane].to_f64();
                    stable_step(self.store.cell_width, density, f64::from(out[0][lane]), f64::from(out[1][lane]))
                };
                Ok((0..count).map(step).fold(f64::INFINITY, f64::min))
            };
            let least = self.pool.install(|| {
                let run_bound = |run: &&Run| {
                    let mut scratch: Scratch = (Default::default(), Default::default(), ErrorBuffer::default());
                    (0..run.chunks()).try_fold(f64::INFINITY, |least: f64, k| {
                        let count = (run.count - k * LANES).min(LANES);
                        Ok(least.min(chunk_bound(run.first + k, count, &mut scratch)?))
                    })
                };
                runs.par_iter().map(run_bound).try_reduce(|| f64::INFINITY, |a, b| Ok(a.min(b)))
            })?;
            if least < self.stiffness.dt {
                self.stiffness = Bound { dt: least, by: format!("stiffness of material '{}'", planned.name) };
            }
        }
        Ok(())
    }
}

/// A fault in the state, with the time at which it was found.
fn at_time(error: Error, at: f64) -> Error {
    match error {
        Error::NonFinite { step, field, particle, list, value, count, .. } => {
            Error::NonFinite { step, time: at, field, particle, list, value, count }
        }
        other => other,
    }
}

/// The greater of two magnitudes; NaN wins, so that it cannot hide.
fn greater<T: Float>(a: T, b: T) -> T {
    if a >= b || a.to_f64().is_nan() { a } else { b }
}

/// The greater of each.
fn faster<T: Float>(a: Rates<T>, b: Rates<T>) -> Rates<T> {
    Rates { deformation: greater(a.deformation, b.deformation), speed: greater(a.speed, b.speed) }
}

/// Zeroes a tile.
struct Clear<'a, T>(&'a mut [T; TILE]);

impl<T: Float> Kernel<T> for Clear<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        self.0.fill(T::default());
    }
}

/// Sums what the tiles around a node block hold for it.
struct SumTiles<'a, T> {
    nodes: &'a mut [T; NODES],
    tiles: &'a [[T; TILE]],
    around: &'a [u32; 27],
}

impl<T: Float> Kernel<T> for SumTiles<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        self.nodes.fill(T::default());
        for (n, &tile) in self.around.iter().enumerate() {
            if tile != NONE {
                block::add_tile(self.nodes, &self.tiles[tile as usize], block::offset(n));
            }
        }
    }
}

/// Momentum to velocity. Returns the greatest velocity component, or NaN if any is not finite.
struct Velocities<'a, T> {
    nodes: &'a mut [T; NODES],
    least: T,
}

impl<T: Float> Kernel<T> for Velocities<'_, T> {
    type Output = T;
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) -> T {
        const MASS_LANE: [f64; LANES] = [0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1., 0., 0., 0., 1.];
        let mut lanes = [T::default(); LANES];
        for (lane, one) in lanes.iter_mut().zip(MASS_LANE) {
            *lane = T::from_f64(one);
        }
        // SAFETY: 16 scalars.
        let is_mass = unsafe { V::load(lanes.as_ptr()) }.gt(V::zero());
        let (mut greatest, mut bad) = (V::zero(), V::zero());
        for four in self.nodes.as_chunks_mut::<LANES>().0 {
            // SAFETY: 16 scalars, four nodes.
            unsafe {
                let node = V::load(four.as_ptr());
                let mass = node.fourth();
                let carries = mass.gt(V::fill(self.least));
                let u = V::select(carries, node / mass, V::zero());
                let speed = V::select(is_mass, V::zero(), u).abs();
                greatest = greatest.max(speed);
                // 0 for finite numbers, NaN for others; the maximum might lose a NaN.
                bad += speed * V::zero();
                V::select(is_mass, node, u).store(four.as_mut_ptr());
            }
        }
        greatest.max_lane() + bad.sum()
    }
}

/// Collects the velocities that a block's particles read.
struct FillTile<'a, T> {
    tile: &'a mut [T; TILE],
    nodes: &'a [[T; NODES]],
    around: &'a [u32; 27],
}

impl<T: Float> Kernel<T> for FillTile<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<V: Lanes<Scalar = T>>(self) {
        for (n, &nodes) in self.around.iter().enumerate() {
            block::fill_tile(self.tile, self.nodes.get(nodes as usize), block::offset(n));
        }
    }
}

impl<T: Scalar> Engine for CpuEngine<T> {
    fn bound(&self) -> Bound {
        let speed = MAX_MOVE * self.store.cell_width / self.particle_speed;
        // An infinite speed is for the step to find, with the particle's name.
        if speed < self.stiffness.dt && speed > 0.0 {
            Bound { dt: speed, by: "particle speed: no particle may move further than half a cell in a step".into() }
        } else {
            self.stiffness.clone()
        }
    }

    fn step(&mut self, time: f64, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<StepReport> {
        let sorted = match self.age {
            None => true,
            Some(age) => self.drift > MAX_DRIFT || (age >= SORT_AGE && self.drift > SORT_DRIFT),
        };
        let ground = self.store.len() > 0;
        if self.spoilt {
            // Found here, it has touched nothing yet.
            self.find_non_finite().map_or(Ok(()), |error| Err(at_time(error, time)))?;
        }
        if sorted && ground {
            self.sort()?;
        }
        let h = self.store.cell_width;
        let mut dt = dt;
        self.gravity = self.scene.gravity_at(time);
        if ground {
            dt = self.ground_to_nodes(time, dt)?;
        } else {
            self.max_speed = 0.0;
        }
        self.contact(time, dt, couplings)?;
        if self.max_speed.is_nan() || self.max_speed * dt / h > MAX_MOVE * (1.0 + 1e-9) {
            return Err(Error::TimeStep {
                step: self.steps,
                dt,
                bound: MAX_MOVE * h / self.max_speed,
                by: "the speed that a coupling gave to a node".into(),
            });
        }
        if ground {
            self.mirror_separated();
            self.grid_to_particles(dt);
        }
        self.stiffness_age += 1;
        if self.hardens && self.stiffness_age >= STIFFNESS_AGE {
            self.measure_stiffness()?;
        }
        for coupling in couplings {
            coupling.after_step(time, dt)?;
        }
        let mass = self.total_mass();
        for d in 0..3 {
            self.gravity_impulse[d] += mass * self.gravity[d] * dt;
        }
        self.drift += self.max_speed * dt / h;
        self.age = self.age.map(|age| age + 1);
        self.steps += 1;
        Ok(StepReport { dt, sorted: sorted && ground, max_speed: self.max_speed })
    }

    fn download(&self) -> ParticleState {
        let measured = Measured { stiffness_bound: self.stiffness.dt, stiffness_age: self.stiffness_age };
        let mut state = self.store.download(self.age.unwrap_or(0), self.drift, measured, self.strain_dt);
        if self.age.is_none() {
            state.sort = None;
        }
        state
    }

    fn upload(&mut self, particles: ParticleState) -> Result<()> {
        self.store.upload(&particles)?;
        self.strain_dt = particles.strain_dt;
        self.spoilt = self.find_non_finite().is_some();
        self.take_stock();
        // Materials cannot say how stiff NaN is; the next step names it.
        if !self.spoilt {
            self.measure_stiffness()?;
        }
        match &particles.sort {
            Some(sort) => {
                (self.age, self.drift) = (Some(sort.age), sort.drift);
                self.grid.rebuild(self.store.blocks.clone(), &self.bounds);
                self.stiffness.dt = sort.measured.stiffness_bound;
                self.stiffness_age = sort.measured.stiffness_age;
            }
            None => (self.age, self.drift) = (None, 0.0),
        }
        Ok(())
    }

    fn particle_count(&self) -> usize {
        self.store.len()
    }

    fn account(&self, ledger: &mut Ledger) {
        self.account_particles(ledger);
        for d in 0..3 {
            ledger.wall_impulse[d] += self.wall_impulse[d];
            ledger.gravity_impulse[d] += self.gravity_impulse[d];
        }
        ledger.deleted_mass += self.departures.deleted_mass;
        ledger.count("particles put back into the world", self.departures.clamped);
        ledger.count("particles deleted on leaving", self.departures.deleted);
        ledger.count("steps shortened for speed", self.shortened);
        ledger.count("steps with strain applied in parts", self.parted);
    }

    fn timings(&self) -> Vec<Timing> {
        let p2g = self.clocks.passes.get(&Pass::P2G).map_or(0.0, |(time, _)| time.as_secs_f64());
        let mut timings = Vec::new();
        for (&pass, &(time, passes)) in &self.clocks.passes {
            let mut seconds = time.as_secs_f64();
            if pass == Pass::P2G {
                for (m, &nanoseconds) in self.clocks.materials.iter().enumerate() {
                    let share = nanoseconds as f64 / (self.clocks.sampled.max(1)) as f64 * p2g;
                    seconds -= share;
                    timings.push(Timing {
                        effect: format!("material {}", self.materials[m].name),
                        seconds: share,
                        passes,
                    });
                }
            }
            timings.push(Timing { effect: pass.name().into(), seconds, passes });
        }
        timings
    }

    fn memory(&self) -> (u64, u64) {
        (self.store.bytes(), self.grid.bytes())
    }
}

impl<T: Scalar> CpuEngine<T> {
    /// Total mass, kept from the last upload and corrected for what was deleted.
    fn total_mass(&self) -> f64 {
        self.mass - self.departures.deleted_mass
    }

    fn take_rates(&mut self, rates: Rates<T>) {
        self.deformation_rate = rates.deformation.to_f64().sqrt();
        self.particle_speed = rates.speed.to_f64();
    }

    /// What depends on the particles as they come in: total and least mass, greatest deformation rate and speed.
    fn take_stock(&mut self) {
        let (mut least, mut mass) = (f64::INFINITY, 0.0);
        let mut rates = Rates::default();
        for list in &self.store.lists {
            for (chunk, lane) in list.places() {
                let m = list.mass_of(chunk, lane);
                least = least.min(m);
                mass += m;
            }
            for &run in &list.runs {
                rates = faster(rates, self.isa.run::<T, _>(Survey { particles: list.view(), run }));
            }
        }
        self.mass = mass + self.departures.deleted_mass;
        self.least_mass = if least.is_finite() { least * 1e-20 } else { 0.0 };
        self.take_rates(rates);
    }

    /// Adds mass, momenta, energies and the materials' counts.
    fn account_particles(&self, ledger: &mut Ledger) {
        let h = self.store.cell_width;
        let quarter = 0.25 * h * h;
        for list in &self.store.lists {
            for (chunk, lane) in list.places() {
                let m = list.mass_of(chunk, lane);
                let motion = list.motion_of(chunk, lane);
                let (v, c) = ([motion[0], motion[1], motion[2]], &motion[3..]);
                let (cell, offset) = (list.cell_of(chunk, lane), list.offset_of(chunk, lane));
                let x: [f64; 3] = std::array::from_fn(|d| (f64::from(cell[d]) + offset[d]) * h);
                ledger.particles += 1;
                ledger.mass += m;
                for d in 0..3 {
                    let (a, b) = ((d + 1) % 3, (d + 2) % 3);
                    ledger.momentum[d] += m * v[d];
                    // x × v, and the spin that C carries about the particle.
                    ledger.angular_momentum[d] +=
                        m * (x[a] * v[b] - x[b] * v[a] + quarter * (c[3 * b + a] - c[3 * a + b]));
                    ledger.potential -= m * self.scene.gravity[d] * x[d];
                }
                let square = |values: &[f64]| values.iter().map(|y| y * y).sum::<f64>();
                ledger.kinetic += 0.5 * m * (square(&v) + quarter * square(c));
            }
            self.account_material(list, ledger);
        }
    }

    /// Adds elastic energy and the counts of one list.
    fn account_material(&self, list: &crate::store::List<T>, ledger: &mut Ledger) {
        let planned = &self.materials[list.material];
        let table = &planned.material.table;
        if table.energy_f64.is_none() {
            ledger.elastic = f64::NAN;
        }
        let (planes, n_state) = (list.strain_planes(), table.n_state);
        let mut strain = [[0f64; BATCH]; 9];
        let mut state = [[0f64; BATCH]; barchan_grid::transfer::MAX_STATE];
        let mut energy = [0f64; BATCH];
        let no_rate = [[0f64; BATCH]; 9];
        let wants_rate = planned.material.has(abi::BARCHAN_CAP_VEL_GRAD);
        let mut counts = [0u64; abi::BARCHAN_N_COUNTERS];
        for run in &list.runs {
            for from in (0..run.count).step_by(BATCH) {
                let n = (run.count - from).min(BATCH);
                let place = |i: usize| (run.first + (from + i) / LANES, (from + i) % LANES);
                for i in 0..n {
                    let (chunk, lane) = place(i);
                    for (p, plane) in strain[..planes].iter_mut().enumerate() {
                        plane[i] = list.rest_of(chunk, lane, STRAIN + p);
                    }
                    for (q, plane) in state[..n_state].iter_mut().enumerate() {
                        plane[i] = list.rest_of(chunk, lane, STRAIN + planes + q);
                    }
                }
                let batch = abi::BarchanBatchF64 {
                    struct_size: size_of::<abi::BarchanBatchF64>(),
                    n,
                    stride: BATCH,
                    dt: 0.0,
                    params: planned.parameters.as_ptr(),
                    strain_trial: strain.as_ptr().cast(),
                    vel_grad: if wants_rate { no_rate.as_ptr().cast() } else { std::ptr::null() },
                    state_in: if n_state > 0 { state.as_ptr().cast() } else { std::ptr::null() },
                    strain: std::ptr::null_mut(),
                    kirchhoff: std::ptr::null_mut(),
                    state_out: std::ptr::null_mut(),
                };
                let mut message = ErrorBuffer::default();
                if let Some(callback) = table.energy_f64 {
                    // SAFETY: the planes that this callback reads are BATCH long and n <= BATCH.
                    let status = unsafe { callback(&batch, energy.as_mut_ptr(), message.as_raw()) };
                    for (i, e) in energy[..n].iter().enumerate() {
                        let (chunk, lane) = place(i);
                        ledger.elastic +=
                            if status == abi::BARCHAN_OK { e * list.volume0_of(chunk, lane) } else { f64::NAN };
                    }
                }
                if let Some(callback) = table.count_f64 {
                    let mut here = [0u64; abi::BARCHAN_N_COUNTERS];
                    // SAFETY: as above.
                    if unsafe { callback(&batch, here.as_mut_ptr(), message.as_raw()) } == abi::BARCHAN_OK {
                        for (sum, count) in counts.iter_mut().zip(here) {
                            *sum += count;
                        }
                    }
                }
            }
        }
        for (what, index) in [
            ("yielding", abi::BARCHAN_COUNT_YIELDING),
            ("stress-free at the apex", abi::BARCHAN_COUNT_APEX),
            ("with a floored stretch", abi::BARCHAN_COUNT_FLOORED),
            ("with a clamped state", abi::BARCHAN_COUNT_CLAMPED),
        ] {
            ledger.count(&format!("{} particles {what} now", planned.name), counts[index]);
        }
    }
}
