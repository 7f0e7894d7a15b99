//! A picture of lines with bands, as SVG and as PNG.

use std::error::Error;
use std::path::Path;
use std::sync::LazyLock;

use anyhow::{Context, anyhow};
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::register_font;
use quad_run::files;
use quad_run::results::statistics::Estimate;

const SIZE: (u32, u32) = (900, 540);
/// Panels of a picture that stand side by side; each is half as wide and high as a picture.
const COLUMNS: usize = 3;
/// Pixels of a PNG for each of an SVG.
const FINER: u32 = 2;
/// Points of a line that are shown as such.
const MOST_POINTS: usize = 40;
/// What is farther from 0 is not drawn, nor what is no number: an axis to there would have no end.
const FARTHEST: f64 = 1e300;
const REFERENCE: RGBColor = RGBColor(110, 110, 110);
/// Colors that stay apart for most color-blind readers (Okabe and Ito).
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
];

/// What is drawn.
#[derive(Clone, Debug, Default)]
pub struct Picture {
    pub title: String,
    /// What x is.
    pub x: &'static str,
    /// Whether x is the power of ten that the axis shows.
    pub is_power: bool,
    /// What y is.
    pub y: String,
    /// Whether the lines fall from the top, so that the legend stands below them.
    pub is_falling: bool,
    /// Dashed lines at some y, each with its name.
    pub references: Vec<(String, f64)>,
    pub lines: Vec<Line>,
    /// Pictures that stand in it side by side, in place of lines of its own.
    pub panels: Vec<Self>,
}

/// A line through points by x, and a band between the ends of their intervals where they have some.
#[derive(Clone, Debug)]
pub struct Line {
    pub label: String,
    pub points: Vec<(f64, Estimate)>,
}

type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Drawn = Result<(), Box<dyn Error>>;

