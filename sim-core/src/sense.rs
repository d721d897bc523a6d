//! What robots sense besides their joints: how their base moves, what their links touch, and how high the ground around stands.
//!
//! Nothing here is worked out before somebody asks. [`Simulation::robots`] costs no look at the ground; [`Simulation::patches`] and [`Simulation::scan`] read
//! the particles near the robot, and scans ask tools that stay where they are.

use crate::scene::Wall;
use crate::{Aabb, Coupling, Error, Fields, Reading, Result, Simulation, Vec3, Wrench};
use glam::{DQuat, DVec3};
use std::collections::HashMap;

/// How a robot's base moves, and what its links feel. The base's frame is that of its first link, as the URDF has it.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotState {
    /// Name in the scene.
    pub name: String,
    /// Where the base's frame is, world [m].
    pub position: Vec3,
    /// Orientation quaternion of the base's frame (w, x, y, z).
    pub rotation: [f64; 4],
    /// Velocity of the base frame's origin, along the base's axes [m/s].
    pub velocity: Vec3,
    /// Angular velocity along the base's axes [rad/s]: what a gyroscope reads.
    pub angular_velocity: Vec3,
    /// Acceleration of the base frame's origin less gravity, the mean of the last step, along the base's axes [m/s²]: what an accelerometer reads. At rest it
    /// points upwards with 9.81 m/s², in free fall it is zero; so it is before the first step.
    pub specific_force: Vec3,
    /// Where gravity points, a unit vector along the base's axes; zero without gravity.
    pub projected_gravity: Vec3,
    /// Its links with mass or shape, the base first: in the order of [`Simulation::bodies`].
    pub links: Vec<LinkState>,
}

/// How a link moves, and what it feels.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkState {
    /// Name, as in [`Simulation::bodies`].
    pub name: String,
    /// Centre of mass, world [m].
    pub centre: Vec3,
    /// Orientation quaternion (w, x, y, z).
    pub rotation: [f64; 4],
    /// Velocity of the centre of mass, world [m/s].
    pub velocity: Vec3,
    /// Angular velocity, world [rad/s].
    pub angular_velocity: Vec3,
    /// Mean force of the soft ground over the last step [N], and torque about the centre of mass [N m], world frame.
    pub ground: Wrench,
    /// Where it touched what is rigid in the last step: walls, tools, other links.
    pub rigid: Vec<PointForce>,
}

/// A force at a point of contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointForce {
    /// Where, world [m].
    pub position: Vec3,
    /// Mean force on the link over the last step, world frame [N].
    pub force: Vec3,
}

/// Where a link is touched.
#[derive(Clone, Debug, PartialEq)]
pub struct Patch {
    /// How many particles and rigid points touch it.
    pub points: usize,
    /// The box that holds them, world [m].
    pub bounds: Aabb,
    /// The point among them through which the whole force goes, world [m]: where the line of force, about which there is no torque but along itself, comes
    /// nearest to their middle.
    pub centre_of_pressure: Vec3,
}

/// Heights of the ground at points around a robot's base that the scene gives (`robot.scan`), rows along x.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightScan {
    /// Where the points are in the world [m].
    pub points: Vec<[f64; 2]>,
    /// How high the surface there is above the origin of the base's frame [m], negative below; none where there is neither ground nor floor.
    pub heights: Vec<Option<f64>>,
}

impl HeightScan {
    /// Heights of the ground at points, seen from a base so high [m].
    pub fn new(points: Vec<[f64; 2]>, base: f64, heights: Vec<Option<f64>>) -> Self {
        Self { points, heights: heights.into_iter().map(|z| z.map(|z| z - base)).collect() }
    }
}

impl LinkState {
    /// Force of soft ground and rigid things together [N], and torque about the centre of mass [N m], world frame.
    pub fn felt(&self) -> Wrench {
        let centre = DVec3::from_array(self.centre);
        let [mut force, mut torque] = [self.ground.force, self.ground.torque].map(DVec3::from_array);
        for point in &self.rigid {
            let [at, by] = [point.position, point.force].map(DVec3::from_array);
            force += by;
            torque += (at - centre).cross(by);
        }
        Wrench { force: force.to_array(), torque: torque.to_array() }
    }

