//! The part of a soft body that is of one material.

use crate::coupling::Aabb;
use crate::scene::{Zone, ZonePicture};
use crate::solid::Solid;
use crate::{Error, Result, Scene, Vec3};
use std::path::Path;
use std::sync::Arc;

/// A body's solid and the zones in it.
pub(crate) struct Zones {
    solid: Box<dyn Solid>,
    /// Index in the plan of the material where no zone holds.
    own: usize,
    /// The last first: the first that holds counts.
    zones: Vec<Ready>,
}

/// A zone, its material's index in the plan, and its picture.
struct Ready {
    zone: Zone,
    material: usize,
    map: Option<Map>,
}

impl Zones {
    /// The zones of a body of a scene; `index` gives the index of a material in the plan.
    ///
    /// # Errors
    /// For a picture that cannot be read or has colours.
    pub(crate) fn new(
        solid: Box<dyn Solid>,
        scene: &Scene,
        body: usize,
        own: usize,
        index: impl Fn(&str) -> Option<usize>,
    ) -> Result<Self> {
        let mut zones = Vec::new();
        for (i, zone) in scene.body[body].zone.iter().enumerate().rev() {
            let Some(material) = index(&zone.material) else { continue };
            let read = |picture| Map::read(picture, scene, &format!("body[{body}].zone[{i}].picture.file"));
            let map = zone.picture.as_ref().map(read).transpose()?;
            zones.push(Ready { zone: zone.clone(), material, map });
        }
        Ok(Self { solid, own, zones })
    }

    /// The material at a point of the solid.
    fn at(&self, x: Vec3) -> usize {
        let surface = self.solid.column(x[0], x[1]).map_or(f64::NEG_INFINITY, |[_, surface]| surface);
        let holds = |Ready { zone, map, .. }: &&Ready| {
            zone.below.is_none_or(|below| surface - x[2] > below)
                && zone.within.is_none_or(|within| Aabb { min: within.min, max: within.max }.contains(x))
                && map.as_ref().is_none_or(|map| map.over([x[0], x[1]], [x[0], x[1]]) == Some(true))
        };
        self.zones.iter().find(holds).map_or(self.own, |ready| ready.material)
    }

    /// The one material at all points of a box; `None` where there may be several.
    fn over(&self, region: &Aabb) -> Option<usize> {
        for ready in &self.zones {
            match self.covers(ready, region) {
                Some(true) => return Some(ready.material),
                Some(false) => {}
                None => return None,
            }
        }
        Some(self.own)
    }

    /// Whether a zone holds at all points of a box, or at none.
    fn covers(&self, Ready { zone, map, .. }: &Ready, region: &Aabb) -> Option<bool> {
        let (min, max) = ([region.min[0], region.min[1]], [region.max[0], region.max[1]]);
        let of = |all: bool, some: bool| if all || !some { Some(all) } else { None };
        let below = zone.below.map_or(Some(true), |below| {
            let [low, high] = self.solid.surface(min, max)?;
            of(low - region.max[2] > below, high - region.min[2] > below)
        });
        let within = zone.within.map_or(Some(true), |within| {
            let within = Aabb { min: within.min, max: within.max };
            of(within.contains(region.min) && within.contains(region.max), within.meets(region))
        });
        let all = [below, within, map.as_ref().map_or(Some(true), |map| map.over(min, max))];
        if all.contains(&Some(false)) { Some(false) } else { all.iter().all(Option::is_some).then_some(true) }
    }
}

/// Where a picture has the greys of a zone.
struct Map {
    min: [f64; 2],
    max: [f64; 2],
    /// Pixels along x and y.
    size: [usize; 2],
    /// Whether each pixel has such a grey, row by row from greatest y down.
    holds: Vec<bool>,
}

impl Map {
    fn read(picture: &ZonePicture, scene: &Scene, path: &str) -> Result<Self> {
        let file = scene.folder.join(&picture.file);
        let (size, greys) =
            read_greys(&file, |what, mend| scene.fault(path, format!("{}: {what}", file.display()), mend))?;
        let [least, greatest] = picture.grey.map(|grey| 255.0 * grey);
        let holds = greys.iter().map(|grey| (least..=greatest).contains(&f64::from(*grey))).collect();
        Ok(Self { min: picture.min, max: picture.max, size, holds })
    }

