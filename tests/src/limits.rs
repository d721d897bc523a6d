//! How long a step matter bears: a little noise grows above its limit and does not below it.

use crate::scenes::{Noise, alter, rows};
use crate::sketch::{Head, PERIODIC, block};
use barchan::Simulation;

/// Cell width of the scenes [m].
const H: f64 = 0.1;
/// Steps over which noise grows or does not.
const STEPS: usize = 400;

/// Ways in which matter may lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lie {
    /// One particle, alone in its cells: where limits are least.
    Lone,
    /// Ground without an end, eight particles in a cell, somewhere in it.
    Bulk,
    /// A sheet thinner than a cell.
    Sheet,
    /// A bar whose middle lies on a finer level than its ends.
    Levels,
}

/// A scene of a material of that name, without gravity.
pub fn scene_of(lie: Lie, material: &str, law: &str, time: &str) -> String {
    let jitter = "sampling = \"jitter\"";
    let space = Head::space(H).time(time);
    let periodic = Head { gravity: [0.0; 3], ..Head::cells(H, [8, 8, 8], PERIODIC) }.time(time);
    let with = |head: Head<'_>, body: String, more: &str| head.with(&[material.to_owned(), body, more.to_owned()]);
    match lie {
        Lie::Lone => with(space, block(law, [0.02; 3], [0.07; 3], ""), ""),
        Lie::Bulk => with(periodic, block(law, [0.0; 3], [0.8; 3], jitter), ""),
        Lie::Sheet => with(space, block(law, [0.0; 3], [0.8, 0.8, 0.05], jitter), ""),
        Lie::Levels => {
            let levels = "[levels]\ncount = 2\nhalf = 8\nagents = [\"eye\"]\n[[tool]]\nname = \"eye\"\n\
                          position = [0.0, 0.0, 0.6]\nshape = { sphere = { radius = 0.05 } }\n";
            with(space, block(law, [-1.6, -0.2, -0.2], [1.6, 0.2, 0.2], jitter), levels)
        }
    }
}

/// Gives every particle a velocity of its own, or the lone one a velocity gradient: far too little to deform anything much.
fn stir(sim: &mut Simulation) {
    let scale = 1e-6 * H / sim.bound().dt;
    let (lone, mut noise) = (sim.particle_count() == 1, Noise::new(3));
    alter(sim, |r| {
        if lone {
            r.c = std::array::from_fn(|_| scale / H * noise.draw());
        } else {
            r.v = std::array::from_fn(|_| scale * noise.draw());
        }
    });
}

/// Does a simulation of a scene bear steps of this length [s], so that noise stays within thirty times what it was at the start? `of_time` makes
/// it of what the scene says of time.
pub fn bears(step: f64, of_time: impl FnOnce(&str) -> Simulation) -> bool {
    let mut sim = of_time(&format!("step = {step}\nover_bound = \"allow\""));
    stir(&mut sim);
    let square = |values: &[f64]| values.iter().map(|x| x * x).sum::<f64>();
    let noise = |sim: &Simulation| rows(sim).iter().map(|r| square(&r.v) + 0.25 * H * H * square(&r.c)).sum::<f64>();
    let start = noise(&sim);
    // NaN is not within.
    (0..STEPS).all(|step| sim.step().is_ok() && (step % 50 != 49 || noise(&sim) < 900.0 * start))
}
