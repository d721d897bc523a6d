//! A plain RGB picture: blending, text, scaling, PNG.

use font8x8::UnicodeFonts;
use rayon::prelude::*;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Write};
use std::path::Path;

/// An sRGB colour.
pub type Colour = [u8; 3];

/// Where text stands relative to its anchor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// The text starts at the anchor.
    Left,
    /// The anchor is the text's middle.
    Centre,
    /// The text ends at the anchor.
    Right,
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    /// Left column.
    pub x: usize,
    /// Top row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// An RGB picture, rows from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width: usize,
    height: usize,
    pixels: Vec<Colour>,
}

impl Image {
    /// A picture of one colour.
    pub fn new(width: usize, height: usize, colour: Colour) -> Self {
        Self { width, height, pixels: vec![colour; width * height] }
    }
    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }
    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }
    /// All pixels, row by row.
    pub fn pixels(&self) -> &[Colour] {
        &self.pixels
    }
    /// All pixels, row by row, to write to.
    pub fn pixels_mut(&mut self) -> &mut [Colour] {
        &mut self.pixels
    }

    /// Mixes a colour into one pixel; outside the picture nothing happens.
    pub fn blend(&mut self, x: i64, y: i64, colour: Colour, alpha: f32) {
        if x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height {
            let pixel = &mut self.pixels[y as usize * self.width + x as usize];
            *pixel = mix(*pixel, colour, alpha);
        }
    }
    /// Fills a rectangle.
    pub fn fill(&mut self, rect: Rect, colour: Colour) {
        for y in rect.y..(rect.y + rect.height).min(self.height) {
            for x in rect.x..(rect.x + rect.width).min(self.width) {
                self.pixels[y * self.width + x] = colour;
            }
        }
    }
    /// Copies another picture in, with its top left corner at (x, y); what does not fit is cut off.
    pub fn paste(&mut self, other: &Self, x: usize, y: usize) {
        let columns = other.width.min(self.width.saturating_sub(x));
        for row in 0..other.height.min(self.height.saturating_sub(y)) {
            let from = row * other.width;
            let to = (y + row) * self.width + x;
            self.pixels[to..to + columns].copy_from_slice(&other.pixels[from..from + columns]);
        }
    }
    /// The part inside a rectangle.
    #[must_use]
    pub fn crop(&self, rect: Rect) -> Self {
        let width = rect.width.min(self.width.saturating_sub(rect.x));
        let height = rect.height.min(self.height.saturating_sub(rect.y));
        let rows = (rect.y..rect.y + height).map(|y| &self.pixels[y * self.width + rect.x..][..width]);
        Self { width, height, pixels: rows.flatten().copied().collect() }
    }
    /// Made smaller to `width` columns, each pixel the mean of the area that it covers.
    #[must_use]
    pub fn shrunk(&self, width: usize) -> Self {
        if width >= self.width {
            return self.clone();
        }
        let height = (self.height as f32 * width as f32 / self.width as f32).round().max(1.0) as usize;
        let (across, down) = (Shrink::new(self.width, width), Shrink::new(self.height, height));
        // Rows first, then columns: of each row of the small picture, the mean of the old rows that it covers.
        let mut pixels = vec![[0; 3]; width * height];
        pixels.par_chunks_mut(width).enumerate().for_each(|(y, small)| {
            let mut row = vec![[0.0f32; 3]; self.width];
            for (from, weight) in down.shares(y) {
                for (sum, pixel) in row.iter_mut().zip(&self.pixels[from * self.width..][..self.width]) {
                    (0..3).for_each(|c| sum[c] += weight * f32::from(pixel[c]));
                }
            }
            for (x, pixel) in small.iter_mut().enumerate() {
                let mut sum = [0.5f32; 3];
                for (from, weight) in across.shares(x) {
                    (0..3).for_each(|c| sum[c] += weight * row[from][c]);
                }
                *pixel = sum.map(|v| v as u8);
            }
        });
        Self { width, height, pixels }
    }

    /// Writes one line of text; `y` is the top of capital letters and `size` their height in pixels.
    pub fn text(&mut self, x: f32, y: f32, size: f32, align: Align, colour: Colour, text: &str) {
        let scale = size / 7.0;
        let mut pen = match align {
            Align::Left => x,
            Align::Centre => x - 0.5 * text_width(size, text),
            Align::Right => x - text_width(size, text),
        };
        // Rows of the font are 8; descenders reach the last.
        for glyph in text.chars().map(Glyph::new) {
            let (left, right) = (pen.floor() as i64, (pen + (glyph.ink + 1.0) * scale).ceil() as i64);
            let (top, bottom) = (y.floor() as i64 - 1, (y + 8.0 * scale).ceil() as i64 + 1);
            for row in top..bottom {
                for column in left..=right {
                    let u = (column as f32 + 0.5 - pen) / scale + glyph.first;
                    let v = (row as f32 + 0.5 - y) / scale;
                    // A sharpened bilinear reading of the bitmap rounds its corners.
                    let coverage = ((glyph.sample(u, v) - 0.5) * scale.max(1.0) * 1.6 + 0.5).clamp(0.0, 1.0);
                    if coverage > 0.0 {
                        self.blend(column, row, colour, coverage);
                    }
                }
            }
            pen += glyph.advance * scale;
        }
    }

    /// Writes a PNG file, with text chunks.
    ///
    /// # Errors
    /// What the file system says.
    pub fn write_png(&self, path: &Path, notes: &[(&str, &str)]) -> io::Result<()> {
        let mut file = BufWriter::new(File::create(path)?);
        self.encode_png(&mut file, notes)?;
        file.flush()
    }
    /// Writes what a PNG file holds, with text chunks.
    ///
    /// # Errors
    /// What the writer or the encoder says.
    pub fn encode_png(&self, out: &mut impl Write, notes: &[(&str, &str)]) -> io::Result<()> {
        let mut encoder = png::Encoder::new(out, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::Fast);
        for (keyword, text) in notes {
            encoder.add_itxt_chunk((*keyword).to_owned(), (*text).to_owned())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(self.pixels.as_flattened())?;
        Ok(writer.finish()?)
    }
    /// Reads a PNG file as [`write_png`](Self::write_png) writes it, with its text chunks.
    ///
    /// # Errors
    /// What the file system or the decoder says; also if the file is no 8-bit RGB picture.
    pub fn read_png(path: &Path) -> io::Result<(Self, Vec<(String, String)>)> {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info()?;
        let (width, height) = (reader.info().width as usize, reader.info().height as usize);
        if reader.output_color_type() != (png::ColorType::Rgb, png::BitDepth::Eight) {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "not an 8-bit RGB picture"));
        }
        let mut pixels = vec![[0; 3]; width * height];
        reader.next_frame(pixels.as_flattened_mut())?;
        let texts = &reader.info().utf8_text;
        let notes = texts.iter().map(|chunk| Ok((chunk.keyword.clone(), chunk.get_text()?)));
        let notes = notes.collect::<Result<_, png::DecodingError>>()?;
        Ok((Self { width, height, pixels }, notes))
    }
}

