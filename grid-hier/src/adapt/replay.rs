//! What particles went through as levels moved, once more from the record of it, and backwards.

use super::Parcel;
use super::parcel::{Material, coarsened, moved};
use crate::resample::adjoint::{Cotangent, merge_back, split_back};
use crate::resample::{CHILDREN, Particle, merge, split};
use barchan_core::gradient::{Cotangents, by_number};
use barchan_core::{Adapted, Error, LevelChange, ParticleState, Plan, Result};
use nalgebra::{Matrix3, Vector3};
use std::collections::HashMap;

/// Replays changes of a plan's particles.
pub struct Replay {
    materials: Vec<Material>,
    /// Cell width of each level [m].
    widths: Vec<f64>,
}

/// Particles that went through changes, and what it takes to go back.
pub struct Replayed {
    /// The particles behind them.
    pub after: ParticleState,
    steps: Vec<Step>,
}

/// A split or merge, with the particles before it.
enum Step {
    Split { parent: Box<Particle>, material: usize, children: [u32; CHILDREN], scale: f64 },
    Merge { members: Vec<(u32, Particle)>, material: usize, into: u32 },
}

impl Replay {
    /// For a plan.
    pub fn new(plan: &Plan) -> Self {
        Self { materials: plan.materials.iter().map(Material::of).collect(), widths: plan.cell_widths.clone() }
    }

    /// The particles behind all that they went through.
    ///
    /// # Errors
    /// [`Error::Body`] if there are no such particles, or if some cannot merge.
    pub fn forwards(&self, before: &ParticleState, adapted: &Adapted) -> Result<Replayed> {
        let mut after = ParticleState { kept: None, sort: None, ..before.clone() };
        let (mut out, mut steps) = (self.take_out(&mut after, adapted), Vec::new());
        for change in &adapted.changes {
            match change {
                LevelChange::Split { id, children, scale } => {
                    let (level, parcel) = out.remove(id).ok_or_else(|| unknown(*id))?;
                    let (material, h, origin) = (&self.materials[parcel.list], self.widths[level], parcel.cell);
                    let parent = material.particle(&parcel, origin, h);
                    for (id, child) in children.iter().zip(split(&parent, material.planes(), *scale)) {
                        let like = Parcel { id: *id, ..parcel.clone() };
                        out.insert(*id, (level, material.parcel(&child, origin, h, &like)));
                    }
                    let (parent, children) = (Box::new(parent), *children);
                    steps.push(Step::Split { parent, material: parcel.list, children, scale: *scale });
                }
                LevelChange::Merge { members } => {
                    let found = members.iter().map(|id| out.remove(id).ok_or_else(|| unknown(*id)));
                    let found: Vec<(usize, Parcel)> = found.collect::<Result<_>>()?;
                    // All as seen from the first one's cell, on the coarsest level among them.
                    let level = found.iter().map(|(level, _)| *level).max().unwrap_or_default();
                    let seen = found.into_iter().map(|(from, parcel)| coarsened(parcel, from, level));
                    let seen: Vec<Parcel> = seen.collect();
                    let (Some(first), Some(into)) = (seen.first(), members.iter().min()) else { continue };
                    let (material, h, origin) = (&self.materials[first.list], self.widths[level], first.cell);
                    let particles: Vec<_> = seen.iter().map(|one| material.particle(one, origin, h)).collect();
                    let (one, _) = merge(&particles, material.planes(), f64::INFINITY, f64::INFINITY, false)
                        .map_err(|refusal| refused(*into, refusal.name()))?;
                    let like = Parcel { id: *into, ..first.clone() };
                    out.insert(*into, (level, material.parcel(&one, origin, h, &like)));
                    let members = members.iter().copied().zip(particles).collect();
                    steps.push(Step::Merge { members, material: first.list, into: *into });
                }
                LevelChange::Leave { id } => _ = out.remove(id).ok_or_else(|| unknown(*id))?,
                LevelChange::Come(list) => {
                    let each = (0..list.len()).map(|i| (list.level as usize, Parcel::of(list, i)));
                    out.extend(each.map(|(level, parcel)| (parcel.id, (level, parcel))));
                }
                LevelChange::Move { ids, to } => {
                    for id in ids {
                        let (from, parcel) = out.remove(id).ok_or_else(|| unknown(*id))?;
                        out.insert(*id, (*to as usize, moved(parcel, from, *to as usize)));
                    }
                }
            }
        }
        let mut back: Vec<&(usize, Parcel)> = out.values().collect();
        back.sort_unstable_by_key(|(level, parcel)| (*level, parcel.list, parcel.id));
        for some in back.chunk_by(|a, b| (a.0, a.1.list) == (b.0, b.1.list)) {
            let parcels: Vec<&Parcel> = some.iter().map(|(_, parcel)| parcel).collect();
            let list = some[0].0 * self.materials.len() + some[0].1.list;
            Parcel::add_all(&parcels, &mut after.lists[list]);
        }
        Ok(Replayed { after, steps })
    }

