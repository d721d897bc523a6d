// Adds what rims have given to parts of walls in a step that is short enough, and begins anew: for the 64 threads of one workgroup.
fn take_up(thread: u32) {
    for (var i = thread; i < LAYERS / LEVELS * PARTS * 3u; i += 64u) {
        let at = sums_of_part(i / (PARTS * 3u), i / 3u % PARTS) + 4u * (i % 3u);
        var digits: vec4<u32>;
        for (var k = 0u; k < 4u; k++) {
            digits[k] = atomicExchange(&probed[at + PENDING_PART + k], 0u);
        }
        add_digits(at, digits, false);
    }
}

