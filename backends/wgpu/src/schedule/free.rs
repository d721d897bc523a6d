//! Free bodies that the device moves: as they are lent for a submission, and what came of it. See `lent.wgsl`.

use crate::device::kernel::Role;
use crate::device::memory::{LENT, STATE, Writes};
use crate::schedule::batch::WgpuBatch;
use crate::schedule::bodies::Driven;
use crate::schedule::submission::{Behind, Outcome};
use barchan_core::backend::WorldStep;
use barchan_core::coupling::{FreeState, Lent, Moved};
use barchan_core::plan::TOOL_COURANT;
use barchan_core::{Aabb, BodyState, Result, Vec3, Wrench};

/// One part of a cell, and of a rotation, in a state.
pub(crate) const PLACE: f64 = 1.0 / 4_294_967_296.0;
pub(crate) const ROTATION: f64 = 1.0 / 1_073_741_824.0;
/// What rounding on the device may amount to in displacements [cells].
pub(crate) const ROUNDING: f64 = 1e-4;
/// What bodies of different couplings keep between the nodes that they touch [cells].
const CLEARANCE: f64 = 1.0;
/// In place of infinity [cells].
pub(crate) const FAR: f64 = 1e9;

/// A vector as the device reads it.
pub(crate) type Words = [u32; 4];

/// A free body that the device moves.
#[derive(Clone, Debug)]
pub(crate) struct Borrowed {
    /// Its coupling, and its number on the device.
    pub(crate) coupling: usize,
    pub(crate) number: usize,
    pub(crate) lent: Lent,
    /// Do levels follow it?
    pub(crate) followed: bool,
}

/// What happened to a free body in a step.
#[derive(Clone, Debug)]
pub(crate) struct FreeStep {
    /// The body afterwards.
    pub(crate) body: BodyState,
    /// Impulse and angular impulse from the ground.
    pub(crate) impulse: Wrench,
}

/// Where the states of so many free bodies after each of some slots stand, to be brought back.
pub(crate) fn states(bodies: usize, slots: usize) -> Option<Behind> {
    let of_slot = 16 * (bodies * STATE) as u64;
    Some(Behind::of(Role::Lent, 16 * (bodies * LENT) as u64 + of_slot, of_slot * slots as u64))
}

/// Parts of cells of width `h` [m] from the origin of the world; exact for what the device has come to.
pub(crate) fn parts(position: Vec3, h: f64) -> [i64; 3] {
    position.map(|x| (x / h / PLACE).round() as i64)
}

/// A state of a body, where finest cells have that width [m].
pub(crate) fn state_words(state: &FreeState, h: f64) -> [Words; STATE] {
    let [w, x, y, z] = state.rotation.map(|q| (q / ROTATION).round() as i32 as u32);
    let real = |v: Vec3| [bits(v[0]), bits(v[1]), bits(v[2]), 0];
    let [cell, place] = places(state.position, h);
    let mut words = [[0; 4]; STATE];
    (words[0], words[1], words[2]) = (cell, place, [x, y, z, w]);
    (words[3], words[4]) = (real(state.velocity), real(state.angular_momentum));
    words
}

/// Cell and place in it.
pub(crate) fn places(position: Vec3, h: f64) -> [Words; 2] {
    let [x, y, z] = parts(position, h);
    [[(x >> 32) as u32, (y >> 32) as u32, (z >> 32) as u32, 0], [x as u32, y as u32, z as u32, 0]]
}

pub(crate) fn bits(x: f64) -> u32 {
    (x as f32).to_bits()
}

/// What came of a body in a slot: how it is, its counts, and its impulses.
pub(crate) fn read_state(words: &[Words], h: f64) -> (Moved, Wrench) {
    let real = |v: Words| [0, 1, 2].map(|d| f64::from(f32::from_bits(v[d])));
    let position = [0, 1, 2].map(|d| {
        let parts = (i64::from(words[0][d] as i32) << 32) + i64::from(words[1][d]);
        parts as f64 * PLACE * h
    });
    let [x, y, z, w] = words[2].map(|q| f64::from(q as i32) * ROTATION);
    let state =
        FreeState { position, rotation: [w, x, y, z], velocity: real(words[3]), angular_momentum: real(words[4]) };
    let moved = Moved { state, deep_nodes: words[3][3].into(), unconverged: words[4][3].into() };
    (moved, Wrench { force: real(words[5]), torque: real(words[6]) })
}

