// The distances of `mesh.rs`, for meshes: coupling_sample(first) holds where the first sample stands, in the part's frame, and how far they are apart
// [m]; the next one how many there are along x, y and z; and those that follow the distances [m], x fastest.

fn rigid_sample(first: u32, n: u32) -> f32 {
    return coupling_sample(first + 2u + (n >> 2u))[n & 3u];
}

// Distance and normal, trilinear between samples. Beyond them: the distance to them plus what is there.
fn rigid_sampled(first: u32, x: vec3<f32>) -> RigidSurface {
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
    let left = vec4<f32>(rigid_sample(first, corner), rigid_sample(first, corner + row),
        rigid_sample(first, corner + slab), rigid_sample(first, corner + row + slab));
    let right = vec4<f32>(rigid_sample(first, corner + 1u), rigid_sample(first, corner + 1u + row),
        rigid_sample(first, corner + 1u + slab), rigid_sample(first, corner + 1u + row + slab));
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
