// What has crossed the sections of probes in a step, a workgroup a block. Where a particle was before it moved follows from its velocity as it is stored, by
// the same rounding: what stands on a section at the end of a step does so at the beginning of the next, and each crossing counts once.
//
// A section has two sums, along its normal and against it, of six numbers of four words: particles, mass, rest volume, momentum.
const CROSSED: u32 = 48u;

var<workgroup> go: u32;

fn ready(b: u32, layer: u32, first: vec3<i32>) -> u32 {
    let too_fast = atomicLoad(&status[fast_word(step.number)]);
    if atomicLoad(&status[HALTED]) != 0u || too_fast != 0u || b >= atomicLoad(&status[BLOCKS]) || !is_live(layer) {
        return 0u;
    }
    // A block's particles are within two cells of it, which is four cells wide: less than 7 from its middle.
    for (var s = 0u; s < SECTIONS; s++) {
        let section = place_at(PLACE * (layer * PROBED + s));
        let distance = dot(from_middle(section, first + vec3<i32>(2), vec3<u32>(0u)), section.normal);
        if section.kind != NOWHERE && abs(distance) < 8.0 {
            return 1u;
        }
    }
    return 0u;
}

// Does the part of a section's plane at this place belong to it?
fn holds(section: Place, at: vec3<f32>) -> bool {
    if section.kind == SQUARE {
        return all(at >= -section.half) && all(at < section.half);
    }
    let along = at - dot(at, section.normal) * section.normal;
    return dot(along, along) < section.half.x * section.half.x;
}

fn look(q: u32, layer: u32, first: vec3<i32>) {
    @if(sleeps)
    if (owners[q].y & OF_SLEEPERS) != 0u {
        return;
    }
    let p = record_of(q, 0u);
    let v = bitcast<vec3<f32>>(vec3<u32>(record_of(q, 2u).x, record_of(q, 3u).x, record_of(q, 4u).x));
    // As G2P moved it.
    let by_move = v * (step.dt_per_h * shrink_of(layer) * steps_of(layer));
    let moved = vec3<i32>(round(by_move * 4294967296.0));
    let before = p.xyz - bitcast<vec3<u32>>(moved);
    let up = (moved > vec3<i32>(0)) & (p.xyz < before);
    let down = (moved < vec3<i32>(0)) & (p.xyz > before);
    let cell = first + cell_of(p.w);
    let cell_before = cell - select(vec3<i32>(0), vec3<i32>(1), up) + select(vec3<i32>(0), vec3<i32>(1), down);
    for (var s = 0u; s < SECTIONS; s++) {
        let section = place_at(PLACE * (layer * PROBED + s));
        if section.kind == NOWHERE {
            continue;
        }
        let start = from_middle(section, cell_before, before);
        let there = from_middle(section, cell, p.xyz);
        let ends = vec2<f32>(dot(start, section.normal), dot(there, section.normal));
        if (ends.x < 0.0) == (ends.y < 0.0) {
            continue;
        }
        let at = start + ends.x / (ends.x - ends.y) * (there - start);
        if !holds(section, at) || !is_counted(section, law_of(p.w), ids[q].y) {
            continue;
        }
        let mass = bitcast<f32>(record_of(q, 1u).w);
        let sum = PLACE * LAYERS * PROBED + CROSSED * (layer / LEVELS * PROBED + s) + select(0u, 24u, ends.y < ends.x);
        add_exactly(sum, 1.0);
        add_exactly(sum + 4u, mass);
        add_exactly(sum + 8u, rest_of(q, REST - 1u).w);
        for (var d = 0u; d < 3u; d++) {
            add_exactly(sum + 12u + 4u * d, mass * v[d]);
        }
    }
}

@compute @workgroup_size(64)
fn see_crossed(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) n: u32) {
    let b = group.y * extent.row + group.x;
    let here = min(b, extent.block_room - 1u);
    let layer = u32(lists[here * ENTRY].w);
    let first = lists[here * ENTRY].xyz * 4;
    if n == 0u {
        go = ready(b, layer, first);
    }
    if workgroupUniformLoad(&go) == 0u {
        return;
    }
    let end = cells[here * 64u + 64u];
    for (var q = cells[here * 64u] + n; q < end; q += 64u) {
        look(q, layer, first);
    }
}
