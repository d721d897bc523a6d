//! Which bodies flow apart, since neither walls nor their own strength hold them, and how far they may get.

use crate::account::BATCH;
use crate::batch::{Answer, Matter, Plane};
use crate::coupling::Aabb;
use crate::material::ErrorBuffer;
use crate::plan::PlannedMaterial;
use crate::probe::invariants;
use crate::scene::{Body, Motion, Scene, Wall};

/// Shears at which a material is asked what it bears: what yields at all has yielded there.
const SHEARS: [f64; 2] = [0.25, 0.5];
/// What bears so many times as much at the greater of them has not.
const ELASTIC: f64 = 1.5;
/// Compression at which it is asked how much of a pressure it bears as shear, the logarithm of the stretch.
const PRESSED: f64 = 1e-3;
/// Height of a vertical face that stands by itself over strength by weight per volume.
const FACE: f64 = 4.0;
/// A body that is lower than this share of half its width is a bed, of which only the edges flow.
const LOW: f64 = 0.25;
/// What bears less of a pressure as shear than this does not come to rest before a wall.
const FLUID: f64 = 0.02;
/// Share of gravity along x or y from which on ground slides that way.
const STEEP: f64 = 0.1;
/// Share of the height that ground falls from by which it runs out as if it were so much higher.
const FALLEN: f64 = 0.3;
/// Most that ground runs out, in heights.
const MOST: f64 = 20.0;

/// What may hold a body.
pub(crate) struct Ends {
    /// Whether nothing does, neither the world's end nor another body: below and above along x, and along y.
    pub(crate) sides: [[bool; 2]; 2],
    /// The same below it.
    pub(crate) below: bool,
}

/// Where a body may get.
#[derive(Default)]
pub(crate) struct Runout {
    /// Does it flow apart along x, along y?
    pub(crate) along: [bool; 2],
    /// Is it a fluid, which mixes as soon as something stirs it, whatever holds it?
    pub(crate) mixes: bool,
    /// The box that it may come to fill, inside the world [m]; none where it stays about where it is.
    pub(crate) reaches: Option<Aabb>,
}

/// Where a body of such materials and so much volume [m³] may get, in gravity that is greatest along z.
///
/// Dry grains run out by 1.2 of their height, whatever their friction is. A slender column runs out by 1.9 height^(2/3) width^(1/3) in a channel, and by 1.6 √(height radius) to
/// all sides. A fluid runs out until it is as thin as a particle, or as fast as a dam breaks.
///
/// # Source
/// Lube, Huppert, Sparks and Freundt, Physical Review E 72 (2005) 041301, and Journal of Fluid Mechanics 508 (2004) 175.
pub(crate) fn of_body<'a>(
    scene: &Scene,
    body: &Body,
    bounds: &Aabb,
    ends: impl FnOnce() -> Ends,
    volume: impl FnOnce() -> f64,
    materials: impl Iterator<Item = &'a PlannedMaterial>,
) -> Runout {
    let (world, end) = (&scene.world, scene.time.end);
    let g = scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
    let size: [f64; 3] = std::array::from_fn(|d| bounds.max[d] - bounds.min[d]);
    let height = if g > 0.0 { (0..3).map(|d| scene.gravity[d].abs() / g * size[d]).sum() } else { 0.0 };
    let collapsing: Vec<&PlannedMaterial> = materials.filter(|planned| collapses(planned, scene, height)).collect();
    let flies = body.velocity != [0.0; 3];
    if collapsing.is_empty() && !flies {
        return Runout::default();
    }
    let ends = ends();
    let is_fluid = collapsing.iter().any(|planned| {
        shear_borne(planned, PRESSED, SHEARS[1]).is_some_and(|[pressure, shear]| shear <= FLUID * pressure)
    });
    let is_one_sided = |d: usize| ends.sides[d][0] != ends.sides[d][1];
    let half = |d: usize| if is_one_sided(d) { size[d] } else { 0.5 * size[d] };
    let is_upright = (0..2).all(|d| scene.gravity[d].abs() <= scene.gravity[2].abs());
    let mixes = is_fluid && is_upright;
    let flows = |d: usize| (ends.sides[d] != [false; 2] || ends.below) && (is_fluid || height > LOW * half(d));
    let along = if collapsing.is_empty() || !is_upright { [false; 2] } else { [flows(0), flows(1)] };
    if scene.levels.reach > 0 || !flies && along == [false; 2] {
        return Runout { along, mixes, reaches: None };
    }
    let is_open = world.walls.z_min == Wall::Open;
    let drop = if ends.below && !is_open { bounds.min[2] - world.min[2] } else { 0.0 };
    // What lies as thin as a particle covers this.
    let area = if is_fluid { volume() / scene.spacing(body) } else { 0.0 };
    let run = |d: usize| {
        let (across, other, half) = (size[d], size[1 - d], half(d));
        let (tall, round) = (height + FALLEN * drop, along == [true; 2] && other < 2.0 * across);
        let grains = if tall < 1.7 * half {
            1.2 * tall
        } else if round {
            1.6 * (tall * half).sqrt()
        } else {
            1.9 * (tall * tall * half).cbrt()
        };
        if !is_fluid {
            return grains;
        }
        let thin = if round { (area / std::f64::consts::PI).sqrt() } else { area / other * half / across };
        grains.max((thin - half).min(2.0 * (g * (height + drop)).sqrt() * end))
    };
    let mut reaches = *bounds;
    if flies {
        let fall = scene.gravity[2].min(0.0).abs();
        let [.., up] = body.velocity;
        let time = if fall > 0.0 { (up + (up * up + 2.0 * fall * drop.max(0.0)).sqrt()) / fall } else { end };
        let top = if fall > 0.0 { up.max(0.0).powi(2) / (2.0 * fall) } else { (up * end).max(0.0) };
        for d in 0..2 {
            let by = body.velocity[d] * time.clamp(0.0, end);
            (reaches.min[d], reaches.max[d]) = (reaches.min[d] + by.min(0.0), reaches.max[d] + by.max(0.0));
        }
        reaches.max[2] += top;
    }
    for d in (0..2).filter(|d| along[*d]) {
        let down = scene.gravity[d];
        let slides = if down.abs() > STEEP * g { 0.5 * down.abs() * end * end } else { 0.0 };
        let by = |sign: f64| (run(d) + if down * sign > 0.0 { slides } else { 0.0 }).min(MOST * height);
        (reaches.min[d], reaches.max[d]) = (reaches.min[d] - by(-1.0), reaches.max[d] + by(1.0));
    }
    if ends.below && along != [false; 2] {
        reaches.min[2] = world.min[2];
    }
    Runout { along, mixes, reaches: Some(reaches.intersection(&scene.world_box())) }
}

