// Turns the sums into sums of all before, and checks that there is room. One workgroup.
@compute @workgroup_size(256)
fn total_blocks(@builtin(local_invocation_index) thread: u32) {
    let count = (extent.places + 1023u) / 1024u;
    let each = (count + 255u) / 256u;
    let source = min(thread * each, count);
    let to = min(source + each, count);
    var sum = vec2<u32>(0u);
    for (var i = source; i < to; i++) {
        sum += sums[i];
    }
    let found = sums_of(thread, sum);
    let all = found.all;
    var before = found.before;
    for (var i = source; i < to; i++) {
        let here = sums[i];
        sums[i] = before;
        before += here;
    }
    let fits = all.x <= extent.block_room && all.y <= extent.node_room;
    if halted() {
        return;
    }
    if fits {
        for (var layer = thread; layer < LAYERS; layer += 256u) {
            if is_sorted(layer) {
                atomicStore(&status[sum_word(layer, SORTED)], step.number + 1u);
            }
            for (var d = 0u; d < 3u; d++) {
                atomicStore(&status[layer_word(layer, LEAST_BLOCK + d)], NONE);
                atomicStore(&status[layer_word(layer, GREATEST_BLOCK + d)], 0u);
            }
        }
    }
    if thread == 0u {
        atomicStore(&status[NEW_BLOCKS], all.x);
        atomicStore(&status[NEW_NODE_BLOCKS], all.y);
        if fits {
            // How many blocks of the old order there are is still needed.
            atomicStore(&status[OLD_BLOCKS], atomicLoad(&status[BLOCKS]));
            atomicStore(&status[SORTS], atomicLoad(&status[SORTS]) + 1u);
            atomicStore(&status[BLOCKS], all.x);
            atomicStore(&status[NODE_BLOCKS], all.y);
        } else {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], ROOM);
        }
    }
}
