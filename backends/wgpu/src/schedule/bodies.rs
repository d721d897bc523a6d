//! Bodies whose law runs on the device: the law itself, where they are in each step, what they felt.

use crate::device::kernel::{Kernel, Role};
use crate::device::memory::{Answering, BODY, answering_bytes};
use crate::passes::bodies::{NearKernels, answer_draft, fits_workgroups};
use crate::passes::couplings::Laws;
use crate::schedule::ContactPasses;
use crate::schedule::batch::WgpuBatch;
use crate::schedule::groups::{BodyStep, HeldGroup};
use crate::schedule::submission::Behind;
use crate::worlds::sleep::{self, BlockBox};
use crate::worlds::world::{Level, Place};
use barchan_core::backend::WorldStep;
use barchan_core::coupling::{DeviceBody, begin_step};
use barchan_core::{Aabb, BodyState, Coupling, Error, Result, StepReport, Vec3, Wrench};
use std::collections::BTreeMap;
use std::ops::Range;

/// Blocks in the box of a body that answers on a level that the device can look into, and bodies of a group that answer together: the law of larger ones runs on
/// the host.
pub(crate) const MOST_ROOMS: usize = 8192;
const MOST_TOGETHER: usize = 64;

/// The couplings' laws, where they run: as far as any world has asked.
#[derive(Default)]
pub(crate) struct Contact {
    /// On the host, a step at a time: what is near bodies is gathered, and nodes are scattered again.
    pub(crate) host: Option<Box<NearKernels>>,
    /// On the device.
    pub(crate) device: Option<Box<DeviceContact>>,
}

impl Contact {
    /// What the device does in each step.
    pub(crate) fn on_device(&self) -> ContactPasses<'_> {
        let Some(contact) = &self.device else { return ContactPasses::default() };
        let driven: &[Kernel] = if contact.needs.driven { &contact.kernels } else { &[] };
        let (answering, with_rims): (&[Kernel], _) =
            contact.answering.as_ref().map_or((&[], false), |(kernels, rims)| (kernels, *rims));
        ContactPasses { driven, answering, with_rims, roams: contact.needs.roams, on_host: false }
    }

    /// Groups and bodies that answer that the device has room for in each world.
    pub(crate) fn answering(&self) -> Answering {
        self.device.as_ref().map_or(Answering::default(), |contact| contact.needs.answering)
    }
}

/// What a world's law asks of the device, or the laws of several worlds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Needs {
    /// Bodies of each world, and vectors of each world's table.
    pub(crate) bodies: usize,
    pub(crate) vectors: usize,
    pub(crate) answering: Answering,
    /// Are there driven bodies?
    pub(crate) driven: bool,
    /// May bodies come near coarser levels?
    pub(crate) roams: bool,
}

/// Blocks of finest cells across a body beyond which there is no room on any device, and so none is asked for: sizes stay numbers.
const MOST_ACROSS: f64 = 1e4;

/// Blocks of finest cells of width `h` [m] that a box of a body's extent can reach into.
pub(crate) fn rooms_around(body: &DeviceBody, h: f64) -> usize {
    let across = (2.0 * body.reach / (4.0 * h)).min(MOST_ACROSS) as usize + 2;
    across.pow(3)
}

impl Needs {
    /// Of a world's couplings with so many materials, where finest cells have that width [m].
    pub(crate) fn of(laws: &Laws, materials: usize, h: f64, roams: bool) -> Self {
        let answering = Answering::of(&laws.groups(h), |body| rooms_around(body, h));
        let (bodies, vectors) = (laws.bodies, laws.table.len() + materials);
        Self { bodies, vectors, answering, driven: answering.bodies < bodies, roams }
    }

    /// Those of both.
    pub(crate) fn with(self, other: Self) -> Self {
        Self {
            bodies: self.bodies.max(other.bodies),
            vectors: self.vectors.max(other.vectors),
            answering: self.answering.with(other.answering),
            driven: self.driven || other.driven,
            roams: self.roams || other.roams,
        }
    }
}

/// The law on the device.
pub(crate) struct DeviceContact {
    /// How particles press, the law, then the sums of impulses.
    kernels: [Kernel; 3],
    /// Contact of those that answer, and their motion; does it move rims, too?
    answering: Option<([Kernel; 2], bool)>,
    wgsl: String,
    answer: String,
    reach: f64,
    samples: Samples,
    needs: Needs,
    /// Each world's table.
    tables: Vec<Vec<[f32; 4]>>,
}

