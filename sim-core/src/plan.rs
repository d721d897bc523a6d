//! The plan: the effects that a scene calls for, and why; the stages they need; what bounds the step; what memory they take.

use crate::backend::Bound;
use crate::file::Stamp;
use crate::levels::{
    AROUND_AGENT, Agent, CellBox, DEAD_ZONE, LEAST_DEPTH, Regions, TILE, agent_bounds, surface_depths,
};
use crate::material::ErrorBuffer;
use crate::scene::{Body, Export, Leaving, MaterialSpec, Motion, OverBound, Wall, nearest, plain};
use crate::schedule::{Form, Needs, Schedule, Stage};
use crate::seed::Terrain;
use crate::simulation::Options;
use crate::stiffness::{Damping, Moduli, Stiffness};
use crate::{Backend, Coupling, Error, Material, ParticleList, ParticleState, Registry, Result, Scene, Vec3};
use barchan_abi as abi;
use barchan_lanes::Isa;
use std::collections::HashSet;
use std::fmt;
use std::sync::Arc;

/// What errors about particles that do not fit a plan name as their place.
pub(crate) const PARTICLES: &str = "particles";
/// Where laws come from that need no library.
pub const BUILT_IN: &str = "built-in";
/// Registered name of the coupling that a scene's tools call for.
pub const TOOL_COUPLING: &str = "rigid";
/// Greatest fraction of a cell that a tool's surface may move in one step. Of sand that a plate strikes faster than sound,
/// particles end up 0.8 cells deep in the plate at 0.4 cells a step, 1.3 at 0.5.
pub const TOOL_COURANT: f64 = 0.4;
/// Fine cells that should lie below a tool before a rim: a sphere pressed into elastic ground, its box's half side 12, 10 and 8 cells, felt 0.1, 1.4 and
/// 7.5 % more than in fine ground throughout.
const LEAST_BELOW: f64 = 6.0;
/// Friction angle above which a cone matched in triaxial compression never fails in plane strain [rad]: there
/// 2 sqrt(3) sin(phi) / (3 - sin(phi)) = 1.
const NO_PLANE_STRAIN_FAILURE: f64 = 0.736_9;
/// Poisson's ratio above which the pressure of a displacement-only method checkers.
const NEARLY_INCOMPRESSIBLE: f64 = 0.49;
/// Resident bytes of one occupied block of 4³ cells in f32: its nodes with their halo, and bookkeeping.
const BLOCK_BYTES: u64 = 9 * 1024;
/// Cells further from the origin than any backend reaches; coordinates up to here can be added without overflow.
pub(crate) const FARTHEST_CELL: u32 = 1 << 30;
/// Ground slower than this part of sqrt(g h) is at rest: at 1 cm, 3e-5 m/s.
const SLOW: f64 = 1e-4;
/// Where no ground bounds it, an automatic step is at most this long [s].
const UNBOUND_STEP: f64 = 5e-3;
/// Relative width to which the longest step is found that tools bear: it is short of what it might be by that at most.
const TOOL_STEP_WIDTH: f64 = 1e-3;

/// Number format of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// 32-bit floats, 32-bit fixed-point offsets.
    #[default]
    F32,
    /// 64-bit floats.
    F64,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if *self == Self::F32 { "f32" } else { "f64" })
    }
}

impl std::str::FromStr for Precision {
    type Err = String;
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "f32" => Ok(Self::F32),
            "f64" => Ok(Self::F64),
            _ => Err(format!("'{text}' is no precision; use f32 or f64")),
        }
    }
}

/// Something that a scene calls for, and what it brings with it.
#[derive(Clone, Debug, PartialEq)]
pub struct Effect {
    /// Such as "material sand" or "two-way coupling".
    pub name: String,
    /// Which keys of the scene call for it.
    pub because: String,
    /// What it adds: passes, planes, callbacks.
    pub adds: String,
}

/// A material of the scene, ready for a backend.
#[derive(Clone, Debug)]
pub struct PlannedMaterial {
    /// Name in the scene.
    pub name: String,
    /// The law.
    pub material: Material,
    /// All parameters in the law's order, SI.
    pub parameters: Vec<f64>,
    /// Density at rest [kg/m³].
    pub density: f64,
    /// Damping of elastic strain, if the scene asks for any.
    pub damping: Option<Damping>,
}

/// What a backend builds.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The scene.
    pub scene: Scene,
    /// The files that it reads, as they were.
    pub files: Vec<Stamp>,
    /// Number format.
    pub precision: Precision,
    /// Worker threads; 0: as many as the machine has.
    pub threads: usize,
    /// Instruction set of what runs on the processor.
    pub isa: Isa,
    /// Name or number of the adapter that the backend runs on; `None`: its first.
    pub adapter: Option<String>,
    /// Cell width of each level, finest first [m].
    pub cell_widths: Vec<f64>,
    /// Least cell of the world on level 0, per axis; meaningful where there is a wall or periodicity.
    pub cell_min: [i32; 3],
    /// One past the greatest cell of the world on level 0.
    pub cell_max: [i32; 3],
    /// Cells of ground, of each level's own width, under the surface that the level sees at the start; `None` where it sees
    /// none, or if there is one level only.
    pub ground_cells: Vec<Option<f64>>,
    /// Where the levels are at the start.
    pub regions: Regions,
    /// The ground as a function of position, if only what is within reach of agents is live.
    pub terrain: Option<Arc<Terrain>>,
    /// What the levels follow.
    pub agents: Vec<Agent>,
    /// Steps of the finest level in one step of the simulation.
    pub substeps: u32,
    /// Gravity [m/s²].
    pub gravity: Vec3,
    /// Speed along an axis up to which ground is at rest and may sleep [m/s]; 0: none does.
    pub slow: f64,
    /// Materials in the scene's order.
    pub materials: Vec<PlannedMaterial>,
    /// Couplings called for, by registered kind.
    pub couplings: Vec<String>,
    /// Effects and reasons.
    pub effects: Vec<Effect>,
    /// The stages of a step, in order.
    pub schedule: Schedule,
    /// Number of particles at the start.
    pub particle_count: usize,
    /// Estimated resident bytes: particles, grid.
    pub memory: (u64, u64),
    /// Greatest stable step at the start [s], and what sets it.
    pub bound: Bound,
    /// Step that the run starts with [s].
    pub dt: f64,
    /// What the user should know.
    pub warnings: Vec<String>,
}

