//! Where a robot's links are and how they move, given its joints; its mass matrix and what its motion asks of it.
//!
//! All vectors are along the world's axes. A floating robot's first six rates are the velocity of its base's centre of mass [m/s] and the base's angular velocity
//! [rad/s]; then, for all robots, come the rates of its drives.

use super::model::{Freedom, RobotModel};
use crate::motion::{Pose, cross_matrix};
use barchan_core::contact::Twist;
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector, Matrix6};

/// A rate's part in the motion of a link: the twist of its centre of mass for each unit of the rate.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// Number of the rate.
    pub rate: usize,
    /// The twist.
    pub twist: Twist,
}

/// Where a link is.
#[derive(Clone, Debug)]
pub struct Place {
    /// Its frame.
    pub frame: Pose,
    /// Its centre of mass [m].
    pub centre: DVec3,
    /// Its inertia about the centre of mass [kg m²].
    pub inertia: DMat3,
    /// Axis of its joint.
    axis: DVec3,
    /// How rates move it: those of the joints between it and the base, and the base's own.
    pub columns: Vec<Column>,
}

impl Place {
    /// Its centre of mass, and its frame's axes.
    pub fn pose(&self) -> Pose {
        Pose { position: self.centre, rotation: self.frame.rotation }
    }

    /// The twist of its centre of mass at these rates.
    pub fn twist(&self, rates: &DVector<f64>) -> Twist {
        self.columns.iter().fold(Twist::default(), |sum, column| sum.plus(rates[column.rate], &column.twist))
    }

    /// The same place as it moves against another link: rates that move both alike have no part in it.
    #[must_use]
    pub fn against(&self, other: &Self) -> Self {
        let arm = self.centre - other.centre;
        let mut columns = self.columns.clone();
        for Column { rate, twist } in &other.columns {
            let back = Twist { linear: -twist.at(arm), angular: -twist.angular };
            match columns.iter_mut().find(|column| column.rate == *rate) {
                Some(column) => column.twist = column.twist.plus(1.0, &back),
                None => columns.push(Column { rate: *rate, twist: back }),
            }
        }
        Self { columns, ..self.clone() }
    }

    /// The same place, so far on [m]: that of an image.
    #[must_use]
    pub fn moved(&self, by: DVec3) -> Self {
        Self { frame: self.frame.moved(by), centre: self.centre + by, ..self.clone() }
    }

    /// The same place where the numbers of rates begin `by` further on.
    #[must_use]
    pub fn shifted(&self, by: usize) -> Self {
        let columns = self.columns.iter().map(|column| Column { rate: column.rate + by, ..*column }).collect();
        Self { columns, ..self.clone() }
    }

    /// Adds to each rate's sum what a force at the centre of mass and a torque come to for it.
    pub fn add_wrench(&self, force: DVec3, torque: DVec3, sums: &mut DVector<f64>) {
        for Column { rate, twist } in &self.columns {
            sums[*rate] += twist.linear.dot(force) + twist.angular.dot(torque);
        }
    }

    /// Adds Jᵀ A J, A a 6 × 6 matrix on twists of its centre of mass.
    pub fn add_matrix(&self, matrix: &[[f64; 6]; 6], sums: &mut DMatrix<f64>) {
        for right in &self.columns {
            let v = six(&right.twist);
            let image = std::array::from_fn::<f64, 6, _>(|i| (0..6).map(|j| matrix[i][j] * v[j]).sum());
            for left in &self.columns {
                let u = six(&left.twist);
                sums[(left.rate, right.rate)] += (0..6).map(|i| u[i] * image[i]).sum::<f64>();
            }
        }
    }

    /// Adds Jᵀ diag(m, I) J.
    fn add_inertia(&self, mass: f64, sums: &mut DMatrix<f64>) {
        for (k, right) in self.columns.iter().enumerate() {
            let (force, torque) = (mass * right.twist.linear, self.inertia * right.twist.angular);
            for left in &self.columns[..=k] {
                let part = left.twist.linear.dot(force) + left.twist.angular.dot(torque);
                sums[(left.rate, right.rate)] += part;
                if left.rate != right.rate {
                    sums[(right.rate, left.rate)] += part;
                }
            }
        }
    }
}

