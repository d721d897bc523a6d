
// Does a particle lie where its level does? Each belongs to the finest level whose region, grown by SPLIT_AHEAD parent cells, holds its
// cell; `upper` says for each axis whether it lies in the cell's upper half.
fn is_placed(layer: u32, cell: vec3<i32>, upper: vec3<i32>) -> bool {
    if !holds(layer, cell, cell + vec3<i32>(1), 2 * SPLIT_AHEAD) {
        return false;
    }
    let finer = 2 * cell + upper;
    return level_of(layer) == 0u || !holds(layer - 1u, finer, finer + vec3<i32>(1), 2 * SPLIT_AHEAD);
}
