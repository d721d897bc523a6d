//! What the host knows of the worlds of a batch: their levels, what rests in them, how stiff they are, and what was summed up. Nothing here talks to the
//! device.

pub(crate) mod sleep;
pub(crate) mod soft;
pub(crate) mod stiffness;
pub(crate) mod world;

use crate::device::uniforms::{Layer, WorldCells};
use crate::device::{Gpu, lacks, layout};
use crate::passes::couplings::Laws;
use crate::passes::scene;
use barchan_core::backend::NewWorld;
use barchan_core::{Coupling, Error, ParticleList, Plan, Result, Vec3};
use barchan_grid::adapt::finest_volumes;

/// What all worlds of a batch must have in common.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Fixed {
    pub(crate) world: (String, WorldCells),
    /// When it has grown [m/s²], and over what time it grows [s].
    pub(crate) gravity: (Vec3, f64),
    pub(crate) laws: Vec<(String, String, bool)>,
    /// How many there are, steps of the finest in one of the coarsest, boxes of each, and soft bodies that they follow.
    pub(crate) levels: (usize, u32, usize, Vec<u16>),
    /// Of the finest particles of each body, if there are several levels [m³].
    pub(crate) volumes: Vec<f64>,
    /// Sections of probes, and these with the parts of walls that probes ask about.
    pub(crate) sections: usize,
    pub(crate) probed: usize,
}

impl Fixed {
    pub(crate) fn of(plan: &Plan) -> Self {
        let law = |m: &barchan_core::plan::PlannedMaterial| {
            (m.material.name.clone(), m.material.origin.clone(), m.damping.is_some())
        };
        Self {
            world: (scene::constants(plan), scene::world_cells(plan)),
            gravity: (plan.scene.gravity, plan.scene.gravity_ramp),
            laws: plan.materials.iter().map(law).collect(),
            levels: (plan.cell_widths.len(), plan.substeps, scene::boxes(plan), scene::softs(plan)),
            volumes: if plan.cell_widths.len() > 1 { finest_volumes(plan) } else { Vec::new() },
            sections: plan.scene.sections().count(),
            probed: plan.scene.sections().count() + plan.scene.wall_parts().count(),
        }
    }

    /// Refuses a world that differs, by name.
    pub(crate) fn check(&self, plan: &Plan, world: usize) -> Result<()> {
        let other = Self::of(plan);
        let differs = |what, mend| Err(differs(what, world, mend));
        const MEND: &str = "give all worlds the same, or run them on the backend cpu";
        if other.world != self.world {
            return differs("cell width, extent, walls, world.leaving, what sleeps, or what materials keep", MEND);
        }
        if other.laws != self.laws {
            return differs("their materials' laws, or which of these are damped", MEND);
        }
        if other.levels != self.levels {
            return differs("levels.count, levels.subcycle, or the number or the soft ones of levels.agents", MEND);
        }
        if other.volumes != self.volumes {
            return differs("how many bodies they have on levels, or how finely these are sampled", MEND);
        }
        if (other.sections, other.probed) != (self.sections, self.probed) {
            return differs("how many probes of flux and of walls they have", MEND);
        }
        if other.gravity != self.gravity {
            return differs("gravity", MEND);
        }
        Ok(())
    }
}

fn differs(what: &str, world: usize, mend: &str) -> Error {
    let what = format!("batch of worlds that differ in {what}");
    lacks(what, format!("world {world} does not have that of the first"), mend)
}

/// The texts of the laws that bodies of a batch follow on the device, as far as a world has such: how they grip, and how they answer. They are the same in all worlds,
/// since numbers may be rounded otherwise in another text, or on the host, and a world would not be what it is alone.
#[derive(Clone, Debug, Default)]
pub(crate) struct LawTexts {
    grip: Option<String>,
    answer: Option<String>,
}

impl LawTexts {
    /// Takes up those of a world, or refuses it.
    pub(crate) fn take_up(&mut self, couplings: &[Box<dyn Coupling>], world: usize) -> Result<()> {
        let Some(laws) = Laws::of(couplings) else { return Ok(()) };
        let answer = laws.groups.iter().any(|groups| !groups.is_empty()).then_some(laws.answer);
        for (known, own) in [(&mut self.grip, Some(laws.wgsl)), (&mut self.answer, answer)] {
            if known.is_some() && own.is_some() && *known != own {
                return Err(differs(
                    "the kinds of their tools and robots",
                    world,
                    "give all worlds the same robots, as many tools that move freely beside others, of as many parts, and meshes or height fields in all or in none (what a world has no use for may be out of reach); or step such worlds in batches of their own, or on the backend cpu",
                ));
            }
            *known = own.or(known.take());
        }
        Ok(())
    }
}

/// What the worlds have in common, if it is enough for one batch.
pub(crate) fn check_together<'a>(gpu: &Gpu, worlds: &[NewWorld<'a>]) -> Result<(&'a Plan, Fixed, LawTexts)> {
    let Some(NewWorld { plan, .. }) = worlds.first() else {
        return Err(lacks("batch of no worlds", "none is given", "give one at least"));
    };
    let levels = plan.cell_widths.len();
    let fixed = Fixed::of(plan);
    worlds.iter().enumerate().try_for_each(|(w, world)| fixed.check(world.plan, w))?;
    let of_regions = 16 * scene::region_vectors(plan);
    let most = gpu.limits.max_uniform_buffer_binding_size as usize / (size_of::<Layer>() * levels).max(of_regions);
    if worlds.len() > most {
        return Err(Error::Capacity {
            what: "worlds in one batch of the adapter",
            asked: worlds.len() as u64,
            cap: most as u64,
            mend: "run fewer worlds together",
        });
    }
    worlds.iter().try_for_each(|world| layout::check(&world.particles, &world.plan.materials, levels))?;
    let particles: usize = worlds.iter().flat_map(|world| &world.particles.lists).map(ParticleList::len).sum();
    layout::check_count(particles, "simulate fewer, or use the backend cpu")?;
    let mut texts = LawTexts::default();
    if worlds.len() > 1 {
        worlds.iter().enumerate().try_for_each(|(w, world)| texts.take_up(world.couplings, w))?;
    }
    Ok((plan, fixed, texts))
}