impl PlannedMaterial {
    /// How errors name it: with its law and library, if it comes from one.
    pub fn label(&self) -> String {
        match self.material.origin.as_str() {
            BUILT_IN => self.name.clone(),
            library => format!("{}: law '{}' of {library}", self.name, self.material.name),
        }
    }

    /// Resident bytes of one of its particles in a backend.
    pub fn particle_bytes(&self, precision: Precision) -> u64 {
        let planes = self.material.values();
        let (real, offset) = if precision == Precision::F32 { (4, 4) } else { (8, 8) };
        let indices = 3 * 4 + 3 * offset + 8 + 2;
        // Velocity, affine matrix, mass, rest volume, strain and history.
        (indices + real * (3 + 9 + 2 + planes)) as u64
    }

    /// Greatest stable step of an undeformed particle alone in its cells, in a grid of cell width `h` [m] ([`Moduli::need`]), and what
    /// sets it. `None` if the law gives no tangent moduli.
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] if a callback fails or gives what bounds no step.
    pub fn bound(&self, h: f64) -> Result<Option<Bound>> {
        let Some(stiffness) = Stiffness::of(self) else { return Ok(None) };
        Ok(Some(stiffness.bound(stiffness.at_rest()?.need(h, self.density), 1)))
    }

    /// Its stiffness against being pushed into, λ + 2μ of the undeformed material [Pa]; of a law without tangent moduli the greatest that the
    /// scene's step bears.
    ///
    /// # Errors
    /// [`Error::MaterialFailed`] if a callback fails or gives what bounds no step.
    pub fn contact_modulus(&self, scene: &Scene) -> Result<f64> {
        if let Some(stiffness) = Stiffness::of(self) {
            return Ok(stiffness.at_rest()?.p_wave);
        }
        let step = scene.time.step.expect("a law without moduli is refused where the scene gives no step");
        Ok(self.density * (scene.world.cell / step).powi(2))
    }

    /// Poisson's ratio of the undeformed material, if it bears shear and gives its moduli.
    fn poisson_ratio(&self) -> Result<Option<f64>> {
        if self.material.has(abi::BARCHAN_CAP_FLUID) {
            return Ok(None);
        }
        let Some(stiffness) = Stiffness::of(self) else { return Ok(None) };
        let Moduli { p_wave, triple_bulk, .. } = stiffness.at_rest()?;
        let (lambda, mu) = (0.5 * (triple_bulk - p_wave), 0.25 * (3.0 * p_wave - triple_bulk));
        Ok(Some(0.5 * lambda / (lambda + mu)))
    }

    /// Value of a parameter by name.
    fn parameter(&self, name: &str) -> Option<f64> {
        self.material.parameters.iter().position(|p| p.name == name).map(|i| self.parameters[i])
    }
}

/// The materials among some that come from libraries, for errors that cannot tell which one it was.
pub fn loaded(materials: &[PlannedMaterial]) -> String {
    let loaded = materials.iter().filter(|planned| planned.material.origin != BUILT_IN);
    loaded.map(PlannedMaterial::label).collect::<Vec<_>>().join(", ")
}

/// A count that has been estimated from some of the points is this part of itself at least.
const ABOUT: f64 = 0.8;

/// Everything that a simulation is made from.
pub type Assembly = (Plan, ParticleState, Vec<Box<dyn Coupling>>);

impl Plan {
    /// Works out what a scene calls for, seeds its particles and makes its couplings.
    ///
    /// 1. The scene is checked; materials that bodies use are looked up and their parameters resolved.
    /// 2. Couplings are made, then particles are seeded around them.
    /// 3. The step's bound is worked out from materials and tools, and held against the scene's step.
    /// 4. Effects are listed with their reasons, and the stages that they need.
    ///
    /// # Errors
    /// Unknown names, bad parameters, missing callbacks, a step above the bound, too little memory: each by name.
    pub fn assemble(registry: &Registry, scene: &Scene, options: &Options) -> Result<Assembly> {
        Self::assemble_with(registry, scene, options, None)
    }

