// Particles to grid, a block at a time: p_i = sum_p w_ip [m (v + dt g) + (m C - dt V0 (4/h2) tau) (x_i - x_p)], m_i = sum_p w_ip m.
//
// Two threads own a cell, one for the momentum along x and y, one for that along z and the mass, and sum its 27 nodes in registers
// over the cell's particles. Then cells are added to the tile: for one of the 27 nodes at a time, different cells touch different nodes.
// Particles that have left their cell since the sort are listed on the way, by the cell they are in, and summed behind: two threads take a cell
// that others have come to and walk its list in the order of memory, so that sums do not depend on who was listed first.
//
// Calls of `unrolled_...` stand for text that `unrolled.rs` writes out for each of the 27 nodes, which registers `a0` to `a26` hold.

// Momentum along x and y of the tile's nodes, then along z and mass.
var<workgroup> tile: array<vec2<f32>, 1024>;
// For each of 6x6x6 cells its last leaver, counted from 1.
var<workgroup> head: array<atomic<u32>, 216>;
// Leavers: index in the block or window, and the next one in 16 bits.
var<workgroup> leavers: array<u32, 384>;
var<workgroup> leaver_count: atomic<u32>;
// Of these the ones that particles have come to, as bits; and all of them, those first, else in order.
var<workgroup> come_to: array<atomic<u32>, 7>;
var<workgroup> guest_cells: array<u32, 216>;
var<workgroup> go: u32;
var<workgroup> corner: vec3<i32>;
var<workgroup> walled: u32;
var<workgroup> at_rim: u32;
// Is a cell crowded?
var<workgroup> crowded: atomic<u32>;

const LEAVERS: u32 = 384u;
// What a cell holds beyond its rounds, which stands behind those of all cells, is dealt to all threads in units of so many particles.
// Those of its rounds have a bit each in a word.
const IN_ROUNDS: u32 = ROUNDS * TOGETHER;
const UNIT: u32 = 32u;
// Instead of a count: some cell is crowded.
const CROWDED: u32 = 0xffffffffu;

// Spread over the banks of workgroup memory.
fn in_tile(x: u32, y: u32, z: u32) -> u32 {
    return x * 64u + y * 8u + (z ^ ((y & 2u) << 1u));
}

fn layer_of_block(b: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[b * ENTRY].w);
}

// The listed particles in one cell that come from others, one after the other.
struct Walk {
    // The cell's number among 6x6x6.
    cell: u32,
    // Leavers before this one are done.
    after: u32,
    // The first particle of those that are listed.
    start: u32,
}

// Notes a particle, if it has left its cell, where those that have come to another are looked for.
fn list_leaver(q: u32, index: u32, tag: u32) {
    if (tag & LEFT_HOME) == 0u {
        return;
    }
    let at = cell_of(tag) + vec3<i32>(1);
    if any(at < vec3<i32>(0)) || any(at > vec3<i32>(5)) {
        if SUBCYCLED {
            // The world has failed, which the host sees by how far particles have come; the others go on.
            atomicMax(&status[step_word(step.number, layer_now, MOVE)], bitcast<u32>(1.0));
            return;
        }
        atomicStore(&status[WHO], q);
        atomicStore(&status[HALT_STEP], step.number);
        atomicStore(&status[HALTED], STRAYED);
        return;
    }
    let cell = u32((at.x * 6 + at.y) * 6 + at.z);
    let k = atomicAdd(&leaver_count, 1u);
    if k < LEAVERS {
        leavers[k] = (index << 16u) | atomicExchange(&head[cell], k + 1u);
    }
    atomicOr(&come_to[cell >> 5u], 1u << (cell & 31u));
}

// Lists those of a window of particles that have left their cells, in place of what is listed.
fn list_window(thread: u32, first: u32, end: u32) {
    for (var cell = thread; cell < 216u; cell += 128u) {
        atomicStore(&head[cell], 0u);
    }
    if thread < 7u {
        atomicStore(&come_to[thread], 0u);
    }
    if thread == 0u {
        atomicStore(&leaver_count, 0u);
    }
    workgroupBarrier();
    for (var q = first + thread; q < end; q += 128u) {
        list_leaver(q, q - first, record_of(q, 0u).w);
    }
    workgroupBarrier();
}

// How many windows of particles have to be listed, one after the other, so that the list holds what has left of each; one if it holds all.
fn windows_of(particles: u32) -> u32 {
    let listed = atomicLoad(&leaver_count);
    return select(min(listed, 1u), (particles + LEAVERS - 1u) / LEAVERS, listed > LEAVERS || particles > 65536u);
}