fn six(twist: &Twist) -> [f64; 6] {
    let [v, w] = [twist.linear, twist.angular];
    [v.x, v.y, v.z, w.x, w.y, w.z]
}

/// Number of a robot's rates.
pub fn rates_of(model: &RobotModel, floating: bool) -> usize {
    model.drives.len() + if floating { 6 } else { 0 }
}

/// Where all links are, if the base's frame is at `base` and drives at `positions`.
pub fn places(model: &RobotModel, floating: bool, base: &Pose, positions: &[f64]) -> Vec<Place> {
    let first = if floating { 6 } else { 0 };
    let mut places: Vec<Place> = Vec::with_capacity(model.links.len());
    for link in &model.links {
        let joint = &link.joint;
        let from = link.parent.map_or(*base, |parent| places[parent].frame.then(&joint.origin));
        let position = match joint.freedom {
            Freedom::Fixed => 0.0,
            _ => joint.ratio * positions[joint.drive] + joint.offset,
        };
        let frame = match joint.freedom {
            Freedom::Fixed => from,
            Freedom::Revolute => {
                from.then(&Pose { position: DVec3::ZERO, rotation: glam::DQuat::from_axis_angle(joint.axis, position) })
            }
            Freedom::Prismatic => Pose { position: from.apply(joint.axis * position), ..from },
        };
        let rotation = DMat3::from_quat(frame.rotation);
        let axis = rotation * joint.axis;
        let centre = frame.apply(link.centre);
        let mut columns = match link.parent {
            Some(parent) => {
                let parent = &places[parent];
                let arm = centre - parent.centre;
                let moved = |column: &Column| Column {
                    twist: Twist { linear: column.twist.at(arm), ..column.twist },
                    ..*column
                };
                parent.columns.iter().map(moved).collect()
            }
            None if floating => base_columns(),
            None => Vec::new(),
        };
        let own = match joint.freedom {
            Freedom::Fixed => None,
            Freedom::Revolute => Some(Twist { linear: axis.cross(centre - frame.position), angular: axis }),
            Freedom::Prismatic => Some(Twist { linear: axis, angular: DVec3::ZERO }),
        };
        if let Some(twist) = own {
            let (rate, twist) = (first + joint.drive, Twist::default().plus(joint.ratio, &twist));
            // A joint that mimics one of its own ancestors moves with the same rate.
            match columns.iter_mut().find(|column| column.rate == rate) {
                Some(column) => column.twist = column.twist.plus(1.0, &twist),
                None => columns.push(Column { rate, twist }),
            }
        }
        let inertia = rotation * link.inertia * rotation.transpose();
        places.push(Place { frame, centre, inertia, axis, columns });
    }
    places
}

fn base_columns() -> Vec<Column> {
    let along = |d: usize| Column { rate: d, twist: Twist { linear: DVec3::AXES[d], angular: DVec3::ZERO } };
    let about = |d: usize| Column { rate: 3 + d, twist: Twist { linear: DVec3::ZERO, angular: DVec3::AXES[d] } };
    (0..3).map(along).chain((0..3).map(about)).collect()
}

/// The mass matrix: Σ Jᵀ diag(m, I) J, and armatures on its diagonal.
pub fn mass_matrix(model: &RobotModel, floating: bool, places: &[Place]) -> DMatrix<f64> {
    let n = rates_of(model, floating);
    let mut matrix = DMatrix::zeros(n, n);
    for (link, place) in model.links.iter().zip(places) {
        if link.mass > 0.0 {
            place.add_inertia(link.mass, &mut matrix);
        }
    }
    for (d, drive) in model.drives.iter().enumerate() {
        let rate = n - model.drives.len() + d;
        matrix[(rate, rate)] += drive.armature;
    }
    matrix
}