    /// Whether all points of a rectangle have such a grey, or none.
    fn over(&self, min: [f64; 2], max: [f64; 2]) -> Option<bool> {
        if (0..2).any(|d| max[d] < self.min[d] || self.max[d] < min[d]) {
            return Some(false);
        }
        let pixel = |x: f64, d: usize| {
            let along = (x - self.min[d]) / (self.max[d] - self.min[d]) * self.size[d] as f64;
            (along.max(0.0) as usize).min(self.size[d] - 1)
        };
        let columns = pixel(min[0], 0)..=pixel(max[0], 0);
        let rows = (pixel(min[1], 1)..=pixel(max[1], 1)).map(|row| self.size[1] - 1 - row);
        let mut pixels =
            rows.flat_map(|row| columns.clone().map(move |column| self.holds[row * self.size[0] + column]));
        let first = pixels.next()?;
        let inside = (0..2).all(|d| self.min[d] <= min[d] && max[d] <= self.max[d]);
        (pixels.all(|other| other == first) && (inside || !first)).then_some(first)
    }
}

/// Columns and rows of a PNG file, and its greys from 0 to 255, row by row from the top.
#[cfg(feature = "pictures")]
fn read_greys(file: &Path, fault: impl Fn(String, &'static str) -> Error) -> Result<([usize; 2], Vec<u8>)> {
    let open = std::fs::File::open(file);
    let open = open.map_err(|source| Error::Io { file: file.to_owned(), what: "reading a picture", source })?;
    let no_png = |e: png::DecodingError| fault(e.to_string(), "give a PNG file");
    let mut decoder = png::Decoder::new(std::io::BufReader::new(open));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(no_png)?;
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let info = reader.next_frame(&mut bytes).map_err(no_png)?;
    let channels = info.color_type.samples();
    let pixels = || bytes[..info.buffer_size()].chunks(channels);
    if channels > 2 && pixels().any(|pixel| pixel[0] != pixel[1] || pixel[0] != pixel[2]) {
        return Err(fault("has colours".to_owned(), "save it as greyscale"));
    }
    let greys = pixels().map(|pixel| pixel[0]).collect();
    Ok(([info.width as usize, info.height as usize], greys))
}

/// Without its feature `pictures`, this program reads none.
#[cfg(not(feature = "pictures"))]
fn read_greys(_: &Path, fault: impl Fn(String, &'static str) -> Error) -> Result<([usize; 2], Vec<u8>)> {
    Err(fault("this program reads no pictures".to_owned(), "build it with the feature `pictures`"))
}

/// What of a body is of one material.
pub(crate) struct Zoned {
    /// The body.
    pub(crate) zones: Arc<Zones>,
    /// Index of the material in the plan.
    pub(crate) material: usize,
}

impl Solid for Zoned {
    fn bounds(&self) -> Aabb {
        self.zones.solid.bounds()
    }
    fn contains(&self, x: Vec3) -> bool {
        self.zones.solid.contains(x) && self.zones.at(x) == self.material
    }
    fn cover(&self, region: &Aabb) -> Option<bool> {
        match (self.zones.solid.cover(region), self.zones.over(region)) {
            (Some(false), _) => Some(false),
            (_, Some(other)) if other != self.material => Some(false),
            (Some(true), Some(_)) => Some(true),
            _ => None,
        }
    }
    /// Between the ends of all zones there is one material.
    fn columns(&self, x: f64, y: f64) -> Vec<[f64; 2]> {
        let Some([bottom, surface]) = self.zones.solid.column(x, y) else { return Vec::new() };
        let ends = self.zones.zones.iter().flat_map(|Ready { zone, .. }| {
            let sides = zone.within.map(|within| [within.min[2], within.max[2]]);
            zone.below.map(|below| surface - below).into_iter().chain(sides.into_iter().flatten())
        });
        let mut ends: Vec<f64> = ends.filter(|z| bottom < *z && *z < surface).chain([bottom, surface]).collect();
        ends.sort_unstable_by(f64::total_cmp);
        let is_mine = |piece: &[f64]| self.zones.at([x, y, 0.5 * (piece[0] + piece[1])]) == self.material;
        ends.windows(2).filter(|piece| is_mine(piece)).map(|piece| [piece[0], piece[1]]).collect()
    }
}
