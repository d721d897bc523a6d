// What damping dissipates, summed: within a workgroup in the order of threads, then in whole units, whose sums do not depend on who comes first.

var<workgroup> damped_by: array<f32, 128>;
// Of the thread's particles on the first one's layer [J].
var<private> damped_there: f32;

// Adds an energy [J] to that of a layer: four digits of 32 bits, the least of which counts 2^-80 J.
fn book_damped(layer: u32, energy: f32) {
    var weight = 7.9228163e28;
    var rest = min(energy * 1.2089258e24, 1e37);
    var digits: vec4<u32>;
    for (var k = 4u; k > 0u; k--) {
        let digit = floor(rest / weight);
        rest -= digit * weight;
        digits[k - 1u] = u32(digit);
        weight *= 2.3283064e-10;
    }
    var carry = 0u;
    for (var k = 0u; k < 4u; k++) {
        let more = digits[k] + carry;
        // Else it is 2^32: nothing, and the same carry.
        if more >= carry && more > 0u {
            let before = atomicAdd(&status[sum_word(layer, DAMPED + k)], more);
            carry = u32(before > 0xffffffffu - more);
        }
    }
}

fn see_damped(is_first: bool) {
    if is_first {
        damped_there += damped_now;
    } else if damped_now > 0.0 {
        book_damped(layer_now, damped_now);
    }
}

// Once all threads have noted theirs.
fn book_all_damped(layer: u32) {
    var sum = 0.0;
    for (var t = 0u; t < 128u; t++) {
        sum += damped_by[t];
    }
    if sum > 0.0 {
        book_damped(layer, sum);
    }
}
