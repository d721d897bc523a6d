//! Charts on logarithmic or linear axes, as PNG and as SVG from one list of strokes.

use super::image::{Align, Colour, Image, text_width};
use super::{INK, PAGE};
use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::Path;

const WIDTH: f64 = 960.0;
const HEIGHT: f64 = 640.0;
/// Edges of the plotted area: left, right, top, bottom.
const FRAME: [f64; 4] = [86.0, 936.0, 92.0, 574.0];
const GRID: Colour = [222, 218, 210];
/// Height of capital letters in pixels: titles, axes, labels of points.
const TITLE: f64 = 14.0;
const TEXT: f64 = 10.5;
const LABEL: f64 = 8.75;
/// Okabe and Ito's colours, which people with colour blindness tell apart, without the light ones.
const COLOURS: [Colour; 6] = [INK, [0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [120, 120, 120]];

/// A chart.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    /// What it shows.
    pub title: String,
    /// Quantity and unit along x.
    pub x: String,
    /// Quantity and unit along y.
    pub y: String,
    /// What is drawn, each in a colour of its own.
    pub series: Vec<Series>,
    /// How its axes are divided.
    pub axes: Axes,
}

/// How axes are divided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Axes {
    /// By decades; points that are not above 0 are left out.
    #[default]
    Logarithmic,
    /// Evenly.
    Linear,
}

/// Points of one kind.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x, y and label of each.
    pub points: Vec<(f64, f64, String)>,
    /// How they are drawn.
    pub style: Style,
}

/// How the points of a series are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Style {
    /// Each as a disc.
    #[default]
    Points,
    /// Discs, joined by a line.
    Joined,
    /// A line alone, behind all discs; it ends before a point that is not finite, and begins anew behind it.
    Line,
}

/// A point that can be drawn: x, y, label.
type Point<'a> = (f64, f64, &'a str);

/// What a chart is made of. Pixels from the top left.
enum Stroke {
    Line {
        from: [f64; 2],
        to: [f64; 2],
        width: f64,
        colour: Colour,
    },
    Disc {
        at: [f64; 2],
        radius: f64,
        colour: Colour,
    },
    /// `at` is the anchor at the top of capital letters, `size` their height.
    Text {
        at: [f64; 2],
        size: f64,
        align: Align,
        colour: Colour,
        text: String,
    },
}

