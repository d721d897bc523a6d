//! Steps backwards, for gradients.
//!
//! A step is x, v, C, b → stress and b' (the law) → momentum and mass of nodes (P2G, walls) → their velocity, which bodies change → v', C', x' (G2P). Backwards, what a loss owes to the
//! latter goes to the nodes' velocity (the adjoint of G2P), through contact (`contact.rs`) to their momentum and mass, and from these to stress, v, C and x (that of P2G), and through the law to
//! b, C, its history and its parameters. What the step made of the nodes is found anew, in f64 whatever the run's precision.
//!
//! Particles are worked on in pieces of a fixed number, some of which share nodes of their own. These are added up in the order of the pieces: sums are the same bits for
//! any number of threads.

mod contact;
mod damping;
mod nodes;
mod rims;
mod transfer;

use barchan_abi as abi;
use barchan_core::account::BATCH;
use barchan_core::batch::{Answer, Matter, Motion, Owed, Plane};
use barchan_core::gradient::Gradient;
use barchan_core::material::ErrorBuffer;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{
    Adapted, Adjoint, Coupling, Error, ParticleList, ParticleState, Plan, Regions, Result, Scene, SortPhase, Vec3,
};
use barchan_grid::adapt::replay::Replay;
use barchan_grid::archive::{Tiles, edge_of};
use barchan_grid::block::{self, CELLS};
use barchan_grid::bounds::Bounds;
use barchan_grid::limits::{LEAST_MASS, MAX_DEFORMATION};
use barchan_lanes::Isa;
use contact::{Around, Ground, Met};
use damping::Seen;
use nodes::{Nodes, Values};
use rayon::ThreadPool;
use rayon::prelude::*;
use rims::{Rim, runs_of};
use transfer::{Given, Group, Try, TryBack, take_in};

/// Pieces that share nodes: with fewer, more of these are added up than particles touch.
const PIECES: usize = 16;

/// Why a law has the callback that it is asked by.
const ASKED: &str = "whoever records steps has refused laws without it";

/// Goes back through the steps of a plan.
pub(crate) struct CpuAdjoint {
    pool: ThreadPool,
    materials: Vec<PlannedMaterial>,
    /// Of each level, finest first.
    grids: Vec<LevelGrid>,
    regions: Regions,
    replay: Replay,
    scene: Scene,
    ground: Ground,
    /// How each material's damping changes with its parameters.
    damping: Vec<damping::Slopes>,
    isa: Isa,
}

/// Particles in the order of their numbers, which rise with their ids.
struct Order {
    /// The number of each particle of each list.
    numbers: Vec<Vec<u32>>,
    /// By numbers: of which list each is, and its place there.
    places: Vec<(u32, u32)>,
}

/// What a level's grid is like.
struct LevelGrid {
    bounds: Bounds,
    /// Cell width [m].
    h: f64,
}

/// Particles that are worked on together: of one list, which has a number, so many from one on.
#[derive(Clone, Copy)]
struct Piece<'a> {
    list: &'a ParticleList,
    of: usize,
    first: usize,
    count: usize,
    /// Their numbers among all particles, in the order of these.
    number: &'a [u32],
}

/// What a law made of a batch, part by part of the step's strain.
struct Deformed {
    /// Before each part, and its trial.
    before: Vec<[Vec<Plane<f64, BATCH>>; 3]>,
    /// Strain and history behind the last part.
    after: [Vec<Plane<f64, BATCH>>; 2],
    kirchhoff: [Plane<f64, BATCH>; 6],
}

impl Deformed {
    /// A particle's Kirchhoff stress.
    #[inline(always)]
    fn stress(&self, i: usize) -> [f64; 6] {
        self.kirchhoff.each_ref().map(|plane| plane.0[i])
    }

    /// A particle's strain before and after flow in the last part.
    fn numbers(&self, i: usize) -> [[f64; 9]; 2] {
        let trial = self.before.last().map_or(&[][..], |[_, trial, _]| trial);
        [values(trial, i), values(&self.after[0], i)]
    }

    /// What damping sees of it.
    fn seen<'a>(&self, i: usize, numbers: &'a [[f64; 9]; 2], dt: f64, rates: &[Plane<f64, BATCH>; 9]) -> Seen<'a> {
        let [trial, strain] = numbers.each_ref().map(|all| &all[..self.after[0].len()]);
        Seen { dt, rates: std::array::from_fn(|c| rates[c].0[i] * dt), trial, strain }
    }
}

