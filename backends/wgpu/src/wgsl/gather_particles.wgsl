// The particles in the boxes, where a law asks for them, in blocks of their own among those of nodes: how many, their layer, and NONE for a number; and
// of each its cell with its tag, and its place in there with its mass.
const EACH: u32 = (NEAR_BLOCK - 1u) / 2u;

var<workgroup> go: u32;
var<workgroup> found: atomic<u32>;
var<workgroup> put: atomic<u32>;
var<workgroup> slot: u32;

// Is there anything between two cells of a layer that is asked for?
fn is_asked_for(layer: u32, least: vec3<i32>, most: vec3<i32>) -> bool {
    let boxes = u32(around[0].x);
    for (var b = 0u; b < boxes; b++) {
        let at = 1u + 2u * (layer * boxes + b);
        // By how much the image is off whose middle is nearest to that of the box.
        let start = middle_of(least, most) - vec3<i32>(2);
        let off = image_near(layer, start, middle_of(around[at].xyz, around[at + 1u].xyz)) - start;
        if all(most + off >= around[at].xyz) && all(least + off <= around[at + 1u].xyz) && around[at].w != 0 {
            return true;
        }
    }
    return false;
}

@compute @workgroup_size(64)
fn gather_particles(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = group.y * extent.row + group.x;
    let entry = min(b, extent.block_room - 1u) * ENTRY;
    let layer = u32(lists[entry].w);
    let first = lists[entry].xyz * 4;
    if n == 0u {
        go = u32(atomicLoad(&status[HALTED]) == 0u && b < atomicLoad(&status[BLOCKS]) && is_live(layer));
        // Tags tell of cells up to two beyond the block.
        if go == 1u {
            go = u32(is_asked_for(layer, first - vec3<i32>(2), first + vec3<i32>(5)));
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let count = cells[b * 64u + n + 1u] - cells[b * 64u + n];
    var own = 0u;
    for (var r = 0u; r < count; r++) {
        let cell = first + cell_of(record_of(slot_of(b, n, r), 0u).w);
        own += u32(is_asked_for(layer, cell, cell));
    }
    atomicAdd(&found, own);
    workgroupBarrier();
    let all_found = atomicLoad(&found);
    if n == 0u && all_found > 0u {
        slot = atomicAdd(&status[NEAR], (all_found + EACH - 1u) / EACH);
    }
    let start = workgroupUniformLoad(&slot);
    // The host finds out how many there are, and makes room.
    let room = arrayLength(&near) / NEAR_BLOCK;
    if all_found == 0u || start + (all_found + EACH - 1u) / EACH > room {
        return;
    }
    for (var at = n * EACH; at < all_found; at += 64u * EACH) {
        near[(start + at / EACH) * NEAR_BLOCK] = vec4<u32>(min(all_found - at, EACH), layer, 0u, NONE);
    }
    for (var r = 0u; r < count; r++) {
        let q = slot_of(b, n, r);
        let place = record_of(q, 0u);
        let cell = first + cell_of(place.w);
        if is_asked_for(layer, cell, cell) {
            let to = atomicAdd(&put, 1u);
            let at = (start + to / EACH) * NEAR_BLOCK + 1u + 2u * (to % EACH);
            near[at] = vec4<u32>(bitcast<vec3<u32>>(cell), law_of(place.w));
            near[at + 1u] = vec4<u32>(place.xyz >> vec3<u32>(8u), record_of(q, 1u).w);
        }
    }
}
