//! Inflow and outflow: between steps, sinks take particles out and sources bring some in.
//!
//! A source lets layers of particles out of its mouth, one each time the last one has moved on by the spacing. A layer that was due within the last step comes in
//! where it would have fallen to by now, so that a stream is as even as if steps had ended just when layers were due.

use crate::account::{self, MaterialSums};
use crate::batch::Plane;
use crate::coupling::Aabb;
use crate::ledger::Passed;
use crate::levels::{Regions, SPLIT_AHEAD};
use crate::plan::PlannedMaterial;
use crate::scene::{Sampling, Scene, cross};
use crate::seed::{on_level, uniform};
use crate::solid::{self, Solid};
use crate::{Coupling, Engine, Fields, Ledger, ParticleList, Plan, Registry, Result, Spot, Vec3, runout};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// Steps after which sinks look again.
pub const SINK_STEPS: u64 = 8;
/// A cell that holds this part of its volume is full.
const FULL: f64 = 1.0 - 1e-6;
/// What rates and numbers may be off by rounding.
const ROUNDING: f64 = 1e-9;
/// Numbers of random streams of sources, behind those of any bodies.
const STREAMS: u64 = 1 << 32;
/// The same for rows and layers of sources.
const ROWS: u64 = 1 << 33;

/// A particle that a source brings in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Newcomer {
    /// Index into the plan's materials.
    pub material: usize,
    /// Number of its source, counted on from the scene's bodies.
    pub body: u16,
    /// Where it is [m].
    pub position: Vec3,
    /// Its velocity [m/s].
    pub velocity: Vec3,
    /// Side of the cube that it stands for [m].
    pub side: f64,
}

/// A scene's sources and sinks, ready to be asked.
pub struct Flows {
    seed: u64,
    sources: Vec<Mouth>,
    sinks: Vec<Drain>,
}

/// What sources and sinks have done so far: all that they go on from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct FlowState {
    /// Layers of each source so far, and how many particles were due in them.
    layers: Vec<u64>,
    due: Vec<u64>,
    /// Number of the next new particle.
    next_id: u64,
    /// What sources have brought in, and what sinks have taken out.
    pub(crate) came: Passed,
    pub(crate) went: Passed,
    /// Particles that did not come since there was no room for them.
    pub(crate) held_back: u64,
}

/// A source.
struct Mouth {
    material: usize,
    body: u16,
    /// Lattice points of a layer [m], and the directions from one to the next, in the layer and along the stream.
    sites: Vec<Vec3>,
    axes: [Vec3; 3],
    in_slice: bool,
    /// Spacings from the outermost points to the ends of the mouth along these, half of one at most.
    room: [f64; 2],
    /// The row along the first direction in which each of the points lies.
    rows: Vec<u64>,
    sampling: Sampling,
    spacing: f64,
    velocity: Vec3,
    /// Mass of a particle [kg].
    mass: f64,
    /// Particles of a layer on average.
    each: f64,
    /// Most particles in all.
    limit: u64,
    from: f64,
    until: f64,
    /// Seconds between two layers.
    period: f64,
}

/// A sink.
struct Drain {
    solid: Box<dyn Solid>,
    material: Option<usize>,
    from: f64,
    until: f64,
}

impl std::fmt::Debug for Flows {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (sources, sinks) = (self.sources.len(), self.sinks.len());
        f.debug_struct("Flows").field("sources", &sources).field("sinks", &sinks).finish_non_exhaustive()
    }
}

