// A layer's nodes that the finer one hands something to, in subcycling.
fn is_shared(g: u32, n: u32) -> bool {
    return rims[g].z != 0u && !is_slave(g, n);
}

// A layer's own sum at a node, or nothing as long as it is the finer layer's, too.
fn kept_back(g: u32, n: u32, node: vec4<f32>) -> vec4<f32> {
    if is_shared(g, n) {
        shared_nodes[own_at(g, n)] = node;
        return vec4<f32>(0.0);
    }
    return kept(g, n, node);
}
