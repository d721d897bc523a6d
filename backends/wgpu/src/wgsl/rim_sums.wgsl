// What rims have to do with a node's sums.

fn is_slave(g: u32, n: u32) -> bool {
    return (rims[g][n >> 5u] & (1u << (n & 31u))) != 0u;
}

// A layer's own sum at a node, or nothing if it has handed it on. What that weighed it shows as a negative mass.
fn kept(g: u32, n: u32, node: vec4<f32>) -> vec4<f32> {
    return select(node, vec4<f32>(0.0, 0.0, 0.0, -node.w), is_slave(g, n));
}
