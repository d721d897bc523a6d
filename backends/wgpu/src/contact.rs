//! Contact whose law runs on the host: the nodes near the bodies of all worlds, there and back.

use crate::batch::{
    AT_START, Behind, DAMPED, DAMPED_DIGITS, HALTED, Halt, MOVE, NEAR, NODE_MOVE, Part, Status, WALL_IMPULSE,
    WgpuBatch, energy_of,
};
use crate::kernels::{Role, damps};
use crate::memory::{NEAR_BLOCK, StepConstants, Writes, read};
use crate::schedule::{ContactPasses, Dispatch, Passes, around_contact, passes_beside_host};
use crate::sleep::near_tools;
use crate::world::{FELT, Level, MAX_DRIFT, Rhythm, World};
use barchan_core::backend::Turn;
use barchan_core::schedule::ending;
use barchan_core::{Aabb, Coupling, Error, NearParticle, NodeBatch, Result, StepReport, Vec3, Wrench};
use rayon::prelude::*;
use std::collections::HashMap;
use std::ops::Range;
use std::time::Instant;

const ON_HOST: &str = "a law runs on the host";
/// Steps that the status knows of where it does: the last one and the one under way.
const STEPS: usize = 2;

/// A block of nodes on the host: velocities and masses.
struct Block {
    number: u32,
    /// Its first cell.
    first: [i32; 3],
    nodes: Vec<[f32; 4]>,
    changed: bool,
}

impl Block {
    /// As `gather.wgsl` writes it.
    fn of(words: &[[u32; 4]]) -> Self {
        let [x, y, z, number] = words[0];
        let nodes = words[1..].iter().map(|node| node.map(f32::from_bits)).collect();
        Self { number, first: [x, y, z].map(|c| c as i32), nodes, changed: false }
    }

    /// As `scatter_near.wgsl` reads it.
    fn words(&self) -> impl Iterator<Item = [u32; 4]> {
        let [x, y, z] = self.first.map(|c| c as u32);
        std::iter::once([x, y, z, self.number]).chain(self.nodes.iter().map(|node| node.map(f32::to_bits)))
    }
}

/// A particle near bodies, as `gather_particles.wgsl` writes it.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Particle {
    layer: u32,
    cell: [i32; 3],
    /// Place in its cell, in units of 2^-24.
    place: [u32; 3],
    material: u32,
    /// Bits of its mass [kg].
    mass: u32,
}

impl Particle {
    fn of(layer: u32, [at, place]: [[u32; 4]; 2]) -> Self {
        let [x, y, z, material] = at;
        let [u, v, w, mass] = place;
        Self { layer, cell: [x, y, z].map(|c| c as i32), place: [u, v, w], material, mass }
    }
}

/// What a gathering has found.
#[derive(Default)]
struct Found {
    /// In the order of their numbers.
    blocks: Vec<Block>,
    /// Sorted: the device finds them in any order.
    particles: Vec<Particle>,
}

impl Found {
    fn of(words: &[[u32; 4]]) -> Self {
        let mut found = Self::default();
        for block in words.chunks_exact(NEAR_BLOCK) {
            let [count, layer, _, number] = block[0];
            if number == u32::MAX {
                let (pairs, _) = block[1..].as_chunks::<2>();
                found.particles.extend(pairs[..count as usize].iter().map(|pair| Particle::of(layer, *pair)));
            } else {
                found.blocks.push(Block::of(block));
            }
        }
        found.blocks.sort_unstable_by_key(|block| block.number);
        found.particles.sort_unstable();
        found
    }
}

/// A level as bodies meet it.
struct Met {
    /// Cell width [m].
    h: f64,
    /// Numbers of its blocks of nodes.
    blocks: Range<usize>,
    layer: u32,
}

/// A world's nodes and particles near its bodies.
struct Near {
    /// In the order of their numbers.
    blocks: Vec<Block>,
    particles: Vec<Particle>,
    levels: Vec<Met>,
    /// Of each material, stiffness against being pushed into [Pa], and volume over mass [m³/kg].
    materials: Vec<[f32; 4]>,
    /// Nodes lighter than this carry nothing [kg].
    least_mass: f64,
}

impl Near {
    /// A world's nodes, none of which has come yet; its first layer has this number.
    fn new(world: &World, first_layer: usize) -> Self {
        let met = |(layer, level): (usize, &Level)| Met {
            h: level.h,
            blocks: level.node_blocks.clone(),
            layer: layer as u32,
        };
        Self {
            blocks: Vec::new(),
            particles: Vec::new(),
            levels: (first_layer..).zip(&world.levels).map(met).collect(),
            materials: world.contact_materials.clone(),
            least_mass: world.least_mass,
        }
    }

    /// Takes its own that it does not have yet.
    fn take(&mut self, found: &mut Found) {
        let is_own = |block: &Block| self.levels.iter().any(|level| level.blocks.contains(&(block.number as usize)));
        let (own, others): (Vec<_>, _) = std::mem::take(&mut found.blocks).into_iter().partition(is_own);
        found.blocks = others;
        let is_here = |block: &Block| self.blocks.binary_search_by_key(&block.number, |here| here.number).is_ok();
        let new: Vec<_> = own.into_iter().filter(|block| !is_here(block)).collect();
        self.blocks.extend(new);
        self.blocks.sort_unstable_by_key(|block| block.number);
        // Of a level that was asked for, all have come.
        let come: Vec<Particle> =
            found.particles.iter().copied().filter(|p| self.levels.iter().any(|l| l.layer == p.layer)).collect();
        self.particles.retain(|here| come.binary_search_by_key(&here.layer, |p| p.layer).is_err());
        self.particles.extend(come);
        self.particles.sort_unstable();
    }

