// The sort: which blocks hold particles and which nodes they reach, in the order of their coordinates; particles by block, cell, law
// and, among those, as they were. Each entry point is one pass; those over particles run block by block of the old order.

var<workgroup> partial: array<vec2<u32>, 256>;
var<workgroup> total: vec2<u32>;

fn halted() -> bool {
    return atomicLoad(&status[HALTED]) != 0u;
}
