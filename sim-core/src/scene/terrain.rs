//! Terrain: ground whose surface is a function of place.
//!
//! Heights are made of sums, products, quotients, square roots and whole parts alone, and angles are turned into slopes by `libm`.
//! So they are the same bits on every machine, and a surface can be asked anywhere.

use crate::Vec3;
use crate::seed::uniform;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Everything between `bottom` and a surface that is a function of place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Terrain {
    /// Least x and y [m].
    pub min: [f64; 2],
    /// Greatest x and y [m]. Where only what is within `levels.reach` is live, a large terrain costs no more than a small one.
    pub max: [f64; 2],
    /// Lower end [m].
    pub bottom: f64,
    /// Where the surface has its own origin [m]; heights are above its z.
    #[serde(default)]
    pub origin: Vec3,
    /// The surface.
    pub surface: Surface,
}

/// The surface of a terrain.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Surface {
    /// Level, at the origin's height.
    Flat,
    /// A plane through the origin.
    Slope {
        /// Angle to the horizontal, from -60 to 60 [degrees].
        slope_deg: f64,
        /// Where it rises, from x towards y [degrees].
        #[serde(default)]
        direction_deg: f64,
    },
    /// Ridges across the wind, as it blows them from sand: they bend, end and begin anew, climb gently and fall off steeply in the lee.
    Dunes {
        /// Mean distance from crest to crest along the wind [m].
        wavelength: f64,
        /// Height of the highest crests above the troughs, which are at the origin's height [m].
        height: f64,
        /// Where the wind blows to, from x towards y [degrees].
        #[serde(default)]
        wind_deg: f64,
        /// Greatest angle of the lee side, from 1 to 60 [degrees]: below the angle of repose, or the lee slides. Nothing else is steeper.
        #[serde(default = "default_lee")]
        lee_deg: f64,
        /// Another seed is another landscape.
        #[serde(default)]
        seed: u64,
    },
    /// Mounds and hollows without a direction.
    Bumps {
        /// Mean distance from mound to mound [m].
        wavelength: f64,
        /// Height of the highest possible mounds above the deepest possible hollows, which are at the origin's height [m].
        height: f64,
        /// Another seed is another landscape.
        #[serde(default)]
        seed: u64,
    },
    /// Steps that begin at the origin: level before, with a riser there and one after each run.
    Stairs {
        /// Depth of a step along the stairs [m].
        run: f64,
        /// Height of a step [m]; below 0 the stairs go down.
        rise: f64,
        /// Number of steps, from 1 to 1000; then the ground is level.
        count: u32,
        /// Where they lead, from x towards y [degrees].
        #[serde(default)]
        direction_deg: f64,
    },
}

fn default_lee() -> f64 {
    30.0
}

/// A terrain's heights, its angles turned into slopes.
#[derive(Clone, Copy, Debug)]
pub struct Heights {
    origin: Vec3,
    /// Unit vector uphill, down the wind or along the stairs.
    along: [f64; 2],
    form: Form,
}

/// What is left of a [`Surface`] when its direction is known.
#[derive(Clone, Copy, Debug)]
enum Form {
    Flat,
    Slope { rise: f64 },
    Dunes { wavelength: f64, height: f64, lee: Lee, seed: u64 },
    Bumps { wavelength: f64, height: f64, seed: u64 },
    Stairs { run: f64, rise: f64, count: f64 },
}

/// The lee sides of dunes.
#[derive(Clone, Copy, Debug)]
struct Lee {
    /// Greatest slope.
    slope: f64,
    /// Part of a wavelength.
    part: f64,
}