impl Picture {
    /// The picture as SVG.
    ///
    /// # Errors
    /// It cannot be drawn.
    pub fn svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        let drawn = self
            .drawable()
            .draw(SVGBackend::with_string(&mut svg, self.size()).into_drawing_area(), 1);
        drawn.map_err(|error| anyhow!("cannot draw {}: {error}", self.title))?;
        Ok(svg)
    }

    /// The picture as an SVG file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_svg(&self, path: &Path) -> anyhow::Result<()> {
        files::replace(path, self.svg()?.as_bytes())
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// The picture as a PNG file, of twice as many pixels.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_png(&self, path: &Path) -> anyhow::Result<()> {
        let (width, height) = self.size();
        let (width, height) = (width * FINER, height * FINER);
        let mut pixels = vec![0; (width * height * 3) as usize];
        let drawn = self.drawable().draw(
            BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area(),
            FINER,
        );
        drawn.map_err(|error| anyhow!("cannot draw {}: {error}", path.display()))?;
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header()?.write_image_data(&pixels)?;
        files::replace(path, &file).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Whether there is nothing to be seen in it.
    pub fn is_empty(&self) -> bool {
        self.lines.iter().all(|line| line.points.is_empty())
            && self.panels.iter().all(Self::is_empty)
    }

    /// Columns and rows of its panels.
    fn grid(&self) -> (usize, usize) {
        let columns = self.panels.len().min(COLUMNS);
        (columns, self.panels.len().div_ceil(COLUMNS))
    }

    /// Width and height.
    fn size(&self) -> (u32, u32) {
        match self.grid() {
            (0, _) => SIZE,
            (columns, rows) => (SIZE.0 / 2 * columns as u32, SIZE.1 / 2 * rows as u32),
        }
    }

    /// Without what cannot be drawn.
    fn drawable(&self) -> Self {
        let is_near = |value: &f64| value.abs() < FARTHEST;
        let mut picture = self.clone();
        picture.panels.iter_mut().for_each(|panel| *panel = panel.drawable());
        picture.references.retain(|(_, y)| is_near(y));
        for line in &mut picture.lines {
            line.points.retain(|(x, y)| is_near(x) && is_near(&y.value));
            for (_, y) in &mut line.points {
                (y.low, y.high) = (y.low.filter(is_near), y.high.filter(is_near));
            }
        }
        picture
    }

    /// Draws with lengths `by` times as long as usual.
    fn draw<DB: DrawingBackend>(&self, root: DrawingArea<DB, Shift>, by: u32) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        LazyLock::force(&FONT);
        root.fill(&WHITE)?;
        if !self.panels.is_empty() {
            let (columns, rows) = self.grid();
            let parts = root.split_evenly((rows, columns));
            self.panels.iter().zip(parts).try_for_each(|(panel, part)| panel.draw(part, by))?;
            root.present()?;
            return Ok(());
        }
        let font = |size: u32| ("sans-serif", size * by).into_font();
        let [x, y] = self.limits();
        let mut chart = ChartBuilder::on(&root)
            .caption(&self.title, font(18))
            .margin(16 * by)
            .margin_right(36 * by)
            .x_label_area_size(44 * by)
            .y_label_area_size(56 * by)
            .build_cartesian_2d(x.clone(), y)?;
        // Of powers, the whole ones.
        let tick = |x: &f64| match self.is_power {
            true if (x - x.round()).abs() > 1e-6 => String::new(),
            true => format!("{}", 10f64.powf(x.round())),
            false => format!("{x}"),
        };
        chart
            .configure_mesh()
            .x_desc(self.x)
            .y_desc(&self.y)
            .axis_desc_style(font(15))
            .label_style(font(13))
            .x_label_formatter(&tick)
            .light_line_style(WHITE)
            .draw()?;
        for (name, y) in &self.references {
            let line = DashedLineSeries::new(
                [(x.start, *y), (x.end, *y)],
                6 * by,
                4 * by,
                REFERENCE.stroke_width(2 * by),
            );
            chart.draw_series(line)?.label(name).legend(legend(REFERENCE, by));
        }
        for (line, color) in self.lines.iter().zip(COLORS.iter().cycle()) {
            draw_line(&mut chart, line, *color, by)?;
        }
        chart
            .configure_series_labels()
            .position(if self.is_falling {
                SeriesLabelPosition::LowerLeft
            } else {
                SeriesLabelPosition::UpperLeft
            })
            .legend_area_size(26 * by)
            .label_font(font(13))
            .background_style(WHITE.mix(0.8))
            .border_style(REFERENCE.mix(0.4))
            .draw()?;
        root.present()?;
        Ok(())
    }

    /// What the axes show: everything, from 0 or below, with some room above for the legend.
    fn limits(&self) -> [std::ops::Range<f64>; 2] {
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let range = |values: Vec<f64>, least: f64, most: f64| {
            values.iter().copied().fold(least, f64::min)
                ..values.iter().copied().fold(most, f64::max)
        };
        let first = points().map(|(x, _)| *x).next().unwrap_or(0.0);
        let x = range(
            points().map(|(x, _)| *x).collect(),
            if self.is_power { first } else { 0.0 },
            first + 1e-9,
        );
        let of_points = points().flat_map(|(_, y)| [Some(y.value), y.low, y.high]).flatten();
        let y =
            range(of_points.chain(self.references.iter().map(|(_, y)| *y)).collect(), 0.0, 0.01);
        let labels = if self.is_falling { 0 } else { self.lines.len() + self.references.len() };
        let room = 1.05 + 0.05 * labels as f64;
        [x, y.start..y.start + (y.end - y.start) * room]
    }
}

fn draw_line<DB: DrawingBackend>(
    chart: &mut Chart<DB>,
    line: &Line,
    color: RGBColor,
    by: u32,
) -> Drawn
where
    DB::ErrorType: 'static,
{
    let edge = |end: fn(&Estimate) -> Option<f64>| {
        line.points.iter().filter_map(move |(x, y)| Some((*x, end(y)?)))
    };
    let band: Vec<_> = edge(|y| y.high).chain(edge(|y| y.low).rev()).collect();
    if !band.is_empty() {
        chart.draw_series([Polygon::new(band, color.mix(0.15))])?;
    }
    let points: Vec<_> = line.points.iter().map(|(x, y)| (*x, y.value)).collect();
    let series = LineSeries::new(points.clone(), color.stroke_width(2 * by));
    chart.draw_series(series)?.label(&line.label).legend(legend(color, by));
    let points = if points.len() > MOST_POINTS { Vec::new() } else { points };
    chart
        .draw_series(points.into_iter().map(|point| Circle::new(point, 3 * by, color.filled())))?;
    Ok(())
}

fn legend(color: RGBColor, by: u32) -> impl Fn((i32, i32)) -> PathElement<(i32, i32)> {
    move |(x, y)| PathElement::new([(x, y), (x + 20 * by as i32, y)], color.stroke_width(2 * by))
}

/// The font, which measures the text of an SVG and draws that of a PNG.
static FONT: LazyLock<()> = LazyLock::new(|| {
    let font = include_bytes!("../../assets/DejaVuSans.ttf");
    // It is part of the program, and the tests draw with it.
    let _ = register_font("sans-serif", FontStyle::Normal, font);
});

#[cfg(test)]
mod tests;
