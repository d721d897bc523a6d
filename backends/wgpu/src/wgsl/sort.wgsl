// The sort: which blocks hold particles and which nodes they reach, in the order of their coordinates; particles by block, cell, law
// and, among those, as they were. Each entry point is one pass; those over particles run block by block of the old order.

var<workgroup> partial: array<vec2<u32>, 256>;
var<workgroup> total: vec2<u32>;

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

fn halted() -> bool {
    return atomicLoad(&status[HALTED]) != 0u;
}
