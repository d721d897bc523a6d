// What `mesh.rs` and `sdf.rs` find between samples. They stand in a part's own frame, around the middle of its box.

fn rigid_sample(begin: u32, n: u32) -> f32 {
    return coupling_sample(begin + (n >> 2u))[n & 3u];
}

// Of a mesh: coupling_sample(first) holds where the first sample is and how far they are apart [m], the next one how many there are along x, y
// and z; distances [m] follow, x fastest.
//
// Distance and normal, trilinear between samples. Beyond them: the distance to them plus what is there.
fn rigid_mesh(first: u32, x: vec3<f32>) -> RigidSurface {
    let head = coupling_sample(first);
    let size = vec3<u32>(coupling_sample(first + 1u).xyz);
    let at = (x - head.xyz) / head.w;
    let s = clamp(at, vec3<f32>(0.0), vec3<f32>(size - 1u));
    let cell = min(vec3<u32>(s), size - 2u);
    let f = s - vec3<f32>(cell);
    let row = size.x;
    let slab = size.x * size.y;
    let corner = cell.x + cell.y * row + cell.z * slab;
    // On the four edges along x: the values at both ends.
    let left = vec4<f32>(rigid_sample(first + 2u, corner), rigid_sample(first + 2u, corner + row),
        rigid_sample(first + 2u, corner + slab), rigid_sample(first + 2u, corner + row + slab));
    let right = vec4<f32>(rigid_sample(first + 2u, corner + 1u), rigid_sample(first + 2u, corner + 1u + row),
        rigid_sample(first + 2u, corner + 1u + slab), rigid_sample(first + 2u, corner + 1u + row + slab));
    let rise = right - left;
    let edge = left + f.x * rise;
    let face = mix(edge.xz, edge.yw, f.y);
    let value = mix(face.x, face.y, f.z);
    let rise_across = mix(rise.xz, rise.yw, f.y);
    let gradient = vec3<f32>(mix(rise_across.x, rise_across.y, f.z), mix(edge.y - edge.x, edge.w - edge.z, f.z), face.y - face.x) / head.w;
    // Where branches of the distance meet, the interpolated slope falls short of one and its direction means little.
    let slope = length(gradient);
    let known = slope > 0.3;
    let normal = select(vec3<f32>(0.0), gradient / slope, known);
    let beyond = head.w * (at - s);
    let gap = length(beyond);
    if gap > 0.0 {
        return rigid_direction(beyond + value * normal, head.w, value + gap);
    }
    return RigidSurface(value, normal, known);
}

// Of a height field, half as large as `half`: coupling_sample(first) holds how many heights there are along x and y, and how far they are apart [m];
// they follow [m], x fastest.
fn rigid_heights(first: u32, half: vec3<f32>, x: vec3<f32>) -> RigidSurface {
    let head = coupling_sample(first);
    let count = vec2<u32>(head.xy);
    let s = clamp((x.xy + half.xy) / head.zw, vec2<f32>(0.0), vec2<f32>(count - 1u));
    let cell = min(vec2<u32>(s), count - 2u);
    let f = s - vec2<f32>(cell);
    let corner = cell.y * count.x + cell.x;
    let near = vec2<f32>(rigid_sample(first + 1u, corner), rigid_sample(first + 1u, corner + 1u));
    let far = vec2<f32>(rigid_sample(first + 1u, corner + count.x), rigid_sample(first + 1u, corner + count.x + 1u));
    let along_y = mix(near, far, f.y);
    let along_x = mix(vec2<f32>(near.x, far.x), vec2<f32>(near.y, far.y), f.x);
    let slope = vec3<f32>(-(along_y.y - along_y.x) / head.z, -(along_x.y - along_x.x) / head.w, 1.0);
    let steep = length(slope);
    var surface = RigidSurface((x.z - mix(along_y.x, along_y.y, f.x)) / steep, slope / steep, true);
    // The bottom and the four sides.
    if -half.z - x.z > surface.distance {
        surface = RigidSurface(-half.z - x.z, vec3<f32>(0.0, 0.0, -1.0), true);
    }
    if abs(x.x) - half.x > surface.distance {
        surface = RigidSurface(abs(x.x) - half.x, vec3<f32>(rigid_sign(x.x), 0.0, 0.0), true);
    }
    if abs(x.y) - half.y > surface.distance {
        surface = RigidSurface(abs(x.y) - half.y, vec3<f32>(0.0, rigid_sign(x.y), 0.0), true);
    }
    return surface;
}