    /// Is it pressed by the ground or something rigid with more than `least` [N]?
    pub fn touches(&self, least: f64) -> bool {
        let above = |force: Vec3| DVec3::from_array(force).length() > least;
        above(self.ground.force) || self.rigid.iter().any(|point| above(point.force))
    }

    /// The patch that these points make.
    fn patch(&self, points: &[DVec3]) -> Option<Patch> {
        let bounds = points.iter().map(|p| Aabb { min: p.to_array(), max: p.to_array() });
        let bounds = bounds.reduce(|a, b| a.union(&b))?;
        let middle = points.iter().sum::<DVec3>() / points.len() as f64;
        let Wrench { force, torque } = self.felt();
        let [force, torque] = [force, torque].map(DVec3::from_array);
        let on_line = DVec3::from_array(self.centre) + force.cross(torque) / force.length_squared();
        let nearest = on_line + force * ((middle - on_line).dot(force) / force.length_squared());
        let centre = if nearest.is_finite() { nearest } else { middle };
        // Rounding and particles' width may bring it out of the box.
        let within = centre.clamp(DVec3::from_array(bounds.min), DVec3::from_array(bounds.max));
        Some(Patch { points: points.len(), bounds, centre_of_pressure: within.to_array() })
    }
}

impl Simulation {
    /// What the sensors of all robots say, in the scene's order.
    pub fn robots(&self) -> Vec<RobotState> {
        self.sensed().into_iter().map(|(_, robot)| robot).collect()
    }

    /// What the sensors of one of them say.
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such robot.
    pub fn robot(&self, name: &str) -> Result<RobotState> {
        Ok(self.sensed_robot(name)?.1)
    }

    /// Robots with their couplings, what the ground does to their links filled in.
    fn sensed(&self) -> Vec<(&dyn Coupling, RobotState)> {
        let wrenches = self.wrenches();
        let mut rest = wrenches.as_slice();
        let mut all = Vec::new();
        for coupling in self.couplings() {
            let (own, others) = rest.split_at(coupling.wrenches().len());
            rest = others;
            let mut robots = coupling.robots();
            let links = robots.iter_mut().flat_map(|robot| &mut robot.links);
            links.zip(own).for_each(|(link, wrench)| link.ground = *wrench);
            all.extend(robots.into_iter().map(|robot| (coupling.as_ref(), robot)));
        }
        all
    }

    /// Where each link of a robot is touched, in the order of [`RobotState::links`]; none where no force above `least` [N] is felt. A particle touches where it
    /// is less than half its width from the surface by which the link meets the ground.
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such robot, [`Error::Device`] if the particles were lost with their device.
    pub fn patches(&self, robot: &str, least: f64) -> Result<Vec<Option<Patch>>> {
        let (coupling, state) = self.sensed_robot(robot)?;
        let first = coupling.bodies().iter().position(|body| Some(&body.name) == state.links.first().map(|l| &l.name));
        let (first, bounds) = (first.unwrap_or_default(), coupling.bounds());
        let touched = |link: &LinkState| link.touches(least);
        let pressed = |link: &LinkState| DVec3::from_array(link.ground.force).length() > least;
        let boxes = state.links.iter().zip(&bounds[first..]).filter(|(link, _)| pressed(link));
        let around = boxes.map(|(_, bounds)| bounds.grown(self.widest())).reduce(|a, b| a.union(&b));
        // Along periodic axes the ground may be anywhere.
        let is_joined = (0..3).any(|d| self.plan().scene.world.is_periodic(d));
        let reading = match around {
            Some(region) => {
                self.read((!is_joined).then_some(region), Fields { volume0: true, exact: true, ..Fields::default() })?
            }
            None => Reading::default(),
        };
        let patch = |(body, link): (usize, &LinkState)| {
            let mut points: Vec<DVec3> = link.rigid.iter().map(|point| DVec3::from_array(point.position)).collect();
            if pressed(link) {
                points.extend(self.touching(coupling, first + body, &bounds[first + body], &reading));
            }
            if touched(link) { link.patch(&points) } else { None }
        };
        Ok(state.links.iter().enumerate().map(patch).collect())
    }

