// How bodies grip nodes, as in `grip.rs`, and the distances of `sdf.rs`, for all shapes.
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

// A surface further out by so much.
fn rigid_offset(surface: RigidSurface, by: f32) -> RigidSurface {
    return RigidSurface(surface.distance - by, surface.normal, surface.known);
}

// Edges of boxes and cylinders are rounded to the radius `edge`.
fn rigid_primitive(kind: vec4<f32>, size: vec3<f32>, x: vec3<f32>, edge: f32) -> RigidSurface {
    switch i32(kind.x) {
        case 0: { return rigid_direction(x, size.x, length(x) - size.x); }
        case 1: { return rigid_offset(rigid_box(x, size - vec3<f32>(edge)), edge); }
        case 2: { return rigid_offset(rigid_cylinder(x, size.x - edge, size.y - edge), edge); }
        case 3: {
            let arm = x - vec3<f32>(0.0, 0.0, clamp(x.z, -size.y, size.y));
            return rigid_direction(arm, size.x, length(arm) - size.x);
        }
        case 5: { return rigid_mesh(u32(kind.z), x); }
        case 6: { return rigid_heights(u32(kind.z), size, x); }
        default: { return RigidSurface(x.z, vec3<f32>(0.0, 0.0, 1.0), true); }
    }
}

// A body's surface as contact sees it on a grid, and whether the point is in the core of a thin part.
struct RigidNear { surface: RigidSurface, core: bool }

// At `x` [m] from the body's reference point, in the body's frame. `cell` is the cell's width [m].
fn rigid_near(body: u32, x: vec3<f32>, cell: f32) -> RigidNear {
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
        // Thin parts are grown to two cells, which rounds their edges, too.
        let padding = max(cell - kind.y, 0.0);
        let edge = clamp(1.5 * cell - padding, 0.0, kind.y);
        let surface = rigid_primitive(kind, coupling_table(at + 1u).xyz, back, edge);
        if surface.distance - padding < nearest.distance {
            let n = surface.normal;
            let normal = vec3<f32>(dot(row0, n), dot(row1, n), dot(row2, n));
            nearest = RigidSurface(surface.distance - padding, normal, surface.known);
            half_thickness = kind.y;
        }
    }
    let core = half_thickness < 1.5 * cell && -nearest.distance > max(half_thickness, cell) - 0.75 * cell;
    return RigidNear(nearest, core);
}

// How far a point is from a body's surface as contact sees it [m], negative inside.
fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32 {
    return rigid_near(body, x, cell).surface.distance;
}

// The greatest force [N] with which a particle at `x` presses on a body, in the body's frame: half as wide as `half` [m], with an elastic modulus [Pa].
fn coupling_press(body: u32, x: vec3<f32>, half: f32, modulus: f32, cell: f32) -> vec3<f32> {
    let surface = rigid_near(body, x, cell).surface;
    let overlap = min((half - surface.distance) / (2.0 * half), 0.9);
    if overlap <= 0.0 || !surface.known {
        return vec3<f32>(0.0);
    }
    return (4.0 * modulus * half * half * overlap / (1.0 - overlap)) * surface.normal;
}

// At `x` [m] from the body's reference point, in the body's frame, where particles press by `press`: their forces times the step [N s].
fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip {
    let near = rigid_near(body, x, cell);
    let distance = near.surface.distance;
    let most = length(press);
    let none = vec3<f32>(0.0);
    if distance < -2.0 * cell {
        return CouplingGrip(GRIP_STICK, none, GRIP_UNBOUNDED, true, distance);
    }
    if coupling_table(body).z == 0.0 {
        let bound = select(most, GRIP_UNBOUNDED, distance < 0.0);
        return CouplingGrip(select(GRIP_NONE, GRIP_STICK, bound > 0.0), none, bound, false, distance);
    }
    if near.core && near.surface.known {
        return CouplingGrip(GRIP_BILATERAL, near.surface.normal, GRIP_UNBOUNDED, false, distance);
    }
    if most == 0.0 {
        return CouplingGrip(GRIP_NONE, none, 0.0, false, distance);
    }
    return CouplingGrip(GRIP_COULOMB, press / most, most, false, distance);
}

// A body's coefficient of friction.
fn coupling_friction(body: u32) -> f32 {
    return coupling_table(body).w;
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
        // Half the size of a box along its axes, and how much further it reaches on all sides.
        var half = size;
        var further = max(cell - kind.y, 0.0);
        switch i32(kind.x) {
            case 0: {
                half = vec3<f32>(0.0);
                further += size.x;
            }
            case 1, 5, 6: {}
            case 2: { half = vec3<f32>(size.x, size.x, size.y); }
            case 3: {
                half = vec3<f32>(0.0, 0.0, size.y);
                further += size.x;
            }
            default: { half = vec3<f32>(1e30); }
        }
        let origin = coupling_table(at + 2u).xyz;
        let part0 = coupling_table(at + 3u).xyz;
        let part1 = coupling_table(at + 4u).xyz;
        let part2 = coupling_table(at + 5u).xyz;
        var reach = vec3<f32>(0.0);
        reach.x = dot(abs(rows[0].x * part0 + rows[0].y * part1 + rows[0].z * part2), half) + further;
        reach.y = dot(abs(rows[1].x * part0 + rows[1].y * part1 + rows[1].z * part2), half) + further;
        reach.z = dot(abs(rows[2].x * part0 + rows[2].y * part1 + rows[2].z * part2), half) + further;
        let centre = vec3<f32>(dot(rows[0], origin), dot(rows[1], origin), dot(rows[2], origin));
        least = min(least, centre - reach);
        most = max(most, centre + reach);
    }
    return array<vec3<f32>, 2>(least, most);
}
