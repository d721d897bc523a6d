
// What particles of a block that have left the world gave, one thread after the other: impulse [N s] and mass [kg].
var<workgroup> left: array<vec4<f32>, 128>;

// The block's sum stands where what walls would give in a step stands, which nobody asks for in a sort.
fn note_left(b: u32, thread: u32, mine: vec4<f32>) {
    left[thread] = mine;
    workgroupBarrier();
    if thread == 0u {
        var sum = vec4<f32>(0.0);
        for (var t = 0u; t < 128u; t++) {
            sum += left[t];
        }
        lists[b * ENTRY + PENDING] = bitcast<vec4<i32>>(sum);
    }
}

// Puts a particle back to the edge of the world, and takes what speed it has outwards: the impulse [N s].
fn put_back(q: u32, layer: u32, block: vec3<i32>, local: ptr<function, vec3<i32>>) -> vec4<f32> {
    var p = record_of(q, 0u);
    let mass = bitcast<f32>(record_of(q, 1u).w);
    let first = world_min(layer);
    let last = world_max(layer) - vec3<i32>(1);
    var impulse = vec4<f32>(0.0);
    for (var d = 0u; d < 3u; d++) {
        let cell = 4 * block[d] + (*local)[d];
        let low = cell < first[d];
        if !IS_PERIODIC[d] && (low || cell > last[d]) {
            (*local)[d] = select(last[d], first[d], low) - 4 * block[d];
            p[d] = select(0xfffffe00u, 0u, low);
            var row = record_of(q, 2u + d);
            let v = bitcast<f32>(row.x);
            if select(v > 0.0, v < 0.0, low) {
                impulse[d] -= mass * v;
                row.x = 0u;
                set_record(q, 2u + d, row);
            }
            atomicAdd(&status[sum_word(layer, LEFT)], 1u);
        }
    }
    set_record(q, 0u, vec4<u32>(p.xyz, tag_at(p.w, *local, p.xyz)));
    return impulse;
}
