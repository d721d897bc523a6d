// What all passes share. Constants of the scene (H, WORLD_MIN, LOW, ...) stand before this text.
//
// Blocks are 4x4x4 cells; a block's tile is the 8x8x8 nodes from two before its first cell on. Particles are sorted by cell, block
// by block; a particle's place is its offset in its cell, in 2^-32 cells, and a tag: the cell counted from two before the block's
// first one, three bits an axis; from bit 9 on the law, and from bit 16 on the cell that it had at the sort. So a block's particles may
// drift by a cell and more.
//
// What both transfers need of a particle are six vectors: place; V0 tau_xz, V0 tau_yz, V0 tau_zz [J] and mass; the rows (v_i, C_ij)
// for i = x, y, z; V0 times tau_xx, tau_yy, tau_xy. Each is a plane of its own, so that neighbours which each write a particle write what
// lies together.

struct Extent {
    // Room for particles in each plane, and particles.
    slots: u32,
    particles: u32,
    // Room for blocks with particles, and for blocks of nodes.
    block_room: u32,
    node_room: u32,
    // The directory's first block, and blocks along each axis.
    box_min: vec3<i32>,
    // Workgroups in a row of a dispatch.
    row: u32,
    box_size: vec3<i32>,
    box_blocks: u32,
}

struct Step {
    // Step [s], in cells per (m/s), and -4 dt / h.
    dt: f32,
    dt_per_h: f32,
    stress: f32,
    // Upper bound of the drift since the last sort when step `first` began [cells].
    drift: f32,
    // Gravity times dt [m/s].
    gravity: vec3<f32>,
    // Number of the step in the submission.
    number: u32,
    // Nodes lighter than this carry nothing [kg].
    least: f32,
    felt: f32,
    // The first step since the last sort, or of the submission.
    first: u32,
    pad: u32,
}

@group(0) @binding(0) var<uniform> extent: Extent;
@group(1) @binding(0) var<uniform> step: Step;

const NONE: u32 = 0xffffffffu;
// Vectors of an entry in the lists: of a block, its coordinates and the 27 node blocks around it, what walls gave to it [N s], and
// what they would give in the step under way; of a node block likewise, with the blocks whose tiles reach it.
const ENTRY: u32 = 10u;
const WALL: u32 = 8u;
const PENDING: u32 = 9u;

// Words of the status. Those of a step: greatest node speed [m/s], greatest move of a particle, and how far particles may have drifted
// before it since the last sort or the submission's begin [cells], as the bits of a float: for numbers that are not negative, their
// order is that of unsigned integers, and NaN is above all.
const BLOCKS: u32 = 0u;
const NODE_BLOCKS: u32 = 1u;
const LEAST_BLOCK: u32 = 2u;
const GREATEST_BLOCK: u32 = 5u;
const HALTED: u32 = 8u;
const HALT_STEP: u32 = 9u;
const WHO: u32 = 10u;
const PARTED: u32 = 11u;
const NEW_BLOCKS: u32 = 12u;
const NEW_NODE_BLOCKS: u32 = 13u;
const OLD_BLOCKS: u32 = 14u;
const SORTS: u32 = 15u;
const WALL_IMPULSE: u32 = 16u;
const STEPS: u32 = 20u;
const PER_STEP: u32 = 4u;

// Why a submission was halted.
const TOO_FAST: u32 = 1u;
const DRIFTED: u32 = 2u;
const ROOM: u32 = 3u;
const LEFT_WORLD: u32 = 4u;
const STRAYED: u32 = 5u;

const BIAS: i32 = 1 << 20;

// Where vector `k` of a particle stands in the record.
fn vector(q: u32, k: u32) -> u32 {
    return k * extent.slots + q;
}

fn magnitude_bits(x: f32) -> u32 {
    return bitcast<u32>(x) & 0x7fffffffu;
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

// A block brought into the world along periodic axes.
fn wrapped(b: vec3<i32>) -> vec3<i32> {
    var block = b;
    for (var d = 0; d < 3; d++) {
        if PERIOD[d] > 0 {
            let from_first = block[d] - PERIOD_MIN[d];
            block[d] = PERIOD_MIN[d] + ((from_first % PERIOD[d]) + PERIOD[d]) % PERIOD[d];
        }
    }
    return block;
}

// Where a block stands in the directory, or NONE.
fn place_in_box(b: vec3<i32>) -> u32 {
    let at = wrapped(b) - extent.box_min;
    if any(at < vec3<i32>(0)) || any(at >= extent.box_size) {
        return NONE;
    }
    return u32((at.x * extent.box_size.y + at.y) * extent.box_size.z + at.z);
}

// The block at a place of the directory.
fn block_at(place: u32) -> vec3<i32> {
    let p = i32(place);
    let size = extent.box_size;
    return extent.box_min + vec3<i32>(p / (size.y * size.z), (p / size.z) % size.y, p % size.z);
}

fn offset_of(n: u32) -> vec3<i32> {
    return vec3<i32>(i32(n / 9u), i32((n / 3u) % 3u), i32(n % 3u)) - vec3<i32>(1);
}