// Counts, for each cell, the units of it and of those before; `go` is how many there are in all.
fn count_units(thread: u32, count: u32) {
    let cell = thread & 63u;
    if thread < 64u {
        guest_cells[cell] = (max(count, IN_ROUNDS) - IN_ROUNDS + UNIT - 1u) / UNIT;
    }
    workgroupBarrier();
    var all = 0u;
    for (var c = 0u; c <= cell; c++) {
        all += guest_cells[c];
    }
    workgroupBarrier();
    if thread < 64u {
        guest_cells[cell] = all;
    }
    if thread == 63u {
        go = all;
    }
}

// A unit: its cell, its number there, and how many units of one cell there are at most among the 64 from a first one on.
fn unit_at(number: u32, first: u32) -> vec3<u32> {
    var cell = 0u;
    var before = 0u;
    var most = 0u;
    var own_before = 0u;
    for (var c = 0u; c < 64u; c++) {
        let end = guest_cells[c];
        if end <= number {
            cell = c + 1u;
            own_before = end;
        }
        most = max(most, min(max(end, first), first + 64u) - min(max(before, first), first + 64u));
        before = end;
    }
    return vec3<u32>(cell, number - own_before, most);
}

fn next_leaver(w: ptr<function, Walk>) -> u32 {
    var best = NONE;
    var h = atomicLoad(&head[(*w).cell]);
    while h != 0u {
        let entry = leavers[h - 1u];
        let index = entry >> 16u;
        if index >= (*w).after && index < best {
            best = index;
        }
        h = entry & 0xffffu;
    }
    if best == NONE {
        return NONE;
    }
    (*w).after = best + 1u;
    return (*w).start + best;
}

// Lists the cells, those that particles have come to before the others; how many have been come to.
fn list_guest_cells(thread: u32) -> u32 {
    var all = 0u;
    for (var w = 0u; w < 7u; w++) {
        all += countOneBits(atomicLoad(&come_to[w]));
    }
    for (var cell = thread; cell < 216u; cell += 128u) {
        let bits = atomicLoad(&come_to[cell >> 5u]);
        var before = countOneBits(bits & ((1u << (cell & 31u)) - 1u));
        for (var w = 0u; w < (cell >> 5u); w++) {
            before += countOneBits(atomicLoad(&come_to[w]));
        }
        let is_come_to = (bits & (1u << (cell & 31u))) != 0u;
        guest_cells[select(all + cell - before, before, is_come_to)] = cell;
    }
    return all;
}

// Folds a node behind a wall onto its image; what the wall gives: [N s].
fn fold_node(node: vec3<u32>, onto: vec3<u32>, signs: vec3<f32>) -> vec3<f32> {
    let source = in_tile(node.x, node.y, node.z);
    let to = in_tile(onto.x, onto.y, onto.z);
    let xy = tile[source];
    let zm = tile[512u + source];
    tile[to] += signs.xy * xy;
    tile[512u + to] += vec2<f32>(signs.z * zm.x, zm.y);
    // The mass stays, for what walls give when velocities are read.
    tile[source] = vec2<f32>(0.0);
    tile[512u + source] = vec2<f32>(0.0, zm.y);
    return (signs - vec3<f32>(1.0)) * vec3<f32>(xy, zm.x);
}

// Sums components of what stands where leavers did: so many sums, each of so many terms that far apart, to where the first of them stands.
fn sum_leavers(thread: u32, sums: u32, terms: u32, step_by: u32) {
    if thread < 3u * sums {
        let first = thread % 3u + thread / 3u * terms * step_by;
        var total = 0.0;
        for (var t = 0u; t < terms; t++) {
            total += bitcast<f32>(leavers[first + t * step_by]);
        }
        leavers[first] = bitcast<u32>(total);
    }
}

