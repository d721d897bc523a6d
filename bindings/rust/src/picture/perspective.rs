//! Pictures in perspective: ground, bodies and their shadows, as a camera sees them. Without a GPU, by z-buffers.
//!
//! 1. The ground's surface and the bodies' come together as triangles.
//! 2. A first buffer says what the sun sees: the rest is in shadow.
//! 3. A second one says which triangle each of four samples a pixel sees; what a pixel sees of one triangle is shaded once.

use super::camera::Lens;
use super::colour::{Ground, encode, linear};
use super::ground::{Bed, Sky, surface};
use super::image::{Colour, Image};
use super::raster::{Buffer, NOTHING, Soup};
use super::relief::{Dot, rough, smoothstep};
use barchan_core::glam::{Quat, Vec3};
use barchan_core::surface;
use rayon::prelude::*;

/// Towards the sun: on the left of those who look north, 38° high.
const SUN: [f32; 3] = [-0.64, -0.46, 0.616];
/// Light of the sun, square on, and of the open sky.
const SUNLIGHT: Vec3 = Vec3::new(1.42, 1.34, 1.20);
const SKYLIGHT: Vec3 = Vec3::new(0.33, 0.36, 0.42);
/// Texels along a side of what the sun sees.
const TEXELS: usize = 1536;
/// Samples of a pixel along its sides.
const SAMPLES: usize = 2;
/// Colours of a tool, and of the floor, and what the floor fades into, far away and at the top of the picture.
const STEEL: Colour = [124, 134, 148];
const FLOOR: Colour = [206, 207, 208];
const HORIZON: Colour = [226, 230, 234];
const ZENITH: Colour = [196, 208, 222];

/// What a picture in perspective shows. Places are from the view's origin on.
pub(super) struct Scenery<'a> {
    /// The camera.
    pub lens: Lens,
    /// What it looks at, and from how far away [m].
    pub target: Vec3,
    pub distance: f32,
    pub dots: &'a [Dot],
    /// The finest particles' distance [m].
    pub spacing: f32,
    pub bed: Bed,
    /// Height in the middle of the palette and from there to its ends [m], where height colours the ground.
    pub heights: Option<(f32, f32)>,
    pub grounds: &'a [Ground],
    pub surfaces: &'a [surface::Surface],
    /// The world's place of the view's origin [m].
    pub origin: [f64; 3],
}

/// How a triangle takes the light.
#[derive(Clone, Copy)]
enum Paint {
    Ground(Ground),
    Rigid(Vec3),
}

/// What the sun sees.
struct Sun {
    /// Across, up, and towards it.
    axes: [Vec3; 3],
    /// Of the map's corner along the axes, and texels a metre.
    corner: Vec3,
    scale: f32,
    map: Buffer,
    /// For each tile of the map, how near it is at least and at most around a place in it.
    tiles: Vec<[f32; 2]>,
}

/// Texels along a side of a tile, and around it that a place in it reads.
const TILE: usize = 8;
const BESIDE_TILE: usize = 2;

