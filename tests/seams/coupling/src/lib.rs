//! Couplings outside Barchan's own crates. [`rollers`] are bodies that grip the ground, and a [`dumbbell`] is two that answer it together. Here are fields that drag it along: a current in the whole world, and brakes
//! in boxes.
//!
//! A scene calls for them by `[[coupling]] kind = "current"` or `"brakes"`, as often as it likes. A node's velocity u follows du/dt = rate (w - u), taken
//! implicitly, so that any step is stable; what the node gains, a pump without an end of mass loses. A current's w is what its parameters say, that of brakes
//! is zero. A current has one body, which bears the coupling's name, and brakes have one for each of their boxes.

pub mod dumbbell;
pub mod rollers;

use barchan::coupling::{Aabb, DeviceLaw};
use barchan::parameter::{Parameter, Range};
use barchan::registries::CouplingSetup;
use barchan::{BodyState, Command, Coupling, Error, NodeBatch, Registry, Result, Vec3, Wrench};
use std::sync::Arc;

/// Name of the kind of currents.
pub const CURRENT: &str = "current";
/// Name of the kind of brakes.
pub const BRAKES: &str = "brakes";

/// Registers all kinds.
///
/// # Errors
/// If a name is taken.
pub fn register(registry: &mut Registry) -> Result<()> {
    let rate = || Parameter::number("rate", "1/s", Range::POSITIVE, "How fast the ground takes up the velocity.");
    let current = vec![
        rate(),
        Parameter::vector("velocity", "m/s", Range::FINITE, "Velocity of the current.").or([0.0; 3]),
        Parameter::number("heading", "rad", Range::FINITE, "Angle about z by which the velocity is turned.").or(0.0),
        Parameter::text("field", &["uniform", "whirl"], "The same everywhere, or turning about the world's middle.")
            .or("uniform"),
        Parameter::number("spin", "rad/s", Range::FINITE, "Angular velocity of a whirl about z.").or(0.0),
        Parameter::switch("horizontal", "Is vertical motion left alone?").or(false),
        Parameter::path("record", "CSV with rows of time [s] and the share of the velocity then, joined by lines.")
            .or(""),
        Parameter::switch("host", "Beside a GPU, is it applied on the host, as if it had no WGSL?").or(false),
    ];
    let doc = "A current that drags the ground along.";
    registry.add_coupling(CURRENT, doc, current, Arc::new(|setup| Ok(Box::new(Drag::current(setup)?))))?;
    let zone = vec![
        Parameter::text("name", &[], "Name of the box in the trace."),
        Parameter::vector("center", "m", Range::FINITE, "Its middle."),
        Parameter::vector("half", "m", Range::POSITIVE, "Half its extents."),
        rate(),
    ];
    let zones = Parameter::tables("zone", zone, 1..=64, "The boxes.");
    let doc = "Boxes in which the ground is slowed down.";
    registry.add_coupling(BRAKES, doc, vec![zones], Arc::new(|setup| Ok(Box::new(Drag::brakes(setup)))))?;
    rollers::register(registry)?;
    dumbbell::register(registry)
}

/// The same for GPUs. The table holds, for each zone, its rate, the spin of a whirl about its middle, along how many axes it acts; and the velocity.
const WGSL: &str = "
fn coupling_field(body: u32, x: vec3<f32>, u: vec3<f32>, mass: f32, dt: f32) -> vec3<f32> {
    let zone = coupling_table(2u * body);
    let taken = zone.x * dt / (1.0 + zone.x * dt);
    let velocity = coupling_table(2u * body + 1u).xyz + zone.y * vec3<f32>(-x.y, x.x, 0.0);
    return u + taken * (velocity - u) * select(vec3<f32>(1.0), vec3<f32>(1.0, 1.0, 0.0), zone.z < 3.0);
}
";

/// How ground is to move.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Field {
    Uniform(Vec3),
    /// About a vertical axis, with an angular velocity [rad/s].
    Whirl([f64; 2], f64),
}

impl Field {
    fn at(self, x: Vec3) -> Vec3 {
        match self {
            Self::Uniform(velocity) => velocity,
            Self::Whirl(axis, spin) => [-spin * (x[1] - axis[1]), spin * (x[0] - axis[0]), 0.0],
        }
    }
}

