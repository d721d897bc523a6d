// What the ground gives to parts of walls in a step, a workgroup a block, once nodes have their velocities and before particles move. A particle gives momentum to nodes
// behind walls, which these turn round, and reads velocities there that are turned round: both is the wall's impulse, and so much the ground gives to it.

var<workgroup> go: u32;

fn is_short_enough() -> bool {
    return atomicLoad(&status[HALTED]) == 0u && atomicLoad(&status[fast_word(step.number)]) == 0u;
}

fn ready(b: u32, layer: u32, first: vec3<i32>) -> u32 {
    if !is_short_enough() || b >= atomicLoad(&status[BLOCKS]) || !is_live(layer) {
        return 0u;
    }
    return u32(reaches_wall(layer, first - vec3<i32>(2)));
}

fn look(q: u32, b: u32, layer: u32, first: vec3<i32>) {
    forget();
    let p = record_of(q, 0u);
    let s = bitcast<vec4<f32>>(record_of(q, 1u));
    let r0 = bitcast<vec4<f32>>(record_of(q, 2u));
    let r1 = bitcast<vec4<f32>>(record_of(q, 3u));
    let r2 = bitcast<vec4<f32>>(record_of(q, 4u));
    let t = bitcast<vec4<f32>>(record_of(q, 5u));
    let cell = cell_of(p.w);
    let f = fraction(p);
    let wx = weights(f.x);
    let wy = weights(f.y);
    let wz = weights(f.z);
    // As P2G gives it: momentum of the particle at its own place, and what that grows by in a cell along each axis.
    let stress = step.stress * shrink_of(layer) * steps_of(layer);
    var gravity = step.gravity * steps_of(layer);
    if GRAVITY_GROWS {
        gravity *= bitcast<f32>(atomicLoad(&status[step_word(step.number, layer, GROWN)]));
    }
    let grows = s.w * extent.world.cell / shrink_of(layer);
    var own = s.w * (vec3<f32>(r0.x, r1.x, r2.x) + gravity);
    var ax = grows * r0.yzw + stress * vec3<f32>(t.x, t.z, s.x);
    var ay = grows * r1.yzw + stress * vec3<f32>(t.z, t.y, s.y);
    var az = grows * r2.yzw + stress * s.xyz;
    @if(sleeps)
    let sleeps = (owners[q].y & OF_SLEEPERS) != 0u;
    @if(sleeps)
    if sleeps {
        // It gives nothing anew, but it weighs on nodes that it shares with ground awake.
        own = vec3<f32>(0.0);
        ax = vec3<f32>(0.0);
        ay = vec3<f32>(0.0);
        az = vec3<f32>(0.0);
    }
    let low = world_min(layer);
    let high = world_max(layer);
    for (var n = 0; n < 27; n++) {
        let by = vec3<i32>(n / 9, n / 3 % 3, n % 3);
        let local = cell + by - vec3<i32>(1);
        var at = first + local;
        let below = (LOW != vec3<u32>(0u)) & (at < low);
        let above = (HIGH != vec3<u32>(0u)) & (at >= high);
        if !any(below | above) {
            continue;
        }
        let w = wx[by.x] * wy[by.y] * wz[by.z];
        let away = vec3<f32>(by) - vec3<f32>(0.5) - f;
        var given = w * (own + vec3<f32>(dot(ax, away), dot(ay, away), dot(az, away)));
        let mass = w * s.w;
        // The node's block among the 27 around.
        let to = vec3<u32>(local + vec3<i32>(4));
        let which = (to.x >> 2u) * 9u + (to.y >> 2u) * 3u + (to.z >> 2u);
        let block = u32(lists[b * ENTRY + 1u + (which >> 2u)][which & 3u]);
        @if(sleeps)
        if sleeps && atomicLoad(&watch[touched_word(block)]) == 0u {
            continue;
        }
        var u = grid[block * 64u + (to.x & 3u) * 16u + (to.y & 3u) * 4u + (to.z & 3u)].xyz;
        // Along the first axis first, as P2G folds; what is read comes back the same way.
        for (var axis = 0; axis < 3; axis++) {
            if !below[axis] && !above[axis] {
                continue;
            }
            let signs = wall_signs(select(HIGH[axis], LOW[axis], below[axis]), axis);
            u *= signs;
            see(layer, 2u * u32(axis) + u32(above[axis]), at, (signs - vec3<f32>(1.0)) * (given + mass * u));
            given *= signs;
            at[axis] = select(2 * high[axis] - 1, 2 * low[axis] - 1, below[axis]) - at[axis];
        }
    }
    add_pressed(layer, 0u);
}

@compute @workgroup_size(64)
fn see_pressed(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = group.y * extent.row + group.x;
    let here = min(b, extent.block_room - 1u);
    let layer = u32(lists[here * ENTRY].w);
    let first = lists[here * ENTRY].xyz * 4;
    @if(levels)
    if b == 0u && is_short_enough() {
        take_up(n);
    }
    if n == 0u {
        go = ready(b, layer, first);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let end = cells[here * 64u + 64u];
    for (var q = cells[here * 64u] + n; q < end; q += 64u) {
        look(q, here, layer, first);
    }
}