impl Chart {
    /// Writes the chart twice, with the endings `.png` and `.svg`.
    ///
    /// # Errors
    /// What the file system says.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        let strokes = self.strokes();
        image(&strokes).write_png(&path.with_extension("png"), &[])?;
        fs::write(path.with_extension("svg"), svg(&strokes))
    }

    /// 1. Axes from the least to the greatest value, with lines at 1, 2 and 5 of each decade.
    /// 2. Lines of series, then points.
    /// 3. Labels of points, each where it covers least.
    fn strokes(&self) -> Vec<Stroke> {
        let series: Vec<(&Series, Vec<Point<'_>>)> = self.series.iter().map(|s| (s, s.shown(self.axes))).collect();
        let values = |get: fn(&Point<'_>) -> f64| series.iter().flat_map(|(_, points)| points).map(get);
        let x = Axis::new(self.axes, values(|p| p.0), FRAME[0], FRAME[1]);
        let y = Axis::new(self.axes, values(|p| p.1), FRAME[3], FRAME[2]);
        let mut strokes = self.frame(&x, &y);
        let mut labels = Vec::new();
        let mut taken: Vec<Area> = Vec::new();
        let mut legend = FRAME[0];
        let mut discs = Vec::new();
        for (i, (one, points)) in series.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            let at: Vec<[f64; 2]> = points.iter().map(|p| [x.pixel(p.0), y.pixel(p.1)]).collect();
            let line: Vec<[f64; 2]> = match one.style {
                Style::Points => Vec::new(),
                Style::Joined => at.clone(),
                Style::Line => one.points.iter().map(|p| [x.pixel(p.0), y.pixel(p.1)]).collect(),
            };
            for pair in line.windows(2).filter(|pair| pair.as_flattened().iter().all(|pixel| pixel.is_finite())) {
                let (from, to) = (pair[0], pair[1]);
                strokes.push(Stroke::Line { from, to, width: 2.0, colour });
                let between = |i: u32| [0, 1].map(|d| from[d] + f64::from(i) / 64.0 * (to[d] - from[d]));
                taken.extend((1..64).map(|i| Area::about(between(i), 2.0)));
            }
            let key = [legend + 5.0, 70.0];
            if one.style == Style::Line {
                strokes.push(Stroke::Line {
                    from: [legend - 1.0, 70.0],
                    to: [legend + 11.0, 70.0],
                    width: 2.0,
                    colour,
                });
            } else {
                discs.extend(at.iter().chain([&key]).map(|at| Stroke::Disc { at: *at, radius: 4.5, colour }));
                taken.extend(at.iter().map(|at| Area::about(*at, 5.0)));
                labels.extend(at.into_iter().zip(points).map(|(at, p)| (at, p.2, colour)));
            }
            strokes.push(text([legend + 16.0, 70.0 - 0.5 * TEXT], TEXT, Align::Left, colour, &one.name));
            legend += 44.0 + f64::from(text_width(TEXT as f32, &one.name));
        }
        strokes.extend(discs);
        for (at, label, colour) in labels {
            let area = place(at, label, &taken);
            strokes.push(text([area.min[0], area.min[1]], LABEL, Align::Left, colour, label));
            taken.push(area);
        }
        strokes
    }

    fn frame(&self, x: &Axis, y: &Axis) -> Vec<Stroke> {
        let [left, right, top, bottom] = FRAME;
        let mut strokes = vec![
            text([left, 16.0], TITLE, Align::Left, INK, &self.title),
            text([left, 42.0], TEXT, Align::Left, INK, &format!("up: {}", self.y)),
            text([0.5 * (left + right), bottom + 38.0], TEXT, Align::Centre, INK, &self.x),
        ];
        let line = |from, to, colour| Stroke::Line { from, to, width: 1.0, colour };
        for (value, name) in x.ticks() {
            let at = x.pixel(value);
            strokes.push(line([at, top], [at, bottom], GRID));
            strokes.push(text([at, bottom + 10.0], TEXT, Align::Centre, INK, &name));
        }
        for (value, name) in y.ticks() {
            let at = y.pixel(value);
            strokes.push(line([left, at], [right, at], GRID));
            strokes.push(text([left - 8.0, at - 0.5 * TEXT], TEXT, Align::Right, INK, &name));
        }
        strokes.push(line([left, top], [left, bottom], INK));
        strokes.push(line([left, bottom], [right, bottom], INK));
        strokes
    }
}

impl Series {
    fn shown(&self, axes: Axes) -> Vec<Point<'_>> {
        let fits = |v: f64| v.is_finite() && (axes == Axes::Linear || v > 0.0);
        let points = self.points.iter().filter(|(x, y, _)| fits(*x) && fits(*y));
        points.map(|(x, y, label)| (*x, *y, label.as_str())).collect()
    }
}

fn text(at: [f64; 2], size: f64, align: Align, colour: Colour, text: &str) -> Stroke {
    Stroke::Text { at, size, align, colour, text: text.to_owned() }
}

/// An axis between two pixels.
struct Axis {
    axes: Axes,
    /// Values at its ends, or their decimal logarithms.
    ends: [f64; 2],
    pixels: [f64; 2],
}

