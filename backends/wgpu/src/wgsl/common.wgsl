// What all passes share. Constants of the scene (LOW, LEVELS, ...) stand before this text.
//
// Blocks are 4x4x4 cells; a block's tile is the 8x8x8 nodes from two before its first cell on. Particles are sorted by cell, block
// by block; a particle's place is its offset in its cell, in 2^-32 cells, and a tag: the cell counted from two before the block's
// first one, three bits an axis; from bit 9 on the law, from bit 16 on the cell that it had at the sort, its home, and whether it has left
// that. So a block's particles may drift by a cell and more.
//
// What both transfers need of a particle are six vectors: place; V0 tau_xz, V0 tau_yz, V0 tau_zz [J] and mass; the rows (v_i, C_ij)
// for i = x, y, z; V0 times tau_xx, tau_yy, tau_xy. Each is a plane of its own, so that neighbours which each write a particle write what
// lies together.

// Where the world ends: what differs between scenes and changes no text of a pass, so that a driver need not compile that anew for every size.
struct World {
    // The world in finest cells: the first one, and one past the last; how wide they are [m].
    min: vec3<i32>,
    cell: f32,
    max: vec3<i32>,
    // Four over that width [1/m].
    per_cell: f32,
    // Where its sides are: cells, and parts of them in 2^-32. Open sides may cut cells.
    side_low: vec3<i32>,
    side_high: vec3<i32>,
    side_low_part: vec3<u32>,
    side_high_part: vec3<u32>,
    // Along periodic axes the first block, and how many there are; 0 along others.
    period_min: vec3<i32>,
    period: vec3<i32>,
}

struct Extent {
    // Room for particles in each plane, and particles.
    slots: u32,
    particles: u32,
    // Room for blocks with particles, and for blocks of nodes.
    block_room: u32,
    node_room: u32,
    // Workgroups in a row of a dispatch.
    row: u32,
    // Places of the directory.
    places: u32,
    // Room for tiles without forces.
    giver_room: u32,
    // Blocks in boxes around all bodies of a world that answer the ground.
    rooms: u32,
    world: World,
}

// A layer is one grid: that of one level of one world; a world's layers stand together, finest first, and each has cells twice as wide
// as the one before. Each entry of the lists has its layer's number in the fourth component of its first vector;
// blocks are in the order of layers and, within one, of their coordinates, so that each layer's blocks, particles and places of the
// directory stand together.
struct Layer {
    // The box that its part of the directory covers: first block, blocks along each axis; its first place, a multiple of 1024, and
    // places.
    box_min: vec3<i32>,
    first_place: u32,
    box_size: vec3<i32>,
    places: u32,
    // Does it take part in this submission?
    on: u32,
    // When the submission began: steps since its last sort, and an upper bound of the drift since then [cells].
    age: u32,
    drift: f32,
    // Nodes lighter than this carry nothing [kg], and what makes of a mass the share of a speed that counts [1/kg].
    least: f32,
    felt: f32,
    first_particle: u32,
    // Its level, 0 is finest, and two to the power of minus that.
    level: u32,
    shrink: f32,
}

struct Step {
    // Step [s], in finest cells per (m/s), and -4 dt / h of the finest level. Subcycled, of a coarser level it is twice as long each time.
    dt: f32,
    dt_per_h: f32,
    stress: f32,
    // Number of the step in the submission.
    number: u32,
    // Gravity times dt [m/s].
    gravity: vec3<f32>,
    // Number among the steps of the finest level in the submission.
    slot: u32,
    // The levels whose step it is: the first of them.
    first_level: u32,
    // In passes over some particles: the first of them, and how many.
    first: u32,
    count: u32,
    // And one past the last of those levels.
    end_level: u32,
    // May nodes behind mirrors be found with what moves at rims, since no body comes near walls?
    mirrors: u32,
    // So many steps a second of the finest level may particles need before the next step has to be shorter [1/s].
    most_need: f32,
    // Number of the submission.
    submission: u32,
}

@group(0) @binding(0) var<uniform> extent: Extent;
@group(1) @binding(0) var<uniform> step: Step;
@group(1) @binding(1) var<uniform> layers: array<Layer, LAYERS>;

