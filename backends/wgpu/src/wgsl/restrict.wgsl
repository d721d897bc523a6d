// What a block gives to nodes at the rim of its layer's region is handed to their parents on the next coarser layer: mass
// m_c = sum_f P m_f, momentum p_c = sum_f P (p_f + M_f (x_c - x_f)), with the affine momentum M_f = sum_p w m C, for which the particles of
// a cell have their mean C. Per axis a node at the even index 2I has the parents I (3/4) and I - 1 (1/4), one at 2I + 1 has I and I + 1.
//
// The parents of a tile's 8x8x8 nodes are 6x6x6 coarse nodes, from two before twice the block on. Each thread sums up two of them, over
// their 4x4x4 children that are slaves. M_f comes column by column, by way of the tile.

// Not a column of M.
const MOMENTUM: u32 = 3u;

// Which of the tile's nodes are slaves, as bits.
var<workgroup> slaves: array<atomic<u32>, 16>;

// Is a node of the tile a slave? `around` is the block's entry.
fn is_slave(around: u32, node: vec3<i32>) -> bool {
    let from_block = node - vec3<i32>(2);
    let by = (from_block >> vec3<u32>(2u)) + vec3<i32>(1);
    let which = u32(by.x * 9 + by.y * 3 + by.z);
    let g = u32(lists[around + 1u + (which >> 2u)][which & 3u]);
    let inner = from_block & vec3<i32>(3);
    let n = u32(inner.x * 16 + inner.y * 4 + inner.z);
    return g != NONE && (rims[min(g, extent.node_room - 1u)][n >> 5u] & (1u << (n & 31u))) != 0u;
}

fn share(child: i32) -> f32 {
    return select(0.25, 0.75, child == 1 || child == 2);
}

fn is_slave_in_tile(plain: u32) -> bool {
    return (atomicLoad(&slaves[plain >> 5u]) & (1u << (plain & 31u))) != 0u;
}

fn in_tile_plain(plain: u32) -> u32 {
    return in_tile(plain >> 6u, (plain >> 3u) & 7u, plain & 7u);
}

// The first child of a parent in the tile, along each axis; it may lie before it.
fn first_child(parent: u32) -> vec3<i32> {
    return 2 * vec3<i32>(i32(parent / 36u), i32((parent / 6u) % 6u), i32(parent % 6u)) - vec3<i32>(3);
}

// Is any of a parent's children a slave?
fn is_parent(parent: u32) -> bool {
    let first = first_child(parent);
    for (var i = max(-first.x, 0); i < min(8 - first.x, 4); i++) {
        for (var j = max(-first.y, 0); j < min(8 - first.y, 4); j++) {
            for (var k = max(-first.z, 0); k < min(8 - first.z, 4); k++) {
                if is_slave_in_tile(u32((first.x + i) * 64 + (first.y + j) * 8 + first.z + k)) {
                    return true;
                }
            }
        }
    }
    return false;
}

// What a parent gets of the tile, which holds slaves only: momentum and mass, or a column of M, which goes times its part of the way to the
// parent.
fn handed_to(parent: u32, column: u32) -> vec4<f32> {
    let first = first_child(parent);
    var sum = vec4<f32>(0.0);
    for (var i = max(-first.x, 0); i < min(8 - first.x, 4); i++) {
        for (var j = max(-first.y, 0); j < min(8 - first.y, 4); j++) {
            for (var k = max(-first.z, 0); k < min(8 - first.z, 4); k++) {
                let at = in_tile(u32(first.x + i), u32(first.y + j), u32(first.z + k));
                let way = select(1.0, 1.5 - f32(vec3<i32>(i, j, k)[min(column, 2u)]), column < 3u);
                sum += share(i) * share(j) * share(k) * way * vec4<f32>(tile[at], tile[512u + at]);
            }
        }
    }
    return sum;
}

