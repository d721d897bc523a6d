//! What probes of a scene find: sums over particles in regions, what has crossed sections, the surface, walls, single particles and clouds of points.
//!
//! Sums and crossings are a backend's, found where the particles live ([`Engine::sums`](crate::Engine::sums), [`Engine::crossed`](crate::Engine::crossed)).

use crate::nearest::Nearest;
use crate::plan::PlannedMaterial;
use crate::scene::{Probe, Region, Section, SurfaceProbe};
use crate::stress::{kirchhoff, volume_ratio};
use crate::{Aabb, Error, Fields, ParticleList, Plan, Reading, Result, Simulation, Vec3};
use serde::{Deserialize, Serialize};
use std::fs;

/// Which particles count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    /// Index into the plan's materials.
    pub material: Option<u32>,
    /// Index of the body in the scene.
    pub body: Option<u16>,
    /// Level, 0 the finest.
    pub level: Option<u32>,
}

impl Filter {
    /// That of a probe. A material that no body uses has no particles.
    pub fn of(plan: &Plan, probe: &Probe) -> Self {
        let material =
            |name: &String| plan.materials.iter().position(|m| m.name == *name).map_or(u32::MAX, |n| n as u32);
        let body = |name: &String| plan.scene.body.iter().position(|b| b.name == *name).map_or(u16::MAX, |n| n as u16);
        Self {
            material: probe.material.as_ref().map(material),
            body: probe.body.as_ref().map(body),
            level: probe.level,
        }
    }

    /// Does a particle count?
    pub fn takes(&self, material: u32, body: u16, level: u32) -> bool {
        self.material.is_none_or(|own| own == material)
            && self.body.is_none_or(|own| own == body)
            && self.level.is_none_or(|own| own == level)
    }
}

/// Particles that are asked about together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sought {
    /// Where they are.
    pub region: Region,
    /// Which of them count.
    pub filter: Filter,
}

/// Sums over particles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sums {
    /// How many.
    pub count: u64,
    /// Mass [kg].
    pub mass: f64,
    /// Rest volume [m³].
    pub volume0: f64,
    /// Volume, as far as strain tells: what has flowed in or out by plastic flow is not in it [m³].
    pub volume: f64,
    /// Momentum [kg m/s].
    pub momentum: Vec3,
    /// Volume times Cauchy stress, which is rest volume times Kirchhoff stress: xx, yy, zz, xy, xz, yz [J].
    pub stress: [f64; 6],
}

impl Sums {
    /// Adds the particles of a list that lie in a region and count.
    ///
    /// # Errors
    /// If the material has no f64 update, or fails.
    pub fn add_list(&mut self, sought: &Sought, planned: &PlannedMaterial, list: &ParticleList) -> Result<()> {
        let is_wanted = |i: &usize| {
            sought.filter.takes(list.material, list.body[*i], list.level) && sought.region.contains(list.position(*i))
        };
        let which: Vec<usize> = (0..list.len()).filter(is_wanted).collect();
        for (&i, tau) in which.iter().zip(kirchhoff(planned, list, &which)?) {
            let (mass, volume0) = (list.mass[i], list.volume0[i]);
            self.count += 1;
            self.mass += mass;
            self.volume0 += volume0;
            self.volume += volume0 * volume_ratio(list, i);
            (0..3).for_each(|d| self.momentum[d] += mass * list.velocity[i][d]);
            (0..6).for_each(|c| self.stress[c] += volume0 * tau[c]);
        }
        Ok(())
    }

    /// Mean Cauchy stress: xx, yy, zz, xy, xz, yz [Pa]; none without particles.
    pub fn mean_stress(&self) -> Option<[f64; 6]> {
        (self.volume > 0.0).then(|| self.stress.map(|s| s / self.volume))
    }

    /// Mean velocity by mass [m/s]; none without particles.
    pub fn mean_velocity(&self) -> Option<Vec3> {
        (self.mass > 0.0).then(|| self.momentum.map(|p| p / self.mass))
    }
}

