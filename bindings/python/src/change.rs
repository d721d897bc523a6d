//! Particles that Python changes.

use crate::given::{Numbers, rows};
use barchan::{Error, GREATEST, ParticleState, Simulation, Vec3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::collections::HashMap;

/// What some particles are to be; what is left out stays.
pub(crate) struct Change {
    id: Vec<u64>,
    position: Option<Vec<Vec3>>,
    velocity: Option<Vec<Vec3>>,
    affine: Option<Vec<[f64; 9]>>,
}

impl Change {
    /// Of the particles with these numbers: positions, velocities and affine matrices, a row each.
    pub(crate) fn new(id: Vec<u64>, [position, velocity, affine]: [Option<Numbers<'_>>; 3]) -> PyResult<Self> {
        if position.is_none() && velocity.is_none() && affine.is_none() {
            return Err(PyValueError::new_err("nothing is to be changed; give position, velocity or affine"));
        }
        let count = id.len();
        Ok(Self {
            position: rows(position.as_ref(), "position", count, "of id")?,
            velocity: rows(velocity.as_ref(), "velocity", count, "of id")?,
            affine: rows(affine.as_ref(), "affine", count, "of id")?,
            id,
        })
    }

    /// Changes them. On an error none is.
    ///
    /// # Errors
    /// [`Error::Body`] for a number that no particle has or that comes twice, for places outside the world, for what is not finite, and for places on several levels.
    pub(crate) fn apply(&self, simulation: &mut Simulation) -> barchan::Result<()> {
        let refuse =
            |what: String, mend: &str| Err(Error::Body { path: "particles".to_owned(), what, mend: mend.to_owned() });
        let world = simulation.plan().scene.world.clone();
        if self.position.is_some() && simulation.plan().cell_widths.len() > 1 {
            return refuse(
                "places can be changed on one level only".to_owned(),
                "leave position out, or use one level",
            );
        }
        let mut state = ParticleState { sort: None, ..simulation.particles() };
        let mut places: HashMap<u64, (usize, usize)> = HashMap::new();
        for (l, list) in state.lists.iter().enumerate() {
            places.extend(list.id.iter().enumerate().map(|(i, id)| (*id, (l, i))));
        }
        for (k, id) in self.id.iter().enumerate() {
            let Some((l, i)) = places.remove(id) else {
                if self.id[..k].contains(id) {
                    return refuse(format!("particle {id} comes twice"), "give each number once");
                }
                let mend = "give numbers that `particles` tells; ground out of reach cannot be changed";
                return refuse(format!("there is no particle {id}"), mend);
            };
            let list = &mut state.lists[l];
            if let Some(position) = &self.position {
                let x = position[k];
                if !(0..3).all(|d| world.min[d] <= x[d] && x[d] < world.max[d]) {
                    return refuse(
                        format!("particle {id} would be at {x:?}, outside the world"),
                        "give a place within it",
                    );
                }
                for d in 0..3 {
                    let cells = x[d] / list.cell_width;
                    list.cell[i][d] = cells.floor() as i32;
                    list.offset[i][d] = (cells - cells.floor()).min(1.0 - f64::EPSILON);
                }
            }
            if let Some(velocity) = &self.velocity {
                list.velocity[i] = velocity[k];
            }
            if let Some(affine) = &self.affine {
                list.affine[i] = affine[k];
            }
            if !list.velocity[i].iter().chain(&list.affine[i]).all(|x| x.abs() <= GREATEST) {
                let what = format!("what is given for particle {id} is not finite, or beyond {GREATEST:.0e}");
                return refuse(what, "give finite numbers that a simulation in f32 can hold");
            }
        }
        simulation.set_particles(state)
    }
}