fn parent_cell(parent: u32) -> vec3<i32> {
    // The tile's first node is at an even index.
    return (corner >> vec3<u32>(1u)) - vec3<i32>(1) + vec3<i32>(i32(parent / 36u), i32((parent / 6u) % 6u), i32(parent % 6u));
}

// Parents behind a mirror are images: what they get is their nodes', reflected. What a parent gets that way; of images, the negative of what
// they give away, so that nothing is left.
struct Mirrored { gain: vec4<f32>, impulse: vec3<f32> }

fn mirrored(parent: u32) -> Mirrored {
    var out = Mirrored(vec4<f32>(0.0), vec3<f32>(0.0));
    let low = world_min(layer_now + 1u);
    let high = world_max(layer_now + 1u);
    let cell = parent_cell(parent);
    let behind = ((LOW != vec3<u32>(0u)) & (cell < low)) | ((HIGH != vec3<u32>(0u)) & (cell >= high));
    if any(behind) {
        out.gain = -vec4<f32>(tile[2u * parent], tile[2u * parent + 1u]);
        return out;
    }
    for (var which = 1u; which < 8u; which++) {
        var image = vec3<i32>(i32(parent / 36u), i32((parent / 6u) % 6u), i32(parent % 6u));
        var signs = vec3<f32>(1.0);
        var exists = true;
        for (var axis = 0; axis < 3; axis++) {
            if (which & (1u << u32(axis))) != 0u {
                // A slave's parent is one cell behind a wall at most.
                let at_low = LOW[axis] != 0u && cell[axis] == low[axis];
                let at_high = HIGH[axis] != 0u && cell[axis] + 1 == high[axis];
                image[axis] += select(1, -1, at_low);
                signs *= wall_signs(select(HIGH[axis], LOW[axis], at_low), axis);
                exists = exists && (at_low || at_high) && image[axis] >= 0 && image[axis] < 6;
            }
        }
        if exists {
            let at = 2u * u32(image.x * 36 + image.y * 6 + image.z);
            let given = vec4<f32>(tile[at], tile[at + 1u]);
            out.gain += vec4<f32>(signs, 1.0) * given;
            out.impulse += (signs - vec3<f32>(1.0)) * given.xyz;
        }
    }
    return out;
}

