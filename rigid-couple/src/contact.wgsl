// The contact law of `contact.rs` and the distances of `sdf.rs`, for all shapes.
//
// coupling_table(i) holds, for each body: first part, parts, 0 stick | 1 Coulomb, friction; and from there for each part: primitive,
// half its thickness, where samples begin; sizes; origin; and the three rows of its rotation. Of what is sampled, the origin is the middle of the
// box around it, and sizes are half that box's.

struct RigidSurface { distance: f32, normal: vec3<f32>, known: bool }

fn rigid_direction(v: vec3<f32>, scale: f32, distance: f32) -> RigidSurface {
    let size = length(v);
    if size > 1e-7 * scale {
        return RigidSurface(distance, v / size, true);
    }
    return RigidSurface(distance, vec3<f32>(0.0), false);
}

fn rigid_sign(x: f32) -> f32 {
    return select(-1.0, 1.0, x >= 0.0);
}

fn rigid_box(x: vec3<f32>, half: vec3<f32>) -> RigidSurface {
    let q = abs(x) - half;
    let out = max(q, vec3<f32>(0.0));
    let size = length(out);
    if size > 0.0 {
        return RigidSurface(size, out / size * sign(x), true);
    }
    if q.x >= q.y && q.x >= q.z {
        return RigidSurface(q.x, vec3<f32>(rigid_sign(x.x), 0.0, 0.0), true);
    }
    if q.y >= q.z {
        return RigidSurface(q.y, vec3<f32>(0.0, rigid_sign(x.y), 0.0), true);
    }
    return RigidSurface(q.z, vec3<f32>(0.0, 0.0, rigid_sign(x.z)), true);
}

fn rigid_cylinder(x: vec3<f32>, radius: f32, half_height: f32) -> RigidSurface {
    let radial = vec3<f32>(x.xy, 0.0);
    let rho = length(radial);
    let a = rho - radius;
    let b = abs(x.z) - half_height;
    let cap = vec3<f32>(0.0, 0.0, rigid_sign(x.z));
    if a > 0.0 && b > 0.0 {
        let distance = length(vec2<f32>(a, b));
        return RigidSurface(distance, (radial * (a / rho) + b * cap) / distance, true);
    }
    if a > b {
        return rigid_direction(radial, radius, a);
    }
    return RigidSurface(b, cap, true);
}

fn rigid_primitive(kind: vec4<f32>, size: vec3<f32>, x: vec3<f32>) -> RigidSurface {
    switch i32(kind.x) {
        case 0: { return rigid_direction(x, size.x, length(x) - size.x); }
        case 1: { return rigid_box(x, size); }
        case 2: { return rigid_cylinder(x, size.x, size.y); }
        case 3: {
            let arm = x - vec3<f32>(0.0, 0.0, clamp(x.z, -size.y, size.y));
            return rigid_direction(arm, size.x, length(arm) - size.x);
        }
        case 5: { return rigid_mesh(u32(kind.z), x); }
        case 6: { return rigid_heights(u32(kind.z), size, x); }
        default: { return RigidSurface(x.z, vec3<f32>(0.0, 0.0, 1.0), true); }
    }
}

// How the surface grips a node.
struct CouplingGrip { kind: u32, normal: vec3<f32>, friction: f32, deep: bool }
const RIGID_OUTSIDE: u32 = 0u;
const RIGID_STICK: u32 = 1u;
const RIGID_COULOMB: u32 = 2u;
// In the core of thin plates, where the node may not separate either.
const RIGID_BILATERAL: u32 = 3u;

// How the surface grips a node at `x` [m] from the body's reference point, in the body's frame. `cell` is the cell's width [m].
fn coupling_grip(body: u32, x: vec3<f32>, cell: f32) -> CouplingGrip {
    let head = coupling_table(body);
    var nearest = RigidSurface(1e30, vec3<f32>(0.0), false);
    var half_thickness = 0.0;
    for (var part = 0u; part < u32(head.y); part++) {
        let at = u32(head.x) + 6u * part;
        let kind = coupling_table(at);
        let local = x - coupling_table(at + 2u).xyz;
        // The rows of the rotation from the part's frame to the body's are columns of the way back.
        let row0 = coupling_table(at + 3u).xyz;
        let row1 = coupling_table(at + 4u).xyz;
        let row2 = coupling_table(at + 5u).xyz;
        let back = local.x * row0 + local.y * row1 + local.z * row2;
        var surface = rigid_primitive(kind, coupling_table(at + 1u).xyz, back);
        // Thin parts are grown to two cells.
        surface.distance -= max(cell - kind.y, 0.0);
        if surface.distance < nearest.distance {
            let n = surface.normal;
            nearest = RigidSurface(surface.distance, vec3<f32>(dot(row0, n), dot(row1, n), dot(row2, n)), surface.known);
            half_thickness = kind.y;
        }
    }
    if nearest.distance >= 0.0 {
        return CouplingGrip(RIGID_OUTSIDE, vec3<f32>(0.0), 0.0, false);
    }
    let deep = nearest.distance < -2.0 * cell;
    if head.z == 0.0 || !nearest.known || deep {
        return CouplingGrip(RIGID_STICK, vec3<f32>(0.0), 0.0, deep);
    }
    let core = half_thickness < 1.5 * cell && -nearest.distance > max(half_thickness, cell) - 0.75 * cell;
    return CouplingGrip(select(RIGID_COULOMB, RIGID_BILATERAL, core), nearest.normal, head.w, false);
}

