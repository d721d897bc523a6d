
// Which particles split and merge may concern: the host's rule, which then decides, with a little more room for volumes, and as if all
// regions had moved. All have just been sorted, so that a block holds its own cells' particles and no others.

// Levels where all of a block's cells belong: before they are split, and for merging as regions are and as they were; NONE if cells differ.
var<workgroup> of_block: array<u32, 3>;
// Likewise for each of its cells, which as a rule lie on one level even if the block does not.
var<workgroup> of_cell: array<u32, 192>;
var<workgroup> counted: atomic<u32>;

// The finest level whose region, grown by so many parent cells, holds cells of the finest level; NONE if they differ in that.
fn finest(table: u32, layer: u32, first: vec3<i32>, end: vec3<i32>, margin: i32) -> u32 {
    for (var l = 0u; l + 1u < LEVELS; l++) {
        let shift = vec3<u32>(l);
        let part = cover(table, layer - level_of(layer) + l, first >> shift, ((end - vec3<i32>(1)) >> shift) + vec3<i32>(1), 2 * margin);
        if part == ALL {
            return l;
        }
        if part == PART {
            return NONE;
        }
    }
    return LEVELS - 1u;
}

// One of the three levels, for cells of the finest level.
fn level_for(which: u32, layer: u32, first: vec3<i32>, end: vec3<i32>) -> u32 {
    return finest(u32(which == 2u), layer, first, end, select(MERGE_LEFT, SPLIT_AHEAD, which == 0u));
}

// The least rest volume of a class of a body's particles [m3].
fn least_volume(body: u32, class_of_size: u32) -> f32 {
    return select(0.0, ldexp(0.35355339 * finest_volume(body), i32(3u * class_of_size)), class_of_size > 0u);
}

// Does a round concern a particle of a block?
fn concerns(block: vec3<i32>, layer: u32, place: vec4<u32>, body: u32, volume: f32) -> bool {
    let level = level_of(layer);
    let local = cell_of(place.w);
    let n = u32(16 * local.x + 4 * local.y + local.z);
    // Its cell of the finest level.
    let within = (place.xyz >> vec3<u32>(1u)) >> vec3<u32>(31u - level);
    let cell = ((4 * block + local) << vec3<u32>(level)) + vec3<i32>(within);
    var of_this: array<u32, 3>;
    for (var which = 0u; which < 3u; which++) {
        of_this[which] = of_cell[which * 64u + n];
        if of_this[which] == NONE {
            of_this[which] = level_for(which, layer, cell, cell + vec3<i32>(1));
        }
    }
    let home = of_this[0];
    let behind = of_this[1];
    let before = of_this[2];
    let splits = volume >= LESS * least_volume(body, home + 1u);
    let merges = behind > before && volume < MORE * least_volume(body, behind) && volume >= LESS * least_volume(body, before);
    return splits || merges || home != level;
}

// Particles that a thread asks for at a time.
const AT_ONCE: u32 = 4u;

@compute @workgroup_size(128)
fn find_concerned(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    let exists = b < atomicLoad(&status[BLOCKS]);
    var block = vec3<i32>(0);
    var layer = 0u;
    var start = 0u;
    var end = 0u;
    if exists {
        block = lists[b * ENTRY].xyz;
        layer = u32(lists[b * ENTRY].w);
        if is_live(layer) {
            start = cells[b * 64u];
            end = cells[b * 64u + 64u];
        }
    }
    let level = level_of(layer);
    if thread < 3u {
        of_block[thread] = level_for(thread, layer, (4 * block) << vec3<u32>(level), (4 * block + vec3<i32>(4)) << vec3<u32>(level));
    }
    workgroupBarrier();
    for (var i = thread; i < 192u; i += 128u) {
        let which = i / 64u;
        of_cell[i] = of_block[which];
        if of_cell[i] == NONE {
            let cell = (4 * block + local_of(i % 64u)) << vec3<u32>(level);
            of_cell[i] = level_for(which, layer, cell, cell + (vec3<i32>(1) << vec3<u32>(level)));
        }
    }
    workgroupBarrier();
    // Several at a time, so that no thread waits for one before it asks for the next: a block under a footprint holds thousands.
    for (var first = start + thread; first < end; first += AT_ONCE * 128u) {
        var place: array<vec4<u32>, AT_ONCE>;
        var body: array<u32, AT_ONCE>;
        var volume: array<f32, AT_ONCE>;
        for (var k = 0u; k < AT_ONCE; k++) {
            let q = min(first + k * 128u, end - 1u);
            place[k] = record_of(q, 0u);
            body[k] = ids[q].y;
            volume[k] = rest_of(q, REST - 1u).w;
        }
        for (var k = 0u; k < AT_ONCE; k++) {
            let q = first + k * 128u;
            if q < end {
                let is_concerned = concerns(block, layer, place[k], body[k], volume[k]);
                loose[q] = u32(is_concerned);
                if is_concerned {
                    atomicAdd(&counted, 1u);
                }
            }
        }
    }
    workgroupBarrier();
    if exists && thread == 0u {
        sums[b] = vec2<u32>(atomicLoad(&counted), 0u);
    }
}