/// Pressure −tr σ / 3, and the shear stress √(s : s / 2) of the deviator s, of a Cauchy stress xx, yy, zz, xy, xz, yz [Pa].
pub fn invariants(stress: &[f64; 6]) -> [f64; 2] {
    let [xx, yy, zz, xy, xz, yz] = *stress;
    let pressure = -(xx + yy + zz) / 3.0;
    let diagonal: f64 = [xx, yy, zz].map(|s| (s + pressure).powi(2)).iter().sum();
    [pressure, (0.5 * diagonal + xy * xy + xz * xz + yz * yz).sqrt()]
}

/// How far points and particles are from one another.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Apart {
    /// Particles.
    pub count: u64,
    /// Sum of their distances to the nearest of the points [m].
    pub distance: f64,
    /// Of each point the nearest particle; none if there are none.
    pub nearest: Vec<Option<Closest>>,
}

impl Apart {
    /// Mean distance of the particles to the nearest of the points, and of these points to the nearest particle [m]: both together are the chamfer distance. None without
    /// particles or points.
    pub fn means(&self, points: &[Vec3]) -> Option<[f64; 2]> {
        let from = |(closest, point): (&Option<Closest>, &Vec3)| closest.map(|closest| closest.distance(*point));
        let from: f64 = self.nearest.iter().zip(points).map(from).sum::<Option<f64>>()?;
        let has_both = self.count > 0 && !points.is_empty();
        has_both.then(|| [self.distance / self.count as f64, from / points.len() as f64])
    }
}

/// The particle nearest to a point; of several as near, that with the least number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// Its number.
    pub id: u64,
    /// Where it is [m].
    pub position: Vec3,
}

impl Closest {
    /// How far it is from the point [m].
    pub fn distance(&self, point: Vec3) -> f64 {
        (0..3).map(|d| (self.position[d] - point[d]).powi(2)).sum::<f64>().sqrt()
    }

    /// The nearer one to a point.
    pub fn or_nearer(self, other: Self, point: Vec3) -> Self {
        let is_nearer = other.distance(point).total_cmp(&self.distance(point)).then(other.id.cmp(&self.id)).is_lt();
        if is_nearer { other } else { self }
    }
}

/// What has crossed a section since the start: along its normal, and against it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Crossed {
    /// Particles.
    pub count: [u64; 2],
    /// Mass [kg].
    pub mass: [f64; 2],
    /// Rest volume [m³].
    pub volume0: [f64; 2],
    /// Momentum that particles had as they crossed [N s].
    pub momentum: [Vec3; 2],
    /// What f64 does not hold of sums that a backend keeps exactly: mass, rest volume, momentum.
    pub rest: [[f64; 5]; 2],
}

impl Crossed {
    /// Adds a particle.
    pub fn add(&mut self, is_against: bool, mass: f64, volume0: f64, velocity: Vec3) {
        let way = usize::from(is_against);
        self.count[way] += 1;
        self.mass[way] += mass;
        self.volume0[way] += volume0;
        (0..3).for_each(|d| self.momentum[way][d] += mass * velocity[d]);
    }
}

/// A section as a backend asks about it.
#[derive(Clone, Copy, Debug)]
pub struct Crossing {
    /// Where.
    pub section: Section,
    /// Which particles count.
    pub filter: Filter,
    point: Vec3,
    normal: Vec3,
}

impl Crossing {
    /// All sections of a plan's probes, in their order.
    pub fn all(plan: &Plan) -> Vec<Self> {
        let of = |(i, section): (usize, Section)| {
            let (point, normal) = section.plane();
            Self { section, filter: Filter::of(plan, &plan.scene.probe[i]), point, normal }
        };
        plan.scene.sections().map(of).collect()
    }

    /// How far in front of the section's plane a point is [m].
    pub fn height(&self, x: Vec3) -> f64 {
        (0..3).map(|d| (x[d] - self.point[d]) * self.normal[d]).sum()
    }

    /// Has something crossed the section on its straight way between two points, and if so, against its normal?
    pub fn is_crossed(&self, from: Vec3, to: Vec3) -> Option<bool> {
        let [before, after] = [from, to].map(|x| self.height(x));
        if (before < 0.0) == (after < 0.0) {
            return None;
        }
        let share = before / (before - after);
        let at = std::array::from_fn(|d| from[d] + share * (to[d] - from[d]));
        // On the plane but for rounding.
        let off = self.height(at);
        let at = std::array::from_fn(|d| at[d] - off * self.normal[d]);
        self.section.holds(at).then_some(after < before)
    }
}