impl Sun {
    /// Of triangles within some distance of a place.
    fn new(soup: &Soup, about: Vec3, within: f32) -> Self {
        let towards = Vec3::from_array(SUN).normalize();
        let across = Vec3::Z.cross(towards).normalize();
        let axes = [across, towards.cross(across), towards];
        let seen = |p: Vec3| Vec3::from_array(axes.map(|axis| axis.dot(p)));
        let near = soup.points.iter().filter(|p| p.distance_squared(about) < within * within);
        let ends = near.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(a, b), &p| (a.min(seen(p)), b.max(seen(p))));
        let (low, high) = if ends.0.x < ends.1.x { ends } else { (seen(about) - 1.0, seen(about) + 1.0) };
        let scale = (TEXELS - 8) as f32 / (high.x - low.x).max(high.y - low.y).max(1e-6);
        // All that is seen is nearer than 0: what is below the lowest is cut off by this much more.
        let corner = Vec3::new(low.x - 4.0 / scale, low.y - 4.0 / scale, low.z - within);
        let at: Vec<Vec3> = soup
            .points
            .iter()
            .map(|&p| {
                let p = seen(p) - corner;
                Vec3::new(p.x * scale, p.y * scale, p.z)
            })
            .collect();
        let map = Buffer::new(TEXELS, TEXELS, &at, &soup.triangles);
        let tiles = (0..(TEXELS / TILE).pow(2)).into_par_iter().map(|tile| {
            let reach = |first: usize| {
                (first * TILE).saturating_sub(BESIDE_TILE)..((first + 1) * TILE + BESIDE_TILE).min(TEXELS)
            };
            let columns = reach(tile % (TEXELS / TILE));
            let mut ends = [f32::INFINITY, 0.0f32];
            for row in reach(tile / (TEXELS / TILE)) {
                for &near in &map.near[row * TEXELS..][columns.clone()] {
                    ends[0] = if near < ends[0] { near } else { ends[0] };
                    ends[1] = if near > ends[1] { near } else { ends[1] };
                }
            }
            ends
        });
        let tiles = tiles.collect();
        Self { axes, corner, scale, map, tiles }
    }

    /// The share of the sun that reaches a place on a surface, with soft edges.
    fn reaches(&self, place: Vec3, normal: Vec3) -> f32 {
        // A place lies up to a texel beside those that the map knows, and must not shade itself.
        let place = place + normal * (1.5 / self.scale);
        let at = Vec3::from_array(self.axes.map(|axis| axis.dot(place))) - self.corner;
        let (x, y) = (at.x * self.scale - 0.5, at.y * self.scale - 0.5);
        let last = (TEXELS - 3) as f32;
        if !(1.0 <= x && x < last && 1.0 <= y && y < last) {
            return 1.0;
        }
        let (column, row) = (x as usize, y as usize);
        let (fx, fy) = (x - column as f32, y - row as f32);
        let limit = at.z + 1.5 / self.scale;
        // Most of a picture is far from any shadow's edge.
        let [least, most] = self.tiles[row / TILE * (TEXELS / TILE) + column / TILE];
        if most <= limit {
            return 1.0;
        }
        if least > limit {
            return 0.0;
        }
        let (across, down) = ([1.0 - fx, 1.0, 1.0, fx], [1.0 - fy, 1.0, 1.0, fy]);
        let mut lit = 0.0;
        for (j, down) in down.into_iter().enumerate() {
            let texels = &self.map.near[(row + j - 1) * TEXELS + column - 1..][..4];
            for (near, across) in texels.iter().zip(across) {
                lit += if *near <= limit { across * down } else { 0.0 };
            }
        }
        lit / 9.0
    }
}

/// A picture in the making.
struct Painter<'a> {
    scenery: &'a Scenery<'a>,
    soup: Soup,
    paints: Vec<Paint>,
    sky: Sky,
    sun: Sun,
    /// Height of the floor [m].
    floor: Option<f32>,
    towards_sun: Vec3,
    /// Light of the horizon and the zenith, and what the floor gives back.
    air: [Vec3; 2],
    stone: Vec3,
}