impl Axis {
    fn new(axes: Axes, values: impl Iterator<Item = f64>, start: f64, end: f64) -> Self {
        let scaled = values.map(|value| scale(axes, value));
        let (low, high) = scaled.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        let least = match axes {
            // Four fifths of a decade at least: nearly equal values look nearly equal, and two numbers stand at the axis.
            Axes::Logarithmic => 0.4,
            // Around zero alone, from -1 to 1.
            Axes::Linear if low == 0.0 && high == 0.0 => 1.0,
            Axes::Linear => 0.05 * low.abs().max(high.abs()),
        };
        let more = (0.08 * (high - low)).max(least - 0.5 * (high - low));
        Self { axes, ends: [low - more, high + more], pixels: [start, end] }
    }

    fn pixel(&self, value: f64) -> f64 {
        let share = (scale(self.axes, value) - self.ends[0]) / (self.ends[1] - self.ends[0]);
        self.pixels[0] + share * (self.pixels[1] - self.pixels[0])
    }

    fn ticks(&self) -> Vec<(f64, String)> {
        match self.axes {
            Axes::Logarithmic => self.decades(),
            Axes::Linear => self.even(),
        }
    }

    /// 1, 2 and 5 of each decade within, or whole decades only if those are many.
    fn decades(&self) -> Vec<(f64, String)> {
        let decades = self.ends[0].floor() as i32..=self.ends[1].ceil() as i32;
        let steps: &[f64] = if self.ends[1] - self.ends[0] > 4.0 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        let values = decades.flat_map(|decade| {
            let name = move |step: f64| format!("{:.*}", (-decade).max(0) as usize, step * 10f64.powi(decade));
            steps.iter().map(move |step| (step * 10f64.powi(decade), name(*step)))
        });
        values.filter(|(value, _)| (self.ends[0]..=self.ends[1]).contains(&value.log10())).collect()
    }

    /// Multiples of 1, 2 or 5 times a power of ten, four to ten of them.
    fn even(&self) -> Vec<(f64, String)> {
        let range = self.ends[1] - self.ends[0];
        let decade = (range / 5.0).log10().floor() as i32;
        let width = |step: &f64| step * 10f64.powi(decade);
        let step =
            [1.0, 2.0, 5.0].iter().map(width).find(|step| range / step <= 10.0).unwrap_or(10f64.powi(decade + 1));
        let (first, last) = ((self.ends[0] / step).ceil() as i64, (self.ends[1] / step).floor() as i64);
        let digits = (-decade).max(0) as usize;
        (first..=last).map(|n| (n as f64 * step, format!("{:.digits$}", n as f64 * step))).collect()
    }
}

/// Where a value stands on an axis.
fn scale(axes: Axes, value: f64) -> f64 {
    if axes == Axes::Logarithmic { value.log10() } else { value }
}

/// A rectangle on the page.
#[derive(Clone, Copy)]
struct Area {
    min: [f64; 2],
    max: [f64; 2],
}

impl Area {
    fn about(at: [f64; 2], half: f64) -> Self {
        Self { min: at.map(|x| x - half), max: at.map(|x| x + half) }
    }
    fn shared(&self, other: &Self) -> f64 {
        (0..2).map(|d| (self.max[d].min(other.max[d]) - self.min[d].max(other.min[d])).max(0.0)).product()
    }
}

