//! What the levels follow, and the boxes that come of it.

use super::Plan;
use crate::levels::{Agent, CellBox, Followed, link_of};
use crate::scene::{AgentPart, LevelAgent, Scene};
use crate::{Aabb, Coupling, Error, ParticleState, Result};

/// What the levels follow: what the scene names, or else what couplings move; and the boxes that stay.
pub(super) fn agents(scene: &Scene, couplings: &[Box<dyn Coupling>]) -> Result<Vec<Agent>> {
    let half = scene.levels.half;
    let boxes = scene.levels.boxes.iter().map(|one| Followed::Fixed(Aabb { min: one.min, max: one.max }));
    let fixed = boxes.map(|one| Agent::around(one, half));
    let Some(named) = &scene.levels.agents else {
        let followed = couplings.iter().flat_map(|coupling| coupling.followed());
        return Ok(followed.map(|name| Agent::around(Followed::Rigid(vec![name]), half)).chain(fixed).collect());
    };
    let bodies: Vec<String> = couplings.iter().flat_map(|coupling| coupling.bodies()).map(|body| body.name).collect();
    let named = named.iter().enumerate().map(|(i, agent)| {
        Ok(Agent {
            followed: followed(scene, &bodies, i, agent)?,
            half: agent.half.unwrap_or(half),
            lowest: agent.at == AgentPart::Lowest,
            offset: agent.offset,
        })
    });
    named.chain(fixed.map(Ok)).collect()
}

/// What an entry of `levels.agents` names. `bodies` are those that couplings move.
fn followed(scene: &Scene, bodies: &[String], i: usize, agent: &LevelAgent) -> Result<Followed> {
    let LevelAgent { name, at, .. } = agent;
    let links = || bodies.iter().filter_map(|body| link_of(name, body));
    let soft = || scene.body.iter().position(|body| body.name == *name);
    let is_rigid = bodies.contains(name);
    let path = format!("levels.agents[{i}]");
    if !is_rigid && soft().is_none() {
        return Err(Error::Unknown {
            path: scene.place(&path),
            kind: "tool, link or body of this scene",
            name: name.clone(),
            known: bodies.to_vec(),
        });
    }
    match at {
        AgentPart::Link(link) => {
            let path = format!("{path}.at");
            if links().next().is_none() {
                let what = if !is_rigid {
                    "a soft body"
                } else if scene.tool.iter().any(|tool| tool.name == *name) {
                    "a tool"
                } else {
                    "no robot with links"
                };
                return Err(scene.fault(
                    &path,
                    format!("names the link '{link}', and '{name}' is {what}"),
                    "write \"origin\" or \"lowest\", or leave it out",
                ));
            }
            match links().find(|known| known == link) {
                Some(_) => Ok(Followed::Rigid(vec![format!("{name}/{link}")])),
                None => Err(Error::Unknown {
                    path: scene.place(&path),
                    kind: "link of that robot",
                    name: link.clone(),
                    known: links().map(str::to_owned).collect(),
                }),
            }
        }
        // The lowest point of a robot is where its feet are.
        AgentPart::Lowest if is_rigid => {
            let own = bodies.iter().filter(|body| *body == name || link_of(name, body).is_some());
            Ok(Followed::Rigid(own.cloned().collect()))
        }
        _ if is_rigid => Ok(Followed::Rigid(vec![name.clone()])),
        _ => Ok(Followed::Soft(soft().unwrap_or(0) as u16)),
    }
}

/// An agent's boxes at the start.
pub(super) struct Boxes {
    /// What they follow.
    pub name: String,
    /// The key that asks for them.
    pub because: String,
    /// Their sizes, and the particles in them, finest first.
    pub sizes: String,
}

impl Plan {
    /// The boxes of each agent at the start, with what is in them of these particles.
    pub(super) fn list_boxes(&self, particles: &ParticleState) -> Vec<Boxes> {
        let levels = &self.scene.levels;
        let boxes = self.regions.boxes().first().map_or(0, Vec::len);
        let (mut present, mut fixed) = (0, 0);
        let mut all = Vec::new();
        for (i, agent) in self.agents.iter().enumerate() {
            let named = levels.agents.as_ref().and_then(|agents| agents.get(i));
            let name = match (&agent.followed, named) {
                (Followed::Fixed(_), _) => {
                    fixed += 1;
                    format!("levels.box[{}]", fixed - 1)
                }
                (_, Some(LevelAgent { name, at: AgentPart::Link(link), .. })) => format!("{name}/{link}"),
                (_, Some(LevelAgent { name, .. })) => name.clone(),
                (Followed::Rigid(names), None) => names.join(", "),
                (Followed::Soft(body), None) => self.scene.body[usize::from(*body)].name.clone(),
            };
            let because = match (&agent.followed, named) {
                (Followed::Fixed(_), _) => name.clone(),
                (_, Some(LevelAgent { half, offset, at, .. })) => {
                    let half = half.map(|half| format!("half = {half}"));
                    let offset = (*offset != [0.0; 3]).then(|| format!("offset = {offset:?}"));
                    let at = (*at != AgentPart::Origin).then(|| format!("at = \"{at}\""));
                    let more: Vec<String> = [half, offset, at].into_iter().flatten().collect();
                    let more = if more.is_empty() { String::new() } else { format!(": {}", more.join(", ")) };
                    format!("levels.agents[{i}]{more}")
                }
                _ => "no levels.agents, and it moves".to_owned(),
            };
            // A soft body that has no particles any more has no box.
            let is_here = match agent.followed {
                Followed::Soft(soft) if boxes < self.agents.len() => {
                    particles.lists.iter().any(|list| list.body.contains(&soft))
                }
                _ => true,
            };
            let sizes = if is_here { self.sizes(present, particles) } else { "none without particles".to_owned() };
            present += usize::from(is_here);
            all.push(Boxes { name, because, sizes });
        }
        all
    }

    /// Sizes of an agent's box on each level, with the particles of the level that are in it.
    fn sizes(&self, agent: usize, particles: &ParticleState) -> String {
        let of_level = |(level, boxes): (usize, &Vec<CellBox>)| {
            let one = boxes.get(agent)?;
            let cells = particles.lists.iter().filter(|list| list.level as usize == level).flat_map(|list| &list.cell);
            let count = self.regions.count_in(level, agent, cells)?;
            let [x, y, z] = [0, 1, 2].map(|d| one.max[d] - one.min[d]);
            let size = if x == y && y == z { format!("{x}³") } else { format!("{x} x {y} x {z}") };
            Some(format!("{size} cells of {} m with {count} particles", self.cell_widths[level]))
        };
        self.regions.boxes().iter().enumerate().filter_map(of_level).collect::<Vec<_>>().join(", ")
    }
}
