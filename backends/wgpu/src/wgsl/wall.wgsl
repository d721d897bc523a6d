// Mirror walls: nodes beyond them are images of those before.

// Signs of a vector's components in the mirror: slip walls turn the normal one, sticking walls all.
fn wall_signs(kind: u32, axis: i32) -> vec3<f32> {
    if kind == 2u {
        return vec3<f32>(-1.0);
    }
    var signs = vec3<f32>(1.0);
    signs[axis] = -1.0;
    return signs;
}

// The tile's node number `t` of 64 in a plane across an axis.
fn plane_node(axis: i32, plane: u32, t: u32) -> vec3<u32> {
    let a = t >> 3u;
    let c = t & 7u;
    if axis == 0 {
        return vec3<u32>(plane, a, c);
    }
    if axis == 1 {
        return vec3<u32>(a, plane, c);
    }
    return vec3<u32>(a, c, plane);
}

fn in_plane(axis: i32, plane: u32, t: u32) -> u32 {
    let n = plane_node(axis, plane, t);
    return in_tile(n.x, n.y, n.z);
}

// Is that node behind a wall across an axis before this one, which has folded it already?
fn behind(axis: i32, t: u32, origin: vec3<i32>) -> bool {
    let node = origin + vec3<i32>(plane_node(axis, 0u, t));
    for (var d = 0; d < axis; d++) {
        if (LOW[d] != 0u && node[d] < WORLD_MIN[d]) || (HIGH[d] != 0u && node[d] >= WORLD_MAX[d]) {
            return true;
        }
    }
    return false;
}
