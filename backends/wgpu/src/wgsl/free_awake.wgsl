// Where ground stays awake for the body in the next slot, as the host says for the first.
    let first_layer = k / FREES * LEVELS;
    let number = lent[k * LENT + 3u].w;
    let first_box = 1u + 2u * ((slot_now() + 1u) * LAYERS + first_layer) * u32(tools[0].x);
    if first_box < arrayLength(&tools) {
        let corners = coupling_box(number, rows_of(rotation_of(rotation)), H);
        let within = place_of(place);
        for (var level = 0u; level < LEVELS; level++) {
            let layer = first_layer + level;
            let base = cell >> vec3<u32>(level);
            let low = in_level(cell, within, corners[0], level, shrink_of(layer)) - NEAR_TOOL;
            let high = in_level(cell, within, corners[1], level, shrink_of(layer)) + NEAR_TOOL;
            let to = first_box + 2u * (level * u32(tools[0].x) + number);
            tools[to] = vec4<i32>((base + vec3<i32>(floor(low))) >> vec3<u32>(2u), 0);
            tools[to + 1u] = vec4<i32>((base + vec3<i32>(floor(high))) >> vec3<u32>(2u), 0);
        }
    }