// May this step go on? It may not once the particles are to be sorted, and so before they have drifted too far for their tiles. The
// step's drift is noted for the next one.
fn ready(b: u32) -> u32 {
    let layer = layer_of_block(min(b, extent.block_room - 1u));
    // Subcycled, sorts come where all levels' steps begin.
    let may_be_due = !SUBCYCLED || step.slot % (1u << (LEVELS - 1u)) == 0u;
    var since_sort = SinceSort(0u, 0.0);
    var followed = 0u;
    var is_stiff = false;
    if may_be_due {
        since_sort = since_sort_of(layer);
        followed = atomicLoad(&status[FOLLOWED]);
        @if(stiffens)
        is_stiff = is_too_stiff(layer);
    }
    if atomicLoad(&status[HALTED]) != 0u || b >= atomicLoad(&status[BLOCKS]) {
        return 0u;
    }
    if !is_live(layer) {
        return 0u;
    }
    if may_be_due {
        var is_first = b == 0u;
        if LAYERS > 1u {
            is_first = b == atomicLoad(&status[layer_word(layer, FIRST_BLOCK)]);
        }
        if is_first {
            atomicStore(&status[step_word(step.number, layer, DRIFT)], bitcast<u32>(since_sort.drift));
        }
        if followed != 0u || is_world_due(layer, since_sort) {
            if is_first {
                atomicStore(&status[HALT_STEP], step.number);
                atomicStore(&status[HALTED], select(DRIFTED, FOLLOW, followed != 0u));
            }
            return 0u;
        }
        // The next step's needs come into the word in which those of the step before the last have been; those asleep, which nobody asks, go on
        // needing what they did.
        @if(stiffens) {
            if is_first {
                @if(sleeps)
                let kept_need = atomicLoad(&status[need_word(step.number + 1u, layer)]);
                @else
                let kept_need = 0u;
                atomicStore(&status[need_word(step.number, layer)], kept_need);
            }
            if is_stiff {
                if is_first {
                    atomicStore(&status[HALT_STEP], step.number);
                    atomicStore(&status[HALTED], TOO_STIFF);
                }
                return 0u;
            }
        }
    }
    @if(sleeps)
    return gives(b, layer);
    @else
    return 1u;
}

