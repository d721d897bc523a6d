// Mass and m C of a block's particles, by the parent cell (2x2x2 cells) in which they are, or the block's next to it: for each of the eight, the
// columns of m C [kg m/s a cell], with the mass behind the first. The thread's cell has so many particles.
// Those that are still in the parent cell in which they were sorted are summed first. Those that have left it are summed behind, by the way to
// where they are now, so that no sum depends on who came first. What each cell holds stands where the tile stood: the rows of m C, and mass.
fn sum_parent_cells(b: u32, thread: u32, count: u32) {
    if thread == 0u {
        atomicStore(&come_to[0], 0u);
    }
    workgroupBarrier();
    // Of the ways that some particle has gone, those of the thread's own cell, as bits.
    let gone = sum_parent_cells_by_way(b, thread, count, 0u);
    atomicOr(&come_to[0], gone);
    workgroupBarrier();
    var sum = sum_of_children(thread, 0u);
    if thread == 0u {
        go = atomicLoad(&come_to[0]);
    }
    let ways = workgroupUniformLoad(&go);
    for (var way = 1u; way < 8u; way++) {
        if ((ways >> way) & 1u) != 0u {
            sum_parent_cells_by_way(b, thread, select(0u, count, ((gone >> way) & 1u) != 0u), way);
            sum += sum_of_children(thread, way);
        }
    }
    if thread < 24u {
        handed[of_parent_cell(b, thread / 3u, thread % 3u)] = sum;
    }
}

// The block's parent cell, of eight, that has one of its cells, or that is next to one outside; a bit an axis.
fn parent_of(cell: vec3<i32>) -> u32 {
    let upper = vec3<u32>(cell >= vec3<i32>(2));
    return upper.x * 4u + upper.y * 2u + upper.z;
}

// Sums each cell's particles that have gone one way: the bits in which the parent cell where they are differs from that where they were sorted. Which
// ways its particles have gone, as bits.
fn sum_parent_cells_by_way(b: u32, thread: u32, count: u32, way: u32) -> u32 {
    let cell = thread & 63u;
    let sorted_in = parent_of(local_of(cell));
    let width = extent.world.cell / shrink_of(layer_now);
    var gone = 0u;
    var sums: array<vec2<f32>, 3>;
    // One half of the threads takes the first two rows, the other one the last, and mass. Those that stand together are asked for at once.
    let is_first = thread < 64u;
    for (var rank = 0u; rank < count; rank += TOGETHER) {
        let q = slot_of(b, cell, rank);
        var tags: array<u32, TOGETHER>;
        var masses: array<f32, TOGETHER>;
        var rows: array<array<vec4<f32>, 2>, TOGETHER>;
        for (var k = 0u; k < TOGETHER; k++) {
            let here = q + min(k, count - rank - 1u);
            tags[k] = record_of(here, 0u).w;
            masses[k] = bitcast<f32>(record_of(here, 1u).w);
            rows[k][0] = bitcast<vec4<f32>>(record_of(here, select(4u, 2u, is_first)));
            rows[k][1] = bitcast<vec4<f32>>(record_of(here, select(4u, 3u, is_first)));
        }
        for (var k = 0u; k < TOGETHER; k++) {
            if rank + k < count {
                let its = parent_of(cell_of(tags[k])) ^ sorted_in;
                gone |= 1u << its;
                if its == way {
                    let of_mass = masses[k] * width;
                    let one = of_mass * rows[k][0].yzw;
                    let other = of_mass * rows[k][1].yzw;
                    sums[0] += one.xy;
                    sums[1] += vec2<f32>(one.z, select(masses[k], other.x, is_first));
                    sums[2] += other.yz;
                }
            }
        }
    }
    workgroupBarrier();
    let at = cell * 5u + select(3u, 0u, is_first);
    tile[at] = sums[0];
    tile[at + 1u] = sums[1];
    if is_first {
        tile[at + 2u] = sums[2];
    }
    workgroupBarrier();
    return gone;
}

// What a parent cell gets of the eight cells whose particles come to it by that way; a thread has a column of a parent cell.
fn sum_of_children(thread: u32, way: u32) -> vec4<f32> {
    var sum = vec4<f32>(0.0);
    if thread < 24u {
        let from_parent = (thread / 3u) ^ way;
        let column = thread % 3u;
        let corner = ((from_parent >> 2u) << 5u) + (((from_parent >> 1u) & 1u) << 3u) + ((from_parent & 1u) << 1u);
        for (var k = 0u; k < 8u; k++) {
            let child = corner + ((k >> 2u) << 4u) + (((k >> 1u) & 1u) << 2u) + (k & 1u);
            sum += vec4<f32>(of_cell(child, column), of_cell(child, 3u + column), of_cell(child, 6u + column), of_cell(child, 9u));
        }
    }
    return sum;
}

// A cell's entry of m C, row by row, or its mass behind them.
fn of_cell(cell: u32, k: u32) -> f32 {
    return tile[cell * 5u + (k >> 1u)][k & 1u];
}