/// Draws it all.
pub(super) fn draw(image: &mut Image, scenery: &Scenery<'_>) {
    let mut soup = Soup::default();
    let mut paints: Vec<Paint> = scenery.grounds.iter().map(|&ground| Paint::Ground(ground)).collect();
    // Shadows, and what hides the sky, come from a little beyond the picture.
    let seen = |place: Vec3| scenery.lens.is_near(place, 0.5 * scenery.distance);
    let sky = surface(scenery.dots, &scenery.bed, scenery.spacing, seen, 0, &mut soup);
    for part in scenery.surfaces {
        add(part, scenery.origin, paints.len() as u16, &mut soup);
        let colour = part.colour.map_or(STEEL, |colour| colour.map(|c| (255.0 * c) as u8));
        paints.push(Paint::Rigid(Vec3::from_array(colour.map(linear))));
    }
    let sun = Sun::new(&soup, scenery.target, 1.5 * scenery.distance);
    soup.clip(|p| scenery.lens.depth(p), 0.02 * scenery.distance);
    let lens = &scenery.lens;
    let at: Vec<Vec3> = soup
        .points
        .par_iter()
        .map(|&p| {
            let at = lens.project(p);
            Vec3::new(at.x * SAMPLES as f32, at.y * SAMPLES as f32, at.z)
        })
        .collect();
    let (width, height) = (image.width(), image.height());
    let seen = Buffer::new(SAMPLES * width, SAMPLES * height, &at, &soup.triangles);
    let floor = scenery.bed.walls[4].then_some(scenery.bed.min.z);
    let [air @ .., stone] = [HORIZON, ZENITH, FLOOR].map(|c| Vec3::from_array(c.map(linear)));
    let painter =
        Painter { scenery, soup, paints, sky, sun, floor, towards_sun: Vec3::from_array(SUN).normalize(), air, stone };
    image.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(row, pixels)| {
        for (column, pixel) in pixels.iter_mut().enumerate() {
            let light = painter.pixel(column, row, height, &seen, &at);
            *pixel = light.to_array().map(encode);
        }
    });
}

/// Adds a body's triangles where they are.
fn add(part: &surface::Surface, origin: [f64; 3], paint: u16, soup: &mut Soup) {
    let [w, x, y, z] = part.rotation.map(|q| q as f32);
    let turn = Quat::from_xyzw(x, y, z, w);
    let place = Vec3::from_array(std::array::from_fn(|d| (part.position[d] - origin[d]) as f32));
    for (corners, normals) in part.mesh.corners.iter().zip(&part.mesh.normals) {
        let triangle = [0, 1, 2].map(|i| {
            let (corner, normal) = (Vec3::from_array(corners[i]), Vec3::from_array(normals[i]));
            soup.corner(place + turn * corner, turn * normal, 1.0)
        });
        soup.triangle(triangle, paint);
    }
}

