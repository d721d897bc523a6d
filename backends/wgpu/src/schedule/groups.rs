//! Groups of bodies that answer, which the device moves: as they are at the start of a submission, and what came of them. See `answering.wgsl`.

use crate::device::kernel::Role;
use crate::device::memory::{ABREAST, Answering, BODY_HEAD, BODY_STATE, GROUP_HEAD, Writes};
use crate::schedule::batch::WgpuBatch;
use crate::schedule::bodies::{Driven, rooms_around};
use crate::schedule::submission::Behind;
use barchan_core::backend::WorldStep;
use barchan_core::coupling::{DeviceBody, Group, GroupState, GroupStep, Leashes, Moved, Placed, show_others};
use barchan_core::plan::TOOL_COURANT;
use barchan_core::{Aabb, BodyState, Result, Vec3, Wrench};
use std::ops::Range;

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

/// A group that the device moves.
#[derive(Clone, Debug)]
pub(crate) struct HeldGroup {
    /// Its coupling, and its number among that one's groups.
    coupling: usize,
    number: usize,
    /// Its mass [kg].
    mass: f64,
    state: GroupState,
    pub(crate) bodies: Vec<HeldBody>,
    /// Does it go a step at a time?
    pub(crate) in_turns: bool,
}

impl HeldGroup {
    /// After how many steps of `dt` the first of its bodies comes to the end of its leash, if all go on as they move now.
    pub(crate) fn steps_on_leash(&self, dt: f64) -> f64 {
        let along = |body: &HeldBody, d: usize| {
            let v = body.velocity[d];
            let end = if v < 0.0 { body.leash.min[d] } else { body.leash.max[d] };
            if v == 0.0 { f64::INFINITY } else { (end / (v * dt)).max(0.0) }
        };
        let all = self.bodies.iter().flat_map(|body| (0..3).map(move |d| along(body, d)));
        all.fold(f64::INFINITY, f64::min)
    }
}

/// One of its bodies.
#[derive(Clone, Debug)]
pub(crate) struct HeldBody {
    /// Its number among its coupling's bodies, and on the device.
    own: usize,
    pub(crate) number: usize,
    /// Its mass [kg].
    mass: f64,
    /// Greatest distance of a surface point from the reference point [m].
    extent: f64,
    /// How far the ends of its box move for each radian that it turns [m].
    swing: f64,
    /// Blocks around it.
    rooms: usize,
    /// Its velocity [m/s].
    velocity: Vec3,
    /// How far along each axis its box may move: least and greatest displacement [m].
    leash: Aabb,
    /// Do levels follow it?
    followed: bool,
}

/// What happened to a body in a step on the device.
#[derive(Clone, Debug)]
pub(crate) struct BodyStep {
    /// Its number on the device.
    pub(crate) number: usize,
    /// The body afterwards, if somebody asks for it.
    pub(crate) body: Option<BodyState>,
    /// Impulse and angular impulse from the ground.
    pub(crate) impulse: Wrench,
}

/// Where groups, bodies and their states stand in the buffer [vectors], for so many worlds.
#[derive(Clone, Copy)]
struct Places {
    room: Answering,
    worlds: usize,
}

impl Places {
    fn body_head(self, body: usize) -> usize {
        self.worlds * self.room.groups * GROUP_HEAD + body * BODY_HEAD
    }
    fn told(self, group: usize) -> usize {
        self.body_head(self.worlds * self.room.bodies) + group * self.room.told
    }
    fn states(self) -> usize {
        self.told(self.worlds * self.room.groups)
    }
    fn of_slot(self) -> usize {
        self.words(self.worlds * self.room.groups)
    }
    /// A group's words within a slot, behind all bodies.
    fn words(self, group: usize) -> usize {
        self.worlds * self.room.bodies * BODY_STATE + group * self.room.words
    }
}

/// Where the states after each of some slots stand, to be brought back.
pub(crate) fn states(room: Answering, worlds: usize, slots: usize) -> Option<Behind> {
    let places = Places { room, worlds };
    let bytes = |vectors: usize| 16 * vectors as u64;
    Some(Behind::of(Role::Answering, bytes(places.states() + places.of_slot()), bytes(places.of_slot() * slots)))
}

/// Parts of cells of width `h` [m] from the origin of the world; exact for what the device has come to.
pub(crate) fn parts(position: Vec3, h: f64) -> [i64; 3] {
    position.map(|x| (x / h / PLACE).round() as i64)
}