/// What worlds' laws sample, such as distances to a mesh, once for all worlds that have the same.
#[derive(Clone, Debug)]
pub(crate) struct Samples {
    all: Vec<[f32; 4]>,
    of_worlds: Vec<Range<usize>>,
}

impl Samples {
    /// Of so many worlds, none of which has any.
    pub(crate) fn none(worlds: usize) -> Self {
        Self { all: Vec::new(), of_worlds: vec![0..0; worlds] }
    }

    /// Where some world has these.
    fn find(&self, samples: &[[f32; 4]]) -> Option<Range<usize>> {
        self.of_worlds.iter().find(|range| self.all[(*range).clone()] == *samples).cloned()
    }

    /// Gives a world those that some world has already, if they are these.
    pub(crate) fn share(&mut self, world: usize, samples: &[[f32; 4]]) -> bool {
        self.find(samples).map(|range| self.of_worlds[world] = range).is_some()
    }

    /// Gives a world others than any has. Those that no world has any longer go.
    pub(crate) fn add(&mut self, world: usize, samples: &[[f32; 4]]) {
        self.of_worlds[world] = 0..0;
        let before = std::mem::take(&mut self.all);
        let mut moved = BTreeMap::new();
        for range in &mut self.of_worlds {
            let to = moved.entry((range.start, range.end)).or_insert_with(|| {
                self.all.extend(&before[range.clone()]);
                self.all.len() - range.len()..self.all.len()
            });
            *range = to.clone();
        }
        self.all.extend(samples);
        self.of_worlds[world] = self.all.len() - samples.len()..self.all.len();
    }

    /// As the device reads them: where those of each of several worlds begin, then all; nothing if there are none.
    pub(crate) fn packed(&self) -> Vec<[f32; 4]> {
        let begins = (0..self.of_worlds.len()).filter_map(|world| self.begin(world));
        begins.chain(self.all.iter().copied()).collect()
    }

    /// How many vectors that are at most with those of one more world.
    pub(crate) fn packed_len_with(&self, samples: &[[f32; 4]]) -> usize {
        let more = if self.find(samples).is_some() { 0 } else { samples.len() };
        self.of_worlds.len() + self.all.len() + more
    }

    /// Where those of one of several worlds begin, as bits.
    pub(crate) fn begin(&self, world: usize) -> Option<[f32; 4]> {
        let start = self.of_worlds[world].start as u32;
        (self.of_worlds.len() > 1 && !self.all.is_empty()).then_some([f32::from_bits(start), 0.0, 0.0, 0.0])
    }
}

/// Bodies of a world over the steps of a submission.
pub(crate) struct Driven<'a> {
    /// The steps that they go.
    pub(crate) steps: usize,
    /// The couplings before each step. Where the device moves all bodies, only before the first: after it they stay as they are, until they are told what came
    /// of the steps.
    saved: Vec<Vec<Vec<u8>>>,
    /// Bodies of all couplings after each step, if somebody asks for them.
    after: Vec<Vec<BodyState>>,
    /// As the device reads them, step by step.
    packed: Vec<Vec<[f32; 4]>>,
    /// Boxes of blocks near them on each level, likewise.
    near: Vec<Vec<Vec<BlockBox>>>,
    /// Groups that the device moves, and what happened to their bodies in each step.
    pub(crate) held: &'a [HeldGroup],
    pub(crate) moved: Vec<Vec<BodyStep>>,
}

/// Repeats the last one until there are so many.
pub(crate) fn go_on<T: Clone>(all: &mut Vec<T>, count: usize) {
    if let Some(last) = all.last().cloned() {
        all.resize(count, last);
    }
}

/// Takes a world's couplings, which have gone all of their steps, back to what they were before one of them.
pub(crate) fn go_back(couplings: &mut [Box<dyn Coupling>], driven: &Option<Driven<'_>>, step: usize) -> Result<()> {
    let saved = driven.iter().flat_map(|driven| driven.saved.get(step)).flatten();
    couplings.iter_mut().zip(saved).try_for_each(|(coupling, saved)| {
        coupling.restore(saved).map_err(|what| Error::Body {
            path: format!("coupling '{}'", coupling.name()),
            what: format!("cannot go back to an earlier step: {what}"),
            mend: "resume from the last snapshot".to_owned(),
        })
    })
}

