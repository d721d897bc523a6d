//! The height of the ground in columns, as arrays and as a picture.

use super::npz::Npz;
use crate::accuracy::{Grain, HeightMap};
use barchan_core::file::write_whole;
use barchan_core::{Result, Simulation};
use std::path::Path;

/// A height map of a moment, to be written.
#[derive(Clone, Debug)]
pub struct HeightFile {
    map: HeightMap,
    /// Width of a column [m].
    spacing: f64,
    /// Simulated time [s].
    time: f64,
}

/// The height of the ground of a whole world in square columns `spacing` [m] wide, the particles of all bodies together; see [`HeightMap`].
pub fn height_map(simulation: &Simulation, spacing: f64) -> HeightFile {
    let grains: Vec<Grain> = simulation.spots().iter().map(Grain::of).collect();
    let mut map = HeightMap::new(&grains, &simulation.plan().scene.world, spacing);
    // A column that is only in part within reach is not full.
    map.put_in(|columns| simulation.untouched_heights(columns, 0.5 * spacing));
    HeightFile { map, spacing, time: simulation.time() }
}

impl HeightFile {
    /// The heights.
    pub fn map(&self) -> &HeightMap {
        &self.map
    }

    /// Writes arrays: `height` [m], row j at `y[j]`, column i at `x[i]` (middles of columns [m]); `spacing` [m] and `time` [s].
    ///
    /// # Errors
    /// [`Error::Io`](barchan_core::Error::Io) if it cannot be written.
    pub fn write_npz(&self, path: impl AsRef<Path>) -> Result<()> {
        let [nx, ny] = self.map.count();
        let x: Vec<f64> = (0..nx).map(|i| self.map.at(i)[0]).collect();
        let y: Vec<f64> = (0..ny).map(|j| self.map.at(j * nx)[1]).collect();
        write_whole(path.as_ref(), "writing a height map", |out| {
            let mut archive = Npz::new(out);
            archive.reals("height", &[ny, nx], self.map.heights())?;
            archive.reals("x", &[nx], &x)?;
            archive.reals("y", &[ny], &y)?;
            archive.reals("spacing", &[], &[self.spacing])?;
            archive.reals("time", &[], &[self.time])?;
            archive.finish()
        })
    }

    /// Writes a grey picture of 16 bits as seen from above, x to the right and y up: 0 is the lowest column, 65535 the highest. Both heights [m] stand
    /// in the picture's texts `lowest [m]` and `highest [m]`.
    ///
    /// # Errors
    /// [`Error::Io`](barchan_core::Error::Io) if it cannot be written.
    #[cfg(feature = "pictures")]
    pub fn write_png(&self, path: impl AsRef<Path>) -> Result<()> {
        let [nx, ny] = self.map.count();
        let heights = self.map.heights();
        let [lowest, highest] = [
            heights.iter().copied().fold(f64::INFINITY, f64::min),
            heights.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        ];
        let scale = if highest > lowest { f64::from(u16::MAX) / (highest - lowest) } else { 0.0 };
        let grey = |z: &f64| (((z - lowest) * scale).round() as u16).to_be_bytes();
        let data: Vec<u8> = heights.chunks(nx).rev().flatten().flat_map(grey).collect();
        write_whole(path.as_ref(), "writing a height map", |out| {
            let mut encoder = png::Encoder::new(out, nx as u32, ny as u32);
            encoder.set_color(png::ColorType::Grayscale);
            encoder.set_depth(png::BitDepth::Sixteen);
            encoder.add_text_chunk("lowest [m]".to_owned(), lowest.to_string())?;
            encoder.add_text_chunk("highest [m]".to_owned(), highest.to_string())?;
            encoder.write_header()?.write_image_data(&data)?;
            Ok(())
        })
    }

    /// Refuses: it takes the feature `pictures`.
    ///
    /// # Errors
    /// [`Error::Missing`](barchan_core::Error::Missing).
    #[cfg(not(feature = "pictures"))]
    pub fn write_png(&self, _: impl AsRef<Path>) -> Result<()> {
        Err(barchan_core::Error::Missing {
            kind: "crate",
            name: env!("CARGO_PKG_NAME").to_owned(),
            origin: "built without the feature 'pictures'".to_owned(),
            what: "pictures".to_owned(),
            why: "output.height_map.png asks for some".to_owned(),
            mend: "build it with that feature, or leave output.height_map.png out".to_owned(),
        })
    }
}