    /// The heights that a robot's `scan` asks for. Its points turn with the base about the vertical, but stay level. Tools that stay where they are count as ground, by their
    /// surfaces as contact has them.
    ///
    /// # Errors
    /// Those of [`scan_points`](Self::scan_points), [`Error::Device`] if the particles were lost with their device.
    pub fn scan(&self, robot: &str) -> Result<HeightScan> {
        let (points, base) = self.scan_points(robot)?;
        let heights = self.with_hard_ground(&points, self.heights(&points)?);
        Ok(HeightScan::new(points, base, heights))
    }

    /// Where the points of a robot's `scan` are [m], and how high the origin of its base's frame is [m].
    ///
    /// # Errors
    /// [`Error::Body`] if there is no such robot or its entry has no `scan`.
    pub fn scan_points(&self, robot: &str) -> Result<(Vec<[f64; 2]>, f64)> {
        let (_, state) = self.sensed_robot(robot)?;
        let entry = self.plan().scene.robot.iter().find(|entry| entry.name == robot);
        let grid = entry.and_then(|entry| entry.scan.as_ref()).ok_or_else(|| Error::Body {
            path: format!("robot '{robot}'"),
            what: "its entry gives no points to look at".to_owned(),
            mend: "add scan = { min = [-0.5, -0.3], max = [0.5, 0.3], points = [11, 7] }".to_owned(),
        })?;
        let [w, x, y, z] = state.rotation;
        let ahead = DQuat::from_xyzw(x, y, z, w) * DVec3::X;
        let (sin, cos) = ahead.y.atan2(ahead.x).sin_cos();
        let place = |[x, y]: [f64; 2]| [state.position[0] + cos * x - sin * y, state.position[1] + sin * x + cos * y];
        Ok((grid.places().map(place).collect(), state.position[2]))
    }

    /// Height of the surface of the soft ground above or below each point [m]: where, seen from above, particles first fill half of space, taken over a particle's
    /// width to all sides. Single grains in the air are not the ground. Where there is none, that of the world's floor; none if it is open.
    /// Ground out of `levels.reach` that nothing has changed is where the scene's shapes have it. Tools and robots are not seen. Beyond the world's sides the ground goes on: along periodic axes as it is at the other end,
    /// along others as high as beside the side.
    ///
    /// # Errors
    /// [`Error::Device`] if the particles were lost with their device.
    pub fn heights(&self, points: &[[f64; 2]]) -> Result<Vec<Option<f64>>> {
        let world = &self.plan().scene.world;
        let points: Vec<[f64; 2]> = points.iter().map(|point| world.inside(*point)).collect();
        if let Some(found) = self.engine().heights(&points, world.min[2]) {
            return Ok(self.completed(&points, found));
        }
        let column = |&[x, y]: &[f64; 2]| Aabb { min: [x, y, world.min[2]], max: [x, y, world.max[2]] };
        let Some(region) = points.iter().map(column).reduce(|a, b| a.union(&b)) else { return Ok(Vec::new()) };
        let fields = Fields { volume0: true, exact: true, ..Fields::default() };
        let periods = [0, 1].map(|d| if world.is_periodic(d) { world.max[d] - world.min[d] } else { 0.0 });
        // What is beyond a periodic side is at the other end.
        let mut region = region.grown(self.widest());
        for d in (0..2).filter(|d| world.is_periodic(*d)) {
            (region.min[d], region.max[d]) = (world.min[d], world.max[d]);
        }
        let columns = Columns::new(&self.read(Some(region), fields)?, [world.min[0], world.min[1]], periods);
        Ok(self.completed(&points, points.iter().map(|point| columns.height(*point)).collect()))
    }

