
var<workgroup> touched: atomic<u32>;

// One of the 27 blocks whose tiles reach a node block: is it awake?
fn look_at(g: u32, n: u32) {
    let b = u32(lists[(extent.block_room + g) * ENTRY + 1u + (n >> 2u)][n & 3u]);
    if b != NONE && !is_asleep(b) {
        atomicStore(&touched, 1u);
    }
}
