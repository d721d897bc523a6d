
// Velocities of nodes that a finer layer, whose step it is, hands something to. Their own momentum is then what they have at that velocity,
// and what the forces of the next such step add.
@compute @workgroup_size(64)
fn solve(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        let fits = atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]);
        go = u32(fits && rims[min(g, extent.node_room - 1u)].z != 0u && level_of(layer_of(min(g, extent.node_room - 1u))) <= step.end_level);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    var node = vec4<f32>(0.0);
    if is_shared(g, n) {
        let at = own_at(g, n);
        let own = shared_nodes[at];
        node = velocity(g, own + handed_to(g, n));
        grid[g * 64u + n] = node;
        shared_nodes[at] = vec4<f32>(own.w * node.xyz + shared_nodes[at + 64u].xyz, own.w);
    }
    note_speed(g, node, n);
}