const NONE: u32 = 0xffffffffu;
// Vectors of an entry in the lists: of a block, its coordinates and the 27 node blocks around it, what walls gave to it [N s], and
// what they would give in the step under way; of a node block likewise, with the blocks whose tiles reach it.
const ENTRY: u32 = 10u;
// Behind the 27, on levels: in the lowest bit whether rims need the block's parent cells; above it, counted from 1, its number among those whose
// particles give to nodes that the finer level takes part in.
const OF_RIMS: u32 = 7u;
const WALL: u32 = 8u;
const PENDING: u32 = 9u;

// What is known of a block of nodes on levels, as bits: finer ones hand something to it; it has nodes at a rim, before mirrors, that hand something on; nodes
// behind mirrors, if these are found with what moves at rims; and among these images of nodes that finer ones hand something to.
const IS_GIVEN: u32 = 1u;
const HANDS_ON: u32 = 2u;
const IS_BEHIND: u32 = 4u;
const IMAGES_GIVEN: u32 = 8u;

// Words of the status.
const BLOCKS: u32 = 0u;
const NODE_BLOCKS: u32 = 1u;
const HALTED: u32 = 2u;
const HALT_STEP: u32 = 3u;
const WHO: u32 = 4u;
// Must the host look where free bodies are before the next step?
const FOLLOWED: u32 = 5u;
const NEW_BLOCKS: u32 = 6u;
const NEW_NODE_BLOCKS: u32 = 7u;
const OLD_BLOCKS: u32 = 8u;
const SORTS: u32 = 9u;
// What blocks held in all when that was summed last.
const COUNTED: u32 = 10u;
// Blocks of nodes near bodies whose law runs on the host: gathered, and on their way back.
const NEAR: u32 = 11u;
const BACK: u32 = 12u;
// Blocks whose particles give to nodes that a finer level takes part in, as the last sort has found.
const GIVERS: u32 = 13u;
// Those of a layer that stay: its first block and node block; least and greatest block.
const OF_LAYERS: u32 = 14u;
const PER_LAYER: u32 = 8u;
const FIRST_BLOCK: u32 = 0u;
const FIRST_NODE_BLOCK: u32 = 1u;
const LEAST_BLOCK: u32 = 2u;
const GREATEST_BLOCK: u32 = 5u;

// Those of a layer in a submission, zero when it begins: 1 + the step before which it was sorted last; particles' steps with strain
// applied in parts; what walls gave [N s]; is it due in the sort under way; did a sort find particles that belong on another level; how often
// it found one outside the world; the impulse of those it put back [N s], and the mass of those it took out [kg]; mass asleep, times
// gravity's part, summed over steps [kg]; blocks that fell asleep, and what momentum [N s] and kinetic energy [J] that took; how many steps a
// second particles whose stiffness follows their state need after an even step, and after an odd one, as the bits of a float; what damping has
// dissipated, in units of 2^-80 J: four digits of 32 bits, the least first.
const OF_SUMS: u32 = OF_LAYERS + PER_LAYER * LAYERS;
const PER_SUM: u32 = 24u;
const SORTED: u32 = 0u;
const PARTED: u32 = 1u;
const WALL_IMPULSE: u32 = 2u;
const DUE: u32 = 5u;
const ASTRAY: u32 = 6u;
const LEFT: u32 = 7u;
const LEFT_IMPULSE: u32 = 8u;
const SUM_SLEPT: u32 = 12u;
const SUM_FELL: u32 = 13u;
const SUM_LOST: u32 = 14u;
const NEED: u32 = 18u;
const DAMPED: u32 = 20u;

// Those of a layer in a step: greatest node speed [m/s], greatest move of a particle, and how far particles may have drifted before it
// since the last sort [cells], as the bits of a float: for numbers that are not negative, their order is that of unsigned integers, and NaN
// is above all. Before them stands, for each step, how many nodes of all layers are too fast for it.
const OF_FAST: u32 = OF_SUMS + PER_SUM * LAYERS;
const OF_STEPS: u32 = OF_FAST + MAX_STEPS;
const PER_STEP: u32 = 4u;
const SPEED: u32 = 0u;
const MOVE: u32 = 1u;
const DRIFT: u32 = 2u;
// What part of gravity there is, if it grows.
const GROWN: u32 = 3u;

