// Heights of the ground at points, a workgroup each: the greatest upper end of a particle at which particles fill half of space, as `Simulation::heights` says.
//
// The eighth and ninth word of the buffer say where the points stand there, and how many they are. Of each are given its cell, in finest cells, the z of which is where
// heights count from, its place in there along x and y, and its world's first block and one past the last; in the first word comes the height in finest cells, as bits.
const POINT: u32 = 8u;
const HEIGHTS: u32 = 7u;
// Particles over and under a point; with more the host has to look.
const MOST: u32 = 1024u;
const UNKNOWN: u32 = 0xffffffffu;
// Shares of space are whole parts of it, so that their sum does not depend on their order.
const PARTS: f32 = 1048576.0;

var<workgroup> count: atomic<u32>;
var<workgroup> highest: atomic<u32>;
var<workgroup> ends: array<vec2<f32>, MOST>;
var<workgroup> shares: array<u32, MOST>;

// The width of a particle that is a cube at rest [finest cells].
fn side_of(q: u32) -> f32 {
    let h = extent.world.cell;
    let volume = rest_of(q, REST - 1u).w / (h * h * h);
    let side = pow(volume, 1.0 / 3.0);
    // Powers are less exact than roots.
    return side - (side - volume / (side * side)) / 3.0;
}

// Takes down where a particle begins and ends, and its share of the space around the point.
fn put(q: u32, from_point: vec3<f32>) {
    let side = side_of(q);
    let beside = max(vec2<f32>(1.0) - abs(from_point.xy) / side, vec2<f32>(0.0));
    let share = u32(beside.x * beside.y * PARTS + 0.5);
    if share > 0u {
        let at = atomicAdd(&count, 1u);
        if at < MOST {
            ends[at] = vec2<f32>(from_point.z - 0.5 * side, from_point.z + 0.5 * side);
            shares[at] = share;
        }
    }
}

@compute @workgroup_size(64)
fn find_heights(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let i = group.y * extent.row + group.x;
    let at = looked[HEIGHTS] + POINT * min(i, looked[HEIGHTS + 1u] - 1u);
    let cell = bitcast<vec3<i32>>(vec3<u32>(looked[at], looked[at + 1u], looked[at + 2u]));
    let offset = vec3<f32>(bitcast<f32>(looked[at + 3u]), bitcast<f32>(looked[at + 4u]), 0.0);
    let end = looked[at + 6u];
    for (var b = looked[at + 5u]; b < end; b++) {
        let layer = u32(lists[b * ENTRY].w);
        let level = vec3<u32>(level_of(layer));
        let width = 1.0 / shrink_of(layer);
        let own = 4 * lists[b * ENTRY].xyz;
        let first = image_near(layer, own, vec3<i32>(cell.xy >> level.xy, own.z));
        // A block's particles are within two cells of it, which is four cells wide; and none is wider than the widest cells.
        let away = abs(vec2<f32>(((first.xy + vec2<i32>(2)) << level.xy) - cell.xy) - offset.xy);
        if any(away > vec2<f32>(5.0 * width + f32(1u << (LEVELS - 1u)))) {
            continue;
        }
        for (var q = cells[b * 64u] + n; q < cells[b * 64u + 64u]; q += 64u) {
            let p = record_of(q, 0u);
            let in_cell = vec3<f32>(p.xyz >> vec3<u32>(8u)) * 5.9604645e-8 * width;
            put(q, vec3<f32>(((first + cell_of(p.w)) << level) - cell) + (in_cell - offset));
        }
    }
    workgroupBarrier();
    let all = min(atomicLoad(&count), MOST);
    for (var k = n; k < all; k += 64u) {
        let top = ends[k].y;
        var filled = 0u;
        for (var other = 0u; other < all; other++) {
            let from_to = ends[other];
            filled += select(0u, shares[other], from_to.x < top && top <= from_to.y);
        }
        if filled >= u32(0.5 * PARTS) {
            // Numbers above zero are ordered as their bits are; nothing ends lower than heights count from.
            atomicMax(&highest, bitcast<u32>(max(top, 0.0)));
        }
    }
    workgroupBarrier();
    if n == 0u && i < looked[HEIGHTS + 1u] {
        looked[at] = select(atomicLoad(&highest), UNKNOWN, atomicLoad(&count) > MOST);
    }
}