/// Cell, place in it, and rotation of a body, where finest cells have that width [m].
fn pose_words(placed: &Placed, h: f64) -> [Words; 3] {
    let [w, x, y, z] = placed.rotation.map(|q| (q / ROTATION).round() as i32 as u32);
    let [cell, place] = places(placed.position, h);
    [cell, place, [x, y, z, w]]
}

/// Cell and place in it.
pub(crate) fn places(position: Vec3, h: f64) -> [Words; 2] {
    let [x, y, z] = parts(position, h);
    [[(x >> 32) as u32, (y >> 32) as u32, (z >> 32) as u32, 0], [x as u32, y as u32, z as u32, 0]]
}

fn bits(x: f64) -> u32 {
    (x as f32).to_bits()
}

/// Where a body is after a slot.
fn read_pose(words: &[Words], h: f64) -> Placed {
    let position = [0, 1, 2].map(|d| {
        let parts = (i64::from(words[0][d] as i32) << 32) + i64::from(words[1][d]);
        parts as f64 * PLACE * h
    });
    let [x, y, z, w] = words[2].map(|q| f64::from(q as i32) * ROTATION);
    Placed { position, rotation: [w, x, y, z] }
}

/// What a body that meets so many levels, and whose blocks have their rooms from `first_room` on, is for the steps of a submission, where finest cells have width `h` [m].
fn body_words(body: &HeldBody, position: Vec3, levels: usize, first_room: usize, h: f64) -> [Words; BODY_HEAD] {
    let end = |x: f64, inwards: f64| bits((x / h + inwards * ROUNDING).clamp(-FAR, FAR));
    let ends = |v: Vec3, inwards: f64, last: u32| [end(v[0], inwards), end(v[1], inwards), end(v[2], inwards), last];
    let [[x, y, z, _], [in_x, in_y, in_z, _]] = places(position, h);
    [
        [body.number as u32, levels as u32, bits(TOOL_COURANT * (1.0 - ROUNDING)), bits(body.extent / h)],
        ends(body.leash.min, 1.0, bits(body.mass)),
        ends(body.leash.max, -1.0, first_room as u32),
        [x, y, z, body.rooms as u32],
        [in_x, in_y, in_z, bits(body.swing / h)],
    ]
}

impl WgpuBatch {
    /// Takes a world's groups to the device for up to so many steps, on leashes that keep its levels where they are, too, and bodies of one coupling away from
    /// those of others; `None` if a coupling must take the next step.
    pub(crate) fn hold_groups(&self, world_step: &mut WorldStep<'_>, dt: f64, steps: usize) -> Option<Vec<HeldGroup>> {
        show_others(world_step.couplings);
        let held = self.held_groups(world_step, dt, steps);
        for (c, coupling) in world_step.couplings.iter_mut().enumerate() {
            let in_turns = held.iter().flatten().any(|group| group.coupling == c && group.in_turns);
            coupling.move_on_device(match held {
                None => Moved::ByCoupling,
                Some(_) if in_turns => Moved::InTurns,
                Some(_) => Moved::ByDevice,
            });
        }
        held
    }

    fn held_groups(&self, world_step: &WorldStep<'_>, dt: f64, steps: usize) -> Option<Vec<HeldGroup>> {
        let world = &self.worlds[world_step.world];
        let softs = world.softs.boxes(self.h);
        let of_agents = world.adapt.leashes(world_step.couplings, |body| softs.get(&body).copied());
        let mut all = Vec::new();
        for (c, coupling) in world_step.couplings.iter().enumerate() {
            let groups = coupling.device_groups();
            if groups.is_empty() {
                continue;
            }
            let Leashes { each, mut in_turns } = coupling.leashes(world_step.time, dt, steps)?;
            let mut leashes = each.into_iter();
            let from = all.len();
            let (bodies, boxes, now) = (&world.bodies[c], coupling.bounds(), coupling.bodies());
            let states = coupling.device_state().into_iter();
            let known = world.groups[c].iter();
            for (number, ((Group { bodies: own, mass }, state), known)) in
                groups.into_iter().zip(states).zip(known).enumerate()
            {
                let mut held = Vec::with_capacity(own.len());
                for (own, known) in own.zip(&known.bodies) {
                    let (name, mass) = (&bodies[own].0, bodies[own].1);
                    let of_own = of_agents.iter().filter(|(agent, _)| agent.is_of(name));
                    let of_levels = of_own.fold(Aabb::UNBOUND, |all, (_, leash)| all.intersection(leash));
                    let (of_others, is_near) = self.keep_off(world_step, c, &boxes[own], dt * steps as f64)?;
                    in_turns |= is_near;
                    let leash = leashes.next()?.intersection(&of_levels).intersection(&of_others);
                    let followed = world.adapt.follows(name);
                    let number = world.first_bodies[c] + own;
                    let rooms = rooms_around(known, self.h).next_multiple_of(ABREAST);
                    let DeviceBody { extent, swing, .. } = *known;
                    let velocity = now[own].velocity;
                    held.push(HeldBody { own, number, mass, extent, swing, rooms, velocity, leash, followed });
                }
                all.push(HeldGroup { coupling: c, number, mass, state, bodies: held, in_turns: false });
            }
            if in_turns && self.substeps > 1 {
                return None;
            }
            all[from..].iter_mut().for_each(|group| group.in_turns = in_turns);
        }
        Some(all)
    }

