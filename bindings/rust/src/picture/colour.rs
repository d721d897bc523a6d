//! Colour maps.

use super::image::{Colour, mix};

/// Nine samples of viridis at even distances, dark to light with even steps of lightness.
///
/// # Source
/// Smith and van der Walt 2015, matplotlib's default colour map, released under CC0.
const VIRIDIS: [Colour; 9] = [
    [0x44, 0x01, 0x54],
    [0x47, 0x2d, 0x7b],
    [0x3b, 0x52, 0x8b],
    [0x2c, 0x72, 0x8e],
    [0x21, 0x91, 0x8c],
    [0x28, 0xae, 0x80],
    [0x5e, 0xc9, 0x62],
    [0xad, 0xdc, 0x30],
    [0xfd, 0xe7, 0x25],
];

/// Viridis at `t`, 0 to 1.
pub(super) fn viridis(t: f32) -> Colour {
    let position = t.clamp(0.0, 1.0) * 8.0;
    let index = (position as usize).min(7);
    mix(VIRIDIS[index], VIRIDIS[index + 1], position - index as f32)
}

/// What ground looks like in full light: linear reflectance low down, at its starting height, and high up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ground {
    stops: [[f32; 3]; 3],
    /// How uneven its colour is, from grain to grain, and how much it shines, 0 to 1.
    pub grain: f32,
    pub gloss: f32,
}

impl Ground {
    /// The look of a material law, by its name in the registry; others look like clay.
    pub(super) fn of_law(law: &str) -> Self {
        let stops: [Colour; 3] = match law {
            "sand" => [[166, 124, 78], [222, 186, 132], [246, 224, 182]],
            "snow" => [[150, 172, 204], [214, 222, 234], [240, 244, 250]],
            "liquid" => [[24, 78, 140], [56, 128, 190], [126, 186, 226]],
            "neo_hookean" | "fixed_corotated" | "hencky" => [[30, 110, 108], [72, 168, 158], [150, 214, 200]],
            _ => [[120, 74, 60], [184, 122, 98], [222, 172, 148]],
        };
        let (grain, gloss) = match law {
            "sand" => (1.0, 0.0),
            "snow" => (0.4, 0.0),
            "liquid" => (0.0, 0.5),
            "neo_hookean" | "fixed_corotated" | "hencky" => (0.0, 0.25),
            _ => (0.7, 0.0),
        };
        Self { stops: stops.map(|stop| stop.map(linear)), grain, gloss }
    }
    /// Reflectance at `t`: 0 low, ½ as it started, 1 high.
    pub(super) fn at(&self, t: f32) -> [f32; 3] {
        let t = t.clamp(0.0, 1.0) * 2.0;
        let (a, b, f) =
            if t < 1.0 { (self.stops[0], self.stops[1], t) } else { (self.stops[1], self.stops[2], t - 1.0) };
        std::array::from_fn(|c| a[c] + (b[c] - a[c]) * f)
    }
}

/// From an sRGB byte to linear light, 0 to 1.
pub(super) fn linear(byte: u8) -> f32 {
    let v = f32::from(byte) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// From linear light to an sRGB byte, by a table: pictures need it 3 times a pixel. Light above 0.7 is pressed together,
/// so that slopes facing the sun keep their shape.
pub(super) fn encode(light: f32) -> u8 {
    const SIZE: usize = 8192;
    const KNEE: f32 = 0.7;
    const MOST: f32 = 2.0;
    static TABLE: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let curve = |v: f32| if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
        let pressed = |v: f32| if v <= KNEE { v } else { 1.0 - (1.0 - KNEE) * ((KNEE - v) / (1.0 - KNEE)).exp() };
        (0..=SIZE).map(|i| (curve(pressed(i as f32 * MOST / SIZE as f32)) * 255.0).round() as u8).collect()
    });
    table[(light.clamp(0.0, MOST) / MOST * SIZE as f32) as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viridis_gets_lighter_all_the_way() {
        let light = |c: Colour| 0.2126 * linear(c[0]) + 0.7152 * linear(c[1]) + 0.0722 * linear(c[2]);
        let samples: Vec<f32> = (0..=64).map(|i| light(viridis(i as f32 / 64.0))).collect();
        assert!(samples.windows(2).all(|w| w[1] > w[0]));
        assert_eq!(viridis(-1.0), VIRIDIS[0]);
        assert_eq!(viridis(2.0), VIRIDIS[8]);
    }

    #[test]
    fn srgb_goes_there_and_back_below_the_knee() {
        for byte in 0..=216 {
            assert!(encode(linear(byte)).abs_diff(byte) <= 1, "{byte}");
        }
        assert!((217..=255).all(|byte| encode(linear(byte)) <= byte) && encode(2.0) > 250);
    }
}