    /// Height of the ground at points where nothing has changed it and that are out of `levels.reach`, or nearer than `margin` [m] to such ground along x or y: as the
    /// scene's shapes have it [m]. None elsewhere, and where they have nothing.
    pub fn untouched_heights(&self, points: &[[f64; 2]], margin: f64) -> Vec<Option<f64>> {
        let Some(terrain) = &self.plan().terrain else { return vec![None; points.len()] };
        let (world, inner) = (&self.plan().scene.world, 0.5 * self.plan().scene.world.cell);
        let corners = if margin > 0.0 { 4 } else { 1 };
        let corner = |n: usize, point: &[f64; 2]| {
            let place = |d: usize| point[d] + if n >> d & 1 == 0 { -margin } else { margin };
            [0, 1].map(|d| place(d).min(world.max[d] - inner).max(world.min[d] + inner))
        };
        let all: Vec<[f64; 2]> = points.iter().flat_map(|point| (0..corners).map(|n| corner(n, point))).collect();
        let untouched = self.engine().untouched(&all);
        let height =
            |(point, near): (&[f64; 2], &[bool])| if near.contains(&true) { terrain.height(*point) } else { None };
        points.iter().zip(untouched.chunks(corners)).map(height).collect()
    }

    /// Heights of what particles are at points [m], completed: by ground out of reach, and by the world's floor where there is no ground.
    pub(crate) fn completed(&self, points: &[[f64; 2]], heights: Vec<Option<f64>>) -> Vec<Option<f64>> {
        let world = &self.plan().scene.world;
        let floor = (world.walls.z_min != Wall::Open).then_some(world.min[2]);
        // Beside the edge, particles on one side alone fill half of space at most. Ground there is held at rest.
        let untouched = self.untouched_heights(points, 0.5 * self.widest());
        heights.into_iter().zip(untouched).map(|(height, untouched)| untouched.or(height).or(floor)).collect()
    }

    /// Heights of soft ground at points [m], or of tools that stay where they are, by their surfaces as contact has them, where these are higher.
    pub(crate) fn with_hard_ground(&self, points: &[[f64; 2]], mut heights: Vec<Option<f64>>) -> Vec<Option<f64>> {
        let world = &self.plan().scene.world;
        let points: Vec<[f64; 2]> = points.iter().map(|point| world.inside(*point)).collect();
        for coupling in self.couplings() {
            let staying = coupling.bounds().into_iter().enumerate().filter(|(body, _)| coupling.stays(*body));
            for (body, bounds) in staying {
                for by in world.images(&bounds) {
                    let there = |i: usize| [points[i][0] + by[0], points[i][1] + by[1]];
                    let is_over = |i: &usize| (0..2).all(|d| (bounds.min[d]..=bounds.max[d]).contains(&there(*i)[d]));
                    let over: Vec<usize> = (0..points.len()).filter(is_over).collect();
                    let places: Vec<[f64; 2]> = over.iter().map(|i| there(*i)).collect();
                    for (i, top) in over.into_iter().zip(fallen_on(&**coupling, body, &bounds, &places, world.cell)) {
                        heights[i] = heights[i].into_iter().chain(top).reduce(f64::max);
                    }
                }
            }
        }
        heights
    }

    /// The particles that touch a body with such bounds.
    fn touching(&self, coupling: &dyn Coupling, body: usize, bounds: &Aabb, reading: &Reading) -> Vec<DVec3> {
        let around = bounds.grown(self.widest());
        let middle: Vec3 = std::array::from_fn(|d| 0.5 * (bounds.min[d] + bounds.max[d]));
        let world = &self.plan().scene.world;
        let images = (0..reading.len()).map(|i| (i, world.image_near(reading.exact[i], middle)));
        let near: Vec<(usize, Vec3)> = images.filter(|(_, place)| around.contains(*place)).collect();
        let places: Vec<Vec3> = near.iter().map(|(_, place)| *place).collect();
        let distances = coupling.contact_distance(body, &places);
        let touches = |i: usize, distance: f64| 2.0 * distance < f64::from(reading.volume0[i]).cbrt();
        let all = near.iter().zip(distances).filter(|((i, _), distance)| touches(*i, *distance));
        all.map(|((_, place), _)| DVec3::from_array(*place)).collect()
    }