/// Where ground is dragged along.
#[derive(Clone, Debug)]
struct Zone {
    name: String,
    extent: Aabb,
    rate: f64,
    field: Field,
}

/// A coupling of either kind, and what it felt in the last step.
#[derive(Clone, Debug)]
pub struct Drag {
    name: String,
    zones: Vec<Zone>,
    /// Axes along which it acts.
    axes: usize,
    /// Times [s] and the share of the velocity then; empty: all of it, always.
    record: Vec<[f64; 2]>,
    /// That share in the step under way.
    share: f64,
    /// Is it to be applied on the host?
    on_host: bool,
    wrenches: Vec<Wrench>,
}

impl Drag {
    fn current(setup: &CouplingSetup<'_>) -> Result<Self> {
        let (world, given) = (setup.scene.world_box(), setup.parameters);
        let [x, y, z] = given.vector("velocity");
        let (sin, cos) = given.number("heading").sin_cos();
        let field = match given.text("field") {
            "whirl" => {
                let middle = std::array::from_fn(|d| 0.5 * (world.min[d] + world.max[d]));
                Field::Whirl(middle, given.number("spin"))
            }
            _ => Field::Uniform([cos * x - sin * y, sin * x + cos * y, z]),
        };
        let record = match given.path("record") {
            Some(file) => {
                let text = std::fs::read_to_string(file).map_err(|source| Error::Io {
                    file: file.to_owned(),
                    what: "reading the record of a current",
                    source,
                })?;
                read(&text).ok_or_else(|| {
                    let mend = "give rows of two finite numbers, time and share, with times that rise";
                    setup.fault("record", format!("{} is no record", file.display()), mend)
                })?
            }
            None => Vec::new(),
        };
        let name = setup.name.to_owned();
        let zone = Zone { name, extent: world, rate: given.number("rate"), field };
        let (axes, on_host) = (if given.switch("horizontal") { 2 } else { 3 }, given.switch("host"));
        Ok(Self { axes, record, on_host, ..Self::of(setup.name, vec![zone]) })
    }

    fn brakes(setup: &CouplingSetup<'_>) -> Self {
        let zones = setup.parameters.tables("zone").into_iter().map(|zone| {
            let (center, half) = (zone.vector("center"), zone.vector("half"));
            Zone {
                name: zone.text("name").to_owned(),
                extent: Aabb {
                    min: std::array::from_fn(|d| center[d] - half[d]),
                    max: std::array::from_fn(|d| center[d] + half[d]),
                },
                rate: zone.number("rate"),
                field: Field::Uniform([0.0; 3]),
            }
        });
        Self::of(setup.name, zones.collect())
    }

    fn of(name: &str, zones: Vec<Zone>) -> Self {
        let wrenches = vec![Wrench::default(); zones.len()];
        Self { name: name.to_owned(), zones, axes: 3, record: Vec::new(), share: 1.0, on_host: false, wrenches }
    }

    /// The share of the velocity at a time [s]: before the record and after it, that of its end.
    fn share_at(&self, time: f64) -> f64 {
        let after = self.record.partition_point(|row| row[0] <= time);
        match (after.checked_sub(1).map(|i| self.record[i]), self.record.get(after)) {
            (Some([t0, s0]), Some([t1, s1])) => s0 + (s1 - s0) * (time - t0) / (t1 - t0),
            (Some([_, share]), None) | (None, Some(&[_, share])) => share,
            (None, None) => 1.0,
        }
    }
}

/// The rows of a record.
fn read(text: &str) -> Option<Vec<[f64; 2]>> {
    let row = |line: &str| {
        let (time, share) = line.split_once(',')?;
        let row = [time.trim().parse::<f64>().ok()?, share.trim().parse::<f64>().ok()?];
        row.iter().all(|x| x.is_finite()).then_some(row)
    };
    let rows = text.lines().filter(|line| !line.trim().is_empty()).map(row).collect::<Option<Vec<_>>>()?;
    (!rows.is_empty() && rows.windows(2).all(|pair| pair[0][0] < pair[1][0])).then_some(rows)
}

