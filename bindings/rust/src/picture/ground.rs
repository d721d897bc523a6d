//! The surface of soft ground and bodies: where particles fill half of space.
//!
//! 1. Each particle is a cube of its volume; nodes take up the share of their cells that particles fill ([`Field`]).
//! 2. That share is smoothed, over about a cell, so that single particles do not show in a surface of many.
//! 3. Where it passes about one half there is the surface (surface nets, [`Net`]).
//! 4. Smoothed much more, it says how much of the sky is hidden there: hollows are darker than the ground around.
//! 5. Particles too far from others to fill half of anything are balls.

use super::raster::Soup;
use super::relief::Dot;
use crate::nets::{Corner, Face, Field, Net, Rimmed};
use barchan_core::glam::Vec3;
use rayon::prelude::*;

/// Most nodes of a picture's grid: with more, cells are wider than particles are apart.
const MOST_NODES: f32 = 4e6;
/// Rounds of smoothing for places, and further ones for normals; each adds half a cell² to the variance.
const ROUNDS: usize = 1;
const NORMAL_ROUNDS: usize = 1;
/// Of a cell that nothing fills.
const NO_GROUND: u8 = u8::MAX;
/// Share at the surface. In a sheet one particle thick it is up to one half, at the corner of a cube 0.42, in a row of particles 0.25.
const HALF: f32 = 0.45;
/// Particles at a share below this are drawn alone.
const ALONE: f32 = 0.28;
/// The share of the sky that is seen from a side that is cut at a wall.
const CUT_SKY: f32 = 0.8;
/// Cells of the surface's grid along one side of a cell of the sky's, and rounds of smoothing there.
const COARSE: usize = 4;
const COARSE_ROUNDS: usize = 3;
/// Cells that are empty around the particles, and coarse ones around those.
const AIR: usize = 3;
const SKY_AIR: usize = 4;

/// The box that particles may be in, and which of its sides the ground goes on behind: x least and greatest, y, and z least.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bed {
    /// Least corner [m].
    pub min: Vec3,
    /// Greatest corner [m].
    pub max: Vec3,
    /// Is there a wall at the side, that ground ends at?
    pub walls: [bool; 5],
}

/// How much of the sky is hidden by ground.
#[derive(Debug)]
pub(super) struct Sky(Option<Field>);

impl Sky {
    /// The share of the sky that is seen from a place on a surface with some normal.
    pub(super) fn seen(&self, place: Vec3, normal: Vec3) -> f32 {
        let Some(field) = &self.0 else { return 1.0 };
        // Beside flat ground a fifth is hidden at this height; what is above that is ground that stands higher.
        let hidden = field.at(place + normal * field.cell);
        1.0 - ((hidden - 0.21) * 1.9).clamp(-0.12, 0.92)
    }
}

impl Field {
    /// What hides the sky: the same in cells four times as wide, with air around and the floor below.
    fn sky(&self, bed: &Bed) -> Field {
        let coarse = COARSE as f32 * self.cell;
        let count = self.count.map(|n| n.div_ceil(COARSE) + 2 * SKY_AIR);
        let mut sky = Self::new(self.min - SKY_AIR as f32 * coarse, coarse, count);
        let part = 1.0 / (COARSE * COARSE * COARSE) as f32;
        for (k, layer) in self.values.chunks(self.count[0] * self.count[1]).enumerate() {
            for (j, row) in layer.chunks(self.count[0]).enumerate() {
                let first = sky.index([SKY_AIR, SKY_AIR + j / COARSE, SKY_AIR + k / COARSE]);
                for (i, cells) in row.chunks(COARSE).enumerate() {
                    sky.values[first + i] += part * cells.iter().map(|v| v.min(1.0)).sum::<f32>();
                }
            }
        }
        // Behind a wall the ground is taken to go on, so that it is not brighter along its sides, and a floor is solid.
        let inner = count.map(|n| n - 2 * SKY_AIR);
        for n in 0..sky.values.len() {
            let at = [n % count[0], n / count[0] % count[1], n / (count[0] * count[1])];
            let mut from = at;
            let mut behind = false;
            for d in 0..2 {
                let (low, high) = (at[d] < SKY_AIR, at[d] >= SKY_AIR + inner[d]);
                if (low && bed.walls[2 * d]) || (high && bed.walls[2 * d + 1]) {
                    // The last coarse cell may be filled in part only; the one before it is whole.
                    from[d] = if low { SKY_AIR } else { (SKY_AIR + inner[d]).saturating_sub(2).max(SKY_AIR) };
                    behind = true;
                }
            }
            if at[2] < SKY_AIR && bed.walls[4] {
                sky.values[n] = 1.0;
            } else if behind {
                sky.values[n] = sky.values[sky.index(from)];
            }
        }
        (0..COARSE_ROUNDS).for_each(|_| sky.smooth());
        sky
    }
}