    /// The law of all couplings on the nodes of some levels. Returns the greatest speed that particles may feel [m/s].
    fn touch(&mut self, levels: Range<usize>, dt: f64, couplings: &mut [Box<dyn Coupling>]) -> Result<f64> {
        let mut speed = 0.0;
        for coupling in couplings {
            for level in levels.clone() {
                speed = greater(speed, self.apply(level, dt, coupling.as_mut())?);
            }
        }
        Ok(speed)
    }

    /// Hands a level's nodes near a coupling's bodies to its law, and takes back their velocities.
    fn apply(&mut self, level: usize, dt: f64, coupling: &mut dyn Coupling) -> Result<f64> {
        let Met { h, blocks: ref own, layer } = self.levels[level];
        let reach = coupling.reach();
        let boxes: Vec<Aabb> = coupling.bounds().into_iter().map(|one| one.grown(reach * h)).collect();
        let (mut batch, mut places) = (NodeBatch { cell_width: h, ..NodeBatch::default() }, Vec::new());
        let mut numbers = HashMap::new();
        let centre = |cell: i32| (f64::from(cell) + 0.5) * h;
        for (b, block) in self.blocks.iter().enumerate().filter(|(_, block)| own.contains(&(block.number as usize))) {
            let extent = Aabb { min: block.first.map(centre), max: block.first.map(|c| centre(c + 3)) };
            if !boxes.iter().any(|one| one.meets(&extent)) {
                continue;
            }
            for (n, node) in block.nodes.iter().enumerate() {
                let mass = f64::from(node[3]);
                if mass <= self.least_mass {
                    continue;
                }
                let local = [(n / 16) as i32, (n / 4 % 4) as i32, (n % 4) as i32];
                let cell: [i32; 3] = std::array::from_fn(|d| block.first[d] + local[d]);
                let x = cell.map(centre);
                if boxes.iter().any(|b| b.contains(x)) {
                    numbers.insert(cell, batch.len() as u32);
                    batch.position.push(x);
                    batch.mass.push(mass);
                    batch.velocity.push([node[0], node[1], node[2]].map(f64::from));
                    places.push((b, n));
                }
            }
        }
        if batch.is_empty() {
            return Ok(0.0);
        }
        if reach > 0.0 {
            let number = |cell: [i32; 3]| numbers.get(&cell).copied().unwrap_or(NodeBatch::NONE);
            let around = |first: [i32; 3]| -> [u32; 8] {
                std::array::from_fn(|n| {
                    let offset = [n / 4, n / 2 % 2, n % 2].map(|x| x as i32);
                    number(std::array::from_fn(|d| first[d] + offset[d]))
                })
            };
            let mut cubes = HashMap::new();
            for particle in self.particles.iter().filter(|p| p.layer == layer) {
                let in_cell = particle.place.map(|x| f64::from(x) / f64::from(1 << 24));
                let (to_first, place) = NearParticle::between_nodes(in_cell);
                let first: [i32; 3] = std::array::from_fn(|d| particle.cell[d] + to_first[d]);
                let cube = *cubes.entry(first).or_insert_with(|| {
                    batch.cubes.push(around(first));
                    batch.cubes.len() as u32 - 1
                });
                if batch.cubes[cube as usize].iter().any(|&node| node != NodeBatch::NONE) {
                    let [modulus, specific_volume, ..] = self.materials[particle.material as usize].map(f64::from);
                    batch.particles.push(NearParticle {
                        cube,
                        position: std::array::from_fn(|d| (f64::from(particle.cell[d]) + in_cell[d]) * h),
                        place,
                        volume: f64::from(f32::from_bits(particle.mass)) * specific_volume,
                        modulus,
                    });
                }
            }
        }
        coupling.contact(dt, &mut batch)?;
        let mut fastest = 0.0f64;
        for ((&(b, n), u), mass) in places.iter().zip(&batch.velocity).zip(&batch.mass) {
            let felt = (mass / (self.least_mass * FELT)).min(1.0);
            let block = &mut self.blocks[b];
            block.changed = true;
            for d in 0..3 {
                block.nodes[n][d] = u[d] as f32;
                fastest = greater(fastest, felt * u[d].abs());
            }
        }
        Ok(fastest)
    }
}

/// The greater of two speeds, or NaN if one is.
fn greater(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
}

/// A box around a body, and how far beyond it this acts [cells of a level].
struct Around {
    bounds: Aabb,
    reach: f64,
}

/// A world's boxes around its bodies, grown by a margin [m].
fn boxes_of(turn: &Turn<'_>, margin: f64) -> Vec<Around> {
    let mut all = Vec::new();
    for coupling in turn.couplings.iter() {
        let around = |bounds: Aabb| Around { bounds: bounds.grown(margin), reach: coupling.reach() };
        all.extend(coupling.bounds().into_iter().map(around));
    }
    all
}