impl Coupling for Drag {
    fn name(&self) -> &str {
        &self.name
    }
    fn bodies(&self) -> Vec<BodyState> {
        let body = |zone: &Zone| BodyState {
            name: zone.name.clone(),
            position: std::array::from_fn(|d| 0.5 * (zone.extent.min[d] + zone.extent.max[d])),
            rotation: [1.0, 0.0, 0.0, 0.0],
            velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
            mass: f64::INFINITY,
            kinetic_energy: 0.0,
            potential_energy: 0.0,
            momentum: [0.0; 3],
            angular_momentum: [0.0; 3],
        };
        self.zones.iter().map(body).collect()
    }
    fn max_speed(&self, _: f64, _: f64) -> f64 {
        0.0
    }
    fn before_step(&mut self, time: f64, _: f64) -> Result<()> {
        self.share = self.share_at(time);
        self.wrenches.fill(Wrench::default());
        Ok(())
    }
    fn bounds(&self) -> Vec<Aabb> {
        self.zones.iter().map(|zone| zone.extent).collect()
    }
    fn is_field(&self) -> bool {
        true
    }
    fn act_as_field(&mut self, dt: f64, nodes: &mut NodeBatch) -> Result<()> {
        for (zone, wrench) in self.zones.iter().zip(&mut self.wrenches) {
            let taken = zone.rate * dt / (1.0 + zone.rate * dt);
            for ((u, &mass), &x) in nodes.velocity.iter_mut().zip(&nodes.mass).zip(&nodes.position) {
                if !zone.extent.contains(x) {
                    continue;
                }
                let velocity = zone.field.at(x).map(|v| self.share * v);
                for d in 0..self.axes {
                    let gain = taken * (velocity[d] - u[d]);
                    u[d] += gain;
                    wrench.force[d] -= mass * gain / dt;
                }
            }
        }
        Ok(())
    }
    fn device_law(&self) -> Option<DeviceLaw> {
        // What a record says changes from step to step, and the table does not.
        if self.on_host || !self.record.is_empty() {
            return None;
        }
        let of_zone = |zone: &Zone| {
            let (spin, [x, y, z]) = match zone.field {
                Field::Uniform(velocity) => (0.0, velocity),
                Field::Whirl(_, spin) => (spin, [0.0; 3]),
            };
            [[zone.rate, spin, self.axes as f64, 0.0], [x, y, z, 0.0]].map(|row| row.map(|x| x as f32))
        };
        let table = self.zones.iter().flat_map(of_zone).collect();
        Some(DeviceLaw { counted: true, wgsl: WGSL.to_owned(), table, ..DeviceLaw::default() })
    }
    fn book(&mut self, wrenches: &[Wrench]) {
        self.wrenches.copy_from_slice(wrenches);
    }
    fn after_step(&mut self, _: f64, _: f64) -> Result<()> {
        Ok(())
    }
    fn wrenches(&self) -> &[Wrench] {
        &self.wrenches
    }
    fn distance(&self, points: &[Vec3]) -> Vec<f64> {
        vec![f64::INFINITY; points.len()]
    }
    fn act(&mut self, body: &str, command: &Command) -> Result<()> {
        Err(Error::Body {
            path: format!("coupling '{}'", self.name),
            what: format!("'{body}' stays where it is, and {} is asked for", command.name()),
            mend: "move a tool instead".to_owned(),
        })
    }
    fn warnings(&self, _: f64) -> Vec<String> {
        Vec::new()
    }
    fn save(&self) -> Vec<u8> {
        self.wrenches.iter().flat_map(|wrench| wrench.force).flat_map(f64::to_le_bytes).collect()
    }
    fn restore(&mut self, bytes: &[u8]) -> Result<(), String> {
        let wanted = 24 * self.wrenches.len();
        if bytes.len() != wanted {
            return Err(format!("{} bytes where {wanted} were written", bytes.len()));
        }
        let numbers: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
        for (wrench, force) in self.wrenches.iter_mut().zip(numbers.as_chunks::<3>().0) {
            wrench.force = *force;
        }
        Ok(())
    }
}
