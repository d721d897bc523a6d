// Which cells of each block are at least half full: the block and its layer, then 64 bits. All particles have just been sorted.
var<workgroup> full: array<atomic<u32>, 2>;

@compute @workgroup_size(64)
fn fill(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = group.y * extent.row + group.x;
    let exists = b < atomicLoad(&status[BLOCKS]);
    if exists {
        let h = extent.world.cell;
        let per_cell = ldexp(1.0 / (h * h * h), -3 * i32(level_of(u32(lists[b * ENTRY].w))));
        var part = 0.0;
        let count = cells[b * 64u + n + 1u] - cells[b * 64u + n];
        for (var rank = 0u; rank < count; rank++) {
            part += rest_of(slot_of(b, n, rank), REST - 1u).w * per_cell;
        }
        if part >= 0.5 {
            atomicOr(&full[n >> 5u], 1u << (n & 31u));
        }
    }
    workgroupBarrier();
    if exists && n == 0u {
        filled[2u * b] = bitcast<vec4<u32>>(lists[b * ENTRY]);
        filled[2u * b + 1u] = vec4<u32>(atomicLoad(&full[0]), atomicLoad(&full[1]), 0u, 0u);
    }
}
