//! Pictures of a running simulation, without a GPU: the scene in perspective, or its surface from above as a shaded relief, and a
//! vertical cut. A view in perspective shows the ground and what couplings give as their [surfaces](barchan_core::Coupling::surfaces).
//!
//! ```
//! use barchan::picture::{Align, Axes, Chart, Colour, Image, Rect, Series, Style, View};
//!
//! let simulation = barchan::Simulation::new(&barchan::registry(), &barchan::example(), &barchan::Options::default())?;
//! let mut view = View::new(&simulation);
//! let picture: Image = view.draw(&simulation)?;
//! let red: Colour = [200, 30, 30];
//! let mut corner = picture.crop(Rect { x: 0, y: 0, width: 80, height: 40 });
//! corner.text(40.0, 10.0, 8.0, Align::Centre, red, "start");
//! assert!(corner.width() == 80 && corner.pixels() != picture.crop(Rect { x: 0, y: 0, width: 80, height: 40 }).pixels());
//!
//! let points = vec![(1e-3, 2.0, "fine".to_owned()), (1e-2, 0.1, "coarse".to_owned())];
//! let series = vec![Series { name: "cube".into(), points, style: Style::Joined }];
//! let chart = Chart { title: "error and time".into(), x: "error [m]".into(), y: "time [s]".into(), series, axes: Axes::Logarithmic };
//! let file = std::env::temp_dir().join(format!("barchan-chart-{}.svg", std::process::id()));
//! chart.write(&file).map_err(|source| barchan::Error::Io { file: file.clone(), what: "writing a chart", source })?;
//! assert!(std::fs::read_to_string(&file).is_ok_and(|text| text.contains("error and time")));
//! # let _ = std::fs::remove_file(file);
//! # Ok::<(), barchan::Error>(())
//! ```

mod animation;
mod camera;
mod chart;
mod colour;
mod cut;
mod ground;
mod image;
mod perspective;
mod raster;
mod relief;
mod robot;
mod stage;
mod tools;

pub use animation::{contact_sheet, gif};
pub use chart::{Axes, Chart, Series, Style};
pub use image::{Align, Colour, Image, Rect, text_width};
pub use robot::draw_robot;

use crate::stress::pressure;
use barchan_core::glam;
use barchan_core::levels::CellBox;
use barchan_core::plan::Plan;
use barchan_core::scene::{CutColour, Motion, Tool, Wall};
use barchan_core::{ParticleState, Result, Simulation, Spot, Vec3};
use camera::Camera;
use colour::{Ground, viridis};
use ground::Bed;
use perspective::Scenery;
use rayon::prelude::*;
use relief::{Dot, Surface};
use serde::{Deserialize, Serialize};
use stage::Stage;
use tools::{Frame, Tools};

/// Colour of the page around the panels.
pub const PAGE: Colour = [250, 248, 244];
/// Colour of text and lines.
pub const INK: Colour = [52, 48, 44];
/// Colour of the air in a vertical cut.
const AIR: Colour = [233, 236, 239];
/// Linear reflectance of bare floor.
const FLOOR: [f32; 3] = [0.11, 0.12, 0.13];

const MARGIN: usize = 14;
const HEADER: usize = 30;
const STRIP: usize = 38;
/// Scale bar and legend need this much.
const LEAST_WIDTH: usize = 540;
/// A view in perspective is at least so many pixels wide.
const LEAST_VIEW: usize = 16;
const TEXT: f32 = 8.75;

/// Particle spacings that the surface seen from above may be wide, if that is more than the picture's pixels.
const MOST_SPACINGS: f32 = 2000.0;
/// Share of a picture's width that the cut below a view in perspective may be high.
const CUT_SHARE: f64 = 0.3;

/// A fixed view of a scene: the same extent, height colours and layout in every frame; only the cut's scale may grow, and a camera may follow a body.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct View {
    name: String,
    min: Vec3,
    max: Vec3,
    /// Decimals of the time below pictures.
    #[serde(default)]
    decimals: usize,
    cut: CutColour,
    cut_y: f64,
    spacing: f64,
    /// Height in the middle of the palette, and from there to its ends [m]; set by the first frame.
    heights: Option<(f32, f32)>,
    /// End of the cut's colour scale [Pa or m/s].
    top: f64,
    scale: f64,
    /// Sides of the picture that are walls: x_min, x_max, y_min, y_max, z_min.
    walls: [bool; 5],
    /// Where it is seen in perspective, that; else it is seen from the top.
    stage: Option<Stage>,
}

