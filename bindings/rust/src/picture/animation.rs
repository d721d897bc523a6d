//! Animations (GIF) and contact sheets made from finished frames.

use super::image::{Align, Colour, Image};
use super::{INK, PAGE};
use rayon::prelude::*;
use std::io;

/// Encodes `count` frames as an endlessly looping GIF of at most `limit` bytes, each shown for `seconds`; if it would get
/// larger, every second frame is left out and the others are shown longer, again and again. Each frame is loaded once.
///
/// One palette serves all frames and a pixel that stays the same is not written again.
///
/// # Errors
/// What `load` or the encoder says; if there are no frames or they differ in size.
pub fn gif(
    count: usize,
    load: impl Fn(usize) -> io::Result<Image> + Sync,
    seconds: f64,
    limit: usize,
) -> io::Result<Vec<u8>> {
    let refuse = |what: &'static str| io::Error::new(io::ErrorKind::InvalidInput, what);
    if count == 0 {
        return Err(refuse("no frames"));
    }
    let apart = count.div_ceil(16);
    let sample: Vec<Image> =
        (0..count.div_ceil(apart)).into_par_iter().map(|i| load(i * apart)).collect::<io::Result<_>>()?;
    let size = (sample[0].width(), sample[0].height());
    let palette = Palette::of(&sample);
    let index = |i: usize| {
        let loaded = if i.is_multiple_of(apart) { None } else { Some(load(i)?) };
        match loaded.as_ref().unwrap_or(&sample[i / apart]) {
            frame if (frame.width(), frame.height()) == size => Ok(palette.indices(frame)),
            _ => Err(refuse("frames differ in size")),
        }
    };
    let indexed: Vec<Vec<u8>> = (0..count).into_par_iter().map(index).collect::<io::Result<_>>()?;
    let mut stride = 1;
    loop {
        let shown: Vec<&[u8]> = indexed.iter().step_by(stride).map(Vec::as_slice).collect();
        let most = if shown.len() <= 2 { usize::MAX } else { limit };
        if let Some(bytes) = encode(&shown, size, &palette, seconds * stride as f64, most)? {
            return Ok(bytes);
        }
        stride *= 2;
    }
}

/// The animation, or `None` if it has more than `most` bytes.
fn encode(
    frames: &[&[u8]],
    size: (usize, usize),
    palette: &Palette,
    seconds: f64,
    most: usize,
) -> io::Result<Option<Vec<u8>>> {
    // Frames compressed at the same time.
    const BATCH: usize = 16;
    let (width, height) = (size.0 as u16, size.1 as u16);
    let colours: Vec<u8> = palette.colours.as_flattened().to_vec();
    // Viewers take hundredths of a second, and slow down what is under two of them.
    let delay = (seconds * 100.0).round().max(2.0) as u16;
    let compressed = |i: usize| {
        let buffer = match i.checked_sub(1).map(|before| frames[before]) {
            Some(before) => {
                let changed = frames[i].iter().zip(before);
                changed.map(|(&now, &then)| if now == then { TRANSPARENT } else { now }).collect()
            }
            None => frames[i].to_vec(),
        };
        let mut frame = gif::Frame {
            width,
            height,
            delay: if i + 1 == frames.len() { 150 } else { delay },
            buffer: buffer.into(),
            transparent: Some(TRANSPARENT),
            dispose: gif::DisposalMethod::Keep,
            ..gif::Frame::default()
        };
        frame.make_lzw_pre_encoded();
        frame
    };
    let mut encoder = gif::Encoder::new(Vec::new(), width, height, &colours).map_err(io::Error::other)?;
    encoder.set_repeat(gif::Repeat::Infinite).map_err(io::Error::other)?;
    for first in (0..frames.len()).step_by(BATCH) {
        let batch: Vec<gif::Frame<'_>> =
            (first..(first + BATCH).min(frames.len())).into_par_iter().map(compressed).collect();
        for frame in &batch {
            encoder.write_lzw_pre_encoded_frame(frame).map_err(io::Error::other)?;
        }
        if encoder.get_ref().len() > most {
            return Ok(None);
        }
    }
    let bytes = encoder.into_inner().map_err(io::Error::other)?;
    Ok((bytes.len() <= most).then_some(bytes))
}

/// Index that stands for "as before".
const TRANSPARENT: u8 = 255;
/// Bits kept of each colour channel when counting and looking up colours.
const BITS: usize = 5;

/// Up to 255 colours, and for each coarse colour the nearest of them.
struct Palette {
    colours: Vec<Colour>,
    nearest: Vec<u8>,
}