    /// As [`assemble`](Self::assemble), with the particles of a snapshot instead of seeded ones.
    pub(crate) fn assemble_with(
        registry: &Registry,
        scene: &Scene,
        options: &Options,
        particles: Option<ParticleState>,
    ) -> Result<Assembly> {
        options.check()?;
        let isa = Isa::current().map_err(Error::Isa)?;
        let mut scene = scene.clone();
        scene.check()?;
        let materials = plan_materials(registry, &scene, options.precision)?;
        check_couplings(registry, &scene)?;
        let kinds = coupling_kinds(&scene);
        // One coupling a kind: it finds its own entries in the scene.
        let couplings = kinds
            .iter()
            .map(|(kind, path)| registry.coupling(kind).map_err(|e| e.at(&scene.place(path)))?.make(&scene))
            .collect::<Result<Vec<_>>>()?;
        let h = scene.world.cell;
        let whole = |side: &Vec3, round: fn(f64) -> f64| {
            side.map(|x| {
                let cells = x / h;
                let near = (cells - cells.round()).abs() <= crate::scene::WHOLE_CELL;
                if near { cells.round() as i32 } else { round(cells) as i32 }
            })
        };
        let (cell_min, cell_max) = (whole(&scene.world.min, f64::floor), whole(&scene.world.max, f64::ceil));
        let mut regions = Regions::new(&scene, CellBox { min: cell_min, max: cell_max });
        let agents = if regions.levels() > 1 { agents(&scene) } else { Vec::new() };
        let resumed = particles.is_some();
        // A resumed run needs the shapes only where ground is still to come.
        let terrain = (!resumed || regions.unbounded())
            .then(|| Terrain::new(&scene, registry, &materials, options.precision).map(Arc::new))
            .transpose()?;
        let particles = match (particles, &terrain) {
            (Some(particles), _) => {
                if let Some(phase) = &particles.levels {
                    regions.restore(phase.boxes.clone());
                }
                particles
            }
            (None, None) => unreachable!("there is terrain unless a run is resumed"),
            (None, Some(terrain)) => {
                let soft = |body: u16| scene.body[usize::from(body)].shape.bounds();
                regions.follow(&agent_bounds(&agents, &couplings, soft));
                check_room(registry, options, terrain, &materials)?;
                let cap = options.max_bytes.unwrap_or_else(available_bytes);
                terrain.seed(&couplings, &regions, cap)?
            }
        };
        let cell_widths: Vec<f64> = (0..scene.levels.count).map(|level| h * f64::from(1 << level)).collect();
        let ground = ground_bound(&scene, &materials)?;
        let bound = tighten(ground.clone(), &couplings, 0.0, h, 1);
        let dt = first_step(&scene, &ground, &bound, resumed)?;
        let files = scene.files().into_iter().map(|file| Stamp::of(&scene.folder, file)).collect::<Result<_>>()?;
        let mut plan = Self {
            files,
            precision: options.precision,
            threads: options.threads,
            isa,
            adapter: options.adapter.clone(),
            cell_widths,
            ground_cells: Vec::new(),
            cell_min,
            cell_max,
            terrain: terrain.filter(|_| regions.unbounded()),
            regions,
            agents,
            substeps: scene.levels.substeps(),
            gravity: scene.gravity,
            slow: slow(&scene, &materials),
            couplings: kinds.into_iter().map(|(kind, _)| kind).collect(),
            effects: Vec::new(),
            schedule: Schedule::new(Needs::default()),
            particle_count: particles.lists.iter().map(ParticleList::len).sum(),
            memory: (0, 0),
            bound,
            dt,
            warnings: scene.warnings(),
            materials,
            scene,
        };
        plan.check_particles(&particles)?;
        plan.ground_cells = match plan.cell_widths.as_slice() {
            [_] => vec![None],
            widths => {
                let depths = surface_depths(&particles, widths.len()).into_iter().zip(widths);
                depths.map(|(depth, width)| depth.map(|depth| depth / width)).collect()
            }
        };
        plan.memory = plan.estimate_memory(&particles);
        plan.schedule = Schedule::new(plan.needs());
        let by_level =
            particles.lists.chunks(plan.materials.len().max(1)).map(|level| level.iter().map(ParticleList::len).sum());
        let live = particles.levels.as_ref().map_or(0, |phase| phase.live.len());
        plan.effects = plan.list_effects(&by_level.collect::<Vec<usize>>(), live);
        plan.warn(registry, &couplings)?;
        // An unknown backend is found out when it is to compile the plan.
        if let Ok(backend) = registry.backend(&options.backend) {
            plan.check_forms(backend.as_ref())?;
        }
        Ok((plan, particles, couplings))
    }

    /// Is the stage part of the plan?
    pub fn has(&self, stage: Stage) -> bool {
        self.schedule.has(stage)
    }

    /// Holds the stages to the forms that a backend has.
    ///
    /// # Errors
    /// [`Error::Missing`], which names the first stage that it cannot carry out.
    pub fn check_forms(&self, backend: &dyn Backend) -> Result<()> {
        let form = Form::Forward;
        let lacks = |stage: &Stage| !backend.has_form(*stage, form);
        self.schedule.stages().into_iter().find(lacks).map_or(Ok(()), |stage| {
            Err(Error::Missing {
                kind: "backend",
                name: backend.name().to_owned(),
                origin: "registered".to_owned(),
                what: format!("{form} of the stage '{stage}'"),
                why: format!("a step of this scene goes {}", self.schedule.to_string().replace('\n', "; ")),
                mend: "choose another backend".to_owned(),
            })
        })
    }

    /// Does a tool move freely, so that forces act both ways?
    pub fn two_way(&self) -> bool {
        self.scene.tool.iter().any(|tool| matches!(tool.motion, Motion::Free { .. }))
    }

    /// Holds particles that come from outside to the shape that every backend relies on: one list a material, planes of
    /// equal length and of the material's number, cells within reach, offsets inside the cell. Numbers may be anything else;
    /// a step finds those that are not finite.
    pub(crate) fn check_particles(&self, particles: &ParticleState) -> Result<()> {
        let refuse = |what: String| {
            Err(Error::Body {
                path: PARTICLES.to_owned(),
                what,
                mend: "use particles of a simulation of the same scene".to_owned(),
            })
        };
        let (levels, materials) = (self.cell_widths.len(), self.materials.len());
        if particles.lists.len() != levels * materials {
            return refuse(format!(
                "{} lists where the plan has {materials} materials on {levels} levels",
                particles.lists.len()
            ));
        }
        if let Some(phase) = &particles.levels {
            self.regions.check(phase).or_else(refuse)?;
        }
        if let Some(tile) = particles.archive.keys().find(|tile| !self.regions.is_tile_of_world(**tile)) {
            return refuse(format!("tile {tile:?} of the archive lies outside the world"));
        }
        if let Some(sort) = particles.sort.as_ref().filter(|sort| sort.rest.len() != sort.blocks.len()) {
            return refuse(format!("{} blocks of which {} say whether they sleep", sort.blocks.len(), sort.rest.len()));
        }
        if let Some(sort) =
            particles.sort.as_ref().filter(|sort| [sort.drift.len(), sort.kept_for.len()] != [levels; 2])
        {
            return refuse(format!("a sort of {} levels where the plan has {levels}", sort.drift.len()));
        }
        for (i, list) in particles.lists.iter().enumerate() {
            let (level, material) = (i / materials, i % materials);
            if (list.level as usize, list.material as usize) != (level, material) {
                return refuse(format!("list {i} is of level {} and material {}", list.level, list.material));
            }
            self.check_list(&format!("list {i}"), list).or_else(refuse)?;
        }
        if self.terrain.is_some() && particles.levels.as_ref().is_none_or(|phase| phase.live.is_empty()) {
            return refuse("nothing says which tiles are live".to_owned());
        }
        for (tile, archived) in &particles.archive {
            for list in archived.unpack() {
                self.check_list(&format!("a list of tile {tile:?}"), &list).or_else(refuse)?;
            }
        }
        Ok(())
    }