/// What a picture shows, taken from a simulation; the drawing is still to be done.
pub(crate) struct Sketch {
    /// As it was then.
    pub(crate) view: View,
    /// When [s].
    pub(crate) time: f64,
    heights: (f32, f32),
    dots: Vec<Dot>,
    /// The surface, where it has been found already.
    surface: Option<Surface>,
    cut: Vec<Dot>,
    tools: Tools,
    /// Boxes of levels, with the width of their cells.
    levels: Vec<(CellBox, f64)>,
    grounds: Vec<Ground>,
    /// The camera of a view in perspective, and the bodies that it sees.
    seen: Option<Seen>,
}

/// What a view in perspective shows besides particles.
struct Seen {
    camera: Camera,
    surfaces: Vec<barchan_core::Surface>,
    /// The box that the ground may be in [m].
    bed: [Vec3; 2],
}

impl Sketch {
    /// How many particles it holds.
    pub(crate) fn len(&self) -> usize {
        self.dots.len()
    }

    /// Draws it: the relief or the view in perspective, the cut, and a page around both.
    pub(crate) fn draw(&self) -> Image {
        let Self { view, time, heights, cut: cut_dots, tools, levels, grounds, .. } = self;
        let (columns, rows) = view.main_panel();
        let mut main = Image::new(columns, rows, AIR);
        match (&self.seen, &view.stage) {
            (Some(seen), Some(stage)) => self.draw_perspective(&mut main, seen, stage),
            _ => self.draw_relief(&mut main),
        }
        let (width, height) = view.cut_panel();
        let mut cut = Image::new(width, height, AIR);
        let top = (view.top as f32).max(f32::MIN_POSITIVE);
        cut::draw(&mut cut, Frame { origin: [0.0, view.min[2]], scale: view.scale }, cut_dots, top);
        tools.draw_cut(&mut cut, view.frame_of_cut());

        for (one, cell) in levels {
            if self.seen.is_none() {
                view.outline(&mut main, 1, one, *cell);
            }
            view.outline(&mut cut, 2, one, *cell);
        }
        let ground = grounds.first().copied().unwrap_or_else(|| Ground::of_law("sand"));
        view.page(&main, &cut, ground, *heights, *time)
    }

    fn draw_relief(&self, relief: &mut Image) {
        let Self { view, heights, dots, tools, grounds, .. } = self;
        let found;
        let surface = match &self.surface {
            Some(surface) => surface,
            None => {
                found = view.surface(dots);
                &found
            }
        };
        surface.draw(relief, view.scale as f32, grounds, heights.0, heights.1, FLOOR);
        tools.draw_above(relief, view.frame_above(), surface);
    }

    fn draw_perspective(&self, image: &mut Image, seen: &Seen, stage: &Stage) {
        let Seen { camera, ref surfaces, bed: [min, max] } = *seen;
        // Particles' places are from the view's corner on, but for heights.
        let origin = [self.view.min[0], self.view.min[1], 0.0];
        let local = |place: Vec3| glam::Vec3::from_array(std::array::from_fn(|d| (place[d] - origin[d]) as f32));
        let lens = camera.lens(origin, image.width(), image.height());
        let target = local(camera.target);
        let scenery = Scenery {
            lens,
            target,
            distance: lens.eye.distance(target),
            dots: &self.dots,
            spacing: self.view.spacing as f32,
            bed: Bed { min: local(min), max: local(max), walls: stage.walls },
            heights: stage.by_height.then_some(self.heights),
            grounds: &self.grounds,
            surfaces,
            origin,
        };
        perspective::draw(image, &scenery);
    }
}

