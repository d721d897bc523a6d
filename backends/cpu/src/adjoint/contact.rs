//! Bodies in a step backwards: they meet the nodes and particles near them as they did, and what a loss owes goes back through that.

use super::nodes::Nodes;
use super::{ASKED, CpuAdjoint, LevelGrid, Step, parameter_slopes};
use barchan_core::account::BATCH;
use barchan_core::batch::{Matter, Motion, Owed, Plane};
use barchan_core::contact::adjoint::{BodyInStep, NearCotangents};
use barchan_core::contact::{Contact, Twist};
use barchan_core::coupling::{BodiesOwed, BodiesTold, Moved, begin_step};
use barchan_core::gradient::{Cotangents, Gradient};
use barchan_core::material::ErrorBuffer;
use barchan_core::plan::PlannedMaterial;
use barchan_core::{Aabb, Coupling, Error, NearParticle, NodeBatch, ParticleState, Plan, Result, Vec3, Wrench};
use barchan_grid::block::{self, CELLS};
use barchan_grid::near::{boxes_near_block, gather_block, is_near_block};
use rayon::prelude::*;
use std::collections::HashMap;
use std::ops::Range;

/// How stiff bodies find the ground.
pub(super) struct Ground {
    /// Of each material [Pa].
    moduli: Vec<f64>,
    /// And how that changes with each of its parameters.
    slopes: Vec<Vec<f64>>,
}

impl Ground {
    pub(super) fn new(plan: &Plan) -> Result<Self> {
        if plan.couplings.is_empty() {
            return Ok(Self { moduli: Vec::new(), slopes: Vec::new() });
        }
        let moduli =
            plan.materials.iter().map(|planned| planned.contact_modulus(&plan.scene)).collect::<Result<_>>()?;
        let slopes = plan.materials.iter().map(modulus_slopes).collect::<Result<_>>()?;
        Ok(Self { moduli, slopes })
    }

    /// What is owed to particles that pressed on bodies, and by their stiffness to parameters.
    pub(super) fn take_in(&self, near: &[Pressed], gradient: &mut Gradient) {
        for Pressed { number, material, position, modulus } in near {
            (0..3).for_each(|d| gradient.particles.position[*number][d] += position[d]);
            let sums = gradient.parameters[*material].iter_mut().zip(&self.slopes[*material]);
            sums.for_each(|(sum, slope)| *sum += modulus * slope);
        }
    }
}

/// How the stiffness that bodies find changes with each differentiable parameter.
fn modulus_slopes(planned: &PlannedMaterial) -> Result<Vec<f64>> {
    // Of other laws it is what the scene's step bears.
    if planned.material.table.tangent_moduli_f32.is_none() {
        return Ok(vec![0.0; planned.parameters.len()]);
    }
    let modulus = |parameters: &[f64]| p_wave(planned, parameters).map(|modulus| Some([modulus]));
    Ok(parameter_slopes(planned, (1e-3, 12), modulus)?.into_iter().map(|[slope]| slope).collect())
}

/// λ + 2μ with these parameters, of the undeformed material squeezed by a millionth: without stress sand stands at the tip of its cone, where a little more may yield [Pa].
fn p_wave(planned: &PlannedMaterial, parameters: &[f64]) -> Result<f64> {
    const SQUEEZED: f64 = 1.0 - 1e-6;
    let law = &planned.material;
    let planes = law.strain_identity().len();
    // Of F, or of b, which is its square.
    let (stretch, per_stretch) = if planes == 9 { (SQUEEZED, 1.0) } else { (SQUEEZED * SQUEEZED, 2.0 * SQUEEZED) };
    let strain: Vec<_> = law.strain_identity().iter().map(|entry| Plane([entry * stretch; BATCH])).collect();
    let state: Vec<_> = law.states.iter().map(|state| Plane([state.initial; BATCH])).collect();
    let mut kirchhoff = [Plane::default(); 6];
    kirchhoff[0].0[0] = 1.0;
    let none = |count: usize| vec![Plane::<f64, BATCH>::default(); count];
    let (of_strain, of_state) = (none(planes), none(state.len()));
    let (mut trial, mut vel_grad, mut state_before) = (none(planes), [Plane::default(); 9], none(state.len()));
    let mut of_parameters = vec![0.0; parameters.len()];
    let owed = Owed {
        strain: &of_strain,
        kirchhoff: &kirchhoff,
        state: &of_state,
        trial: &mut trial,
        vel_grad: &mut vel_grad,
        state_before: &mut state_before,
        parameters: &mut of_parameters,
    };
    let still = [Plane::default(); 9];
    let mut error = ErrorBuffer::default();
    let matter = Matter { count: 1, parameters, strain: &strain, state: &state };
    let status = law.pull_back(&matter, Motion { dt: 1e-6, vel_grad: &still }, owed, &mut error).expect(ASKED);
    error.check(status, law, "update_adj_f64", |_| u64::MAX)?;
    Ok(trial[0].0[0] * per_stretch)
}

