// Contact with driven bodies: the coupling's law on the nodes in a body's box, and what they give to it.

var<workgroup> go: u32;
var<workgroup> near: u32;
var<workgroup> layer: u32;
var<workgroup> greatest: atomic<u32>;
var<workgroup> forces: array<vec4<f32>, 64>;
var<workgroup> torques: array<vec4<f32>, 64>;

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
    let width = H / shrink_of(layer_now);
    let first = lists[(extent.block_room + g) * ENTRY].xyz * 4;
    let cell = first + local_of(n);
    let node = grid[g * 64u + n];
    let mass = $MASS;
    var u = node.xyz;
    var changed = false;
    for (var b = 0u; b < BODIES; b++) {
        let at = ((slot_now() * LAYERS + layer_now) * BODIES + b) * BODY;
        let least = int_vector(bodies[at + 7u]);
        let most = int_vector(bodies[at + 8u]);
        if n == 0u {
            near = u32(all(first + vec3<i32>(3) >= least) && all(first <= most));
        }
        if workgroupUniformLoad(&near) == 0u {
            if n < 2u {
                partials[(g * BODIES + b) * 2u + n] = vec4<f32>(0.0);
            }
            continue;
        }
        var impulse = vec3<f32>(0.0);
        var arm = vec3<f32>(0.0);
        // Nodes behind mirrors move as their images.
        let is_own = mass > layers[layer_now].least && !is_behind(layer_now, cell);
        if is_own && all(cell >= least) && all(cell <= most) {
            arm = (vec3<f32>(cell - int_vector(bodies[at])) + (vec3<f32>(0.5) - bodies[at + 1u].xyz)) * width;
            let row0 = bodies[at + 2u].xyz;
            let row1 = bodies[at + 3u].xyz;
            let row2 = bodies[at + 4u].xyz;
            let surface = bodies[at + 5u].xyz + cross(bodies[at + 6u].xyz, arm);
            let relative = u - surface;
            let x = arm.x * row0 + arm.y * row1 + arm.z * row2;
            let before = relative.x * row0 + relative.y * row1 + relative.z * row2;
            let press = partials[pressed_at(g, b, n)].xyz * (step.dt * steps_of(layer_now) / mass);
            let kept = coupling_contact(b, x, before, width, press);
            if any(kept != before) {
                let taken = before - kept;
                let change = vec3<f32>(dot(row0, taken), dot(row1, taken), dot(row2, taken));
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
