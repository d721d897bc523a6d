// Who sleeps in the step that begins, a workgroup a block: ground that has been slow for RESTED steps, as all around it, and is neither near a
// tool nor at a rim. It wakes as soon as something next to it is fast, or a tool comes near. What is decided holds from P2G on; to decide twice
// without a step in between changes nothing.

var<workgroup> go: u32;
// The block's own count, and whether it slept until now.
var<workgroup> own: u32;
var<workgroup> slept: u32;
var<workgroup> stirred: atomic<u32>;
var<workgroup> restless: atomic<u32>;
var<workgroup> tied: atomic<u32>;
// Are particles to be visited, stopped, and what is their mark?
var<workgroup> visit: u32;
var<workgroup> stop: u32;
var<workgroup> mark: u32;
var<workgroup> masses: array<f32, 64>;
var<workgroup> motions: array<vec4<f32>, 64>;

// May this step go on? Not if P2G will halt it.
fn ready(b: u32) -> u32 {
    if atomicLoad(&status[HALTED]) != 0u || b >= atomicLoad(&status[BLOCKS]) {
        return 0u;
    }
    let layer = u32(lists[b * ENTRY].w);
    return u32(is_live(layer) && !is_world_due(layer, since_sort_of(layer)));
}

// A block's count after what has happened.
fn rest_of(b: u32) -> u32 {
    var rest = atomicLoad(&watch[watch_word(b, RESTS)]);
    let happened = atomicLoad(&watch[watch_word(b, HAPPENED)]);
    if (happened & FAST) != 0u {
        rest = 0u;
    } else if (happened & STEPPED) != 0u && rest != ASLEEP {
        rest = min(rest + 1u, RESTED);
    }
    return select(rest, min(rest, 1u), (happened & STIRRED) != 0u);
}

// Looks at one of the 27 blocks around a block, itself among them.
fn look_at(b: u32, n: u32) {
    let g = u32(lists[b * ENTRY + 1u + (n >> 2u)][n & 3u]);
    // The block with particles that has the node block's place is the one in the middle.
    let other = u32(lists[(extent.block_room + g) * ENTRY + 4u].y);
    if other != NONE {
        let rest = rest_of(other);
        if rest == 0u {
            atomicStore(&stirred, 1u);
        }
        if rest < RESTED {
            atomicStore(&restless, 1u);
        }
        if n == 13u {
            own = rest;
            slept = u32(is_asleep(b));
        }
    }
    @if(levels)
    if any(rims[g].xyz != vec3<u32>(0u)) || rims[extent.node_room + b].x != 0u {
        atomicStore(&tied, 1u);
    }
}

// Is a tool near? `tools` holds how many boxes a layer has, and for each step and layer those boxes, of blocks.
fn is_near_tool(b: u32, tool: u32) -> bool {
    let layer = u32(lists[b * ENTRY].w);
    let at = 1u + 2u * ((slot_now() * LAYERS + layer) * u32(tools[0].x) + tool);
    let block = image_near(layer, 4 * lists[b * ENTRY].xyz, 4 * middle_of(tools[at].xyz, tools[at + 1u].xyz)) >> vec3<u32>(2u);
    return all(block >= tools[at].xyz) && all(block <= tools[at + 1u].xyz);
}

@compute @workgroup_size(64)
fn watch_blocks(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    // All that can be asked for at once is, also where there is no such block.
    let here = min(b, extent.block_room - 1u);
    if thread < 27u {
        look_at(here, thread);
    } else if thread == 32u {
        go = ready(b);
    } else if thread > 32u {
        for (var tool = thread - 33u; tool < u32(tools[0].x); tool += 31u) {
            if is_near_tool(here, tool) {
                atomicStore(&stirred, 1u);
            }
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    if thread == 0u {
        if slept != 0u {
            book_sleep(b);
        }
        var rest = own;
        if atomicLoad(&stirred) != 0u {
            rest = min(rest, 1u);
        } else if atomicLoad(&tied) != 0u {
            // Levels may have moved.
            rest = min(rest, RESTED);
        } else if rest != ASLEEP && atomicLoad(&restless) == 0u {
            rest = ASLEEP;
            stop = 1u;
            atomicStore(&watch[watch_word(b, FILLED)], 0u);
            atomicAdd(&watch[watch_word(b, FELL)], 1u);
        }
        atomicStore(&watch[watch_word(b, DECIDED)], rest);
        // A sort has taken off all marks, and left tiles to be filled.
        let is_new = atomicLoad(&watch[watch_word(b, FILLED)]) == 0u || atomicLoad(&watch[watch_word(b, MASS)]) == 0u;
        mark = select(0u, OF_SLEEPERS, rest == ASLEEP);
        visit = u32((rest == ASLEEP) != (slept != 0u) || (rest == ASLEEP && is_new));
    }
    if workgroupUniformLoad(&visit) == 0u {
        return;
    }
    // What its particles weigh, and how they move, in the order of threads.
    let is_stopped = workgroupUniformLoad(&stop) != 0u;
    let width = extent.world.cell / shrink_of(u32(lists[b * ENTRY].w));
    let quarter = 0.25 * width * width;
    var mass = 0.0;
    var motion = vec4<f32>(0.0);
    for (var q = cells[b * 64u] + thread; q < cells[b * 64u + 64u]; q += 64u) {
        let m = bitcast<f32>(record_of(q, 1u).w);
        owners[q].y = bitcast<u32>(m) | mark;
        mass += m;
        if is_stopped {
            for (var d = 0u; d < 3u; d++) {
                let row = bitcast<vec4<f32>>(record_of(q, 2u + d));
                motion[d] += m * row.x;
                motion.w += 0.5 * m * (row.x * row.x + quarter * dot(row.yzw, row.yzw));
                set_record(q, 2u + d, vec4<u32>(0u));
            }
        }
    }
    masses[thread] = mass;
    motions[thread] = motion;
    workgroupBarrier();
    if thread == 0u {
        var weighs = 0.0;
        var taken = vec4<f32>(0.0);
        for (var t = 0u; t < 64u; t++) {
            weighs += masses[t];
            taken += motions[t];
        }
        atomicStore(&watch[watch_word(b, MASS)], bitcast<u32>(weighs));
        for (var k = 0u; k < 4u; k++) {
            let word = watch_word(b, LOST + k);
            atomicStore(&watch[word], bitcast<u32>(bitcast<f32>(atomicLoad(&watch[word])) + taken[k]));
        }
    }
}
