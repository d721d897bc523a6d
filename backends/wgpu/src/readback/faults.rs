//! Errors of a step, in words that a user can act upon.

use crate::device::status::{Halt, Status, WHO};
use crate::readback::{Laid, Readback, account};
use barchan_core::plan::loaded;
use barchan_core::{Error, ParticleList, Vec3};

impl Readback<'_> {
    /// The world of a particle that a halt names.
    pub(crate) fn world_of(&self, status: &Status) -> Option<usize> {
        let who = status.words[WHO] as usize;
        self.worlds.iter().position(|world| world.particles().contains(&who))
    }

    pub(crate) fn left_world(&self, world: usize, status: &Status) -> Error {
        let (step, scene) = (self.worlds[world].steps, &self.worlds[world].scene.world);
        match self.lists(world).map(|lists| self.find(world, &lists, status.words[WHO] as usize)) {
            Ok(Some((particle, position, _))) => Error::left_world(scene, step, particle, position),
            Ok(None) => Error::left_world(scene, step, u64::MAX, [f64::NAN; 3]),
            Err(error) => error,
        }
    }

    /// Id, position and material of the particle in a slot.
    pub(crate) fn find(
        &self,
        world: usize,
        (lists, laid): &(Vec<ParticleList>, Vec<Laid>),
        slot: usize,
    ) -> Option<(u64, Vec3, usize)> {
        let world = &self.worlds[world];
        let l = world.levels.iter().position(|level| level.particles.contains(&slot))?;
        let (slot, (homes, planes)) = (slot - world.levels[l].particles.start, &laid[l]);
        let law = planes.law(slot);
        // Lists go by places, not by slots.
        let own = homes.places().into_iter().map(|(q, _)| q).filter(|&q| planes.law(q) == law);
        let (i, list) = own.zip(0..).find(|(q, _)| *q == slot).zip(lists.get(l * world.materials.len() + law))?;
        Some((*list.id.get(i.1)?, list.position(i.1), law))
    }

    /// Turns a halt that no shorter step mends into what a user can act upon.
    pub(crate) fn explain(&self, w: usize, status: &Status, speed: f64, time: f64) -> Error {
        if let Some(error) = self.find_non_finite(w, time) {
            return error;
        }
        let who = status.words[WHO] as usize;
        match status.halt() {
            Some(Halt::LeftWorld) => self.left_world(w, status),
            Some(Halt::Strayed) => match self.lists(w).map(|l| self.find(w, &l, who)) {
                Ok(Some((particle, _, law))) => self.non_finite(w, "cell", (particle, law), f64::NAN, 1, time),
                Ok(None) => self.non_finite(w, "cell", (u64::MAX, 0), f64::NAN, 1, time),
                Err(error) => error,
            },
            _ => Error::NonFinite {
                step: self.worlds[w].steps,
                time,
                field: "node velocity",
                particle: 0,
                list: loaded(&self.worlds[w].materials),
                value: speed,
                count: 0,
            },
        }
    }

    pub(crate) fn non_finite(
        &self,
        w: usize,
        field: &'static str,
        (particle, law): (u64, usize),
        value: f64,
        count: u64,
        time: f64,
    ) -> Error {
        let world = &self.worlds[w];
        let list = world.materials[law % world.materials.len()].label();
        Error::NonFinite { step: world.steps, time, field, particle, list, value, count }
    }

    /// The particle of least id with a NaN or infinite value.
    pub(crate) fn find_non_finite(&self, w: usize, time: f64) -> Option<Error> {
        match self.lists(w) {
            Ok((lists, ..)) => {
                let world = &self.worlds[w];
                account::find_non_finite(&lists).error(world.steps, time, &world.materials)
            }
            Err(error) => Some(error),
        }
    }
}
