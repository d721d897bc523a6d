// What the ground gives to parts of walls through rims, a workgroup a block, once rims move: parents behind walls turn round what is handed to them, and so is what rims read
// there. As `hand_on.wgsl` and `prolong.wgsl` have it, parent by parent; it waits until the step turns out to be short enough.

fn ready(g: u32) -> u32 {
    let here = min(g, extent.node_room - 1u);
    if g == NONE || is_on(here) == 0u {
        return 0u;
    }
    let first = 2 * lists[(extent.block_room + here) * ENTRY].xyz - vec3<i32>(1);
    return u32(has_nodes_behind(layer_of(here) + 1u, first));
}

@compute @workgroup_size(64)
fn see_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = listed_block(AT_RIM, group.y * extent.row + group.x);
    if n == 0u {
        go = ready(g);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let entry = (extent.block_room + g) * ENTRY;
    let layer = layer_of(g);
    // What is behind mirrors hands on nothing.
    let hands = is_slave(g, n) && !is_behind(layer, 4 * lists[entry].xyz + local_of(n));
    var node = vec4<f32>(0.0);
    if hands {
        node = sum_of_tiles(entry, n);
    }
    let first = 2 * lists[entry].xyz - vec3<i32>(1);
    let given = to_parents(layer, first, n, node);
    let cell = first + local_of(n);
    let to = before_mirrors(layer + 1u, cell);
    if all(to == cell) {
        return;
    }
    var signs = vec3<f32>(1.0);
    for (var axis = 0; axis < 3; axis++) {
        if to[axis] != cell[axis] {
            signs *= wall_signs(select(LOW[axis], HIGH[axis], to[axis] < cell[axis]), axis);
        }
    }
    let impulse = (signs - vec3<f32>(1.0)) * (given.xyz + given.w * velocity_at(layer + 1u, to));
    forget();
    // A component is that of the wall across its axis if that turned something, and of the first that did else.
    for (var d = 0; d < 3; d++) {
        var wall = NONE;
        for (var k = 0; k < 4; k++) {
            let axis = select(k - 1, d, k == 0);
            if wall == NONE && to[axis] != cell[axis] {
                wall = 2u * u32(axis) + u32(to[axis] < cell[axis]);
            }
        }
        var component = vec3<f32>(0.0);
        component[d] = impulse[d];
        see(layer + 1u, wall, to, component);
    }
    add_pressed(layer, PENDING_PART);
}
