//! The picture of a run: score over gradient steps, with the dataset's mean beside it. SVG.

use std::path::Path;

use anyhow::anyhow;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::run::{EvaluationReport, RunReport};

const SIZE: (u32, u32) = (900, 540);
const DATASET: RGBColor = RGBColor(110, 110, 110);
/// Colours that stay apart for most colour-blind readers (Okabe and Ito).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
];

/// Draws the learning curves of some runs into one SVG file: the mean over an evaluation's episodes as a line with
/// points, and for a single run a band of ± one standard deviation over them. The dashed line is the dataset's mean.
pub fn learning_curves(path: &Path, runs: &[RunReport]) -> anyhow::Result<()> {
    let file = path.file_name().ok_or_else(|| anyhow!("{} is no file name", path.display()))?;
    let partial = path.with_file_name(format!("{}.partial", file.display()));
    draw(&partial, runs).map_err(|error| anyhow!("cannot draw {}: {error}", path.display()))?;
    std::fs::rename(&partial, path)?;
    Ok(())
}

type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(path: &Path, runs: &[RunReport]) -> Drawn {
    let root = SVGBackend::new(path, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (last_step, range) = limits(runs);
    let measure = match [true, false].map(|normalised| runs.iter().any(|run| run.normalised == normalised)) {
        [_, false] => "D4RL-normalised score",
        [false, true] if runs.iter().any(|run| run.measure() == "score") => "score",
        [false, true] => "return",
        [true, true] => "D4RL-normalised score, or return",
    };
    let title = match runs {
        [run] => format!("{}: {measure} over {} episodes", run.run, episodes(run)),
        _ => measure.to_owned(),
    };
    let mut chart = ChartBuilder::on(&root)
        .caption(title, ("sans-serif", 20))
        .margin(16)
        .x_label_area_size(44)
        .y_label_area_size(56)
        .build_cartesian_2d(0.0..last_step, range)?;
    chart
        .configure_mesh()
        .x_desc("gradient steps")
        .y_desc(measure)
        .x_label_formatter(&|step| format!("{step:.0}"))
        .light_line_style(WHITE)
        .draw()?;
    draw_references(&mut chart, runs, last_step)?;
    for (run, colour) in runs.iter().zip(COLOURS.iter().cycle()) {
        draw_run(&mut chart, run, *colour, runs.len() == 1)?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE.mix(0.8))
        .border_style(DATASET.mix(0.4))
        .draw()?;
    root.present()?;
    Ok(())
}

fn draw_references(chart: &mut Chart, runs: &[RunReport], last_step: f64) -> Drawn {
    let mut references: Vec<f64> = runs.iter().map(|run| run.dataset_score).collect();
    references.sort_by(f64::total_cmp);
    references.dedup();
    for score in references {
        let line = DashedLineSeries::new([(0.0, score), (last_step, score)], 6, 4, DATASET.stroke_width(2));
        let legend = |(x, y)| PathElement::new([(x, y), (x + 20, y)], DATASET.stroke_width(2));
        chart.draw_series(line)?.label(format!("dataset mean {score:.1}")).legend(legend);
    }
    Ok(())
}

fn draw_run(chart: &mut Chart, run: &RunReport, colour: RGBColor, has_band: bool) -> Drawn {
    if has_band {
        let edge =
            |sign: f64| move |e: &EvaluationReport| (e.step as f64, e.score.mean + sign * e.score.std.unwrap_or(0.0));
        let upper = run.evaluations.iter().map(edge(1.0));
        let band: Vec<_> = upper.chain(run.evaluations.iter().rev().map(edge(-1.0))).collect();
        chart.draw_series([Polygon::new(band, colour.mix(0.15))])?;
    }
    let points: Vec<_> = run.evaluations.iter().map(|e| (e.step as f64, e.score.mean)).collect();
    let label = format!("{} ({})", run.run, run.variant);
    let legend = move |(x, y)| PathElement::new([(x, y), (x + 20, y)], colour.stroke_width(2));
    chart.draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))?.label(label).legend(legend);
    chart.draw_series(points.into_iter().map(|point| Circle::new(point, 3, colour.filled())))?;
    Ok(())
}

fn episodes(run: &RunReport) -> usize {
    run.evaluations.iter().map(|e| e.episodes).max().unwrap_or(0)
}

/// The last step, and the scores to show: everything, with some room above for the legend.
fn limits(runs: &[RunReport]) -> (f64, std::ops::Range<f64>) {
    let evaluations = || runs.iter().flat_map(|run| &run.evaluations);
    let last_step = evaluations().map(|e| e.step).max().unwrap_or(1);
    let spreads = evaluations().flat_map(|e| [-1.0, 1.0].map(|sign| e.score.mean + sign * e.score.std.unwrap_or(0.0)));
    let scores: Vec<f64> = spreads.chain(runs.iter().map(|run| run.dataset_score)).collect();
    let lowest = scores.iter().copied().fold(0.0, f64::min);
    let highest = scores.iter().copied().fold(1.0, f64::max);
    (last_step as f64, lowest..lowest + (highest - lowest) * 1.25)
}