/// Is each box in the one that was asked for?
fn are_within(boxes: &[Around], asked: &[Around]) -> bool {
    let is_within = |(one, asked): (&Around, &Around)| one.bounds.union(&asked.bounds) == asked.bounds;
    boxes.len() == asked.len() && boxes.iter().zip(asked).all(is_within)
}

/// A world in a step whose contact is on the host.
struct Visit<'a, 'b> {
    turn: &'a mut Turn<'b>,
    /// The boxes whose nodes were asked for.
    asked: Vec<Around>,
    near: Near,
    /// Greatest node speed [m/s].
    speed: f64,
    sorted: bool,
    /// What bodies felt in the steps of all levels, as a sum over the slots of mean forces and torques.
    wrenches: Vec<Wrench>,
    failed: Option<Error>,
}

impl<'a, 'b> Visit<'a, 'b> {
    fn new(turn: &'a mut Turn<'b>, world: &World, failed: Option<Error>) -> Self {
        let (asked, wrenches) = (Vec::new(), Vec::new());
        let near = Near::new(world, turn.world * world.levels.len());
        Self { turn, asked, near, speed: 0.0, sorted: false, wrenches, failed }
    }

    fn world(&self) -> usize {
        self.turn.world
    }

    fn is_going(&self) -> bool {
        self.failed.is_none()
    }

    fn begin(&mut self, time: f64, dt: f64) -> Result<()> {
        self.turn.couplings.iter_mut().try_for_each(|coupling| coupling.before_step(time, dt))
    }

    fn end(&mut self, time: f64, dt: f64) -> Result<()> {
        self.turn.couplings.iter_mut().try_for_each(|coupling| coupling.after_step(time, dt))
    }

    /// The bodies meet the nodes of some levels.
    fn meet(&mut self, levels: Range<usize>, dt: f64) -> Result<()> {
        let reached = self.near.touch(levels, dt, self.turn.couplings)?;
        self.speed = greater(self.speed, reached);
        Ok(())
    }

    /// Have nodes become no faster than particles bear?
    fn is_slow_enough(&self, most: f64, step: u64, dt: f64) -> Result<()> {
        if self.speed * dt <= most * (1.0 + 1e-9) {
            return Ok(());
        }
        let by = "the speed that a coupling gave to a node".into();
        Err(Error::TimeStep { step, dt, bound: most / self.speed, by })
    }

    fn wrenches_now(&self) -> Vec<Wrench> {
        self.turn.couplings.iter().flat_map(|coupling| coupling.wrenches().iter().copied()).collect()
    }

    /// What bodies felt since, so many times.
    fn feel(&mut self, before: &[Wrench], times: f64) {
        let now = self.wrenches_now();
        self.wrenches.resize(now.len(), Wrench::default());
        for (i, (sum, now)) in self.wrenches.iter_mut().zip(&now).enumerate() {
            let before = before.get(i).copied().unwrap_or_default();
            for d in 0..3 {
                sum.force[d] += times * (now.force[d] - before.force[d]);
                sum.torque[d] += times * (now.torque[d] - before.torque[d]);
            }
        }
    }
}

/// Lets something happen to the worlds that go on, side by side; those that it fails for go on no more.
fn side_by_side(visits: &mut [Visit<'_, '_>], happen: impl Fn(&mut Visit<'_, '_>) -> Result<()> + Sync) {
    let happens = |visit: &mut Visit<'_, '_>| visit.failed = happen(visit).err();
    match visits {
        // One need not wait for a thread.
        [only] if only.is_going() => happens(only),
        _ => visits.par_iter_mut().filter(|visit| visit.is_going()).for_each(happens),
    }
}

