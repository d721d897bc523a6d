// Regions of levels: unions of boxes of cells, two vectors a box, as many for each level of a world.

// How much of a box of cells lies in a region: nothing; part of it, or all of it in several boxes; all of it in one.
const NOTHING: u32 = 0u;
const PART: u32 = 1u;
const ALL: u32 = 2u;

fn has_region(layer: u32) -> bool {
    return level_of(layer) + 1u < LEVELS;
}

// Does a box of a layer's region, grown by so many cells, hold all cells from `first` up to but without `end`?
fn holds(layer: u32, first: vec3<i32>, end: vec3<i32>, by: i32) -> bool {
    return cover(0u, layer, first, end, by) == ALL;
}

// How much of those cells lies in the layer's region, whose boxes stand in one table or another. Cells behind a wall belong where the
// wall's own cells do.
fn cover(table: u32, layer: u32, first: vec3<i32>, end: vec3<i32>, by: i32) -> u32 {
    if !has_region(layer) {
        return ALL;
    }
    var found = NOTHING;
    let low = world_min(layer);
    let high = world_max(layer);
    var least = select(first, max(first, low), HAS_LOW_WALL);
    var most = select(end, max(end, low + vec3<i32>(1)), HAS_LOW_WALL);
    least = select(least, min(least, high - vec3<i32>(1)), HAS_HIGH_WALL);
    most = select(most, min(most, high), HAS_HIGH_WALL);
    let is_periodic = IS_PERIODIC;
    // Beside a box itself, copies of it along periodic axes.
    let first_copy = select(13u, 0u, any(is_periodic));
    let end_copy = select(14u, 27u, any(is_periodic));
    for (var b = 0u; b < BOXES; b++) {
        let at = layer / LEVELS * PER_WORLD + 2u * ((table * (LEVELS - 1u) + level_of(layer)) * BOXES + b);
        let low_face = regions[at].xyz - vec3<i32>(by);
        let high_face = regions[at + 1u].xyz + vec3<i32>(by);
        for (var copy = first_copy; copy < end_copy; copy++) {
            let shift = offset_of(copy);
            if all(is_periodic | (shift == vec3<i32>(0))) {
                let moved = shift * (high - low);
                if all(least + moved >= low_face) && all(most + moved <= high_face) {
                    return ALL;
                }
                if all(least + moved < high_face) && all(most + moved > low_face) {
                    found = PART;
                }
            }
        }
    }
    return found;
}

// May a block's particles give to nodes at the rim of its layer's region? Its tile, with all that its nodes' splines reach, is not
// in one box.
fn is_edge(layer: u32, block: vec3<i32>) -> bool {
    return !holds(layer, 4 * block - vec3<i32>(3), 4 * block + vec3<i32>(7), 0);
}

// May the parent cells of a block be next to those of nodes at the rim?
fn is_near_edge(layer: u32, block: vec3<i32>) -> bool {
    return !holds(layer, 4 * block - vec3<i32>(4), 4 * block + vec3<i32>(8), 0);
}
