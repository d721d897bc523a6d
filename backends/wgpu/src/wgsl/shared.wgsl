// A layer's nodes that the finer one hands something to, in subcycling.
fn is_shared(g: u32, n: u32) -> bool {
    return (rims[g].z & IS_GIVEN) != 0u && !is_slave(g, n);
}