/// What a probe has found.
#[derive(Clone, Debug, PartialEq)]
pub struct Probed {
    /// Name of the probe.
    pub name: String,
    /// Columns with their units, and values; none where there is nothing to measure.
    pub values: Vec<(String, Option<f64>)>,
}

const VELOCITY: [&str; 3] = ["vx [m/s]", "vy [m/s]", "vz [m/s]"];
const STRESS: [&str; 6] = ["xx [Pa]", "yy [Pa]", "zz [Pa]", "xy [Pa]", "xz [Pa]", "yz [Pa]"];

/// Columns of a probe, in the order of its values.
pub fn columns(probe: &Probe) -> Vec<String> {
    let named = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    match probe {
        Probe { flux: Some(_), .. } => named(&[
            "mass [kg]",
            "mass forwards [kg]",
            "mass back [kg]",
            "rest volume [m3]",
            "px [N s]",
            "py [N s]",
            "pz [N s]",
            "particles forwards",
            "particles back",
        ]),
        Probe { within: Some(_), .. } => {
            let first = ["particles", "mass [kg]", "rest volume [m3]", "fill"];
            named(&[&first[..], &VELOCITY, &["pressure [Pa]", "shear stress [Pa]"], &STRESS].concat())
        }
        Probe { surface: Some(surface), .. } => {
            let each = match surface {
                SurfaceProbe::Patch { .. } => 0,
                _ => surface.places().len(),
            };
            let mut all: Vec<String> = (0..each).map(|i| format!("z{i} [m]")).collect();
            all.extend(named(&["mean [m]", "least [m]", "greatest [m]"]));
            if let SurfaceProbe::Patch { above: Some(_), .. } = surface {
                all.push("share above".to_owned());
            }
            all
        }
        Probe { wall: Some(_), .. } => named(&["impulse x [N s]", "impulse y [N s]", "impulse z [N s]"]),
        Probe { nearest: Some(_), .. } => {
            let first = ["distance [m]", "id", "x [m]", "y [m]", "z [m]"];
            named(&[&first[..], &VELOCITY, &["density [kg/m3]", "pressure [Pa]"]].concat())
        }
        _ => named(&["to cloud [m]", "from cloud [m]", "chamfer [m]"]),
    }
}

impl Simulation {
    /// Sums over the particles in regions, found where the particles live; those in the archive of ground out of reach are among them.
    ///
    /// # Errors
    /// [`Error::Device`] if the particles were lost with their device, and what laws say that are asked for stress.
    pub fn sums_within(&self, sought: &[Sought]) -> Result<Vec<Sums>> {
        let sums = self.engine().sums(&self.plan().materials, sought)?;
        self.engine().check()?;
        Ok(sums)
    }

    /// How far points [m] and the particles that count are from one another, found where the particles live; those in the archive of ground out of reach are among
    /// them. Periodic sides are left out of account. The chamfer distance is the mean distance of the particles and that of the points, added.
    ///
    /// # Errors
    /// [`Error::Device`] if the particles were lost with their device.
    pub fn apart(&self, points: &[Vec3], filter: Filter) -> Result<Apart> {
        if let Some(apart) = self.engine().apart(points, filter)? {
            return Ok(apart);
        }
        let reading = self.read(None, placed())?;
        let mut all: Vec<Closest> =
            counted(&reading, filter).map(|i| Closest { id: reading.id[i], position: reading.exact[i] }).collect();
        all.sort_unstable_by_key(|one| one.id);
        let (to_points, particles) =
            (Nearest::new(points.to_vec()), Nearest::new(all.iter().map(|one| one.position).collect()));
        Ok(Apart {
            count: all.len() as u64,
            distance: all.iter().map(|one| to_points.distance(one.position)).sum(),
            nearest: points.iter().map(|point| particles.closest(*point).map(|i| all[i])).collect(),
        })
    }

    /// What has crossed the sections of the scene's probes since its start, in their order.
    ///
    /// # Errors
    /// [`Error::Device`] if it was lost with its device.
    pub fn crossed(&self) -> Result<Vec<Crossed>> {
        self.engine().crossed()
    }

