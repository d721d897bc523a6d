// A number that is not negative in whole units, whose sums do not depend on who comes first: four digits of 32 bits, the least of which counts 2^-80.
fn digits_of(number: f32) -> vec4<u32> {
    var weight = 7.9228163e28;
    var rest = min(number * 1.2089258e24, 1e37);
    var digits: vec4<u32>;
    for (var k = 4u; k > 0u; k--) {
        let digit = floor(rest / weight);
        rest -= digit * weight;
        digits[k - 1u] = u32(digit);
        weight *= 2.3283064e-10;
    }
    return digits;
}