/// What goes back to a particle by what it pressed with.
pub(super) struct Pressed {
    number: usize,
    material: usize,
    position: Vec3,
    modulus: f64,
}

/// Bodies that have met nodes.
pub(super) struct Met {
    contact: Contact,
    /// The nodes and particles near bodies, as they were before contact; none where no body was near any.
    nodes: NodeBatch,
    /// Their numbers among all nodes, and each particle's among all, with its material.
    of_nodes: Vec<usize>,
    of_particles: Vec<(usize, usize)>,
}

/// The ground that bodies meet.
pub(super) struct Around<'a> {
    pub(super) adjoint: &'a CpuAdjoint,
    pub(super) level: usize,
    /// The particles, and the number of each among all.
    pub(super) particles: &'a ParticleState,
    pub(super) numbers: &'a [Vec<u32>],
    /// What nodes hold, and what they hold at least if they are to move [kg].
    pub(super) sums: &'a Nodes,
    pub(super) least: f64,
}

/// Bodies begin a step.
pub(super) fn begin(couplings: &mut [Box<dyn Coupling>], step: &Step) -> Result<()> {
    // A device may have moved them.
    couplings.iter_mut().for_each(|coupling| coupling.move_on_device(Moved::ByCoupling));
    begin_step(couplings, step.time, step.dt)
}

impl Met {
    /// Bodies meet the ground, and change the velocities of its nodes.
    pub(super) fn forwards(
        around: &Around<'_>,
        couplings: &mut [Box<dyn Coupling>],
        step: &Step,
        velocities: &mut Nodes,
    ) -> Result<Self> {
        let mut met = Self {
            contact: Contact::default(),
            nodes: NodeBatch::default(),
            of_nodes: Vec::new(),
            of_particles: Vec::new(),
        };
        let Self { contact, nodes, of_nodes, of_particles } = &mut met;
        contact.act(couplings, [step.dt, around.grid().h], |[near_nodes, near_particles], act| {
            *of_nodes = around.gather(near_nodes, velocities, nodes);
            if nodes.is_empty() {
                return Ok(());
            }
            *of_particles = around.gather_particles(near_particles, of_nodes, nodes);
            let before = nodes.velocity.clone();
            act(nodes)?;
            let after = std::mem::replace(&mut nodes.velocity, before);
            for (node, [x, y, z]) in of_nodes.iter().zip(after) {
                let velocity = velocities.get_mut(*node);
                *velocity = [x, y, z, velocity[3]];
            }
            Ok(())
        })?;
        Ok(met)
    }

    /// What is owed to nodes of this level goes back through what bodies did to them: `owed` is that to velocities behind contact, and comes back as that before it, with what is owed to
    /// masses. `found` is what is owed to each body, and to its twist behind contact at first.
    fn backwards(
        &self,
        couplings: &[Box<dyn Coupling>],
        dt: f64,
        (impulses, found): (&[Wrench], &mut [BodyInStep]),
        owed: &mut Nodes,
    ) -> Result<Vec<Pressed>> {
        if self.nodes.is_empty() {
            return Ok(Vec::new());
        }
        let velocity = |node: &usize| {
            let [x, y, z, _] = owed.get(*node);
            [x, y, z]
        };
        let mut near = NearCotangents::of(self.of_nodes.iter().map(velocity).collect(), &self.nodes);
        let twists: Vec<Twist> = found.iter().map(|body| body.twist).collect();
        let of_level = self.contact.meet_back(couplings, dt, &self.nodes, (impulses, &twists), &mut near)?;
        for (body, of_level) in found.iter_mut().zip(of_level) {
            body.position += of_level.position;
            body.rotation += of_level.rotation;
            body.twist = of_level.twist;
            body.friction += of_level.friction;
        }
        for ((node, [x, y, z]), mass) in self.of_nodes.iter().zip(near.velocity).zip(near.mass) {
            *owed.get_mut(*node) = [x, y, z, mass];
        }
        let particles = self.of_particles.iter().zip(near.position).zip(near.modulus);
        let pressed =
            particles.map(|((&(number, material), position), modulus)| Pressed { number, material, position, modulus });
        Ok(pressed.filter(|one| one.position != [0.0; 3] || one.modulus != 0.0).collect())
    }
}

