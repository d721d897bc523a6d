// What the nodes at the rim of a layer's region hold is handed to their parents on the next coarser layer: mass m_c = sum_f P m_f, momentum
// p_c = sum_f P (p_f + M_f (x_c - x_f)), with the affine momentum M_f, which is the node's mass times the mean C about it. Per axis a node at
// the even index 2I has the parents I (3/4) and I - 1 (1/4), one at 2I + 1 has I and I + 1. So the parents of a block's nodes, and
// the parent cells around it, are 4x4x4, from one before the block's first on.

// In `exchange` there stand, column by column, columns of m C, with the mass behind the first: of parent cells, then about nodes, then of nodes. Behind
// them, momentum and mass of nodes; then of parents.
const SUMS: u32 = 192u;

var<workgroup> is_walled: u32;

fn column(n: u32, j: u32) -> u32 {
    return 64u * j + n;
}

// Brings the parent cell with the place of this thread; behind a mirror stands the image of one before it.
fn fetch_parent_cell(layer: u32, first: vec3<i32>, n: u32) {
    var cell = first + local_of(n);
    // M becomes S M R: the signs of velocities, and of the axes that are turned round.
    var signs = vec3<f32>(1.0);
    var turned = vec3<f32>(1.0);
    for (var axis = 0; axis < 3; axis++) {
        let low = world_min(layer + 1u)[axis];
        let high = world_max(layer + 1u)[axis];
        let is_low = LOW[axis] != 0u && cell[axis] < low;
        if is_low || (HIGH[axis] != 0u && cell[axis] >= high) {
            cell[axis] = 2 * select(high, low, is_low) - 1 - cell[axis];
            signs *= wall_signs(select(HIGH[axis], LOW[axis], is_low), axis);
            turned[axis] = -1.0;
        }
    }
    let at = place_in_box(layer, cell >> vec3<u32>(1u));
    var b = NONE;
    if at != NONE {
        b = directory[at].x;
    }
    let is_summed = b != NONE && rims[extent.node_room + min(b, extent.block_room - 1u)].x != 0u;
    let inner = vec3<u32>(cell & vec3<i32>(1));
    for (var j = 0u; j < 3u; j++) {
        exchange[column(n, j)] = vec4<f32>(0.0);
        if is_summed {
            let held = handed[of_parent_cell(b, inner.x * 4u + inner.y * 2u + inner.z, j)];
            exchange[column(n, j)] = vec4<f32>(signs * turned[j] * held.xyz, held.w);
        }
    }
}

// Along one axis, means about nodes from sums of parent cells: the quadratic spline of twice the cell's width.
fn spread(n: u32, place: i32, stride: u32) {
    let first = n - u32(place) * stride + u32(place >> 1u) * stride;
    let is_odd = (place & 1) == 1;
    let before = select(9.0 / 32.0, 1.0 / 32.0, is_odd);
    let after = select(1.0 / 32.0, 9.0 / 32.0, is_odd);
    var to: array<vec4<f32>, 3>;
    for (var j = 0u; j < 3u; j++) {
        to[j] = before * exchange[column(first, j)] + 0.6875 * exchange[column(first + stride, j)] + after * exchange[column(first + 2u * stride, j)];
    }
    workgroupBarrier();
    for (var j = 0u; j < 3u; j++) {
        exchange[column(n, j)] = to[j];
    }
    workgroupBarrier();
}

// Along one axis, what parents get of nodes: of their sums by their shares, and of the columns of that axis by shares times ways.
fn gather(n: u32, place: i32, stride: u32, axis: u32) {
    let first = max(2 * place - 3, 0);
    let last = min(2 * place, 3);
    let row = n - u32(place) * stride;
    var to = array<vec4<f32>, 4>();
    // Never more than three.
    for (var i = 0; i < 3; i++) {
        let child = row + u32(min(first + i, last)) * stride;
        let way = 2.0 * f32(place) - 1.5 - f32(first + i);
        let share = select(0.0, 1.0 - 0.5 * abs(way), first + i <= last);
        for (var j = 0u; j < 4u; j++) {
            to[j] += select(share, share * way, j == axis) * exchange[column(child, j)];
        }
    }
    workgroupBarrier();
    for (var j = 0u; j < 4u; j++) {
        exchange[column(n, j)] = to[j];
    }
    workgroupBarrier();
}

