//! What the user should know.

use super::Plan;
use crate::levels::{AROUND_AGENT, Agent, CellBox, DEAD_ZONE, Followed, LEAST_DEPTH, targets};
use crate::scene::{Body, Motion, OverBound, Probe, Shape, Tool, named_together, plain};
use crate::{Aabb, Coupling, Registry, Result, Vec3};

/// Fine cells that should lie below a tool before a rim: a sphere pressed into elastic ground, its box's half side 12, 10 and 8 cells, felt 0.1, 1.4 and
/// 7.5 % more than in fine ground throughout.
const LEAST_BELOW: f64 = 6.0;

/// Friction angle above which a cone matched in triaxial compression never fails in plane strain [rad]: there
/// 2 sqrt(3) sin(phi) / (3 - sin(phi)) = 1.
const NO_PLANE_STRAIN_FAILURE: f64 = 0.736_9;

/// Poisson's ratio above which the pressure of a displacement-only method checkers.
const NEARLY_INCOMPRESSIBLE: f64 = 0.49;

impl Plan {
    pub(super) fn warn(&mut self, registry: &Registry, couplings: &[Box<dyn Coupling>]) -> Result<()> {
        let mut warnings = registry.warnings().to_vec();
        for planned in &self.materials {
            let name = &planned.name;
            match planned.poisson_ratio()? {
                Some(nu) if nu > NEARLY_INCOMPRESSIBLE => warnings.push(format!(
                    "material '{name}': Poisson's ratio {nu:.4} is above {NEARLY_INCOMPRESSIBLE}: pressure checkers from cell to cell and the time step collapses; lower it"
                )),
                _ => {}
            }
            if planned.material.table.tangent_moduli_f32.is_none() {
                warnings.push(format!(
                    "material '{name}': its law gives no tangent moduli, so nothing checks that time.step is stable"
                ));
            }
            let matched_in_triaxial_compression = planned.parameter("cone").unwrap_or(0.0) == 0.0;
            match planned.parameter("friction_angle") {
                Some(phi) if phi > NO_PLANE_STRAIN_FAILURE && matched_in_triaxial_compression => warnings.push(format!(
                    "material '{name}': a friction angle of {:.2} deg is above 42.22 deg, where a cone matched in triaxial compression has no shear failure in plane strain: sin(phi_ps) = 2 sqrt(3) sin(phi) / (3 - sin(phi)) would be above 1, and a vertical face stands; lower it, or set cone = 1",
                    phi.to_degrees()
                )),
                _ => {}
            }
        }
        for (level, (cells, width)) in self.ground_cells.iter().zip(&self.cell_widths).enumerate() {
            // Volumes add up to whole cells but for rounding.
            let Some(cells) = cells.filter(|cells| *cells < LEAST_DEPTH - 1e-4) else { continue };
            let finer = (1e5 * self.cell_widths[0] * cells / LEAST_DEPTH + 1e-3).floor() / 1e5;
            let fewer = if level > 0 { format!("set levels.count = {level}, or ") } else { String::new() };
            warnings.push(format!(
                "level {level}: where it has the surface, the ground is {cells:.2} cells of {width} m deep, and fewer than {LEAST_DEPTH} neither bear nor flow as deep ground does; {fewer}set world.cell to {finer} or less"
            ));
        }
        if self.cell_widths.len() > 1 && self.agents.is_empty() && !self.materials.is_empty() {
            warnings.push(format!(
                "levels: nothing moves, and neither levels.agents nor levels.box names what is to have fine cells, so that all cells are {} m wide; name it, or leave levels out",
                self.cell_widths[self.cell_widths.len() - 1]
            ));
        }
        warnings.extend(self.near_rims(couplings));
        warnings.extend(self.steeper_than_repose());
        warnings.extend(self.probes_beyond());
        if self.scene.world.plane_strain.is_some() && self.scene.gravity[1] != 0.0 {
            warnings.push(format!(
                "gravity: its part along y, {} m/s², does nothing in plane strain, where nothing moves along y; set it to 0, or take out world.plane_strain",
                self.scene.gravity[1]
            ));
        }
        let time = &self.scene.time;
        let step = time.step.unwrap_or(0.0);
        if step > self.bound.dt && time.over_bound != OverBound::Refuse {
            warnings.push(format!(
                "time.step = {step} is above the bound {:.3e} s set by {}; {}",
                self.bound.dt,
                self.bound.by,
                if time.over_bound == OverBound::Substep {
                    "each step is cut"
                } else {
                    "it is taken all the same, and energy is watched"
                }
            ));
        }
        // Where there is no ground, nothing is too thin for its cells.
        let cell_width = if self.materials.is_empty() { 0.0 } else { self.scene.world.cell };
        warnings.extend(couplings.iter().flat_map(|c| c.warnings(cell_width)));
        self.warnings.extend(warnings);
        self.warnings.iter_mut().for_each(|warning| *warning = plain(warning));
        Ok(())
    }

    /// Says which terrains start to slide as soon as they are there.
    fn steeper_than_repose(&self) -> Vec<String> {
        let bodies = self.scene.body.iter().enumerate();
        let warning = |(i, body): (usize, &Body)| {
            let Shape::Terrain(terrain) = &body.shape else { return None };
            let planned = self.materials.iter().find(|planned| planned.name == body.material)?;
            let (slope, friction) = (terrain.heights().steepest().atan(), planned.parameter("friction_angle")?);
            // Cohesion holds any slope of some height.
            let holds = slope <= friction || planned.parameter("cohesion").unwrap_or(0.0) > 0.0;
            (!holds).then(|| {
                format!(
                    "body[{i}]: its surface is up to {:.1} deg steep, and material '{}' slides above its friction angle of {:.1} deg; make it less steep, or wait until it has slid",
                    slope.to_degrees(),
                    planned.name,
                    friction.to_degrees()
                )
            })
        };
        bodies.filter_map(warning).collect()
    }

