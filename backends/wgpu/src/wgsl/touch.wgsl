// Nodes inside free bodies. Around each body there are ROOMS rooms for blocks of all levels, finest first, a workgroup each, which lists its block's nodes in their
// order.
var<workgroup> go: u32;
var<workgroup> layer: u32;
var<workgroup> block: u32;
var<workgroup> first: vec3<i32>;
var<workgroup> least: vec3<i32>;
var<workgroup> most: vec3<i32>;
var<workgroup> rooms: u32;
var<workgroup> inside: array<atomic<u32>, 2>;
var<workgroup> deep: atomic<u32>;
var<workgroup> masses: array<f32, 64>;

// Finds the room's block of nodes, if it has one.
fn find_block(k: u32, level: u32, room: u32) {
    let at = state_at(k, state_now());
    let cell = bitcast<vec3<i32>>(lent[at].xyz);
    let place = place_of(lent[at + 1u]);
    let shrink = shrink_of(layer_now);
    let corners = coupling_box(lent[k * LENT + 3u].w, rows_of(rotation_of(lent[at + 2u])), H);
    let base = cell >> vec3<u32>(level);
    // Nodes stand at the centres of cells.
    let low = base + vec3<i32>(ceil(in_level(cell, place, corners[0], level, shrink) - 0.5));
    let high = base + vec3<i32>(floor(in_level(cell, place, corners[1], level, shrink) - 0.5));
    let first_block = low >> vec3<u32>(2u);
    let count = max((high >> vec3<u32>(2u)) - first_block + vec3<i32>(1), vec3<i32>(0));
    rooms = min(u32(count.x * count.y * count.z), rooms_on(level));
    least = low;
    most = high;
    block = NONE;
    if room < rooms {
        let r = i32(room);
        let b = first_block + vec3<i32>(r / (count.y * count.z), (r / count.z) % count.y, r % count.z);
        first = b * 4;
        // Bodies do not reach round a periodic world.
        let here = place_in_box(layer_now, b);
        if here != NONE && all(wrapped(layer_now, b) == b) {
            block = directory[here].y;
        }
    }
}

@compute @workgroup_size(64)
fn touch(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let w = group.y * extent.row + group.x;
    let k = w / ROOMS;
    var level = 0u;
    var room = w % ROOMS;
    while room >= rooms_on(level) {
        room -= rooms_on(level);
        level++;
    }
    if n == 0u {
        go = 0u;
        layer_now = min(k / FREES, WORLDS - 1u) * LEVELS + level;
        layer = layer_now;
        if atomicLoad(&status[HALTED]) == 0u && k < WORLDS * FREES && is_live(layer_now) && lent[k * LENT + 5u].w != 0u {
            go = 1u;
            find_block(k, level, room);
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    // By way of memory also where there is one layer only: Mesa 22.3 fails to compile an index of `layers` that it can tell in advance.
    layer_now = workgroupUniformLoad(&layer);
    let g = workgroupUniformLoad(&block);
    if g == NONE {
        if n == 0u {
            touches[w] = vec4<u32>(0u, 0u, 0u, rooms);
        }
        return;
    }
    let node = grid[g * 64u + n];
    let mass = $MASS;
    let own = first + local_of(n);
    var grip = CouplingGrip(0u, vec3<f32>(0.0), 0.0, false);
    var arm = vec3<f32>(0.0);
    let at = state_at(k, state_now());
    var rows = rows_of(rotation_of(lent[at + 2u]));
    if mass > layers[layer_now].least && all(own >= least) && all(own <= most) {
        let cell = bitcast<vec3<i32>>(lent[at].xyz);
        let centre = vec3<f32>(0.5 / shrink_of(layer_now)) - place_of(lent[at + 1u]);
        arm = (vec3<f32>((own << vec3<u32>(level)) - cell) + centre) * H;
        let x = arm.x * rows[0] + arm.y * rows[1] + arm.z * rows[2];
        grip = coupling_grip(lent[k * LENT + 3u].w, x, H / shrink_of(layer_now));
    }
    let touches_it = grip.kind != 0u;
    masses[n] = select(0.0, mass, touches_it);
    if touches_it {
        atomicOr(&inside[n >> 5u], 1u << (n & 31u));
        if grip.deep {
            atomicAdd(&deep, 1u);
        }
    }
    workgroupBarrier();
    let before = vec2<u32>(atomicLoad(&inside[0]), atomicLoad(&inside[1]));
    if touches_it {
        let lower = (1u << (n & 31u)) - 1u;
        let rank = select(countOneBits(before.x & lower), countOneBits(before.x) + countOneBits(before.y & lower), n >= 32u);
        let to = HEADS + (w * 64u + rank) * TOUCH;
        let normal = vec3<f32>(dot(rows[0], grip.normal), dot(rows[1], grip.normal), dot(rows[2], grip.normal));
        touches[to] = bitcast<vec4<u32>>(vec4<f32>(arm, mass));
        touches[to + 1u] = vec4<u32>(bitcast<vec3<u32>>(node.xyz), (g * 64u + n) | (grip.kind << 30u));
        touches[to + 2u] = bitcast<vec4<u32>>(vec4<f32>(normal, grip.friction));
    }
    for (var half = 32u; half > 0u; half = half >> 1u) {
        if n < half {
            masses[n] += masses[n + half];
        }
        workgroupBarrier();
    }
    if n == 0u {
        let count = countOneBits(before.x) + countOneBits(before.y);
        touches[w] = vec4<u32>(count, atomicLoad(&deep), bitcast<u32>(masses[0]), rooms);
    }
}