    /// How far along each axis a body that answers, of coupling `c`, in the box `own`, may go for `duration` [s] before it may touch a node that a body of another coupling
    /// touches, too; `None` if it is there. With a driven body it may share nodes: each is that one's in which it is deeper. Is it near one that moves, so that it has to go a step
    /// at a time? Where levels take steps of their own, no pass knows in which body a node is deeper.
    fn keep_off(&self, world_step: &WorldStep<'_>, c: usize, own: &Aabb, duration: f64) -> Option<(Aabb, bool)> {
        let widest = self.worlds[world_step.world].levels.last().map_or(self.h, |level| level.h);
        let (mut leash, mut is_near) = (Aabb::UNBOUND, false);
        let couplings = &*world_step.couplings;
        for (o, other) in couplings.iter().enumerate().filter(|(o, other)| *o != c && !other.is_field()) {
            let clearance = CLEARANCE * self.h + (couplings[c].reach() + couplings[o].reach()) * widest;
            let groups = other.groups();
            for (b, near) in other.bounds().iter().enumerate() {
                // One that answers may come as far.
                let answers = groups.iter().any(|group| group.bodies.contains(&b));
                if !answers && self.substeps == 1 && other.stays(b) {
                    continue;
                }
                let off = own.leash(near, clearance, |spare| {
                    if answers { 0.5 * spare } else { spare - duration * other.max_speed(world_step.time, duration) }
                });
                match off {
                    Some(off) => leash = leash.intersection(&off),
                    None if answers || self.substeps > 1 => return None,
                    None => is_near = true,
                }
            }
        }
        Some((leash, is_near))
    }