    /// What is wrong with the shape of a list.
    fn check_list(&self, name: &str, list: &ParticleList) -> Result<(), String> {
        let width = self.cell_widths.get(list.level as usize);
        let (Some(planned), 0, true) =
            (self.materials.get(list.material as usize), list.world, width == Some(&list.cell_width))
        else {
            return Err(format!(
                "{name} is of world {}, level {} with cells of {} m and material {}",
                list.world, list.level, list.cell_width, list.material
            ));
        };
        let (law, n) = (&planned.material, list.len());
        if list.strain.len() != law.strain_planes() || list.state.len() != law.states.len() {
            return Err(format!(
                "{name} has {} strain and {} history planes where its material has {} and {}",
                list.strain.len(),
                list.state.len(),
                law.strain_planes(),
                law.states.len()
            ));
        }
        let planes = list.strain.iter().chain(&list.state).chain([&list.mass, &list.volume0]).map(Vec::len);
        let rows = [list.body.len(), list.cell.len(), list.offset.len(), list.velocity.len(), list.affine.len()];
        if let Some(length) = planes.chain(rows).find(|length| *length != n) {
            return Err(format!("{name} has {n} ids and a plane of {length} entries"));
        }
        let lost = list.cell.iter().flatten().position(|c| c.unsigned_abs() > FARTHEST_CELL);
        let outside = list.offset.iter().flatten().position(|x| !(0.0..1.0).contains(x));
        if let Some(at) = lost.or(outside) {
            let (cell, offset) = (list.cell[at / 3], list.offset[at / 3]);
            return Err(format!("particle {} is in cell {cell:?} at offset {offset:?}", list.id[at / 3]));
        }
        Ok(())
    }

    fn estimate_memory(&self, particles: &ParticleState) -> (u64, u64) {
        let mut bytes = 0;
        let mut blocks = HashSet::new();
        for list in &particles.lists {
            bytes += list.len() as u64 * self.materials[list.material as usize].particle_bytes(self.precision);
            let mut last = None;
            for cell in &list.cell {
                let block = Some((list.level, cell.map(|c| c >> 2)));
                if block != last {
                    blocks.insert(block);
                    last = block;
                }
            }
        }
        let width = if self.precision == Precision::F32 { 1 } else { 2 };
        (bytes, blocks.len() as u64 * BLOCK_BYTES * width)
    }

    fn needs(&self) -> Needs {
        Needs {
            // Without a body there is no list that particles could come into.
            ground: !self.materials.is_empty(),
            levels: self.cell_widths.len(),
            subcycled: self.substeps > 1,
            sleeps: self.slow > 0.0,
            unbounded: self.terrain.is_some(),
            bodies: !self.couplings.is_empty(),
        }
    }

