//! What is written of the ground: at an interval, on a grid that can be made.

use crate::Result;
use crate::scene::Scene;

/// Bins of the largest height map: columns times layers.
const MOST_BINS: f64 = 2e8;

impl Scene {
    pub(super) fn check_ground_output(&self) -> Result<()> {
        let cell = self.world.cell;
        let spacing = |path: &str, spacing: Option<f64>| {
            let spacing = spacing.unwrap_or(cell);
            self.require(
                spacing >= 0.5 * cell && spacing.is_finite(),
                &format!("{path}.spacing"),
                format!("is {spacing} m"),
                format!("must be half a cell, {} m, or more: particles lie that far apart", 0.5 * cell),
            )?;
            Ok(spacing)
        };
        if let Some(surface) = &self.output.surface {
            self.positive("output.surface.interval", surface.interval)?;
            spacing("output.surface", surface.spacing)?;
        }
        if let Some(map) = &self.output.height_map {
            self.positive("output.height_map.interval", map.interval)?;
            let wide = spacing("output.height_map", map.spacing)?;
            let bins: f64 = (0..3).map(|d| ((self.world.max[d] - self.world.min[d]) / wide).max(1.0)).product();
            self.require(
                bins <= MOST_BINS,
                "output.height_map.spacing",
                format!("is {wide} m, which makes {bins:.1e} bins of the world, in columns and layers"),
                format!(
                    "{MOST_BINS:.0e} are the most: make it {:.3} m or more",
                    1.001 * wide * (bins / MOST_BINS).cbrt()
                ),
            )?;
        }
        Ok(())
    }
}
