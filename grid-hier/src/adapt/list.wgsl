// Lists the particles that were found, cell by cell; where stress stands in a record, each one's copy has its cell and layer.
@compute @workgroup_size(64)
fn list_found(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) cell: u32) {
    let b = group.y * extent.row + group.x;
    var all = 0u;
    if b < atomicLoad(&status[BLOCKS]) && sums[b].y > 0u {
        all = cells[b * 64u + cell + 1u] - cells[b * 64u + cell];
    }
    var count = 0u;
    for (var rank = 0u; rank < all; rank++) {
        count += loose[slot_of(b, cell, rank)];
    }
    partial[cell] = vec2<u32>(count, 0u);
    workgroupBarrier();
    if count == 0u {
        return;
    }
    var next = sums[b].x;
    for (var t = 0u; t < cell; t++) {
        next += partial[t].x;
    }
    let place = lists[b * ENTRY];
    for (var rank = 0u; rank < all; rank++) {
        let q = slot_of(b, cell, rank);
        if loose[q] != 0u {
            order[next] = q;
            let at = 4 * place.xyz + cell_of(record_of(q, 0u).w);
            set_new_record(next, 5u, vec4<u32>(bitcast<vec3<u32>>(at), u32(place.w)));
            next++;
        }
    }
}
