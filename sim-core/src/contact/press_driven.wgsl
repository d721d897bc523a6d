const PRESSED_BODIES: u32 = BODIES;

fn pressed_body(b: u32) -> PressedBody {
    let at = body_at(b);
    let rows = array<vec3<f32>, 3>(bodies[at + 2u].xyz, bodies[at + 3u].xyz, bodies[at + 4u].xyz);
    let least = int_vector(bodies[at + 7u]);
    // On fields nothing presses.
    let most = select(int_vector(bodies[at + 8u]), least - vec3<i32>(1), is_field(b));
    return PressedBody(least, most, int_vector(bodies[at]), bodies[at + 1u].xyz, rows, b);
}

fn pressed_cell(b: u32) -> vec3<i32> {
    return int_vector(bodies[body_at(b)]);
}

fn put_pressed(b: u32, body: PressedBody, g: u32, first: vec3<i32>, n: u32, force: vec3<f32>) {
    partials[pressed_at(g, b, n)] = vec4<f32>(force, 0.0);
}

fn end_pressed(g: u32, thread: u32) {}

fn note_near(b: u32) {}

fn may_be_near(b: u32, first: vec3<i32>) -> bool {
    return true;
}

fn is_within_reach(body: PressedBody, first: vec3<i32>) -> bool {
    return true;
}