    fn list_effects(&self, particles_by_level: &[usize], live: usize) -> Vec<Effect> {
        let scene = &self.scene;
        let mut effects = Vec::new();
        let mut add = |name: String, because: String, adds: String| {
            effects.push(Effect { name: plain(&name), because: plain(&because), adds: plain(&adds) });
        };
        if self.particle_count > 0 {
            add(
                format!("soft ground, {}", self.precision),
                listed(scene.body.iter().enumerate().map(|(i, b)| match b.name.as_str() {
                    "" => format!("body[{i}]"),
                    name => format!("body '{name}'"),
                })),
                "sort, P2G, grid update, G2P".to_owned(),
            );
        }
        if self.particle_count > 0 && self.slow > 0.0 {
            let because = match scene.sleep.on {
                Some(_) => "sleep.on = true",
                None if scene.sleep.speed.is_some() => "sleep.speed",
                None => {
                    "gravity, and no law that flows with time: sleep.on = false keeps all awake (so does wgpu, unless asked)"
                }
            };
            let rest = format!("blocks that stay below {:.1e} m/s are left out of every pass", self.slow);
            add("ground at rest sleeps".to_owned(), because.to_owned(), rest);
        }
        if self.particle_count > 0 && self.cell_widths.len() > 1 {
            let followed = self.agents.iter().map(|agent| match agent {
                Agent::Rigid(name) => name.clone(),
                Agent::Soft(body) => scene.body[usize::from(*body)].name.clone(),
            });
            let counts = particles_by_level.iter().map(usize::to_string).collect::<Vec<_>>();
            add(
                format!("{} levels", self.cell_widths.len()),
                format!("levels.count = {} around {}", scene.levels.count, listed(followed)),
                format!(
                    "adapt, restrict, prolong; {} particles, finest first; boxes of {}³ cells",
                    counts.join(" + "),
                    2 * scene.levels.half
                ),
            );
        }
        if self.terrain.is_some() {
            let tile = f64::from(TILE) * self.cell_widths[self.cell_widths.len() - 1];
            let tiles: i64 = self.regions.tiles_of_world().iter().map(|[a, b]| i64::from(b - a + 1)).product();
            add(
                "unbounded ground".to_owned(),
                format!("levels.reach = {}", scene.levels.reach),
                format!(
                    "archive; {live} of {tiles} tiles of {tile} m live, the others are what the bodies' shapes say or what agents have left"
                ),
            );
        }
        if self.substeps > 1 {
            add(
                "subcycling".to_owned(),
                "levels.subcycle = true".to_owned(),
                format!("{} steps of the finest level in one of the coarsest", self.substeps),
            );
        }
        for planned in &self.materials {
            let users = scene.body.iter().enumerate().filter(|(_, b)| b.material == planned.name);
            let law = &planned.material;
            let planes = |n: usize, what: &str| format!("{n} {what} plane{}", if n == 1 { "" } else { "s" });
            add(
                format!("material {}", planned.name),
                listed(users.map(|(i, _)| format!("body[{i}].material = \"{}\"", planned.name))),
                format!(
                    "law {} ({}): update_{}, {}, {}{}",
                    law.name,
                    law.origin,
                    self.precision,
                    planes(law.strain_planes(), "strain"),
                    planes(law.states.len(), "state"),
                    if law.has(abi::BARCHAN_CAP_HARDENS) { ", moduli at every step" } else { "" },
                ),
            );
            if planned.damping.is_some()
                && let Some(spec) = scene.material.iter().find(|spec| spec.name == planned.name)
            {
                add(
                    format!("damping of material {}", planned.name),
                    format!("damping = {} s", spec.damping),
                    "a stress that follows the elastic rate of strain, and what it dissipates".to_owned(),
                );
            }
        }
        if self.particle_count > 0 && scene.gravity != [0.0; 3] {
            add("gravity".to_owned(), format!("gravity = {:?}", scene.gravity), "one addition a node".to_owned());
        }
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            for (side, wall) in ["min", "max"].into_iter().zip(scene.world.walls.pair(axis)) {
                let key = format!("world.walls.{name}_{side}");
                match wall {
                    Wall::Open => {}
                    Wall::Periodic if side == "max" => {}
                    Wall::Periodic => add(
                        format!("periodic {name}"),
                        format!("{key} = \"periodic\""),
                        "blocks wrap around".to_owned(),
                    ),
                    wall => add(
                        format!("wall {name}_{side}"),
                        format!("{key} = {}", wall_text(wall)),
                        "ghost nodes folded back in blocks at the wall".to_owned(),
                    ),
                }
            }
        }
        for tool in &scene.tool {
            let (motion, adds) = match &tool.motion {
                Motion::Fixed => ("fixed", "contact on nodes near it"),
                Motion::Keyframes { .. } => ("keyframes", "contact on nodes near it; path at every step"),
                Motion::Velocity { .. } => ("velocity", "contact on nodes near it; moved at every step"),
                Motion::Free { .. } => ("free", "contact on nodes near it; rigid-body step"),
            };
            add(format!("contact with tool {}", tool.name), format!("its motion is {motion}"), adds.to_owned());
        }
        if self.two_way() {
            let free = scene.tool.iter().filter(|t| matches!(t.motion, Motion::Free { .. }));
            add(
                "two-way coupling".to_owned(),
                listed(free.map(|t| format!("tool '{}' moves freely", t.name))),
                "impulses of nodes summed on bodies".to_owned(),
            );
        }
        for kind in self.couplings.iter().filter(|kind| *kind != TOOL_COUPLING) {
            add(
                format!("coupling {kind}"),
                format!("coupling.kind = \"{kind}\""),
                "contact on nodes near it".to_owned(),
            );
        }
        match scene.world.leaving {
            Leaving::Error => {}
            Leaving::Clamp => {
                add("clamping".to_owned(), "world.leaving = \"clamp\"".to_owned(), "impulse booked".to_owned())
            }
            Leaving::Delete => {
                add("deletion".to_owned(), "world.leaving = \"delete\"".to_owned(), "mass booked".to_owned())
            }
        }
        let output = &scene.output;
        let every = format!("output.interval = {}", output.interval);
        if output.picture.on {
            let cut = format!("{:?}", output.picture.cut).to_lowercase();
            add(format!("{cut} pictures"), every.clone(), "a top view and a vertical cut, outside the step".to_owned());
        }
        if let Some(format) = output.export {
            add(format!("{} export", format.extension()), every, "a particle file, outside the step".to_owned());
        }
        if let Some(interval) = output.snapshot_interval {
            add(
                "snapshots".to_owned(),
                format!("output.snapshot_interval = {interval}"),
                "a copy of all particles, outside the step".to_owned(),
            );
        }
        for material in scene.material.iter().filter(|m| self.materials.iter().all(|p| p.name != m.name)) {
            add(
                format!("declared but unused: material {}", material.name),
                "no body names it".to_owned(),
                "costs nothing".to_owned(),
            );
        }
        if scene.tool.is_empty() && scene.coupling.iter().any(|c| c.kind == TOOL_COUPLING) {
            add(
                format!("declared but unused: coupling {TOOL_COUPLING}"),
                "the scene has no tool".to_owned(),
                "costs nothing".to_owned(),
            );
        }
        effects
    }

    fn warn(&mut self, registry: &Registry, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        let mut warnings = registry.warnings().to_vec();
        for planned in &self.materials {
            let name = &planned.name;
            match planned.poisson_ratio()? {
                Some(nu) if nu > NEARLY_INCOMPRESSIBLE => warnings.push(format!(
                    "material '{name}': Poisson's ratio {nu:.4} is above {NEARLY_INCOMPRESSIBLE}: pressure checkers from cell to cell and the time step collapses; lower it"
                )),
                _ => {}
            }
            if planned.material.table.tangent_moduli_f32.is_none() {
                warnings.push(format!(
                    "material '{name}': its law gives no tangent moduli, so nothing checks that time.step is stable"
                ));
            }
            let matched_in_triaxial_compression = planned.parameter("cone").unwrap_or(0.0) == 0.0;
            match planned.parameter("friction_angle") {
                Some(phi) if phi > NO_PLANE_STRAIN_FAILURE && matched_in_triaxial_compression => warnings.push(format!(
                    "material '{name}': a friction angle of {:.2} deg is above 42.22 deg, where a cone matched in triaxial compression has no shear failure in plane strain: sin(phi_ps) = 2 sqrt(3) sin(phi) / (3 - sin(phi)) would be above 1, and a vertical face stands; lower it, or set cone = 1",
                    phi.to_degrees()
                )),
                _ => {}
            }
        }
        for (level, (cells, width)) in self.ground_cells.iter().zip(&self.cell_widths).enumerate() {
            // Volumes add up to whole cells but for rounding.
            let Some(cells) = cells.filter(|cells| *cells < LEAST_DEPTH - 1e-4) else { continue };
            let finer = (1e5 * self.cell_widths[0] * cells / LEAST_DEPTH + 1e-3).floor() / 1e5;
            let fewer = if level > 0 { format!("set levels.count = {level}, or ") } else { String::new() };
            warnings.push(format!(
                "level {level}: where it has the surface, the ground is {cells:.2} cells of {width} m deep, and fewer than {LEAST_DEPTH} neither bear nor flow as deep ground does; {fewer}set world.cell to {finer} or less"
            ));
        }
        warnings.extend(self.near_rims(couplings));
        let time = &self.scene.time;
        let step = time.step.unwrap_or(0.0);
        if step > self.bound.dt && time.over_bound != OverBound::Refuse {
            warnings.push(format!(
                "time.step = {step} is above the bound {:.3e} s set by {}; {}",
                self.bound.dt,
                self.bound.by,
                if time.over_bound == OverBound::Substep {
                    "each step is cut"
                } else {
                    "it is taken all the same, and energy is watched"
                }
            ));
        }
        warnings.extend(couplings.iter().flat_map(|c| c.warnings(self.scene.world.cell)));
        self.warnings.extend(warnings);
        self.warnings.iter_mut().for_each(|warning| *warning = plain(warning));
        Ok(())
    }

    /// Says which tools have too little fine ground below them when they press it, wherever in its box the tool is: a box follows only once its agent is out of
    /// the dead zone.
    fn near_rims(&self, couplings: &[Box<dyn Coupling>]) -> Vec<String> {
        let Some(boxes) = self.regions.boxes().first() else { return Vec::new() };
        let (h, world) = (self.scene.world.cell, &self.scene.world);
        let ends = |body: &Body| body.shape.bounds().map_or([world.min[2], world.max[2]], |b| [b.min[2], b.max[2]]);
        let ground = self.scene.body.iter().map(ends).reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
        let Some([bottom, top]) = ground else { return Vec::new() };
        let warning = |(agent, around): (&Agent, &CellBox)| {
            let Agent::Rigid(name) = agent else { return None };
            let bounds = *agent_bounds(std::slice::from_ref(agent), couplings, |_| None).first()?;
            let tall = 0.5 * (bounds.max[2] - bounds.min[2]) / h;
            let moves = !self.scene.tool.iter().any(|tool| tool.name == *name && matches!(tool.motion, Motion::Fixed));
            let below = if moves {
                (0.5 * f64::from(around.max[2] - around.min[2]) - tall - 2.0 * DEAD_ZONE).max(AROUND_AGENT)
            } else {
                bounds.min[2] / h - f64::from(around.min[2])
            };
            // Where it touches the ground, the rim may lie below all of it.
            if below >= LEAST_BELOW - 1e-6 || bounds.min[2].min(top) - below * h < bottom + 0.5 * h {
                return None;
            }
            let half = 2.0 * (0.5 * (tall + LEAST_BELOW + 2.0 * DEAD_ZONE) - 1e-6).ceil();
            Some(format!(
                "levels: there may be as few as {below:.1} fine cells between the lowest point of tool '{name}' and the rim below it; with fewer than {LEAST_BELOW} the coarse ground beyond stiffens what the tool feels; set levels.half = {half} or more"
            ))
        };
        self.agents.iter().zip(boxes).filter_map(warning).collect()
    }
}

