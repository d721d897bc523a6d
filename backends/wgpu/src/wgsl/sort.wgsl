// The sort: which blocks hold particles and which nodes they reach, in the order of their coordinates; particles by block, cell, law
// and, among those, as they were. Each entry point is one pass; those over particles run block by block of the old order.

// What is marked at a place of the directory: its block holds particles; some reach its nodes.
const HOLDS: u32 = 1u;
const REACHED: u32 = 2u;

var<workgroup> partial: array<vec2<u32>, 256>;
var<workgroup> of_sixteen: array<vec2<u32>, 16>;

// Sums over the threads of a workgroup of 256: those before one, and all.
struct Sums {
    before: vec2<u32>,
    all: vec2<u32>,
}

fn sums_of(thread: u32, mine: vec2<u32>) -> Sums {
    partial[thread] = mine;
    workgroupBarrier();
    if thread < 16u {
        var sum = vec2<u32>(0u);
        for (var t = 0u; t < 16u; t++) {
            sum += partial[thread * 16u + t];
        }
        of_sixteen[thread] = sum;
    }
    workgroupBarrier();
    var result = Sums(vec2<u32>(0u), vec2<u32>(0u));
    for (var t = 0u; t < 16u; t++) {
        let here = (thread & ~15u) + t;
        result.before += select(vec2<u32>(0u), of_sixteen[t], t < thread / 16u) + select(vec2<u32>(0u), partial[here], here < thread);
        result.all += of_sixteen[t];
    }
    return result;
}

// Marks particles that keep their tags, in keys and order.
const KEPT: u32 = 0x80000000u;
// Marks the tag of a particle that split and merge have taken out: a sort leaves it behind.
const GONE: u32 = 0x80000000u;

fn is_sorted(layer: u32) -> bool {
    return atomicLoad(&status[sum_word(layer, DUE)]) != 0u;
}

// The cell by which a particle is sorted, from its block's first one: where it is, or its home if its layer is not due.
fn cell_to_be(tag: u32, layer_is_due: bool) -> vec3<i32> {
    return cell_of(select(tag >> 16u, tag, layer_is_due));
}

// Is a place, a cell of the layer and counts in it, beyond a side of the world? Open sides may cut cells.
fn is_beyond(layer: u32, cell: vec3<i32>, counts: vec3<u32>) -> bool {
    let level = vec3<u32>(level_of(layer));
    // In cells of the finest level, whose first counts are the layer's last.
    var fine = cell << level;
    if level.x > 0u {
        fine += vec3<i32>(counts >> (vec3<u32>(32u) - level));
    }
    let part = counts << level;
    let world = extent.world;
    let low = (fine < world.side_low) | ((fine == world.side_low) & (part < world.side_low_part));
    let high = (fine > world.side_high) | ((fine == world.side_high) & (part >= world.side_high_part));
    return any((low | high) & !IS_PERIODIC);
}

fn halted() -> bool {
    return atomicLoad(&status[HALTED]) != 0u;
}
