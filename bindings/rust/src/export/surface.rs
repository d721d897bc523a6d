//! The surface of soft ground and bodies as a triangle mesh.

use crate::nets::{Face, Field, Net};
use barchan_core::file::write_whole;
use barchan_core::glam;
use barchan_core::scene::plain;
use barchan_core::{Error, Result, Simulation, Spot, Vec3};
use std::io::Write;
use std::path::Path;

/// Nodes of the largest grid.
const MOST_NODES: f64 = 2e8;
/// Share of space that particles fill at the surface.
const HALF: f32 = 0.5;
/// Cells that are empty around the particles.
const AIR: f64 = 2.0;

/// A closed triangle mesh around all particles: where they fill half of space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// Corners [m].
    pub corners: Vec<Vec3>,
    /// Triangles by their corners, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// The surface of particles, each a cube of its rest volume, on a grid of cells `spacing` [m] wide.
    ///
    /// 1. The share of each cell that particles fill, smoothed once (1 2 1) along each axis, so that single particles do not show.
    /// 2. A surface net where that passes one half. A plane is met within 4 % of a cell. Edges are rounded over a cell or
    ///    two: a box of 10 by 15 by 12 cells loses 5 to 7 % of its volume, a ball of 8 cells' radius 4.5 %.
    ///
    /// Single particles, and sheets thinner than a cell, fill half of nothing and are not in it.
    ///
    /// # Errors
    /// [`Error::Body`] if the particles lie so far apart that the grid would have more than 2e8 nodes.
    pub fn new(spots: &[Spot], spacing: f64) -> Result<Self> {
        let Some(first) = spots.first() else { return Ok(Self::default()) };
        let ends = spots.iter().fold((first.position, first.position), |(low, high), spot| {
            let (at, half) = (spot.position, 0.5 * spot.side());
            (std::array::from_fn(|d| low[d].min(at[d] - half)), std::array::from_fn(|d| high[d].max(at[d] + half)))
        });
        // Cells begin at multiples of their width: a surface at rest stays as it is while others move.
        let grid = |spacing: f64| -> (Vec3, Vec3) {
            let origin = ends.0.map(|x: f64| ((x / spacing).floor() - AIR) * spacing);
            (origin, std::array::from_fn(|d| ((ends.1[d] - origin[d]) / spacing).ceil() + AIR))
        };
        let nodes = |spacing: f64| grid(spacing).1.iter().product::<f64>();
        if nodes(spacing) > MOST_NODES {
            let mut wider = spacing;
            while nodes(wider) > MOST_NODES {
                wider = (1000.0 * 1.1 * wider).ceil() / 1000.0;
            }
            return Err(Error::Body {
                path: "output.surface.spacing".to_owned(),
                what: format!(
                    "at {spacing} m, the grid around all particles has {:.1e} nodes, and {MOST_NODES:.0e} are the most",
                    nodes(spacing)
                ),
                mend: format!("make it {wider} m or more"),
            });
        }
        let (origin, count) = grid(spacing);
        // Places are seen from the origin, so that f32 is as exact 10 km away.
        let mut field = Field::new(glam::Vec3::ZERO, spacing as f32, count.map(|n| n as usize));
        for spot in spots {
            let place = glam::Vec3::from_array(std::array::from_fn(|d| (spot.position[d] - origin[d]) as f32));
            field.fill(place, spot.side() as f32, |_| ());
        }
        field.smooth();
        let mut surface = Self::default();
        let net = Net::new(&field, HALF, |corner| {
            let at = corner.at.to_array();
            surface.corners.push(std::array::from_fn(|d| origin[d] + f64::from(at[d])));
            surface.corners.len() as u32 - 1
        });
        net.faces(|Face { corners: [a, b, c, d], axis, inside, outside }| {
            let [b, d] = if inside[axis] < outside[axis] { [b, d] } else { [d, b] };
            surface.triangles.extend([[a, b, c], [a, c, d]]);
        });
        Ok(surface)
    }

    /// The volume inside [m³].
    pub fn volume(&self) -> f64 {
        let Some(&middle) = self.corners.first() else { return 0.0 };
        let part = |triangle: &[u32; 3]| {
            let [a, b, c]: [Vec3; 3] =
                triangle.map(|i| std::array::from_fn(|d| self.corners[i as usize][d] - middle[d]));
            let cross = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]];
            (a[0] * cross[0] + a[1] * cross[1] + a[2] * cross[2]) / 6.0
        };
        self.triangles.iter().map(part).sum()
    }

    /// Writes it as a binary PLY file, with the simulation's name and time in its comments.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be written.
    pub fn write_ply(&self, path: impl AsRef<Path>, simulation: &Simulation) -> Result<()> {
        write_whole(path.as_ref(), "writing the surface", |out| {
            write!(
                out,
                "ply\nformat binary_little_endian 1.0\ncomment {}\ncomment time {} s\ncomment unit of position: m\n\
                 element vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
                 element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
                plain(&simulation.plan().scene.name),
                simulation.time(),
                self.corners.len(),
                self.triangles.len()
            )?;
            for x in self.corners.as_flattened() {
                out.write_all(&x.to_le_bytes())?;
            }
            for triangle in &self.triangles {
                out.write_all(&[3])?;
                triangle.iter().try_for_each(|corner| out.write_all(&corner.to_le_bytes()))?;
            }
            Ok(())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Particles on a lattice where `within` says so, seen from a place.
    fn spots(from: f64, spacing: f64, within: impl Fn(Vec3) -> bool) -> Vec<Spot> {
        let places = (0..64_000).map(|n| [n % 40, n / 40 % 40, n / 1600].map(|i: usize| (i as f64 + 0.5) * spacing));
        let spot = |p: Vec3| Spot { position: p.map(|x| x + from), volume0: spacing.powi(3), material: 0 };
        places.filter(|&p| within(p)).map(spot).collect()
    }

    /// How far corners are off a surface, and whether each edge belongs to two triangles that run through it in turn.
    fn is_closed(surface: &Surface) -> bool {
        let edges = |t: &[u32; 3]| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]];
        let mut balance = std::collections::BTreeMap::new();
        for [a, b] in surface.triangles.iter().flat_map(edges) {
            *balance.entry([a.min(b), a.max(b)]).or_insert(0) += if a < b { 1 } else { -1 };
        }
        balance.values().all(|&sum| sum == 0)
    }

    /// Flat sides lie where the ground ends, wherever that is in a cell, and 10 km away too; the mesh is closed, faces outwards, and
    /// holds the ground's volume but for its edges.
    #[test]
    fn a_box_has_flat_sides_and_its_volume() {
        for from in [0.0, 0.0037, 1e4] {
            let all = spots(from, 0.005, |p| p[0] < 0.1 && p[1] < 0.15 && p[2] < 0.125);
            let surface = Surface::new(&all, 0.01).unwrap();
            assert!(is_closed(&surface));
            let top = |p: &&Vec3| {
                (p[0] - from - 0.05).abs() < 0.03 && (p[1] - from - 0.07).abs() < 0.03 && p[2] - from > 0.06
            };
            let off = surface.corners.iter().filter(top).map(|p| (p[2] - from - 0.125).abs()).fold(0.0, f64::max);
            assert!(off < 4e-4, "the top is {off} m off");
            let share = surface.volume() / (0.1 * 0.15 * 0.125);
            // What edges lose by being rounded; a gap or a wrong side would be a third and more.
            assert!((0.93..1.0).contains(&share), "{share} of the volume");
        }
    }

    #[test]
    fn a_ball_is_round() {
        let middle = [0.1; 3];
        let distance = |p: Vec3| (0..3).map(|d| (p[d] - middle[d]).powi(2)).sum::<f64>().sqrt();
        let all = spots(0.0, 0.005, |p| distance(p) < 0.08);
        let surface = Surface::new(&all, 0.01).unwrap();
        let off = surface.corners.iter().map(|p| (distance(*p) - 0.08).abs()).fold(0.0, f64::max);
        assert!(is_closed(&surface) && off < 0.004, "{off} m off");
        let share = surface.volume() / (all.len() as f64 * 0.005f64.powi(3));
        assert!((0.95..1.0).contains(&share), "{share} of the volume");
    }

    #[test]
    fn a_grid_that_is_too_large_is_refused_with_a_width_that_is_not() {
        let mut all = spots(0.0, 0.005, |p| p[0] < 0.01);
        all[0].position = [500.0, 200.0, 1.0];
        let error = Surface::new(&all, 0.01).unwrap_err().to_string();
        assert!(error.contains("output.surface.spacing"), "{error}");
        let wider: f64 =
            error.split("make it ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap().parse().unwrap();
        // Three times as wide, the grid takes little memory.
        assert!(wider > 0.01 && Surface::new(&all, 3.0 * wider).is_ok());
    }
}