/// The materials that bodies use, in the scene's order.
fn plan_materials(registry: &Registry, scene: &Scene, precision: Precision) -> Result<Vec<PlannedMaterial>> {
    let used = |spec: &MaterialSpec| scene.body.iter().any(|body| body.material == spec.name);
    let mut planned = Vec::new();
    for (i, spec) in scene.material.iter().enumerate() {
        let path = format!("material[{i}]");
        let law = registry.material(&spec.law).map_err(|e| e.at(&scene.place(&format!("{path}.law"))))?;
        let parameters = resolve(scene, &path, spec, law)?;
        if !used(spec) {
            continue;
        }
        let missing = |what: &str, why: String, mend: &str| Error::Missing {
            kind: "material",
            name: law.name.clone(),
            origin: law.origin.clone(),
            what: what.to_owned(),
            why,
            mend: mend.to_owned(),
        };
        if precision == Precision::F64 && law.table.update_f64.is_none() {
            return Err(missing(
                "update_f64",
                "the run is in f64".to_owned(),
                "run in f32, or add the callback to the plugin",
            ));
        }
        if law.table.tangent_moduli_f32.is_none() && scene.time.step.is_none() {
            return Err(missing(
                "tangent_moduli_f32",
                "time.step is absent, so the step must follow the material's stiffness".to_owned(),
                "set time.step, or add the callback to the plugin",
            ));
        }
        if law.table.tangent_moduli_f32.is_none() && spec.damping > 0.0 {
            return Err(missing(
                "tangent_moduli_f32",
                format!("{path}.damping = {} is a part of the material's stiffness", spec.damping),
                "set the damping to 0, or add the callback to the plugin",
            ));
        }
        let undamped = PlannedMaterial {
            name: spec.name.clone(),
            material: law.clone(),
            parameters,
            density: spec.density,
            damping: None,
        };
        let at_rest = Stiffness::of(&undamped).filter(|_| spec.damping > 0.0).map(|law| law.at_rest()).transpose()?;
        let damping = at_rest.map(|moduli| Damping::new(spec.damping, &moduli));
        planned.push(PlannedMaterial { damping, ..undamped });
    }
    Ok(planned)
}