impl View {
    /// A view of a simulation's scene that holds its particles, as they are now, with some space around.
    pub fn new(simulation: &Simulation) -> Self {
        let scene = &simulation.plan().scene;
        let spots = simulation.spots();
        let (min, max) = extent(simulation.plan(), &spots);
        let bodies = scene.body.iter().map(|body| scene.spacing(body));
        let sources = scene.inflow.iter().map(|source| scene.inflow_spacing(source));
        let finest = bodies.chain(sources).fold(f64::INFINITY, f64::min);
        let spacing = if finest.is_finite() { finest } else { 0.5 * scene.world.cell };
        let ys = spots.iter().map(|spot| spot.position[1]);
        let ends = ys.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], y| [low.min(y), high.max(y)]);
        let middle = if ends[0] <= ends[1] { 0.5 * (ends[0] + ends[1]) } else { 0.5 * (min[1] + max[1]) };
        let pixels = scene.output.picture.pixels as usize;
        let across = (pixels.saturating_sub(2 * MARGIN).max(64)) as f64 / (max[0] - min[0]);
        let down = (pixels.saturating_sub(HEADER + 2 * STRIP).max(64)) as f64 / (max[1] - min[1] + max[2] - min[2]);
        let wide = pixels.saturating_sub(2 * MARGIN).max(LEAST_VIEW);
        let stage = Stage::new(simulation, &spots, wide);
        let scale = match &stage {
            Some(_) => (wide as f64 / (max[0] - min[0])).min(CUT_SHARE * wide as f64 / (max[2] - min[2])),
            None => across.min(down),
        };
        let walls = &scene.world.walls;
        let shown = |wall: Wall, side: f64, edge: f64| wall != Wall::Open && (side - edge).abs() < scene.world.cell;
        let world = &scene.world;
        Self {
            name: scene.name.clone(),
            min,
            max,
            decimals: decimals(scene.output.interval),
            cut: scene.output.picture.cut,
            cut_y: scene.output.picture.cut_y.unwrap_or(middle),
            spacing,
            heights: None,
            top: 0.0,
            scale,
            stage,
            walls: [
                shown(walls.x_min, world.min[0], min[0]),
                shown(walls.x_max, world.max[0], max[0]),
                shown(walls.y_min, world.min[1], min[1]),
                shown(walls.y_max, world.max[1], max[1]),
                shown(walls.z_min, world.min[2], min[2]),
            ],
        }
    }

    /// Draws a simulation as it is now.
    ///
    /// # Errors
    /// If a material fails to give its stress.
    pub fn draw(&mut self, simulation: &Simulation) -> Result<Image> {
        Ok(self.look(simulation)?.draw())
    }

    /// Takes from a simulation what a picture of it as it is now shows, to be drawn while it goes on.
    ///
    /// 1. Of all particles only place and size are asked for: the relief needs no more.
    /// 2. Those near the cut come with everything else, for what colours them.
    /// 3. Bodies are looked at where pixels are.
    ///
    /// # Errors
    /// If a material fails to give its stress.
    pub(crate) fn look(&mut self, simulation: &Simulation) -> Result<Sketch> {
        let plan = simulation.plan();
        let followed = self.stage.as_ref().and_then(|stage| stage.followed(simulation));
        // In a periodic world the ground is shown where it is near who is followed.
        let place = |x: Vec3| followed.map_or(x, |near| plan.scene.world.image_near(x, near));
        let spots = simulation.spots();
        let shown = spots.par_iter().map(|spot| Spot { position: place(spot.position), ..*spot });
        let dots: Vec<Dot> = shown.map(|spot| self.dot(&spot, 0.0)).collect();
        let surface = self.heights.is_none().then(|| self.surface(&dots));
        let heights = *self.heights.get_or_insert_with(|| {
            let level = surface.as_ref().and_then(Surface::median).unwrap_or(self.min[2] as f32);
            (level, cut::round_up(0.35 * (f64::from(level) - self.min[2])).max(2.0 * self.spacing) as f32)
        });

        let cut_y = self.cut_y;
        // Within one of their sides.
        let near = simulation.ground_where(&|spot| (spot.position[1] - cut_y).abs().powi(3) < spot.volume0);
        let cut = self.cut_dots(plan, &near)?;

        let distance = |points: &[Vec3]| {
            let mut nearest = vec![f64::INFINITY; points.len()];
            for coupling in simulation.couplings() {
                nearest.iter_mut().zip(coupling.distance(points)).for_each(|(near, d)| *near = near.min(d));
            }
            nearest
        };
        let boxes: Vec<_> = simulation.couplings().iter().flat_map(|coupling| coupling.bounds()).collect();
        // In perspective, tools are drawn by their surfaces.
        let above = if self.stage.is_some() { (0, 0) } else { self.main_panel() };
        let cut_panel = (self.cut_panel(), self.frame_of_cut());
        let tools = Tools::new(&boxes, &distance, (above, self.frame_above()), cut_panel, cut_y);
        let seen = self.stage.as_ref().map(|stage| {
            let surfaces = simulation.couplings().iter().flat_map(|coupling| coupling.surfaces()).collect();
            Seen { camera: stage.camera(simulation), surfaces, bed: stage.bed(simulation) }
        });

        let mut levels = Vec::new();
        if plan.scene.output.picture.levels {
            for (level, boxes) in near.levels.iter().flat_map(|phase| phase.boxes.iter().enumerate()) {
                levels.extend(boxes.iter().map(|&one| (one, plan.cell_widths[level])));
            }
        }
        let grounds = plan.materials.iter().map(|m| Ground::of_law(&m.material.name)).collect();
        Ok(Sketch {
            view: self.clone(),
            heights,
            dots,
            surface,
            cut,
            tools,
            levels,
            grounds,
            seen,
            time: simulation.time(),
        })
    }

    fn surface(&self, dots: &[Dot]) -> Surface {
        let far = [(self.max[0] - self.min[0]) as f32, (self.max[1] - self.min[1]) as f32];
        // What no pixel shows takes no memory.
        let spacing = (self.spacing as f32).max(far[0].max(far[1]) / MOST_SPACINGS.max(self.width() as f32));
        // Finer particles would leave gaps between its nodes.
        let dots: Vec<Dot> = dots.par_iter().map(|dot| Dot { side: dot.side.max(spacing), ..*dot }).collect();
        Surface::new(&dots, spacing, [0.0; 2], far, self.min[2] as f32)
    }

    fn frame_above(&self) -> Frame {
        Frame { origin: [self.min[0], self.min[1]], scale: self.scale }
    }

    fn frame_of_cut(&self) -> Frame {
        Frame { origin: [self.min[0], self.min[2]], scale: self.scale }
    }

    /// Does the view hold what the scene asks for?
    ///
    /// # Errors
    /// If there is no such body as the camera is to follow.
    pub(crate) fn check(simulation: &Simulation) -> Result<()> {
        stage::check(simulation)
    }

    /// Where the relief, or the view in perspective, lies within a frame.
    pub fn relief_rect(&self) -> Rect {
        let (width, height) = self.main_panel();
        Rect { x: (self.width() - width) / 2, y: HEADER, width, height }
    }

    fn pixels(&self, d: usize) -> usize {
        (((self.max[d] - self.min[d]) * self.scale).round() as usize).max(8)
    }
    /// Columns and rows of the relief, or the view in perspective.
    fn main_panel(&self) -> (usize, usize) {
        self.stage.as_ref().map_or_else(|| (self.pixels(0), self.pixels(1)), |stage| (stage.size[0], stage.size[1]))
    }
    /// Columns and rows of the cut.
    fn cut_panel(&self) -> (usize, usize) {
        (self.pixels(0), self.pixels(2))
    }
    fn width(&self) -> usize {
        (self.main_panel().0.max(self.cut_panel().0) + 2 * MARGIN).max(LEAST_WIDTH)
    }

    /// A particle, x and y from the view's corner.
    fn dot(&self, spot: &Spot, value: f64) -> Dot {
        let [x, y, z] = spot.position;
        let position = [(x - self.min[0]) as f32, (y - self.min[1]) as f32, z as f32];
        Dot { position, ground: spot.material as u8, value: value as f32, side: (spot.volume0 as f32).cbrt() }
    }

    /// The particles near the vertical cut, with what colours them.
    fn cut_dots(&mut self, plan: &Plan, near: &ParticleState) -> Result<Vec<Dot>> {
        let (mut dots, mut values) = (Vec::new(), Vec::new());
        for list in &near.lists {
            let all: Vec<usize> = (0..list.len()).collect();
            let quantity = match self.cut {
                CutColour::Pressure => pressure(&plan.materials[list.material as usize], list, &all)?,
                CutColour::Speed => list.velocity.iter().map(|v| v.iter().map(|c| c * c).sum::<f64>().sqrt()).collect(),
            };
            dots.extend(all.iter().map(|&i| self.dot(&list.spot(i), quantity[i])));
            values.extend(quantity);
        }
        // The scale's end covers all but the outliers, and never shrinks, so that frames can be compared.
        if !values.is_empty() {
            let index = (values.len() - 1) * 995 / 1000;
            let high = *values.select_nth_unstable_by(index, f64::total_cmp).1;
            self.top = self.top.max(cut::round_up(high));
        }
        Ok(dots)
    }

    /// Draws where a level's box ends, in the panel whose axes are x and `up`, with the width of its cells.
    fn outline(&self, image: &mut Image, up: usize, one: &CellBox, cell: f64) {
        let (min, max) = (one.min.map(|c| f64::from(c) * cell), one.max.map(|c| f64::from(c) * cell));
        if up == 2 && !(min[1] <= self.cut_y && self.cut_y < max[1]) {
            return;
        }
        let (width, height) = (image.width() as f64, image.height() as f64);
        let (left, right) = ((min[0] - self.min[0]) * self.scale, (max[0] - self.min[0]) * self.scale);
        let (top, bottom) =
            (height - (max[up] - self.min[up]) * self.scale, height - (min[up] - self.min[up]) * self.scale);
        let inside = |from: f64, to: f64, end: f64| (from.max(0.0) as usize, to.min(end).max(0.0) as usize);
        let ((x, x_end), (y, y_end)) = (inside(left, right, width), inside(top, bottom, height));
        for column in [left, right].into_iter().filter(|x| (0.0..width).contains(x)) {
            image.fill(Rect { x: column as usize, y, width: 1, height: y_end.saturating_sub(y) }, INK);
        }
        for row in [top, bottom].into_iter().filter(|y| (0.0..height).contains(y)) {
            image.fill(Rect { x, y: row as usize, width: x_end.saturating_sub(x), height: 1 }, INK);
        }
        // Of boxes seen from the side, names would lie on each other.
        if up == 1 && x_end > x + 40 && y_end > y + 12 {
            let label = format!("{} mm", (1e6 * cell).round() / 1e3);
            image.text(x_end as f32 - 4.0, y as f32 + 4.0, 0.8 * TEXT, Align::Right, INK, &label);
        }
    }

    /// A time [s], so that pictures that follow one another have different ones.
    pub(crate) fn label(&self, time: f64) -> String {
        format!("t = {time:.0$} s", self.decimals.max(2))
    }

    /// Sets the panels on a page with title, time, scale bar and legends.
    fn page(&self, relief: &Image, cut: &Image, ground: Ground, (level, range): (f32, f32), time: f64) -> Image {
        let rect = self.relief_rect();
        let (left, right) = (MARGIN as f32, (self.width() - MARGIN) as f32);
        let mut page = Image::new(self.width(), HEADER + rect.height + STRIP + cut.height() + STRIP, PAGE);
        page.text(left, 11.0, TEXT + 1.75, Align::Left, INK, &self.name);
        page.text(right, 11.0, TEXT + 1.75, Align::Right, INK, &self.label(time));

        page.paste(relief, rect.x, rect.y);
        let strip = rect.y + rect.height + 14;
        let (first, last) = (MARGIN, self.width() - MARGIN);
        self.scale_bar(&mut page, first, strip);
        if self.stage.is_some() {
            self.border(&mut page, rect, [false; 4]);
            page.text(right, strip as f32, TEXT, Align::Right, INK, "above: in perspective; below: a cut, to scale");
        } else {
            self.border(&mut page, rect, [self.walls[0], self.walls[1], self.walls[3], self.walls[2]]);
            // Two marks beside the relief show where the cut is.
            let row = (rect.y + rect.height) as f64 - (self.cut_y - self.min[1]) * self.scale;
            for x in [rect.x.saturating_sub(10), rect.x + rect.width + 4] {
                page.fill(Rect { x, y: row as usize, width: 6, height: 2 }, INK);
            }
            let (factor, name) = unit(f64::from(range), "m");
            let end = f64::from(range) / factor;
            let ends = [format!("-{}", three_digits(end)), format!("+{} {name}", three_digits(end))];
            let label = format!("height about {:.0} mm", 1e3 * (f64::from(level) - self.min[2]));
            legend(&mut page, last, strip, &label, &ends, |t| ground.at(t).map(colour::encode));
        }

        let left_of_cut = (self.width() - cut.width()) / 2;
        let below = Rect { x: left_of_cut, y: rect.y + rect.height + STRIP, width: cut.width(), height: cut.height() };
        page.paste(cut, below.x, below.y);
        self.border(&mut page, below, [self.walls[0], self.walls[1], false, self.walls[4]]);

        let strip = below.y + below.height + 14;
        let cut_label = format!("cut at y = {:.2} m", (100.0 * self.cut_y).round() / 100.0 + 0.0);
        page.text(left, strip as f32, TEXT, Align::Left, INK, &cut_label);
        let (quantity, (factor, name)) = match self.cut {
            CutColour::Pressure => ("pressure", unit(self.top, "Pa")),
            CutColour::Speed => ("speed", unit(self.top, "m/s")),
        };
        let ends = ["0".to_owned(), format!("{} {name}", three_digits(self.top / factor))];
        legend(&mut page, last, strip, quantity, &ends, viridis);
        page
    }

    /// Frames a panel: thick where there is a wall. Sides: left, right, top, bottom.
    fn border(&self, page: &mut Image, rect: Rect, walls: [bool; 4]) {
        let thick = |wall: bool| if wall { 3 } else { 1 };
        let colour = |wall: bool| if wall { INK } else { [196, 192, 186] };
        let Rect { x, y, width, height } = rect;
        for (side, wall) in walls.into_iter().enumerate() {
            let t = thick(wall);
            let line = match side {
                0 => Rect { x: x - t, y: y - 1, width: t, height: height + 2 },
                1 => Rect { x: x + width, y: y - 1, width: t, height: height + 2 },
                2 => Rect { x: x - 1, y: y - t, width: width + 2, height: t },
                _ => Rect { x: x - 1, y: y + height, width: width + 2, height: t },
            };
            page.fill(line, colour(wall));
        }
    }

    /// A bar of round length, about a fifth of the width, in four fields.
    fn scale_bar(&self, page: &mut Image, x: usize, y: usize) {
        let length = cut::round_up(0.1 * (self.max[0] - self.min[0]));
        let pixels = (length * self.scale).round() as usize;
        for field in 0..4 {
            let (from, to) = (pixels * field / 4, pixels * (field + 1) / 4);
            page.fill(Rect { x: x + from, y, width: to - from, height: 8 }, INK);
            if field % 2 == 1 {
                // Of a bar that is hardly seen nothing may be left to be light.
                let width = (to - from).saturating_sub(2 * (field / 3));
                page.fill(Rect { x: x + from, y: y + 2, width, height: 4 }, PAGE);
            }
        }
        let (label, unit) = if length < 1.0 { (100.0 * length, "cm") } else { (length, "m") };
        page.text(
            (x + pixels + 8) as f32,
            y as f32,
            TEXT,
            Align::Left,
            INK,
            &format!("{} {unit}", three_digits(label)),
        );
    }
}