/// A step to go back through.
#[derive(Clone, Copy)]
struct Step {
    time: f64,
    dt: f64,
    gravity: Vec3,
    /// How much of the scene's gravity that is.
    grown: f64,
    /// The step over which C has yet to change the strain [s], and in how many parts.
    strain_dt: f64,
    parts: u32,
}

/// A node before a wall that lets go, and its image, as they were before the wall acted on them.
struct Pair {
    separation: usize,
    node: usize,
    image: usize,
    sums: [[f64; 4]; 2],
    presses: bool,
}

impl CpuAdjoint {
    pub(crate) fn new(plan: &Plan) -> Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(plan.threads).build().map_err(|e| Error::Io {
            file: "threads".into(),
            what: "starting worker threads",
            source: std::io::Error::other(e),
        })?;
        let grid = |(level, h): (usize, &f64)| LevelGrid { bounds: Bounds::new(plan, level), h: *h };
        Ok(Self {
            pool,
            materials: plan.materials.clone(),
            grids: plan.cell_widths.iter().enumerate().map(grid).collect(),
            regions: plan.regions.clone(),
            replay: Replay::new(plan),
            scene: plan.scene.clone(),
            ground: Ground::new(plan)?,
            damping: damping::slopes(plan)?,
            isa: plan.isa,
        })
    }

    /// What a list's law and step come to for a piece: stress, and what goes back through it needs.
    fn deform(&self, piece: &Piece<'_>, step: &Step) -> Result<Deformed> {
        let list = piece.list;
        let planned = &self.materials[list.material as usize];
        let (dt, vel_grad) = (step.strain_dt / f64::from(step.parts), self.rates(piece));
        let mut strain: Vec<_> = list.strain.iter().map(|plane| piece.plane(plane)).collect();
        let mut state: Vec<_> = list.state.iter().map(|plane| piece.plane(plane)).collect();
        let (mut before, mut kirchhoff) = (Vec::new(), [Plane::default(); 6]);
        for _ in 0..step.parts {
            let trial = self.isa.run(Try { dt, vel_grad: &vel_grad, strain: &strain });
            before.push([strain.clone(), trial, state.clone()]);
            let [_, trial, old] = &before[before.len() - 1];
            let matter = Matter { count: piece.count, parameters: &planned.parameters, strain: trial, state: old };
            let motion = Motion { dt, vel_grad: &vel_grad };
            let answer = Answer { strain: &mut strain, kirchhoff: &mut kirchhoff, state: &mut state };
            let mut error = ErrorBuffer::default();
            let status = planned.material.update(&matter, Some(motion), answer, &mut error).expect(ASKED);
            error.check(status, &planned.material, "update_f64", |i| piece.id(i))?;
        }
        let mut made = Deformed { before, after: [strain, state], kirchhoff };
        if let Some(damping) = planned.damping.filter(|_| dt > 0.0) {
            for i in 0..BATCH {
                let stress = made.seen(i, &made.numbers(i), dt, &vel_grad).stress(damping);
                made.kirchhoff.iter_mut().zip(stress).for_each(|(plane, stress)| plane.0[i] += stress);
            }
        }
        Ok(made)
    }

    /// The affine matrices of a piece, plane by plane.
    fn rates(&self, piece: &Piece<'_>) -> [Plane<f64, BATCH>; 9] {
        std::array::from_fn(|c| {
            Plane(std::array::from_fn(|i| piece.list.affine[piece.first + i.min(piece.count - 1)][c]))
        })
    }

    /// Walls that let go act on sums of nodes. Returns what they were before, in the order in which walls acted.
    fn separate(bounds: &Bounds, sums: &mut Nodes) -> Vec<Pair> {
        let mut pairs = Vec::new();
        for (number, (separation, faces)) in bounds.separations.iter().enumerate() {
            for image in 0..sums.keys.len() * CELLS {
                let mut cell = sums.cell(image);
                let behind = if separation.inward > 0.0 {
                    2 * cell[separation.axis] < *faces
                } else {
                    2 * cell[separation.axis] > *faces
                };
                if !behind || sums.get(image)[3] <= 0.0 {
                    continue;
                }
                cell[separation.axis] = faces - cell[separation.axis];
                let block = sums.block(block::of_cell(cell));
                let node = sums.find(cell).unwrap_or(block * CELLS);
                let (mut here, mut there) = (sums.get(node), sums.get(image));
                let before = [here, there];
                let (presses, _) = separation.fold(&mut here, &mut there);
                (*sums.get_mut(node), *sums.get_mut(image)) = (here, there);
                pairs.push(Pair { separation: number, node, image, sums: before, presses });
            }
        }
        pairs
    }

    /// The law and the strain of a piece backwards: `given` gets what is missing.
    fn deform_back(
        &self,
        piece: &Piece<'_>,
        made: &Deformed,
        step: &Step,
        gradient: &Gradient,
        mut kirchhoff: [Plane<f64, BATCH>; 6],
        given: &mut Given,
    ) -> Result<()> {
        let planned = &self.materials[piece.list.material as usize];
        let (planes, states) = (piece.list.strain.len(), piece.list.state.len());
        let (dt, vel_grad) = (step.strain_dt / f64::from(step.parts), self.rates(piece));
        let of = |value: &dyn Fn(usize) -> f64| {
            let mut plane = Plane::<f64, BATCH>::default();
            plane.0.iter_mut().zip(piece.number).for_each(|(x, number)| *x = value(*number as usize));
            plane
        };
        let mut strain: Vec<_> = (0..planes).map(|c| of(&|n| gradient.particles.strain[n][c])).collect();
        let mut state: Vec<_> = (0..states).map(|c| of(&|n| gradient.particles.state[n][c])).collect();
        let mut parameters = vec![0.0; planned.parameters.len()];
        // Only the last part's stress is damped.
        let mut by_damping: Option<Vec<Plane<f64, BATCH>>> = None;
        if let Some(damping) = planned.damping.filter(|_| dt > 0.0) {
            let of_trial = by_damping.insert(vec![Plane::default(); planes]);
            for (i, affine) in given.affine.iter_mut().enumerate() {
                let owed = kirchhoff.each_ref().map(|plane| plane.0[i]);
                let of = made.seen(i, &made.numbers(i), dt, &vel_grad).stress_back(damping, owed);
                (0..9).for_each(|c| affine[c] += dt * of.rates[c]);
                strain.iter_mut().zip(of.strain).for_each(|(plane, owed)| plane.0[i] += owed);
                of_trial.iter_mut().zip(of.trial).for_each(|(plane, owed)| plane.0[i] = owed);
                let slopes = &self.damping[piece.list.material as usize];
                for (sum, slope) in parameters.iter_mut().zip(slopes) {
                    *sum += of.damping.lambda * slope.lambda + of.damping.mu * slope.mu;
                }
            }
        }
        for [before, trial, old] in made.before.iter().rev() {
            let mut of_trial = vec![Plane::default(); planes];
            let mut of_rates = [Plane::default(); 9];
            let mut of_state = vec![Plane::default(); states];
            let matter = Matter { count: piece.count, parameters: &planned.parameters, strain: trial, state: old };
            let owed = Owed {
                strain: &strain,
                kirchhoff: &kirchhoff,
                state: &state,
                trial: &mut of_trial,
                vel_grad: &mut of_rates,
                state_before: &mut of_state,
                parameters: &mut parameters,
            };
            let mut error = ErrorBuffer::default();
            let motion = Motion { dt, vel_grad: &vel_grad };
            let status = planned.material.pull_back(&matter, motion, owed, &mut error).expect(ASKED);
            error.check(status, &planned.material, "update_adj_f64", |i| piece.id(i))?;
            for (of_trial, damped) in of_trial.iter_mut().zip(by_damping.take().into_iter().flatten()) {
                of_trial.0.iter_mut().zip(damped.0).for_each(|(sum, owed)| *sum += owed);
            }
            let tried = Try { dt, vel_grad: &vel_grad, strain: before };
            strain = self.isa.run(TryBack { given: tried, of_trial: &of_trial, of_rates: &mut of_rates });
            for (i, affine) in given.affine.iter_mut().enumerate() {
                (0..9).for_each(|c| affine[c] += of_rates[c].0[i]);
            }
            state = of_state;
            // Only the last part's stress acts.
            kirchhoff = [Plane::default(); 6];
        }
        (given.strain, given.state, given.parameters) = (strain, state, parameters);
        Ok(())
    }

    /// What is owed to nodes before walls that let go, from what is owed to their images behind them, which move as they do.
    fn images_back(bounds: &Bounds, pairs: &[Pair], owed: &mut Nodes) {
        for pair in pairs {
            let separation = &bounds.separations[pair.separation].0;
            let image = std::mem::take(owed.get_mut(pair.image));
            let back = separation.unfold_back(pair.presses, [image[0], image[1], image[2]]);
            (0..3).for_each(|d| owed.get_mut(pair.node)[d] += back[d]);
        }
    }

    /// What is owed to the sums of nodes, from what is owed to their velocities, and to masses by contact.
    fn sums_back(bounds: &Bounds, [velocities, sums]: [&Nodes; 2], pairs: &[Pair], owed: &mut Nodes) {
        let all = (&mut owed.values, &velocities.values, &sums.values);
        all.into_par_iter().for_each(|(owed, velocities, sums)| {
            for (of, (velocity, [x, y, z, mass])) in owed.iter_mut().zip(velocities.iter().zip(sums)) {
                if velocity[3] > 0.0 {
                    let along = of[0] * x + of[1] * y + of[2] * z;
                    *of = [of[0] / mass, of[1] / mass, of[2] / mass, of[3] - along / (mass * mass)];
                } else {
                    // Where ground out of reach holds it, what a body took still depends on its mass.
                    *of = [0.0, 0.0, 0.0, of[3]];
                }
            }
        });
        for pair in pairs.iter().rev() {
            let separation = &bounds.separations[pair.separation].0;
            let [node, image] = separation.fold_back(&pair.sums[0], &pair.sums[1], owed.get(pair.node));
            (*owed.get_mut(pair.node), *owed.get_mut(pair.image)) = (node, image);
        }
    }

    /// Nodes at the edge of the ground within reach stay at rest.
    fn hold(&self, velocities: &mut [Nodes], live: &Tiles) {
        let (Some(nodes), Some(grid)) = (velocities.last_mut(), self.grids.last()) else { return };
        if !self.regions.unbounded() {
            return;
        }
        let world = [0, 1].map(|d| [grid.bounds.min[d], grid.bounds.max[d]]);
        for (key, values) in nodes.keys.iter().zip(&mut nodes.values) {
            let columns = edge_of(live, [key[0], key[1]], world);
            let held = values.iter_mut().enumerate().filter(|(n, _)| columns >> (n / 4) & 1 == 1);
            held.for_each(|(_, node)| *node = [0.0; 4]);
        }
    }

    /// Particles whose strain lags behind no more.
    fn carry(&self, before: &ParticleState, steps: &[Step]) -> Result<ParticleState> {
        let order = Order::of(before);
        let pieces = pieces(before, &order.numbers, |_| true);
        let one = |piece: &Piece<'_>| self.deform(piece, &steps[piece.list.level as usize]);
        let made: Vec<Deformed> = pieces.par_iter().map(one).collect::<Result<_>>()?;
        let mut carried = before.clone();
        for (piece, Deformed { after: [strain, state], .. }) in pieces.iter().zip(made) {
            let list = piece.list.level as usize * self.materials.len() + piece.list.material as usize;
            let list = &mut carried.lists[list];
            let planes = list.strain.iter_mut().zip(strain).chain(list.state.iter_mut().zip(state));
            planes.for_each(|(to, from)| to[piece.first..][..piece.count].copy_from_slice(&from.0[..piece.count]));
        }
        Ok(carried)
    }

    /// The adjoint of that, and no more.
    fn carry_back(&self, before: &ParticleState, steps: &[Step], gradient: &mut Gradient) -> Result<()> {
        let order = Order::of(before);
        let pieces = pieces(before, &order.numbers, |_| true);
        let one = |piece: &Piece<'_>| {
            let (particles, numbers) = (&gradient.particles, || piece.number.iter().map(|number| *number as usize));
            let mut given = Given {
                position: numbers().map(|number| particles.position[number]).collect(),
                velocity: numbers().map(|number| particles.velocity[number]).collect(),
                affine: numbers().map(|number| particles.affine[number]).collect(),
                strain: Vec::new(),
                state: Vec::new(),
                parameters: Vec::new(),
                gravity: [0.0; 3],
            };
            let step = &steps[piece.list.level as usize];
            let made = self.deform(piece, step)?;
            self.deform_back(piece, &made, step, gradient, [Plane::default(); 6], &mut given)?;
            Ok(given)
        };
        let given: Vec<Given> = pieces.par_iter().map(one).collect::<Result<_>>()?;
        take_in(gradient, &order, &pieces, &given);
        Ok(())
    }

    fn back(
        &self,
        (particles, sort): (&ParticleState, Option<&SortPhase>),
        couplings: &mut [Box<dyn Coupling>],
        place: &Levels<'_>,
        steps: &[Step],
        gradient: &mut Gradient,
    ) -> Result<()> {
        let (order, levels) = (Order::of(particles), self.grids.len());
        let of_level = |l: usize| pieces(particles, &order.numbers, |list| list.level as usize == l);
        let pieces: Vec<Vec<Piece<'_>>> = (0..levels).map(of_level).collect();
        let groups: Vec<Vec<Group<'_>>> =
            pieces.iter().zip(steps).map(|(pieces, step)| self.give_level(pieces, step)).collect::<Result<_>>()?;
        let mut sums: Vec<Nodes> = (0..levels).map(|_| Nodes::default()).collect();
        for (sums, groups) in sums.iter_mut().zip(&groups) {
            groups.iter().for_each(|group| sums.add(&group.nodes.keys, &group.nodes.values));
        }
        let runs = if levels > 1 { runs_of(particles, sort, place.sorted) } else { Vec::new() };
        let mut grids: Vec<OnLevel> = Vec::with_capacity(levels);
        for l in 0..levels {
            let rim = sums[l..].split_first_mut().and_then(|(sums, coarser)| {
                Some(self.hand_over(l, &place.regions, [sums, coarser.first_mut()?], (particles, &runs)))
            });
            let pairs = Self::separate(&self.grids[l].bounds, &mut sums[l]);
            grids.push(OnLevel { rim, pairs });
        }
        let least = sort.map_or_else(
            || particles.lists.iter().flat_map(|list| &list.mass).fold(f64::INFINITY, |a, b| a.min(*b)) * LEAST_MASS,
            |sort| sort.measured.least_mass,
        );
        // The last number says whether a node moves at all.
        let moves = |[x, y, z, m]: [f64; 4]| if m > least { [x / m, y / m, z / m, 1.0] } else { [0.0; 4] };
        let mut velocities: Vec<Nodes> = sums.iter().map(|sums| sums.map(moves)).collect();
        self.hold(&mut velocities, place.live);
        contact::begin(couplings, &steps[0])?;
        let mut met = Vec::with_capacity(levels);
        for (l, (sums, velocities)) in sums.iter().zip(&mut velocities).enumerate() {
            let around = Around { adjoint: self, level: l, particles, numbers: &order.numbers, sums, least };
            met.push(Met::forwards(&around, couplings, &steps[l], velocities)?);
        }
        for l in (0..levels).rev() {
            for pair in grids[l].pairs.iter().rev() {
                let separation = &self.grids[l].bounds.separations[pair.separation].0;
                let (image, _) = separation.unfold(&velocities[l].get(pair.node), pair.presses, 0.0);
                *velocities[l].get_mut(pair.image) = [image[0], image[1], image[2], 0.0];
            }
            if let ([.., finer], [here, ..]) = velocities.split_at_mut(l)
                && let Some(rim) = &grids[l - 1].rim
            {
                rim.prolong(finer, here);
            }
        }

        let (mut owed, mut positions) = (Vec::with_capacity(levels), Vec::with_capacity(levels));
        for ((groups, step), velocities) in groups.iter().zip(steps).zip(&velocities) {
            let read: Vec<(Values, Vec<Vec<Vec3>>)> =
                groups.par_iter().map(|group| self.read_back(group, velocities, step.dt, gradient)).collect();
            let (mut sum, mut of_groups) = (velocities.map(|_| [0.0; 4]), Vec::with_capacity(read.len()));
            for (group, (values, positions)) in groups.iter().zip(read) {
                sum.add(&group.nodes.keys, &values);
                of_groups.push(positions);
            }
            owed.push(sum);
            positions.push(of_groups);
        }
        for (l, OnLevel { rim, pairs }) in grids.iter().enumerate() {
            Self::images_back(&self.grids[l].bounds, pairs, &mut owed[l]);
            if let ([.., here], [coarser, ..]) = owed.split_at_mut(l + 1)
                && let Some(rim) = rim
            {
                rim.prolong_back(here, coarser);
            }
        }
        let near = contact::backwards(&met, couplings, &steps[0], &mut owed, gradient)?;
        let mut of_affine = Vec::new();
        for (l, OnLevel { rim, pairs }) in grids.iter().enumerate().rev() {
            Self::sums_back(&self.grids[l].bounds, [&velocities[l], &sums[l]], pairs, &mut owed[l]);
            if let ([.., here], [coarser, ..]) = owed.split_at_mut(l + 1)
                && let Some(rim) = rim
            {
                of_affine.extend(self.hand_over_back(l, rim, [here, coarser], (particles, &runs)));
            }
        }
        let mut given = Vec::with_capacity(pieces.iter().map(Vec::len).sum());
        for ((groups, positions), (owed, step)) in groups.into_iter().zip(positions).zip(owed.iter().zip(steps)) {
            // What a group has kept goes with it.
            let one = |(group, positions): (Group<'_>, _)| self.give_back(&group, owed, step, gradient, positions);
            let of_groups: Vec<Vec<Given>> = groups.into_par_iter().zip(positions).map(one).collect::<Result<_>>()?;
            given.extend(of_groups.into_iter().flatten());
        }
        take_in(gradient, &order, &pieces.concat(), &given);
        for (list, i, back) in of_affine {
            let affine = &mut gradient.particles.affine[order.numbers[list][i] as usize];
            affine.iter_mut().zip(back).for_each(|(sum, own)| *sum += own);
        }
        self.ground.take_in(&near, gradient);
        Ok(())
    }
}