    fn sensed_robot(&self, name: &str) -> Result<(&dyn Coupling, RobotState)> {
        let mut all = self.sensed();
        let known: Vec<String> = all.iter().map(|(_, robot)| robot.name.clone()).collect();
        let number = known.iter().position(|other| other == name);
        number.map(|number| all.swap_remove(number)).ok_or_else(|| Error::Body {
            path: format!("robot '{name}'"),
            what: "no robot has this name".to_owned(),
            mend: if known.is_empty() {
                "the scene has none".to_owned()
            } else {
                format!("there are {}", known.join(", "))
            },
        })
    }

    /// Cells of the coarsest level: no particle is wider [m].
    fn widest(&self) -> f64 {
        self.plan().cell_widths.iter().copied().fold(0.0, f64::max)
    }
}

/// Particles in square columns.
struct Columns {
    /// Width of a column: that of the largest particle [m].
    width: f64,
    columns: HashMap<[i64; 2], Vec<(Vec3, f64)>>,
}

impl Columns {
    /// Particles, and images of those near sides that are joined, where the world goes from `min` for such lengths, 0 where sides are not joined.
    fn new(reading: &Reading, min: [f64; 2], periods: [f64; 2]) -> Self {
        let side = |i: usize| f64::from(reading.volume0[i]).cbrt();
        let width = (0..reading.len()).map(side).fold(0.0, f64::max);
        let mut columns: HashMap<[i64; 2], Vec<(Vec3, f64)>> = HashMap::new();
        let images = |d: usize, x: f64| {
            let off = (x - min[d], min[d] + periods[d] - x);
            let near = |off: f64| periods[d] > 0.0 && off < 2.0 * width;
            let beyond = [near(off.0).then_some(periods[d]), near(off.1).then_some(-periods[d])];
            std::iter::once(0.0).chain(beyond.into_iter().flatten()).map(move |by| x + by)
        };
        for (i, &[x, y, z]) in reading.exact.iter().enumerate() {
            for x in images(0, x) {
                for y in images(1, y) {
                    columns.entry(Self::key([x, y], width)).or_default().push(([x, y, z], side(i)));
                }
            }
        }
        Self { width, columns }
    }

    fn key(point: [f64; 2], width: f64) -> [i64; 2] {
        point.map(|x| (x / width).floor() as i64)
    }

    /// Where particles fill half of space for the first time from above. Each is a cube, blurred sideways by its own width, so that cubes that tile space
    /// fill it evenly.
    fn height(&self, point: [f64; 2]) -> Option<f64> {
        if self.columns.is_empty() {
            return None;
        }
        let [i, j] = Self::key(point, self.width);
        let near = (0..9).filter_map(|n| self.columns.get(&[i + n % 3 - 1, j + n / 3 - 1])).flatten();
        let mut ends = Vec::new();
        for &([x, y, z], side) in near {
            let share = |off: f64| (1.0 - off.abs() / side).max(0.0);
            let share = share(x - point[0]) * share(y - point[1]);
            if share > 0.0 {
                ends.extend([(z + 0.5 * side, share), (z - 0.5 * side, -share)]);
            }
        }
        ends.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut filled = 0.0;
        ends.iter()
            .find(|(_, share)| {
                filled += share;
                filled >= 0.5
            })
            .map(|(z, _)| *z)
    }
}