impl Mouth {
    fn new(scene: &Scene, registry: &Registry, materials: &[PlannedMaterial], i: usize) -> Result<Self> {
        let (source, path) = (&scene.inflow[i], format!("source[{i}]"));
        let material = index_of(materials, &source.material);
        let solid = solid::in_world(&source.shape, scene, registry, &format!("{path}.shape"))?;
        scene.check_inside(&path, solid.bounds())?;
        let (spacing, density) = (scene.inflow_spacing(source), materials[material].density);
        let speed = source.velocity.iter().map(|v| v * v).sum::<f64>().sqrt();
        let (mass, period) = (density * spacing.powi(3), spacing / speed);
        let axes = directions(source.velocity.map(|v| v / speed));
        let sites = layer(&*solid, axes, spacing);
        let fall = solid.bounds().max[2] - scene.world.min[2];
        if sites.is_empty() {
            return Err(scene.fault(
                &format!("{path}.shape"),
                format!("has no point of a lattice of {spacing} m in its middle"),
                "enlarge it, or lower spacing or world.cell",
            ));
        }
        let most = sites.len() as f64 * mass / period;
        let (key, rate) = match (source.mass_rate, source.volume_rate) {
            (Some(rate), _) => ("mass_rate", rate),
            (None, Some(rate)) => ("volume_rate", rate * density),
            (None, None) => ("mass_rate", most),
        };
        if rate > most * (1.0 + ROUNDING) {
            return Err(scene.fault(
                &format!("{path}.{key}"),
                format!(
                    "asks for {rate} kg/s, and {} particles of {mass:.4e} kg every {period:.4e} s are {most:.6} kg/s",
                    sites.len()
                ),
                "lower it, widen the shape, or raise the velocity",
            ));
        }
        if let Some(limit) = source.limit.filter(|limit| limit / mass * (1.0 + ROUNDING) < 1.0) {
            return Err(scene.fault(
                &format!("{path}.limit"),
                format!("is {limit} kg, and a particle has {mass:.4e} kg: none would come"),
                "raise it, or lower spacing or world.cell",
            ));
        }
        Ok(Self {
            material,
            body: (scene.body.len() + i) as u16,
            in_slice: scene.world.plane_strain.is_some(),
            room: [axes[0], axes[1]].map(|axis| room(&*solid, axis, spacing)),
            rows: rows(&sites, axes[1], spacing),
            sites,
            axes,
            sampling: match source.sampling {
                // What holds together should come without gaps.
                Sampling::Auto if !runout::collapses(&materials[material], scene, fall) => Sampling::Lattice,
                Sampling::Auto => Sampling::Stagger,
                other => other,
            },
            spacing,
            velocity: source.velocity,
            mass,
            each: rate * period / mass,
            limit: source.limit.map_or(u64::MAX, |limit| (limit / mass * (1.0 + ROUNDING)) as u64),
            from: source.from,
            until: source.until.unwrap_or(f64::INFINITY),
            period,
        })
    }

    /// When a layer is due [s]; infinite if it never is.
    fn time_of(&self, layer: u64, due: u64) -> f64 {
        let time = self.from + layer as f64 * self.period;
        if time < self.until && due < self.limit { time } else { f64::INFINITY }
    }

    /// Particles that are due in the first layers together.
    fn due_in(&self, layers: u64) -> u64 {
        ((self.each * layers as f64 * (1.0 + ROUNDING)) as u64).min(self.limit)
    }

    /// The sites of so many particles of a layer, chosen at random where they are fewer than there are sites.
    fn chosen(&self, seed: u64, layer: u64, count: usize) -> Vec<usize> {
        let mut sites: Vec<usize> = (0..self.sites.len()).collect();
        if count < sites.len() {
            let random = |site: &usize| self.random(seed, layer, *site, 2);
            sites.sort_by(|a, b| random(a).total_cmp(&random(b)));
            sites.truncate(count);
            sites.sort_unstable();
        }
        sites
    }

    /// A random number in [0, 1): its `number`th one of a site in a layer.
    fn random(&self, seed: u64, layer: u64, site: usize, number: u64) -> f64 {
        // A stream has three numbers for each particle: those of a site are in two of them.
        let place = 2 * (layer * self.sites.len() as u64 + site as u64);
        uniform(seed, STREAMS + u64::from(self.body), place + number / 3, number % 3)
    }

