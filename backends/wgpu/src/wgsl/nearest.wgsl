// The particles nearest to points, a workgroup a point; of several as near, that with the least number.
//
// The buffer is that of `apart.wgsl`. In a point's place come its particle's cell with its tag and its place in there, its block, its level, its number, and one if there is any.
const HEAD: u32 = 16u;
const POINT: u32 = 12u;
const FAR: f32 = 3e38;

// Squared distance [finest cells], number, slot and block of a particle.
struct Closest {
    square: f32,
    id: u32,
    slot: u32,
    block: u32,
}

var<workgroup> begins_with: u32;
// The least squared distance so far, as bits: numbers that are not negative are ordered as their bits are.
var<workgroup> least: atomic<u32>;
var<workgroup> listed: atomic<u32>;
var<workgroup> candidates: array<u32, 64>;
var<workgroup> count: u32;
var<workgroup> closest: array<Closest, 64>;

// How near to a point a particle of a block can be: squared distance [finest cells], FAR where none counts, being of another level. It is within two cells of its block, which is four
// cells wide.
fn least_of(b: u32, cell: vec3<i32>, offset: vec3<f32>) -> f32 {
    let layer = u32(lists[b * ENTRY].w);
    let level = level_of(layer);
    if probed_word(4u) != NONE && probed_word(4u) != level {
        return FAR;
    }
    let low = vec3<f32>(((4 * lists[b * ENTRY].xyz - vec3<i32>(2)) << vec3<u32>(level)) - cell) - offset;
    let gap = max(max(low, -(low + vec3<f32>(8.0 / shrink_of(layer)))), vec3<f32>(0.0));
    return 0.99999 * dot(gap, gap);
}

// Takes up nearer particles of a block, each thread its own.
fn search(b: u32, n: u32, cell: vec3<i32>, offset: vec3<f32>) {
    let layer = u32(lists[b * ENTRY].w);
    let level = vec3<u32>(level_of(layer));
    let width = 1.0 / shrink_of(layer);
    let own = 4 * lists[b * ENTRY].xyz;
    var mine = closest[n];
    let end = cells[b * 64u + 64u];
    for (var q = cells[b * 64u] + n; q < end; q += 64u) {
        let p = record_of(q, 0u);
        let inside = vec3<f32>(p.xyz >> vec3<u32>(8u)) * 5.9604645e-8 * width;
        let away = vec3<f32>(((own + cell_of(p.w)) << level) - cell) + (inside - offset);
        let square = dot(away, away);
        let is_nearer = square < mine.square || (square == mine.square && ids[q].x < mine.id);
        if is_nearer && is_taken(probed_word(2u), probed_word(3u), law_of(p.w), ids[q].y) {
            mine = Closest(square, ids[q].x, q, b);
        }
    }
    closest[n] = mine;
    atomicMin(&least, bitcast<u32>(mine.square));
}

@compute @workgroup_size(64)
fn find_nearest(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let i = group.y * extent.row + group.x;
    let at = HEAD + POINT * min(i, probed_word(12u) - 1u);
    let cell = bitcast<vec3<i32>>(vec3<u32>(probed_word(at), probed_word(at + 1u), probed_word(at + 2u)));
    let offset = probed_vector(at + 3u);
    if n == 0u {
        count = probed_word(1u) - probed_word(0u);
    }
    let blocks = workgroupUniformLoad(&count);
    let first = probed_word(0u);
    // First the block that comes nearest, so that most others need no look.
    var near = Closest(FAR, NONE, NONE, NONE);
    for (var b = first + n; b < first + blocks; b += 64u) {
        let square = least_of(b, cell, offset);
        if square < near.square {
            near = Closest(square, NONE, NONE, b);
        }
    }
    closest[n] = near;
    workgroupBarrier();
    if n == 0u {
        for (var t = 1u; t < 64u; t++) {
            if closest[t].square < near.square {
                near = closest[t];
            }
        }
        begins_with = near.block;
        atomicStore(&least, bitcast<u32>(FAR));
    }
    let begins = workgroupUniformLoad(&begins_with);
    closest[n] = Closest(FAR, NONE, NONE, NONE);
    if begins != NONE {
        search(begins, n, cell, offset);
    }
    for (var past = 0u; past < blocks; past += 64u) {
        if n == 0u {
            atomicStore(&listed, 0u);
        }
        workgroupBarrier();
        let b = first + past + n;
        if b < first + blocks && b != begins {
            let square = least_of(b, cell, offset);
            if square < FAR && square <= bitcast<f32>(atomicLoad(&least)) {
                candidates[atomicAdd(&listed, 1u)] = b;
            }
        }
        workgroupBarrier();
        if n == 0u {
            count = atomicLoad(&listed);
        }
        let all = workgroupUniformLoad(&count);
        for (var k = 0u; k < all; k++) {
            search(candidates[k], n, cell, offset);
        }
    }
    workgroupBarrier();
    if n == 0u && i < probed_word(12u) {
        var best = closest[0];
        for (var t = 1u; t < 64u; t++) {
            let other = closest[t];
            if other.square < best.square || (other.square == best.square && other.id < best.id) {
                best = other;
            }
        }
        atomicStore(&probed[at + 9u], u32(best.slot != NONE));
        if best.slot != NONE {
            let place = record_of(best.slot, 0u);
            for (var d = 0u; d < 4u; d++) {
                atomicStore(&probed[at + d], place[d]);
            }
            for (var d = 0u; d < 3u; d++) {
                atomicStore(&probed[at + 4u + d], bitcast<u32>(lists[best.block * ENTRY][d]));
            }
            atomicStore(&probed[at + 7u], level_of(u32(lists[best.block * ENTRY].w)));
            atomicStore(&probed[at + 8u], best.id);
        }
    }
}