impl WgpuBatch {
    /// One step of the worlds that have a turn, whose couplings' law runs on the host, or that have no particles. A world that fails is left
    /// out, and the others go on without it.
    ///
    /// 1. What is due is sorted, particles give to nodes, and the nodes near the bodies of all worlds come to the host, in one submission: the
    ///    only one that is waited for. If it turns out that a sort or a shorter step was called for, it is repeated: particles are as they were.
    /// 2. Couplings fix their bodies' velocities, meet the nodes and move, the worlds side by side.
    /// 3. Nodes go back, and particles take their velocities; what that came to stays on the device until the next step.
    pub(crate) fn step_on_host(&mut self, mut dt: f64, turns: &mut [Turn<'_>]) -> Result<Vec<Result<Vec<StepReport>>>> {
        let ground = self.particles() > 0;
        let mut visits = self.visits(turns);
        if ground {
            dt = self.bring_near(dt, &mut visits)?;
        }
        side_by_side(&mut visits, |visit| visit.begin(visit.turn.time, dt));
        if ground {
            self.fetch(0..self.levels, &mut visits)?;
        }
        let begun = Instant::now();
        let (levels, most, steps) = (self.levels, NODE_MOVE * self.h, self.steps_so_far());
        side_by_side(&mut visits, |visit| {
            visit.meet(0..levels, dt)?;
            visit.is_slow_enough(most, steps[visit.world()], dt)?;
            visit.end(visit.turn.time, dt)
        });
        self.book_contact(begun);
        if ground {
            self.nodes_to_ground(dt, &visits)?;
        }
        let mut reports = Vec::new();
        for visit in visits {
            let world = &mut self.worlds[visit.world()];
            reports.push(if let Some(error) = visit.failed {
                Err(error)
            } else {
                if ground {
                    world.book_gravity(visit.turn.time, dt, 1);
                    world.stiffness_age += 1;
                }
                world.steps += 1;
                world.last_dt = dt;
                let (sorted, max_speed) = (visit.sorted, visit.speed);
                Ok(vec![StepReport { dt, sorted, max_speed, ..StepReport::default() }])
            });
        }
        Ok(reports)
    }

    /// As [`step_on_host`](Self::step_on_host), where levels take steps of their own: bodies meet the finest level in each slot, which is a step
    /// of it, and coarser ones where theirs end, as in the backend cpu's `subcycle.rs`. A submission is waited for in each slot, and at the end.
    pub(crate) fn step_levels_on_host(
        &mut self,
        dt: f64,
        turns: &mut [Turn<'_>],
    ) -> Result<Vec<Result<Vec<StepReport>>>> {
        let mut visits = self.visits(turns);
        self.settle()?;
        let (each, steps) = (dt / self.substeps as f64, self.steps_so_far());
        for slot in 0..self.substeps {
            let schedule = self.schedule.clone();
            let late = |visit: &Visit<'_, '_>| schedule.time_of(slot, visit.turn.time, dt);
            let before = going(&visits);
            side_by_side(&mut visits, |visit| visit.begin(late(visit), each));
            self.slot_to_nodes(dt, slot, &mut visits)?;
            let begun = Instant::now();
            side_by_side(&mut visits, |visit| {
                visit.meet(0..1, each)?;
                visit.end(late(visit), each)?;
                visit.feel(&[], 1.0);
                Ok(())
            });
            let coarser = 1..ending(self.levels, slot).end;
            if !coarser.is_empty() {
                self.fetch(coarser.clone(), &mut visits)?;
            }
            side_by_side(&mut visits, |visit| {
                for l in coarser.clone() {
                    let (times, before) = (f64::from(1 << l), visit.wrenches_now());
                    visit.meet(l..l + 1, times * each)?;
                    visit.feel(&before, times);
                }
                // How far particles move is what counts.
                visit.is_slow_enough(f64::MAX, steps[visit.world()], each)
            });
            self.book_contact(begun);
            // Particles have moved in the slots before.
            let now = going(&visits);
            for (w, _) in before.into_iter().filter(|one| slot > 0 && !now.contains(one)) {
                self.worlds[w].torn.get_or_insert((dt, 0.5 * dt));
            }
        }
        let active = going(&visits);
        if !active.is_empty() {
            let status = self.run_slot(dt, self.substeps, false, &mut visits)?;
            active.iter().for_each(|&(w, time)| self.take_steps(&status, w, time, dt, 1));
        }
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            visit.failed = self.fault(visit.turn);
        }
        let mean = |wrench: &Wrench| {
            let per_slot = |x: f64| x / self.substeps as f64;
            Wrench { force: wrench.force.map(per_slot), torque: wrench.torque.map(per_slot) }
        };
        let report = |visit: Visit<'_, '_>| {
            let wrenches = Some(visit.wrenches.iter().map(mean).collect());
            let report = StepReport { dt, sorted: visit.sorted, max_speed: visit.speed, wrenches, bodies: None };
            visit.failed.map_or(Ok(vec![report]), Err)
        };
        Ok(visits.into_iter().map(report).collect())
    }

    /// From where bodies have met the ground in the slot before, to where nodes are near them in this one.
    fn slot_to_nodes(&mut self, dt: f64, slot: usize, visits: &mut [Visit<'_, '_>]) -> Result<()> {
        let levels = ending(self.levels, slot);
        let boxes = |visit: &mut Visit<'_, '_>| {
            // Bodies will have moved when they meet coarser levels.
            let margin = if levels.len() > 1 { self.h } else { 0.0 };
            visit.asked = boxes_of(visit.turn, margin);
        };
        visits.iter_mut().filter(|visit| visit.is_going()).for_each(boxes);
        self.write_near_tools(slot, visits)?;
        let mut sort = false;
        loop {
            let active = going(visits);
            let Some(&(first, _)) = active.first() else { return Ok(()) };
            self.write_around(levels.clone(), visits)?;
            let status = self.run_slot(dt, slot, sort, visits)?;
            match status.halt() {
                None => {
                    for visit in visits.iter_mut().filter(|visit| visit.is_going() && !visit.speed.is_finite()) {
                        visit.failed = Some(self.explain(visit.world(), &status, visit.speed, visit.turn.time));
                    }
                    return Ok(());
                }
                // Only the first slot of a step is halted.
                Some(halt) => self.mend(halt, &status, &mut sort, first, visits)?,
            }
        }
    }

    /// What makes a submission possible that was halted before particles moved.
    fn mend(
        &mut self,
        halt: Halt,
        status: &Status,
        sort: &mut bool,
        first: usize,
        visits: &mut [Visit<'_, '_>],
    ) -> Result<()> {
        match halt {
            Halt::Fewer => {}
            Halt::Drifted if !*sort => *sort = true,
            Halt::Room | Halt::Misplaced => {
                if halt == Halt::Room {
                    self.make_room(status)?;
                }
                let is_astray = |visit: &&Visit<'_, '_>| status.is_astray(self.layers_of(visit.world()));
                let astray: Vec<_> = visits.iter().filter(is_astray).collect();
                astray.into_iter().try_for_each(|visit| self.adapt(visit.world(), None, visit.turn.couplings))?;
            }
            _ => {
                let culprit = self.world_of(status).unwrap_or(first);
                if let Some(visit) = visits.iter_mut().find(|visit| visit.world() == culprit) {
                    visit.failed = Some(self.explain(culprit, status, f64::NAN, visit.turn.time));
                }
            }
        }
        Ok(())
    }

    /// Runs the passes from where bodies met the ground in the slot before a slot to where they meet it in that one, or, behind the last slot, to
    /// the end of the step.
    fn run_slot(&mut self, dt: f64, slot: usize, sort: bool, visits: &mut [Visit<'_, '_>]) -> Result<Status> {
        let active = going(visits);
        let sort = slot == 0 && (sort || self.is_any_due(&active));
        if sort {
            self.cover_blocks(1)?;
        }
        self.write_layers(&self.layers(|w| active.iter().any(|a| a.0 == w)));
        let words = self.memory.words();
        if slot == 0 {
            self.write_words(HALTED, &AT_START);
            let sums = words.of_sum(0, 0);
            self.write_words(sums, &self.fresh(sums, 0..1, dt, &active));
        }
        let changed = self.write_changed(visits);
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let before = self.memory.now;
        let measures = (self.h, self.fixed.gravity.0);
        let contact = ContactPasses::on_host();
        let mut passes = Passes::new(&self.kernels, contact, &self.schedule, before, measures);
        let step = passes.constants(dt);
        if sort {
            passes.sort(dt);
        }
        let mut starts = vec![0];
        for one in 0..self.substeps {
            let (before, after) = around_contact(&self.schedule, one);
            passes.carry_out(&before, dt);
            starts.push(passes.dispatches.len());
            passes.carry_out(&after, dt);
        }
        passes.look_for_soft(dt);
        let end = starts.get(slot + 1).copied().unwrap_or(passes.dispatches.len());
        let own = passes.dispatches.drain(starts[slot]..end).collect::<Vec<_>>();
        passes.dispatches.clear();
        passes.run(step, Some(&near.scatter).filter(|_| changed > 0));
        passes.dispatches.extend(own);
        if slot < self.substeps {
            passes.run(step, &near.gather);
        } else {
            passes.run(step, &self.kernels.set.collect);
        }
        self.write_steps(0, &passes.constants);
        let parts = self.with_groups(vec![Part { sorting: sort.then_some(before), dispatches: passes.dispatches }]);
        let room = if slot < self.substeps { self.near_expected() } else { 0 };
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        if slot == 0 {
            self.take_blocks(&status);
        }
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            let layers = self.layers_of(visit.world());
            visit.sorted = status.sorted_before(layers.start).is_some();
            visit.speed = greater(visit.speed, status.speed(0, layers));
        }
        if slot < self.substeps && status.halt().is_none() {
            self.hand_out(&status, of_nodes, visits)?;
        }
        Ok(status)
    }