/// Where levels are in a step.
struct Levels<'a> {
    regions: Regions,
    /// Tiles within reach, if not all are, and which levels' particles have just been sorted.
    live: &'a Tiles,
    sorted: &'a [bool],
}

/// What a level's nodes go through besides.
struct OnLevel {
    /// Where they end at a coarser level.
    rim: Option<Rim>,
    pairs: Vec<Pair>,
}

/// How numbers that a material has change with each of its differentiable parameters, by differences to the fourth order: of so many steps, the first so long relative to the parameter and each
/// half the one before, the two are taken that agree best. Where there are no numbers, a step is passed over.
fn parameter_slopes<const N: usize>(
    planned: &PlannedMaterial,
    (longest, steps): (f64, i32),
    numbers: impl Fn(&[f64]) -> Result<Option<[f64; N]>>,
) -> Result<Vec<[f64; N]>> {
    let mut slopes = vec![[0.0; N]; planned.parameters.len()];
    for (i, slope) in slopes.iter_mut().enumerate() {
        if planned.material.parameters[i].flags & abi::BARCHAN_PARAM_DIFFERENTIABLE == 0 {
            continue;
        }
        let value = planned.parameters[i];
        let scale = if value == 0.0 { 1.0 } else { value.abs() };
        let at = |by: f64| {
            let mut parameters = planned.parameters.clone();
            parameters[i] = value + by;
            numbers(&parameters)
        };
        let difference = |k: i32| -> Result<Option<[f64; N]>> {
            let step = longest * scale * 0.5f64.powi(k);
            let (Some(a), Some(b), Some(c), Some(d)) = (at(step)?, at(-step)?, at(2.0 * step)?, at(-2.0 * step)?)
            else {
                return Ok(None);
            };
            Ok(Some(std::array::from_fn(|n| (8.0 * (a[n] - b[n]) - (c[n] - d[n])) / (12.0 * step))))
        };
        let found: Vec<[f64; N]> = (0..steps).filter_map(|k| difference(k).transpose()).collect::<Result<_>>()?;
        let apart = |pair: &[[f64; N]]| (0..N).map(|n| (pair[0][n] - pair[1][n]).abs()).sum::<f64>();
        if let Some([_, best]) = found.windows(2).min_by(|a, b| apart(a).total_cmp(&apart(b))) {
            *slope = *best;
        }
    }
    Ok(slopes)
}

