// Strains minus I, rounded to what 1 + x holds in 64 bits: so that a copy that is held as 1 + x comes back the same.
fn representable(x: f32) -> f32 {
    let quantum = 3.7252903e-9;
    return select(x, (x + quantum) - quantum, abs(x) < quantum);
}

// Strains below this mean nothing next to 1.
fn without_dust(x: f32) -> f32 {
    return select(x, 0.0, abs(x) < 1e-12);
}

// The trial strain F - I, or b - I of the left Cauchy-Green tensor, in a step with that increment of the velocity gradient.
fn trial_def_grad(strain: mat3x3<f32>, g: mat3x3<f32>) -> mat3x3<f32> {
    return strain + g + g * strain;
}

fn trial_left(strain: mat3x3<f32>, g: mat3x3<f32>) -> mat3x3<f32> {
    let half = strain + g * strain;
    let back = transpose(g);
    return half + half * back + g + back + g * back;
}

// `laws.rs` writes the text for which calls of `unrolled_...` stand: which numbers a particle holds depends on the laws of a scene.
//
// Carries the strain of a particle of that mass along with its velocity gradient `c`, and finds its stress.
fn deform(q: u32, law: u32, mass: f32, held: Held, c: mat3x3<f32>, dt: f32) {
    let volume = rest_volume(held);
    var strain: mat3x3<f32>;
    var state: array<f32, BARCHAN_MAX_STATE>;
    unrolled_load();
    let wanted = ceil(sqrt(dot(c[0], c[0]) + dot(c[1], c[1]) + dot(c[2], c[2])) * dt / MAX_DEFORMATION);
    let parts = clamp(wanted, 1.0, MAX_PARTS);
    if parts > 1.0 {
        atomicAdd(&status[sum_word(layer_now, PARTED)], 1u);
    }
    let step_part = dt / parts;
    let g = step_part * c;
    @if(damps)
    damped_now = 0.0;
    var out: MatOut;
    for (var part = 0u; part < u32(parts); part++) {
        var trial: mat3x3<f32>;
        @if(def_grads && lefts)
        if has_def_grad(law) {
            trial = trial_def_grad(strain, g);
        } else {
            trial = trial_left(strain, g);
        }
        @elif(def_grads)
        trial = trial_def_grad(strain, g);
        @else
        trial = trial_left(strain, g);
        var x: MatIn;
        x.strain = trial;
        if wants_rate(law) {
            x.vel_grad = c;
        }
        x.dt = step_part;
        out = update_material(law, x, param_base(law), &state);
        @if(damps)
        if is_damped(law) && dt > 0.0 {
            out.kirchhoff = damp(law, out.kirchhoff, trial, out.strain, g, step_part, volume);
        }
        strain = out.strain;
    }
    // Without a step, matter is as it was.
    if dt > 0.0 {
        unrolled_store();
    }
    @if(stiffens)
    need_now = 0u;
    @if(stiffens)
    if gives_stiffness(law) {
        @if(damps)
        let stiffness = with_damping(law, stiffness_of_material(law, strain, param_base(law), &state));
        @else
        let stiffness = stiffness_of_material(law, strain, param_base(law), &state);
        need_now = need_of(stiffness, mass, volume);
    }
    // Times the rest volume: [J].
    let tau = volume * out.kirchhoff;
    set_record(q, 1u, bitcast<vec4<u32>>(vec4<f32>(tau[2].x, tau[2].y, tau[2].z, mass)));
    set_record(q, 5u, bitcast<vec4<u32>>(vec4<f32>(tau[0].x, tau[1].y, tau[1].x, 0.0)));
}