    fn visits<'a, 'b>(&self, turns: &'a mut [Turn<'b>]) -> Vec<Visit<'a, 'b>> {
        let visit = |turn: &'a mut Turn<'b>| {
            let failed = self.fault(turn);
            let world = &self.worlds[turn.world];
            Visit::new(turn, world, failed)
        };
        turns.iter_mut().map(visit).collect()
    }

    fn steps_so_far(&self) -> Vec<u64> {
        self.worlds.iter().map(|world| world.steps).collect()
    }

    fn book_contact(&mut self, begun: Instant) {
        self.contact_seconds.0 += begun.elapsed().as_secs_f64();
        self.contact_seconds.1 += 1;
    }

    /// Particles give to nodes, and the nodes near bodies come to the host. Returns the step that all worlds bear [s].
    fn bring_near(&mut self, mut dt: f64, visits: &mut [Visit<'_, '_>]) -> Result<f64> {
        let mut sort = false;
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            visit.asked = boxes_of(visit.turn, 0.0);
        }
        self.write_near_tools(1, visits)?;
        loop {
            let active = going(visits);
            let Some(&(first, _)) = active.first() else { return Ok(dt) };
            let status = self.ground_to_nodes(dt, sort, visits)?;
            if let Some(halt) = status.halt() {
                self.mend(halt, &status, &mut sort, first, visits)?;
                continue;
            }
            let shorter = self.bearable(visits, &status, dt);
            if shorter == dt && going(visits).len() == active.len() {
                return Ok(dt);
            }
            dt = shorter;
        }
    }

    /// Brings those nodes near bodies that have not come, since bodies reach further than they did when nodes were asked for.
    fn fetch(&mut self, levels: Range<usize>, visits: &mut [Visit<'_, '_>]) -> Result<()> {
        let mut is_here = true;
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            let boxes = boxes_of(visit.turn, 0.0);
            if !are_within(&boxes, &visit.asked) {
                (visit.asked, is_here) = (boxes, false);
            }
        }
        if is_here {
            return Ok(());
        }
        self.write_around(levels, visits)?;
        self.write_words(NEAR, &[0]);
        let mut found = self.gather()?;
        visits.iter_mut().for_each(|visit| visit.near.take(&mut found));
        Ok(())
    }

    /// The step that the fastest world bears; worlds that bear none have failed.
    fn bearable(&mut self, visits: &mut [Visit<'_, '_>], status: &Status, mut dt: f64) -> f64 {
        let asked = dt;
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            let moves = visit.speed * asked / self.h;
            if !moves.is_finite() {
                visit.failed = Some(self.explain(visit.world(), status, visit.speed, visit.turn.time));
            } else if moves > NODE_MOVE {
                self.worlds[visit.world()].shortened += 1;
                dt = dt.min(asked * (0.9 * NODE_MOVE / moves).max(0.1));
            }
        }
        dt
    }

    /// Tells the device the boxes around bodies, as cells of each of some levels.
    fn write_around(&mut self, levels: Range<usize>, visits: &[Visit<'_, '_>]) -> Result<()> {
        let most = visits.iter().map(|visit| visit.asked.len()).max().unwrap_or(0).max(1);
        self.memory.add_near(&self.gpu, most, 64 * self.worlds.len())?;
        // A box that holds nothing.
        let none = [[i32::MAX / 4, i32::MAX / 4, i32::MAX / 4, 0], [i32::MIN / 4, i32::MIN / 4, i32::MIN / 4, 0]];
        let mut vectors = vec![[most as i32, 0, 0, 0]];
        vectors.extend(std::iter::repeat_n(none, self.memory.words().layers * most).flatten());
        for visit in visits.iter().filter(|visit| visit.is_going()) {
            for l in levels.clone() {
                let (layer, h) = (self.layers_of(visit.world()).start + l, self.worlds[visit.world()].levels[l].h);
                for (b, Around { bounds, reach }) in visit.asked.iter().enumerate() {
                    let one = bounds.grown(reach * h);
                    // Nodes stand at the centres of cells; which of them are inside, the host finds out.
                    let node = |x: f64, round: fn(f64) -> f64| round(x / h - 0.5).clamp(-1e9, 1e9) as i32;
                    let [x, y, z] = one.min.map(|x| node(x, f64::floor));
                    let at = 1 + 2 * (layer * most + b);
                    // Particles are asked for where they are looked at.
                    vectors[at] = [x, y, z, i32::from(*reach > 0.0)];
                    let [x, y, z] = one.max.map(|x| node(x, f64::ceil));
                    vectors[at + 1] = [x, y, z, 0];
                }
            }
        }
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Around, 0), 0, bytemuck::cast_slice(&vectors));
        Ok(())
    }

    /// Tells the device near what nothing sleeps in a step.
    fn write_near_tools(&mut self, step: usize, visits: &[Visit<'_, '_>]) -> Result<()> {
        let mut near = vec![Vec::new(); self.memory.words().layers];
        for visit in visits {
            let own = near_tools(visit.turn.couplings, &self.worlds[visit.world()].levels);
            near[self.layers_of(visit.world())].clone_from_slice(&own);
        }
        self.write_tools(step, &[near])
    }

    /// Are worlds due to be sorted, as far as is known?
    fn is_any_due(&self, active: &[(usize, f64)]) -> bool {
        let is_due = |world: &World| world.levels.iter().any(|level| world.likely(level).is_due(self.most_drift));
        self.unlinked || active.iter().any(|(w, _)| is_due(&self.worlds[*w]))
    }

    /// The nodes that have come, to the worlds whose they are.
    fn hand_out(&mut self, status: &Status, of_nodes: Vec<u32>, visits: &mut [Visit<'_, '_>]) -> Result<()> {
        let mut found = self.found_near(status, of_nodes)?;
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            let world = visit.world();
            visit.near = Near::new(&self.worlds[world], self.layers_of(world).start);
            visit.near.take(&mut found);
        }
        Ok(())
    }

    /// Hands back the blocks of nodes that have changed; how many there are.
    fn write_changed(&self, visits: &[Visit<'_, '_>]) -> usize {
        let going = visits.iter().filter(|visit| visit.is_going());
        let blocks = going.flat_map(|visit| &visit.near.blocks).filter(|block| block.changed);
        let changed: Vec<[u32; 4]> = blocks.flat_map(Block::words).collect();
        let count = changed.len() / NEAR_BLOCK;
        self.write_words(NEAR, &[0, count as u32]);
        self.gpu.queue.write_buffer(self.memory.buffer(Role::Near, 0), 0, bytemuck::cast_slice(&changed));
        count
    }

    /// A sort if one is asked for or likely to be due, P2G and the grid update; brings back the status and the nodes near bodies.
    fn ground_to_nodes(&mut self, dt: f64, sort: bool, visits: &mut [Visit<'_, '_>]) -> Result<Status> {
        let active = going(visits);
        let sort = sort || self.is_any_due(&active);
        if sort {
            self.cover_blocks(1)?;
        }
        self.write_around(0..self.levels, visits)?;
        // The last step's numbers stand in the words of step 0.
        let mut layers = self.layers(|w| active.iter().any(|a| a.0 == w));
        for (layer, of_layer) in layers.iter_mut().enumerate() {
            if !self.worlds[layer / self.levels].pending {
                of_layer.age = of_layer.age.wrapping_sub(1);
            }
        }
        self.write_layers(&layers);
        // What particles need has not been seen when the step is chosen: the next one takes it into account.
        self.write_steps(1, &[StepConstants { most_need: f32::MAX, ..self.step_constants(dt, 1) }]);
        let words = self.memory.words();
        self.write_words(HALTED, &AT_START);
        self.write_words(NEAR, &[0]);
        if self.worlds.iter().any(|world| world.pending) {
            for w in (0..self.worlds.len()).filter(|w| !self.worlds[*w].pending) {
                self.write_words(words.of_step(0, self.layers_of(w).start, 0), &drifts(&self.worlds[w], 0));
            }
        } else {
            let sums = words.of_sum(0, 0);
            self.write_words(sums, &vec![0; words.of_sum(words.layers, 0) - sums]);
            let drifts: Vec<u32> = self.worlds.iter().flat_map(|world| drifts(world, 0)).collect();
            self.write_words(words.of_step(0, 0, 0), &drifts);
        }
        let from = words.of_step(1, 0, 0);
        self.write_words(from, &self.fresh(from, 1..2, dt, &active));
        self.write_words(words.fast(1), &[0]);

        let near = self.contact.host.as_ref().expect(ON_HOST);
        let before = self.memory.now;
        let sorting = sort.then_some(before);
        let now = if sort { 1 - before } else { before };
        let kernels = &self.kernels;
        let sorts = kernels.set.sort.iter().filter(|_| sort).map(|kernel| Dispatch {
            kernel,
            now: before,
            step: 1,
            end: self.levels,
        });
        let (calls, _) = around_contact(&self.schedule, 0);
        let passes = passes_beside_host(&kernels.set, &self.schedule, &calls).chain(&near.gather);
        let dispatches =
            sorts.chain(passes.map(|kernel| Dispatch { kernel, now, step: 1, end: self.levels })).collect();
        let parts = self.with_groups(vec![Part { sorting, dispatches }]);
        let room = self.near_expected();
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        self.take_pending(&status);
        self.take_blocks(&status);
        for visit in visits.iter_mut().filter(|visit| visit.is_going()) {
            let layers = self.layers_of(visit.world());
            if status.sorted_before(layers.start).is_some() {
                self.worlds[visit.world()].levels.iter_mut().for_each(|level| level.rhythm = Rhythm::default());
                visit.sorted = true;
            }
            visit.speed = status.speed(1, layers);
        }
        if status.halt().is_none() {
            self.hand_out(&status, of_nodes, visits)?;
        }
        Ok(status)
    }

    /// As many blocks as are brought back with the status: a quarter more than there were.
    fn near_expected(&self) -> usize {
        (self.near_blocks + self.near_blocks / 4 + 16).min(self.memory.near())
    }

    /// All that a gathering has found. If that is more than was expected, it is asked for; if more than there is room for, gathered again.
    fn found_near(&mut self, status: &Status, mut of_nodes: Vec<u32>) -> Result<Found> {
        let count = status.words[NEAR] as usize;
        self.near_blocks = count;
        if count > self.memory.near() {
            self.memory.add_near(&self.gpu, 0, count + count / 4)?;
            self.write_words(NEAR, &[0]);
            return self.gather();
        }
        let (here, wanted) = (of_nodes.len(), 4 * NEAR_BLOCK * count);
        if wanted > here {
            let rest = wanted - here;
            of_nodes.extend(read::<u32>(&self.gpu, self.memory.buffer(Role::Near, 0), 4 * here as u64, rest)?);
        }
        Ok(Found::of(bytemuck::cast_slice(&of_nodes[..wanted])))
    }

    /// Gathers what is in the boxes on its own.
    fn gather(&mut self) -> Result<Found> {
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let (now, end) = (self.memory.now, self.levels);
        let dispatches = near.gather.iter().map(|kernel| Dispatch { kernel, now, step: 1, end }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let room = self.near_expected();
        let (status, of_nodes) =
            Self::run(&Writes::default(), &self.gpu, &mut self.memory, &mut self.clocks, &parts, STEPS, behind(room))?;
        self.found_near(&status, of_nodes)
    }

    /// Takes in the numbers of a step that were still on the device.
    fn take_pending(&mut self, status: &Status) {
        for w in 0..self.worlds.len() {
            if !std::mem::take(&mut self.worlds[w].pending) {
                continue;
            }
            let layers = self.layers_of(w);
            let world = &mut self.worlds[w];
            for (layer, level) in layers.zip(&mut world.levels) {
                let moved = status.in_step(0, layer, MOVE);
                level.rhythm = level.rhythm.after(moved);
                level.particle_speed = f64::from(moved) * level.h / world.last_dt;
            }
            self.take_sums(status, w);
            self.take_needs(status, w, 0);
        }
    }

    /// Asks for the numbers of a step that are still on the device.
    pub(crate) fn settle(&mut self) -> Result<()> {
        if self.worlds.iter().any(|world| world.pending) {
            let words = self.memory.words();
            let found = read(&self.gpu, self.memory.buffer(Role::Status, 0), 0, words.count(STEPS))?;
            self.take_pending(&Status::new(found, words));
        }
        Ok(())
    }

    /// Nodes go back, and particles take their velocities. What it came to stays on the device until the next step asks for it.
    fn nodes_to_ground(&mut self, dt: f64, visits: &[Visit<'_, '_>]) -> Result<()> {
        let active = going(visits);
        if active.is_empty() {
            return Ok(());
        }
        let goes = |visit: &&Visit<'_, '_>| visit.is_going();
        let speed_of = |w: usize| visits.iter().filter(goes).find(|visit| visit.world() == w).map(|visit| visit.speed);
        let speeds: Vec<_> = (0..self.worlds.len()).map(|w| speed_of(w).unwrap_or(0.0) as f32).collect();
        let words = self.memory.words();
        self.write_steps(0, &[self.step_constants(dt, 0)]);
        let sums = words.of_sum(0, 0);
        self.write_words(sums, &vec![0; words.of_sum(words.layers, 0) - sums]);
        let of_world = |(world, speed): (&World, &f32)| drifts(world, speed.to_bits());
        let drifts: Vec<u32> = self.worlds.iter().zip(&speeds).flat_map(of_world).collect();
        // Nodes that were too fast have been found out by now.
        self.write_words(words.fast(0), &[0]);
        self.write_words(words.of_step(0, 0, 0), &drifts);
        if active.len() < visits.len() {
            self.write_layers(&self.layers(|w| speed_of(w).is_some()));
        }
        let count = self.write_changed(visits);
        let near = self.contact.host.as_ref().expect(ON_HOST);
        let (kernels, now) = (&self.kernels.set, self.memory.now);
        let back = Some(&near.scatter).filter(|_| count > 0).into_iter();
        let (_, calls) = around_contact(&self.schedule, 0);
        let passes = back
            .chain(passes_beside_host(kernels, &self.schedule, &calls))
            .chain(kernels.soft())
            .chain(&kernels.collect);
        let dispatches = passes.map(|kernel| Dispatch { kernel, now, step: 0, end: self.levels }).collect();
        let parts = self.with_groups(vec![Part { sorting: None, dispatches }]);
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        for (part, groups) in &parts {
            part.dispatches.iter().for_each(|d| self.clocks.of.entry(d.kernel.name).or_default().passes += 1);
            let dispatches: Vec<_> = part.dispatches.iter().zip(groups.iter().copied()).collect();
            Self::encode(&self.gpu, &mut encoder, &mut self.memory, &dispatches, None);
        }
        self.gpu.queue.submit([encoder.finish()]);
        self.gpu.check()?;
        active.iter().for_each(|(w, _)| self.worlds[*w].pending = true);
        Ok(())
    }

    /// The rhythms of a world's levels after its last step, also if that step's numbers are still on the device.
    pub(crate) fn rhythms(&self, w: usize) -> Vec<Rhythm> {
        let rhythm = |(layer, level): (usize, &crate::world::Level)| {
            if !self.worlds[w].pending {
                return level.rhythm;
            }
            let at = 4 * self.memory.words().of_step(0, layer, MOVE) as u64;
            let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), at, 1);
            level.rhythm.after(words.map_or(MAX_DRIFT, |words| words[0]))
        };
        self.layers_of(w).zip(&self.worlds[w].levels).map(rhythm).collect()
    }

    /// What walls gave a world in a step whose numbers are still on the device [N s].
    pub(crate) fn pending_walls(&self, w: usize) -> Vec3 {
        if !self.worlds[w].pending || self.kernels.set.collect.is_empty() {
            return [0.0; 3];
        }
        let of_layer = |layer: usize| {
            let at = 4 * self.memory.words().of_sum(layer, WALL_IMPULSE) as u64;
            let words: Result<Vec<f32>> = read(&self.gpu, self.memory.buffer(Role::Status, 0), at, 3);
            words.map_or([0.0; 3], |w| [w[0], w[1], w[2]].map(f64::from))
        };
        self.layers_of(w).map(of_layer).fold([0.0; 3], |sum, v| std::array::from_fn(|d| sum[d] + v[d]))
    }

    /// What damping dissipated of a world in such a step [J].
    pub(crate) fn pending_damped(&self, w: usize) -> f64 {
        if !self.worlds[w].pending || !damps(&self.worlds[w].materials) {
            return 0.0;
        }
        let of_layer = |layer: usize| {
            let at = 4 * self.memory.words().of_sum(layer, DAMPED) as u64;
            let words: Vec<u32> =
                read(&self.gpu, self.memory.buffer(Role::Status, 0), at, DAMPED_DIGITS).unwrap_or_default();
            words.try_into().map_or(0.0, energy_of)
        };
        self.layers_of(w).map(of_layer).sum()
    }
}

/// So many blocks of nodes near bodies, to be brought back.
fn behind(blocks: usize) -> Option<Behind> {
    Some(Behind::of(Role::Near, 0, (16 * NEAR_BLOCK * blocks) as u64))
}

/// The worlds that go on, and their times [s].
fn going(visits: &[Visit<'_, '_>]) -> Vec<(usize, f64)> {
    visits.iter().filter(|visit| visit.is_going()).map(|visit| (visit.world(), visit.turn.time)).collect()
}

/// Words of a world's levels in a step that begins, with that greatest node speed.
fn drifts(world: &World, speed: u32) -> Vec<u32> {
    world.levels.iter().flat_map(|level| [speed, 0, level.rhythm.drift.to_bits(), 0]).collect()
}