/// What motion at these rates asks of each rate without any of them changing: Σ Jᵀ (m a, I α + ω × I ω), with a and α the links' accelerations then.
pub fn bias(model: &RobotModel, floating: bool, places: &[Place], rates: &DVector<f64>) -> DVector<f64> {
    let first = if floating { 6 } else { 0 };
    let mut sums = DVector::zeros(rates.len());
    // Twist, and acceleration of the centre of mass and about it.
    let mut motions: Vec<(Twist, Twist)> = Vec::with_capacity(places.len());
    for (link, place) in model.links.iter().zip(places) {
        let twist = place.twist(rates);
        let acceleration = match link.parent {
            None => Twist::default(),
            Some(parent) => {
                let (before, of_parent) = &motions[parent];
                let rate = match link.joint.freedom {
                    Freedom::Fixed => 0.0,
                    _ => link.joint.ratio * rates[first + link.joint.drive],
                };
                let moves = rate * place.axis;
                // The place of the parent at which the joint's origin is now.
                let arm = place.frame.position - places[parent].centre;
                let (spin, own) = (before.angular, place.centre - place.frame.position);
                let mut angular = of_parent.angular;
                let mut linear = of_parent.linear + of_parent.angular.cross(arm) + spin.cross(spin.cross(arm));
                match link.joint.freedom {
                    Freedom::Fixed => {}
                    Freedom::Revolute => angular += spin.cross(moves),
                    Freedom::Prismatic => linear += 2.0 * spin.cross(moves),
                }
                linear += angular.cross(own) + twist.angular.cross(twist.angular.cross(own));
                Twist { linear, angular }
            }
        };
        if link.mass > 0.0 {
            let spin = place.inertia * twist.angular;
            let torque = place.inertia * acceleration.angular + twist.angular.cross(spin);
            place.add_wrench(link.mass * acceleration.linear, torque, &mut sums);
        }
        motions.push((twist, acceleration));
    }
    sums
}

/// What a uniform acceleration g gives each rate: Σ Jᵀ m g.
pub fn gravity(model: &RobotModel, places: &[Place], g: DVec3, rates: usize) -> DVector<f64> {
    let mut sums = DVector::zeros(rates);
    for (link, place) in model.links.iter().zip(places) {
        place.add_wrench(link.mass * g, DVec3::ZERO, &mut sums);
    }
    sums
}

/// The mass matrix of a floating base alone: of all links, if no joint moved.
pub fn inertia_of_all(model: &RobotModel, places: &[Place]) -> Matrix6<f64> {
    let mut sums = Matrix6::zeros();
    let base = places[0].centre;
    for (link, place) in model.links.iter().zip(places).filter(|(link, _)| link.mass > 0.0) {
        let arm = place.centre - base;
        // A velocity of the base's centre of mass and a turn about it move the link's by v + w × arm.
        let cross = cross_matrix(arm);
        let about = place.inertia - link.mass * (cross * cross);
        for i in 0..3 {
            sums[(i, i)] += link.mass;
            for j in 0..3 {
                let moment = link.mass * cross.row(i)[j];
                sums[(3 + i, j)] += moment;
                sums[(j, 3 + i)] += moment;
                sums[(3 + i, 3 + j)] += about.row(i)[j];
            }
        }
    }
    sums
}

/// Momentum of all links, linear and angular about `point` [kg m/s, kg m²/s].
pub fn momentum(model: &RobotModel, places: &[Place], rates: &DVector<f64>, point: DVec3) -> [DVec3; 2] {
    let mut sums = [DVec3::ZERO; 2];
    for (link, place) in model.links.iter().zip(places) {
        if link.mass > 0.0 {
            let twist = place.twist(rates);
            let linear = link.mass * twist.linear;
            sums[0] += linear;
            sums[1] += (place.centre - point).cross(linear) + place.inertia * twist.angular;
        }
    }
    sums
}

/// Twice the kinetic energy at some rates, vᵀ M v [J].
pub fn twice_energy(model: &RobotModel, places: &[Place], rates: &DVector<f64>) -> f64 {
    let of_link = |(mass, place): (f64, &Place)| {
        let Twist { linear, angular } = place.twist(rates);
        mass * linear.length_squared() + angular.dot(place.inertia * angular)
    };
    let links = model.links.iter().map(|link| link.mass).zip(places).filter(|(mass, _)| *mass > 0.0);
    let first = rates.len() - model.drives.len();
    let rotors = model.drives.iter().zip(rates.iter().skip(first)).map(|(drive, rate)| drive.armature * rate * rate);
    links.map(of_link).sum::<f64>() + rotors.sum::<f64>()
}