fn layer_word(layer: u32, k: u32) -> u32 {
    return OF_LAYERS + PER_LAYER * layer + k;
}

fn sum_word(layer: u32, k: u32) -> u32 {
    return OF_SUMS + PER_SUM * layer + k;
}

fn step_word(number: u32, layer: u32, k: u32) -> u32 {
    return OF_STEPS + PER_STEP * (number * LAYERS + layer) + k;
}

// Why a submission was halted.
const TOO_FAST: u32 = 1u;
const DRIFTED: u32 = 2u;
const ROOM: u32 = 3u;
const MISPLACED: u32 = 4u;
const LEFT_WORLD: u32 = 5u;
const STRAYED: u32 = 6u;
const FEWER: u32 = 7u;
const FOLLOW: u32 = 8u;
const TOO_STIFF: u32 = 9u;

const BIAS: i32 = 1 << 20;

// Number of the step among those in which bodies move.
fn slot_now() -> u32 {
    if SUBCYCLED {
        return step.slot;
    }
    return step.number;
}

// Where vector `k` of a particle stands in the record.
fn vector(q: u32, k: u32) -> u32 {
    return k * extent.slots + q;
}

fn magnitude_bits(x: f32) -> u32 {
    return bitcast<u32>(x) & 0x7fffffffu;
}

// What particles of a layer need after a step.
fn need_word(number: u32, layer: u32) -> u32 {
    return sum_word(layer, NEED + (number & 1u));
}

// Where the number of nodes stands that are too fast for a step.
fn fast_word(number: u32) -> u32 {
    return OF_FAST + number;
}

// The cell of a tag, from the block's first cell.
fn cell_of(tag: u32) -> vec3<i32> {
    return vec3<i32>(vec3<u32>(tag >> 6u, tag >> 3u, tag) & vec3<u32>(7u)) - vec3<i32>(2);
}

fn law_of(tag: u32) -> u32 {
    return (tag >> 9u) & 15u;
}

fn tag_of(cell: vec3<i32>) -> u32 {
    let c = vec3<u32>(cell + vec3<i32>(2));
    return (c.x << 6u) | (c.y << 3u) | c.z;
}

// The tag of a particle that has come to `place` in a cell.
fn tag_at(tag: u32, cell: vec3<i32>, place: vec3<u32>) -> u32 {
    let kept = tag & ~(511u | LEFT_HOME | BESIDE);
    let to = tag_of(cell);
    let home = (tag >> 16u) & 511u;
    if to == home {
        return kept | to;
    }
    // Just above a cell's lower end it is beside the cell below, and just below its upper end beside the one above.
    let is_low = place < vec3<u32>(BESIDE_BY);
    let is_high = place >= vec3<u32>(0u - BESIDE_BY);
    let near = select(select(vec3<i32>(0), vec3<i32>(-1), is_high), vec3<i32>(1), is_low);
    let shift = cell - cell_of(home);
    return kept | to | select(LEFT_HOME, BESIDE, all((shift == vec3<i32>(0)) | (shift == near)));
}

// How often a layer's cells are twice as wide as the finest.
fn level_of(layer: u32) -> u32 {
    if LEVELS == 1u {
        return 0u;
    }
    return layers[layer].level;
}

// Two to the power of minus that.
fn shrink_of(layer: u32) -> f32 {
    if LEVELS == 1u {
        return 1.0;
    }
    return layers[layer].shrink;
}

// How long the layer's step is, in steps of the finest level.
fn steps_of(layer: u32) -> f32 {
    if SUBCYCLED {
        return 1.0 / shrink_of(layer);
    }
    return 1.0;
}

// The world in a layer's cells: the first one, and one past the last.
fn world_min(layer: u32) -> vec3<i32> {
    return extent.world.min >> vec3<u32>(level_of(layer));
}

fn world_max(layer: u32) -> vec3<i32> {
    return ((extent.world.max - vec3<i32>(1)) >> vec3<u32>(level_of(layer))) + vec3<i32>(1);
}