/// The surface of particles, the finest `spacing` [m] apart, added to a soup: paints are the grounds' numbers from `first_paint` on. Where all of them take more nodes
/// than there are for one picture, it is that of those that are `seen`.
pub(super) fn surface(
    dots: &[Dot],
    bed: &Bed,
    spacing: f32,
    seen: impl Fn(Vec3) -> bool + Sync,
    first_paint: u16,
    soup: &mut Soup,
) -> Sky {
    let is_too_wide = ends(dots, bed).is_some_and(|[low, high]| cell_for(high - low, spacing) > spacing);
    let is_seen = |dot: &&Dot| seen(Vec3::from_array(dot.position));
    let near: Vec<Dot>;
    let dots = if is_too_wide {
        near = dots.par_iter().filter(is_seen).copied().collect();
        &near
    } else {
        dots
    };
    let Some((mut field, grounds, walls)) = filled(dots, bed, spacing) else { return Sky(None) };
    let bed = &Bed { walls, ..*bed };
    (0..ROUNDS).for_each(|_| field.smooth());
    let sky = Sky(Some(field.sky(bed)));
    let mut smoother = Field { values: field.values.clone(), ..field };
    (0..NORMAL_ROUNDS).for_each(|_| smoother.smooth());
    nets(&field, &smoother, &grounds, bed, &sky, first_paint, soup);
    for dot in dots {
        let place = Vec3::from_array(dot.position);
        if field.at(place) < ALONE && place.cmpge(bed.min).all() && place.cmple(bed.max).all() {
            ball(place, 0.6 * dot.side, sky.seen(place, Vec3::Z), first_paint + u16::from(dot.ground), soup);
        }
    }
    sky
}

/// The least and the greatest corner of what particles fill, if there is anything [m].
fn ends(dots: &[Dot], bed: &Bed) -> Option<[Vec3; 2]> {
    let ends = dots.par_iter().fold(
        || (Vec3::INFINITY, Vec3::NEG_INFINITY),
        |(low, high), dot| {
            let (place, half) = (Vec3::from_array(dot.position), 0.5 * dot.side);
            (low.min(place - half), high.max(place + half))
        },
    );
    let (low, high) = ends.reduce(|| (Vec3::INFINITY, Vec3::NEG_INFINITY), |a, b| (a.0.min(b.0), a.1.max(b.1)));
    let (low, high) = (low.max(bed.min), high.min(bed.max));
    low.cmplt(high).all().then_some([low, high])
}

/// Width of a picture's cells where particles are as far apart as `spacing`, and fill a box of that size [m].
fn cell_for(size: Vec3, spacing: f32) -> f32 {
    spacing.max((size.x * size.y * size.z / MOST_NODES).cbrt())
}

/// The share of each cell that particles fill, of what, and the walls that they reach; nothing if there are none.
fn filled(dots: &[Dot], bed: &Bed, spacing: f32) -> Option<(Field, Vec<u8>, [bool; 5])> {
    let [low, high] = ends(dots, bed)?;
    let cell = cell_for(high - low, spacing);
    // Ground that reaches a wall ends there; else some air is around it.
    let air = AIR as f32 * cell;
    let mut min = low - air;
    let (mut count, mut walls) = ([0; 3], bed.walls);
    for d in 0..3 {
        if d == 2 && bed.walls[4] {
            min[d] = bed.min[d];
        }
        let mut end = high[d] + air;
        if d < 2 {
            walls[2 * d] &= low[d] - bed.min[d] < 2.0 * cell;
            walls[2 * d + 1] &= bed.max[d] - high[d] < 2.0 * cell;
            min[d] = if walls[2 * d] { bed.min[d] } else { min[d] };
            end = if walls[2 * d + 1] { bed.max[d] } else { end };
        }
        count[d] = ((end - min[d]) / cell).round().max(1.0) as usize;
    }
    let mut field = Field::new(min, cell, count);
    let several = dots.iter().any(|dot| dot.ground != 0);
    let mut grounds = vec![NO_GROUND; if several { field.values.len() } else { 0 }];
    for dot in dots {
        let place = Vec3::from_array(dot.position);
        if several {
            field.fill(place, dot.side, |node| grounds[node] = dot.ground);
        } else {
            field.fill(place, dot.side, |_| ());
        }
    }
    // The smoothed surface passes through cells beside those that particles fill.
    if several {
        (0..=ROUNDS).for_each(|_| spread(&mut grounds, field.count));
    }
    Some((field, grounds, walls))
}

