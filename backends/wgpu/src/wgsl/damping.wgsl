// Damping of elastic strain; transfer.rs of the grid says why it is this.

// What it has dissipated of the particle that was worked on last [J].
var<private> damped_now: f32;

// Its constants stand behind the law's parameters: beta lambda and beta mu [Pa s].
fn damping_of(law: u32) -> Lame {
    let base = param_base(law) + damping_at(law);
    return Lame(barchan_param(base, 0u), barchan_param(base, 1u));
}

fn with_damping(law: u32, s: Stiffness) -> Stiffness {
    if !is_damped(law) {
        return s;
    }
    let d = damping_of(law);
    return Stiffness(s.p_wave, s.triple_bulk, s.viscosity + d.mu + 0.5 * max(d.lambda, 3.0 * d.lambda));
}

// b - I of a strain minus I.
fn b_of(law: u32, strain: mat3x3<f32>) -> Sym {
    if has_def_grad(law) {
        return barchan_left_cauchy_green(strain);
    }
    return barchan_sym(strain);
}

// Adds to a stress what damping gives for a strain that grew by G = `g` over `dt`, from `trial` to `strain` by flow, of so much rest volume.
fn damp(law: u32, kirchhoff: mat3x3<f32>, trial: mat3x3<f32>, strain: mat3x3<f32>, g: mat3x3<f32>, dt: f32, volume: f32) -> mat3x3<f32> {
    let d = damping_of(law);
    let before = b_of(law, trial);
    let b = b_of(law, strain);
    let square = barchan_left_cauchy_green(g);
    let flow = 1.0 / (1.0 + barchan_trace(b) * (1.0 / 3.0));
    let rate = barchan_affine(0.5 / dt, Sym(square.d + flow * (b.d - before.d), square.o + flow * (b.o - before.o)), 0.0);
    let swelling = barchan_trace(rate);
    damped_now += volume * dt * (d.lambda * swelling * swelling + 2.0 * d.mu * barchan_norm2(rate));
    return kirchhoff + barchan_mat(barchan_affine(2.0 * d.mu, rate, d.lambda * swelling));
}
