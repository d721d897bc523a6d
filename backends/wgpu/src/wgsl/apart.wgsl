// Sum of the distances of particles to the nearest of points, a workgroup a block; within one in the order of threads, then in whole units.
//
// The buffer begins with the world's first block and one past its last; which particles count: their material, body and level; the bins: how many along
// each axis, the cell where they begin, how wide they are, all in finest cells; how many points there are, where the bins' first points are noted, and where the
// sums stand, particles and their distances [finest cells]. Then follow the points, bin by bin, which are bins along x first: each has its cell, and its place in there.
const HEAD: u32 = 16u;
const POINT: u32 = 12u;
const FAR: f32 = 3e38;

struct Bins {
    count: vec3<i32>,
    first: vec3<i32>,
    width: i32,
    starts: u32,
}

// The squared distance to the nearest of some points.
fn among(bins: Bins, first: vec3<i32>, last: vec3<i32>, cell: vec3<i32>, offset: vec3<f32>) -> f32 {
    let start = (first.z * bins.count.y + first.y) * bins.count.x + first.x;
    let to = (last.z * bins.count.y + last.y) * bins.count.x + last.x;
    let end = probed_word(bins.starts + u32(to) + 1u);
    var least = FAR;
    for (var i = probed_word(bins.starts + u32(start)); i < end; i++) {
        let at = HEAD + POINT * i;
        let its_cell = bitcast<vec3<i32>>(vec3<u32>(probed_word(at), probed_word(at + 1u), probed_word(at + 2u)));
        let away = vec3<f32>(cell - its_cell) + (offset - probed_vector(at + 3u));
        least = min(least, dot(away, away));
    }
    return least;
}

// That of the bins so many bins from one along some axis.
fn in_shell(bins: Bins, own: vec3<i32>, shell: i32, cell: vec3<i32>, offset: vec3<f32>) -> f32 {
    let low = max(own - vec3<i32>(shell), vec3<i32>(0));
    let high = min(own + vec3<i32>(shell), bins.count - vec3<i32>(1));
    var least = FAR;
    for (var k = low.z; k <= high.z; k++) {
        for (var j = low.y; j <= high.y; j++) {
            if abs(k - own.z) == shell || abs(j - own.y) == shell {
                // The bins of a row follow one another.
                least = min(least, among(bins, vec3<i32>(low.x, j, k), vec3<i32>(high.x, j, k), cell, offset));
                continue;
            }
            for (var side = -1; side < 2; side += 2) {
                let end = vec3<i32>(own.x + side * shell, j, k);
                if end.x >= low.x && end.x <= high.x {
                    least = min(least, among(bins, end, end, cell, offset));
                }
            }
        }
    }
    return least;
}

// Distance to the nearest point [finest cells], as `Nearest::distance` says.
fn to_nearest(bins: Bins, cell: vec3<i32>, offset: vec3<f32>) -> f32 {
    let width = f32(bins.width);
    let place = vec3<f32>(cell - bins.first) + offset;
    let own = clamp(vec3<i32>(floor(place / width)), vec3<i32>(0), bins.count - vec3<i32>(1));
    let away = max(max(-place, place - vec3<f32>(bins.count) * width), vec3<f32>(0.0));
    let shells = max(bins.count.x, max(bins.count.y, bins.count.z));
    var least = FAR;
    for (var shell = 0; shell < shells; shell++) {
        least = min(least, in_shell(bins, own, shell, cell, offset));
        var beyond = FAR;
        for (var d = 0; d < 3; d++) {
            let beside = dot(away, away) - away[d] * away[d];
            // What rounding may make of a place.
            let sure = 1e-6 * abs(place[d]);
            if own[d] > shell {
                let side = max(place[d] - f32(own[d] - shell) * width - sure, 0.0);
                beyond = min(beyond, side * side + beside);
            }
            if own[d] + shell + 1 < bins.count[d] {
                let side = max(f32(own[d] + shell + 1) * width - place[d] - sure, 0.0);
                beyond = min(beyond, side * side + beside);
            }
        }
        if least <= 0.999999 * beyond {
            break;
        }
    }
    return sqrt(least);
}

var<workgroup> found: array<vec2<f32>, 64>;

@compute @workgroup_size(64)
fn sum_distances(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = probed_word(0u) + group.y * extent.row + group.x;
    let here = min(b, extent.block_room - 1u);
    let layer = u32(lists[here * ENTRY].w);
    let level = level_of(layer);
    let width = 1.0 / shrink_of(layer);
    let first = lists[here * ENTRY].xyz * 4;
    let bins = Bins(
        bitcast<vec3<i32>>(vec3<u32>(probed_word(5u), probed_word(6u), probed_word(7u))),
        bitcast<vec3<i32>>(vec3<u32>(probed_word(8u), probed_word(9u), probed_word(10u))),
        i32(probed_word(11u)),
        probed_word(13u),
    );
    let is_of_level = probed_word(4u) == NONE || probed_word(4u) == level;
    let end = select(0u, cells[here * 64u + 64u], b < probed_word(1u) && is_of_level);
    found[n] = vec2<f32>(0.0);
    for (var q = cells[here * 64u] + n; q < end; q += 64u) {
        let p = record_of(q, 0u);
        if is_taken(probed_word(2u), probed_word(3u), law_of(p.w), ids[q].y) {
            // Of a coarse cell's inside, whole finest cells first.
            let inside = vec3<f32>(p.xyz >> vec3<u32>(8u)) * 5.9604645e-8 * width;
            let cell = ((first + cell_of(p.w)) << vec3<u32>(level)) + vec3<i32>(floor(inside));
            found[n] += vec2<f32>(1.0, to_nearest(bins, cell, inside - floor(inside)));
        }
    }
    workgroupBarrier();
    if n < 2u {
        var total = 0.0;
        for (var t = 0u; t < 64u; t++) {
            total += found[t][n];
        }
        if total != 0.0 {
            add_exactly(probed_word(14u) + 4u * n, total);
        }
    }
}