    /// Takes those that anything happens to out of their lists: by their numbers, each with its level.
    fn take_out(&self, particles: &mut ParticleState, adapted: &Adapted) -> HashMap<u32, (usize, Parcel)> {
        let mut out = HashMap::new();
        for change in &adapted.changes {
            match change {
                LevelChange::Split { id, .. } | LevelChange::Leave { id } => {
                    out.insert(*id, None);
                }
                LevelChange::Come(_) => {}
                LevelChange::Merge { members: ids } | LevelChange::Move { ids, .. } => {
                    out.extend(ids.iter().map(|id| (*id, None)));
                }
            }
        }
        for list in &mut particles.lists {
            let mut stays = vec![true; list.len()];
            for (i, stays) in stays.iter_mut().enumerate() {
                let wanted = u32::try_from(list.id[i]).ok().and_then(|id| out.get_mut(&id));
                if let Some(parcel) = wanted {
                    *parcel = Some((list.level as usize, Parcel::of(list, i)));
                    *stays = false;
                }
            }
            if stays.contains(&false) {
                list.keep(&stays);
            }
        }
        out.into_iter().filter_map(|(id, parcel)| Some((id, parcel?))).collect()
    }

    /// From what a loss owes to the particles behind the changes, in the order of their numbers, to what it owes to those before them. What has come is owed
    /// nothing before it was there, and what has left owes nothing behind that.
    pub fn backwards(&self, before: &ParticleState, replayed: &Replayed, owed: &mut Cotangents) {
        let ids: Vec<u64> =
            by_number(&replayed.after).into_iter().map(|(l, i)| replayed.after.lists[l].id[i]).collect();
        let number_of = |id: u64| ids.binary_search(&id).ok();
        let mut changed: HashMap<u32, Cotangent> = HashMap::new();
        let behind = |changed: &mut HashMap<u32, Cotangent>, owed: &Cotangents, id: u32| {
            changed
                .remove(&id)
                .unwrap_or_else(|| number_of(u64::from(id)).map_or_else(Cotangent::default, |n| get(owed, n)))
        };
        for step in replayed.steps.iter().rev() {
            match step {
                Step::Split { parent, material, children, scale } => {
                    let owed = children.map(|id| behind(&mut changed, owed, id));
                    let planes = self.materials[*material].planes();
                    changed.insert(children[0], split_back(parent, planes, *scale, &owed));
                }
                Step::Merge { members, material, into } => {
                    let owed = behind(&mut changed, owed, *into);
                    let (ids, particles): (Vec<u32>, Vec<Particle>) = members.iter().copied().unzip();
                    let backs = merge_back(&particles, self.materials[*material].planes(), &owed);
                    changed.extend(ids.into_iter().zip(backs));
                }
            }
        }
        let order = by_number(before);
        let mut all = Cotangents::zero(order.len());
        for (number, (l, i)) in order.into_iter().enumerate() {
            let id = before.lists[l].id[i];
            match u32::try_from(id).ok().and_then(|id| changed.get(&id)) {
                Some(one) => put(&mut all, number, one),
                None => put(&mut all, number, &number_of(id).map_or_else(Cotangent::default, |n| get(owed, n))),
            }
        }
        all.lags = owed.lags;
        (all.bodies, all.robots) = (std::mem::take(&mut owed.bodies), std::mem::take(&mut owed.robots));
        *owed = all;
    }
}

fn get(owed: &Cotangents, number: usize) -> Cotangent {
    Cotangent {
        x: Vector3::from(owed.position[number]),
        v: Vector3::from(owed.velocity[number]),
        c: Matrix3::from_row_slice(&owed.affine[number]),
        strain: owed.strain[number],
        state: owed.state[number],
    }
}

fn put(owed: &mut Cotangents, number: usize, one: &Cotangent) {
    owed.position[number] = one.x.into();
    owed.velocity[number] = one.v.into();
    owed.affine[number].copy_from_slice(one.c.transpose().as_slice());
    owed.strain[number] = one.strain;
    owed.state[number] = one.state;
}

fn unknown(id: u32) -> Error {
    Error::Body {
        path: "particles".into(),
        what: format!("no particle {id} is there to change its level, split or merge"),
        mend: "hand back particles of the same run".into(),
    }
}

fn refused(id: u32, why: &str) -> Error {
    Error::Body {
        path: "particles".into(),
        what: format!("particle {id} and others merged, and cannot merge again: {why}"),
        mend: "record the steps anew".into(),
    }
}