/// Does anything in a scene stir a fluid that walls hold: what flows in or out, flies or flows apart, a tool that moves, a robot, gravity that is not along z? One that nothing
/// stirs stays in balance to rounding on a lattice, and only there.
pub(crate) fn is_stirred(scene: &Scene, runouts: &[Runout]) -> bool {
    let flows = !scene.inflow.is_empty() || !scene.outflow.is_empty();
    let moves = !scene.robot.is_empty() || scene.tool.iter().any(|tool| !matches!(tool.motion, Motion::Fixed));
    let falls = runouts.iter().any(|runout| runout.along != [false; 2]);
    let flies = scene.body.iter().any(|body| [body.velocity, body.angular_velocity] != [[0.0; 3]; 2]);
    let slides = scene.gravity[0] != 0.0 || scene.gravity[1] != 0.0;
    flows || moves || falls || flies || slides
}

/// Does a face of a material that is so high [m] fall down?
pub(crate) fn collapses(planned: &PlannedMaterial, scene: &Scene, height: f64) -> bool {
    let g = scene.gravity.iter().map(|g| g * g).sum::<f64>().sqrt();
    strength(planned).is_some_and(|strength| FACE * strength < planned.density * g * height)
}

/// Shear stress that a material bears without pressure [Pa]; none if it does not say, or if it does not yield.
fn strength(planned: &PlannedMaterial) -> Option<f64> {
    let [_, little] = shear_borne(planned, 0.0, SHEARS[0])?;
    let [_, much] = shear_borne(planned, 0.0, SHEARS[1])?;
    (much <= ELASTIC * little).then_some(much)
}

/// Pressure and shear stress [Pa] of a material that is sheared by so much while it is pressed together, by the logarithm of the stretch. None if it does
/// not say.
fn shear_borne(planned: &PlannedMaterial, pressed: f64, shear: f64) -> Option<[f64; 2]> {
    let material = &planned.material;
    let filled = |values: &[f64]| values.iter().map(|value| Plane([*value; BATCH])).collect::<Vec<_>>();
    let stretch = (-pressed).exp();
    let mut trial = filled(material.strain_identity());
    let sheared: &[(usize, f64)] = match trial.len() {
        9 => &[(0, stretch), (1, stretch * shear), (4, stretch), (8, stretch)],
        // The left Cauchy-Green tensor of the same.
        6 => {
            let square = stretch * stretch;
            &[(0, square * (1.0 + shear * shear)), (1, square), (2, square), (3, square * shear)]
        }
        _ => return None,
    };
    sheared.iter().for_each(|(plane, value)| trial[*plane] = Plane([*value; BATCH]));
    let initial = filled(&material.states.iter().map(|state| state.initial).collect::<Vec<_>>());
    let (mut strain, mut state, mut kirchhoff) = (trial.clone(), initial.clone(), [Plane([0.0; BATCH]); 6]);
    let matter = Matter { count: 1, parameters: &planned.parameters, strain: &trial, state: &initial };
    let answer = Answer { strain: &mut strain, kirchhoff: &mut kirchhoff, state: &mut state };
    let mut buffer = ErrorBuffer::default();
    let status = material.update(&matter, None, answer, &mut buffer)?;
    buffer.check(status, material, "update_f64", |_| u64::MAX).ok()?;
    Some(invariants(&kirchhoff.map(|plane| plane.0[0])))
}
