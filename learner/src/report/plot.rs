//! Plots of lines with bands, as SVG and as PNG.

use std::collections::BTreeSet;
use std::error::Error;
use std::ops::Range;
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
/// Panels in a row; each has half the size of a plot.
const COLUMNS: usize = 3;
/// Pixels of a PNG for each of an SVG.
const PNG_SCALE: u32 = 2;
/// Longer lines have no markers.
const MAX_MARKERS: usize = 40;
/// Values beyond are not drawn: an axis to there would have no end.
const LARGEST: f64 = 1e300;
const REFERENCE: RGBColor = RGBColor(110, 110, 110);
/// Okabe and Ito's colors, which most color-blind readers can tell apart.
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
];

#[derive(Clone, Debug, Default)]
pub struct Plot {
    pub title: String,
    pub x: &'static str,
    pub y: &'static str,
    /// True if x is the base-10 logarithm of the number that the axis shows.
    pub is_log: bool,
    /// True if the lines fall from the top, so that the legend is below them.
    pub is_falling: bool,
    /// Dashed lines at some y, with labels.
    pub references: Vec<(String, f64)>,
    /// Dashed lines at gradient steps after which online learning begins.
    pub begins: BTreeSet<u64>,
    pub lines: Vec<Line>,
    /// Plots side by side, in place of lines.
    pub panels: Vec<Self>,
}

/// Points by x, with a band where they have intervals.
#[derive(Clone, Debug)]
pub struct Line {
    pub label: String,
    pub points: Vec<(f64, Estimate)>,
}

type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Drawn = Result<(), Box<dyn Error>>;

impl Plot {
    pub fn svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        self.render(SVGBackend::with_string(&mut svg, self.size()), 1)?;
        Ok(svg)
    }

    pub fn write_svg(&self, path: &Path) -> anyhow::Result<()> {
        write(path, self.svg()?.as_bytes())
    }

    pub fn write_png(&self, path: &Path) -> anyhow::Result<()> {
        let (width, height) = self.size();
        let (width, height) = (width * PNG_SCALE, height * PNG_SCALE);
        let mut pixels = vec![0; (width * height * 3) as usize];
        let backend = BitMapBackend::with_buffer(&mut pixels, (width, height));
        self.render(backend, PNG_SCALE)?;
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header()?.write_image_data(&pixels)?;
        write(path, &file)
    }

    pub fn is_empty(&self) -> bool {
        self.lines.iter().all(|line| line.points.is_empty())
            && self.panels.iter().all(Self::is_empty)
    }

    fn grid(&self) -> (usize, usize) {
        let count = self.panels.len();
        (count.div_ceil(COLUMNS), count.min(COLUMNS))
    }

    fn size(&self) -> (u32, u32) {
        match self.grid() {
            (0, _) => SIZE,
            (rows, columns) => (SIZE.0 / 2 * columns as u32, SIZE.1 / 2 * rows as u32),
        }
    }

    fn render<DB: DrawingBackend>(&self, backend: DB, scale: u32) -> anyhow::Result<()>
    where
        DB::ErrorType: 'static,
    {
        LazyLock::force(&FONT);
        let area = backend.into_drawing_area();
        let drawn = area
            .fill(&WHITE)
            .map_err(Into::into)
            .and_then(|()| self.finite().draw(&area, scale))
            .and_then(|()| Ok(area.present()?));
        drawn.map_err(|error| anyhow!("cannot draw {}: {error}", self.title))
    }

    fn finite(&self) -> Self {
        let is_finite = |value: &f64| value.abs() < LARGEST;
        let mut plot = self.clone();
        plot.panels = self.panels.iter().map(Self::finite).collect();
        plot.references.retain(|(_, y)| is_finite(y));
        for Line { points, .. } in &mut plot.lines {
            points.retain(|(x, y)| is_finite(x) && is_finite(&y.value));
            for (_, y) in points {
                (y.low, y.high) = (y.low.filter(is_finite), y.high.filter(is_finite));
            }
        }
        plot
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, scale: u32) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        if !self.panels.is_empty() {
            let mut panels = self.panels.iter().zip(area.split_evenly(self.grid()));
            return panels.try_for_each(|(it, area)| it.draw(&area, scale));
        }
        let font = |size: u32| ("sans-serif", size * scale).into_font();
        let (x, y) = self.limits();
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, font(18))
            .margin(16 * scale)
            .margin_right(36 * scale)
            .x_label_area_size(44 * scale)
            .y_label_area_size(56 * scale)
            .build_cartesian_2d(x, y)?;
        // A logarithmic axis has labels at whole powers of ten.
        let label = |x: &f64| match self.is_log {
            true if (x - x.round()).abs() > 1e-6 => String::new(),
            true => format!("{}", 10f64.powf(x.round())),
            false => format!("{x}"),
        };
        chart
            .configure_mesh()
            .x_desc(self.x)
            .y_desc(self.y)
            .axis_desc_style(font(15))
            .label_style(font(13))
            .x_label_formatter(&label)
            .light_line_style(WHITE)
            .draw()?;
        self.draw_dashed(&mut chart, scale)?;
        for (line, color) in self.lines.iter().zip(COLORS.iter().cycle()) {
            line.draw(&mut chart, *color, scale)?;
        }
        let position = match self.is_falling {
            true => SeriesLabelPosition::LowerLeft,
            false => SeriesLabelPosition::UpperLeft,
        };
        chart
            .configure_series_labels()
            .position(position)
            .legend_area_size(26 * scale)
            .label_font(font(13))
            .background_style(WHITE.mix(0.8))
            .border_style(REFERENCE.mix(0.4))
            .draw()?;
        Ok(())
    }

    /// Draws the references, and where online learning begins.
    fn draw_dashed<DB: DrawingBackend>(&self, chart: &mut Chart<DB>, scale: u32) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let (x, y) = self.limits();
        let dashed = |ends: [(f64, f64); 2], width| {
            let style = REFERENCE.stroke_width(width * scale);
            DashedLineSeries::new(ends, 6 * scale, 4 * scale, style)
        };
        for (name, y) in &self.references {
            let line = dashed([(x.start, *y), (x.end, *y)], 2);
            let drawn = chart.draw_series(line)?.label(name);
            drawn.legend(legend(REFERENCE, scale));
        }
        let font = ("sans-serif", 13 * scale).into_font();
        for step in self.begins.iter().map(|step| *step as f64) {
            chart.draw_series(dashed([(step, y.start), (step, y.end)], 1))?;
            let at = (step, y.start + 0.04 * (y.end - y.start));
            chart.draw_series([Text::new(" online", at, font.color(&REFERENCE))])?;
        }
        Ok(())
    }

    /// Ranges of the axes: all values and 0, with room above for the legend.
    fn limits(&self) -> (Range<f64>, Range<f64>) {
        let mut points = self.lines.iter().flat_map(|line| &line.points).peekable();
        let first = points.peek().map_or(0.0, |(x, _)| *x);
        let mut x = if self.is_log { first } else { 0.0 }..first + 1e-9;
        let mut y = 0.0..0.01;
        for (at, estimate) in points {
            extend(&mut x, *at);
            extend(&mut y, estimate.low.unwrap_or(estimate.value));
            extend(&mut y, estimate.value);
            extend(&mut y, estimate.high.unwrap_or(estimate.value));
        }
        for (_, value) in &self.references {
            extend(&mut y, *value);
        }
        let labels = (self.lines.len() + self.references.len()) as f64;
        let room = 0.05 + 0.05 * labels * f64::from(!self.is_falling);
        y.end += (y.end - y.start) * room;
        (x, y)
    }
}