@compute @workgroup_size(128)
fn restrict_rims(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    let part = thread >> 6u;
    let own = thread & 63u;
    let here = min(b, extent.block_room - 1u);
    if thread == 0u {
        corner = lists[here * ENTRY].xyz * 4 - vec3<i32>(2);
        walled = u32(reaches_wall(layer_of_block(here)));
        let fits = atomicLoad(&status[HALTED]) == 0u && b < atomicLoad(&status[BLOCKS]);
        go = u32(fits && rims[extent.node_room + here].x != 0u && is_live(layer_of_block(here)));
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    layer_now = layer_of_block(here);
    let start = cells[here * 64u];
    let end = cells[here * 64u + 64u];
    var next = cells[here * 64u + own];
    let stop = cells[here * 64u + own + 1u];
    let width = H / shrink_of(layer_now);
    let own_cell = vec3<u32>(own >> 4u, (own >> 2u) & 3u, own & 3u);
    let home = tag_of(vec3<i32>(own_cell));
    for (var t = thread; t < 512u; t += 128u) {
        if is_slave(here * ENTRY, vec3<i32>(i32(t >> 6u), i32((t >> 3u) & 7u), i32(t & 7u))) {
            atomicOr(&slaves[t >> 5u], 1u << (t & 31u));
        }
    }

    // 1. Each cell's mass by node, and two rows of its m C, or the third.
    $ZERO
    var row0 = vec3<f32>(0.0);
    var row1 = vec3<f32>(0.0);
    var mass = 0.0;
    if part == 0u {
        $OWN_XY
    } else {
        $OWN_Z
    }
    workgroupBarrier();
    if thread == 0u {
        listed = u32(atomicLoad(&leaver_count) <= LEAVERS && end - start <= 65536u);
    }
    let halo_count = list_halo(thread);
    if thread == 0u {
        go = 1u + (halo_count + 63u) / 64u;
    }
    let batches = workgroupUniformLoad(&go);

    // 2. Momentum and mass as P2G has left them.
    let second = min(thread + 128u, 215u);
    let takes0 = is_parent(thread);
    let takes1 = is_parent(second);
    for (var t = thread; t < 512u; t += 128u) {
        let held = select(vec4<f32>(0.0), grid[extent.node_room * 64u + b * 512u + t], is_slave_in_tile(t));
        tile[in_tile_plain(t)] = held.xy;
        tile[512u + in_tile_plain(t)] = held.zw;
    }
    workgroupBarrier();
    var sum0 = vec4<f32>(0.0);
    var sum1 = vec4<f32>(0.0);
    if takes0 {
        sum0 = handed_to(thread, MOMENTUM);
    }
    if takes1 {
        sum1 = handed_to(second, MOMENTUM);
    }
    workgroupBarrier();

    // 3. M, column by column.
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
            row0 = vec3<f32>(0.0);
            row1 = vec3<f32>(0.0);
            mass = 0.0;
        }
        if on && crowded {
            if part == 0u {
                $GUESTS_XY
            } else {
                $GUESTS_Z
            }
        }
        let x = walk.cell / 36u;
        let y = (walk.cell / 6u) % 6u;
        let z = walk.cell % 6u;
        // The way from a node to its parents is in cells.
        let by_mass = select(0.0, width / mass, mass > 0.0);
        for (var column = 0u; column < 3u; column++) {
            let mean = by_mass * vec2<f32>(row0[column], row1[column]);
            for (var t = thread; t < 1024u; t += 128u) {
                tile[t] = vec2<f32>(0.0);
            }
            workgroupBarrier();
            $FLUSH
            if workgroupUniformLoad(&walled) != 0u {
                for (var axis = 0; axis < 3; axis++) {
                    if thread < 64u {
                        fold(axis, 0, thread, i32(column));
                        fold(axis, 1, thread, i32(column));
                    }
                    workgroupBarrier();
                }
            }
            for (var t = thread; t < 512u; t += 128u) {
                if !is_slave_in_tile(t) {
                    tile[in_tile_plain(t)] = vec2<f32>(0.0);
                    tile[512u + in_tile_plain(t)] = vec2<f32>(0.0);
                }
            }
            workgroupBarrier();
            if takes0 {
                sum0 += handed_to(thread, column);
            }
            if takes1 {
                sum1 += handed_to(second, column);
            }
            workgroupBarrier();
        }
    }

    // 4. Parents behind walls.
    tile[2u * thread] = sum0.xy;
    tile[2u * thread + 1u] = sum0.zw;
    if thread < 88u {
        tile[2u * second] = sum1.xy;
        tile[2u * second + 1u] = sum1.zw;
    }
    workgroupBarrier();
    if any((LOW != vec3<u32>(0u)) | (HIGH != vec3<u32>(0u))) {
        let first_gain = mirrored(thread);
        let second_gain = mirrored(second);
        sum0 += first_gain.gain;
        sum1 += second_gain.gain;
        let impulse = first_gain.impulse + select(vec3<f32>(0.0), second_gain.impulse, thread < 88u);
        // The list of leavers is done with.
        for (var d = 0u; d < 3u; d++) {
            leavers[thread * 3u + d] = bitcast<u32>(impulse[d]);
        }
        workgroupBarrier();
        if thread < 3u {
            // P2G has noted here what its own folding gave, if there was any.
            var total = select(0.0, bitcast<f32>(lists[b * ENTRY + PENDING][thread]), walled != 0u);
            for (var t = 0u; t < 128u; t++) {
                total += bitcast<f32>(leavers[t * 3u + thread]);
            }
            lists[b * ENTRY + PENDING][thread] = bitcast<i32>(total);
        }
    }
    handed[b * 216u + thread] = sum0;
    if thread < 88u {
        handed[b * 216u + second] = sum1;
    }
}
