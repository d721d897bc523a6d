// Mass and m C of a block's particles, by the parent cell (2x2x2 cells) in which they were sorted: for each of the eight, the columns of
// m C [kg m/s a cell], with the mass behind the first.

// What each cell holds: mass, and the rows of m C.
var<workgroup> rows: array<array<vec4<f32>, 3>, 64>;

@compute @workgroup_size(64)
fn sum_parent_cells(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    let here = min(b, extent.block_room - 1u);
    let layer = u32(lists[here * ENTRY].w);
    let fits = atomicLoad(&status[HALTED]) == 0u && b < atomicLoad(&status[BLOCKS]);
    let go = fits && rims[extent.node_room + here].x != 0u && is_live(layer);
    var x = vec4<f32>(0.0);
    var y = vec4<f32>(0.0);
    var z = vec4<f32>(0.0);
    if go {
        let width = H / shrink_of(layer);
        for (var q = cells[here * 64u + thread]; q < cells[here * 64u + thread + 1u]; q++) {
            let m = bitcast<f32>(record[vector(q, 1u)].w);
            let of_mass = m * width;
            x += vec4<f32>(of_mass * bitcast<vec4<f32>>(record[vector(q, 2u)]).yzw, m);
            y += vec4<f32>(of_mass * bitcast<vec4<f32>>(record[vector(q, 3u)]).yzw, 0.0);
            z += vec4<f32>(of_mass * bitcast<vec4<f32>>(record[vector(q, 4u)]).yzw, 0.0);
        }
    }
    rows[thread][0] = x;
    rows[thread][1] = y;
    rows[thread][2] = z;
    workgroupBarrier();
    if !go || thread >= 24u {
        return;
    }
    let parent = thread / 3u;
    let column = thread % 3u;
    let first = ((parent >> 2u) << 5u) + (((parent >> 1u) & 1u) << 3u) + ((parent & 1u) << 1u);
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < 8u; k++) {
        let cell = first + ((k >> 2u) << 4u) + (((k >> 1u) & 1u) << 2u) + (k & 1u);
        sum += vec4<f32>(rows[cell][0][column], rows[cell][1][column], rows[cell][2][column], rows[cell][0].w);
    }
    handed[of_parent_cell(b, parent, column)] = sum;
}