    /// Where a particle comes in, `late` seconds after its layer was due.
    fn newcomer(&self, seed: u64, (layer, site): (u64, usize), late: f64, gravity: Vec3) -> Newcomer {
        let mut position = self.sites[site];
        let part = |number: u64, axis: u64| uniform(seed, ROWS + u64::from(self.body), number, axis);
        let within = match self.sampling {
            Sampling::Auto | Sampling::Lattice => [0.5; 3],
            // Rows and whole layers, as far as they stay in the mouth. In plane strain nothing varies along y.
            Sampling::Stagger if self.in_slice => {
                let across = |n: usize| if self.axes[n][1] == 0.0 { 2.0 * part(layer, n as u64) - 1.0 } else { 0.0 };
                [0.5 + self.room[0] * across(0), 0.5 + self.room[1] * across(1), 0.5]
            }
            Sampling::Stagger => {
                let row = layer * self.sites.len() as u64 + self.rows[site];
                let [of_row, of_layer] = [part(row, 0), part(layer, 1)].map(|part| 2.0 * part - 1.0);
                [0.5 + self.room[0] * of_row, 0.5 + self.room[1] * of_layer, 0.5]
            }
            Sampling::Jitter => [0, 1, 3].map(|number| self.random(seed, layer, site, number)),
        };
        for (axis, within) in self.axes.iter().zip(within) {
            (0..3).for_each(|d| position[d] += (within - 0.5) * self.spacing * axis[d]);
        }
        for d in 0..3 {
            position[d] += late * (self.velocity[d] + 0.5 * late * gravity[d]);
        }
        let velocity = std::array::from_fn(|d| self.velocity[d] + late * gravity[d]);
        Newcomer { material: self.material, body: self.body, position, velocity, side: self.spacing }
    }
}

impl Drain {
    fn is_open(&self, time: f64) -> bool {
        self.from <= time && time < self.until
    }
    fn takes(&self, spot: &Spot) -> bool {
        self.material.is_none_or(|material| material == spot.material as usize) && self.solid.contains(spot.position)
    }
}

impl Flows {
    /// The sources and sinks of a scene; `None` if it has none.
    ///
    /// # Errors
    /// [`Error::Scene`](crate::Error::Scene) for a mouth without sites or with too high a rate, and what reading a mesh or a height field may give.
    pub(crate) fn new(scene: &Scene, registry: &Registry, materials: &[PlannedMaterial]) -> Result<Option<Self>> {
        if scene.inflow.is_empty() && scene.outflow.is_empty() {
            return Ok(None);
        }
        let sources = (0..scene.inflow.len()).map(|i| Mouth::new(scene, registry, materials, i));
        let sinks = scene.outflow.iter().enumerate().map(|(i, sink)| {
            Ok(Drain {
                solid: solid::of_shape(&sink.shape, scene, registry, &format!("sink[{i}].shape"))?,
                // A material that nothing is of is not in the plan.
                material: sink
                    .material
                    .as_ref()
                    .map(|name| materials.iter().position(|m| m.name == *name).unwrap_or(usize::MAX)),
                from: sink.from,
                until: sink.until.unwrap_or(f64::INFINITY),
            })
        });
        Ok(Some(Self {
            seed: scene.seed,
            sources: sources.collect::<Result<_>>()?,
            sinks: sinks.collect::<Result<_>>()?,
        }))
    }

    /// Nothing has flowed; the next new particle has this number.
    pub(crate) fn start(&self, next_id: u64) -> FlowState {
        let none = vec![0; self.sources.len()];
        FlowState { layers: none.clone(), due: none, next_id, ..FlowState::default() }
    }

    /// What a source lets out: particles of a full layer, seconds between layers, and mass a second [kg/s].
    pub(crate) fn rate_of(&self, source: usize) -> (usize, f64, f64) {
        let mouth = &self.sources[source];
        (mouth.sites.len(), mouth.period, mouth.each * mouth.mass / mouth.period)
    }

    /// Most particles of each material that sources bring in until `end` [s]: pairs of a material and a number.
    pub(crate) fn most(&self, end: f64) -> impl Iterator<Item = (usize, f64)> {
        self.sources.iter().map(move |mouth| {
            let layers = ((end.min(mouth.until) - mouth.from) / mouth.period).ceil().max(0.0);
            (mouth.material, (mouth.each * layers).min(mouth.limit as f64))
        })
    }

