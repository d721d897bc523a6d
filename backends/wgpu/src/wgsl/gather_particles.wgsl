// The particles in the boxes, where a law asks for them, in blocks of their own among those of nodes: how many, their layer, and NONE for a number; and
// of each its cell with its tag, and its place in there with its mass.
const EACH: u32 = (NEAR_BLOCK - 1u) / 2u;

var<workgroup> go: u32;
var<workgroup> found: atomic<u32>;
var<workgroup> put: atomic<u32>;
var<workgroup> slot: u32;

fn is_near(layer: u32, cell: vec3<i32>) -> bool {
    let boxes = u32(around[0].x);
    for (var b = 0u; b < boxes; b++) {
        let at = 1u + 2u * (layer * boxes + b);
        if all(cell >= around[at].xyz) && all(cell <= around[at + 1u].xyz) && around[at].w != 0 {
            return true;
        }
    }
    return false;
}

@compute @workgroup_size(64)
fn gather_particles(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = group.y * extent.row + group.x;
    if n == 0u {
        go = 0u;
        if atomicLoad(&status[HALTED]) == 0u && b < atomicLoad(&status[BLOCKS]) {
            go = u32(is_live(u32(lists[b * ENTRY].w)));
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let layer = u32(lists[b * ENTRY].w);
    let first = lists[b * ENTRY].xyz * 4;
    let count = cells[b * 64u + n + 1u] - cells[b * 64u + n];
    var own = 0u;
    for (var r = 0u; r < count; r++) {
        own += u32(is_near(layer, first + cell_of(record_of(slot_of(b, n, r), 0u).w)));
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
        if is_near(layer, cell) {
            let to = atomicAdd(&put, 1u);
            let at = (start + to / EACH) * NEAR_BLOCK + 1u + 2u * (to % EACH);
            near[at] = vec4<u32>(bitcast<vec3<u32>>(cell), law_of(place.w));
            near[at + 1u] = vec4<u32>(place.xyz >> vec3<u32>(8u), record_of(q, 1u).w);
        }
    }
}
