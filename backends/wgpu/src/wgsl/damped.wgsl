// What damping dissipates, summed: within a workgroup in the order of threads, then in whole units, whose sums do not depend on who comes first.

var<workgroup> damped_by: array<f32, 128>;
// Of the thread's particles on the first one's layer [J].
var<private> damped_there: f32;

// Adds an energy [J] to that of a layer.
fn book_damped(layer: u32, energy: f32) {
    let digits = digits_of(energy);
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
