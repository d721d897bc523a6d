//! What a scene fixes for all passes, as WGSL.

use crate::device::layout::{BESIDE, BESIDE_BY, LEFT_HOME, ROUNDS, TOGETHER, vectors_for};
use crate::device::memory::{MAX_STEPS, is_stored};
use crate::device::uniforms::WorldCells;
use crate::passes::bodies::RIMS_BESIDE;
use crate::passes::laws::is_asked_on_device;
use crate::passes::since_sort::most_drift;
use barchan_core::levels::{Followed, SPLIT_AHEAD};
use barchan_core::plan::PlannedMaterial;
use barchan_core::scene::{Tool, Wall};
use barchan_core::{Plan, Stage};
use barchan_grid::bounds::Bounds;
use barchan_grid::due::ON_DEVICE;
use barchan_grid::limits::{MAX_DEFORMATION, MAX_PARTS, NODE_MOVE};
use barchan_grid::rest::{RESTED, falls};

/// Vectors of four that hold a particle's strain, history and, in their last place, rest volume.
pub(crate) fn rest_vectors(materials: &[PlannedMaterial]) -> usize {
    let most = materials.iter().map(|m| m.material.values()).max();
    // Without a material passes are made for a symmetric strain, and nobody runs them.
    vectors_for(most.unwrap_or(6))
}

/// Tools in each world of a scene that answer the ground.
pub(crate) fn free_bodies(plan: &Plan) -> usize {
    plan.scene.tool.iter().filter(|tool| tool.answers()).count()
}

/// Vectors of four that hold a world's material parameters.
pub(crate) fn parameter_vectors(plan: &Plan) -> usize {
    plan.materials.iter().flat_map(parameters_of).count().div_ceil(4).max(1)
}

/// What couplings' laws read: so many vectors for each world, and behind them samples, of many worlds as [`Samples`](crate::schedule::bodies::Samples) lays them out. Is it
/// stored?
pub(crate) fn coupling_table([worlds, levels]: [usize; 2], vectors: usize, samples: usize) -> (bool, String) {
    let stored = is_stored(worlds, vectors, samples);
    let space = space(stored);
    let (tables, first) = table_of_worlds([worlds, levels], vectors);
    let begin = if worlds > 1 {
        format!("{}u + bitcast<u32>(contact_table[{tables}u + layer_now / {levels}u].x)", tables + worlds)
    } else {
        format!("{tables}u")
    };
    let of_samples = format!("fn coupling_sample(i: u32) -> vec4<f32> {{ return contact_table[{begin} + i]; }}\n");
    let text = format!(
        "@group(0) @binding(1) var<{space}> contact_table: array<vec4<f32>, {}>;\n\
         fn coupling_table(i: u32) -> vec4<f32> {{ return contact_table[{first}i]; }}\n{}",
        tables + samples,
        if samples > 0 { of_samples } else { String::new() }
    );
    (stored, text)
}

/// The address space of a table.
pub(crate) fn space(stored: bool) -> &'static str {
    if stored { "storage, read" } else { "uniform" }
}

/// A table of so many vectors for each world: vectors in all, and what leads to the world's own.
pub(crate) fn table_of_worlds([worlds, levels]: [usize; 2], vectors: usize) -> (usize, String) {
    let first = if worlds > 1 { format!("layer_now / {levels}u * {vectors}u + ") } else { String::new() };
    (worlds * vectors, first)
}

/// Are there walls behind which nodes are images?
pub(crate) fn has_mirrors(plan: &Plan) -> bool {
    (0..3).flat_map(|axis| plan.scene.world.walls.pair(axis)).any(|wall| matches!(wall, Wall::Slip | Wall::Stick))
}

/// Are nodes behind mirrors found with the others? So it is where nothing but bodies that keep away from walls, as robots do not, comes between the grid and the
/// particles, and where, on levels, no step is halted any more once the grid update has come. If a body comes near walls after all, another pass does it again.
pub(crate) fn mirrors_early(plan: &Plan) -> bool {
    let fits = if plan.cell_widths.len() > 1 {
        plan.substeps > 1 && !plan.scene.has_robots() && plan.scene.tool.iter().all(Tool::answers)
    } else {
        !plan.has(Stage::CONTACT)
    };
    has_mirrors(plan) && fits && !may_sleep(plan) && plan.terrain.is_none() && separations(plan).is_empty()
}