impl Painter<'_> {
    /// The light that a pixel gets: what its samples see, each thing once.
    fn pixel(&self, column: usize, row: usize, height: usize, seen: &Buffer, at: &[Vec3]) -> Vec3 {
        let first = SAMPLES * (row * seen.width + column);
        if let ([a, b], [c, d]) = (&seen.which[first..][..2], &seen.which[first + seen.width..][..2])
            && a == b
            && a == c
            && a == d
        {
            let (x, y) = (column as f32 + 0.5, row as f32 + 0.5);
            let light = match *a {
                NOTHING => self.background(x, y, height),
                which => self.triangle(which as usize, SAMPLES as f32 * x, SAMPLES as f32 * y, at),
            };
            return light.min(Vec3::splat(1.6));
        }
        let mut things = [(NOTHING, 0.0f32, 0.0f32, 0.0f32); SAMPLES * SAMPLES];
        let mut count = 0;
        for j in 0..SAMPLES {
            for i in 0..SAMPLES {
                let (x, y) = (SAMPLES * column + i, SAMPLES * row + j);
                let which = seen.which[y * seen.width + x];
                let known = things[..count].iter().position(|thing| thing.0 == which);
                let thing = known.unwrap_or_else(|| {
                    things[count] = (which, 0.0, 0.0, 0.0);
                    count += 1;
                    count - 1
                });
                things[thing].1 += 1.0;
                things[thing].2 += x as f32 + 0.5;
                things[thing].3 += y as f32 + 0.5;
            }
        }
        let mut light = Vec3::ZERO;
        for &(which, share, x, y) in &things[..count] {
            let (x, y) = (x / share, y / share);
            let colour = match which {
                NOTHING => self.background(x / SAMPLES as f32, y / SAMPLES as f32, height),
                which => self.triangle(which as usize, x, y, at),
            };
            light += share * colour.min(Vec3::splat(1.6));
        }
        light / (SAMPLES * SAMPLES) as f32
    }

    fn triangle(&self, which: usize, x: f32, y: f32, at: &[Vec3]) -> Vec3 {
        let corners = self.soup.triangles[which].map(|i| i as usize);
        let [a, b, c] = corners.map(|i| at[i]);
        let cross = |p: Vec3, q: Vec3| (p.x - x) * (q.y - y) - (p.y - y) * (q.x - x);
        // One weight a corner, so that what lies evenly on the triangle lies unevenly in the picture.
        let area = cross(a, b) + cross(b, c) + cross(c, a);
        let parts = [(cross(b, c), a.z), (cross(c, a), b.z), (cross(a, b), c.z)];
        let parts = parts.map(|(part, near)| (part / area).max(0.0) * near);
        let whole = parts[0] + parts[1] + parts[2];
        let weights = if whole > 0.0 { parts.map(|part| part / whole) } else { [1.0 / 3.0; 3] };
        let mix = |of: &[Vec3]| (0..3).map(|i| weights[i] * of[corners[i]]).sum::<Vec3>();
        let (place, normal) = (mix(&self.soup.points), mix(&self.soup.normals).normalize_or(Vec3::Z));
        match self.paints[usize::from(self.soup.paints[which])] {
            Paint::Ground(ground) => {
                let sky = (0..3).map(|i| weights[i] * self.soup.sky[corners[i]]).sum();
                self.ground(&ground, place, normal, sky)
            }
            Paint::Rigid(colour) => {
                let [p, q, r] = corners.map(|i| self.soup.points[i]);
                let mut face = (q - p).cross(r - p);
                if face.dot(self.scenery.lens.eye - place) < 0.0 {
                    face = -face;
                }
                self.rigid(colour, place, if normal.dot(face) < 0.0 { -normal } else { normal })
            }
        }
    }

    fn sunlight(&self, place: Vec3, normal: Vec3) -> (f32, f32) {
        let incidence = normal.dot(self.towards_sun);
        if incidence <= 0.0 { (0.0, 0.0) } else { (incidence, self.sun.reaches(place, normal)) }
    }

    /// Light of the sky on a surface, more from above than from below, where the ground gives back some of the sun's.
    fn ambient(normal: Vec3, sky: f32) -> Vec3 {
        let up = 0.5 + 0.5 * normal.z;
        sky * (SKYLIGHT * (0.35 + 0.65 * up) + Vec3::new(0.16, 0.13, 0.10) * (1.0 - up))
    }

    fn ground(&self, ground: &Ground, place: Vec3, normal: Vec3, sky: f32) -> Vec3 {
        let high = self.scenery.heights.map_or(0.5, |(level, range)| 0.5 + 0.5 * (place.z - level) / range);
        let grain = 1.0 + 0.07 * ground.grain * self.grain(place);
        let colour = Vec3::from_array(ground.at(high)) * grain;
        let (incidence, reaches) = self.sunlight(place, normal);
        let direct = rough(incidence.min(1.0)) * reaches * (0.4 + 0.6 * sky.min(1.0));
        // Most grounds do not shine at all.
        let gloss =
            if ground.gloss > 0.0 && reaches > 0.0 { ground.gloss * self.shine(place, normal, 24.0) } else { 0.0 };
        colour * (SUNLIGHT * direct + Self::ambient(normal, sky)) + SUNLIGHT * gloss * reaches
    }

    fn rigid(&self, colour: Vec3, place: Vec3, normal: Vec3) -> Vec3 {
        let (incidence, reaches) = self.sunlight(place, normal);
        let sky = self.sky.seen(place, normal);
        let shine = 0.16 * self.shine(place, normal, 40.0) * reaches;
        let eye = (self.scenery.lens.eye - place).normalize_or_zero();
        // Grazing surfaces mirror the sky.
        let mirror = 0.10 * (1.0 - normal.dot(eye).clamp(0.0, 1.0)).powi(4) * sky;
        colour * (SUNLIGHT * incidence * reaches + Self::ambient(normal, sky)) + SUNLIGHT * shine + SKYLIGHT * mirror
    }

    fn shine(&self, place: Vec3, normal: Vec3, sharp: f32) -> f32 {
        let eye = (self.scenery.lens.eye - place).normalize_or_zero();
        let half = (eye + self.towards_sun).normalize_or_zero();
        normal.dot(half).max(0.0).powf(sharp)
    }

    /// A fixed grain in space, -1 to 1: ground is never evenly coloured.
    fn grain(&self, place: Vec3) -> f32 {
        // As fine as pixels are in the picture's middle.
        let cell = (1.2 * self.scenery.distance / self.scenery.lens.focal).min(0.5 * self.scenery.spacing);
        let [x, y, z] = (place / cell).floor().to_array().map(|c| c as i32 as u32);
        let mut hash = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ z.wrapping_mul(0xc2b2_ae35);
        hash = (hash ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d);
        hash = (hash ^ (hash >> 12)).wrapping_mul(0x297a_2d39);
        ((hash ^ (hash >> 15)) >> 8) as f32 / 8_388_608.0 - 1.0
    }

    /// The floor, which fades into the horizon, or what is behind everything.
    fn background(&self, column: f32, row: f32, height: usize) -> Vec3 {
        let air = self.air[0].lerp(self.air[1], 1.0 - (row / height as f32).clamp(0.0, 1.0));
        let ray = self.scenery.lens.ray(column, row);
        let eye = self.scenery.lens.eye;
        let Some(floor) = self.floor.filter(|floor| ray.z < -1e-4 && *floor < eye.z) else { return air };
        let place = eye + ray * ((floor - eye.z) / ray.z);
        let away = (place - self.scenery.target).length() / self.scenery.distance;
        let near = 1.0 - smoothstep(0.3, 1.6, away);
        if near <= 0.0 {
            return air;
        }
        let (incidence, reaches) = self.sunlight(place, Vec3::Z);
        // Beyond the walls, the field of the sky goes on as if there were ground.
        let (low, high) = (self.scenery.bed.min.truncate(), self.scenery.bed.max.truncate());
        let within = place.truncate().cmpge(low).all() && place.truncate().cmple(high).all();
        let sky = if within { self.sky.seen(place, Vec3::Z) } else { 1.0 };
        let light = SUNLIGHT * incidence * reaches + Self::ambient(Vec3::Z, sky);
        air.lerp(self.stone * light, near)
    }
}