/// Where the label of a point covers least: beside it first, further away if that is taken.
fn place(at: [f64; 2], label: &str, taken: &[Area]) -> Area {
    let (width, height) = (f64::from(text_width(LABEL as f32, label)), LABEL * 8.0 / 7.0);
    let candidate = |dx: f64, dy: f64, away: f64| {
        let centre = [at[0] + dx * (0.5 * width + away), at[1] + dy * (0.5 * height + away)];
        Area {
            min: [centre[0] - 0.5 * width, centre[1] - 0.5 * height],
            max: [centre[0] + 0.5 * width, centre[1] + 0.5 * height],
        }
    };
    let sides = [(1.0, 0.0), (1.0, -1.0), (1.0, 1.0), (0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (-1.0, -1.0), (-1.0, 1.0)];
    let candidates = [7.0, 14.0, 24.0].into_iter().flat_map(|away| sides.map(|(dx, dy)| candidate(dx, dy, away)));
    let page = Area { min: [FRAME[0], FRAME[2]], max: [WIDTH, FRAME[3]] };
    let covered = |area: &Area| {
        let outside = width * height - area.shared(&page);
        taken.iter().map(|other| area.shared(other)).sum::<f64>() + 10.0 * outside
    };
    candidates.min_by(|a, b| covered(a).total_cmp(&covered(b))).expect("the candidates listed above are some")
}

fn image(strokes: &[Stroke]) -> Image {
    let mut image = Image::new(WIDTH as usize, HEIGHT as usize, PAGE);
    for stroke in strokes {
        match stroke {
            Stroke::Line { from, to, width, colour } => segment(&mut image, *from, *to, 0.5 * width, *colour),
            Stroke::Disc { at, radius, colour } => segment(&mut image, *at, *at, *radius, *colour),
            Stroke::Text { at, size, align, colour, text } => {
                image.text(at[0] as f32, at[1] as f32, *size as f32, *align, *colour, text);
            }
        }
    }
    image
}

/// Everything within `radius` of a segment, its edge one pixel soft.
fn segment(image: &mut Image, from: [f64; 2], to: [f64; 2], radius: f64, colour: Colour) {
    let range = |d: usize| {
        let (low, high) = (from[d].min(to[d]) - radius - 1.0, from[d].max(to[d]) + radius + 1.0);
        low.floor() as i64..=high.ceil() as i64
    };
    let along = [to[0] - from[0], to[1] - from[1]];
    let square = (along[0].powi(2) + along[1].powi(2)).max(1e-9);
    for y in range(1) {
        for x in range(0) {
            let p = [x as f64 + 0.5 - from[0], y as f64 + 0.5 - from[1]];
            let share = ((p[0] * along[0] + p[1] * along[1]) / square).clamp(0.0, 1.0);
            let distance = (p[0] - share * along[0]).hypot(p[1] - share * along[1]);
            let cover = (radius + 0.5 - distance).clamp(0.0, 1.0);
            image.blend(x, y, colour, cover as f32);
        }
    }
}

fn svg(strokes: &[Stroke]) -> String {
    let hex = |[r, g, b]: &Colour| format!("#{r:02x}{g:02x}{b:02x}");
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"{}\"/>\n",
        hex(&PAGE)
    );
    for stroke in strokes {
        let line = match stroke {
            Stroke::Line { from: [x1, y1], to: [x2, y2], width, colour } => format!(
                "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{}\" stroke-width=\"{width}\"/>",
                hex(colour)
            ),
            Stroke::Disc { at: [x, y], radius, colour } => {
                format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{}\"/>", hex(colour))
            }
            Stroke::Text { at: [x, y], size, align, colour, text } => {
                let anchor = match align {
                    Align::Left => "start",
                    Align::Centre => "middle",
                    Align::Right => "end",
                };
                let text = text.replace('&', "&amp;").replace('<', "&lt;");
                // Capitals of common fonts are 0.72 of the font's size high.
                let (y, size) = (y + size, size / 0.72);
                format!(
                    "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"{size:.1}\" text-anchor=\"{anchor}\" fill=\"{}\">{text}</text>",
                    hex(colour)
                )
            }
        };
        writeln!(out, "{line}").expect("text can be written to a string");
    }
    out + "</svg>\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        let points =
            vec![(1.0, 8.0, "n 16".to_owned()), (10.0, 2.0, "a < b".to_owned()), (0.0, 1.0, "gone".to_owned())];
        let series = vec![Series { name: "uniform".to_owned(), points, style: Style::Joined }];
        Chart {
            title: "error".to_owned(),
            x: "time [s]".to_owned(),
            y: "error [mm]".to_owned(),
            series,
            ..Chart::default()
        }
    }

    #[test]
    fn both_files_hold_the_same_chart() {
        let strokes = chart().strokes();
        let text = svg(&strokes);
        for part in ["time [s]", "error [mm]", "n 16", "a &lt; b", ">uniform<", "</svg>"] {
            assert!(text.contains(part), "'{part}' is not in\n{text}");
        }
        assert!(!text.contains("gone"), "a logarithm of 0 was drawn");
        let discs = strokes.iter().filter(|s| matches!(s, Stroke::Disc { .. })).count();
        assert_eq!((discs, text.matches("<circle").count()), (3, 3), "two points and the legend");
        let ink = image(&strokes).pixels().iter().filter(|p| **p != PAGE).count();
        assert!(ink > 5000, "{ink} pixels");
    }

    #[test]
    fn axes_are_logarithmic_and_hold_their_values() {
        let axis = Axis::new(Axes::Logarithmic, [1.0, 100.0].into_iter(), 0.0, 300.0);
        let [a, b, c] = [1.0, 10.0, 100.0].map(|v| axis.pixel(v));
        assert!(((b - a) - (c - b)).abs() < 1e-9 && 0.0 < a && c < 300.0);
        let names: Vec<String> = axis.ticks().into_iter().map(|(_, name)| name).collect();
        assert_eq!(names, ["1", "2", "5", "10", "20", "50", "100"]);
        let small = Axis::new(Axes::Logarithmic, [0.012, 0.03].into_iter(), 0.0, 1.0);
        assert_eq!(small.ticks().into_iter().map(|(_, n)| n).collect::<Vec<_>>(), ["0.01", "0.02"]);
    }

    #[test]
    fn even_axes_hold_what_is_not_above_zero() {
        let axis = Axis::new(Axes::Linear, [-2.0, 8.0].into_iter(), 0.0, 100.0);
        let [a, b, c] = [-2.0, 3.0, 8.0].map(|v| axis.pixel(v));
        assert!(((b - a) - (c - b)).abs() < 1e-9 && 0.0 < a && c < 100.0);
        let names: Vec<String> = axis.ticks().into_iter().map(|(_, name)| name).collect();
        assert_eq!(names, ["-2", "0", "2", "4", "6", "8"]);
        let small = Axis::new(Axes::Linear, [0.0, 0.1].into_iter(), 0.0, 1.0);
        assert_eq!(small.ticks().first().map(|(_, n)| n.clone()), Some("0.00".to_owned()));
        let shown = Series { name: String::new(), points: vec![(0.0, -1.0, String::new())], style: Style::Points };
        assert_eq!((shown.shown(Axes::Linear).len(), shown.shown(Axes::Logarithmic).len()), (1, 0));
    }

    /// A law stands behind what was measured, without discs, and in two parts where it is broken.
    #[test]
    fn lines_have_no_discs_and_end_at_a_gap() {
        let points = [0.0, 1.0, f64::NAN, 3.0, 4.0].map(|x| (x, x, "no label".to_owned())).into();
        let series = vec![Series { name: "law".to_owned(), points, style: Style::Line }];
        let strokes = Chart { series, axes: Axes::Linear, ..Chart::default() }.strokes();
        let law = |s: &&Stroke| matches!(s, Stroke::Line { width: 2.0, .. });
        assert_eq!(strokes.iter().filter(law).count(), 2 + 1, "two parts and the legend");
        assert!(!strokes.iter().any(|s| matches!(s, Stroke::Disc { .. })) && !svg(&strokes).contains("no label"));
    }

    #[test]
    fn labels_keep_out_of_each_others_way() {
        let at = [300.0, 300.0];
        let first = place(at, "first", &[Area::about(at, 5.0)]);
        let second = place(at, "second", &[Area::about(at, 5.0), first]);
        assert_eq!(first.shared(&second), 0.0);
    }
}
