// Nodes at rims move with the next coarser layer: u_f = sum_c P u_c.

// Brings a parent of a block's nodes, which are 4x4x4, from one before its first one on: its velocity and, as bits of a whole number, whose components'
// signs are turned, for behind a mirror stand images.
fn fetch_parent(layer: u32, first: vec3<i32>, n: u32) {
    var parent = first + local_of(n);
    let low = world_min(layer);
    let high = world_max(layer);
    var turned = vec3<f32>(1.0);
    for (var axis = 0; axis < 3; axis++) {
        if LOW[axis] != 0u && parent[axis] < low[axis] {
            parent[axis] = 2 * low[axis] - 1 - parent[axis];
            turned *= wall_signs(LOW[axis], axis);
        } else if HIGH[axis] != 0u && parent[axis] >= high[axis] {
            parent[axis] = 2 * high[axis] - 1 - parent[axis];
            turned *= wall_signs(HIGH[axis], axis);
        }
    }
    let are_turned = dot(vec3<u32>(turned < vec3<f32>(0.0)), vec3<u32>(1u, 2u, 4u));
    exchange[64u * abreast + n] = vec4<f32>(velocity_at(layer, parent), f32(are_turned));
}

fn signs_of(parent: vec4<f32>) -> vec3<f32> {
    return select(vec3<f32>(1.0), vec3<f32>(-1.0), (vec3<u32>(u32(parent.w)) & vec3<u32>(1u, 2u, 4u)) != vec3<u32>(0u));
}

// The nodes of a block that are at the rim, if `is_rim`. Those behind mirrors whose images are there find the same as these, reflected.
fn move_rim(g: u32, n: u32, is_rim: bool) {
    let entry = (extent.block_room + g) * ENTRY;
    let coarser = u32(lists[entry].w) + 1u;
    let first = 2 * lists[entry].xyz - vec3<i32>(1);
    var impulse = vec3<f32>(0.0);
    let mass = -grid[g * 64u + n].w;
    if is_rim {
        fetch_parent(coarser, first, n);
    }
    workgroupBarrier();
    // Nobody reads the velocity of nodes that weigh nothing.
    if is_rim && (rims[g][n >> 5u] & (1u << (n & 31u))) != 0u && mass > 0.0 {
        let place = local_of(n);
        let near = (place >> vec3<u32>(1u)) + vec3<i32>(1);
        let far = near + select(vec3<i32>(-1), vec3<i32>(1), (place & vec3<i32>(1)) == vec3<i32>(1));
        var u = vec3<f32>(0.0);
        for (var k = 0u; k < 8u; k++) {
            let is_far = (vec3<u32>(k >> 2u, k >> 1u, k) & vec3<u32>(1u)) == vec3<u32>(1u);
            let share = select(vec3<f32>(0.75), vec3<f32>(0.25), is_far);
            let at = vec3<u32>(select(near, far, is_far));
            let parent = exchange[64u * abreast + at.x * 16u + at.y * 4u + at.z];
            let signs = signs_of(parent);
            let part = share.x * share.y * share.z * parent.xyz;
            u += signs * part;
            // What particles read is not what they would have read from the node itself.
            impulse += mass * (signs - vec3<f32>(1.0)) * part;
        }
        grid[g * 64u + n] = vec4<f32>(u, 0.0);
        if MIRRORED {
            let image = image_of(coarser - 1u, 4 * lists[entry].xyz + place);
            if image.is_other {
                impulse = given_behind(image, image.outer * u, mass);
            }
        }
    }
    // Parents are done with.
    workgroupBarrier();
    let total = sum_of_block(n, impulse);
    if n == 0u && is_rim && has_nodes_behind(coarser, first) {
        book(entry + TO_BOOK, total);
    }
}
