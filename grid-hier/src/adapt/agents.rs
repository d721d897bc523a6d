//! Where agents are, and how far they may go before levels move after them.

use super::Adapt;
use barchan_core::levels::{Agent, Followed, Leeway, targets};
use barchan_core::{Aabb, Coupling, Regions};

impl Adapt {
    /// Moves the levels' boxes after their agents; `soft` gives the box around a soft body [m]. Returns the regions as they were if any
    /// has moved.
    pub fn follow(&mut self, couplings: &[Box<dyn Coupling>], soft: impl Fn(u16) -> Option<Aabb>) -> Option<Regions> {
        if self.widths.len() == 1 {
            return None;
        }
        let targets = targets(&self.agents, couplings, soft);
        let before = self.regions.clone();
        self.regions.follow(&targets).then_some(before)
    }

    /// Whether the boxes have to move after these bodies.
    pub fn must_follow(&self, couplings: &[Box<dyn Coupling>], soft: impl Fn(u16) -> Option<Aabb>) -> bool {
        self.widths.len() > 1 && self.regions.clone().follow(&targets(&self.agents, couplings, soft))
    }

    /// Whether levels follow all of a coupling's body. If so, nothing coarser than the finest level comes near it.
    pub fn follows(&self, name: &str) -> bool {
        self.agents.iter().any(|agent| agent.surrounds() && agent.is_of(name))
    }

    /// For each agent that couplings move, how far along each axis its bodies may move before boxes have to move after them [m].
    pub fn leashes(&self, couplings: &[Box<dyn Coupling>], soft: impl Fn(u16) -> Option<Aabb>) -> Vec<(&Agent, Aabb)> {
        if self.widths.len() == 1 {
            return Vec::new();
        }
        let targets = targets(&self.agents, couplings, &soft);
        let present = self.agents.iter().filter(|agent| is_here(agent, &soft)).zip(targets).enumerate();
        let rigid = present.filter(|(_, (agent, _))| matches!(agent.followed, Followed::Rigid(_)));
        rigid.map(|(i, (agent, target))| (agent, self.regions.leash(i, &target.bounds))).collect()
    }

    /// For each soft body that agents are, in order: where its cells may end before boxes have to move; `None` for one without
    /// particles.
    pub fn leeways(&self, soft: impl Fn(u16) -> Option<Aabb>) -> Vec<Option<Leeway>> {
        let (mut leeways, mut present): (Vec<(u16, Option<Leeway>)>, usize) = (Vec::new(), 0);
        for agent in &self.agents {
            let is_here = is_here(agent, &soft);
            if let Followed::Soft(body) = agent.followed {
                let own = is_here.then(|| agent.leeway(self.regions.leeway(present), self.widths[0]));
                match leeways.iter_mut().find(|(known, _)| *known == body) {
                    Some((_, all)) => *all = all.zip(own).map(|(all, own)| all.and(own)),
                    None => leeways.push((body, own)),
                }
            }
            present += usize::from(is_here);
        }
        leeways.into_iter().map(|(_, leeway)| leeway).collect()
    }
}

/// A soft body without particles has no boxes.
fn is_here(agent: &Agent, soft: &impl Fn(u16) -> Option<Aabb>) -> bool {
    !matches!(agent.followed, Followed::Soft(body) if soft(body).is_none())
}
