//! Plots of a run: what the pupil did, and what each frame cost.

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::failure::{Exit, Failure};

/// A raw sample and what the gate made of it.
#[derive(Clone, Copy, Debug)]
pub struct PupilSampleMark {
    /// Seconds since the run began.
    pub t_s: f64,
    /// Raw diameter; in the plot's unit where that is not millimetres.
    pub raw_mm: f64,
    /// Whether the gate let it through.
    pub accepted: bool,
}

/// A pupil over time: what was measured and what was made of it.
pub struct PupilPlot<'a> {
    /// The unit of all figures; millimetres where there is none. Samples in another unit were not judged.
    pub unit: Option<&'static str>,
    /// Of a log, which nothing was shown of: the estimate is at its samples' own times.
    pub of_log: bool,
    /// Every sample, refused ones included.
    pub samples: &'a [PupilSampleMark],
    /// (seconds, millimetres) that each frame was rendered for, or that a log's samples come to.
    pub estimate: &'a [(f64, f64)],
    /// (seconds, millimetres) of the simulated eye, where there is one.
    pub truth: &'a [(f64, f64)],
}

/// What each frame cost.
pub struct LatencyPlot<'a> {
    /// (seconds, milliseconds) from waking to the submitted pattern.
    pub render_ms: &'a [(f64, f64)],
    /// (seconds, milliseconds) from the tracker sample to photons.
    pub sample_to_photon_ms: &'a [(f64, f64)],
    /// (seconds, milliseconds from the tracker sample to photons) of the frames that came later than planned.
    pub missed: &'a [(f64, f64)],
}

const SIZE: (u32, u32) = (1100, 480);
/// What the axis of millimetres shows, and no pupil exceeds.
const GREATEST_MM: f64 = 9.0;

impl PupilPlot<'_> {
    /// Writes the plot as SVG.
    pub fn save(&self, path: &Path) -> Result<(), Failure> {
        let root = SVGBackend::new(path, SIZE).into_drawing_area();
        self.draw(&root).and_then(|()| Ok(root.present()?)).map_err(|error| cannot_draw(path, &*error))
    }

    fn draw(&self, root: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), Box<dyn std::error::Error>> {
        root.fill(&WHITE)?;
        let end_s = last_time(&[self.estimate, self.truth]).max(self.samples.last().map_or(0.0, |s| s.t_s));
        let greatest = self.samples.iter().map(|mark| mark.raw_mm).fold(f64::MIN_POSITIVE, f64::max);
        let top = if self.unit.is_none() { GREATEST_MM } else { 1.1 * greatest };
        let caption = match (self.unit, self.of_log) {
            (None, false) => "Pupil diameter: what the tracker said, what the gate kept, what the filter expected",
            (None, true) => "Pupil diameter: what the tracker said, what the gate kept, what the filter makes of it",
            (Some(_), _) => "Pupil size: what the tracker said, in its own unit",
        };
        let estimate_name =
            if self.of_log { "estimate at the samples' times" } else { "estimate at the photons' time, per frame" };
        let y_name = format!("pupil diameter / {}", self.unit.unwrap_or("mm"));
        let mut chart = ChartBuilder::on(root)
            .caption(caption, ("sans-serif", 20))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(56)
            .build_cartesian_2d(0.0..end_s.max(0.1), 0.0..top)?;
        chart.configure_mesh().x_desc("time since start / s").y_desc(y_name).light_line_style(WHITE).draw()?;
        let (good, bad) = (RGBColor(150, 170, 200), RGBColor(214, 60, 40));
        let kept_name = if self.unit.is_none() { "raw sample, kept" } else { "raw sample" };
        for (kept, colour, name) in [(true, good, kept_name), (false, bad, "raw sample, rejected")] {
            if !kept && self.unit.is_some() {
                continue;
            }
            let marks = self.samples.iter().filter(|mark| mark.accepted == kept);
            chart
                .draw_series(
                    marks.map(|mark| Circle::new((mark.t_s, mark.raw_mm.clamp(0.0, top)), 1.5, colour.filled())),
                )?
                .label(name)
                .legend(move |(x, y)| Circle::new((x + 8, y), 3, colour.filled()));
        }
        let truth = RGBColor(90, 90, 90);
        if !self.truth.is_empty() {
            chart
                .draw_series(LineSeries::new(self.truth.iter().copied(), truth.stroke_width(1)))?
                .label("the simulated eye itself")
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], truth.stroke_width(1)));
        }
        let used = RGBColor(16, 96, 48);
        if !self.estimate.is_empty() {
            chart
                .draw_series(LineSeries::new(self.estimate.iter().copied(), used.stroke_width(2)))?
                .label(estimate_name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], used.stroke_width(2)));
        }
        chart.configure_series_labels().background_style(WHITE.mix(0.85)).border_style(BLACK.mix(0.3)).draw()?;
        Ok(())
    }
}

