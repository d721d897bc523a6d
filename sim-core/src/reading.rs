//! Parts of particles for those who look: of a region, the values asked for, in f32.

use crate::{Aabb, ParticleList, Vec3};

/// What is read of particles besides where they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fields {
    /// Positions in f64 from the world's origin, instead of in f32 from [`Reading::origin`].
    pub exact: bool,
    /// Velocity.
    pub velocity: bool,
    /// APIC affine matrix.
    pub affine: bool,
    /// Mass.
    pub mass: bool,
    /// Rest volume.
    pub volume0: bool,
    /// Number of the particle.
    pub id: bool,
    /// Body that it was seeded for.
    pub body: bool,
    /// Material.
    pub material: bool,
    /// Level.
    pub level: bool,
}

/// What was read of some particles: an array for each value, all in the same order, which is the engine's own. Arrays that nobody asked for are empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reading {
    /// What was asked for.
    pub fields: Fields,
    /// What positions in f32 are counted from [m]: the least corner of the region, or of the world. 1 m from it they are exact to 0.06 µm.
    pub origin: Vec3,
    /// Position from the origin [m], n × 3; empty if they were asked for in f64.
    pub position: Vec<[f32; 3]>,
    /// Position [m], n × 3, if asked for in f64.
    pub exact: Vec<Vec3>,
    /// Velocity [m/s], n × 3.
    pub velocity: Vec<[f32; 3]>,
    /// APIC affine matrix C, row-major [1/s], n × 9.
    pub affine: Vec<[f32; 9]>,
    /// Mass [kg], n.
    pub mass: Vec<f32>,
    /// Rest volume [m³], n.
    pub volume0: Vec<f32>,
    /// Unique number in the world, n.
    pub id: Vec<u64>,
    /// Index of the body in the scene, n.
    pub body: Vec<u16>,
    /// Index into the plan's materials, n.
    pub material: Vec<u16>,
    /// Level, 0 is finest, n.
    pub level: Vec<u8>,
}

impl Reading {
    /// Nothing read yet.
    pub fn new(fields: Fields, origin: Vec3) -> Self {
        Self { fields, origin, ..Self::default() }
    }

    /// Number of particles.
    pub fn len(&self) -> usize {
        self.position.len().max(self.exact.len())
    }
    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// World position of particle `i` [m].
    ///
    /// # Panics
    /// If there is no such particle.
    pub fn at(&self, i: usize) -> Vec3 {
        if self.fields.exact {
            self.exact[i]
        } else {
            std::array::from_fn(|d| self.origin[d] + f64::from(self.position[i][d]))
        }
    }

    /// Adds where a particle is [m]; the values asked for follow, each into its array.
    pub fn add_position(&mut self, position: Vec3) {
        if self.fields.exact {
            self.exact.push(position);
        } else {
            self.position.push(std::array::from_fn(|d| (position[d] - self.origin[d]) as f32));
        }
    }

    /// Adds those of a list that lie in the region.
    pub fn add_list(&mut self, list: &ParticleList, region: Option<&Aabb>) {
        for i in 0..list.len() {
            let position = list.position(i);
            if region.is_some_and(|region| !region.contains(position)) {
                continue;
            }
            self.add_position(position);
            let Fields { exact: _, velocity, affine, mass, volume0, id, body, material, level } = self.fields;
            self.velocity.extend(velocity.then(|| list.velocity[i].map(|x| x as f32)));
            self.affine.extend(affine.then(|| list.affine[i].map(|x| x as f32)));
            self.mass.extend(mass.then(|| list.mass[i] as f32));
            self.volume0.extend(volume0.then(|| list.volume0[i] as f32));
            self.id.extend(id.then(|| list.id[i]));
            self.body.extend(body.then(|| list.body[i]));
            self.material.extend(material.then_some(list.material as u16));
            self.level.extend(level.then_some(list.level as u8));
        }
    }

    /// Adds what another reading of the same kind has read.
    pub fn append(&mut self, mut other: Self) {
        self.position.append(&mut other.position);
        self.exact.append(&mut other.exact);
        self.velocity.append(&mut other.velocity);
        self.affine.append(&mut other.affine);
        self.mass.append(&mut other.mass);
        self.volume0.append(&mut other.volume0);
        self.id.append(&mut other.id);
        self.body.append(&mut other.body);
        self.material.append(&mut other.material);
        self.level.append(&mut other.level);
    }
}
