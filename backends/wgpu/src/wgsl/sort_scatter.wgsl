// Particles by cell, in any order within it; with the law, by which they are to be ordered.
@compute @workgroup_size(128)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let q = (group.y * extent.row + group.x) * 128u + thread;
    if halted() || q >= extent.particles {
        return;
    }
    let key = keys[q];
    if key.x == NONE {
        return;
    }
    loose[counts[key.x] + (key.y & ~KEPT)] = (law_of(record_of(q, 0u).w) << 28u) | q;
}