/// Greatest slope of [`noise`], for cells of side 1.
const NOISE_SLOPE: f64 = 3.0;
/// By how much of a wavelength noise shifts crests to either side.
const BEND: f64 = 0.4;
/// Cells of that noise along and across the wind, in wavelengths.
const BEND_CELL: [f64; 2] = [6.0, 3.0];
/// Wavelengths are shortened by this factor at most: the phase's greatest gradient, which is along the wind.
const SQUEEZE: f64 = 1.0 + BEND * NOISE_SLOPE / BEND_CELL[0];
/// Part of a crest's height that noise takes, at most twice that, and the side of its cells in wavelengths.
const SPARE: f64 = 0.3;
const SPARE_CELL: f64 = 2.5;
/// Slope that the changing height of crests adds at most, over height per wavelength.
const SPARE_SLOPE: f64 = SPARE * NOISE_SLOPE / SPARE_CELL;
/// Greatest part of a wavelength that the lee takes: with more it would be no steeper than the windward side, a smooth step whose
/// steepest slope is 1.5 times its mean.
const MOST_LEE: f64 = 0.4;

impl Lee {
    fn new(wavelength: f64, height: f64, lee_deg: f64) -> Self {
        let slope = libm::tan(lee_deg.to_radians());
        Self { slope, part: SQUEEZE / (slope * wavelength / height - SPARE_SLOPE) }
    }
}

/// Height of the highest dunes of a wavelength whose lee is nowhere steeper than an angle, and the windward side less steep [m].
pub(super) fn highest_dunes(wavelength: f64, lee_deg: f64) -> f64 {
    wavelength * libm::tan(lee_deg.to_radians()) / (SQUEEZE / MOST_LEE + SPARE_SLOPE)
}

impl Terrain {
    /// Its heights as a function.
    ///
    /// ```
    /// use barchan_core::scene::{Surface, Terrain};
    ///
    /// let surface = Surface::Stairs { run: 0.3, rise: 0.1, count: 5, direction_deg: 0.0 };
    /// let stairs = Terrain { min: [-1.0; 2], max: [3.0; 2], bottom: 0.0, origin: [0.0, 0.0, 0.2], surface };
    /// assert!((stairs.heights().at(0.31, 7.0) - 0.4).abs() < 1e-12);
    /// ```
    pub fn heights(&self) -> Heights {
        let (form, direction) = match self.surface {
            Surface::Flat => (Form::Flat, 0.0),
            Surface::Slope { slope_deg, direction_deg } => {
                (Form::Slope { rise: libm::tan(slope_deg.to_radians()) }, direction_deg)
            }
            Surface::Dunes { wavelength, height, wind_deg, lee_deg, seed } => {
                (Form::Dunes { wavelength, height, lee: Lee::new(wavelength, height, lee_deg), seed }, wind_deg)
            }
            Surface::Bumps { wavelength, height, seed } => (Form::Bumps { wavelength, height, seed }, 0.0),
            Surface::Stairs { run, rise, count, direction_deg } => {
                (Form::Stairs { run, rise, count: f64::from(count) }, direction_deg)
            }
        };
        let (sin, cos) = libm::sincos(direction.to_radians());
        Heights { origin: self.origin, along: [cos, sin], form }
    }
}

impl Heights {
    /// Height of the surface [m].
    pub fn at(&self, x: f64, y: f64) -> f64 {
        let ([x, y], [c, s]) = ([x - self.origin[0], y - self.origin[1]], self.along);
        let [u, v] = [c * x + s * y, c * y - s * x];
        let above = match self.form {
            Form::Flat => 0.0,
            Form::Slope { rise } => rise * u,
            Form::Dunes { wavelength, height, lee, seed } => height * dune(u / wavelength, v / wavelength, lee, seed),
            Form::Bumps { wavelength, height, seed } => height * bump(x / wavelength, y / wavelength, seed),
            Form::Stairs { run, rise, count } => rise * steps(u / run, count),
        };
        self.origin[2] + above
    }

