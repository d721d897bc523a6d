// Particles before each block, and those in it; and how many there are in all. One workgroup.
@compute @workgroup_size(256)
fn sum_blocks(@builtin(local_invocation_index) thread: u32) {
    let count = select(atomicLoad(&status[BLOCKS]), 0u, halted());
    let each = (count + 255u) / 256u;
    let source = min(thread * each, count);
    let to = min(source + each, count);
    var sum = 0u;
    for (var i = source; i < to; i++) {
        sum += sums[i].x;
    }
    var before = sums_of(thread, vec2<u32>(sum, 0u)).before.x;
    for (var i = source; i < to; i++) {
        let here = sums[i].x;
        sums[i] = vec2<u32>(before, here);
        before += here;
    }
    if thread == 255u {
        atomicStore(&status[COUNTED], before);
    }
}