/// Parameters in the law's order, SI, with defaults where the scene is silent.
fn resolve(scene: &Scene, path: &str, spec: &MaterialSpec, law: &Material) -> Result<Vec<f64>> {
    let mut values: Vec<Option<f64>> = vec![None; law.parameters.len()];
    for (key, &value) in &spec.parameters {
        let path = format!("{path}.parameters.{key}");
        let exact = law.parameters.iter().position(|p| p.name == *key);
        let in_degrees = || {
            let name = key.strip_suffix("_deg")?;
            law.parameters.iter().position(|p| p.name == name && p.unit == "rad")
        };
        let Some((i, degrees)) = exact.map(|i| (i, false)).or_else(|| in_degrees().map(|i| (i, true))) else {
            let keys: Vec<String> = law
                .parameters
                .iter()
                .flat_map(|p| {
                    std::iter::once(p.name.clone()).chain((p.unit == "rad").then(|| format!("{}_deg", p.name)))
                })
                .collect();
            return Err(scene.fault(&path, format!("law '{}' has no parameter `{key}`", law.name), it_has(key, &keys)));
        };
        let parameter = &law.parameters[i];
        let si = if degrees { value.to_radians() } else { value };
        if values[i].is_some() {
            return Err(scene.fault(&path, format!("gives {} a second time", parameter.name), "keep one of the two"));
        }
        if !parameter.allows(si) {
            return Err(scene.fault(
                &path,
                format!("is {value}{}", if degrees { format!(" deg, that is {si} rad") } else { String::new() }),
                format!("must be in {} {}", parameter.range(), parameter.unit),
            ));
        }
        values[i] = Some(si);
    }
    let values: Vec<f64> = values.iter().zip(&law.parameters).map(|(v, p)| v.unwrap_or(p.default)).collect();
    if let Some(check) = law.table.check_params {
        let mut buffer = ErrorBuffer::default();
        // SAFETY: one value a parameter, as the ABI asks; both arguments live until the call returns.
        let status = unsafe { check(values.as_ptr(), buffer.as_raw()) };
        if status != abi::BARCHAN_OK {
            let what = format!("law '{}' refuses these parameters together: {}", law.name, buffer.message(status));
            return Err(scene.fault(&format!("{path}.parameters"), what, ""));
        }
    }
    Ok(values)
}

/// Speed up to which ground may sleep [m/s]; 0 if it may not.
///
/// Without being asked it may if nothing can happen in it unseen: under gravity, which would set loose ground in motion, of laws
/// that do not flow with time, and without walls that have to decide anew in each step.
fn slow(scene: &Scene, materials: &[PlannedMaterial]) -> f64 {
    let g = scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
    let flows = materials.iter().any(|planned| planned.material.has(abi::BARCHAN_CAP_VEL_GRAD));
    if scene.sleep.on.unwrap_or(g > 0.0 && !flows && !scene.world.walls.let_go()) {
        scene.sleep.speed.unwrap_or(SLOW * (g * scene.world.cell).sqrt())
    } else {
        0.0
    }
}

/// What the levels follow: what the scene names, or else every tool that moves.
fn agents(scene: &Scene) -> Vec<Agent> {
    let tool = |name: &String| Agent::Rigid(name.clone());
    match &scene.levels.agents {
        None => scene.tool.iter().filter(|t| !matches!(t.motion, Motion::Fixed)).map(|t| tool(&t.name)).collect(),
        Some(names) => names
            .iter()
            .map(|name| match scene.body.iter().position(|body| body.name == *name) {
                Some(body) if scene.tool.iter().all(|t| t.name != *name) => Agent::Soft(body as u16),
                _ => tool(name),
            })
            .collect(),
    }
}

/// Holds what the scene says of couplings to what their kinds have declared.
fn check_couplings(registry: &Registry, scene: &Scene) -> Result<()> {
    for (i, spec) in scene.coupling.iter().enumerate() {
        let path = format!("coupling[{i}]");
        let kind = registry.coupling(&spec.kind).map_err(|e| e.at(&scene.place(&format!("{path}.kind"))))?;
        for (key, value) in &spec.parameters {
            let path = format!("{path}.parameters.{key}");
            let Some(parameter) = kind.parameters.iter().find(|p| p.name == *key) else {
                let keys: Vec<String> = kind.parameters.iter().map(|p| p.name.clone()).collect();
                return Err(scene.fault(
                    &path,
                    format!("coupling '{}' has no parameter `{key}`", spec.kind),
                    it_has(key, &keys),
                ));
            };
            if !parameter.allows(*value) {
                let mend = format!("must be in {} {}", parameter.range(), parameter.unit);
                return Err(scene.fault(&path, format!("is {value}"), mend));
            }
        }
    }
    Ok(())
}

/// What there is in the place of a name that is not known, and which was most likely meant.
fn it_has(name: &str, known: &[String]) -> String {
    let meant = nearest(name, known).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
    format!("it has {}{meant}", if known.is_empty() { "none".to_owned() } else { known.join(", ") })
}

/// The kinds of couplings called for, each with the key path that calls for it first.
fn coupling_kinds(scene: &Scene) -> Vec<(String, String)> {
    let mut kinds: Vec<(String, String)> = Vec::new();
    if !scene.tool.is_empty() {
        kinds.push((TOOL_COUPLING.to_owned(), "tool".to_owned()));
    }
    for (i, spec) in scene.coupling.iter().enumerate() {
        if spec.kind != TOOL_COUPLING && kinds.iter().all(|(kind, _)| *kind != spec.kind) {
            kinds.push((spec.kind.clone(), format!("coupling[{i}].kind")));
        }
    }
    kinds
}

/// The bound that the undeformed ground sets.
fn ground_bound(scene: &Scene, materials: &[PlannedMaterial]) -> Result<Bound> {
    let mut bound = Bound { dt: f64::INFINITY, by: "nothing".to_owned() };
    for planned in materials {
        let whole = |own: Bound| Bound { dt: own.dt * f64::from(scene.levels.substeps()), ..own };
        if let Some(own) = planned.bound(scene.world.cell)?.map(whole).filter(|own| own.dt < bound.dt) {
            bound = own;
        }
    }
    Ok(bound)
}

/// Tightens what the ground bears so that no tool's surface moves more than [`TOOL_COURANT`] cells in any of so many steps from `time` [s].
pub(crate) fn tighten(ground: Bound, couplings: &[Box<dyn Coupling>], time: f64, h: f64, steps: u64) -> Bound {
    couplings.iter().fold(ground, |bound, coupling| {
        let longest = if bound.dt.is_finite() { bound.dt } else { UNBOUND_STEP };
        let borne = |dt: f64| TOOL_COURANT * h / coupling.max_speed(time, dt * steps as f64);
        // A shorter step sees less of what a tool is about to do, so that it bears at least what a longer one does.
        let (mut least, mut most) = (borne(longest), longest);
        if least.total_cmp(&most).is_ge() {
            return if least < bound.dt { by_tool(coupling.as_ref(), least) } else { bound };
        }
        // Of one that is as fast at once there is nothing to find.
        while least > 0.0 && least < (1.0 - TOOL_STEP_WIDTH) * most && borne(least) > least {
            let middle = (least * most).sqrt();
            let borne = borne(middle);
            if borne < middle { (least, most) = (least.max(borne), middle) } else { least = middle }
        }
        by_tool(coupling.as_ref(), least)
    })
}