/// A colour bar that ends at `right`, with a label before it and the values of its ends around it.
fn legend(page: &mut Image, right: usize, y: usize, label: &str, ends: &[String; 2], colour: impl Fn(f32) -> Colour) {
    const LENGTH: usize = 120;
    let right = right as f32;
    page.text(right, y as f32, TEXT, Align::Right, INK, &ends[1]);
    let bar = (right - text_width(TEXT, &ends[1]) - 8.0) as usize - LENGTH;
    page.fill(Rect { x: bar - 1, y: y - 2, width: LENGTH + 2, height: 13 }, INK);
    for i in 0..LENGTH {
        let column = Rect { x: bar + i, y: y - 1, width: 1, height: 11 };
        page.fill(column, colour(i as f32 / (LENGTH - 1) as f32));
    }
    page.text(bar as f32 - 8.0, y as f32, TEXT, Align::Right, INK, &ends[0]);
    page.text(bar as f32 - 20.0 - text_width(TEXT, &ends[0]), y as f32, TEXT, Align::Right, INK, label);
}

/// A number of one to three digits, without what rounding left behind them.
fn three_digits(value: f64) -> f64 {
    (1e3 * value).round() / 1e3
}

/// The prefixed unit in which `value` has one to three digits before the point.
fn unit(value: f64, base: &str) -> (f64, String) {
    let (factor, prefix) = match value.abs() {
        v if v >= 1e9 => (1e9, "G"),
        v if v >= 1e6 => (1e6, "M"),
        v if v >= 1e3 => (1e3, "k"),
        v if v >= 1.0 || v == 0.0 => (1.0, ""),
        v if v >= 1e-3 => (1e-3, "m"),
        _ => (1e-6, "u"),
    };
    (factor, format!("{prefix}{base}"))
}

