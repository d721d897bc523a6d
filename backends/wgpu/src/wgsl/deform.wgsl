// Strains minus I, rounded to what 1 + x holds in 64 bits: so that a copy that is held as 1 + x comes back the same.
fn representable(x: f32) -> f32 {
    let quantum = 3.7252903e-9;
    return select(x, (x + quantum) - quantum, abs(x) < quantum);
}

// Strains below this mean nothing next to 1.
fn without_dust(x: f32) -> f32 {
    return select(x, 0.0, abs(x) < 1e-12);
}

// A particle's strain, history and rest volume.
struct Held {
    $FIELDS
}

fn held_by(q: u32) -> Held {
    var held: Held;
    $FETCH
    return held;
}

// Carries the strain of a particle of that mass along with its velocity gradient `c`, and finds its stress.
fn deform(q: u32, law: u32, mass: f32, held: Held, c: mat3x3<f32>, dt: f32) {
    $LOAD
    let wanted = ceil(sqrt(dot(c[0], c[0]) + dot(c[1], c[1]) + dot(c[2], c[2])) * dt / MAX_DEFORMATION);
    let parts = clamp(wanted, 1.0, MAX_PARTS);
    if parts > 1.0 {
        atomicAdd(&status[sum_word(layer_now, PARTED)], 1u);
    }
    let step_part = dt / parts;
    let g = step_part * c;
    $UNDAMPED
    var out: MatOut;
    for (var part = 0u; part < u32(parts); part++) {
        var trial: mat3x3<f32>;
        $TRIAL
        var x: MatIn;
        x.strain = trial;
        if wants_rate(law) {
            x.vel_grad = c;
        }
        x.dt = step_part;
        out = update_material(law, x, param_base(law), &state);
        $DAMP
        strain = out.strain;
    }
    // Without a step, matter is as it was.
    if dt > 0.0 {
        $STORE
    }
    $NEED
    // Times the rest volume: [J].
    let tau = $VOLUME * out.kirchhoff;
    set_record(q, 1u, bitcast<vec4<u32>>(vec4<f32>(tau[2].x, tau[2].y, tau[2].z, mass)));
    set_record(q, 5u, bitcast<vec4<u32>>(vec4<f32>(tau[0].x, tau[1].y, tau[1].x, 0.0)));
}