// Parents behind a mirror are images: what they get is their nodes', reflected. What a parent gets that way; of images, the negative of what
// they give away, so that nothing is left.
struct Mirrored { gain: vec4<f32>, impulse: vec3<f32> }

fn mirrored(layer: u32, first: vec3<i32>, n: u32) -> Mirrored {
    var out = Mirrored(vec4<f32>(0.0), vec3<f32>(0.0));
    let low = world_min(layer + 1u);
    let high = world_max(layer + 1u);
    let cell = first + local_of(n);
    let behind = ((LOW != vec3<u32>(0u)) & (cell < low)) | ((HIGH != vec3<u32>(0u)) & (cell >= high));
    if any(behind) {
        out.gain = -exchange[SUMS + n];
        return out;
    }
    for (var which = 1u; which < 8u; which++) {
        var image = local_of(n);
        var signs = vec3<f32>(1.0);
        var exists = true;
        for (var axis = 0; axis < 3; axis++) {
            if (which & (1u << u32(axis))) != 0u {
                // A slave's parent is one cell behind a wall at most.
                let at_low = LOW[axis] != 0u && cell[axis] == low[axis];
                let at_high = HIGH[axis] != 0u && cell[axis] + 1 == high[axis];
                image[axis] += select(1, -1, at_low);
                signs *= wall_signs(select(HIGH[axis], LOW[axis], at_low), axis);
                exists = exists && (at_low || at_high) && image[axis] >= 0 && image[axis] < 4;
            }
        }
        if exists {
            let given = exchange[SUMS + u32(image.x * 16 + image.y * 4 + image.z)];
            out.gain += vec4<f32>(signs, 1.0) * given;
            out.impulse += (signs - vec3<f32>(1.0)) * given.xyz;
        }
    }
    return out;
}

// What the parent with this thread's place gets of a block's nodes, before walls turn it; `node` is what the node at the rim holds that this thread has, or nothing.
fn to_parents(layer: u32, first: vec3<i32>, n: u32, node: vec4<f32>) -> vec4<f32> {
    let place = local_of(n);
    fetch_parent_cell(layer, first, n);
    workgroupBarrier();
    spread(n, place.x, 16u);
    spread(n, place.y, 4u);
    spread(n, place.z, 1u);

    let near = exchange[column(n, 0u)].w;
    let part = select(0.0, node.w / near, near > 0.0);
    for (var j = 0u; j < 3u; j++) {
        exchange[column(n, j)] *= part;
    }
    exchange[SUMS + n] = node;
    workgroupBarrier();
    gather(n, place.x, 16u, 0u);
    gather(n, place.y, 4u, 1u);
    gather(n, place.z, 1u, 2u);
    let carried = exchange[column(n, 0u)].xyz + exchange[column(n, 1u)].xyz + exchange[column(n, 2u)].xyz;
    return exchange[SUMS + n] + vec4<f32>(carried, 0.0);
}

fn hand_on(g: u32, entry: u32, n: u32, node: vec4<f32>) {
    let layer = layer_of(g);
    let first = 2 * lists[entry].xyz - vec3<i32>(1);
    var sum = to_parents(layer, first, n, node);
    // Elsewhere, walls give nothing.
    if n == 0u {
        is_walled = u32(has_nodes_behind(layer + 1u, first));
    }
    if workgroupUniformLoad(&is_walled) != 0u {
        exchange[SUMS + n] = sum;
        workgroupBarrier();
        let gain = mirrored(layer, first, n);
        sum += gain.gain;
        let total = sum_of_block(n, gain.impulse);
        if n == 0u {
            let before = select(vec4<f32>(0.0), bitcast<vec4<f32>>(lists[entry + WALL]), MIRRORED);
            lists[entry + TO_BOOK] = bitcast<vec4<i32>>(before + total);
        }
    }
    handed[g * 64u + n] = sum;
}
