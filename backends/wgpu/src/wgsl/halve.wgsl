
// Splits what shared nodes have after a step's P2G, p + dt f, into p + dt f / 2 and dt f / 2; the tiles hold p.
@compute @workgroup_size(64)
fn halve(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if is_on(g) == 0u || !is_shared(g, n) {
        return;
    }
    let at = own_at(g, n);
    let own = shared_nodes[at];
    let carried = sum_of_tiles((extent.block_room + g) * ENTRY, n);
    let gain = 0.5 * (own.xyz - carried.xyz);
    shared_nodes[at] = vec4<f32>(carried.xyz + gain, own.w);
    shared_nodes[at + 64u] = vec4<f32>(gain, 0.0);
}
