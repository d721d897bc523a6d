// Unbounded ground: columns of the coarsest level whose nodes touch ground that is not live. For each world there stand how many tiles are, and these
// in their order.
var<workgroup> edge: atomic<u32>;

fn is_live_tile(world: u32, tile: vec2<i32>) -> bool {
    let first = world * (arrayLength(&live) / (LAYERS / LEVELS));
    var low = 0u;
    var high = u32(live[first].x);
    while high > low {
        let middle = (low + high) / 2u;
        let here = live[first + 1u + middle];
        if all(here == tile) {
            return true;
        }
        if here.x < tile.x || (here.x == tile.x && here.y < tile.y) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return false;
}

// Is a column out of reach? Beyond the world there is nothing that could be.
fn is_away(layer: u32, column: vec2<i32>) -> bool {
    let inside = all(column >= world_min(layer).xy) && all(column < world_max(layer).xy);
    return inside && !is_live_tile(layer / LEVELS, column >> vec2<u32>(2u));
}

fn find_edge(layer: u32, block: vec3<i32>, n: u32) {
    if n >= 16u || level_of(layer) + 1u < LEVELS {
        return;
    }
    for (var k = 0; k < 9; k++) {
        if is_away(layer, 4 * block.xy + vec2<i32>(i32(n >> 2u) + k / 3 - 1, i32(n & 3u) + k % 3 - 1)) {
            atomicOr(&edge, 1u << n);
        }
    }
}

