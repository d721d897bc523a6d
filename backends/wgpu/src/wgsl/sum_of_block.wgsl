
// The sum over the nodes of this thread's block, for the first of its threads.
fn sum_of_block(n: u32, impulse: vec3<f32>) -> vec4<f32> {
    let own = 64u * abreast;
    exchange[own + n] = vec4<f32>(impulse, 0.0);
    workgroupBarrier();
    if n < 8u {
        for (var t = 1u; t < 8u; t++) {
            exchange[own + n] += exchange[own + n + 8u * t];
        }
    }
    workgroupBarrier();
    var total = vec4<f32>(0.0);
    if n == 0u {
        for (var t = 0u; t < 8u; t++) {
            total += exchange[own + t];
        }
    }
    return total;
}