/// A particle's values of up to nine planes.
fn values(planes: &[Plane<f64, BATCH>], i: usize) -> [f64; 9] {
    let mut values = [0.0; 9];
    values.iter_mut().zip(planes).for_each(|(value, plane)| *value = plane.0[i]);
    values
}

/// The particles of some lists, in pieces.
fn pieces<'a>(
    particles: &'a ParticleState,
    numbers: &'a [Vec<u32>],
    wanted: impl Fn(&ParticleList) -> bool,
) -> Vec<Piece<'a>> {
    let of_list = |(of, (list, numbers)): (usize, (&'a ParticleList, &'a Vec<u32>))| {
        let each = numbers.chunks(BATCH).enumerate();
        each.map(move |(k, number)| Piece { list, of, first: k * BATCH, count: number.len(), number })
    };
    let lists = particles.lists.iter().zip(numbers).enumerate();
    lists.filter(|(_, (list, _))| wanted(list)).flat_map(of_list).collect()
}

impl Piece<'_> {
    /// A plane of its values, the last one's again behind its end.
    fn plane(&self, values: &[f64]) -> Plane<f64, BATCH> {
        Plane(std::array::from_fn(|i| values[self.first + i.min(self.count - 1)]))
    }

    /// The number that a law names; any number at all, by a law that is wrong.
    fn id(&self, i: u64) -> u64 {
        let within = usize::try_from(i).ok().filter(|i| *i < self.count);
        within.map_or(u64::MAX, |i| self.list.id[self.first + i])
    }
}