/// Decimals that tell pictures an interval [s] apart from one another.
fn decimals(interval: f64) -> usize {
    (2..6).find(|decimals| 2.0 * 0.1f64.powi(*decimals) < interval).unwrap_or(6) as usize
}

/// Places where a tool's origin comes by until `end` [m].
fn places(tool: &Tool, end: f64) -> Vec<Vec3> {
    match &tool.motion {
        Motion::Keyframes { frames, .. } => frames.iter().map(|frame| frame.position).collect(),
        Motion::Velocity { linear, .. } => {
            vec![tool.position, std::array::from_fn(|d| tool.position[d] + end * linear[d])]
        }
        Motion::Fixed | Motion::Free { .. } | Motion::Servo(_) => vec![tool.position],
    }
}

/// What a view shows: the particles with a quarter of their extent around, and how far they may run out, inside the world, down to a floor.
fn extent(plan: &Plan, particles: &[Spot]) -> (Vec3, Vec3) {
    let (scene, world) = (&plan.scene, &plan.scene.world);
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for Spot { position, .. } in particles {
        for d in 0..3 {
            low[d] = low[d].min(position[d]);
            high[d] = high[d].max(position[d]);
        }
    }
    if low[0] > high[0] {
        return (world.min, world.max);
    }
    if scene.levels.reach > 0 {
        // The ground comes with the tools: show where they go.
        for place in scene.tool.iter().flat_map(|tool| places(tool, scene.time.end)) {
            for d in 0..2 {
                low[d] = low[d].min(place[d]);
                high[d] = high[d].max(place[d]);
            }
        }
    }
    let size: Vec3 = std::array::from_fn(|d| high[d] - low[d] + world.cell);
    let wide = size[0].max(size[1]);
    let above = [0.25 * size[0], 0.25 * size[1], (0.5 * size[2]).max(0.12 * wide)];
    // Tools on keyframes are shown on all their way up, within reason.
    let way = scene.tool.iter().flat_map(|tool| match &tool.motion {
        Motion::Keyframes { frames, .. } => frames.iter().map(|frame| frame.position[2]).collect(),
        _ => vec![tool.position[2]],
    });
    high[2] = high[2].max(way.fold(high[2], f64::max).min(high[2] + 0.35 * wide) - above[2]);
    let below = [0.25 * size[0], 0.25 * size[1], 0.1 * size[2]];
    let mut min: Vec3 = std::array::from_fn(|d| (low[d] - below[d]).max(world.min[d]));
    let mut max: Vec3 = std::array::from_fn(|d| (high[d] + above[d]).min(world.max[d]));
    for reach in &plan.reaches {
        for d in 0..3 {
            (min[d], max[d]) = (min[d].min(reach.min[d]), max[d].max(reach.max[d]));
        }
    }
    if world.walls.z_min != Wall::Open {
        min[2] = world.min[2];
    }
    (min, max)
}
