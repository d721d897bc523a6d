// Turns the sums into sums of all before, and checks that there is room. One workgroup.
@compute @workgroup_size(256)
fn total_blocks(@builtin(local_invocation_index) thread: u32) {
    let count = (extent.box_blocks + 1023u) / 1024u;
    let each = (count + 255u) / 256u;
    let source = min(thread * each, count);
    let to = min(source + each, count);
    var sum = vec2<u32>(0u);
    for (var i = source; i < to; i++) {
        sum += sums[i];
    }
    partial[thread] = sum;
    workgroupBarrier();
    var before = vec2<u32>(0u);
    for (var t = 0u; t < thread; t++) {
        before += partial[t];
    }
    for (var i = source; i < to; i++) {
        let here = sums[i];
        sums[i] = before;
        before += here;
    }
    if thread == 255u && !halted() {
        atomicStore(&status[NEW_BLOCKS], before.x);
        atomicStore(&status[NEW_NODE_BLOCKS], before.y);
        if before.x > extent.block_room || before.y > extent.node_room {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], ROOM);
        } else {
            // How many blocks of the old order there are is still needed.
            atomicStore(&status[OLD_BLOCKS], atomicLoad(&status[BLOCKS]));
            atomicStore(&status[SORTS], atomicLoad(&status[SORTS]) + 1u);
            atomicStore(&status[BLOCKS], before.x);
            atomicStore(&status[NODE_BLOCKS], before.y);
            for (var d = 0u; d < 3u; d++) {
                atomicStore(&status[LEAST_BLOCK + d], NONE);
                atomicStore(&status[GREATEST_BLOCK + d], 0u);
            }
        }
    }
}
