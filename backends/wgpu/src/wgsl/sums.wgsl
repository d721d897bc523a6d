// Sums over the particles in regions of worlds that follow one another, a workgroup a block: 13 numbers of four words each, which are particles, mass, rest volume, volume, momentum,
// and rest volume times Kirchhoff stress. Within a workgroup in the order of threads, then in whole units.
//
// The buffer begins with the worlds' first block, one past their last, their first layer, the number of regions of each world, and the number of layers; then,
// layer by layer, stand the regions, and, world by world, the sums.
const HEAD: u32 = 16u;
const SUMMED: u32 = 13u;

var<workgroup> go: u32;
var<workgroup> count: u32;
var<workgroup> found: array<array<f32, SUMMED>, 64>;

// Value k of a particle's strain, less that at rest.
fn strain_of(q: u32, k: u32) -> f32 {
    let values = rest_of(q, k >> 2u);
    return values[k & 3u];
}

// How many times its rest volume a particle has: of F, or of the left Cauchy-Green tensor.
fn volume_ratio(q: u32, law: u32) -> f32 {
    let one = mat3x3<f32>(vec3<f32>(1.0, 0.0, 0.0), vec3<f32>(0.0, 1.0, 0.0), vec3<f32>(0.0, 0.0, 1.0));
    var strain: mat3x3<f32>;
    if has_def_grad(law) {
        for (var k = 0u; k < 9u; k++) {
            strain[k / 3u][k % 3u] = strain_of(q, k);
        }
        return determinant(one + strain);
    }
    let xy = strain_of(q, 3u);
    let xz = strain_of(q, 4u);
    let yz = strain_of(q, 5u);
    strain = mat3x3<f32>(vec3<f32>(strain_of(q, 0u), xy, xz), vec3<f32>(xy, strain_of(q, 1u), yz), vec3<f32>(xz, yz, strain_of(q, 2u)));
    return sqrt(max(determinant(one + strain), 0.0));
}

fn is_in(region: Place, r: vec3<f32>) -> bool {
    let part = r / region.half;
    switch region.kind {
        case SQUARE: { return all(abs(part) < vec3<f32>(1.0)); }
        case ROUND: { return dot(part, part) < 1.0; }
        case UPRIGHT: { return dot(part.xy, part.xy) < 1.0 && abs(part.z) < 1.0; }
        default: { return false; }
    }
}

fn look(q: u32, n: u32, region: Place, first: vec3<i32>) {
    let p = record_of(q, 0u);
    if !is_in(region, from_middle(region, first + cell_of(p.w), p.xyz)) || !is_counted(region, law_of(p.w), ids[q].y) {
        return;
    }
    let shear = bitcast<vec4<f32>>(record_of(q, 1u));
    let normal = bitcast<vec4<f32>>(record_of(q, 5u));
    let volume = rest_of(q, REST - 1u).w;
    found[n][0] += 1.0;
    found[n][1] += shear.w;
    found[n][2] += volume;
    found[n][3] += volume * volume_ratio(q, law_of(p.w));
    for (var d = 0u; d < 3u; d++) {
        found[n][4u + d] += shear.w * bitcast<f32>(record_of(q, 2u + d).x);
    }
    found[n][7] += normal.x;
    found[n][8] += normal.y;
    found[n][9] += shear.z;
    found[n][10] += normal.z;
    found[n][11] += shear.x;
    found[n][12] += shear.y;
}

@compute @workgroup_size(64)
fn sum_regions(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = probed_word(0u) + group.y * extent.row + group.x;
    let here = min(b, extent.block_room - 1u);
    let layer = u32(lists[here * ENTRY].w) - probed_word(2u);
    let first = lists[here * ENTRY].xyz * 4;
    let start = cells[here * 64u];
    let end = cells[here * 64u + 64u];
    if n == 0u {
        count = probed_word(3u);
    }
    let regions = workgroupUniformLoad(&count);
    for (var s = 0u; s < regions; s++) {
        let region = place_at(HEAD + PLACE * (layer * regions + s));
        if n == 0u {
            // A block's particles are within two cells of it, which is four cells wide.
            let away = abs(from_middle(region, first + vec3<i32>(2), vec3<u32>(0u)));
            go = u32(b < probed_word(1u) && region.kind != NOWHERE && all(away < region.half + vec3<f32>(5.0)));
        }
        if workgroupUniformLoad(&go) != 0u {
            for (var k = 0u; k < SUMMED; k++) {
                found[n][k] = 0.0;
            }
            for (var q = start + n; q < end; q += 64u) {
                look(q, n, region, first);
            }
            workgroupBarrier();
            if n < SUMMED {
                var total = 0.0;
                for (var t = 0u; t < 64u; t++) {
                    total += found[t][n];
                }
                if total != 0.0 {
                    let sums = HEAD + PLACE * probed_word(4u) * regions;
                    add_exactly(sums + 4u * ((layer / LEVELS * regions + s) * SUMMED + n), total);
                }
            }
            workgroupBarrier();
        }
    }
}