fn save(couplings: &[Box<dyn Coupling>]) -> Vec<Vec<u8>> {
    couplings.iter().map(|coupling| coupling.save()).collect()
}

fn bodies_of(couplings: &[Box<dyn Coupling>]) -> Vec<BodyState> {
    couplings.iter().flat_map(|coupling| coupling.bodies()).collect()
}

/// The bodies of couplings as each of some levels sees them, of so many places for bodies: without those that it moves. `firsts` are the numbers of the
/// couplings' first bodies.
pub(crate) fn pack_all(
    couplings: &[Box<dyn Coupling>],
    firsts: &[usize],
    levels: &[Level],
    held: &[HeldGroup],
    places: usize,
) -> Vec<[f32; 4]> {
    let mut packed = vec![NOWHERE; levels.len() * places];
    for (coupling, &first) in couplings.iter().zip(firsts) {
        let (bodies, boxes, reach) = (coupling.bodies(), coupling.bounds(), coupling.reach());
        for (number, (body, bounds)) in (first..).zip(bodies.iter().zip(&boxes)) {
            if held.iter().flat_map(|group| &group.bodies).any(|body| body.number == number) {
                continue;
            }
            for (l, level) in levels.iter().enumerate() {
                packed[l * places + number] = pack(body, &bounds.grown(reach * level.h), level.h);
            }
        }
    }
    packed.into_flattened()
}

/// A body whose box holds no node, as `contact.wgsl` reads it.
pub(crate) const NOWHERE: [[f32; 4]; BODY as usize] = {
    let mut body = [[0.0; 4]; BODY as usize];
    let far = f32::from_bits(1 << 30);
    body[7] = [far, far, far, 0.0];
    body
};

/// A body in a step, as `contact.wgsl` reads it.
pub(crate) fn pack(body: &BodyState, bounds: &Aabb, h: f64) -> [[f32; 4]; BODY as usize] {
    let ints =
        |v: [i32; 3]| [f32::from_bits(v[0] as u32), f32::from_bits(v[1] as u32), f32::from_bits(v[2] as u32), 0.0];
    let reals = |v: Vec3| [v[0] as f32, v[1] as f32, v[2] as f32, 0.0];
    let cell = body.position.map(|x| (x / h).floor());
    let place = std::array::from_fn(|d| body.position[d] / h - cell[d]);
    let [w, x, y, z] = body.rotation;
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    // Nodes stand at the centres of cells.
    let node = |x: f64, round: fn(f64) -> f64| round(x / h - 0.5).clamp(-1e9, 1e9) as i32;
    [
        ints(cell.map(|c| c as i32)),
        reals(place),
        reals(rows[0]),
        reals(rows[1]),
        reals(rows[2]),
        reals(body.velocity),
        reals(body.angular_velocity),
        ints(bounds.min.map(|x| node(x, f64::ceil))),
        ints(bounds.max.map(|x| node(x, f64::floor))),
    ]
}

impl WgpuBatch {
    /// Finds out where the law of a world's bodies runs: on the device if it can run there; else on the host. That of other worlds is the same; see
    /// [`LawTexts`](crate::worlds::LawTexts).
    pub(crate) fn settle_contact(&mut self, w: usize, couplings: &mut [Box<dyn Coupling>]) -> Result<()> {
        if self.worlds[w].contact.is_some() {
            return Ok(());
        }
        let mut place = if couplings.is_empty() { Place::Nowhere } else { Place::Host };
        while let Some(mut laws) = Laws::of(couplings) {
            let adapt = &self.worlds[w].adapt;
            let roams = bodies_of(couplings).iter().any(|body| !adapt.follows(&body.name));
            let needs = Needs::of(&laws, self.worlds[w].materials.len(), self.h, roams);
            // One world alone may have other bodies from now on.
            let before = self.contact.device.as_ref().filter(|_| self.worlds.len() > 1);
            let all = before.map_or(needs, |contact| contact.needs.with(needs));
            // A world without bodies that answer takes over how those of others do.
            let answers = |needs: Needs| needs.answering.groups > 0;
            if let Some(contact) = before.filter(|contact| answers(contact.needs) && !answers(needs)) {
                (laws.answer, laws.reach) = (contact.answer.clone(), contact.reach);
            }
            let is_same = |contact: &DeviceContact| {
                let answer = contact.answer == laws.answer || !answers(contact.needs);
                contact.wgsl == laws.wgsl && answer
            };
            let is_known = self.contact.device.as_deref().is_some_and(is_same);
            let is_taught = |contact: &mut DeviceContact| {
                contact.needs == all && contact.answer == laws.answer && contact.samples.share(w, &laws.samples)
            };
            let sampled = before.map_or(laws.samples.len(), |contact| contact.samples.packed_len_with(&laws.samples));
            let vectors = self.worlds.len() * all.vectors + sampled;
            if (is_known || before.is_none()) && self.has_room(all.answering, vectors) && self.fits(&laws, all) {
                if !is_known || !self.contact.device.as_deref_mut().is_some_and(is_taught) {
                    self.add_laws(w, &laws, all)?;
                }
                self.worlds[w].groups = laws.groups(self.h);
                let known = |body: BodyState| (body.name, body.mass);
                let all = couplings.iter().map(|coupling| coupling.bodies().into_iter().map(known).collect());
                self.worlds[w].bodies = all.collect();
                self.write_table(w, laws.table);
                self.worlds[w].first_bodies = laws.firsts;
                place = Place::Device;
                break;
            }
            if !couplings.iter_mut().any(|coupling| coupling.part_device_groups()) {
                break;
            }
        }
        self.gpu.check()?;
        self.worlds[w].contact = Some(place);
        Ok(())
    }