    /// After how many steps of `dt` from `time`, the present one being number `step`, something is due that is not due now; at most `most`.
    pub(crate) fn steps_until_due(&self, state: &FlowState, (time, step): (f64, u64), dt: f64, most: usize) -> usize {
        let mut count = most;
        if !self.sinks.is_empty() {
            count = count.min((SINK_STEPS - step % SINK_STEPS) as usize);
        }
        let next = self.next_layer(state);
        // Time is added up just as steps do it, so that nothing depends on how many are taken at once.
        let mut at = time;
        for taken in 1..=count {
            at += dt;
            if at >= next {
                return taken;
            }
        }
        count
    }

    /// When the next layer is due [s].
    fn next_layer(&self, state: &FlowState) -> f64 {
        let times = self.sources.iter().zip(state.layers.iter().zip(&state.due));
        times.map(|(mouth, (layer, due))| mouth.time_of(*layer, *due)).fold(f64::INFINITY, f64::min)
    }

    /// Does what is due before step number `step`, at `time` [s]. Returns whether any particle came or went.
    ///
    /// 1. Sinks take out what is in them.
    /// 2. Sources bring in their layers where there is room.
    ///
    /// # Errors
    /// Those of the engine.
    pub(crate) fn advance(
        &self,
        state: &mut FlowState,
        plan: &Plan,
        (time, step): (f64, u64),
        engine: &mut dyn Engine,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<bool> {
        let mut changed = false;
        if step.is_multiple_of(SINK_STEPS) {
            changed |= self.drain(state, plan, time, engine)?;
        }
        if self.next_layer(state) <= time {
            changed |= self.pour(state, plan, time, engine, couplings)?;
        }
        Ok(changed)
    }

    fn drain(&self, state: &mut FlowState, plan: &Plan, time: f64, engine: &mut dyn Engine) -> Result<bool> {
        let open: Vec<&Drain> = self.sinks.iter().filter(|sink| sink.is_open(time)).collect();
        let Some(around) = open.iter().map(|sink| sink.solid.bounds()).reduce(|a, b| a.union(&b)) else {
            return Ok(false);
        };
        let is_in = |spot: &Spot| open.iter().any(|sink| sink.takes(spot));
        let seen = engine.read(Some(&around), Fields { exact: true, material: true, ..Fields::default() }, around.min);
        engine.check()?;
        let spot = |i: usize| Spot { position: seen.at(i), volume0: 0.0, material: u32::from(seen.material[i]) };
        if !(0..seen.len()).any(|i| is_in(&spot(i))) {
            return Ok(false);
        }
        let gone = engine.take_out(time, &is_in)?;
        state.went.add(&gone, plan);
        Ok(true)
    }

    fn pour(
        &self,
        state: &mut FlowState,
        plan: &Plan,
        time: f64,
        engine: &mut dyn Engine,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<bool> {
        let gravity = plan.scene.gravity_at(time);
        let mut come = Vec::new();
        for (mouth, (layers, due)) in self.sources.iter().zip(state.layers.iter_mut().zip(&mut state.due)) {
            while mouth.time_of(*layers, *due) <= time {
                let late = time - mouth.time_of(*layers, *due);
                let count = (mouth.due_in(*layers + 1) - *due) as usize;
                let sites = mouth.chosen(self.seed, *layers, count);
                come.extend(sites.iter().map(|&site| mouth.newcomer(self.seed, (*layers, site), late, gravity)));
                (*layers, *due) = (*layers + 1, *due + count as u64);
            }
        }
        let due = come.len();
        self.keep_where_room_is(&mut come, plan, engine, couplings)?;
        state.held_back += (due - come.len()) as u64;
        if come.is_empty() {
            return Ok(false);
        }
        let came = engine.bring_in(plan, time, &come, &mut state.next_id)?;
        state.came.add(&came, plan);
        Ok(true)
    }

    /// Leaves out those that would come into a cell that is full, into a tool or out of the world.
    fn keep_where_room_is(
        &self,
        come: &mut Vec<Newcomer>,
        plan: &Plan,
        engine: &dyn Engine,
        couplings: &[Box<dyn Coupling>],
    ) -> Result<()> {
        let points = come.iter().map(|one| Aabb { min: one.position, max: one.position });
        let Some(around) = points.reduce(|a, b| a.union(&b)) else { return Ok(()) };
        let (widest, fields) = (
            plan.cell_widths.last().copied().unwrap_or_default(),
            Fields { exact: true, volume0: true, level: true, ..Fields::default() },
        );
        let there = engine.read(Some(&around.grown(widest)), fields, around.min);
        engine.check()?;
        let cell = |level: usize, x: Vec3| (level, x.map(|x| (x / plan.cell_widths[level]).floor() as i64));
        let mut filled: HashMap<(usize, [i64; 3]), f64> = HashMap::new();
        for i in 0..there.len() {
            *filled.entry(cell(usize::from(there.level[i]), there.at(i))).or_default() += f64::from(there.volume0[i]);
        }
        let is_full = |level: usize, x: Vec3| {
            filled.get(&cell(level, x)).is_some_and(|volume| *volume >= FULL * plan.cell_widths[level].powi(3))
        };
        let mut inside = vec![false; come.len()];
        let positions: Vec<Vec3> = come.iter().map(|one| one.position).collect();
        for coupling in couplings {
            inside.iter_mut().zip(coupling.distance(&positions)).for_each(|(inside, d)| *inside |= d < 0.0);
        }
        let (world, mut inside) = (plan.scene.world_box(), inside.into_iter());
        come.retain(|one| {
            let in_tool = inside.next().unwrap_or(false);
            let full = (0..plan.cell_widths.len()).any(|level| is_full(level, one.position));
            !in_tool && !full && world.contains(one.position)
        });
        Ok(())
    }
}

impl Plan {
    /// Particles for newcomers, a list a level and material: undeformed, each on the level that `regions` have at its place. Numbers start at `next_id`, which
    /// moves on.
    pub fn newcomers(&self, come: &[Newcomer], regions: &Regions, next_id: &mut u64) -> Vec<ParticleList> {
        let precision = self.precision;
        let round = |x: f64| precision.round(x);
        let mut lists = Vec::new();
        for (level, width) in self.cell_widths.iter().enumerate() {
            for (m, planned) in self.materials.iter().enumerate() {
                let law = &planned.material;
                lists.push(ParticleList::empty(level, m, *width, law.strain_planes(), law.states.len()));
            }
        }
        for one in come {
            let site = |level: usize| one.position.map(|x| on_level(x, self.cell_widths[0], level, precision));
            let level = regions.finest_at(site(0).map(|place| place.0), SPLIT_AHEAD);
            let (planned, place) = (&self.materials[one.material], site(level));
            let list = &mut lists[level * self.materials.len() + one.material];
            list.id.push(*next_id);
            *next_id += 1;
            list.body.push(one.body);
            list.cell.push(place.map(|place| place.0));
            list.offset.push(place.map(|place| place.1));
            list.velocity.push(one.velocity.map(round));
            list.affine.push([0.0; 9]);
            list.mass.push(round(planned.density * one.side.powi(3)));
            list.volume0.push(round(one.side.powi(3)));
            for (plane, identity) in list.strain.iter_mut().zip(planned.material.strain_identity()) {
                plane.push(*identity);
            }
            for (plane, variable) in list.state.iter_mut().zip(&planned.material.states) {
                plane.push(round(variable.initial));
            }
        }
        lists
    }
}

impl Passed {
    /// Adds particles of a plan.
    fn add(&mut self, lists: &[ParticleList], plan: &Plan) {
        let mut sums = Ledger::default();
        for list in lists {
            for i in 0..list.len() {
                let motion = (&list.velocity[i][..], &list.affine[i][..]);
                let at = (list.mass[i], list.position(i));
                account::add_particle(&mut sums, at, motion, list.cell_width, plan.gravity);
            }
            if list.is_empty() {
                continue;
            }
            let mut of_material = MaterialSums::new(&plan.materials[list.material as usize], &mut sums);
            for first in (0..list.len()).step_by(account::BATCH) {
                let count = (list.len() - first).min(account::BATCH);
                // The last particle stands in for those behind it, so that no material sees a strain that nothing can have.
                let plane = |values: &Vec<f64>| Plane(std::array::from_fn(|i| values[first + i.min(count - 1)]));
                let (strain, state): (Vec<_>, Vec<_>) =
                    (list.strain.iter().map(plane).collect(), list.state.iter().map(plane).collect());
                of_material.add(&mut sums, &strain, &state, &list.volume0[first..first + count]);
            }
        }
        self.particles += sums.particles;
        self.mass += sums.mass;
        self.energy += sums.kinetic + sums.elastic + sums.potential;
        for d in 0..3 {
            self.momentum[d] += sums.momentum[d];
            self.angular_momentum[d] += sums.angular_momentum[d];
        }
    }
}

/// The index of a material that the plan has, since something is of it.
fn index_of(materials: &[PlannedMaterial], name: &str) -> usize {
    materials.iter().position(|m| m.name == name).expect("a source's material is planned")
}

/// Two directions at right angles to a unit vector, and the vector: along the axes if it is along one.
fn directions(along: Vec3) -> [Vec3; 3] {
    let least = (0..3).min_by(|a, b| along[*a].abs().total_cmp(&along[*b].abs())).unwrap_or(0);
    let mut first: Vec3 = [0.0; 3];
    first[least] = 1.0;
    let part = along[least];
    (0..3).for_each(|d| first[d] -= part * along[d]);
    let length = first.iter().map(|x| x * x).sum::<f64>().sqrt();
    let first = first.map(|x| x / length);
    [first, cross(along, first), along]
}

/// How wide a solid is along a direction, at most [m].
fn extent(solid: &dyn Solid, axis: Vec3) -> f64 {
    let Aabb { min, max } = solid.bounds();
    (0..3).map(|d| axis[d].abs() * (max[d] - min[d])).sum()
}

/// Spacings from a layer's outermost points to its mouth's end, half of one at most.
fn room(solid: &dyn Solid, axis: Vec3, spacing: f64) -> f64 {
    let spacings = extent(solid, axis) / spacing;
    0.5 + 0.5 * (spacings - spacings.round()).min(0.0)
}

/// The number of the row in which each point of a layer lies: rows follow one another along `across`.
fn rows(sites: &[Vec3], across: Vec3, spacing: f64) -> Vec<u64> {
    let along = |x: &Vec3| (0..3).map(|d| x[d] * across[d]).sum::<f64>();
    let first = sites.iter().map(along).fold(f64::INFINITY, f64::min);
    sites.iter().map(|x| ((along(x) - first) / spacing).round() as u64).collect()
}

/// The points of a square lattice in the cut through the middle of a solid that lie inside it, centred in its extent along both directions.
fn layer(solid: &dyn Solid, [u, v, _]: [Vec3; 3], spacing: f64) -> Vec<Vec3> {
    let Aabb { min, max } = solid.bounds();
    let middle: Vec3 = std::array::from_fn(|d| 0.5 * (min[d] + max[d]));
    let count = |axis: Vec3| (extent(solid, axis) / spacing).round() as i64;
    let (across, along) = (count(u), count(v));
    let at = |i: i64, count: i64| (i as f64 - 0.5 * (count - 1) as f64) * spacing;
    let points = (0..across).flat_map(|i| (0..along).map(move |j| (at(i, across), at(j, along))));
    let points = points.map(|(a, b)| std::array::from_fn(|d| middle[d] + a * u[d] + b * v[d]));
    points.filter(|x| solid.contains(*x)).collect()
}
