//! The plan: the effects that a scene calls for, and why; the stages they need; what bounds the step; what memory they take.

mod agents;
mod bound;
mod couplings;
mod display;
mod effects;
mod materials;
mod particles;
mod warnings;

pub use bound::TOOL_COURANT;
pub(crate) use bound::{cut, tighten, wanted_step};
pub use couplings::PlannedCoupling;
pub use materials::{BUILT_IN, PlannedMaterial, loaded};
pub(crate) use particles::{FARTHEST_CELL, PARTICLES};

use crate::backend::Bound;
use crate::coupling::Aabb;
use crate::file::{Stamp, changed};
use crate::flow::Flows;
use crate::levels::{Agent, CellBox, Regions, surface_depths, targets};
use crate::parameter::Parameters;
use crate::scene::Tool;
use crate::schedule::{Form, Needs, Schedule, Stage};
use crate::seed::Terrain;
use crate::simulation::Options;
use crate::{Backend, Coupling, Error, ParticleList, ParticleState, Registry, Result, Scene, Vec3};
use barchan_abi as abi;
use barchan_lanes::Isa;
use bound::{first_step, ground_bound};
use couplings::{Couplings, make_couplings};
use materials::plan_materials;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// Registered name of the coupling that a scene's tools call for.
pub const TOOL_COUPLING: &str = "rigid";
/// The coupling that moves a scene's robots.
pub const ROBOT_COUPLING: &str = "robots";
/// The couplings that a scene's own entries make, without a `[[coupling]]`.
pub const SCENE_COUPLINGS: [&str; 2] = [TOOL_COUPLING, ROBOT_COUPLING];
/// Ground slower than this part of sqrt(g h) is at rest: at 1 cm, 3e-5 m/s.
const SLOW: f64 = 1e-4;

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

impl Precision {
    /// The nearest number that it has.
    pub fn round(self, x: f64) -> f64 {
        if self == Self::F32 { f64::from(x as f32) } else { x }
    }
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
    /// Bodies whose particles stand staggered, by their numbers in the scene; empty in a run that is resumed, unless ground is still to come.
    pub staggered: Vec<usize>,
    /// Boxes that bodies may come to fill which flow apart or fly, inside the world [m]; empty in a run that is resumed.
    pub reaches: Vec<Aabb>,
    /// Its sources and sinks, if it has any.
    pub flows: Option<Arc<Flows>>,
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
    /// Couplings called for, in the order in which they act.
    pub couplings: Vec<PlannedCoupling>,
    /// What the backend was asked for, and its defaults.
    pub backend_parameters: Parameters,
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

/// A count that has been estimated from some of the points is this part of itself at least.
const ABOUT: f64 = 0.8;

/// Everything that a simulation is made from.
pub type Assembly = (Plan, ParticleState, Vec<Box<dyn Coupling>>);

impl Plan {
    /// Works out what a scene calls for, seeds its particles and makes its couplings.
    ///
    /// 1. The scene is checked; materials that bodies use are looked up and their parameters resolved.
    /// 2. Couplings and the task are made with what the scene says for them, then particles are seeded around them.
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
        // An unknown backend is found out when it is to compile the plan.
        let backend = registry.backend(&options.backend).ok().map(|backend| &**backend);
        let backend_parameters = backend.map(|backend| options.parameters_of(backend)).transpose()?.unwrap_or_default();
        let Couplings { planned, made: couplings, files: coupling_files } = make_couplings(registry, &scene)?;
        backend.map_or(Ok(()), |backend| backend.check_couplings(&couplings))?;
        let task = registry.make_task(&scene)?;
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
        let agents = if regions.levels() > 1 { agents::agents(&scene, &couplings)? } else { Vec::new() };
        let resumed = particles.is_some();
        let flows = Flows::new(&scene, registry, &materials)?.map(Arc::new);
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
            (None, None) => unreachable!("there is terrain unless a run is resumed, and that brings its particles"),
            (None, Some(terrain)) => {
                let soft = |body: u16| scene.body[usize::from(body)].shape.bounds();
                regions.follow(&targets(&agents, &couplings, soft));
                let inflow = flows.as_deref().map_or_else(Vec::new, |flows| flows.most(scene.time.end).collect());
                check_room(backend, options, (terrain, &inflow), &materials)?;
                let cap = options.max_bytes.unwrap_or_else(available_bytes);
                check_memory(&inflow, &materials, options.precision, cap)?;
                terrain.seed(&couplings, &regions, cap)?
            }
        };
        let cell_widths: Vec<f64> = (0..scene.levels.count).map(|level| h * f64::from(1 << level)).collect();
        let ground = ground_bound(&scene, &materials)?;
        let bound = tighten(ground.clone(), &couplings, 0.0, h, 1);
        let dt = first_step(&scene, &ground, &bound, resumed)?;
        let mut files = scene.files();
        files.extend(coupling_files.iter().map(PathBuf::as_path));
        files.extend(task.iter().flat_map(|(_, parameters)| parameters.files()));
        let files = files.into_iter().map(|file| Stamp::of(&scene.folder, file)).collect::<Result<_>>()?;
        let mut warnings = scene.warnings();
        warnings.extend(terrain.iter().flat_map(|terrain| overlapping(&scene, terrain)));
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
            staggered: terrain.as_deref().map_or_else(Vec::new, Terrain::staggered),
            reaches: terrain.as_deref().map_or_else(Vec::new, |terrain| terrain.reaches().to_vec()),
            terrain: terrain.filter(|_| regions.unbounded()),
            flows,
            regions,
            agents,
            substeps: scene.levels.substeps(),
            gravity: scene.gravity,
            slow: slow(&scene, &materials),
            couplings: planned,
            backend_parameters,
            effects: Vec::new(),
            schedule: Schedule::new(Needs::default()),
            particle_count: particles.lists.iter().map(ParticleList::len).sum(),
            memory: (0, 0),
            bound,
            dt,
            warnings,
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
        let live = particles.levels.as_ref().map_or(0, |phase| phase.live.len());
        plan.effects = plan.list_effects(&particles, live);
        plan.warn(registry, &couplings)?;
        backend.map_or(Ok(()), |backend| plan.check_forms(backend))?;
        Ok((plan, particles, couplings))
    }

    /// Its couplings as they are at the start. They read their files anew, and these must be what they were.
    pub(crate) fn make_couplings(&self, registry: &Registry) -> Result<Vec<Box<dyn Coupling>>> {
        if let Some(file) = changed(&self.scene.folder, &self.files)? {
            return Err(Error::Body {
                path: file.display().to_string(),
                what: "this file of the scene has changed since the simulation was made".to_owned(),
                mend: "put it back as it was to copy the simulation, or make a new one".to_owned(),
            });
        }
        Ok(make_couplings(registry, &self.scene)?.made)
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

    /// Does the ground move a tool, so that forces act both ways?
    pub fn two_way(&self) -> bool {
        self.scene.tool.iter().any(Tool::answers)
    }

    fn needs(&self) -> Needs {
        Needs {
            // Without a body or a source there is no list that particles could come into.
            ground: !self.materials.is_empty(),
            levels: self.cell_widths.len(),
            subcycled: self.substeps > 1,
            sleeps: self.slow > 0.0,
            unbounded: self.terrain.is_some(),
            bodies: !self.couplings.is_empty(),
            flux: self.scene.sections().next().is_some(),
            press: self.scene.wall_parts().next().is_some(),
        }
    }
}