/// The inverse of a symmetric matrix.
pub(crate) fn inverse([a, b, c]: [Vec3; 3]) -> [Vec3; 3] {
    let cross = |u: Vec3, v: Vec3| [0, 1, 2].map(|i| u[(i + 1) % 3] * v[(i + 2) % 3] - u[(i + 2) % 3] * v[(i + 1) % 3]);
    let rows = [cross(b, c), cross(c, a), cross(a, b)];
    let determinant: f64 = (0..3).map(|d| a[d] * rows[0][d]).sum();
    rows.map(|row| row.map(|x| x / determinant))
}

/// What a body that meets so many levels is for the steps of a submission, where finest cells have width `h`.
pub(crate) fn lent_words(Borrowed { lent, number, .. }: &Borrowed, levels: usize, h: f64) -> [Words; LENT] {
    let row = |v: Vec3, last: u32| [bits(v[0]), bits(v[1]), bits(v[2]), last];
    let [i, inverse] = [lent.inertia, inverse(lent.inertia)];
    let end = |x: f64, inwards: f64| (x / h + inwards * ROUNDING).clamp(-FAR, FAR);
    let [cell, place] = places(lent.state.position, h);
    [
        row(i[0], bits(lent.mass)),
        row(i[1], 0),
        row(i[2], bits(lent.extent / h)),
        row(inverse[0], *number as u32),
        row(inverse[1], bits(TOOL_COURANT * (1.0 - ROUNDING))),
        row(inverse[2], levels as u32),
        row(lent.leash.min.map(|x| end(x, 1.0)), 0),
        row(lent.leash.max.map(|x| end(x, -1.0)), 0),
        cell,
        place,
    ]
}

impl WgpuBatch {
    /// Borrows the free bodies of a world for up to so many steps, on leashes that keep its levels where they are, too, and bodies of one coupling away from
    /// those of others; `None` if a coupling must take the next step.
    pub(crate) fn borrow(&self, world_step: &mut WorldStep<'_>, dt: f64, steps: usize) -> Option<Vec<Borrowed>> {
        let borrowed = self.borrow_all(world_step, dt, steps);
        if borrowed.is_none() {
            world_step.couplings.iter_mut().for_each(|coupling| coupling.take_back());
        }
        borrowed
    }

    fn borrow_all(&self, world_step: &mut WorldStep<'_>, dt: f64, steps: usize) -> Option<Vec<Borrowed>> {
        let world = &self.worlds[world_step.world];
        let softs = world.softs.boxes(self.h);
        let mut all = Vec::new();
        for c in 0..world_step.couplings.len() {
            if world_step.couplings[c].groups().is_empty() {
                continue;
            }
            let lent = world_step.couplings[c].lend(world_step.time, dt, steps)?;
            let (bodies, boxes) = (world_step.couplings[c].bodies(), world_step.couplings[c].bounds());
            for mut one in lent {
                let name = &bodies[one.body].name;
                let of_levels = world.adapt.leash(name, &boxes[one.body], |body| softs.get(&body).copied());
                let of_others = self.keep_off(world_step, c, &boxes[one.body], dt * steps as f64)?;
                one.leash = one.leash.intersection(&of_levels).intersection(&of_others);
                let number = world.first_bodies[c] + one.body;
                all.push(Borrowed { coupling: c, number, lent: one, followed: world.adapt.follows(name) });
            }
        }
        Some(all)
    }

