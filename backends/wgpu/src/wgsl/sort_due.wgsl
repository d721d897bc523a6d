// Which layers are to be sorted. In a sort, the others keep their particles' homes and order.
@compute @workgroup_size(64)
fn due(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let layer = group.x * 64u + thread;
    if layer < LAYERS {
        atomicStore(&status[sum_word(layer, DUE)], u32(is_live(layer) && is_world_due(layer, since_sort_of(layer))));
    }
}
