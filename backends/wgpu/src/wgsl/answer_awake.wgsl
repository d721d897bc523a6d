// Where ground stays awake for the body in the next slot, as the host says for the first.
    let first_layer = group_now / GROUPS * LEVELS;
    let first_box = 1u + 2u * ((slot_now() + 1u) * LAYERS + first_layer) * u32(tools[0].x);
    if first_box < arrayLength(&tools) {
        let corners = coupling_box(head.x, rows_of(rotation_of(bitcast<vec4<u32>>(pose.rotation))), extent.world.cell);
        let within = place_of(vec4<u32>(pose.place, 0u));
        for (var level = 0u; level < LEVELS; level++) {
            let layer = first_layer + level;
            let base = pose.cell >> vec3<u32>(level);
            let low = in_level(pose.cell, within, corners[0], level, shrink_of(layer)) - NEAR_TOOL;
            let high = in_level(pose.cell, within, corners[1], level, shrink_of(layer)) + NEAR_TOOL;
            let to = first_box + 2u * (level * u32(tools[0].x) + head.x);
            tools[to] = vec4<i32>((base + vec3<i32>(floor(low))) >> vec3<u32>(2u), 0);
            tools[to + 1u] = vec4<i32>((base + vec3<i32>(floor(high))) >> vec3<u32>(2u), 0);
        }
    }
