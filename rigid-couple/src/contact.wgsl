// The contact law of `contact.rs` and the distances of `sdf.rs`, for driven bodies made of primitives.
//
// coupling_table(i) holds, for each body: first part, parts, 0 stick | 1 Coulomb, friction; and from there for each part: primitive,
// half its thickness; sizes; origin; and the three rows of its rotation.

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

fn rigid_primitive(kind: f32, size: vec3<f32>, x: vec3<f32>) -> RigidSurface {
    switch i32(kind) {
        case 0: { return rigid_direction(x, size.x, length(x) - size.x); }
        case 1: { return rigid_box(x, size); }
        case 2: { return rigid_cylinder(x, size.x, size.y); }
        case 3: {
            let arm = x - vec3<f32>(0.0, 0.0, clamp(x.z, -size.y, size.y));
            return rigid_direction(arm, size.x, length(arm) - size.x);
        }
        default: { return RigidSurface(x.z, vec3<f32>(0.0, 0.0, 1.0), true); }
    }
}

// What is left of the velocity `u` [m/s], relative to the surface, of a node at `x` [m] from the body's reference point; all in the
// body's frame. `cell` is the cell's width [m].
fn coupling_contact(body: u32, x: vec3<f32>, u: vec3<f32>, cell: f32) -> vec3<f32> {
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
        var surface = rigid_primitive(kind.x, coupling_table(at + 1u).xyz, back);
        // Thin parts are grown to two cells.
        surface.distance -= max(cell - kind.y, 0.0);
        if surface.distance < nearest.distance {
            let n = surface.normal;
            nearest = RigidSurface(surface.distance, vec3<f32>(dot(row0, n), dot(row1, n), dot(row2, n)), surface.known);
            half_thickness = kind.y;
        }
    }
    if nearest.distance >= 0.0 {
        return u;
    }
    if head.z == 0.0 || !nearest.known || nearest.distance < -2.0 * cell {
        return vec3<f32>(0.0);
    }
    let core = half_thickness < 1.5 * cell && -nearest.distance > max(half_thickness, cell) - 0.75 * cell;
    let approach = -dot(u, nearest.normal);
    let tangential = u + approach * nearest.normal;
    if approach <= 0.0 {
        return select(u, tangential, core);
    }
    let speed = length(tangential);
    let taken = head.w * approach;
    if taken >= speed && head.w > 0.0 {
        return vec3<f32>(0.0);
    }
    return tangential * (1.0 - taken / max(speed, 1e-30));
}
