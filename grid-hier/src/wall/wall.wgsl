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