/// What is owed to nodes of all levels goes back through what bodies did to them, as [`Met::backwards`] says. What is owed to bodies goes to the gradient, and what is owed to particles that
/// pressed is returned.
pub(super) fn backwards(
    met: &[Met],
    couplings: &mut [Box<dyn Coupling>],
    step: &Step,
    owed: &mut [Nodes],
    gradient: &mut Gradient,
) -> Result<Vec<Pressed>> {
    let Gradient { particles: Cotangents { bodies, robots, .. }, bodies: told, robots: robots_told, gravity, .. } =
        gradient;
    let impulses: Vec<Wrench> = bodies.iter().map(|body| body.impulse).collect();
    let parts = parts(couplings);
    one_level_each(met, couplings, &parts)?;
    let mut found = Vec::with_capacity(impulses.len());
    for (coupling, [own, own_robots]) in couplings.iter_mut().zip(&parts) {
        let mut owed = BodiesOwed { bodies: &mut bodies[own.clone()], robots: &mut robots[own_robots.clone()] };
        let twists = coupling.advance_back(step.dt, &mut owed)?.into_iter();
        found.extend(twists.map(|twist| BodyInStep { twist, ..BodyInStep::default() }));
    }
    let mut pressed = Vec::new();
    for (met, owed) in met.iter().zip(owed).rev() {
        pressed.extend(met.backwards(couplings, step.dt, (&impulses, &mut found), owed)?);
    }
    see_back(couplings, step, &parts, &mut found)?;
    for (coupling, [own, own_robots]) in couplings.iter_mut().zip(&parts) {
        let mut owed = BodiesOwed { bodies: &mut bodies[own.clone()], robots: &mut robots[own_robots.clone()] };
        let mut told = BodiesTold { bodies: &mut told[own.clone()], robots: &mut robots_told[own_robots.clone()] };
        let of_gravity = coupling.begin_back(step.time, step.dt, &found[own.clone()], &mut owed, &mut told)?;
        (0..3).for_each(|d| gravity[d] += step.grown * of_gravity[d]);
    }
    Ok(pressed)
}

/// Holds bodies that answer to one level: on several they find their motion one after the other, and what stood between is not kept.
fn one_level_each(met: &[Met], couplings: &[Box<dyn Coupling>], parts: &[[Range<usize>; 2]]) -> Result<()> {
    if met.len() == 1 {
        return Ok(());
    }
    for (coupling, [own, _]) in couplings.iter().zip(parts) {
        for group in coupling.groups() {
            let bodies = own.start + group.bodies.start..own.start + group.bodies.end;
            let touched = |met: &&Met| bodies.clone().any(|body| met.contact.has_met(body));
            if met.iter().filter(touched).count() > 1 {
                let name = coupling.bodies().get(group.bodies.start).map_or_else(String::new, |body| body.name.clone());
                return Err(Error::Body {
                    path: format!("coupling '{}'", coupling.name()),
                    what: format!("gradients: '{name}' answers the ground of two levels at once, which has no adjoint"),
                    mend: "make levels follow all of it (levels.agents), or levels.half greater".to_owned(),
                });
            }
        }
    }
    Ok(())
}

/// Which bodies and which robots are each coupling's.
fn parts(couplings: &[Box<dyn Coupling>]) -> Vec<[Range<usize>; 2]> {
    let mut ends = [0; 2];
    let counts = couplings.iter().map(|coupling| [coupling.wrenches().len(), coupling.robots().len()]);
    let part = |counts: [usize; 2]| {
        std::array::from_fn(|k| {
            let start = ends[k];
            ends[k] += counts[k];
            start..ends[k]
        })
    };
    counts.map(part).collect()
}

/// What is owed to bodies gets what is owed to them for what others have seen of them.
fn see_back(
    couplings: &[Box<dyn Coupling>],
    step: &Step,
    parts: &[[Range<usize>; 2]],
    found: &mut [BodyInStep],
) -> Result<()> {
    let mut seen = Vec::new();
    for (coupling, [own, _]) in couplings.iter().zip(parts) {
        seen.extend(coupling.see_back(step.time, step.dt, &found[own.clone()])?);
    }
    if seen.is_empty() {
        return Ok(());
    }
    let names: Vec<String> = couplings.iter().flat_map(|one| one.bodies()).map(|body| body.name).collect();
    for (name, by) in seen {
        if let Some(to) = names.iter().position(|one| *one == name).map(|body| &mut found[body]) {
            to.position += by.position;
            to.rotation += by.rotation;
            to.twist = to.twist.plus(1.0, &by.twist);
            to.friction += by.friction;
        }
    }
    Ok(())
}