/// Axes with a wall that lets go.
pub(crate) fn separations(plan: &Plan) -> Vec<usize> {
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
pub(crate) fn layer_constants(plan: &Plan, worlds: usize) -> String {
    let levels = plan.cell_widths.len();
    let layers = worlds * levels;
    let (subcycled, most_drift, free) = (plan.substeps > 1, most_drift(plan), worlds * free_bodies(plan));
    let mirrored = mirrors_early(plan);
    let [often, now_and_then, seldom] = ON_DEVICE.map(|pace| pace.every);
    let [far, less, least] = ON_DEVICE.map(|pace| pace.drift);
    format!(
        "const LAYERS: u32 = {layers}u;\nconst LEVELS: u32 = {levels}u;\nconst SUBCYCLED: bool = {subcycled};\nconst MIRRORED: bool = {mirrored};\nconst MAX_STEPS: u32 = {MAX_STEPS}u;\nconst FREE_ROOM: u32 = {free}u;\nconst RIMS_BESIDE: u32 = {RIMS_BESIDE}u;\n\
         const SORT_EVERY = vec3<u32>({often}u, {now_and_then}u, {seldom}u);\n\
         const TOGETHER: u32 = {TOGETHER}u;\nconst ROUNDS: u32 = {ROUNDS}u;\n\
         const LEFT_HOME: u32 = {LEFT_HOME}u;\nconst BESIDE: u32 = {BESIDE}u;\nconst BESIDE_BY: u32 = {BESIDE_BY}u;\n\
         const SORT_DRIFT = vec3<f32>({far:?}, {less:?}, {least:?});\nconst MAX_DRIFT: f32 = {most_drift:?};\n"
    )
}

/// Where the world ends.
pub(crate) fn world_cells(plan: &Plan) -> WorldCells {
    let (min, max, cell) = (plan.cell_min, plan.cell_max, plan.cell_widths[0] as f32);
    let bounds = Bounds::new(plan, 0);
    let padded = |of: &dyn Fn(usize) -> i32| [of(0), of(1), of(2), 0];
    let parts = |end: usize| {
        let part = |d: usize| (bounds.sides[d][end].1 * (1_u64 << 32) as f64) as u32;
        [part(0), part(1), part(2), 0]
    };
    WorldCells {
        min,
        cell,
        max,
        per_cell: 4.0 / cell,
        side_low: padded(&|d| bounds.sides[d][0].0),
        side_high: padded(&|d| bounds.sides[d][1].0),
        side_low_part: parts(0),
        side_high_part: parts(1),
        period_min: padded(&|d| min[d].div_euclid(4)),
        period: padded(&|d| if plan.scene.world.is_periodic(d) { (max[d] - min[d]) / 4 } else { 0 }),
    }
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
    let flags = |name: &str, v: [bool; 3]| format!("const {name} = vec3<bool>({}, {}, {});\n", v[0], v[1], v[2]);
    let kinds = |name: &str, end: usize| {
        let k = walls.map(|axis| kind(axis[end]));
        format!("const {name} = vec3<u32>({}u, {}u, {}u);\n", k[0], k[1], k[2])
    };
    let frictions = |name: &str, end: usize| {
        let f = walls.map(|axis| friction(axis[end]));
        format!("const {name} = vec3<f32>({:?}, {:?}, {:?});\n", f[0], f[1], f[2])
    };
    let coarsest = plan.cell_widths.len() - 1;
    let is_narrow = |d: usize| (plan.cell_max[d] - plan.cell_min[d]) >> coarsest < 4;
    [
        flags("IS_PERIODIC", [0, 1, 2].map(|d| plan.scene.world.is_periodic(d))),
        // Across a world narrower than a tile's own cells on the coarsest level, both walls fold onto the same nodes.
        flags("IS_NARROW", [0, 1, 2].map(is_narrow)),
        kinds("LOW", 0),
        kinds("HIGH", 1),
        flags("HAS_LOW_WALL", walls.map(|axis| axis[0].is_wall())),
        flags("HAS_HIGH_WALL", walls.map(|axis| axis[1].is_wall())),
        frictions("LOW_FRICTION", 0),
        frictions("HIGH_FRICTION", 1),
        format!("const NODE_MOVE: f32 = {NODE_MOVE:?};\nconst MAX_DEFORMATION: f32 = {MAX_DEFORMATION:?};\nconst MAX_PARTS: f32 = {MAX_PARTS:?};\n"),
        format!("const REST: u32 = {}u;\n", rest_vectors(&plan.materials)),
        format!("const GRAVITY_GROWS: bool = {};\n", plan.scene.gravity_ramp > 0.0),
        format!("// Particles that leave: {:?}\n", plan.scene.world.leaving),
        if may_sleep(plan) {
            format!(
                "const SLOW: f32 = {:?};\nconst RESTED: u32 = {RESTED}u;\nconst FALLS: f32 = {:?};\n",
                plan.slow as f32,
                falls(&plan.scene) as f32
            )
        } else {
            String::new()
        },
    ]
    .concat()
}

/// Vectors of four that hold the boxes of a world's levels, as they are now, and as split and merge see them before.
pub(crate) fn region_vectors(plan: &Plan) -> usize {
    4 * boxes(plan) * (plan.cell_widths.len() - 1)
}

/// The boxes of levels, and what lies in them.
pub(crate) fn regions(plan: &Plan, worlds: usize) -> String {
    let boxes = boxes(plan);
    let each = region_vectors(plan);
    let vectors = worlds * each;
    format!(
        "const BOXES: u32 = {boxes}u;\nconst PER_WORLD: u32 = {each}u;\nconst SPLIT_AHEAD: i32 = {SPLIT_AHEAD};\n\
         @group(0) @binding(1) var<uniform> regions: array<vec4<i32>, {vectors}>;\n{}",
        include_str!("../wgsl/regions.wgsl")
    )
}

/// Soft bodies that levels follow, each once, in the order of agents.
pub(crate) fn softs(plan: &Plan) -> Vec<u16> {
    let mut all = Vec::new();
    for agent in &plan.agents {
        if let Followed::Soft(body) = agent.followed
            && !all.contains(&body)
        {
            all.push(body);
        }
    }
    all
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