/// Cells that nothing fills take what fills one beside them.
fn spread(grounds: &mut [u8], count: [usize; 3]) {
    let before = grounds.to_vec();
    let steps = [1, count[0], count[0] * count[1]];
    grounds.par_iter_mut().enumerate().filter(|(_, ground)| **ground == NO_GROUND).for_each(|(cell, ground)| {
        for (step, count) in steps.into_iter().zip(count) {
            let place = cell / step % count;
            let beside = [(place > 0).then(|| cell - step), (place + 1 < count).then(|| cell + step)];
            if let Some(found) = beside.into_iter().flatten().map(|other| before[other]).find(|one| *one != NO_GROUND) {
                *ground = found;
                return;
            }
        }
    });
}

/// The surface where the field passes one half. Beyond the field there is nothing.
fn nets(field: &Field, smoother: &Field, grounds: &[u8], bed: &Bed, sky: &Sky, first_paint: u16, soup: &mut Soup) {
    let [nx, ny, _] = field.count;
    let smoother = Rimmed::new(smoother);
    let net = Net::new(field, HALF, |Corner { cell: [i, j, _], node, within, at }| {
        let normal = -slope(&smoother.around(node), within).normalize_or_zero();
        let cut = [i == 0, i == nx, j == 0, j == ny].iter().zip(bed.walls).any(|(&end, wall)| end && wall);
        let seen = if cut && normal.z < 0.5 { CUT_SKY } else { sky.seen(at, normal) };
        soup.corner(at, normal, seen)
    });
    let ground = |place: [usize; 3]| {
        let inner: [usize; 3] = std::array::from_fn(|d| place[d].clamp(1, field.count[d]) - 1);
        grounds.get(field.index(inner)).copied().filter(|ground| *ground != NO_GROUND).unwrap_or_default()
    };
    net.faces(|Face { corners: [a, b, c, e], axis, inside, outside }| {
        // What lies on the floor is not seen from below.
        if axis == 2 && outside[2] == 0 && bed.walls[4] {
            return;
        }
        let paint = first_paint + u16::from(ground(inside));
        soup.triangle([a, b, c], paint);
        soup.triangle([a, c, e], paint);
    });
}

/// The slope of a field in a cell.
fn slope(values: &[f32; 8], place: Vec3) -> Vec3 {
    let mut slope = Vec3::ZERO;
    for (corner, value) in values.iter().enumerate() {
        let part: [[f32; 2]; 3] =
            std::array::from_fn(|d| if corner >> d & 1 == 1 { [place[d], 1.0] } else { [1.0 - place[d], -1.0] });
        slope.x += value * part[0][1] * part[1][0] * part[2][0];
        slope.y += value * part[0][0] * part[1][1] * part[2][0];
        slope.z += value * part[0][0] * part[1][0] * part[2][1];
    }
    slope
}

