
var<workgroup> go: u32;

// May this step go on?
fn ready(g: u32) -> u32 {
    let speed = bitcast<f32>(atomicLoad(&status[greatest_word(step.number)]));
    let fits = atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) && is_slow_enough(speed);
    return u32(fits && is_live(u32(lists[(extent.block_room + g) * ENTRY].w)));
}

@compute @workgroup_size(64)
fn prolong(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = $BLOCK;
    if n == 0u {
        go = ready(g);
    }
    if workgroupUniformLoad(&go) != 0u {
        move_rim(g, n);
    }
}
