// Couplings on the nodes in their bodies' boxes, and what these give to them: fields act first, in the scene's order; then a node is held by the driven body
// in which it is deepest, by the law of `contact_law.wgsl`, unless it is deeper in one that answers, which `keeper` knows: all threads of a workgroup call it.

const NEAR_WORDS: u32 = (BODIES + 31u) / 32u;

var<workgroup> go: u32;
// The bodies near whose boxes there are nodes of the block, as bits: first as threads find them, then to be read by all.
var<workgroup> found_near: array<atomic<u32>, NEAR_WORDS>;
var<workgroup> near: array<u32, NEAR_WORDS>;
var<workgroup> found_any: atomic<u32>;
var<workgroup> any_near: u32;
var<workgroup> layer: u32;
var<workgroup> greatest: atomic<u32>;
var<workgroup> forces: array<vec4<f32>, 64>;
var<workgroup> torques: array<vec4<f32>, 64>;

// From a body's reference point to a node [m].
fn arm_of(at: u32, cell: vec3<i32>, width: f32) -> vec3<f32> {
    return (vec3<f32>(cell - int_vector(bodies[at])) + (vec3<f32>(0.5) - bodies[at + 1u].xyz)) * width;
}

// A vector of the world's frame, seen from a body's.
fn in_body(at: u32, v: vec3<f32>) -> vec3<f32> {
    return v.x * bodies[at + 2u].xyz + v.y * bodies[at + 3u].xyz + v.z * bodies[at + 4u].xyz;
}

// The greatest component of a velocity, as much as a particle may feel of it.
fn felt_bits(u: vec3<f32>, mass: f32) -> u32 {
    let felt = min(mass * layers[layer_now].felt, 1.0);
    return max(max(magnitude_bits(felt * u.x), magnitude_bits(felt * u.y)), magnitude_bits(felt * u.z));
}

@compute @workgroup_size(64)
fn contact(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let g = group.y * extent.row + group.x;
    if n == 0u {
        go = u32(atomicLoad(&status[HALTED]) == 0u && g < atomicLoad(&status[NODE_BLOCKS]));
        layer = u32(lists[(extent.block_room + g) * ENTRY].w);
        go = select(0u, go, is_live(layer));
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    layer_now = workgroupUniformLoad(&layer);
    let width = extent.world.cell / shrink_of(layer_now);
    let own_first = lists[(extent.block_room + g) * ENTRY].xyz * 4;
    for (var b = n; b < BODIES; b += 64u) {
        let at = body_at(b);
        let first = image_near(layer_now, own_first, int_vector(bodies[at]));
        if all(first + vec3<i32>(3) >= int_vector(bodies[at + 7u])) && all(first <= int_vector(bodies[at + 8u])) {
            atomicOr(&found_near[b >> 5u], 1u << (b & 31u));
            atomicStore(&found_any, 1u);
        }
    }
    workgroupBarrier();
    for (var word = n; word < NEAR_WORDS; word += 64u) {
        near[word] = atomicLoad(&found_near[word]);
    }
    if n == 0u {
        any_near = atomicLoad(&found_any);
    }
    if workgroupUniformLoad(&any_near) == 0u {
        for (var at = n; at < 2u * BODIES; at += 64u) {
            partials[g * BODIES * 2u + at] = vec4<f32>(0.0);
        }
        return;
    }
    let node = grid[g * 64u + n];
    let mass = $MASS;
    var u = node.xyz;
    var changed = false;
    // Nodes behind mirrors move as their images.
    let is_own = mass > layers[layer_now].least && !is_behind(layer_now, own_first + local_of(n));
    // The body that holds the node, and how.
    var owner = NONE;
    var grip: CouplingGrip;
    for (var word = 0u; word < NEAR_WORDS; word++) {
        var left = near[word];
        while left != 0u {
            let b = 32u * word + firstTrailingBit(left);
            left &= left - 1u;
            let at = body_at(b);
            let cell = image_near(layer_now, own_first, int_vector(bodies[at])) + local_of(n);
            if !is_own || is_field(b) || any(cell < int_vector(bodies[at + 7u])) || any(cell > int_vector(bodies[at + 8u])) {
                continue;
            }
            let x = in_body(at, arm_of(at, cell, width));
            let press = partials[pressed_at(g, b, n)].xyz * (step.dt * steps_of(layer_now));
            let own = coupling_grip(b, x, width, press);
            if own.kind != GRIP_NONE && (owner == NONE || own.distance < grip.distance) {
                owner = b;
                grip = own;
                grip.most = most_of(own.most, mass);
            }
        }
    }
    owner = keeper(owner, grip.distance, own_first, g, n);
    // Fields have the lowest numbers.
    for (var word = 0u; word < NEAR_WORDS; word++) {
        let here = workgroupUniformLoad(&near[word]);
        for (var b = 32u * word; b < min(32u * word + 32u, BODIES); b++) {
            if (here & (1u << (b & 31u))) == 0u {
                if n < 2u {
                    partials[(g * BODIES + b) * 2u + n] = vec4<f32>(0.0);
                }
                continue;
            }
            var impulse = vec3<f32>(0.0);
            var arm = vec3<f32>(0.0);
            let at = body_at(b);
            let cell = image_near(layer_now, own_first, int_vector(bodies[at])) + local_of(n);
            let acts = is_field(b) && is_own && all(cell >= int_vector(bodies[at + 7u])) && all(cell <= int_vector(bodies[at + 8u]));
            if acts || b == owner {
                arm = arm_of(at, cell, width);
                let relative = u - (bodies[at + 5u].xyz + cross(bodies[at + 6u].xyz, arm));
                let before = in_body(at, relative);
                var kept = before;
                if acts {
                    kept = coupling_field(b, in_body(at, arm), before, mass, step.dt * steps_of(layer_now));
                } else {
                    let hold = hold_of(coupling_friction(b), grip, before);
                    if hold.held {
                        kept = kept_by(hold, before);
                    }
                }
                if any(kept != before) {
                    let taken = before - kept;
                    let change = vec3<f32>(dot(bodies[at + 2u].xyz, taken), dot(bodies[at + 3u].xyz, taken), dot(bodies[at + 4u].xyz, taken));
                    u -= change;
                    impulse = mass * change;
                    changed = true;
                }
            }
            forces[n] = vec4<f32>(impulse, 0.0);
            torques[n] = vec4<f32>(cross(arm, impulse), 0.0);
            workgroupBarrier();
            if n < 2u {
                var sum = vec4<f32>(0.0);
                for (var t = 0u; t < 64u; t++) {
                    sum += select(torques[t], forces[t], n == 0u);
                }
                partials[(g * BODIES + b) * 2u + n] = sum;
            }
            workgroupBarrier();
        }
    }
    if changed {
        grid[g * 64u + n] = vec4<f32>(u, node.w);
        let bits = felt_bits(u, mass);
        atomicMax(&greatest, bits);
        // Where ground is squeezed, nodes that hardly weigh anything shoot off into the body that squeezes it, and are held there.
        let was_too_fast = is_too_fast(layer_now, bitcast<f32>(felt_bits(node.xyz, mass)));
        let is_now = is_too_fast(layer_now, bitcast<f32>(bits));
        if was_too_fast && !is_now {
            atomicSub(&status[fast_word(step.number)], 1u);
        } else if is_now && !was_too_fast {
            atomicAdd(&status[fast_word(step.number)], 1u);
        }
    }
    workgroupBarrier();
    if n == 0u && atomicLoad(&greatest) > 0u {
        atomicMax(&status[step_word(step.number, layer_now, SPEED)], atomicLoad(&greatest));
    }
}