    /// Is there room on the device for what is inside so many bodies that answer, and for tables of so many vectors?
    pub(crate) fn has_room(&self, answering: Answering, vectors: usize) -> bool {
        let cap = self.gpu.limits.max_storage_buffer_binding_size.min(self.gpu.limits.max_buffer_size);
        let bytes = answering_bytes(answering, self.worlds.len(), self.levels).max(16 * vectors as u64);
        answering.widest <= MOST_ROOMS && answering.together <= MOST_TOGETHER && bytes <= cap
    }

    /// Does what groups of several bodies keep while they answer fit the adapter's memory for workgroups?
    fn fits(&self, laws: &Laws, needs: Needs) -> bool {
        let (worlds, set) = (self.worlds.len(), &self.kernels.set);
        needs.answering.together <= 1 || {
            let passes = [set.solve.is_some(), set.watch.is_some(), false];
            let draft = answer_draft(passes, laws, needs.vectors, [worlds, self.levels], needs.answering);
            fits_workgroups(&self.gpu, &self.kernels.setting, worlds, &draft)
        }
    }

    /// Teaches the device the laws of a world's couplings.
    fn add_laws(&mut self, w: usize, laws: &Laws, needs: Needs) -> Result<()> {
        let (worlds, Needs { bodies, vectors, answering, .. }) = (self.worlds.len(), needs);
        let shape = [worlds, self.levels];
        let materials = self.worlds[0].materials.len();
        let known = self.contact.device.as_ref().filter(|_| worlds > 1).map(|contact| contact.samples.clone());
        let mut samples = known.unwrap_or_else(|| Samples::none(worlds));
        if !samples.share(w, &laws.samples) {
            samples.add(w, &laws.samples);
        }
        let mut laws = laws.clone();
        laws.samples = samples.packed();
        let kernels = crate::passes::bodies::contact(
            &self.gpu,
            &self.kernels,
            &laws,
            [bodies, vectors, materials],
            shape,
            answering,
        );
        let of_groups = (answering.groups > 0).then(|| {
            let counts = [vectors, materials];
            crate::passes::bodies::answer(&self.gpu, &self.kernels, &laws, counts, shape, answering, needs.roams)
        });
        self.memory.add_bodies(&self.gpu, [bodies, worlds * vectors], answering, &laws.samples)?;
        self.unlinked = true;
        let before = self.contact.device.take().map_or_else(|| vec![Vec::new(); worlds], |contact| contact.tables);
        let Laws { wgsl, answer, reach, .. } = laws;
        let tables = vec![Vec::new(); worlds];
        let contact = DeviceContact { kernels, answering: of_groups, wgsl, answer, reach, samples, needs, tables };
        self.contact.device = Some(Box::new(contact));
        before.into_iter().enumerate().for_each(|(w, table)| self.write_table(w, table));
        Ok(())
    }