impl Around<'_> {
    fn grid(&self) -> &LevelGrid {
        &self.adjoint.grids[self.level]
    }

    /// Collects the nodes in the boxes that weigh enough. Returns their numbers.
    fn gather(&self, boxes: &[Aabb], velocities: &Nodes, batch: &mut NodeBatch) -> Vec<usize> {
        let LevelGrid { h, bounds } = self.grid();
        let (h, periods) = (*h, bounds.periods());
        batch.cell_width = h;
        batch.periods = periods.map(|cells| f64::from(cells) * h);
        let mut numbers = Vec::new();
        for (b, key) in self.sums.keys.iter().enumerate() {
            let first = key.map(|k| k * block::SIDE);
            if !is_near_block(boxes, first, h, 0.0, periods) {
                continue;
            }
            let node = |n: usize| {
                let [x, y, z, _] = velocities.get(b * CELLS + n);
                ([x, y, z], self.sums.get(b * CELLS + n)[3])
            };
            gather_block(batch, boxes, first, periods, self.least, node, |n, _, _| numbers.push(b * CELLS + n));
        }
        numbers
    }

    /// Collects the particles in the boxes beside nodes of the batch, whose numbers are given. Returns the number of each, and its material.
    fn gather_particles(&self, boxes: &[Aabb], of_nodes: &[usize], batch: &mut NodeBatch) -> Vec<(usize, usize)> {
        let LevelGrid { h, bounds } = self.grid();
        let (h, periods) = (*h, bounds.periods());
        let in_batch: HashMap<usize, u32> = of_nodes.iter().zip(0..).map(|(node, number)| (*node, number)).collect();
        let Some(around_all) = boxes.iter().copied().reduce(|all, one| all.union(&one)) else { return Vec::new() };
        let mut found = Vec::new();
        let all = self.particles.lists.iter().zip(self.numbers);
        for (list, numbers) in all.filter(|(list, _)| list.level as usize == self.level) {
            // Boxes have images where ends of the world are joined, each block its own.
            let is_near = |seen: &mut HashMap<[i32; 3], Vec<Aabb>>, i: usize| {
                let position = list.position(i);
                if periods == [0; 3] {
                    return around_all.contains(position) && boxes.iter().any(|one| one.contains(position));
                }
                let key = block::of_cell(list.cell[i]);
                let images = || boxes_near_block(boxes, key.map(|k| k * block::SIDE), h, 1.5 * h, periods);
                seen.entry(key).or_insert_with(images).iter().any(|one| one.contains(position))
            };
            let each = (0..list.len()).into_par_iter().with_min_len(BATCH);
            let near = each.map_init(HashMap::new, |seen, i| is_near(seen, i).then_some((i, numbers[i])));
            for (i, number) in near.flatten_iter().collect::<Vec<_>>() {
                let (cell, position) = (list.cell[i], list.position(i));
                let (to_first, place) = NearParticle::between_nodes(list.offset[i]);
                let cube = self.cube(std::array::from_fn(|d| cell[d] + to_first[d]), &in_batch);
                if cube == [NodeBatch::NONE; 8] {
                    continue;
                }
                let material = list.material as usize;
                batch.particles.push(NearParticle {
                    cube: batch.cubes.len() as u32,
                    position,
                    place,
                    volume: list.volume0[i],
                    modulus: self.adjoint.ground.moduli[material],
                });
                batch.cubes.push(cube);
                found.push((number as usize, material));
            }
        }
        found
    }

    /// The numbers in a batch of the eight nodes from one on, z fastest.
    fn cube(&self, first: [i32; 3], in_batch: &HashMap<usize, u32>) -> [u32; 8] {
        let bounds = &self.grid().bounds;
        std::array::from_fn(|n| {
            let corner = [n / 4, n / 2 % 2, n % 2];
            let node: [i32; 3] = std::array::from_fn(|d| {
                let (at, period) = (first[d] + corner[d] as i32, bounds.periods()[d]);
                if period == 0 { at } else { bounds.min[d] + (at - bounds.min[d]).rem_euclid(period) }
            });
            let node = self.sums.find(node).and_then(|node| in_batch.get(&node));
            node.copied().unwrap_or(NodeBatch::NONE)
        })
    }
}