    /// Says which probes look where no ground ever is.
    fn probes_beyond(&self) -> Vec<String> {
        let world = &self.scene.world;
        // Until they are sorted, particles that went over a periodic side stand a cell beyond it.
        let coarsest = self.cell_widths[self.cell_widths.len() - 1];
        let over = |d: usize| if world.is_periodic(d) { coarsest } else { 0.0 };
        let is_beyond =
            |min: Vec3, max: Vec3| (0..3).any(|d| max[d] < world.min[d] - over(d) || min[d] > world.max[d] + over(d));
        // Heights are those of a point's image within the world.
        let point_is_beyond = |point: [f64; 2]| {
            (0..2).any(|d| !world.is_periodic(d) && (point[d] < world.min[d] || point[d] > world.max[d]))
        };
        let part = |probe: &Probe| match probe {
            Probe { flux: Some(section), .. } => {
                let Aabb { min, max } = section.bounds();
                is_beyond(min, max).then(|| "flux".to_owned())
            }
            Probe { within: Some(region), .. } => {
                let Aabb { min, max } = region.bounds();
                is_beyond(min, max).then(|| "within".to_owned())
            }
            Probe { wall: Some(part), .. } => {
                let (axis, _) = part.side.axis();
                let [mut min, mut max] = part.corners();
                (min[axis], max[axis]) = (world.min[axis], world.max[axis]);
                is_beyond(min, max).then(|| "wall".to_owned())
            }
            Probe { surface: Some(surface), .. } => surface
                .places()
                .into_iter()
                .find(|point| point_is_beyond(*point))
                .map(|point| format!("surface, at {point:?},")),
            _ => None,
        };
        let warning = |probe: &Probe| {
            part(probe).map(|part| {
                format!(
                    "probe '{}': its {part} is outside the world, from {:?} to {:?}, and measures nothing there; move it, or widen world.min and world.max",
                    probe.name, world.min, world.max
                )
            })
        };
        self.scene.probe.iter().filter_map(warning).collect()
    }

    /// Says which tools have too little fine ground below them when they press it, wherever in its box the tool is: a box follows only once its agent is out of
    /// the dead zone.
    fn near_rims(&self, couplings: &[Box<dyn Coupling>]) -> Vec<String> {
        let Some(boxes) = self.regions.boxes().first() else { return Vec::new() };
        let (h, world) = (self.scene.world.cell, &self.scene.world);
        let ends = |body: &Body| body.shape.bounds().map_or([world.min[2], world.max[2]], |b| [b.min[2], b.max[2]]);
        let ground = self.scene.body.iter().map(ends).reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
        let Some([bottom, top]) = ground else { return Vec::new() };
        let own_half = |i: usize| {
            self.scene.levels.agents.as_ref().is_some_and(|all| all.get(i).is_some_and(|own| own.half.is_some()))
        };
        let warning = |(i, (agent, around)): (usize, (&Agent, &CellBox))| {
            let Followed::Rigid(names) = &agent.followed else { return None };
            let bounds_of = |agent: &Agent| {
                targets(std::slice::from_ref(agent), couplings, |_| None).first().map(|target| target.bounds)
            };
            let (followed, bounds) =
                (bounds_of(agent)?, bounds_of(&Agent::around(agent.followed.clone(), agent.half))?);
            let tall = 0.5 * (followed.max[2] - followed.min[2]) / h;
            // How far its lowest point is below what its box stands around.
            let deeper = (followed.min[2] - bounds.min[2]) / h;
            let is_fixed = |tool: &Tool| names.contains(&tool.name) && matches!(tool.motion, Motion::Fixed);
            let below = if self.scene.tool.iter().any(is_fixed) {
                bounds.min[2] / h - f64::from(around.min[2])
            } else {
                (0.5 * f64::from(around.max[2] - around.min[2]) - tall - 2.0 * DEAD_ZONE).max(AROUND_AGENT) - deeper
            };
            // Where it touches the ground, the rim may lie below all of it.
            if below >= LEAST_BELOW - 1e-6 || bounds.min[2].min(top) - below * h < bottom + 0.5 * h {
                return None;
            }
            let half = 2.0 * (0.5 * (tall + deeper + LEAST_BELOW + 2.0 * DEAD_ZONE) - 1e-6).ceil();
            let key = if own_half(i) { format!("levels.agents[{i}].half") } else { "levels.half".to_owned() };
            Some((names.first()?.clone(), (format!("{below:.1}"), format!("{key} = {half}"))))
        };
        let sentence = |(names, several, (below, mend)): (String, bool, (String, String))| {
            let (points, them) = if several { ("points", "them") } else { ("point", "it") };
            format!(
                "levels: there may be as few as {below} fine cells between the lowest {points} of {names} and the rim below {them}; with fewer than {LEAST_BELOW} the coarse ground beyond stiffens what is felt there; set {mend} or more"
            )
        };
        let all = self.agents.iter().zip(boxes).enumerate().filter_map(warning);
        named_together(all).into_iter().map(sentence).collect()
    }
}
