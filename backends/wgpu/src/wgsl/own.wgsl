// Subcycling: nodes that the finer layer hands something to take part in both of its steps within one of theirs. For each of a block's nodes
// there stands, in `shared`, the momentum and mass of the own layer's particles in the first of them, then what their forces add in half a step, and
// then the momentum in the second.
fn own_at(g: u32, n: u32) -> u32 {
    return g * 192u + n;
}

// What a node weighs for bodies: what the own layer's particles weigh there. Those of the finer layer have moved when the layer meets bodies.
fn own_mass(g: u32, n: u32, node: vec4<f32>) -> f32 {
    if (rims[g].z & IS_GIVEN) != 0u && node.w > 0.0 {
        return shared_nodes[own_at(g, n)].w;
    }
    return node.w;
}