// A layer's block brought into the world along periodic axes.
fn wrapped(layer: u32, b: vec3<i32>) -> vec3<i32> {
    var block = b;
    for (var d = 0; d < 3; d++) {
        if IS_PERIODIC[d] {
            let first = extent.world.period_min[d] >> level_of(layer);
            let period = extent.world.period[d] >> level_of(layer);
            block[d] = first + (((block[d] - first) % period) + period) % period;
        }
    }
    return block;
}

// Where a layer's block that begins with a cell has its middle nearest to another cell, among its images along periodic axes.
fn image_near(layer: u32, first: vec3<i32>, to: vec3<i32>) -> vec3<i32> {
    var image = first;
    for (var d = 0; d < 3; d++) {
        if IS_PERIODIC[d] {
            let period = 4 * (extent.world.period[d] >> level_of(layer));
            let off = 2 * (to[d] - first[d] - 2) + period;
            // Rounds down.
            let times = (off - (((off % (2 * period)) + 2 * period) % (2 * period))) / (2 * period);
            image[d] = first[d] + times * period;
        }
    }
    return image;
}

// The middle of a box of cells.
fn middle_of(least: vec3<i32>, most: vec3<i32>) -> vec3<i32> {
    return (least + most) >> vec3<u32>(1u);
}

// Where a layer's block stands in the directory, or NONE.
fn place_in_box(layer: u32, b: vec3<i32>) -> u32 {
    let size = layers[layer].box_size;
    let at = wrapped(layer, b) - layers[layer].box_min;
    if any(at < vec3<i32>(0)) || any(at >= size) {
        return NONE;
    }
    return layers[layer].first_place + u32((at.x * size.y + at.y) * size.z + at.z);
}

// The layer's block at a place of the directory.
fn block_at(layer: u32, place: u32) -> vec3<i32> {
    let p = i32(place - layers[layer].first_place);
    let size = layers[layer].box_size;
    return layers[layer].box_min + vec3<i32>(p / (size.y * size.z), (p / size.z) % size.y, p % size.z);
}

// The layer in whose part of the directory a place is.
fn layer_at(place: u32) -> u32 {
    var low = 0u;
    var high = LAYERS;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if layers[middle].first_place <= place {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

// The layer of the particle in a slot.
fn layer_of_particle(q: u32) -> u32 {
    var low = 0u;
    var high = LAYERS;
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if layers[middle].first_particle <= q {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

// Does a layer take part in this submission, and in this step? One that is alone does.
fn is_live(layer: u32) -> bool {
    if SUBCYCLED && (level_of(layer) < step.first_level || level_of(layer) >= step.end_level) {
        return false;
    }
    return LAYERS == 1u || layers[layer].on != 0u;
}

// Is the step too long for a node of a layer, as fast as a particle may feel it? Levels that take steps of their own cannot take one again: there what
// counts is how far particles move, which the fastest nodes hardly carry, and the host looks at that when the step is done.
fn is_too_fast(layer: u32, speed: f32) -> bool {
    return !SUBCYCLED && !(speed * shrink_of(layer) * step.dt_per_h <= NODE_MOVE);
}

// Place of a node in its block, by its number.
fn local_of(n: u32) -> vec3<i32> {
    return vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
}

fn offset_of(n: u32) -> vec3<i32> {
    return vec3<i32>(i32(n / 9u), i32((n / 3u) % 3u), i32(n % 3u)) - vec3<i32>(1);
}

// The layer that this invocation works on, for functions that a pass does not call itself.
var<private> layer_now: u32;

// Weights of the three nodes along an axis, from the place in the cell.
fn weights(f: f32) -> vec3<f32> {
    let left = 1.0 - f;
    let middle = 0.5 - f;
    return vec3<f32>(0.5 * left * left, fma(-middle, middle, 0.75), 0.5 * f * f);
}

// Where a particle is in its cell.
fn fraction(p: vec4<u32>) -> vec3<f32> {
    return vec3<f32>(p.xyz >> vec3<u32>(8u)) * 5.9604645e-8;
}