impl LatencyPlot<'_> {
    /// Writes the plot as SVG.
    pub fn save(&self, path: &Path) -> Result<(), Failure> {
        let root = SVGBackend::new(path, SIZE).into_drawing_area();
        self.draw(&root).and_then(|()| Ok(root.present()?)).map_err(|error| cannot_draw(path, &*error))
    }

    fn draw(&self, root: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), Box<dyn std::error::Error>> {
        root.fill(&WHITE)?;
        let end_s = last_time(&[self.render_ms, self.sample_to_photon_ms]);
        let top_ms = self.render_ms.iter().chain(self.sample_to_photon_ms).map(|(_, ms)| *ms).fold(1.0, f64::max);
        let mut chart = ChartBuilder::on(root)
            .caption("Latency of each frame", ("sans-serif", 20))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(64)
            .build_cartesian_2d(0.0..end_s.max(0.1), 0.0..top_ms * 1.15)?;
        chart.configure_mesh().x_desc("time since start / s").y_desc("latency / ms").light_line_style(WHITE).draw()?;
        for (series, colour, name) in [
            (self.render_ms, RGBColor(40, 90, 180), "network, double phase and levels"),
            (self.sample_to_photon_ms, RGBColor(16, 96, 48), "tracker sample to photons"),
        ] {
            chart
                .draw_series(LineSeries::new(series.iter().copied(), colour.stroke_width(2)))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
        }
        let late = RGBColor(214, 60, 40);
        chart
            .draw_series(self.missed.iter().map(|&at| Circle::new(at, 3, late.filled())))?
            .label("shown later than planned")
            .legend(move |(x, y)| Circle::new((x + 8, y), 3, late.filled()));
        chart.configure_series_labels().background_style(WHITE.mix(0.85)).border_style(BLACK.mix(0.3)).draw()?;
        Ok(())
    }
}

fn last_time(series: &[&[(f64, f64)]]) -> f64 {
    series.iter().filter_map(|points| points.last()).map(|(t_s, _)| *t_s).fold(0.0, f64::max)
}

fn cannot_draw(path: &Path, error: &dyn std::error::Error) -> Failure {
    Failure::new(Exit::CannotCreate, format!("cannot draw {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejected_samples_and_misses_are_drawn_in_their_own_colour() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pupil.svg");
        let marks = [
            PupilSampleMark { t_s: 0.0, raw_mm: 3.5, accepted: true },
            PupilSampleMark { t_s: 0.5, raw_mm: 1.1, accepted: false },
        ];
        let estimate = [(0.0, 3.5), (0.5, 3.5)];
        let plot = PupilPlot { unit: None, of_log: false, samples: &marks, estimate: &estimate, truth: &[] };
        plot.save(&path).unwrap();
        let svg = std::fs::read_to_string(&path).unwrap();
        assert!(svg.contains("#D63C28") && svg.contains("#96AAC8"));
        assert!(!svg.contains("simulated eye itself"));
        let [of_run, of_log] = ["what the filter expected", "what the filter makes of it"];
        assert!(svg.contains(of_run) && svg.contains("photons") && !svg.contains(of_log));
        PupilPlot { of_log: true, ..plot }.save(&path).unwrap();
        let svg = std::fs::read_to_string(&path).unwrap();
        assert!(svg.contains(of_log) && svg.contains("estimate at the samples") && !svg.contains("photons"));
        assert!(!svg.contains(of_run));
        // Figures that are no millimetres have their own axis, and nobody judged them.
        let marks = [PupilSampleMark { t_s: 0.5, raw_mm: 964.0, accepted: true }];
        let plot =
            PupilPlot { unit: Some("arbitrary units"), of_log: true, samples: &marks, estimate: &[], truth: &[] };
        plot.save(&path).unwrap();
        let svg = std::fs::read_to_string(&path).unwrap();
        assert!(svg.contains("arbitrary units") && svg.contains("#96AAC8"));
        assert!(!svg.contains("rejected") && !svg.contains("estimate") && !svg.contains(" mm"));

        let path = folder.path().join("latency.svg");
        let series = [(0.0, 20.0), (0.5, 40.0)];
        LatencyPlot { render_ms: &series, sample_to_photon_ms: &series, missed: &[(0.5, 40.0)] }.save(&path).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains("shown later than planned"));
    }

    #[test]
    fn a_plot_that_cannot_be_written_says_where() {
        let plot = PupilPlot { unit: None, of_log: false, samples: &[], estimate: &[], truth: &[] };
        let failure = plot.save(Path::new("no/such/folder/pupil.svg")).unwrap_err();
        assert!(failure.to_string().contains("no/such/folder"));
    }
}
