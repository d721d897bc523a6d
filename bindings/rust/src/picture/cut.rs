//! A vertical cut through the ground, coloured by pressure or speed.

use super::colour::viridis;
use super::image::Image;
use super::relief::{Dot, smoothstep};
use super::tools::Frame;

/// Draws dots, seen along y, coloured from 0 to `top`.
pub(super) fn draw(image: &mut Image, frame: Frame, dots: &[Dot], top: f32) {
    let (width, height) = (image.width(), image.height());
    let scale = frame.scale as f32;
    let mut sum = vec![[0.0f32; 2]; width * height];
    let mut cover = vec![0.0f32; width * height];
    for dot in dots {
        // A dot colours its surroundings up to `reach` and covers a disc of `radius`: neighbours overlap, so ground is whole. It ends above where its cube does.
        let (reach, radius) = (1.25 * dot.side * scale, (0.72 * dot.side * scale).max(0.7));
        let above = (0.5 * dot.side * scale).max(0.7);
        let box_reach = reach.max(radius + 0.5);
        let x = (dot.position[0] - frame.origin[0] as f32) * scale - 0.5;
        let y = height as f32 - (dot.position[2] - frame.origin[1] as f32) * scale - 0.5;
        let range = |at: f32, count: usize| {
            let first = (at - box_reach).ceil().clamp(0.0, count as f32) as usize;
            first..((at + box_reach).floor() + 1.0).clamp(first as f32, count as f32) as usize
        };
        for row in range(y, height) {
            for column in range(x, width) {
                let d2 = (column as f32 - x).powi(2) + (row as f32 - y).powi(2);
                let pixel = row * width + column;
                let weight = (1.0 - d2 / (reach * reach)).max(0.0).powi(2) + 1e-6;
                sum[pixel][0] += weight;
                sum[pixel][1] += weight * dot.value;
                cover[pixel] = cover[pixel].max((radius - d2.sqrt()).min(above - (y - row as f32)) + 0.5);
            }
        }
    }
    for (pixel, (sum, cover)) in image.pixels_mut().iter_mut().zip(sum.iter().zip(cover)) {
        // Inside, where the discs leave a chink, the weights of all around still add up.
        let cover = cover.max(smoothstep(0.7, 1.1, sum[0]));
        if cover > 0.0 {
            *pixel = super::image::mix(*pixel, viridis(sum[1] / sum[0] / top), cover);
        }
    }
}

/// The least round number that is at least `value`: such as 1.5, 20 or 250; 0 stays 0.
pub(super) fn round_up(value: f64) -> f64 {
    if value <= 0.0 || !value.is_finite() {
        return 0.0;
    }
    let power = 10f64.powf(value.log10().floor());
    let digit =
        [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0].into_iter().find(|d| d * power >= value * (1.0 - 1e-9));
    digit.unwrap_or(10.0) * power
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_round() {
        for (value, round) in
            [(0.033, 0.04), (1.0, 1.0), (1.1, 1.5), (2300.0, 2500.0), (7e5, 8e5), (9e5, 1e6), (0.0, 0.0)]
        {
            assert!((round_up(value) - round).abs() <= 1e-9 * round, "{value} -> {}", round_up(value));
        }
    }

    #[test]
    fn ground_is_whole_and_coloured_by_value() {
        let spacing = 0.01;
        let dots: Vec<Dot> = (0..100)
            .map(|i| Dot {
                position: [((i % 10) as f32 + 0.5) * spacing, 0.0, ((i / 10) as f32 + 0.5) * spacing],
                ground: 0,
                side: spacing,
                value: 1.0 - 0.1 * (i / 10) as f32,
            })
            .collect();
        let mut image = Image::new(40, 80, [255; 3]);
        let frame = Frame { origin: [0.03, 0.0], scale: 800.0 };
        draw(&mut image, frame, &dots, 1.0);
        assert!(image.pixels().iter().all(|&p| p != [255; 3]), "a hole in whole ground");
        let (top, bottom) = (image.pixels()[0], image.pixels()[79 * 40]);
        assert!(bottom[0] > 200 && top[0] < 90, "{bottom:?} should be yellow and {top:?} dark");
    }

    /// Coarse ground stands as high as fine ground of the same surface.
    #[test]
    fn ground_ends_where_its_particles_do() {
        for cells in [5, 20] {
            let side = 0.1 / cells as f32;
            let dots: Vec<Dot> = (0..cells * cells)
                .map(|i| Dot {
                    position: [((i % cells) as f32 + 0.5) * side, 0.0, ((i / cells) as f32 + 0.5) * side],
                    ground: 0,
                    side,
                    value: 1.0,
                })
                .collect();
            let mut image = Image::new(80, 120, [255; 3]);
            draw(&mut image, Frame { origin: [0.01, 0.0], scale: 1000.0 }, &dots, 1.0);
            let covered = (0..120).filter(|row| image.pixels()[row * 80 + 40] != [255; 3]).count();
            assert!((100..=101).contains(&covered), "{cells} particles deep: {covered} rows of 100");
        }
    }
}