fn by_tool(coupling: &dyn Coupling, dt: f64) -> Bound {
    Bound { dt, by: format!("coupling '{}': speed of a tool", coupling.name()) }
}

/// The step that a scene asks for under a bound, before [`OverBound`] is considered [s]. Where the ground sets none, there is a longest one.
pub(crate) fn wanted_step(scene: &Scene, ground: &Bound, bound: &Bound) -> f64 {
    let longest = if ground.dt.is_finite() { f64::INFINITY } else { UNBOUND_STEP };
    let given = scene.time.step.map(|step| step * f64::from(scene.levels.substeps()));
    given.unwrap_or_else(|| (scene.time.safety * bound.dt).min(longest))
}

fn first_step(scene: &Scene, ground: &Bound, bound: &Bound, resumed: bool) -> Result<f64> {
    let dt = wanted_step(scene, ground, bound);
    if dt <= bound.dt || resumed {
        return Ok(dt);
    }
    match scene.time.over_bound {
        OverBound::Refuse => Err(Error::TimeStep { step: 0, dt, bound: bound.dt, by: bound.by.clone() }),
        OverBound::Substep => Ok(cut(dt, scene.time.safety * bound.dt)),
        OverBound::Allow => Ok(dt),
    }
}

/// `dt` divided into the fewest equal parts that are at most `most`.
pub(crate) fn cut(dt: f64, most: f64) -> f64 {
    dt / (dt / most).ceil().max(1.0)
}

/// Has the backend room for what is to be seeded? Nobody waits for particles that it then refuses.
fn check_room(registry: &Registry, options: &Options, terrain: &Terrain, materials: &[PlannedMaterial]) -> Result<()> {
    let values = materials.iter().map(|m| m.material.values()).max().unwrap_or(0);
    // An unknown backend is found out when it is to compile the plan.
    let Ok(backend) = registry.backend(&options.backend) else { return Ok(()) };
    let Some(cap) = backend.most_particles(options.adapter.as_deref(), values)? else { return Ok(()) };
    // What is only nearly too much is counted when it is there.
    let asked = terrain.about_how_many();
    if ABOUT * asked <= cap as f64 {
        return Ok(());
    }
    Err(Error::Capacity {
        what: "particles on the adapter, about",
        asked: asked as u64,
        cap,
        mend: "raise world.cell or spacing, shrink the bodies, choose an adapter that binds more (--adapter), or use the backend cpu",
    })
}

/// Four fifths of the memory that the machine says is available, or of what this process' control group may take;
/// without limit where neither is known.
fn available_bytes() -> u64 {
    let read = |file: &str| std::fs::read_to_string(file).ok();
    let free = read("/proc/meminfo").and_then(|text| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
    });
    let group = read("/sys/fs/cgroup/memory.max").and_then(|text| text.trim().parse().ok());
    [free, group].into_iter().flatten().min().map_or(u64::MAX, |bytes| bytes / 5 * 4)
}

fn listed(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    match items.as_slice() {
        [first, second, third, .., _] => format!("{first}, {second}, {third}, … ({} in all)", items.len()),
        _ => items.join(", "),
    }
}

fn wall_text(wall: Wall) -> String {
    match wall {
        Wall::Separate { friction } => format!("{{ separate = {{ friction = {friction} }} }}"),
        other => format!("\"{}\"", format!("{other:?}").to_lowercase()),
    }
}

impl Export {
    /// The usual ending of such files' names.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Npz => "npz",
            Self::Vtk => "vtu",
        }
    }
}

/// The plan as a table for people.
impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "scene     {}", plain(&self.scene.name))?;
        for line in self.scene.doc.lines() {
            writeln!(f, "          {}", plain(line))?;
        }
        let cells: Vec<_> = (0..3).map(|d| (self.cell_max[d] - self.cell_min[d]).to_string()).collect();
        let widths: Vec<_> = self.cell_widths.iter().map(f64::to_string).collect();
        writeln!(f, "world     {} cells of {} m, {}", cells.join(" x "), self.cell_widths[0], self.precision)?;
        if widths.len() > 1 {
            let cells =
                self.ground_cells.iter().map(|cells| cells.map_or("none".to_owned(), |cells| format!("{cells:.1}")));
            let cells = cells.collect::<Vec<_>>().join(", ");
            writeln!(
                f,
                "levels    cells of {} m; cells of ground under each level's surface: {cells}",
                widths.join(", ")
            )?;
        }
        writeln!(f, "particles {}", self.particle_count)?;
        let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
        writeln!(
            f,
            "memory    about {:.1} MiB of particles, {:.1} MiB of grid",
            mib(self.memory.0),
            mib(self.memory.1)
        )?;
        writeln!(f, "step      {:.3e} s; bound {:.3e} s by {}", self.dt, self.bound.dt, self.bound.by)?;
        let isas: Vec<_> = Isa::available().map(Isa::name).collect();
        writeln!(f, "isa       {}, by BARCHAN_ISA one of {}", self.isa.name(), isas.join(", "))?;
        for (i, line) in self.schedule.to_string().lines().enumerate() {
            writeln!(f, "{:10}{line}", if i == 0 { "stages" } else { "" })?;
        }
        let width = |pick: fn(&Effect) -> &str, head: &str| {
            self.effects.iter().map(|e| pick(e).chars().count()).chain([head.len()]).max().unwrap_or(0)
        };
        let (name, because) = (width(|e| &e.name, "effect"), width(|e| &e.because, "because"));
        writeln!(f, "\n{:name$}  {:because$}  adds", "effect", "because")?;
        for effect in &self.effects {
            writeln!(f, "{:name$}  {:because$}  {}", effect.name, effect.because, effect.adds)?;
        }
        for warning in &self.warnings {
            writeln!(f, "\nwarning: {warning}")?;
        }
        Ok(())
    }
}