impl Palette {
    /// By median cut over some frames.
    fn of(frames: &[Image]) -> Self {
        let mut counts = vec![0u32; 1 << (3 * BITS)];
        for frame in frames {
            frame.pixels().iter().for_each(|&p| counts[key(p)] += 1);
        }
        let used = (0..counts.len()).filter(|&k| counts[k] > 0).map(|k| (middle(k), counts[k]));
        let mut boxes: Vec<Vec<(Colour, u32)>> = vec![used.collect()];
        // Cut the box with the greatest spread, weighted by how often its colours occur.
        while boxes.len() < 255 {
            let worst = (0..boxes.len()).max_by(|&a, &b| spread(&boxes[a]).0.total_cmp(&spread(&boxes[b]).0));
            let Some(worst) = worst.filter(|&i| boxes[i].len() > 1) else { break };
            let mut colours = boxes.swap_remove(worst);
            let channel = spread(&colours).1;
            colours.sort_unstable_by_key(|(c, _)| c[channel]);
            let half = colours.iter().map(|(_, n)| u64::from(*n)).sum::<u64>() / 2;
            let mut seen = 0;
            let cut = colours.iter().position(|(_, n)| {
                seen += u64::from(*n);
                seen > half
            });
            let rest = colours.split_off(cut.unwrap_or(1).clamp(1, colours.len() - 1));
            boxes.extend([colours, rest]);
        }
        let colours: Vec<Colour> = boxes
            .iter()
            .map(|colours| {
                let total: u64 = colours.iter().map(|(_, n)| u64::from(*n)).sum::<u64>().max(1);
                let sum = |c: usize| colours.iter().map(|(p, n)| u64::from(p[c]) * u64::from(*n)).sum::<u64>();
                std::array::from_fn(|c| (sum(c) / total) as u8)
            })
            .collect();
        let nearest = (0..counts.len())
            .map(|k| {
                let distance = |c: &Colour| (0..3).map(|d| (i32::from(c[d]) - i32::from(middle(k)[d])).pow(2)).sum();
                let best = colours.iter().enumerate().min_by_key(|(_, c)| -> i32 { distance(c) });
                best.map_or(0, |(i, _)| i as u8)
            })
            .collect();
        Self { colours, nearest }
    }
    fn indices(&self, frame: &Image) -> Vec<u8> {
        frame.pixels().iter().map(|&p| self.nearest[key(p)]).collect()
    }
}

fn key(colour: Colour) -> usize {
    colour.iter().fold(0, |key, &c| key << BITS | usize::from(c) >> (8 - BITS))
}

fn middle(key: usize) -> Colour {
    let mask = (1 << BITS) - 1;
    let channel = |shift: usize| ((key >> shift & mask) << (8 - BITS) | 1 << (7 - BITS)) as u8;
    [channel(2 * BITS), channel(BITS), channel(0)]
}

/// Weighted variance of the channel that varies most, and that channel.
fn spread(colours: &[(Colour, u32)]) -> (f64, usize) {
    let total: f64 = colours.iter().map(|(_, n)| f64::from(*n)).sum();
    let variance = |c: usize| {
        let mean = colours.iter().map(|(p, n)| f64::from(p[c]) * f64::from(*n)).sum::<f64>() / total;
        colours.iter().map(|(p, n)| (f64::from(p[c]) - mean).powi(2) * f64::from(*n)).sum::<f64>()
    };
    (0..3).map(|c| (variance(c), c)).fold((-1.0, 0), |a, b| if b.0 > a.0 { b } else { a })
}

/// Pictures side by side in `columns`, each `width` pixels wide with its label below, on a page.
pub fn contact_sheet(pictures: &[(Image, String)], columns: usize, width: usize) -> Image {
    const GAP: usize = 10;
    const LABEL: usize = 20;
    let small: Vec<(Image, &str)> = pictures.iter().map(|(p, label)| (p.shrunk(width), label.as_str())).collect();
    let (cell_width, cell_height) = small.iter().fold((1, 1), |(w, h), (p, _)| (p.width().max(w), p.height().max(h)));
    let rows = small.len().div_ceil(columns);
    let mut sheet = Image::new(
        columns.min(small.len().max(1)) * (cell_width + GAP) + GAP,
        rows * (cell_height + LABEL + GAP) + GAP,
        PAGE,
    );
    for (i, (picture, label)) in small.iter().enumerate() {
        let x = GAP + i % columns * (cell_width + GAP);
        let y = GAP + i / columns * (cell_height + LABEL + GAP);
        sheet.paste(picture, x, y);
        sheet.text(x as f32 + 2.0, (y + cell_height + 6) as f32, 8.75, Align::Left, INK, label);
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<Image> {
        (0..20)
            .map(|f| {
                let mut image = Image::new(64, 32, [230, 200, 150]);
                for i in 0..64 * 32 {
                    image.pixels_mut()[i][0] = (i % 64 * 4) as u8;
                }
                image.fill(super::super::image::Rect { x: f * 3, y: 10, width: 6, height: 6 }, [40, 50, 60]);
                image
            })
            .collect()
    }

    #[test]
    fn a_gif_reads_back_close_to_its_frames() {
        let frames = frames();
        let bytes = gif(frames.len(), |i| Ok(frames[i].clone()), 0.05, 1 << 20).unwrap();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(bytes.as_slice()).unwrap();
        let mut screen = frames[0].clone();
        let mut count = 0;
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            for (pixel, rgba) in screen.pixels_mut().iter_mut().zip(frame.buffer.chunks(4)) {
                if rgba[3] > 0 {
                    *pixel = [rgba[0], rgba[1], rgba[2]];
                }
            }
            for (a, b) in screen.pixels().iter().zip(frames[count].pixels()) {
                assert!((0..3).all(|c| a[c].abs_diff(b[c]) <= 12), "{a:?} for {b:?} in frame {count}");
            }
            count += 1;
        }
        assert_eq!(count, frames.len());
    }

    #[test]
    fn a_gif_over_its_limit_drops_frames() {
        let frames = frames();
        let whole = gif(frames.len(), |i| Ok(frames[i].clone()), 0.05, 1 << 20).unwrap();
        let less = gif(frames.len(), |i| Ok(frames[i].clone()), 0.05, whole.len() - 1).unwrap();
        assert!(less.len() < whole.len());
        assert!(gif(0, |i| Ok(frames[i].clone()), 0.05, 100).is_err());
    }

    #[test]
    fn a_contact_sheet_holds_all_pictures() {
        let pictures: Vec<_> = frames().into_iter().take(5).map(|p| (p, "t = 1 s".to_owned())).collect();
        let sheet = contact_sheet(&pictures, 3, 32);
        assert_eq!((sheet.width(), sheet.height()), (3 * 42 + 10, 2 * (16 + 30) + 10));
    }
}