/// `a` and `b` mixed: all of `b` at alpha 1.
pub(super) fn mix(a: Colour, b: Colour, alpha: f32) -> Colour {
    std::array::from_fn(|c| {
        let (a, b) = (f32::from(a[c]), f32::from(b[c]));
        // A colour is not negative: half more, cut off, is rounded, without a call for every pixel.
        (a + (b - a) * alpha.clamp(0.0, 1.0) + 0.5) as u8
    })
}

/// A row of pixels made shorter.
struct Shrink {
    factor: f32,
    count: usize,
}

impl Shrink {
    fn new(count: usize, to: usize) -> Self {
        Self { factor: count as f32 / to as f32, count }
    }
    /// The old pixels that a new one covers, and what part of it each is.
    fn shares(&self, new: usize) -> impl Iterator<Item = (usize, f32)> {
        let (start, end) = (new as f32 * self.factor, (new + 1) as f32 * self.factor);
        let factor = self.factor;
        let share = move |i: usize| (i, (end.min((i + 1) as f32) - start.max(i as f32)) / factor);
        (start as usize..(end.ceil() as usize).min(self.count)).map(share)
    }
}

/// Width of a line of text in pixels.
pub fn text_width(size: f32, text: &str) -> f32 {
    text.chars().map(|c| Glyph::new(c).advance).sum::<f32>() * size / 7.0
}

/// A character of the 8 x 8 font, set proportionally; digits share one width so that counting text stands still.
struct Glyph {
    rows: [u8; 8],
    first: f32,
    ink: f32,
    advance: f32,
}

impl Glyph {
    fn new(character: char) -> Self {
        let rows = font8x8::BASIC_FONTS
            .get(character)
            .or_else(|| font8x8::LATIN_FONTS.get(character))
            .or_else(|| font8x8::GREEK_FONTS.get(character))
            .unwrap_or([0; 8]);
        let used = rows.iter().fold(0u8, |a, b| a | b);
        if used == 0 {
            return Self { rows, first: 0.0, ink: 0.0, advance: 4.0 };
        }
        let (first, ink) = (used.trailing_zeros() as f32, (8 - used.leading_zeros() - used.trailing_zeros()) as f32);
        let advance = if character.is_ascii_digit() { 8.0 } else { ink + 1.0 };
        let first = if character.is_ascii_digit() { 0.0 } else { first };
        Self { rows, first, ink: if character.is_ascii_digit() { 7.0 } else { ink }, advance }
    }
    /// Coverage at a point of the glyph, in font pixels.
    fn sample(&self, u: f32, v: f32) -> f32 {
        let (u, v) = (u - 0.5, v - 0.5);
        let (column, row) = (u.floor(), v.floor());
        let (fu, fv) = (u - column, v - row);
        let bit = |dx: i32, dy: i32| {
            let (x, y) = (column as i32 + dx, row as i32 + dy);
            f32::from((0..8).contains(&x) && (0..8).contains(&y) && self.rows[y as usize] >> x & 1 == 1)
        };
        (bit(0, 0) * (1.0 - fu) + bit(1, 0) * fu) * (1.0 - fv) + (bit(0, 1) * (1.0 - fu) + bit(1, 1) * fu) * fv
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_returns_pixels_and_notes() {
        let mut image = Image::new(40, 20, [10, 20, 30]);
        image.text(2.0, 2.0, 9.0, Align::Left, [255, 255, 255], "t = 1");
        let folder = std::env::temp_dir().join(format!("barchan-png-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.png");
        image.write_png(&path, &[("time", "1.25")]).unwrap();
        let (read, notes) = Image::read_png(&path).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!(read, image);
        assert_eq!(notes, [("time".to_owned(), "1.25".to_owned())]);
        assert!(image.pixels().contains(&[255, 255, 255]), "the text left no ink");
    }

    #[test]
    fn shrinking_keeps_the_mean() {
        let mut image = Image::new(9, 6, [0; 3]);
        image.pixels_mut().iter_mut().enumerate().for_each(|(i, p)| *p = [(i * 4) as u8; 3]);
        let mean = |i: &Image| i.pixels().iter().map(|p| f32::from(p[0])).sum::<f32>() / i.pixels().len() as f32;
        let small = image.shrunk(6);
        assert_eq!((small.width(), small.height()), (6, 4));
        assert!((mean(&small) - mean(&image)).abs() < 1.0);
    }
}