    /// Heights between which the surface lies over a rectangle, perhaps by far [m].
    pub fn within(&self, min: [f64; 2], max: [f64; 2]) -> [f64; 2] {
        let corner = |i: usize| [[min[0], max[0]][i & 1], [min[1], max[1]][i >> 1]];
        let middle = [0, 1].map(|d| 0.5 * (min[d] + max[d]));
        let [a, b] = [0, 1].map(|d| 0.5 * (max[d] - min[d]));
        let low = self.origin[2];
        match self.form {
            // Monotone along one direction, so that the extremes are at corners.
            Form::Flat | Form::Slope { .. } | Form::Stairs { .. } => {
                let heights = [0, 1, 2, 3].map(|i| self.at(corner(i)[0], corner(i)[1]));
                [
                    heights.into_iter().fold(f64::INFINITY, f64::min),
                    heights.into_iter().fold(f64::NEG_INFINITY, f64::max),
                ]
            }
            Form::Dunes { height, .. } | Form::Bumps { height, .. } => {
                let off = self.steepest() * (a * a + b * b).sqrt();
                // Far beyond a wavelength the middle says nothing.
                if off >= height {
                    return [low, low + height];
                }
                let here = self.at(middle[0], middle[1]);
                [(here - off).max(low), (here + off).min(low + height)]
            }
        }
    }

    /// Greatest slope, as a tangent; infinite for stairs.
    pub fn steepest(&self) -> f64 {
        match self.form {
            Form::Flat => 0.0,
            Form::Slope { rise } => rise.abs(),
            Form::Dunes { lee, .. } => lee.slope,
            // Of two octaves of noise, two and one third, with cells of 1/2 and 1/4 wavelength.
            Form::Bumps { wavelength, height, .. } => 0.5 * height * NOISE_SLOPE * (4.0 + 4.0) / (3.0 * wavelength),
            Form::Stairs { .. } => f64::INFINITY,
        }
    }
}

/// Height of dunes at `u` wavelengths along the wind and `v` across it, from 0 to 1.
///
/// 1. Noise that changes slowly shifts the crests, so that they bend.
/// 2. Over each wavelength a smooth step climbs, and a straight slope falls off behind a sharp crest.
/// 3. Other noise makes crests high and low.
fn dune(u: f64, v: f64, lee: Lee, seed: u64) -> f64 {
    let phase = u + BEND * noise(seed, 0, u / BEND_CELL[0], v / BEND_CELL[1]);
    let t = phase - phase.floor();
    let climb = 1.0 - lee.part;
    let profile = if t < climb { smooth(t / climb) } else { (1.0 - t) / lee.part };
    profile * (1.0 - SPARE + SPARE * noise(seed, 1, u / SPARE_CELL, v / SPARE_CELL))
}

/// Height of mounds and hollows, from 0 to 1: noise of two octaves.
fn bump(x: f64, y: f64, seed: u64) -> f64 {
    let octave = |k: u64, cells: f64| noise(seed, k, cells * x, cells * y);
    0.5 + 0.5 * (2.0 * octave(0, 2.0) + octave(1, 4.0)) / 3.0
}

/// Steps climbed at `u` runs from the first riser.
fn steps(u: f64, count: f64) -> f64 {
    (u.floor() + 1.0).clamp(0.0, count)
}

/// Value noise: numbers from -1 to 1 at whole coordinates, joined smoothly. `kind` tells apart the noises of one seed.
fn noise(seed: u64, kind: u64, x: f64, y: f64) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let (a, b) = (smooth(x - i), smooth(y - j));
    // The numbers of neighbours below 0 go round.
    let at = |di: i64, dj: i64| {
        let [i, j] = [i as i64 + di, j as i64 + dj].map(|cell| cell as u64);
        2.0 * uniform(seed, i, j, kind) - 1.0
    };
    let row = |dj: i64| at(0, dj) * (1.0 - a) + at(1, dj) * a;
    row(0) * (1.0 - b) + row(1) * b
}

/// From 0 at 0 to 1 at 1, level at both.
fn smooth(t: f64) -> f64 {
    t * t * (3.0 - 2.0 * t)
}
