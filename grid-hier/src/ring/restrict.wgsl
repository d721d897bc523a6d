
@compute @workgroup_size(64)
fn restrict_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = listed_block(AT_RIM, group.y * extent.row + group.x);
    if n == 0u {
        go = is_on(g);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    var node = vec4<f32>(0.0);
    if is_slave(g, n) {
        node = sum_of_tiles(entry, n);
    }
    hand_on(g, entry, n, node);
}