/// Says which bodies overlap.
fn overlapping(scene: &Scene, terrain: &Terrain) -> Vec<String> {
    let warning = |([one, other], volume): ([usize; 2], f64)| {
        format!(
            "{}: it overlaps {} in about {volume:.1e} m³, where matter is there twice; move one of them, or cut it by a difference",
            scene.name_of_body(other),
            scene.name_of_body(one)
        )
    };
    terrain.overlaps().into_iter().map(warning).collect()
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

/// Has the backend room for what is to be seeded? Nobody waits for particles that it then refuses.
fn check_room(
    backend: Option<&dyn Backend>,
    options: &Options,
    (terrain, inflow): (&Terrain, &[(usize, f64)]),
    materials: &[PlannedMaterial],
) -> Result<()> {
    let values = materials.iter().map(|m| m.material.values()).max().unwrap_or(0);
    let Some(backend) = backend else { return Ok(()) };
    let Some(cap) = backend.most_particles(options.adapter.as_deref(), values)? else { return Ok(()) };
    // What is only nearly too much is counted when it is there.
    let asked = terrain.about_how_many() + inflow.iter().map(|(_, count)| count).sum::<f64>();
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

/// Is there memory for what sources are to bring in, so many particles of each material?
fn check_memory(inflow: &[(usize, f64)], materials: &[PlannedMaterial], precision: Precision, cap: u64) -> Result<()> {
    let bytes = |&(m, count): &(usize, f64)| count * materials[m].particle_bytes(precision) as f64;
    let asked = inflow.iter().map(bytes).sum::<f64>();
    if asked <= cap as f64 {
        return Ok(());
    }
    Err(Error::Capacity {
        what: "memory for what sources bring in until time.end [bytes]",
        asked: asked as u64,
        cap,
        mend: "set source.limit or source.until, lower their rates, or raise world.cell",
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
