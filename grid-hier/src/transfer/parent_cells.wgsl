
// Mass and m C of a block's particles, by the parent cell (2x2x2 cells) in which they were sorted: for each of the eight, the columns of
// m C [kg m/s a cell], with the mass behind the first. What each cell holds stands where the tile stood: the rows of m C, and mass.
// The thread's cell has so many particles.
fn sum_parent_cells(b: u32, thread: u32, count: u32) {
    let cell = thread & 63u;
    let width = extent.world.cell / shrink_of(layer_now);
    var sums: array<vec2<f32>, 3>;
    // One half of the threads takes the first two rows, the other one the last, and mass. Those that stand together are asked for at once.
    let is_first = thread < 64u;
    for (var rank = 0u; rank < count; rank += TOGETHER) {
        let q = slot_of(b, cell, rank);
        var masses: array<f32, TOGETHER>;
        var rows: array<array<vec4<f32>, 2>, TOGETHER>;
        for (var k = 0u; k < TOGETHER; k++) {
            let here = q + min(k, count - rank - 1u);
            masses[k] = bitcast<f32>(record_of(here, 1u).w);
            rows[k][0] = bitcast<vec4<f32>>(record_of(here, select(4u, 2u, is_first)));
            rows[k][1] = bitcast<vec4<f32>>(record_of(here, select(4u, 3u, is_first)));
        }
        for (var k = 0u; k < TOGETHER; k++) {
            if rank + k < count {
                let of_mass = masses[k] * width;
                let one = of_mass * rows[k][0].yzw;
                let other = of_mass * rows[k][1].yzw;
                sums[0] += one.xy;
                sums[1] += vec2<f32>(one.z, select(masses[k], other.x, is_first));
                sums[2] += other.yz;
            }
        }
    }
    workgroupBarrier();
    let at = cell * 5u + select(3u, 0u, thread < 64u);
    tile[at] = sums[0];
    tile[at + 1u] = sums[1];
    if thread < 64u {
        tile[at + 2u] = sums[2];
    }
    workgroupBarrier();
    if thread < 24u {
        let parent = thread / 3u;
        let column = thread % 3u;
        let corner = ((parent >> 2u) << 5u) + (((parent >> 1u) & 1u) << 3u) + ((parent & 1u) << 1u);
        var sum = vec4<f32>(0.0);
        for (var k = 0u; k < 8u; k++) {
            let child = corner + ((k >> 2u) << 4u) + (((k >> 1u) & 1u) << 2u) + (k & 1u);
            sum += vec4<f32>(of_cell(child, column), of_cell(child, 3u + column), of_cell(child, 6u + column), of_cell(child, 9u));
        }
        handed[of_parent_cell(b, parent, column)] = sum;
    }
}

// A cell's entry of m C, row by row, or its mass behind them.
fn of_cell(cell: u32, k: u32) -> f32 {
    return tile[cell * 5u + (k >> 1u)][k & 1u];
}