    /// Tells the device which groups it moves, and how they are.
    pub(crate) fn write_groups(&self, world_steps: &[WorldStep<'_>], held: &[Vec<HeldGroup>], writes: &mut Writes) {
        let room = self.contact.answering();
        if room.groups == 0 {
            return;
        }
        let places = Places { room, worlds: self.worlds.len() };
        let mut words = vec![[0; 4]; places.states() + places.of_slot()];
        let mut put = |at: usize, what: &[Words]| words[at..at + what.len()].copy_from_slice(what);
        for (world_step, held) in world_steps.iter().zip(held) {
            let mut b = world_step.world * room.bodies;
            let mut first_room = world_step.world * room.rooms;
            let all: Vec<_> = world_step.couplings.iter().map(|coupling| coupling.told()).collect();
            for (k, group) in (world_step.world * room.groups..).zip(held) {
                // Levels that follow a body keep coarser ones away from it.
                let levels = |body: &HeldBody| if body.followed { 1 } else { self.levels };
                let most = group.bodies.iter().map(levels).max().unwrap_or(0);
                let head = [b as u32, group.bodies.len() as u32, group.number as u32, most as u32];
                put(k * GROUP_HEAD, &[head, [bits(group.mass), 0, 0, 0]]);
                if let Some(told) = all[group.coupling].get(group.number).filter(|_| group.in_turns) {
                    put(places.told(k), told);
                }
                put(places.states() + places.words(k), &group.state.words);
                for (body, placed) in group.bodies.iter().zip(&group.state.bodies) {
                    let words = body_words(body, placed.position, levels(body), first_room, self.h);
                    put(places.body_head(b), &words);
                    first_room += body.rooms;
                    put(places.states() + b * BODY_STATE, &pose_words(placed, self.h));
                    b += 1;
                }
            }
        }
        writes.add(self.memory.buffer(Role::Answering, 0), 0, &words);
    }

    /// How groups are to be read from what comes back of a submission.
    pub(crate) fn group_reader(&self) -> GroupReader {
        let places = Places { room: self.contact.answering(), worlds: self.worlds.len() };
        GroupReader { places, substeps: self.substeps, h: self.h }
    }
}

/// Reads what came of groups, which many threads may do for a world each.
#[derive(Clone, Copy)]
pub(crate) struct GroupReader {
    places: Places,
    substeps: usize,
    h: f64,
}

impl GroupReader {
    /// Hands a world's couplings their groups' states after the steps that are done; `groups` is what came back. Where nobody asks where bodies were in between,
    /// the last two are enough: sensors say how motion changed in the last one.
    pub(crate) fn take_groups(
        self,
        world_step: &mut WorldStep<'_>,
        driven: &mut Option<Driven<'_>>,
        groups: &[u32],
        done: usize,
    ) -> Result<()> {
        let Some(driven) = driven else { return Ok(()) };
        if driven.held.is_empty() {
            return Ok(());
        }
        let places = self.places;
        let all: &[Words] = bytemuck::cast_slice(groups);
        driven.moved.resize_with(done, Vec::new);
        for (c, coupling) in world_step.couplings.iter_mut().enumerate() {
            let mut b = world_step.world * places.room.bodies;
            let mut own = Vec::new();
            for (k, group) in (world_step.world * places.room.groups..).zip(driven.held) {
                if group.coupling == c {
                    own.push((group, [k, b]));
                }
                b += group.bodies.len();
            }
            if own.is_empty() {
                continue;
            }
            let mut counts = vec![[0; 2]; own.len()];
            for (s, moved) in driven.moved.iter_mut().enumerate() {
                let slots = s * self.substeps..(s + 1) * self.substeps;
                let before = moved.len();
                for ((group, at), counts) in own.iter().zip(&mut counts) {
                    let felt = read_impulses(all, places, at[1], group, slots.clone(), counts);
                    let step =
                        |(held, impulse): (&HeldBody, Wrench)| BodyStep { number: held.number, body: None, impulse };
                    moved.extend(group.bodies.iter().zip(felt).map(step));
                }
                if !world_step.reports_bodies && s + 2 < done {
                    continue;
                }
                let states = own.iter().zip(&mut counts).map(|((group, at), counts)| {
                    let [deep_nodes, unconverged] = std::mem::take(counts);
                    let state = read_state(all, places, *at, group, slots.end - 1, self.h);
                    GroupStep { state, deep_nodes, unconverged }
                });
                coupling.take_device_state(&states.collect::<Vec<_>>())?;
                if world_step.reports_bodies {
                    let mut bodies: Vec<_> = coupling.bodies().into_iter().map(Some).collect();
                    let held = own.iter().flat_map(|(group, _)| &group.bodies);
                    for (step, held) in moved[before..].iter_mut().zip(held) {
                        step.body = bodies[held.own].take();
                    }
                }
            }
        }
        Ok(())
    }
}

/// What each body of a group, with that first body among all worlds', felt in the slots of a step. Adds up what is counted: nodes that are deep inside, and
/// solutions that did not converge.
fn read_impulses(
    all: &[Words],
    places: Places,
    first: usize,
    group: &HeldGroup,
    slots: Range<usize>,
    counts: &mut [u64; 2],
) -> Vec<Wrench> {
    let real = |v: Words| [0, 1, 2].map(|d| f64::from(f32::from_bits(v[d])));
    let mut felt = vec![Wrench::default(); group.bodies.len()];
    for slot in slots {
        let state = |b: usize| &all[slot * places.of_slot() + (first + b) * BODY_STATE..][..BODY_STATE];
        for (b, felt) in felt.iter_mut().enumerate() {
            let impulse = Wrench { force: real(state(b)[3]), torque: real(state(b)[4]) };
            felt.add_change(&Wrench::default(), &impulse, 1.0);
        }
        counts[0] += u64::from(state(0)[3][3]);
        counts[1] += u64::from(state(0)[4][3]);
    }
    felt
}

/// The state of a group, with that number and first body among all worlds', after a slot.
fn read_state(
    all: &[Words],
    places: Places,
    [k, first]: [usize; 2],
    group: &HeldGroup,
    slot: usize,
    h: f64,
) -> GroupState {
    let here = &all[slot * places.of_slot()..];
    let pose = |b: usize| read_pose(&here[(first + b) * BODY_STATE..], h);
    GroupState {
        words: here[places.words(k)..][..group.state.words.len()].to_vec(),
        bodies: (0..group.bodies.len()).map(pose).collect(),
    }
}
