// Grid to particles, a block at a time: v = sum_i w_ip u_i, C = (4/h2) sum_i w_ip u_i (x_i - x_p)^T, x += dt v; then the material.

var<workgroup> tile: array<vec4<f32>, 512>;
var<workgroup> go: u32;
var<workgroup> corner: vec3<i32>;
var<workgroup> scratch: array<vec4<f32>, 64>;
var<workgroup> greatest_move: atomic<u32>;
var<workgroup> greatest_rate: atomic<u32>;

fn in_tile(x: u32, y: u32, z: u32) -> u32 {
    return x * 64u + y * 8u + z;
}

fn weights(f: f32) -> vec3<f32> {
    let left = 1.0 - f;
    let middle = 0.5 - f;
    return vec3<f32>(0.5 * left * left, fma(-middle, middle, 0.75), 0.5 * f * f);
}

// Is this step short enough for the speeds that the nodes have?
fn ready(b: u32) -> u32 {
    if atomicLoad(&status[HALTED]) != 0u || b >= atomicLoad(&status[BLOCKS]) {
        return 0u;
    }
    let speed = bitcast<f32>(atomicLoad(&status[greatest_word(step.number)]));
    if !(speed * step.dt_per_h <= NODE_MOVE) {
        if b == 0u {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], TOO_FAST);
        }
        return 0u;
    }
    return u32(is_live(u32(lists[b * ENTRY].w)));
}

@compute @workgroup_size(256)
fn g2p(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let b = group.y * extent.row + group.x;
    if thread == 0u {
        go = ready(b);
        if go != 0u {
            corner = lists[b * ENTRY].xyz * 4 - vec3<i32>(2);
        }
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }

    layer_now = u32(lists[b * ENTRY].w);

    // 1. The velocities around the block.
    for (var t = thread; t < 512u; t += 256u) {
        let node = vec3<i32>(i32(t >> 6u), i32((t >> 3u) & 7u), i32(t & 7u)) + vec3<i32>(2);
        let by = node >> vec3<u32>(2u);
        let which = u32(by.x * 9 + by.y * 3 + by.z);
        let g = u32(lists[b * ENTRY + 1u + (which >> 2u)][which & 3u]);
        let local = node & vec3<i32>(3);
        var u = vec4<f32>(0.0);
        if g != NONE {
            u = grid[g * 64u + u32(local.x * 16 + local.y * 4 + local.z)];
        }
        tile[t] = u;
    }
    workgroupBarrier();

    // 2. Nodes behind mirrors move as their images.
    var impulse = vec3<f32>(0.0);
    let origin = workgroupUniformLoad(&corner);
    var walls = false;
    for (var axis = 2; axis >= 0; axis--) {
        for (var end_of_axis = 1; end_of_axis >= 0; end_of_axis--) {
            let kind = select(LOW[axis], HIGH[axis], end_of_axis == 1);
            let sum = 2 * (select(WORLD_MIN[axis], WORLD_MAX[axis], end_of_axis == 1) - origin[axis]) - 1;
            if kind != 0u && sum >= 1 && sum <= 13 {
                walls = true;
                if thread < 64u {
                    for (var image = 0; image < 8; image++) {
                        let node = sum - image;
                        let beyond = select((image < node), (image > node), (end_of_axis == 1));
                        if beyond && node >= 0 && node < 8 {
                            let to = in_plane(axis, u32(image), thread);
                            let u = tile[in_plane(axis, u32(node), thread)].xyz;
                            let signs = wall_signs(kind, axis);
                            tile[to] = vec4<f32>(signs * u, 0.0);
                            if !behind(axis, thread, origin) {
                                let mass = grid[extent.node_room * 64u + b * 512u + to].w;
                                impulse += (signs - vec3<f32>(1.0)) * u * mass;
                            }
                        }
                    }
                }
            }
        }
        workgroupBarrier();
    }
    if walls {
        if thread < 64u {
            scratch[thread] = vec4<f32>(impulse, 0.0);
        }
        workgroupBarrier();
        if thread == 0u {
            var total = bitcast<vec4<f32>>(lists[b * ENTRY + WALL]) + bitcast<vec4<f32>>(lists[b * ENTRY + PENDING]);
            for (var t = 0u; t < 64u; t++) {
                total += scratch[t];
            }
            lists[b * ENTRY + WALL] = bitcast<vec4<i32>>(total);
        }
    }

    // 3. The particles.
    var moves = 0u;
    var rate = 0u;
    let end = cells[b * 64u + 64u];
    for (var q = cells[b * 64u] + thread; q < end; q += 256u) {
        let p = record[RECORD * q];
        var cell = cell_of(p.w);
        let f = vec3<f32>(p.xyz >> vec3<u32>(8u)) * 5.9604645e-8;
        let wx = weights(f.x);
        let wy = weights(f.y);
        let wz = weights(f.z);
        let first = u32(((cell.x + 1) * 8 + cell.y + 1) * 8 + cell.z + 1);
        $GATHER
        // From the distance of each node from the middle one to that from the particle.
        let c = mat3x3<f32>((by_x + (0.5 - f.x) * v) * PER_CELL, (by_y + (0.5 - f.y) * v) * PER_CELL, (by_z + (0.5 - f.z) * v) * PER_CELL);
        record[RECORD * q + 2u] = bitcast<vec4<u32>>(vec4<f32>(v.x, c[0].x, c[1].x, c[2].x));
        record[RECORD * q + 3u] = bitcast<vec4<u32>>(vec4<f32>(v.y, c[0].y, c[1].y, c[2].y));
        record[RECORD * q + 4u] = bitcast<vec4<u32>>(vec4<f32>(v.z, c[0].z, c[1].z, c[2].z));

        // The move, in counts of 2^-32 cells.
        let by_move = v * step.dt_per_h;
        let counts = vec3<i32>(round(by_move * 4294967296.0));
        let moved = p.xyz + bitcast<vec3<u32>>(counts);
        let up = (counts > vec3<i32>(0)) & (moved < p.xyz);
        let down = (counts < vec3<i32>(0)) & (moved > p.xyz);
        cell += select(vec3<i32>(0), vec3<i32>(1), up) - select(vec3<i32>(0), vec3<i32>(1), down);
        record[RECORD * q] = vec4<u32>(moved, (p.w & 0xfffffe00u) | tag_of(clamp(cell, vec3<i32>(-2), vec3<i32>(5))));

        moves = max(moves, max(max(magnitude_bits(by_move.x), magnitude_bits(by_move.y)), magnitude_bits(by_move.z)));
        let norm2 = dot(c[0], c[0]) + dot(c[1], c[1]) + dot(c[2], c[2]);
        rate = max(rate, magnitude_bits(norm2));
        deform(q, law_of(p.w), c, norm2, step.dt);
    }
    atomicMax(&greatest_move, moves);
    atomicMax(&greatest_rate, rate);
    workgroupBarrier();
    if thread == 0u {
        atomicMax(&status[step_word(step.number, layer_now, MOVE)], atomicLoad(&greatest_move));
        atomicMax(&status[step_word(step.number, layer_now, RATE)], atomicLoad(&greatest_rate));
    }
}