/// How high a body's surface is at points within its box [m], found by falling on it from above: by as much as it is away, and back by halves where that was too far; none where
/// it is missed.
fn fallen_on(coupling: &dyn Coupling, body: usize, bounds: &Aabb, points: &[[f64; 2]], cell: f64) -> Vec<Option<f64>> {
    // Beside an upright face it is near and yet far below.
    let (near, least) = (1e-3 * cell, 0.1 * cell);
    let mut found = vec![None; points.len()];
    // Where each is, and where it was last above the surface.
    let mut falling: Vec<(usize, [f64; 2])> = (0..points.len()).map(|i| (i, [bounds.max[2]; 2])).collect();
    while !falling.is_empty() {
        let at: Vec<Vec3> = falling.iter().map(|&(i, [z, _])| [points[i][0], points[i][1], z]).collect();
        let gaps = coupling.contact_distance(body, &at);
        let fall = |((i, [z, above]), gap): ((usize, [f64; 2]), f64)| {
            if gap > near {
                let below = z - gap.max(least);
                return (below >= bounds.min[2] - least).then_some((i, [below, z]));
            }
            if gap >= -near || above - z <= near {
                found[i] = Some(z);
                return None;
            }
            Some((i, [0.5 * (above + z), above]))
        };
        falling = falling.into_iter().zip(gaps).filter_map(fall).collect();
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cubes of 1 cm under a surface, in columns that end where it is.
    fn ground(surface: impl Fn(f64, f64) -> f64) -> Columns {
        let fields = Fields { exact: true, volume0: true, ..Fields::default() };
        let mut reading = Reading::new(fields, [0.0; 3]);
        for n in 0..40 * 40 {
            let [x, y] = [n % 40, n / 40].map(|i| 0.01 * (f64::from(i) + 0.5));
            for k in 0..8 {
                reading.add_position([x, y, surface(x, y) - 0.01 * (f64::from(k) + 0.5)]);
                reading.volume0.push(1e-6);
            }
        }
        Columns::new(&reading, [0.0; 2], [0.0; 2])
    }

    #[test]
    fn the_surface_is_where_columns_end() {
        type Shape = fn(f64, f64) -> f64;
        // A flat bed, slopes of 17 and 31 degrees, a bowl.
        let shapes: [Shape; 4] =
            [|_, _| 0.3, |x, _| 0.3 * x, |x, y| 0.5 * y - 0.3 * x, |x, y| (x - 0.2).powi(2) + (y - 0.2).powi(2)];
        for (number, shape) in shapes.into_iter().enumerate() {
            let columns = ground(shape);
            let mut worst = 0.0_f64;
            for n in 0..400 {
                let [x, y] = [n % 20, n / 20].map(|i| 0.05 + 0.0147 * f64::from(i));
                worst = worst.max((columns.height([x, y]).unwrap() - shape(x, y)).abs());
            }
            println!("shape {number}: off by {worst:.1e} m (half a particle: 5e-3)");
            assert!(worst < if number == 0 { 1e-6 } else { 5e-3 }, "shape {number}: {worst}");
            assert_eq!(columns.height([1.0, 1.0]), None);
        }
    }

    #[test]
    fn a_single_grain_in_the_air_is_not_the_ground() {
        let mut columns = ground(|_, _| 0.1);
        let key = Columns::key([0.2, 0.2], columns.width);
        columns.columns.get_mut(&key).unwrap().push(([0.203, 0.203, 0.5], 0.01));
        assert!((columns.height([0.2, 0.2]).unwrap() - 0.1).abs() < 1e-6);
    }

    #[test]
    fn the_line_of_force_goes_through_the_centre_of_pressure() {
        let at = DVec3::new(0.03, -0.02, -0.1);
        let force = DVec3::new(5.0, 1.0, 80.0);
        let link = LinkState {
            name: "foot".to_owned(),
            centre: [0.0; 3],
            rotation: [1.0, 0.0, 0.0, 0.0],
            velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
            ground: Wrench { force: force.to_array(), torque: at.cross(force).to_array() },
            rigid: Vec::new(),
        };
        let corners = [[0.1, 0.1], [-0.1, 0.1], [0.1, -0.1], [-0.1, -0.1]].map(|[x, y]| DVec3::new(x, y, -0.1));
        let patch = link.patch(&corners).unwrap();
        let off = (DVec3::from_array(patch.centre_of_pressure) - at).length();
        // Nearest to the middle, not in the plane: the force leans by 3.6 degrees.
        assert!(off < 3e-3 && patch.points == 4, "{patch:?}, {off}");
        assert!(link.touches(80.0) && !link.touches(81.0));
    }
}
