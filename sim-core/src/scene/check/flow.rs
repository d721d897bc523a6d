//! What sources and sinks must hold.

use super::AXES;
use crate::Result;
use crate::flow::SINK_STEPS;
use crate::scene::{Inflow, Outflow, Scene, Shape};

impl Scene {
    pub(super) fn check_flows(&self) -> Result<()> {
        self.unique("source", self.inflow.iter().map(|source| source.name.as_str()), false)?;
        self.unique("sink", self.outflow.iter().map(|sink| sink.name.as_str()), false)?;
        for (i, source) in self.inflow.iter().enumerate() {
            self.check_inflow(&format!("source[{i}]"), source)?;
        }
        for (i, sink) in self.outflow.iter().enumerate() {
            self.check_outflow(&format!("sink[{i}]"), sink)?;
        }
        Ok(())
    }

    fn check_inflow(&self, path: &str, source: &Inflow) -> Result<()> {
        self.check_material_name(&format!("{path}.material"), &source.material)?;
        self.check_flow(path, &source.shape, source.from, source.until)?;
        self.check_spacing(&format!("{path}.spacing"), self.inflow_spacing(source))?;
        if let Some(bounds) = source.shape.bounds() {
            self.check_inside(path, bounds)?;
        }
        self.require(
            source.velocity.iter().any(|v| *v != 0.0),
            &format!("{path}.velocity"),
            "is zero, so that nothing would leave the mouth",
            "give the velocity of what comes in [m/s]; for ground that is there at the start, use a body",
        )?;
        self.require(
            source.mass_rate.is_none() || source.volume_rate.is_none(),
            &format!("{path}.volume_rate"),
            "is given beside mass_rate",
            "give one of the two, or neither to let in as much as the mouth lets through",
        )?;
        for (key, value) in
            [("mass_rate", source.mass_rate), ("volume_rate", source.volume_rate), ("limit", source.limit)]
        {
            value.map_or(Ok(()), |value| self.positive(&format!("{path}.{key}"), value))?;
        }
        Ok(())
    }

    fn check_outflow(&self, path: &str, sink: &Outflow) -> Result<()> {
        if let Some(material) = &sink.material {
            self.check_material_name(&format!("{path}.material"), material)?;
        }
        self.check_flow(path, &sink.shape, sink.from, sink.until)?;
        let Some(bounds) = sink.shape.bounds() else { return Ok(()) };
        // Nothing moves more than half a cell of its level in a step.
        let (cells, cell) = (SINK_STEPS as f64 / 2.0, self.world.cell * f64::from(1 << (self.levels.count - 1)));
        for (d, axis) in AXES.into_iter().enumerate() {
            let thick = bounds.max[d] - bounds.min[d];
            self.require(
                thick >= cells * cell * (1.0 - super::WHOLE_CELL),
                &format!("{path}.shape"),
                format!("is {thick} m thick along {axis}, and ground could pass through it between two looks"),
                format!("make it at least {} m thick: {cells} cells of the coarsest level", cells * cell),
            )?;
        }
        Ok(())
    }

    /// What sources and sinks have in common.
    fn check_flow(&self, path: &str, shape: &Shape, from: f64, until: Option<f64>) -> Result<()> {
        self.check_fillable(&format!("{path}.shape"), shape)?;
        self.check_shape(&format!("{path}.shape"), shape)?;
        self.not_negative(&format!("{path}.from"), from)?;
        if let Some(until) = until {
            self.require(
                until > from,
                &format!("{path}.until"),
                format!("is {until} s, and from is {from} s"),
                "must be later than from",
            )?;
        }
        self.require(
            self.levels.reach == 0,
            path,
            "is in a scene with levels.reach, where ground out of reach is put away and brought back as it was at the start",
            "leave out levels.reach, or the sources and sinks",
        )
    }
}