#[cfg(test)]
mod tests {
    use super::super::camera::Camera;
    use super::*;
    use barchan_core::surface::{Mesh, Surface};
    use std::sync::Arc;

    /// A ball of so many sides along its equator.
    fn ball(radius: f32, middle: [f64; 3]) -> Surface {
        let at = |i: usize, j: usize| {
            let (turn, tilt) = ((i % 48) as f32 / 48.0 * std::f32::consts::TAU, j as f32 / 24.0 * std::f32::consts::PI);
            [tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()].map(|x| radius * x)
        };
        let quads = (0..48).flat_map(|i| (0..24).map(move |j| (i, j)));
        let corners = quads.flat_map(|(i, j)| {
            let [a, b, c, d] = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
            [[a, b, c], [a, c, d]]
        });
        let mesh = Arc::new(Mesh::new(corners.collect()));
        Surface { mesh, position: middle, rotation: [1.0, 0.0, 0.0, 0.0], colour: Some([0.8, 0.1, 0.1]) }
    }

    fn picture(camera: Camera, size: [usize; 2], dots: &[Dot], surfaces: &[Surface], floor: bool) -> Image {
        let lens = camera.lens([0.0; 3], size[0], size[1]);
        let target = Vec3::from_array(camera.target.map(|x| x as f32));
        let walls = [floor; 5];
        let scenery = Scenery {
            lens,
            target,
            distance: lens.eye.distance(target),
            dots,
            spacing: 0.01,
            bed: Bed { min: Vec3::ZERO, max: Vec3::ONE, walls },
            heights: None,
            grounds: &[Ground::of_law("sand")],
            surfaces,
            origin: [0.0; 3],
        };
        let mut image = Image::new(size[0], size[1], [0; 3]);
        draw(&mut image, &scenery);
        image
    }

