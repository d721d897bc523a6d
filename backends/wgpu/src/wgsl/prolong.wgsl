// Nodes at rims move with the next coarser layer: u_f = sum_c P u_c.

var<workgroup> go: u32;
var<workgroup> given: array<vec4<f32>, 64>;

// May this step go on?
fn ready(g: u32) -> u32 {
    let speed = bitcast<f32>(atomicLoad(&status[greatest_word(step.number)]));
    let fits = atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) && is_slow_enough(speed);
    return u32(fits && any(rims[g].xy != vec2<u32>(0u)) && is_live(u32(lists[(extent.block_room + g) * ENTRY].w)));
}

@compute @workgroup_size(64)
fn prolong(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = ready(min(g, extent.node_room - 1u)) & u32(g < extent.node_room);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    let layer = u32(lists[entry].w) + 1u;
    let low = world_min(layer);
    let high = world_max(layer);
    var impulse = vec3<f32>(0.0);
    let mass = -grid[g * 64u + n].w;
    // Nobody reads the velocity of nodes that weigh nothing.
    if (rims[g][n >> 5u] & (1u << (n & 31u))) != 0u && mass > 0.0 {
        let cell = 4 * lists[entry].xyz + vec3<i32>(i32(n >> 4u), i32((n >> 2u) & 3u), i32(n & 3u));
        let near = cell >> vec3<u32>(1u);
        let far = near + select(vec3<i32>(-1), vec3<i32>(1), (cell & vec3<i32>(1)) == vec3<i32>(1));
        var u = vec3<f32>(0.0);
        for (var k = 0u; k < 8u; k++) {
            let is_far = (vec3<u32>(k >> 2u, k >> 1u, k) & vec3<u32>(1u)) == vec3<u32>(1u);
            let share = select(vec3<f32>(0.75), vec3<f32>(0.25), is_far);
            var parent = select(near, far, is_far);
            // Parents behind a mirror are images.
            var signs = vec3<f32>(1.0);
            for (var axis = 0; axis < 3; axis++) {
                if LOW[axis] != 0u && parent[axis] < low[axis] {
                    parent[axis] = 2 * low[axis] - 1 - parent[axis];
                    signs *= wall_signs(LOW[axis], axis);
                } else if HIGH[axis] != 0u && parent[axis] >= high[axis] {
                    parent[axis] = 2 * high[axis] - 1 - parent[axis];
                    signs *= wall_signs(HIGH[axis], axis);
                }
            }
            let part = share.x * share.y * share.z * velocity_at(layer, parent);
            u += signs * part;
            // What particles read is not what they would have read from the node itself.
            impulse += mass * (signs - vec3<f32>(1.0)) * part;
        }
        grid[g * 64u + n] = vec4<f32>(u, 0.0);
    }
    given[n] = vec4<f32>(impulse, 0.0);
    workgroupBarrier();
    if n == 0u {
        var total = bitcast<vec4<f32>>(lists[entry + WALL]);
        for (var t = 0u; t < 64u; t++) {
            total += given[t];
        }
        lists[entry + WALL] = bitcast<vec4<i32>>(total);
    }
}