    /// Impulse of the ground on the parts of walls of the scene's probes since its start, in their order [N s].
    pub fn pressed(&self) -> Vec<Vec3> {
        self.engine().pressed()
    }

    /// What the probes of the scene for which `wanted` holds find at present, by their numbers.
    ///
    /// # Errors
    /// As [`sums_within`](Self::sums_within), and what a file of points says.
    pub fn probes(&self, wanted: impl Fn(usize) -> bool) -> Result<Vec<Probed>> {
        let plan = self.plan();
        let probes: Vec<(usize, &Probe)> = plan.scene.probe.iter().enumerate().filter(|(i, _)| wanted(*i)).collect();
        let within = |(_, probe): &(usize, &Probe)| {
            probe.within.map(|region| Sought { region, filter: Filter::of(plan, probe) })
        };
        let sought: Vec<Sought> = probes.iter().filter_map(within).collect();
        let mut sums = if sought.is_empty() { Vec::new() } else { self.sums_within(&sought)? }.into_iter();
        let crossed = if probes.iter().any(|(_, probe)| probe.flux.is_some()) { self.crossed()? } else { Vec::new() };
        let pressed = if probes.iter().any(|(_, probe)| probe.wall.is_some()) { self.pressed() } else { Vec::new() };
        let value = |(number, probe): &(usize, &Probe)| {
            let values = match probe {
                Probe { within: Some(region), .. } => of_sums(&sums.next().unwrap_or_default(), region),
                Probe { flux: Some(_), .. } => {
                    let at = plan.scene.sections().position(|(i, _)| i == *number);
                    of_crossed(&at.and_then(|at| crossed.get(at)).copied().unwrap_or_default())
                }
                Probe { wall: Some(_), .. } => {
                    let at = plan.scene.wall_parts().position(|(i, _)| i == *number);
                    at.and_then(|at| pressed.get(at)).copied().unwrap_or_default().map(Some).into()
                }
                Probe { surface: Some(surface), .. } => self.of_surface(surface)?,
                Probe { nearest: Some(point), .. } => self.of_nearest(*point, Filter::of(plan, probe))?,
                Probe { chamfer: Some(file), .. } => self.of_cloud(file, Filter::of(plan, probe))?,
                _ => Vec::new(),
            };
            Ok(Probed { name: probe.name.clone(), values: columns(probe).into_iter().zip(values).collect() })
        };
        probes.iter().map(value).collect()
    }

    fn of_surface(&self, surface: &SurfaceProbe) -> Result<Vec<Option<f64>>> {
        let heights = self.heights(&surface.places())?;
        let known: Vec<f64> = heights.iter().flatten().copied().collect();
        let mean = known.iter().sum::<f64>() / known.len() as f64;
        let ends = [known.iter().copied().reduce(f64::min), known.iter().copied().reduce(f64::max)];
        let mut values = if let SurfaceProbe::Patch { .. } = surface { Vec::new() } else { heights.clone() };
        values.extend([Some(mean).filter(|_| !known.is_empty()), ends[0], ends[1]]);
        if let SurfaceProbe::Patch { above: Some(above), .. } = surface {
            let higher = known.iter().filter(|z| *z > above).count();
            values.push(Some(higher as f64 / heights.len() as f64));
        }
        Ok(values)
    }

    fn of_nearest(&self, point: Vec3, filter: Filter) -> Result<Vec<Option<f64>>> {
        let plan = self.plan();
        let found = match self.engine().apart(&[point], filter)? {
            Some(apart) => apart.nearest[0],
            None => self.look_for_nearest(point, filter)?,
        };
        let Some(nearest) = found else { return Ok(vec![None; 10]) };
        // Nothing else is as near to it.
        let region = Region::Sphere { center: nearest.position, radius: 1e-4 * plan.cell_widths[0] };
        let sums = self.sums_within(&[Sought { region, filter }])?.pop().unwrap_or_default();
        let first = [nearest.distance(point), nearest.id as f64].into_iter().chain(nearest.position).map(Some);
        let pressure = sums.mean_stress().map(|stress| invariants(&stress)[0]);
        let last = [(sums.volume > 0.0).then(|| sums.mass / sums.volume), pressure];
        Ok(first.chain(sums.mean_velocity().map_or([None; 3], |v| v.map(Some))).chain(last).collect())
    }

