// A wall that keeps the ground from passing but lets it leave, with Coulomb friction: a node before it and its image behind it are
// decided together. Pressing: the image's momentum is folded back reflected, and friction may take tangential momentum up to its
// coefficient times the normal impulse. Leaving: both move together, as if there were no wall.

var<workgroup> go: u32;
var<workgroup> given: array<vec4<f32>, 64>;

// The image of a node, as an index of the grid, or NONE; the wall's friction; the inward direction.
struct Image { at: u32, friction: f32, inward: f32 }

// Nodes behind mirrors make no pairs: they hold nothing any more but their masses, which the mirrors' impulse is reckoned with.
fn image_of(layer: u32, cell: vec3<i32>) -> Image {
    if is_behind(layer, cell) {
        return Image(NONE, 0.0, 0.0);
    }
    for (var end = 0; end < 2; end++) {
        let friction = select(LOW_FRICTION[AXIS], HIGH_FRICTION[AXIS], end == 1);
        if friction >= 0.0 {
            let inward = select(1, -1, end == 1);
            var image = cell;
            image[AXIS] = 2 * select(world_min(layer)[AXIS], world_max(layer)[AXIS], end == 1) - 1 - cell[AXIS];
            let depth = (cell[AXIS] - image[AXIS]) * inward;
            // Twice the distance to the wall is 1 or 3 for the two nodes that the spline can mirror.
            if depth >= 0 && depth < 4 {
                let at = place_in_box(layer, image >> vec3<u32>(2u));
                if at != NONE {
                    let g = directory[at].y;
                    if g != NONE {
                        let local = image & vec3<i32>(3);
                        return Image(g * 64u + u32(local.x * 16 + local.y * 4 + local.z), friction, f32(inward));
                    }
                }
            }
        }
    }
    return Image(NONE, 0.0, 0.0);
}

fn layer_of(g: u32) -> u32 {
    if LAYERS == 1u {
        return 0u;
    }
    return u32(lists[(extent.block_room + g) * ENTRY].w);
}

fn is_on(g: u32) -> u32 {
    return u32(atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]) && is_live(layer_of(g)));
}

fn cell_of_node(g: u32, n: u32) -> vec3<i32> {
    return lists[(extent.block_room + g) * ENTRY].xyz * 4 + local_of(n);
}

// Where what the wall gave to a pair is noted: impulse, and the image's mass, or -1 if the pair does not press.
fn note(image: u32) -> u32 {
    return AXIS * extent.node_room * 64u + image;
}

@compute @workgroup_size(64)
fn separate(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if is_on(g) == 0u || is_slave(g, n) {
        return;
    }
    let image = image_of(layer_of(g), cell_of_node(g, n));
    if image.at == NONE {
        return;
    }
    let p = grid[g * 64u + n];
    // What an image at a rim weighs, it has handed on.
    let found = grid[image.at];
    let q = select(found, vec4<f32>(0.0), found.w < 0.0);
    var sum = p + q;
    // A wall pushes or does nothing. Ground that has not reached it gives the image nothing, and is left alone.
    let presses = q[AXIS] * image.inward < 0.0;
    var impulse = vec3<f32>(0.0);
    if presses {
        let reflected = p[AXIS] - q[AXIS];
        impulse[AXIS] = reflected - sum[AXIS];
        var along = sum.xyz;
        along[AXIS] = 0.0;
        let tangential = length(along);
        if tangential > 0.0 {
            let kept = max(1.0 - image.friction * abs(impulse[AXIS]) / tangential, 0.0);
            impulse += (kept - 1.0) * along;
            along *= kept;
        }
        along[AXIS] = reflected;
        sum = vec4<f32>(along, sum.w);
    }
    grid[g * 64u + n] = sum;
    grid[image.at] = vec4<f32>(0.0);
    pairs[note(image.at)] = vec4<f32>(impulse, select(-1.0, q.w, presses));
}

@compute @workgroup_size(64)
fn mirror_back(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = is_on(g);
        // What a step that is too long does is not booked: it will be repeated.
        if atomicLoad(&status[fast_word(step.number)]) != 0u {
            go = 0u;
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    var impulse = vec3<f32>(0.0);
    let image = image_of(layer_of(g), cell_of_node(g, n));
    if image.at != NONE && !is_slave(g, n) {
        let noted = pairs[note(image.at)];
        var u = grid[g * 64u + n].xyz;
        impulse = noted.xyz;
        if noted.w >= 0.0 {
            impulse[AXIS] -= 2.0 * noted.w * u[AXIS];
            u[AXIS] = -u[AXIS];
        }
        grid[image.at] = vec4<f32>(u, 0.0);
        @if(pressed) {
            forget();
            see(layer_of(g), 2u * AXIS + u32(image.inward < 0.0), cell_of_node(g, n), impulse);
            add_pressed(layer_of(g), 0u);
        }
    }
    given[n] = vec4<f32>(impulse, 0.0);
    workgroupBarrier();
    if n == 0u {
        let entry = (extent.block_room + g) * ENTRY;
        var total = bitcast<vec4<f32>>(lists[entry + WALL]);
        for (var t = 0u; t < 64u; t++) {
            total += given[t];
        }
        lists[entry + WALL] = bitcast<vec4<i32>>(total);
    }
}
