// Grid to particles, a thread a particle: v = sum_i w_ip u_i, C = (4/h2) sum_i w_ip u_i (x_i - x_p)^T, x += dt v; then the material.
//
// Nodes are read where they stand: neighbours in memory are neighbours in space, and find them in the cache. The call of `unrolled_gather` stands for text
// that `unrolled.rs` writes out for each of the 27.

var<workgroup> go: u32;
// The layer of the first particle. Those of further layers note their moves by themselves.
var<workgroup> first_layer: u32;
var<workgroup> greatest_move: atomic<u32>;
@if(stiffens)
var<workgroup> greatest_need: atomic<u32>;

// Is this step short enough for the speeds that the nodes have?
fn ready(is_first: bool) -> u32 {
    let too_fast = atomicLoad(&status[fast_word(step.number)]);
    if atomicLoad(&status[HALTED]) != 0u {
        return 0u;
    }
    if too_fast != 0u {
        if is_first {
            atomicStore(&status[HALT_STEP], step.number);
            atomicStore(&status[HALTED], TOO_FAST);
        }
        return 0u;
    }
    return 1u;
}

// First node of a node block, by its place among the 27 around block `b`.
fn first_node(b: u32, x: u32, y: u32, z: u32) -> u32 {
    let which = x * 9u + y * 3u + z;
    return 64u * u32(lists[b * ENTRY + 1u + (which >> 2u)][which & 3u]);
}

// Carries a particle of block `b` through the step; the bits of its greatest move along an axis [cells].
fn carry(q: u32, b: u32) -> u32 {
    @if(asks)
    let mass = bitcast<f32>(owner.y);
    @else
    let mass = bitcast<f32>(owners[q].y);
    @if(asks)
    let p = place;
    @else
    let p = record_of(q, 0u);
    // Needed only later, but asked for now, so that it comes together with the nodes.
    let held = held_by(q);
    var cell = cell_of(p.w);
    let f = fraction(p);
    let wx = weights(f.x);
    let wy = weights(f.y);
    let wz = weights(f.z);
    // The first of its nodes, counted from the first of the blocks around; those nodes stand in up to two blocks an axis.
    let base = vec3<u32>(cell + vec3<i32>(3));
    let near = base >> vec3<u32>(2u);
    let far = (base + vec3<u32>(2u)) >> vec3<u32>(2u);
    var v = vec3<f32>(0.0);
    var by_x = vec3<f32>(0.0);
    var by_y = vec3<f32>(0.0);
    var by_z = vec3<f32>(0.0);
    unrolled_gather();
    let per_cell = extent.world.per_cell * shrink_of(layer_now);
    // From the distance of each node from the middle one to that from the particle.
    let c = mat3x3<f32>((by_x + (0.5 - f.x) * v) * per_cell, (by_y + (0.5 - f.y) * v) * per_cell, (by_z + (0.5 - f.z) * v) * per_cell);
    set_record(q, 2u, bitcast<vec4<u32>>(vec4<f32>(v.x, c[0].x, c[1].x, c[2].x)));
    set_record(q, 3u, bitcast<vec4<u32>>(vec4<f32>(v.y, c[0].y, c[1].y, c[2].y)));
    set_record(q, 4u, bitcast<vec4<u32>>(vec4<f32>(v.z, c[0].z, c[1].z, c[2].z)));
    @if(sleeps)
    note_speed(b, v);

    // The move, in counts of 2^-32 cells.
    let by_move = v * (step.dt_per_h * shrink_of(layer_now) * steps_of(layer_now));
    let counts = vec3<i32>(round(by_move * 4294967296.0));
    let moved = p.xyz + bitcast<vec3<u32>>(counts);
    let up = (counts > vec3<i32>(0)) & (moved < p.xyz);
    let down = (counts < vec3<i32>(0)) & (moved > p.xyz);
    cell += select(vec3<i32>(0), vec3<i32>(1), up) - select(vec3<i32>(0), vec3<i32>(1), down);
    set_record(q, 0u, vec4<u32>(moved, tag_at(p.w, clamp(cell, vec3<i32>(-2), vec3<i32>(5)), moved)));

    deform(q, law_of(p.w), mass, held, c, step.dt * steps_of(layer_now));
    return max(max(magnitude_bits(by_move.x), magnitude_bits(by_move.y)), magnitude_bits(by_move.z));
}

// Carries a particle through the step if its layer takes part and its block is awake, and notes how far it moved. To ask for the block's state would keep
// all waiting (a sixth of the pass on an H200), so that the mass of those asleep is marked.
fn take_along(q: u32) {
    @if(sleeps)
    let moves = is_live(layer_now) && (owner.y & OF_SLEEPERS) == 0u;
    @else
    let moves = is_live(layer_now);
    if moves {
        @if(asks)
        let by_most = carry(q, owner.x);
        @else
        let by_most = carry(q, owners[q].x);
        // Threads that would change nothing need not queue.
        if layer_now != first_layer {
            atomicMax(&status[step_word(step.number, layer_now, MOVE)], by_most);
        } else if by_most > atomicLoad(&greatest_move) {
            atomicMax(&greatest_move, by_most);
        }
        @if(stiffens)
        if layer_now != first_layer {
            atomicMax(&status[need_word(step.number, layer_now)], need_now);
        } else if need_now > atomicLoad(&greatest_need) {
            atomicMax(&greatest_need, need_now);
        }
        @if(damps)
        see_damped(layer_now == first_layer);
    } else {
        // The last lines of the pass tell of the first block.
        @if(sleeps)
        if is_live(layer_now) && owner.x != first_block {
            note_happened(owner.x, STEPPED);
        }
    }
}

@compute @workgroup_size(128)
fn g2p(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let first = (group.y * extent.row + group.x) * BY_WORKGROUP;
    @if(asks)
    ask(first + thread);
    if thread == 0u {
        go = ready(first == 0u);
        first_layer = layer_now;
        @if(sleeps)
        first_block = owner.x;
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    // Of very many, a thread takes several, so that workgroups start less often. For fewer the loop costs more than it saves.
    @if(several) {
        let end = min(first + BY_WORKGROUP, extent.particles);
        for (var q = first + thread; q < end; q += 128u) {
            take_along(q);
            @if(asks)
            ask(q + 128u);
        }
    }
    @else
    if first + thread < extent.particles {
        take_along(first + thread);
    }
    @if(damps)
    damped_by[thread] = damped_there;
    workgroupBarrier();
    if thread == 0u {
        @if(stiffens)
        atomicMax(&status[need_word(step.number, first_layer)], atomicLoad(&greatest_need));
        @if(damps)
        book_all_damped(first_layer);
        @if(sleeps)
        if is_live(first_layer) {
            atomicOr(&watch[watch_word(first_block, HAPPENED)], select(STEPPED, STEPPED | FAST, atomicLoad(&is_fast) != 0u));
        }
        @if(sleeps)
        if atomicLoad(&greatest_move) == 0u {
            return;
        }
        atomicMax(&status[step_word(step.number, first_layer, MOVE)], atomicLoad(&greatest_move));
    }
}
