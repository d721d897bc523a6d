//! What a terrain must hold.

use crate::Result;
use crate::scene::terrain::highest_dunes;
use crate::scene::{Scene, Surface, Terrain};

/// Steeper ground is a wall.
const STEEPEST_DEG: f64 = 60.0;
/// Rigid stairs are a box for each step, and contact looks at all of them.
const MOST_STEPS: u32 = 1000;
/// A lee that is less steep is none.
const LEAST_LEE_DEG: f64 = 1.0;

impl Scene {
    pub(super) fn check_terrain(&self, path: &str, terrain: &Terrain) -> Result<()> {
        let Terrain { min, max, bottom, .. } = terrain;
        self.check_rectangle(path, *min, *max)?;
        self.check_surface(&format!("{path}.surface"), terrain.surface)?;
        let [_, top] = terrain.heights().within(*min, *max);
        self.require(
            top > *bottom,
            &format!("{path}.bottom"),
            format!("is {bottom}, and the surface nowhere rises above {top}"),
            "lower bottom or raise origin",
        )
    }

    fn check_surface(&self, path: &str, surface: Surface) -> Result<()> {
        match surface {
            Surface::Flat => Ok(()),
            Surface::Slope { slope_deg, .. } => self.require(
                slope_deg.abs() <= STEEPEST_DEG,
                &format!("{path}.slope.slope_deg"),
                format!("is {slope_deg}"),
                format!("must be from -{STEEPEST_DEG} to {STEEPEST_DEG}"),
            ),
            Surface::Dunes { wavelength, height, lee_deg, .. } => {
                let path = format!("{path}.dunes");
                self.positive(&format!("{path}.wavelength"), wavelength)?;
                self.positive(&format!("{path}.height"), height)?;
                self.require(
                    (LEAST_LEE_DEG..=STEEPEST_DEG).contains(&lee_deg),
                    &format!("{path}.lee_deg"),
                    format!("is {lee_deg}"),
                    format!("must be from {LEAST_LEE_DEG} to {STEEPEST_DEG}"),
                )?;
                let most = highest_dunes(wavelength, lee_deg);
                self.require(
                    height <= most,
                    &format!("{path}.height"),
                    format!("is {height}: so high and {wavelength} m apart, dunes are steeper than {lee_deg} degrees"),
                    format!("must be at most {most:.4}, or raise wavelength or lee_deg"),
                )
            }
            Surface::Bumps { wavelength, height, .. } => {
                self.positive(&format!("{path}.bumps.wavelength"), wavelength)?;
                self.positive(&format!("{path}.bumps.height"), height)
            }
            Surface::Stairs { run, rise, count, .. } => {
                let path = format!("{path}.stairs");
                self.positive(&format!("{path}.run"), run)?;
                self.require(rise != 0.0, &format!("{path}.rise"), "is 0", "give a height, below 0 to go down")?;
                self.require(
                    (1..=MOST_STEPS).contains(&count),
                    &format!("{path}.count"),
                    format!("is {count}"),
                    format!("must be from 1 to {MOST_STEPS}"),
                )
            }
        }
    }
}