// What is left of the velocity `u` [m/s], relative to the surface, of a node at `x` [m] from the body's reference point; all in the
// body's frame. `cell` is the cell's width [m].
fn coupling_contact(body: u32, x: vec3<f32>, u: vec3<f32>, cell: f32) -> vec3<f32> {
    let grip = coupling_grip(body, x, cell);
    if grip.kind == RIGID_OUTSIDE {
        return u;
    }
    if grip.kind == RIGID_STICK {
        return vec3<f32>(0.0);
    }
    let approach = -dot(u, grip.normal);
    let tangential = u + approach * grip.normal;
    if approach <= 0.0 {
        return select(u, tangential, grip.kind == RIGID_BILATERAL);
    }
    let speed = length(tangential);
    let taken = grip.friction * approach;
    if taken >= speed && grip.friction > 0.0 {
        return vec3<f32>(0.0);
    }
    return tangential * (1.0 - taken / max(speed, 1e-30));
}

// What the law takes from a relative velocity u: K u with K = drag + (1 - drag) n nT, if anything is held; n = 0 and drag = 1 if all is. Where the
// node slides, drag = friction |u_n| / |u_t|, with u_t along `along`.
struct CouplingHold { held: bool, normal: vec3<f32>, drag: f32, along: vec3<f32>, friction: f32 }

fn coupling_hold(grip: CouplingGrip, u: vec3<f32>) -> CouplingHold {
    let all = CouplingHold(true, vec3<f32>(0.0), 1.0, vec3<f32>(0.0), 0.0);
    if grip.kind == RIGID_STICK {
        return all;
    }
    let approach = -dot(u, grip.normal);
    let normal_only = CouplingHold(true, grip.normal, 0.0, vec3<f32>(0.0), 0.0);
    if approach <= 0.0 {
        let nothing = CouplingHold(false, vec3<f32>(0.0), 0.0, vec3<f32>(0.0), 0.0);
        if grip.kind == RIGID_BILATERAL {
            return normal_only;
        }
        return nothing;
    }
    if grip.friction == 0.0 {
        return normal_only;
    }
    let tangential = u + approach * grip.normal;
    let speed = length(tangential);
    if grip.friction * approach >= speed {
        return all;
    }
    return CouplingHold(true, grip.normal, grip.friction * approach / speed, tangential / speed, grip.friction);
}

// The corners of a body's box from its reference point [m], along the world's axes, if `rows` are those of its rotation. Contact in cells of
// width `cell` [m] thickens it.
fn coupling_box(body: u32, rows: array<vec3<f32>, 3>, cell: f32) -> array<vec3<f32>, 2> {
    let head = coupling_table(body);
    var least = vec3<f32>(1e30);
    var most = vec3<f32>(-1e30);
    for (var part = 0u; part < u32(head.y); part++) {
        let at = u32(head.x) + 6u * part;
        let kind = coupling_table(at);
        let size = coupling_table(at + 1u).xyz;
        var half = size;
        switch i32(kind.x) {
            case 0: { half = vec3<f32>(size.x); }
            case 1, 5, 6: {}
            case 2: { half = vec3<f32>(size.x, size.x, size.y); }
            case 3: { half = vec3<f32>(size.x, size.x, size.x + size.y); }
            default: { half = vec3<f32>(1e30); }
        }
        let origin = coupling_table(at + 2u).xyz;
        let part0 = coupling_table(at + 3u).xyz;
        let part1 = coupling_table(at + 4u).xyz;
        let part2 = coupling_table(at + 5u).xyz;
        let padding = max(cell - kind.y, 0.0);
        var reach = vec3<f32>(0.0);
        reach.x = dot(abs(rows[0].x * part0 + rows[0].y * part1 + rows[0].z * part2), half) + padding;
        reach.y = dot(abs(rows[1].x * part0 + rows[1].y * part1 + rows[1].z * part2), half) + padding;
        reach.z = dot(abs(rows[2].x * part0 + rows[2].y * part1 + rows[2].z * part2), half) + padding;
        let centre = vec3<f32>(dot(rows[0], origin), dot(rows[1], origin), dot(rows[2], origin));
        least = min(least, centre - reach);
        most = max(most, centre + reach);
    }
    return array<vec3<f32>, 2>(least, most);
}