    /// How far along each axis a free body of coupling `c`, in the box `own`, may go for `duration` [s] before it may touch a node that a body of another coupling
    /// touches, too; `None` if it is there.
    fn keep_off(&self, world_step: &WorldStep<'_>, c: usize, own: &Aabb, duration: f64) -> Option<Aabb> {
        let widest = self.worlds[world_step.world].levels.last().map_or(self.h, |level| level.h);
        let mut leash = Aabb { min: [f64::NEG_INFINITY; 3], max: [f64::INFINITY; 3] };
        let couplings = &*world_step.couplings;
        for (o, other) in couplings.iter().enumerate().filter(|(o, other)| *o != c && !other.is_field()) {
            let clearance = CLEARANCE * self.h + (couplings[c].reach() + couplings[o].reach()) * widest;
            let groups = other.groups();
            for (b, near) in other.bounds().iter().enumerate() {
                let gaps = (0..3).flat_map(|axis| {
                    [(axis, false, own.min[axis] - near.max[axis]), (axis, true, near.min[axis] - own.max[axis])]
                });
                let (axis, upwards, gap) = gaps.max_by(|a, b| a.2.total_cmp(&b.2))?;
                let spare = gap - clearance;
                // A free one may come as far.
                let is_free = groups.iter().any(|group| group.bodies.contains(&b));
                let by =
                    if is_free { 0.5 * spare } else { spare - duration * other.max_speed(world_step.time, duration) };
                if by.is_nan() || spare <= 0.0 {
                    return None;
                }
                let end = if upwards { &mut leash.max[axis] } else { &mut leash.min[axis] };
                *end = if upwards { end.min(by.max(0.0)) } else { end.max(-by.max(0.0)) };
            }
        }
        Some(leash)
    }

    /// Tells the device which free bodies it moves, and how they are.
    pub(crate) fn write_lent(&self, world_steps: &[WorldStep<'_>], lent: &[Vec<Borrowed>], writes: &mut Writes) {
        let free = self.contact.free();
        if free == 0 {
            return;
        }
        let all = self.worlds.len() * free;
        let mut words = vec![[0; 4]; all * (LENT + STATE)];
        for (world_step, lent) in world_steps.iter().zip(lent) {
            for (k, one) in (world_step.world * free..).zip(lent) {
                // Levels that follow a body keep coarser ones away from it.
                let levels = if one.followed { 1 } else { self.levels };
                words[k * LENT..][..LENT].copy_from_slice(&lent_words(one, levels, self.h));
                words[all * LENT + k * STATE..][..STATE].copy_from_slice(&state_words(&one.lent.state, self.h));
            }
        }
        writes.add(self.memory.buffer(Role::Lent, 0), 0, &words);
    }

    /// Hands a world's free bodies their states after each step that is done.
    pub(crate) fn adopt(
        &self,
        world_step: &mut WorldStep<'_>,
        driven: &mut Option<Driven>,
        outcome: &Outcome,
    ) -> Result<()> {
        let Some(driven) = driven else { return Ok(()) };
        let (free, all): (usize, &[Words]) = (self.contact.free(), bytemuck::cast_slice(&outcome.lent));
        if driven.lent.is_empty() {
            return Ok(());
        }
        for s in 0..outcome.done {
            let of_step = |b: usize| {
                let slots = s * self.substeps..(s + 1) * self.substeps;
                let of_slot = |slot: usize| {
                    let at = (slot * self.worlds.len() * free + world_step.world * free + b) * STATE;
                    read_state(&all[at..at + STATE], self.h)
                };
                slots.map(of_slot).reduce(|(before, given), (now, more)| {
                    let deep_nodes = before.deep_nodes + now.deep_nodes;
                    let unconverged = before.unconverged + now.unconverged;
                    let sum = |a: Vec3, b: Vec3| std::array::from_fn(|d| a[d] + b[d]);
                    let impulse =
                        Wrench { force: sum(given.force, more.force), torque: sum(given.torque, more.torque) };
                    (Moved { deep_nodes, unconverged, ..now }, impulse)
                })
            };
            let (moved, impulses): (Vec<_>, Vec<_>) = (0..driven.lent.len()).filter_map(of_step).unzip();
            let mut steps = Vec::with_capacity(moved.len());
            for (c, coupling) in world_step.couplings.iter_mut().enumerate() {
                let is_own = |(lent, _): &(&Borrowed, _)| lent.coupling == c;
                let own: Vec<Moved> = driven.lent.iter().zip(&moved).filter(is_own).map(|(_, moved)| *moved).collect();
                if own.is_empty() {
                    continue;
                }
                coupling.adopt(&own)?;
                let bodies = coupling.bodies();
                let felt = driven.lent.iter().zip(&impulses).filter(|(lent, _)| lent.coupling == c);
                let step = |(lent, impulse): (&Borrowed, &Wrench)| FreeStep {
                    body: bodies[lent.lent.body].clone(),
                    impulse: *impulse,
                };
                steps.extend(felt.map(step));
            }
            driven.moved.push(steps);
        }
        Ok(())
    }
}
