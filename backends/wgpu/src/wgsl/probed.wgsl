// Where probes look, and what they find, in one buffer of words. A place, in cells of a layer, is PLACE words: the cell of its middle, its kind, the middle's
// place in that cell, the material that counts, half its width along the axes, the body that counts, and for sections the normal.
const PLACE: u32 = 16u;
// Kinds: a box or rectangle, a sphere or disc, an upright cylinder, and nothing.
const SQUARE: u32 = 0u;
const ROUND: u32 = 1u;
const UPRIGHT: u32 = 2u;
const NOWHERE: u32 = 3u;

struct Place {
    cell: vec3<i32>,
    kind: u32,
    offset: vec3<f32>,
    material: u32,
    half: vec3<f32>,
    body: u32,
    normal: vec3<f32>,
}

fn probed_word(at: u32) -> u32 {
    return atomicLoad(&probed[at]);
}

fn probed_vector(at: u32) -> vec3<f32> {
    return bitcast<vec3<f32>>(vec3<u32>(probed_word(at), probed_word(at + 1u), probed_word(at + 2u)));
}

fn place_at(at: u32) -> Place {
    let cell = bitcast<vec3<i32>>(vec3<u32>(probed_word(at), probed_word(at + 1u), probed_word(at + 2u)));
    let kind = probed_word(at + 3u);
    return Place(cell, kind, probed_vector(at + 4u), probed_word(at + 7u), probed_vector(at + 8u), probed_word(at + 11u), probed_vector(at + 12u));
}

// From the middle of a place to a particle [cells].
fn from_middle(p: Place, cell: vec3<i32>, offset: vec3<u32>) -> vec3<f32> {
    return vec3<f32>(cell - p.cell) + (vec3<f32>(offset >> vec3<u32>(8u)) * 5.9604645e-8 - p.offset);
}

// Does a particle count, where only such a material and body do, or any?
fn is_taken(only_material: u32, only_body: u32, material: u32, body: u32) -> bool {
    return (only_material == NONE || only_material == material) && (only_body == NONE || only_body == body);
}

fn is_counted(p: Place, material: u32, body: u32) -> bool {
    return is_taken(p.material, p.body, material, body);
}

// Adds digits to a sum of four words, and perhaps one more.
fn add_digits(at: u32, digits: vec4<u32>, one_more: bool) {
    var carry = u32(one_more);
    for (var k = 0u; k < 4u; k++) {
        let more = digits[k] + carry;
        // Else it is 2^32, or nothing: nothing, and the same carry.
        if more >= carry && more > 0u {
            let before = atomicAdd(&probed[at + k], more);
            carry = u32(before > 0xffffffffu - more);
        }
    }
}

// Adds a number to a sum of four words: below zero, all digits are turned and one is added.
fn add_exactly(at: u32, number: f32) {
    let digits = digits_of(abs(number));
    add_digits(at, select(digits, ~digits, number < 0.0), number < 0.0);
}