impl Order {
    fn of(particles: &ParticleState) -> Self {
        let mut numbers: Vec<Vec<u32>> = particles.lists.iter().map(|list| vec![0; list.len()]).collect();
        let lists = particles.lists.iter().zip(0..);
        let mut all: Vec<(u64, u32, u32)> =
            lists.flat_map(|(list, l)| list.id.iter().zip(0..).map(move |(id, i)| (*id, l, i))).collect();
        all.par_sort_unstable();
        let places: Vec<(u32, u32)> = all.into_iter().map(|(_, l, i)| (l, i)).collect();
        for (number, (l, i)) in places.iter().enumerate() {
            numbers[*l as usize][*i as usize] = number as u32;
        }
        Self { numbers, places }
    }
}

impl Adjoint for CpuAdjoint {
    fn step_back(
        &mut self,
        before: &ParticleState,
        couplings: &mut [Box<dyn Coupling>],
        time: f64,
        dt: f64,
        adapted: Option<&Adapted>,
        gradient: &mut Gradient,
    ) -> Result<()> {
        let (gravity, grown) = (self.scene.gravity_at(time), self.scene.grown_gravity(time));
        let of_level = |l: usize| {
            let own = before.lists.iter().filter(|list| list.level as usize == l);
            let rates = own.flat_map(|list| &list.affine).map(|c| c.iter().map(|x| x * x).sum::<f64>());
            let fastest = rates.fold(0.0, f64::max).sqrt();
            let parts = (fastest * before.strain_dt / MAX_DEFORMATION).ceil().max(1.0) as u32;
            Step { time, dt, gravity, grown, strain_dt: before.strain_dt, parts }
        };
        let mut steps: Vec<Step> = (0..self.grids.len()).map(of_level).collect();
        let this = &*self;
        if dt == 0.0 {
            return this.pool.install(|| this.carry_back(before, &steps, gradient));
        }
        let (mut regions, none) = (this.regions.clone(), Tiles::new());
        let phase = before.levels.as_ref();
        if let Some(boxes) = adapted.map(|adapted| &adapted.boxes).or(phase.map(|phase| &phase.boxes)) {
            regions.restore(boxes.clone());
        }
        let place = Levels {
            regions,
            live: adapted.map(|adapted| &adapted.live).or(phase.map(|phase| &phase.live)).unwrap_or(&none),
            sorted: adapted.map_or(&[], |adapted| &adapted.sorted),
        };
        let Some(adapted) = adapted.filter(|adapted| !adapted.changes.is_empty()) else {
            let particles = (before, before.sort.as_ref());
            return this.pool.install(|| this.back(particles, couplings, &place, &steps, gradient));
        };
        // Who has brought strain up to date before levels changed did so before anything else.
        let carrying = (adapted.carried && before.strain_dt > 0.0).then(|| steps.clone());
        if carrying.is_some() {
            steps.iter_mut().for_each(|step| (step.strain_dt, step.parts) = (0.0, 1));
        }
        this.pool.install(|| {
            let carried = carrying.as_ref().map(|steps| this.carry(before, steps)).transpose()?;
            let replayed = this.replay.forwards(carried.as_ref().unwrap_or(before), adapted)?;
            let particles = (&replayed.after, before.sort.as_ref());
            this.back(particles, couplings, &place, &steps, gradient)?;
            this.replay.backwards(before, &replayed, &mut gradient.particles);
            carrying.map_or(Ok(()), |steps| this.carry_back(before, &steps, gradient))
        })
    }

    fn adapted(&self, before: &ParticleState, adapted: &Adapted) -> Result<ParticleState> {
        Ok(self.pool.install(|| self.replay.forwards(before, adapted))?.after)
    }
}