fn extend(range: &mut Range<f64>, value: f64) {
    *range = range.start.min(value)..range.end.max(value);
}

fn write(path: &Path, file: &[u8]) -> anyhow::Result<()> {
    files::replace(path, file).with_context(|| format!("cannot write {}", path.display()))
}

impl Line {
    fn draw<DB: DrawingBackend>(&self, chart: &mut Chart<DB>, color: RGBColor, scale: u32) -> Drawn
    where
        DB::ErrorType: 'static,
    {
        let edge = |end: fn(&Estimate) -> Option<f64>| {
            let points = self.points.iter();
            points.filter_map(move |(x, y)| Some((*x, end(y)?)))
        };
        let band = Vec::from_iter(edge(|y| y.high).chain(edge(|y| y.low).rev()));
        if !band.is_empty() {
            chart.draw_series([Polygon::new(band, color.mix(0.15))])?;
        }
        let points = Vec::from_iter(self.points.iter().map(|(x, y)| (*x, y.value)));
        let line = LineSeries::new(points.clone(), color.stroke_width(2 * scale));
        let drawn = chart.draw_series(line)?.label(&self.label);
        drawn.legend(legend(color, scale));
        if points.len() <= MAX_MARKERS {
            let marker = |point| Circle::new(point, 3 * scale, color.filled());
            chart.draw_series(points.into_iter().map(marker))?;
        }
        Ok(())
    }
}

fn legend(color: RGBColor, scale: u32) -> impl Fn((i32, i32)) -> PathElement<(i32, i32)> {
    let style = color.stroke_width(2 * scale);
    move |(x, y)| PathElement::new([(x, y), (x + 20 * scale as i32, y)], style)
}

static FONT: LazyLock<()> = LazyLock::new(|| {
    let font = include_bytes!("../../assets/DejaVuSans.ttf");
    // The embedded font is valid: the tests draw with it.
    let _ = register_font("sans-serif", FontStyle::Normal, font);
});

#[cfg(test)]
mod tests;
