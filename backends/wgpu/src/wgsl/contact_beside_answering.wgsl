// Bodies that answer have noted which nodes they grip, in `press_answering.wgsl`. One that is deeper in a driven body is that one's.

// Nodes of the block that each body loses, as bits.
var<workgroup> lost: array<atomic<u32>, 2u * ANSWERING>;

// Where a body has noted which nodes of a block it grips; NONE if it grips none.
fn noted_at(b: u32, first: vec3<i32>, g: u32) -> u32 {
    let k = layer_now / LEVELS * ANSWERING + b;
    let level = level_of(layer_now);
    let near = near_at(k, level);
    if answering[near].x != slot_mark() {
        return NONE;
    }
    let cell = bitcast<vec3<i32>>(answering[state_of_body(k, state_now())].xyz) >> vec3<u32>(level);
    let at = vec3<u32>((image_near(layer_now, first, cell) >> vec3<u32>(2u)) - bitcast<vec3<i32>>(answering[near + 1u].xyz));
    let size = (vec3<u32>(answering[near].y) >> vec3<u32>(20u, 10u, 0u)) & vec3<u32>(1023u);
    let room = at.x + size.x * (at.y + size.y * at.z);
    if any(at >= size) || room >= rooms_of(k).y {
        return NONE;
    }
    let noted = room_at(k, level, room);
    return select(NONE, noted, answering[noted].x == slot_mark() && answering[noted].y == g);
}

// How far a node of the block is from the surface of a body [m].
fn distance_from(b: u32, first: vec3<i32>, n: u32) -> f32 {
    let k = layer_now / LEVELS * ANSWERING + b;
    let level = level_of(layer_now);
    let shrink = shrink_of(layer_now);
    let at = state_of_body(k, state_now());
    let cell = bitcast<vec3<i32>>(answering[at].xyz);
    let rows = rows_of(rotation_of(answering[at + 2u]));
    let base = cell >> vec3<u32>(level);
    let place = in_level(cell, place_of(answering[at + 1u]), vec3<f32>(0.0), level, shrink);
    let node = image_near(layer_now, first, base) + local_of(n);
    let width = extent.world.cell / shrink;
    let arm = (vec3<f32>(node - base) - place + vec3<f32>(0.5)) * width;
    return coupling_distance(answering[body_head(k)].x, arm.x * rows[0] + arm.y * rows[1] + arm.z * rows[2], width);
}

// The driven body that holds a node at that distance, unless the node is deeper in one that answers; of equals it is the first one's.
fn keeper(owner: u32, distance: f32, first: vec3<i32>, g: u32, n: u32) -> u32 {
    var kept = owner;
    for (var b = 0u; b < ANSWERING && owner != NONE; b++) {
        let noted = noted_at(b, first, g);
        if noted == NONE || ((answering[noted][2u + (n >> 5u)] >> (n & 31u)) & 1u) == 0u {
            continue;
        }
        let other = distance_from(b, first, n);
        let number = answering[body_head(layer_now / LEVELS * ANSWERING + b)].x;
        if distance < other || (distance == other && owner < number) {
            atomicOr(&lost[2u * b + (n >> 5u)], 1u << (n & 31u));
        } else {
            kept = NONE;
        }
    }
    workgroupBarrier();
    for (var b = n; b < ANSWERING; b += 64u) {
        let own = vec2<u32>(atomicLoad(&lost[2u * b]), atomicLoad(&lost[2u * b + 1u]));
        if any(own != vec2<u32>(0u)) {
            let noted = noted_at(b, first, g);
            let held = answering[noted];
            let deep = answering[noted + 1u];
            answering[noted] = vec4<u32>(held.xy, held.zw & ~own);
            answering[noted + 1u] = vec4<u32>(deep.xy & ~own, deep.zw);
        }
    }
    return kept;
}