@compute @workgroup_size(128)
fn p2g(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    // A workgroup's block, or, subcycled, behind all of them one that gives to nodes which two levels share.
    @if(subcycled)
    let which = group.y * extent.row + group.x;
    @if(subcycled)
    let own_blocks = blocks_now();
    @if(subcycled)
    let is_still = which >= own_blocks;
    @if(subcycled)
    let number = max(which, own_blocks) - own_blocks;
    @if(subcycled)
    let b = select(which, listed_block(GIVING, number), is_still);
    @else
    let b = group.y * extent.row + group.x;
    let part = thread >> 6u;
    let own = thread & 63u;
    // Asked for before it is known whether there is such a block.
    let here = min(b, extent.block_room - 1u);
    let start = cells[here * 64u];
    let end = cells[here * 64u + 64u];
    let in_cell = cells[here * 64u + own + 1u] - cells[here * 64u + own];
    var next = cells[round_at(here, 0u, own)];
    var ahead = cells[round_at(here, 1u, own)];
    if thread == 0u {
        corner = lists[here * ENTRY].xyz * 4 - vec3<i32>(2);
        walled = u32(reaches_wall(layer_of_block(here), corner));
        @if(subcycled)
        at_rim = select(u32(lists[here * ENTRY + OF_RIMS].w) & 1u, 0u, is_still);
        @elif(levels)
        at_rim = u32(lists[here * ENTRY + OF_RIMS].w) & 1u;
        @if(sleeps && subcycled)
        if !is_still {
            settle(b);
        }
        @elif(sleeps)
        settle(b);
        go = ready(b);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    layer_now = layer_of_block(here);
    // Cell width [m], and -4 dt / h.
    let width = extent.world.cell / shrink_of(layer_now);
    var stress = step.stress * shrink_of(layer_now) * steps_of(layer_now);
    var gravity = step.gravity * steps_of(layer_now);
    @if(subcycled)
    if is_still {
        stress = 0.0;
        gravity = vec3<f32>(0.0);
    }
    if GRAVITY_GROWS {
        gravity *= bitcast<f32>(atomicLoad(&status[step_word(step.number, layer_now, GROWN)]));
    }
    let own_cell = vec3<u32>(own >> 4u, (own >> 2u) & 3u, own & 3u);

    // 1. Sums over those of each cell's particles that are still there, and to the tile. The others are listed.
    unrolled_zero();
    let count = min(in_cell, IN_ROUNDS);
    // Those that have left, by their numbers in the cell.
    var left = 0u;
    if part == 0u {
        unrolled_own_xy();
    } else {
        unrolled_own_zm();
    }
    while left != 0u {
        let q = slot_of(here, own, firstTrailingBit(left));
        left &= left - 1u;
        list_leaver(q, q - start, record_of(q, 0u).w);
    }
    if in_cell > IN_ROUNDS {
        atomicStore(&crowded, 1u);
    }
    workgroupBarrier();
    if thread == 0u {
        go = select(windows_of(end - start), CROWDED, atomicLoad(&crowded) != 0u);
    }
    {
        let at = own_cell + vec3<u32>(1u);
        unrolled_flush();
    }
    var windows = workgroupUniformLoad(&go);

    // 2. Then what crowded cells hold beyond: the units of one cell add to the tile in turn.
    if windows == CROWDED {
        count_units(thread, in_cell);
        let units = workgroupUniformLoad(&go);
        for (var batch = 0u; batch < units; batch += 64u) {
            let is_one = batch + own < units;
            let unit = unit_at(min(batch + own, units - 1u), batch);
            if thread == 0u {
                go = unit.z;
            }
            let turns = workgroupUniformLoad(&go);
            let own_cell = vec3<u32>(unit.x >> 4u, (unit.x >> 2u) & 3u, unit.x & 3u);
            // What the last cell holds beyond ends with the block.
            let first = cells[round_at(here, ROUNDS, unit.x)] + unit.y * UNIT;
            let end_of_cell = select(cells[round_at(here, ROUNDS, min(unit.x + 1u, 63u))], end, unit.x == 63u);
            let end_of_unit = select(first, min(first + UNIT, end_of_cell), is_one);
            unrolled_clear();
            if part == 0u {
                unrolled_unit_xy();
            } else {
                unrolled_unit_zm();
            }
            let at = own_cell + vec3<u32>(1u);
            for (var turn = 0u; turn < turns; turn++) {
                let is_turn = is_one && turn == min(unit.y, own);
                unrolled_flush_in_turn();
            }
        }
        if thread == 0u {
            go = windows_of(end - start);
        }
        windows = workgroupUniformLoad(&go);
    }

    // 3. Then those that have come to others, a cell after the other. Where the list does not hold them all, they are listed anew, window by window: each has
    // no more of the block's particles than the list holds.
    for (var window = 0u; window < windows; window++) {
        let first = start + window * LEAVERS;
        if windows > 1u {
            list_window(thread, first, min(first + LEAVERS, end));
        }
        let guest_count = list_guest_cells(thread);
        if thread == 0u {
            go = (guest_count + 63u) / 64u;
        }
        let batches = workgroupUniformLoad(&go);
        for (var batch = 0u; batch < batches; batch++) {
            let k = batch * 64u + own;
            // Those that have none add nothing to another cell, for without branches that is faster.
            let cell = guest_cells[k % 216u];
            let at = vec3<u32>(cell / 36u, (cell / 6u) % 6u, cell % 6u);
            var walk = Walk(cell, 0u, first);
            unrolled_clear();
            if k < guest_count {
                if part == 0u {
                    unrolled_guests_xy();
                } else {
                    unrolled_guests_zm();
                }
            }
            unrolled_flush();
        }
    }

    // 4. What lies behind mirrors is folded back, reflected.
    if workgroupUniformLoad(&walled) != 0u {
        let first_node = corner;
        let least = world_min(layer_now);
        let end_node = world_max(layer_now);
        // A row across the planes behind walls.
        let row = vec2<u32>(own >> 3u, own & 7u);
        var impulse = vec3<f32>(0.0);
        unrolled_fold();
        // The list of leavers is done with.
        for (var d = 0u; d < 3u; d++) {
            leavers[thread * 3u + d] = bitcast<u32>(impulse[d]);
        }
        workgroupBarrier();
        sum_leavers(thread, 8u, 16u, 3u);
        workgroupBarrier();
        sum_leavers(thread, 1u, 8u, 48u);
        @if(subcycled)
        let books = thread < 3u && !is_still;
        @else
        let books = thread < 3u;
        if books {
            let total = bitcast<f32>(leavers[thread]);
            // What the step before would give, it has given, since another follows.
            @if(mirrored) {
                let given = bitcast<f32>(lists[b * ENTRY + WALL][thread]) + bitcast<f32>(lists[b * ENTRY + PENDING][thread]);
                lists[b * ENTRY + WALL][thread] = bitcast<i32>(given);
                lists[b * ENTRY + PENDING].w = i32(step.number);
            }
            @if(sleeps)
            lists[b * ENTRY + PENDING][thread] = bitcast<i32>(select(total, 0.0, is_frozen != 0u));
            @else
            lists[b * ENTRY + PENDING][thread] = bitcast<i32>(total);
        }
    }

    // 5. The tile, for the grid to sum.
    let base = extent.node_room * 64u + b * 512u;
    for (var t = thread; t < 512u; t += 128u) {
        let k = in_tile(t >> 6u, (t >> 3u) & 7u, t & 7u);
        let node = vec4<f32>(tile[k], tile[512u + k]);
        @if(subcycled)
        if is_still {
            handed[of_still_tile(number) + t] = node;
        } else {
            grid[base + t] = node;
        }
        @else
        grid[base + t] = node;
    }

    // 6. Parent cells, for rims.
    @if(levels)
    if workgroupUniformLoad(&at_rim) != 0u {
        sum_parent_cells(b, thread, in_cell);
    }
}