/// An octahedron, round by its normals.
fn ball(middle: Vec3, radius: f32, sky: f32, paint: u16, soup: &mut Soup) {
    let axes = [Vec3::X, Vec3::Y, Vec3::NEG_X, Vec3::NEG_Y];
    let ring = axes.map(|axis| soup.corner(middle + radius * axis, axis, sky));
    for pole in [Vec3::Z, Vec3::NEG_Z] {
        let tip = soup.corner(middle + radius * pole, pole, sky);
        (0..4).for_each(|i| soup.triangle([ring[i], ring[(i + 1) % 4], tip], paint));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACING: f32 = 0.01;

    /// Particles on a lattice where `within` says so.
    fn dots(count: [usize; 3], within: impl Fn(Vec3) -> bool) -> Vec<Dot> {
        let all = (0..count.iter().product()).map(|n: usize| {
            let at = [n % count[0], n / count[0] % count[1], n / (count[0] * count[1])];
            Vec3::from_array(at.map(|i| (i as f32 + 0.5) * SPACING))
        });
        all.filter(|&p| within(p))
            .map(|p| Dot { position: p.to_array(), ground: 0, value: 0.0, side: SPACING })
            .collect()
    }

    fn volume(soup: &Soup) -> f32 {
        let part = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| soup.points[i as usize]);
            // Surface nets leave the winding open; normals say what is outside.
            let twice = (b - a).cross(c - a);
            let out = t.iter().map(|&i| soup.normals[i as usize]).sum::<Vec3>();
            a.dot(twice) * twice.dot(out).signum() / 6.0
        };
        soup.triangles.iter().map(part).sum()
    }

    #[test]
    fn a_ball_of_particles_is_round_and_keeps_its_volume() {
        let middle = Vec3::splat(0.2);
        let dots = dots([40; 3], |p| p.distance(middle) < 0.1);
        let bed = Bed { min: Vec3::ZERO, max: Vec3::splat(0.4), walls: [false; 5] };
        let mut soup = Soup::default();
        surface(&dots, &bed, SPACING, |_| true, 0, &mut soup);
        let off = soup.points.iter().map(|p| (p.distance(middle) - 0.1).abs()).fold(0.0, f32::max);
        assert!(off < 0.7 * SPACING, "the surface is {off} m off");
        let turned = soup.points.iter().zip(&soup.normals).map(|(p, n)| (*p - middle).normalize().dot(*n));
        assert!(turned.fold(1.0, f32::min) > 0.93);
        let share = volume(&soup) / (dots.len() as f32 * SPACING.powi(3));
        assert!((share - 1.0).abs() < 0.05, "{share} of the volume");
    }

    #[test]
    fn a_bed_ends_at_its_walls_and_a_footprint_is_darker() {
        let print = |p: Vec3| (p.x - 0.3).abs() < 0.04 && (p.y - 0.3).abs() < 0.04;
        let dots = dots([60, 60, 20], |p| p.z < if print(p) { 0.16 } else { 0.2 });
        let bed = Bed { min: Vec3::ZERO, max: Vec3::new(0.6, 0.6, 1.0), walls: [true; 5] };
        let mut soup = Soup::default();
        let sky = surface(&dots, &bed, SPACING, |_| true, 3, &mut soup);
        assert!(soup.paints.iter().all(|&paint| paint == 3));
        let ends = soup.points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), &p| (a.min(p), b.max(p)));
        assert!(ends.0.truncate().abs_diff_eq(Vec3::ZERO.truncate(), 1e-3), "{ends:?}");
        assert!(ends.1.abs_diff_eq(Vec3::new(0.6, 0.6, 0.2), 2e-3), "{ends:?}");
        let [deep, flat, edge] =
            [[0.3, 0.3, 0.16], [0.1, 0.3, 0.2], [0.01, 0.3, 0.2]].map(|p| sky.seen(Vec3::from_array(p), Vec3::Z));
        assert!(deep < flat - 0.1, "in the footprint {deep} of the sky, beside it {flat}");
        assert!((edge - flat).abs() < 0.02, "at the wall {edge}, inside {flat}");
        assert!((flat - 1.0).abs() < 0.05, "{flat}");
    }

    /// Symptom: footprints fade in the picture as the ground around grows, though nobody touches them. Geometry: what is seen of wide ground is drawn as if it were all.
    #[test]
    fn ground_beyond_the_picture_takes_nothing_from_what_is_in_it() {
        let middle = Vec3::splat(0.2);
        let mut dots = dots([40; 3], |p| p.distance(middle) < 0.1);
        let beyond = [[30.0, 0.0, 0.0], [0.0, 30.0, 1.0]];
        dots.extend(beyond.map(|position| Dot { position, ground: 0, value: 0.0, side: SPACING }));
        let bed = Bed { min: Vec3::ZERO, max: Vec3::splat(40.0), walls: [false; 5] };
        let mut soup = Soup::default();
        surface(&dots, &bed, SPACING, |p| p.distance(middle) < 1.0, 0, &mut soup);
        let off = soup.points.iter().map(|p| (p.distance(middle) - 0.1).abs()).fold(0.0, f32::max);
        assert!(!soup.points.is_empty() && off < 0.7 * SPACING, "the surface is {off} m off");
    }

    #[test]
    fn single_particles_are_balls() {
        let bed = Bed { min: Vec3::ZERO, max: Vec3::splat(1.0), walls: [false; 5] };
        let far = [0.2, 0.8].map(|x| Dot { position: [x, 0.5, 0.5], ground: 1, value: 0.0, side: SPACING });
        let mut soup = Soup::default();
        surface(&far, &bed, SPACING, |_| true, 0, &mut soup);
        assert_eq!((soup.triangles.len(), soup.paints[0]), (16, 1));
    }
}