    /// The particle nearest to a point, in a box around that which grows until nothing outside could be nearer.
    fn look_for_nearest(&self, point: Vec3, filter: Filter) -> Result<Option<Closest>> {
        let plan = self.plan();
        let world = plan.scene.world_box();
        let farthest = (0..3).map(|d| (world.max[d] - world.min[d]).max((point[d] - world.min[d]).abs())).sum::<f64>();
        let mut reach = plan.cell_widths.iter().copied().fold(0.0, f64::max);
        loop {
            let region = Aabb { min: point, max: point }.grown(reach);
            let near = self.read(Some(region), placed())?;
            let closest = counted(&near, filter).map(|i| Closest { id: near.id[i], position: near.exact[i] });
            let nearest = closest.reduce(|one, other| one.or_nearer(other, point));
            if nearest.is_some_and(|nearest| nearest.distance(point) <= reach) || reach > 2.0 * farthest {
                return Ok(nearest);
            }
            reach *= 2.0;
        }
    }

    fn of_cloud(&self, file: &std::path::Path, filter: Filter) -> Result<Vec<Option<f64>>> {
        let cloud = read_points(&self.plan().scene.folder.join(file))?;
        Ok(match self.apart(&cloud, filter)?.means(&cloud) {
            Some([to, from]) => vec![Some(to), Some(from), Some(to + from)],
            None => vec![None; 3],
        })
    }
}

/// What tells where particles are, and whether they count.
fn placed() -> Fields {
    Fields { exact: true, id: true, body: true, material: true, level: true, ..Fields::default() }
}

/// The numbers of those that count.
fn counted(reading: &Reading, filter: Filter) -> impl Iterator<Item = usize> {
    let counts =
        move |i: &usize| filter.takes(u32::from(reading.material[*i]), reading.body[*i], u32::from(reading.level[*i]));
    (0..reading.len()).filter(counts)
}

fn of_crossed(crossed: &Crossed) -> Vec<Option<f64>> {
    let net = |both: [f64; 2]| both[0] - both[1];
    let [forwards, back] = crossed.momentum;
    let mut values = vec![net(crossed.mass), crossed.mass[0], crossed.mass[1], net(crossed.volume0)];
    values.extend((0..3).map(|d| forwards[d] - back[d]));
    values.extend(crossed.count.map(|count| count as f64));
    values.into_iter().map(Some).collect()
}

fn of_sums(sums: &Sums, region: &Region) -> Vec<Option<f64>> {
    let mut values: Vec<Option<f64>> =
        [sums.count as f64, sums.mass, sums.volume0, sums.volume0 / region.volume()].map(Some).into();
    values.extend(sums.mean_velocity().map_or([None; 3], |v| v.map(Some)));
    let stress = sums.mean_stress();
    values.extend(stress.as_ref().map_or([None; 2], |stress| invariants(stress).map(Some)));
    values.extend(stress.map_or([None; 6], |stress| stress.map(Some)));
    values
}

/// Points of a CSV file: x, y, z in each line [m], further columns left out, after a line of names or not.
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Body`] that names the first line which is none.
pub fn read_points(file: &std::path::Path) -> Result<Vec<Vec3>> {
    let text = fs::read_to_string(file).map_err(|source| Error::Io {
        file: file.to_owned(),
        what: "reading points",
        source,
    })?;
    let mut points = Vec::new();
    for (number, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let values: Vec<Option<f64>> = line.split(',').map(|value| value.trim().parse().ok()).collect();
        match values[..] {
            [Some(x), Some(y), Some(z), ..] if [x, y, z].iter().all(|c: &f64| c.is_finite()) => points.push([x, y, z]),
            _ if number == 0 => {}
            _ => {
                return Err(Error::Body {
                    path: format!("{}, line {}", file.display(), number + 1),
                    what: "is no point".to_owned(),
                    mend: "write three finite numbers in metres, with commas between them".to_owned(),
                });
            }
        }
    }
    if points.is_empty() {
        return Err(Error::Body {
            path: file.display().to_string(),
            what: "holds no point".to_owned(),
            mend: "write x, y, z in metres in each line, with commas between them".to_owned(),
        });
    }
    Ok(points)
}
