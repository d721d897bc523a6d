// Holds the nodes at the edge of live ground at rest; what that takes is booked with what walls give, once the step is known to be short enough.

var<workgroup> columns: u32;
var<workgroup> given: array<vec4<f32>, 64>;

fn held_columns(g: u32) -> u32 {
    if atomicLoad(&status[HALTED]) != 0u || g >= atomicLoad(&status[NODE_BLOCKS]) {
        return 0u;
    }
    return select(0u, rims[g].w, is_live(u32(lists[(extent.block_room + g) * ENTRY].w)));
}

@compute @workgroup_size(64)
fn hold(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        columns = held_columns(g);
    }
    let held = workgroupUniformLoad(&columns);
    if held == 0u {
        return;
    }
    given[n] = vec4<f32>(0.0);
    if (held & (1u << (n >> 2u))) != 0u {
        let node = grid[g * 64u + n];
        given[n] = vec4<f32>(-node.w * node.xyz, 0.0);
        grid[g * 64u + n] = vec4<f32>(0.0, 0.0, 0.0, node.w);
    }
    workgroupBarrier();
    if n == 0u {
        var total = vec4<f32>(0.0);
        for (var t = 0u; t < 64u; t++) {
            total += given[t];
        }
        lists[(extent.block_room + g) * ENTRY + PENDING] = bitcast<vec4<i32>>(total);
    }
}
