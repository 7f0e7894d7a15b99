//! Plots of lines with bands, as SVG and as PNG.

use std::collections::BTreeSet;
use std::error::Error;
use std::ops::Range;
use std::sync::LazyLock;

use anyhow::anyhow;
use plotters::prelude::*;
use plotters::style::register_font;
use quad_run::results::statistics::Estimate;

const SIZE: (u32, u32) = (900, 540);
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
    /// Dashed lines at some y, with labels.
    pub references: Vec<(String, f64)>,
    /// Dashed lines at gradient steps after which online learning begins.
    pub begins: BTreeSet<u64>,
    pub lines: Vec<Line>,
}

/// Points by x, with a band where they have intervals.
#[derive(Clone, Debug)]
pub struct Line {
    pub label: String,
    pub points: Vec<(f64, Estimate)>,
}

impl Plot {
    pub fn svg(&self) -> anyhow::Result<String> {
        let mut svg = String::new();
        self.render(SVGBackend::with_string(&mut svg, SIZE), 1)?;
        Ok(svg)
    }

    pub fn png(&self) -> anyhow::Result<Vec<u8>> {
        let (width, height) = (SIZE.0 * PNG_SCALE, SIZE.1 * PNG_SCALE);
        let mut pixels = vec![0; (width * height * 3) as usize];
        let backend = BitMapBackend::with_buffer(&mut pixels, (width, height));
        self.render(backend, PNG_SCALE)?;
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header()?.write_image_data(&pixels)?;
        Ok(file)
    }

    pub fn is_empty(&self) -> bool {
        self.lines.iter().all(|line| line.points.is_empty())
    }

    fn render<DB: DrawingBackend>(&self, backend: DB, scale: u32) -> anyhow::Result<()>
    where
        DB::ErrorType: 'static,
    {
        LazyLock::force(&FONT);
        let drawn = self.finite().draw(backend, scale);
        drawn.map_err(|error| anyhow!("cannot draw {}: {error}", self.title))
    }

    fn finite(&self) -> Self {
        let is_finite = |value: &f64| value.abs() < LARGEST;
        let mut plot = self.clone();
        plot.references.retain(|(_, y)| is_finite(y));
        for Line { points, .. } in &mut plot.lines {
            points.retain(|(x, y)| is_finite(x) && is_finite(&y.value));
            for (_, y) in points {
                (y.low, y.high) = (y.low.filter(is_finite), y.high.filter(is_finite));
            }
        }
        plot
    }

    fn draw<DB: DrawingBackend>(&self, backend: DB, scale: u32) -> Result<(), Box<dyn Error>>
    where
        DB::ErrorType: 'static,
    {
        let area = backend.into_drawing_area();
        area.fill(&WHITE)?;
        let font = |size: u32| ("sans-serif", size * scale).into_font();
        let (x, y) = self.limits();
        let mut chart = ChartBuilder::on(&area)
            .caption(&self.title, font(18))
            .margin(16 * scale)
            .margin_right(36 * scale)
            .x_label_area_size(44 * scale)
            .y_label_area_size(56 * scale)
            .build_cartesian_2d(x.clone(), y.clone())?;
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
        let dashed = |ends: [(f64, f64); 2], width| {
            let style = REFERENCE.stroke_width(width * scale);
            DashedLineSeries::new(ends, 6 * scale, 4 * scale, style)
        };
        for (name, value) in &self.references {
            let line = dashed([(x.start, *value), (x.end, *value)], 2);
            chart.draw_series(line)?.label(name).legend(legend(REFERENCE, scale));
        }
        for step in self.begins.iter().map(|step| *step as f64) {
            chart.draw_series(dashed([(step, y.start), (step, y.end)], 1))?;
            let place = (step, y.start + 0.04 * (y.end - y.start));
            chart.draw_series([Text::new(" online", place, font(13).color(&REFERENCE))])?;
        }
        for (line, color) in self.lines.iter().zip(COLORS.iter().cycle()) {
            let band = line.band();
            if !band.is_empty() {
                chart.draw_series([Polygon::new(band, color.mix(0.15))])?;
            }
            let points = line.points.iter().map(|(x, y)| (*x, y.value));
            let drawn = LineSeries::new(points.clone(), color.stroke_width(2 * scale));
            chart.draw_series(drawn)?.label(&line.label).legend(legend(*color, scale));
            if points.len() <= MAX_MARKERS {
                chart.draw_series(
                    points.map(|point| Circle::new(point, 3 * scale, color.filled())),
                )?;
            }
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperLeft)
            .legend_area_size(26 * scale)
            .label_font(font(13))
            .background_style(WHITE.mix(0.8))
            .border_style(REFERENCE.mix(0.4))
            .draw()?;
        area.present()?;
        Ok(())
    }

    /// Ranges of the axes: all values and 0, with room above for the legend.
    fn limits(&self) -> (Range<f64>, Range<f64>) {
        let mut points = self.lines.iter().flat_map(|line| &line.points).peekable();
        let first = points.peek().map_or(0.0, |(x, _)| *x);
        let mut x = if self.is_log { first } else { 0.0 }..first + 1e-9;
        let mut y = 0.0..0.01;
        for (x_value, Estimate { value, low, high }) in points {
            extend(&mut x, *x_value);
            [Some(*value), *low, *high].into_iter().flatten().for_each(|end| extend(&mut y, end));
        }
        for (_, value) in &self.references {
            extend(&mut y, *value);
        }
        let labels = (self.lines.len() + self.references.len()) as f64;
        y.end += (y.end - y.start) * (0.05 + 0.05 * labels);
        (x, y)
    }
}

fn extend(range: &mut Range<f64>, value: f64) {
    *range = range.start.min(value)..range.end.max(value);
}

impl Line {
    /// The upper edge of the intervals from left to right, and the lower one back.
    fn band(&self) -> Vec<(f64, f64)> {
        let edge = |end: fn(&Estimate) -> Option<f64>| {
            self.points.iter().filter_map(move |(x, y)| Some((*x, end(y)?)))
        };
        edge(|y| y.high).chain(edge(|y| y.low).rev()).collect()
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
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn infinite_values_are_not_drawn() {
        let huge = [1e200, 1e308, -1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
        let estimate =
            |value: f64| Estimate { value, low: Some(-value), high: Some(value * value) };
        let line = |huge: f64| Line {
            label: "a line".to_owned(),
            points: vec![(huge, estimate(1.0)), (1.0, estimate(huge)), (2.0, estimate(3.0))],
        };
        for is_log in [false, true] {
            let mut plot = Plot { is_log, ..Plot::default() };
            plot.references.extend(huge.map(|huge| ("a reference".to_owned(), huge)));
            plot.lines.extend(huge.map(line));
            let svg = plot.svg().unwrap();
            assert!(svg.contains("a line") && svg.contains("a reference"), "{svg}");
            assert!(!svg.contains("NaN"), "{svg}");
        }
    }
}
