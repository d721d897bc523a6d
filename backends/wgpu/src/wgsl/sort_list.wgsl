
// Lists blocks of each kind, and counts the workgroups of passes: for each end among the levels, those of all levels before. Worlds of a batch
// stand one behind the other, with all their levels: there passes visit all. P2G visits those that give to shared nodes twice. One workgroup.
const FOUND: u32 = 7u;
// Those of them that are workgroups for several blocks of several lists.
const IN_FOURS: u32 = 5u;

var<workgroup> found: array<vec4<u32>, 256>;

fn is_of(kinds: u32) -> vec4<u32> {
    return (vec4<u32>(kinds) >> vec4<u32>(AT_RIM, GIVING, WALLED, TAKING)) & vec4<u32>(1u);
}

// How many of a list's blocks come before one.
fn listed_before(kind: u32, block: u32) -> u32 {
    var low = 0u;
    var high = listed[kind];
    while high > low {
        let middle = (low + high) / 2u;
        if listed[place_in_list(kind, middle)] < block {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

// How many blocks, or blocks of nodes, are on the levels before one: `all` there are, and where that level's `first` one stands.
fn before_level(all: u32, first: u32, level: u32) -> u32 {
    if level < LEVELS && LAYERS == LEVELS {
        return atomicLoad(&status[layer_word(level, first)]);
    }
    return atomicLoad(&status[all]);
}

// How many of a list's blocks are on the levels before one. There are no fewer blocks of nodes than blocks.
fn listed_before_level(kind: u32, level: u32) -> u32 {
    return listed_before(kind, before_level(NODE_BLOCKS, FIRST_NODE_BLOCK, level));
}

// How many there are of what a pass visits on the levels before one.
fn found_before(which: u32, level: u32) -> u32 {
    let blocks = before_level(BLOCKS, FIRST_BLOCK, level);
    if which < 2u {
        return select(blocks, before_level(NODE_BLOCKS, FIRST_NODE_BLOCK, level), which == 1u);
    }
    if which - 2u == GIVING {
        return blocks + listed_before(GIVING, blocks);
    }
    if which < IN_FOURS {
        return listed_before_level(which - 2u, level);
    }
    // Rims, what shares nodes, and walls, in the order in which `rims.wgsl` visits them.
    let abreast = select(RIMS_BESIDE, 4u, which == IN_FOURS);
    var visits = select(FREE_ROOM + 1u, 0u, which == IN_FOURS) + (listed_before_level(AT_RIM, level) + abreast - 1u) / abreast;
    if SUBCYCLED {
        // The next coarser level shares nodes with those whose step it is.
        visits += (listed_before_level(TAKING, min(level + 1u, LEVELS)) + abreast - 1u) / abreast;
    }
    if MIRRORED {
        visits += (listed_before_level(WALLED, level) + abreast - 1u) / abreast;
    }
    return visits;
}

@compute @workgroup_size(256)
fn list_blocks(@builtin(local_invocation_index) thread: u32) {
    let on = !halted();
    let count = select(0u, max(atomicLoad(&status[NODE_BLOCKS]), atomicLoad(&status[BLOCKS])), on);
    let each = (count + 255u) / 256u;
    let source = min(thread * each, count);
    let to = min(source + each, count);
    var own = vec4<u32>(0u);
    for (var w = source; w < to; w++) {
        own += is_of(listed[place_in_list(LIST_KINDS, w)]);
    }
    found[thread] = own;
    workgroupBarrier();
    var next = vec4<u32>(0u);
    for (var t = 0u; t < thread; t++) {
        next += found[t];
    }
    for (var w = source; w < to; w++) {
        let is_here = is_of(listed[place_in_list(LIST_KINDS, w)]);
        for (var kind = 0u; kind < LIST_KINDS; kind++) {
            if is_here[kind] != 0u {
                listed[place_in_list(kind, next[kind])] = w;
            }
        }
        if is_here[GIVING] != 0u {
            lists[w * ENTRY + OF_RIMS].w |= i32((next[GIVING] + 1u) << 1u);
        }
        next += is_here;
    }
    if thread == 255u && on {
        for (var kind = 0u; kind < LIST_KINDS; kind++) {
            listed[kind] = next[kind];
        }
        atomicStore(&status[GIVERS], next[GIVING]);
        if SUBCYCLED && next[GIVING] > extent.giver_room {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], ROOM);
        }
    }
    storageBarrier();
    for (var k = thread; k < LIST_KINDS * LEVELS; k += 256u) {
        let before = listed_before_level(k / LEVELS, k % LEVELS + 1u);
        if on {
            listed[until_level(k / LEVELS, k % LEVELS + 1u)] = before;
        }
    }
    for (var k = thread; k < FOUND * LEVELS; k += 256u) {
        let groups_now = found_before(k / LEVELS, k % LEVELS + 1u);
        if on {
            groups[3u * k] = min(groups_now, extent.row);
            groups[3u * k + 1u] = (groups_now + extent.row - 1u) / extent.row;
            groups[3u * k + 2u] = 1u;
        }
    }
}
