// Lists the particles that were found, in their order; where stress stands in a record, each one's copy has its cell and layer.
@compute @workgroup_size(128)
fn list_found(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    var start = 0u;
    var end = 0u;
    if b < atomicLoad(&status[BLOCKS]) && sums[b].y > 0u {
        start = cells[b * 64u];
        end = cells[b * 64u + 64u];
    }
    let each = (end - start + 127u) / 128u;
    let source = min(start + thread * each, end);
    let to = min(source + each, end);
    var count = 0u;
    for (var q = source; q < to; q++) {
        count += loose[q];
    }
    partial[thread] = vec2<u32>(count, 0u);
    workgroupBarrier();
    if source == to {
        return;
    }
    var next = sums[b].x;
    for (var t = 0u; t < thread; t++) {
        next += partial[t].x;
    }
    let place = lists[b * ENTRY];
    for (var q = source; q < to; q++) {
        if loose[q] != 0u {
            order[next] = q;
            let cell = 4 * place.xyz + cell_of(record[vector(q, 0u)].w);
            new_record[vector(next, 5u)] = vec4<u32>(bitcast<vec3<u32>>(cell), u32(place.w));
            next++;
        }
    }
}