    /// Tells the device what the law of a world's bodies reads.
    pub(crate) fn write_table(&mut self, w: usize, table: Vec<[f32; 4]>) {
        if let (Some(contact), Some(buffer)) = (&mut self.contact.device, &self.memory.table) {
            let at = (16 * contact.needs.vectors * w) as u64;
            let materials = self.worlds[w].contact_materials.clone();
            let mut all = table.clone();
            all.resize(contact.needs.vectors - materials.len(), [0.0; 4]);
            all.extend(materials);
            self.gpu.queue.write_buffer(buffer, at, bytemuck::cast_slice(&all));
            if let Some(begin) = contact.samples.begin(w) {
                let at = (16 * (contact.needs.vectors * self.worlds.len() + w)) as u64;
                self.gpu.queue.write_buffer(buffer, at, bytemuck::cast_slice(&begin));
            }
            contact.tables[w] = table;
        }
    }

    /// Lets a world's driven bodies go through up to `count` steps: no further than to where its levels have to move after them.
    pub(crate) fn drive<'a>(
        &self,
        world_step: &mut WorldStep<'_>,
        dt: f64,
        count: usize,
        held: &'a [HeldGroup],
    ) -> Result<Option<Driven<'a>>> {
        let couplings = &mut *world_step.couplings;
        if couplings.is_empty() {
            return Ok(None);
        }
        // Bodies that the device moves stay where they are here: if it moves all, one step is like the next.
        let of_groups = held.iter().map(|group| group.bodies.len()).sum::<usize>();
        let all_held = of_groups == couplings.iter().map(|coupling| coupling.wrenches().len()).sum::<usize>();
        let mut driven = Driven {
            steps: 0,
            saved: Vec::new(),
            after: Vec::new(),
            packed: Vec::new(),
            near: Vec::new(),
            held,
            moved: Vec::new(),
        };
        let needs = self.contact.device.as_ref().map(|contact| contact.needs).unwrap_or_default();
        let mut go = || {
            let each = dt / self.substeps as f64;
            let (levels, firsts) = (&self.worlds[world_step.world].levels, &self.worlds[world_step.world].first_bodies);
            // Soft ones are watched by the device.
            let softs = self.worlds[world_step.world].softs.boxes(self.h);
            let mut time = world_step.time;
            for slot in 0..count * self.substeps {
                if slot % self.substeps == 0 {
                    driven.saved.push(save(couplings));
                }
                let at = self.schedule.time_of(slot % self.substeps, time, dt);
                if self.may_sleep() {
                    driven.near.push(sleep::near_tools(couplings, levels));
                }
                begin_step(couplings, at, each)?;
                // Levels that step together meet bodies where they are before the step; subcycled, coarser ones where they are after it.
                let (before, after) = levels.split_at(if self.substeps > 1 { 1 } else { levels.len() });
                let pack = |couplings: &[Box<dyn Coupling>], levels| {
                    if needs.driven { pack_all(couplings, firsts, levels, held, needs.bodies) } else { Vec::new() }
                };
                let mut packed = pack(couplings, before);
                couplings.iter_mut().try_for_each(|coupling| coupling.after_step(at, each))?;
                packed.extend(pack(couplings, after));
                driven.packed.push(packed);
                if (slot + 1) % self.substeps == 0 {
                    // As a simulation counts it: a path knows the last bit.
                    time += dt;
                    driven.steps += 1;
                    if world_step.reports_bodies {
                        driven.after.push(bodies_of(couplings));
                    }
                    let adapt = &self.worlds[world_step.world].adapt;
                    if all_held || adapt.must_follow(couplings, |body| softs.get(&body).copied()) {
                        break;
                    }
                }
            }
            Ok(())
        };
        if let Err(error) = go() {
            go_back(world_step.couplings, &Some(driven), 0)?;
            return Err(error);
        }
        if all_held {
            driven.steps = count;
            go_on(&mut driven.after, count);
            go_on(&mut driven.near, count * self.substeps);
        }
        Ok(Some(driven))
    }

    /// Tells the device where bodies are in each step.
    pub(crate) fn write_bodies(
        &self,
        world_steps: &[WorldStep<'_>],
        driven: &BTreeMap<usize, Option<Driven<'_>>>,
        steps: usize,
    ) {
        let Some(contact) = self.contact.device.as_ref().filter(|contact| contact.needs.driven) else { return };
        let each = self.levels * contact.needs.bodies * BODY as usize;
        // Of worlds that have none there.
        let nowhere = NOWHERE.repeat(steps * self.substeps * self.worlds.len() * each / NOWHERE.len());
        let mut packed = nowhere;
        for (t, driven) in driven {
            // Another world may have stopped sooner.
            let packed_of = driven.iter().flat_map(|driven| &driven.packed).take(steps * self.substeps);
            for (s, bodies) in packed_of.enumerate() {
                packed[(s * self.worlds.len() + world_steps[*t].world) * each..][..each].copy_from_slice(bodies);
            }
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Bodies, 0), 0, bytemuck::cast_slice(&packed));
    }

    /// Tells the device near what nothing sleeps in each step.
    pub(crate) fn write_near(
        &mut self,
        world_steps: &[WorldStep<'_>],
        driven: &BTreeMap<usize, Option<Driven<'_>>>,
        steps: usize,
    ) -> Result<()> {
        if !self.may_sleep() {
            return Ok(());
        }
        let mut near = vec![vec![Vec::new(); self.memory.words().layers]; steps * self.substeps];
        for (t, driven) in driven {
            let layers = self.layers_of(world_steps[*t].world);
            for (near, own) in near.iter_mut().zip(driven.iter().flat_map(|driven| &driven.near)) {
                near[layers.clone()].clone_from_slice(own);
            }
        }
        self.write_tools(0, &near)
    }

    /// Where force and torque on each driven body of each world in each of so many steps stand, times the step, to be brought back.
    pub(crate) fn felt(&self, steps: usize) -> Option<Behind> {
        let contact = self.contact.device.as_ref().filter(|contact| contact.needs.driven)?;
        let count = 2 * contact.needs.bodies * self.memory.words().layers * self.substeps * steps;
        Some(Behind::of(Role::Impulses, 0, 16 * count as u64))
    }

    /// Says in each step's report where a world's bodies were and what they felt.
    pub(crate) fn report_bodies(
        &self,
        driven: Driven<'_>,
        impulses: &[[f32; 4]],
        world_step: &mut WorldStep<'_>,
        reports: &mut [StepReport],
    ) {
        let Some(contact) = &self.contact.device else { return };
        let each = 2 * contact.needs.bodies;
        let Driven { after, moved, .. } = driven;
        let numbers = self.numbers(world_step);
        let mut after = after.into_iter();
        for (s, report) in reports.iter_mut().enumerate() {
            // Over all levels' steps within this one.
            let sum = |k: usize| {
                let mut sum = [0.0; 3];
                for slot in (0..self.substeps).filter(|_| !impulses.is_empty()) {
                    let has_stepped = |level: &usize| self.substeps == 1 || (slot + 1) % (1 << level) == 0;
                    for level in (0..self.levels).filter(has_stepped) {
                        let row =
                            ((s * self.substeps + slot) * self.worlds.len() + world_step.world) * self.levels + level;
                        (0..3).for_each(|d| sum[d] += f64::from(impulses[row * each + k][d]));
                    }
                }
                sum
            };
            let per_step = |impulse: Vec3| impulse.map(|x| x / report.dt);
            let of_impulse = |[force, torque]: [Vec3; 2]| Wrench { force: per_step(force), torque: per_step(torque) };
            let mut wrenches: Vec<_> =
                numbers.iter().map(|number| of_impulse([sum(2 * number), sum(2 * number + 1)])).collect();
            report.bodies = after.next();
            for felt in moved.get(s).into_iter().flatten() {
                if let Some(b) = numbers.iter().position(|number| *number == felt.number) {
                    wrenches[b] = of_impulse([felt.impulse.force, felt.impulse.torque]);
                    if let (Some(bodies), Some(body)) = (&mut report.bodies, &felt.body) {
                        bodies[b].clone_from(body);
                    }
                }
            }
            report.wrenches = Some(wrenches);
        }
        if let Some(StepReport { wrenches: Some(wrenches), .. }) = reports.last() {
            let mut rest = &wrenches[..];
            for coupling in world_step.couplings.iter_mut() {
                let (own, others) = rest.split_at(coupling.wrenches().len());
                coupling.book(own);
                rest = others;
            }
        }
    }

    /// The numbers on the device of a world's bodies, in the couplings' order.
    fn numbers(&self, world_step: &WorldStep<'_>) -> Vec<usize> {
        let firsts = &self.worlds[world_step.world].first_bodies;
        let pairs = world_step.couplings.iter().zip(firsts);
        pairs.flat_map(|(coupling, &first)| first..first + coupling.wrenches().len()).collect()
    }
}
