const PRESSED_BODIES: u32 = ANSWERING;

// Blocks in a body's box, as `answer.wgsl` counts them: the first, and how many along each axis. Kept for where the forces go.
var<private> pressed_first: vec3<i32>;
var<private> pressed_size: vec3<i32>;

fn pressed_body(b: u32) -> PressedBody {
    let k = layer_now / LEVELS * ANSWERING + b;
    let level = level_of(layer_now);
    let shrink = shrink_of(layer_now);
    let at = state_of_body(k, state_now());
    let head = answering[body_head(k)];
    let cell = bitcast<vec3<i32>>(answering[at].xyz);
    let place = place_of(answering[at + 1u]);
    let number = head.x;
    let base = cell >> vec3<u32>(level);
    let rows = rows_of(rotation_of(answering[at + 2u]));
    let nodes = nodes_near(number, rows, cell, place, level, shrink);
    pressed_first = nodes[0] >> vec3<u32>(2u);
    pressed_size = (nodes[1] >> vec3<u32>(2u)) - pressed_first + vec3<i32>(1);
    var most = nodes[1];
    // It meets no level beyond.
    if level >= head.y {
        most = nodes[0] - vec3<i32>(1);
    }
    return PressedBody(nodes[0], most, base, in_level(cell, place, vec3<f32>(0.0), level, shrink), rows, number);
}

// The cell that the body's reference point is in.
fn pressed_cell(b: u32) -> vec3<i32> {
    let k = layer_now / LEVELS * ANSWERING + b;
    return bitcast<vec3<i32>>(answering[state_of_body(k, state_now())].xyz) >> vec3<u32>(level_of(layer_now));
}

// Is it so far from a block that its box need not be asked? Contact thickens a thin body by a cell.
fn may_be_near(b: u32, first: vec3<i32>) -> bool {
    let k = layer_now / LEVELS * ANSWERING + b;
    let cell = pressed_cell(b);
    let reach = i32(ceil(min(real(answering[body_head(k)]).w * shrink_of(layer_now), 1e6) + REACH)) + 3;
    return all(first + vec3<i32>(3) >= cell - vec3<i32>(reach)) && all(first <= cell + vec3<i32>(reach));
}

// May a node of the block be within reach of its surface? Boxes of long bodies that lean are mostly empty. The block's nodes are within 2.6 cells of its
// middle.
fn is_within_reach(body: PressedBody, first: vec3<i32>) -> bool {
    let width = extent.world.cell / shrink_of(layer_now);
    let arm = (vec3<f32>(first + vec3<i32>(2) - body.cell) - body.place) * width;
    let middle = arm.x * body.rows[0] + arm.y * body.rows[1] + arm.z * body.rows[2];
    return coupling_distance(body.number, middle, width) <= (REACH + 3.0) * width;
}

// Notes which blocks its box has.
fn note_near(b: u32) {
    let at = near_at(layer_now / LEVELS * ANSWERING + b, level_of(layer_now));
    let size = vec3<u32>(pressed_size);
    answering[at].y = (size.x << 20u) | (size.y << 10u) | size.z;
    answering[at + 1u] = vec4<u32>(bitcast<vec3<u32>>(pressed_first), 0u);
}

// The body that grips the thread's node, of several the one in which it is deepest; of equals the first one. How far it is from the surface [m],
// does it count as deep inside, and where the body notes which nodes of the block it grips.
var<private> owner: u32 = NONE;
var<private> owner_distance: f32;
var<private> owner_deep: bool;
var<private> owner_room: u32;
// Nodes of the block that a body grips, and those of them that are deep inside, as bits.
var<workgroup> gripped: array<atomic<u32>, 4>;

fn put_pressed(b: u32, body: PressedBody, g: u32, first: vec3<i32>, n: u32, force: vec3<f32>) {
    let cell = first + local_of(n);
    let at = vec3<u32>((first >> vec3<u32>(2u)) - pressed_first);
    let size = vec3<u32>(pressed_size);
    let room = at.x + size.x * (at.y + size.y * at.z);
    let k = layer_now / LEVELS * ANSWERING + b;
    // Nodes behind mirrors move as their images.
    if room >= rooms_of(k).y || any(cell < body.least) || any(cell > body.most) || is_behind(layer_now, cell) {
        return;
    }
    let width = extent.world.cell / shrink_of(layer_now);
    let rows = body.rows;
    let arm = (vec3<f32>(cell - body.cell) - body.place + vec3<f32>(0.5)) * width;
    let press = force * (step.dt * steps_of(layer_now));
    let grip = coupling_grip(body.number, arm.x * rows[0] + arm.y * rows[1] + arm.z * rows[2], width, press);
    if grip.kind == GRIP_NONE || (owner != NONE && grip.distance >= owner_distance) {
        return;
    }
    owner = b;
    owner_distance = grip.distance;
    owner_deep = grip.deep;
    let level = level_of(layer_now);
    owner_room = room_at(k, level, room);
    var normal = vec3<f32>(dot(rows[0], grip.normal), dot(rows[1], grip.normal), dot(rows[2], grip.normal));
    // The kind can be told from these.
    normal = select(normal, vec3<f32>(0.0), grip.kind == GRIP_STICK);
    let most = select(grip.most, -grip.most, grip.kind == GRIP_BILATERAL);
    answering[gripped_at(k, level, room, n)] = bitcast<vec4<u32>>(vec4<f32>(normal, most));
}

// Notes for each body near the block which nodes it grips.
fn end_pressed(g: u32, thread: u32) {
    for (var word = 0u; word < NEAR_WORDS; word++) {
        for (var bits = workgroupUniformLoad(&near[word]); bits != 0u; bits &= bits - 1u) {
            let is_owned = thread < NODES && owner == 32u * word + firstTrailingBit(bits);
            if is_owned {
                let bit = 1u << (thread & 31u);
                atomicOr(&gripped[thread >> 5u], bit);
                atomicOr(&gripped[2u + (thread >> 5u)], select(0u, bit, owner_deep));
            }
            workgroupBarrier();
            let own = vec2<u32>(atomicLoad(&gripped[0]), atomicLoad(&gripped[1]));
            let first = select(firstTrailingBit(own.x), 32u + firstTrailingBit(own.y), own.x == 0u);
            if is_owned && thread == first {
                answering[owner_room] = vec4<u32>(slot_mark(), g, own);
                answering[owner_room + 1u] = vec4<u32>(atomicLoad(&gripped[2]), atomicLoad(&gripped[3]), 0u, 0u);
                answering[near_at(layer_now / LEVELS * ANSWERING + owner, level_of(layer_now))].x = slot_mark();
            }
            workgroupBarrier();
            if thread < 4u {
                atomicStore(&gripped[thread], 0u);
            }
            workgroupBarrier();
        }
    }
}
