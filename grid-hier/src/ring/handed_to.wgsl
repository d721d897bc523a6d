
// What rims hand to the nodes of a block.

// The blocks of nodes of the next finer layer that may hand something to a block's nodes, from one before its own place on: 4x4x4. NONE stands
// for those that do not.
var<workgroup> givers: array<u32, 64u * ABREAST>;

// Finds them, a thread each. A barrier must follow.
fn find_givers(g: u32, n: u32) {
    let finer = layer_of(g) - 1u;
    let block = 2 * lists[(extent.block_room + g) * ENTRY].xyz - vec3<i32>(1) + local_of(n);
    let at = place_in_box(finer, block);
    var rim = NONE;
    if at != NONE {
        rim = directory[at].y;
    }
    if rim != NONE && (rims[rim].z & HANDS_ON) == 0u {
        rim = NONE;
    }
    givers[64u * abreast + n] = rim;
}

// What one of them hands to a node: `near` counts from the first of the two along each axis that have the node among their parents.
fn of_giver(n: u32, near: vec3<u32>) -> vec4<f32> {
    let local = vec3<u32>(n >> 4u, (n >> 2u) & 3u, n & 3u);
    // From one before the block's own place on, as `givers`; of parents, from one before the giver's own place on.
    let which = ((local + vec3<u32>(1u)) >> vec3<u32>(1u)) + near;
    let place = local + vec3<u32>(3u) - 2u * which;
    let rim = givers[64u * abreast + which.x * 16u + which.y * 4u + which.z];
    let held = handed[select(rim, 0u, rim == NONE) * 64u + place.x * 16u + place.y * 4u + place.z];
    return select(held, vec4<f32>(0.0), rim == NONE);
}

// What they hand to a node in all. All eight are asked for at once.
fn handed_to(n: u32) -> vec4<f32> {
    return of_giver(n, vec3<u32>(0u, 0u, 0u)) + of_giver(n, vec3<u32>(0u, 0u, 1u))
        + of_giver(n, vec3<u32>(0u, 1u, 0u)) + of_giver(n, vec3<u32>(0u, 1u, 1u))
        + of_giver(n, vec3<u32>(1u, 0u, 0u)) + of_giver(n, vec3<u32>(1u, 0u, 1u))
        + of_giver(n, vec3<u32>(1u, 1u, 0u)) + of_giver(n, vec3<u32>(1u, 1u, 1u));
}
