// Vectors of a body in a step: cell of its reference point, place in that cell, three rows of its rotation, velocity, angular
// velocity, least and greatest node of its box.
const BODY: u32 = 9u;

fn int_vector(v: vec4<f32>) -> vec3<i32> {
    return bitcast<vec3<i32>>(v.xyz);
}

// Behind what node blocks give to each body there stands how particles press on it at each node [N], in its frame.
fn pressed_at(g: u32, body: u32, n: u32) -> u32 {
    return extent.node_room * BODIES * 2u + (g * BODIES + body) * 64u + n;
}


// Where a body stands in this slot, as the layer sees it.
fn body_at(b: u32) -> u32 {
    return ((slot_now() * LAYERS + layer_now) * BODIES + b) * BODY;
}