    #[test]
    fn a_balls_outline_has_its_area() {
        let camera = Camera { position: [0.5, -2.5, 0.5], target: [0.5; 3], fov: 0.4 };
        let image = picture(camera, [400, 300], &[], &[ball(0.2, [0.5; 3])], false);
        let red = image.pixels().iter().filter(|[r, g, _]| *r / 2 > *g).count() as f64;
        // Its outline is a cone that touches it.
        let tangent = (0.2f64 / 3.0).asin().tan();
        let expected = std::f64::consts::PI * (tangent * 200.0 / 0.2f64.tan()).powi(2);
        println!("{red} pixels, {expected:.0} expected, tolerance 3 %");
        assert!((red / expected - 1.0).abs() < 0.03, "{red} pixels, not {expected}");
        let at = |x: usize, y: usize| i32::from(image.pixels()[y * 400 + x][0]);
        let (lit, dark) = (at(165, 126), at(235, 174));
        assert!(lit > dark + 60, "the sun is at the upper left: {lit} and {dark}");
    }

    #[test]
    fn a_shadow_falls_away_from_the_sun_and_touches_the_feet() {
        // From above, x to the right and y up: the sun is on the left and below, so that the shadow is on the right and above.
        let camera = Camera { position: [0.5, 0.5, 4.0], target: [0.5, 0.5, 0.0], fov: 0.5 };
        let image = picture(camera, [200, 200], &[], &[ball(0.1, [0.5, 0.5, 0.1])], true);
        let lens = camera.lens([0.0; 3], 200, 200);
        let light = |x: f32, y: f32| {
            let at = lens.project(Vec3::new(x, y, 0.0));
            image.pixels()[at.y as usize * 200 + at.x as usize].iter().map(|&c| i32::from(c)).sum::<i32>()
        };
        let sun = Vec3::from_array(SUN);
        // Where the sun's ray through the ball's middle meets the floor.
        let (dx, dy) = (-sun.x / sun.z * 0.1, -sun.y / sun.z * 0.1);
        let [shadow, mirrored, far] = [light(0.5 + dx, 0.5 + dy), light(0.5 - dx, 0.5 - dy), light(0.8, 0.2)];
        assert!(shadow < mirrored - 150, "{shadow} in the shadow, {mirrored} on the other side");
        assert!((mirrored - far).abs() < 60, "{mirrored} near it, {far} away from it");
    }

    #[test]
    fn a_footprint_is_seen() {
        let print = |p: [f32; 3]| (p[0] - 0.5).abs() < 0.06 && (p[1] - 0.5).abs() < 0.06;
        let dots: Vec<Dot> = (0..100 * 100 * 10)
            .map(|n| [n % 100, n / 100 % 100, n / 10_000].map(|i| (i as f32 + 0.5) * 0.01))
            .filter(|&p| p[2] < if print(p) { 0.07 } else { 0.1 })
            .map(|position| Dot { position, ground: 0, value: 0.0, side: 0.01 })
            .collect();
        let camera = Camera { position: [0.5, 0.5, 4.0], target: [0.5, 0.5, 0.1], fov: 0.25 };
        let image = picture(camera, [200, 200], &dots, &[], true);
        let mean = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
            let all = y.flat_map(|y| x.clone().map(move |x| y * 200 + x));
            let light: Vec<f64> = all.map(|i| f64::from(image.pixels()[i][1])).collect();
            light.iter().sum::<f64>() / light.len() as f64
        };
        // Ten pixels are 49 mm: the print is 25 wide, and its wall towards the sun, on the left, shades its floor.
        let (inside, beside) = (mean(92..100, 96..104), mean(30..60, 96..104));
        println!("{inside:.0} in the print, {beside:.0} beside it");
        assert!(inside < beside - 10.0, "{inside} in the print, {beside} beside it");
    }
}
