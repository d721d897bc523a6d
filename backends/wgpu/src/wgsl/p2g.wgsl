// Particles to grid, a block at a time: p_i = sum_p w_ip [m (v + dt g) + (m C - dt V0 (4/h2) tau) (x_i - x_p)], m_i = sum_p w_ip m.
//
// Two threads own a cell, one for the momentum along x and y, one for that along z and the mass, and sum its 27 nodes in registers
// over the cell's particles. Those that have left their cell since the sort are listed on the way, by the cell they are in; then lists
// are walked in the order of memory, so that sums do not depend on who came first. Then cells are added to the tile: for one of the
// 27 nodes at a time, different cells touch different nodes.

// May this step go on? It may not once the particles are to be sorted, and so before they have drifted too far for their tiles. The
// step's drift is noted for the next one.
fn ready(b: u32) -> u32 {
    let layer = layer_of_block(min(b, extent.block_room - 1u));
    let rhythm = rhythm_of(layer);
    if atomicLoad(&status[HALTED]) != 0u || b >= atomicLoad(&status[BLOCKS]) {
        return 0u;
    }
    if !is_live(layer) {
        return 0u;
    }
    var is_first = b == 0u;
    if LAYERS > 1u {
        is_first = b == atomicLoad(&status[layer_word(layer, FIRST_BLOCK)]);
    }
    if is_first {
        atomicStore(&status[step_word(step.number, layer, DRIFT)], bitcast<u32>(rhythm.drift));
    }
    if is_world_due(layer, rhythm) {
        if is_first {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], DRIFTED);
        }
        return 0u;
    }
    return 1u;
}

@compute @workgroup_size(128)
fn p2g(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    let part = thread >> 6u;
    let own = thread & 63u;
    // Asked for before it is known whether there is such a block.
    let here = min(b, extent.block_room - 1u);
    let start = cells[here * 64u];
    let end = cells[here * 64u + 64u];
    var next = cells[here * 64u + own];
    let stop = cells[here * 64u + own + 1u];
    if thread == 0u {
        corner = lists[here * ENTRY].xyz * 4 - vec3<i32>(2);
        walled = u32(reaches_wall(layer_of_block(here)));
        go = ready(b);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    layer_now = layer_of_block(here);
    // Cell width [m], and -4 dt / h.
    let width = H / shrink_of(layer_now);
    let stress = step.stress * shrink_of(layer_now);
    let own_cell = vec3<u32>(own >> 4u, (own >> 2u) & 3u, own & 3u);
    let home = tag_of(vec3<i32>(own_cell));

    // 1. Sums over those of each cell's particles that are still there. The others are listed.
    $ZERO
    if part == 0u {
        $OWN_XY
    } else {
        $OWN_ZM
    }
    workgroupBarrier();
    if thread == 0u {
        listed = u32(atomicLoad(&leaver_count) <= LEAVERS && end - start <= 65536u);
    }

    // 2. The cells outside the block that hold any, in order.
    let halo_count = list_halo(thread);
    if thread == 0u {
        go = 1u + (halo_count + 63u) / 64u;
    }
    let batches = workgroupUniformLoad(&go);

    // 3. Those that have come, to the block's own cells first; and the sums go to the tile.
    let crowded = atomicLoad(&leaver_count) > 0u;
    for (var batch = 0u; batch < batches; batch++) {
        let own_number = ((own_cell.x + 1u) * 6u + own_cell.y + 1u) * 6u + own_cell.z + 1u;
        var walk = Walk(home, own_number, 0u, start, end);
        var on = true;
        if batch > 0u {
            let k = (batch - 1u) * 64u + own;
            on = k < halo_count;
            walk.cell = select(0u, halo_cells[min(k, 151u)], on);
            let at = vec3<i32>(i32(walk.cell / 36u), i32((walk.cell / 6u) % 6u), i32(walk.cell % 6u)) - vec3<i32>(1);
            walk.tag = tag_of(at);
            $CLEAR
        }
        if on && crowded {
            if part == 0u {
                $GUESTS_XY
            } else {
                $GUESTS_ZM
            }
        }
        let x = walk.cell / 36u;
        let y = (walk.cell / 6u) % 6u;
        let z = walk.cell % 6u;
        $FLUSH
    }

    // 4. What lies behind mirrors is folded back, reflected.
    if workgroupUniformLoad(&walled) != 0u {
        var impulse = vec3<f32>(0.0);
        for (var axis = 0; axis < 3; axis++) {
            if thread < 64u {
                impulse += fold(axis, 0, thread, -1) + fold(axis, 1, thread, -1);
            }
            workgroupBarrier();
        }
        // The list of leavers is done with.
        if thread < 64u {
            for (var d = 0u; d < 3u; d++) {
                leavers[thread * 3u + d] = bitcast<u32>(impulse[d]);
            }
        }
        workgroupBarrier();
        // What a step without length would give is nothing.
        if thread < 3u && (!SUBCYCLED || step.dt > 0.0) {
            var total = 0.0;
            for (var t = 0u; t < 64u; t++) {
                total += bitcast<f32>(leavers[t * 3u + thread]);
            }
            lists[b * ENTRY + PENDING][thread] = bitcast<i32>(total);
        }
    }

    // 5. The tile, for the grid to sum.
    let base = extent.node_room * 64u + b * 512u;
    for (var t = thread; t < 512u; t += 128u) {
        let k = in_tile(t >> 6u, (t >> 3u) & 7u, t & 7u);
        grid[base + t] = vec4<f32>(tile[k], tile[512u + k]);
    }
}
