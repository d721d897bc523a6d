// The contact law between nodes and bodies, as `contact.rs` has it.

// How a surface grips a node: the kind of law; the unit normal out of the body; the greatest impulse that may be taken [N s], or the greatest speed [m/s], once the
// node's mass is known; does the node count as deep inside; and how far it is from the surface [m].
struct CouplingGrip { kind: u32, normal: vec3<f32>, most: f32, deep: bool, distance: f32 }
const GRIP_NONE: u32 = 0u;
const GRIP_STICK: u32 = 1u;
const GRIP_COULOMB: u32 = 2u;
// In the core of thin plates, where the node may not separate either.
const GRIP_BILATERAL: u32 = 3u;
const GRIP_UNBOUNDED: f32 = 3e38;

// The greatest speed that may be taken from a node of some mass [m/s].
fn most_of(impulse: f32, mass: f32) -> f32 {
    return select(impulse / mass, GRIP_UNBOUNDED, impulse >= GRIP_UNBOUNDED * mass);
}

// What the law takes from a relative velocity u: K u with K = hold n nT + drag (1 - n nT), if anything is held; n = 0 and drag = hold if that is
// isotropic. Where the node slides, drag = friction |f_n| / |u_t|, with u_t along `along`. `bounded`: is the normal part held by less than all?
struct Hold { held: bool, normal: vec3<f32>, hold: f32, drag: f32, bounded: bool, along: vec3<f32>, friction: f32 }

fn hold_of(friction: f32, grip: CouplingGrip, u: vec3<f32>) -> Hold {
    let none = vec3<f32>(0.0);
    if grip.kind == GRIP_STICK {
        let share = min(grip.most / max(length(u), 1e-30), 1.0);
        return Hold(true, none, share, share, false, none, 0.0);
    }
    let approach = -dot(u, grip.normal);
    if approach <= 0.0 {
        return Hold(grip.kind == GRIP_BILATERAL, grip.normal, 1.0, 0.0, false, none, 0.0);
    }
    let bounded = approach > grip.most;
    let taken = min(approach, grip.most);
    let hold = select(1.0, grip.most / approach, bounded);
    if friction == 0.0 {
        return Hold(true, grip.normal, hold, 0.0, bounded, none, 0.0);
    }
    let tangential = u + approach * grip.normal;
    let speed = length(tangential);
    if friction * taken >= speed {
        return Hold(true, grip.normal, hold, 1.0, bounded, none, 0.0);
    }
    return Hold(true, grip.normal, hold, friction * taken / speed, bounded, tangential / speed, friction);
}

// What is left of a relative velocity: (1 - K) u.
fn kept_by(hold: Hold, u: vec3<f32>) -> vec3<f32> {
    let along = dot(u, hold.normal) * hold.normal;
    return (1.0 - hold.hold) * along + (1.0 - hold.drag) * (u - along);
}
