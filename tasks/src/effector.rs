//! A tool that an agent moves: the end of an arm, of which the arm is left out.

use barchan_core::registry::TaskSetup;
use barchan_core::scene::{Motion, Scene};
use barchan_core::task::{Limits, Part};
use barchan_core::{BodyState, Command, Error, Result, Simulation, Vec3};

/// What a degree of freedom moves along, or turns about, in the world's axes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// Along x, y or z.
    Along(usize),
    /// About x, y or z; a tool turns about one axis only.
    About(usize),
}

/// One degree of freedom of a tool.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Degree {
    pub(crate) way: Way,
    /// Most change in a control step [m or rad].
    pub(crate) most: f64,
    /// Between what it stays [m or rad].
    pub(crate) range: [f64; 2],
}

impl Degree {
    /// Along an axis, no nearer to the world's sides than so much [m].
    pub(crate) fn along(scene: &Scene, axis: usize, most: f64, keep: f64) -> Self {
        let [min, max] = [scene.world.min[axis] + keep, scene.world.max[axis] - keep];
        Self { way: Way::Along(axis), most, range: [min, f64::max(min, max)] }
    }
    /// About an axis, between two angles [rad].
    pub(crate) fn about(axis: usize, most: f64, range: [f64; 2]) -> Self {
        Self { way: Way::About(axis), most, range }
    }
}

/// A tool of the scene that is driven by velocity.
#[derive(Clone, Debug)]
pub(crate) struct Effector {
    tool: String,
    degrees: Vec<Degree>,
    interval: f64,
}

impl Effector {
    /// The tool of that name of a scene, which may be somebody's own.
    ///
    /// # Errors
    /// If the scene has none, or another one is asked to move it.
    pub(crate) fn new(
        setup: &TaskSetup<'_>,
        scene: &Scene,
        tool: &str,
        degrees: &[Degree],
        interval: f64,
    ) -> Result<Self> {
        let found = scene.tool.iter().find(|one| one.name == tool);
        if !found.is_some_and(|one| matches!(one.motion, Motion::Velocity { .. })) {
            return Err(setup.unfit(
                format!("the task moves a tool '{tool}', and no such tool of the scene is driven by velocity"),
                format!("add a [[tool]] with name = \"{tool}\" and motion = {{ velocity = {{}} }}"),
            ));
        }
        Ok(Self { tool: tool.to_owned(), degrees: degrees.to_vec(), interval })
    }

    /// What an action holds: the change of each degree of freedom in a control step.
    pub(crate) fn actions(&self) -> Vec<Limits> {
        self.degrees.iter().map(|degree| Limits::within(degree.way.name("d"), degree.most)).collect()
    }

    /// What of it an agent sees: each degree of freedom and its rate.
    pub(crate) fn part(&self) -> Part {
        let names: Vec<String> = self.degrees.iter().map(|degree| degree.way.name("")).collect();
        Part::new(format!("{} of '{}', and their rates [1/s]", names.join(", "), self.tool), 2 * self.degrees.len())
    }

    /// The tool as it is.
    ///
    /// # Errors
    /// If it is not there any more.
    pub(crate) fn body(&self, world: &Simulation) -> Result<BodyState> {
        world.bodies().into_iter().find(|body| body.name == self.tool).ok_or_else(|| Error::Body {
            path: format!("tool '{}'", self.tool),
            what: "it is no longer there".to_owned(),
            mend: "keep it as long as the task is played".to_owned(),
        })
    }

    /// Where it is [m]; the origin of the world if it is not there.
    pub(crate) fn position(&self, world: &Simulation) -> Vec3 {
        self.body(world).map(|body| body.position).unwrap_or_default()
    }

    /// The numbers of [`part`](Self::part).
    ///
    /// # Errors
    /// If it is not there any more.
    pub(crate) fn numbers(&self, world: &Simulation) -> Result<Vec<f64>> {
        let body = self.body(world)?;
        let all = self.degrees.iter();
        let places = all.clone().map(|degree| degree.way.of(&body));
        let rates = all.map(|degree| match degree.way {
            Way::Along(d) => body.velocity[d],
            Way::About(d) => body.angular_velocity[d],
        });
        Ok(places.chain(rates).collect())
    }

    /// Moves it by an action, but not out of its range.
    ///
    /// # Errors
    /// If it does not take the command.
    pub(crate) fn act(&self, world: &mut Simulation, action: &[f64]) -> Result<()> {
        let body = self.body(world)?;
        let (mut linear, mut angular) = ([0.0; 3], [0.0; 3]);
        for (degree, change) in self.degrees.iter().zip(action) {
            let now = degree.way.of(&body);
            let rate = ((now + change).clamp(degree.range[0], degree.range[1]) - now) / self.interval;
            match degree.way {
                Way::Along(d) => linear[d] = rate,
                Way::About(d) => angular[d] = rate,
            }
        }
        world.act(&self.tool, &Command::Twist { linear, angular })
    }

    /// The action that moves it towards these values of its degrees of freedom, as far as a control step goes.
    pub(crate) fn towards(&self, world: &Simulation, wanted: &[f64]) -> Vec<f64> {
        let Ok(body) = self.body(world) else { return vec![0.0; self.degrees.len()] };
        let left: Vec<f64> = self.degrees.iter().zip(wanted).map(|(degree, to)| to - degree.way.of(&body)).collect();
        // All get there at once, along a straight line.
        let slow = self.degrees.iter().zip(&left).map(|(degree, left)| left.abs() / degree.most).fold(1.0, f64::max);
        let within = |(degree, left): (&Degree, f64)| (left / slow).clamp(-degree.most, degree.most);
        self.degrees.iter().zip(left).map(within).collect()
    }

    /// Is it there, within so much [m or rad] in each degree of freedom?
    pub(crate) fn is_at(&self, world: &Simulation, wanted: &[f64], within: f64) -> bool {
        let Ok(body) = self.body(world) else { return false };
        self.degrees.iter().zip(wanted).all(|(degree, to)| (to - degree.way.of(&body)).abs() < within)
    }
}

impl Way {
    fn name(self, before: &str) -> String {
        match self {
            Self::Along(d) => format!("{before}{} [m]", ["x", "y", "z"][d]),
            Self::About(d) => format!("{before}{} [rad]", ["roll", "pitch", "yaw"][d]),
        }
    }

    /// Its value.
    fn of(self, body: &BodyState) -> f64 {
        match self {
            Self::Along(d) => body.position[d],
            Self::About(d) => 2.0 * body.rotation[1 + d].atan2(body.rotation[0]),
        }
    }
}

/// What a hand-written agent does one after the other: values of an effector's degrees of freedom, and how many control steps it waits there.
#[derive(Clone, Debug, Default)]
pub(crate) struct Path {
    stops: Vec<(Vec<f64>, u64)>,
    at: usize,
    waited: u64,
}

impl Path {
    pub(crate) fn new(stops: Vec<(Vec<f64>, u64)>) -> Self {
        Self { stops, at: 0, waited: 0 }
    }

    /// The action of the next control step; it stays at the last stop.
    pub(crate) fn next(&mut self, effector: &Effector, world: &Simulation) -> Vec<f64> {
        while let Some((stop, wait)) = self.stops.get(self.at) {
            if !effector.is_at(world, stop, NEAR) {
                return effector.towards(world, stop);
            }
            if self.waited < *wait {
                self.waited += 1;
                return vec![0.0; effector.degrees.len()];
            }
            (self.at, self.waited) = (self.at + 1, 0);
        }
        vec![0.0; effector.degrees.len()]
    }
}

/// A stop is reached within this [m or rad].
const NEAR: f64 = 1e-4;
