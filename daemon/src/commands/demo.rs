//! `holod demo`: the whole loop on built-in inputs, and pictures of what happened.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;

use holod_calibration::{Colour, Dioptres, DisplayGeometry, PupilDiameter, TimeNs};
use holod_model::optics::{Eye, PhasePattern, SimulatedEye};
use holod_model::{LinearImage, RgbdFrame, metrics};
use holod_pupil_input::{Decision, MOCK_SEED, MockSource, Scenario, TrackerSpec, Verdict};
use holod_slm_output::present::ReportFaults;
use holod_slm_output::{FieldEvent, OutputSpec};

use crate::cli::{Backend, DemoArgs, RigArgs, SceneArgs};
use crate::failure::{Exit, Failure};
use crate::frame_record::FrameRecord;
use crate::pictures::{
    Area, LatencyPlot, PupilPlot, PupilSampleMark, Sheet, Tile, phase_picture, screen_picture, shown_pattern,
};
use crate::record::{FieldRecord, FrameLog};
use crate::session::{self, FirstLight, Observer, SessionPlan, SessionReport, ShownLevels};
use crate::source::{Pictures, scene};
use crate::staging::Staging;
use crate::{logging, progress, results, run_text, setup};

/// Where the sample scene's two text cards stand.
const NEAR: Dioptres = Dioptres(2.5);
const FAR: Dioptres = Dioptres(0.25);
/// The cards' rims are left out of the figures: in front of them and behind them other things blur.
const INSET_PX: usize = 12;
const SCENARIO: Scenario = Scenario::Sweep;
const FOLDER: &str = "holod-demo";
const FILES: [&str; 9] = [
    "eye.png",
    "phase_red.png",
    "phase_green.png",
    "phase_blue.png",
    "pupil.svg",
    "latency.svg",
    "frames.csv",
    "summary.json",
    "summary.txt",
];

pub(super) fn demo(args: &DemoArgs) -> Result<(), Failure> {
    let out = args.out.clone().unwrap_or_else(free_folder);
    let staging = Staging::new(&out, &FILES, args.force)?;
    let rig = setup::rig_with_network(&RigArgs::default(), &args.network)?;
    let weights = progress::during("loading the network", || setup::weights(&rig))?;
    let constant = weights.config().amplitude_constant;
    let named = SceneArgs { resolution: args.resolution, ..SceneArgs::default() };
    let frames = scene::frames(&named, &rig.geometry)?;
    let scene = frames.frames[0].clone();
    let geometry = rig.geometry;
    let (resolution, tracker) = (frames.resolution(), SCENARIO.name());
    logging::say(&format!("running the loop for {:?}: {resolution} px, tracker {tracker}", args.duration));
    let mut log = Log {
        frames_csv: FrameLog::create(&staging.path("."))?,
        frames: Vec::new(),
        first_fields: Vec::new(),
        lights: Vec::new(),
        decisions: Vec::new(),
    };
    let session = session::run(
        SessionPlan {
            rig,
            rig_again: None,
            hangups: None,
            weights,
            backend: Backend::Auto,
            pictures: Pictures::Scene(Arc::new(frames)),
            output: OutputSpec::Headless(ReportFaults::NONE),
            tracker: TrackerSpec::Mock(SCENARIO),
            ports_of_others: Vec::new(),
            pupil: None,
            record_tracker: None,
            record: None,
            frame_limit: None,
            duration: Some(args.duration),
            keep_levels: true,
            hash_levels: false,
        },
        &mut log,
    )?;
    log.frames_csv.flush()?;

    let (Some(narrow), Some(wide)) = (session.shown.first(), session.shown.last()) else {
        return Err(Failure::new(
            Exit::Unavailable,
            format!("no frame was shown within {:?}; give the machine longer with --duration 30s", args.duration),
        ));
    };
    logging::say("computing what an eye sees of the recorded panel levels");
    let views: Vec<EyeView> = progress::during("computing what the eye sees", || {
        let mut eye = SimulatedEye::new(&geometry, scene.resolution);
        let of_frame = |shown: &ShownLevels| {
            let pattern = shown_pattern(&session.encoder, &shown.levels);
            [NEAR, FAR].map(|focus| EyeView::new(&mut eye, &pattern, constant, shown.pupil, focus, &scene))
        };
        let frames = if narrow.pupil == wide.pupil { vec![wide] } else { vec![narrow, wide] };
        frames.into_iter().flat_map(of_frame).collect()
    });
    results::save_png(eye_sheet(&views).draw(), &staging.path("eye.png"))?;
    let pattern = shown_pattern(&session.encoder, &wide.levels);
    for colour in Colour::ALL {
        results::save_png(phase_picture(&pattern, colour), &staging.path(&format!("phase_{colour}.png")))?;
    }
    log.pupil_plot(&session, &staging)?;
    log.latency_plot(&session, &staging)?;
    results::save_json(&session.summary, &staging.path("summary.json"))?;
    let text = summary_text(&session, &views);
    std::fs::write(staging.path("summary.txt"), format!("{text}\n")).map_err(Failure::because(Exit::CannotCreate))?;
    staging.commit()?;
    results::print(&text)?;
    results::print(&format!("\nThe pictures are in {}; begin with eye.png.", out.display()))
}

/// `holod-demo`, or the first of `holod-demo-2` and so on that is not there yet.
fn free_folder() -> PathBuf {
    let names = std::iter::once(FOLDER.to_owned()).chain((2..).map(|number| format!("{FOLDER}-{number}")));
    names.map(PathBuf::from).find(|name| !name.exists()).expect("numbers without end")
}

/// What an eye sees of one presented frame at one focus.
struct EyeView {
    pupil: PupilDiameter,
    focus: Dioptres,
    picture: LinearImage,
    /// Sharpness of the cards; of one that is not in the picture, nothing.
    near_energy: Option<f64>,
    far_energy: Option<f64>,
}

impl EyeView {
    fn new(
        eye: &mut SimulatedEye,
        pattern: &PhasePattern,
        constant: f32,
        pupil: PupilDiameter,
        focus: Dioptres,
        scene: &RgbdFrame,
    ) -> Self {
        let picture = eye.view(pattern, constant, Eye { pupil, focus });
        let energy_at = |depth: Dioptres| {
            let area =
                Area::at_depth(&scene.depth_normalised, scene.resolution, &DisplayGeometry::DEFAULT, depth, INSET_PX);
            area.map(|area| metrics::gradient_energy(&picture, area.columns, area.rows))
        };
        let (near_energy, far_energy) = (energy_at(NEAR), energy_at(FAR));
        Self { pupil, focus, picture, near_energy, far_energy }
    }
}

fn eye_sheet(views: &[EyeView]) -> Sheet {
    let tile = |view: &EyeView| Tile {
        caption: format!(
            "pupil {:.1} mm, focus {} ({:.2} dpt, {})",
            view.pupil.mm(),
            if view.focus == NEAR { "near" } else { "far" },
            view.focus.0,
            if view.focus == NEAR { "40 cm" } else { "4 m" },
        ),
        picture: screen_picture(&view.picture),
    };
    let rows = match views.len() {
        2 => "The run was too short for a second pupil.",
        _ => "Top: narrow pupil. Bottom: wide pupil.",
    };
    Sheet {
        title: "What the eye sees of the recorded panel patterns".into(),
        rows: views.chunks(2).map(|row| row.iter().map(tile).collect()).collect(),
        footer: vec![
            format!("Left: the eye focuses on the near card. Right: on the far card. {rows}"),
            "What is in focus is sharper than what is not. The wider pupil blurs edges more, but outlines of print stay."
                .into(),
        ],
    }
}

fn summary_text(session: &SessionReport, views: &[EyeView]) -> String {
    let mut table = String::new();
    let energy = |found: Option<f64>| found.map_or_else(|| "none".to_owned(), |energy| format!("{energy:.1}"));
    for view in views {
        table.push_str(&format!(
            "  pupil {:.2} mm, focus {:4.2} dpt:   near card {:>7}   far card {:>7}\n",
            view.pupil.mm(),
            view.focus.0,
            energy(view.near_energy),
            energy(view.far_energy)
        ));
    }
    if views.iter().any(|view| view.near_energy.is_none() || view.far_energy.is_none()) {
        table.push_str("  (none: at this resolution the card is too small to be judged)\n");
    }
    let phase_mm = views.last().map_or(0.0, |view| view.pupil.mm());
    format!(
        "holod demo\n\n\
         A simulated eye whose pupil closes to about 2 mm in bright light and opens to about 6 mm in the dark was\n\
         tracked at 200 Hz, blinks included. Each frame's hologram was computed for the pupil expected when its light\n\
         arrives, as nearly as an eye sees of its blur, double-phase encoded, turned into panel levels and shown on a\n\
         virtual panel at 60 Hz, colour after colour, each laser lit only over its own field.\n\n\
         eye.png                     what the eye sees of the levels that the panel really showed\n\
         phase_<colour>.png          the phase pattern of the widest pupil kept, {phase_mm:.2} mm: black 0, white 2 pi\n\
         pupil.svg                   raw samples, what the gate rejected, the estimate, and the simulated eye's truth\n\
         latency.svg                 what each frame cost\n\
         frames.csv, summary.json    the record of every colour field, and the numbers of the run\n\n\
         Sharpness of the two text cards (gradient energy; larger is sharper):\n{table}\n{}",
        run_text::summary_text(&session.summary)
    )
}

/// Keeps everything of a short run.
struct Log {
    frames_csv: FrameLog,
    frames: Vec<FrameRecord>,
    first_fields: Vec<FieldEvent>,
    lights: Vec<FirstLight>,
    decisions: Vec<Decision>,
}

impl Observer for Log {
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.frames_csv.frame(*record);
        self.frames.push(*record);
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        if !event.repeated && event.field == 0 {
            self.first_fields.push(*event);
        }
        self.frames_csv.field(&FieldRecord::of(event))
    }

    fn first_light(&mut self, light: &FirstLight) {
        self.lights.push(*light);
    }

    fn decision(&mut self, decision: &Decision) -> Result<(), Failure> {
        self.decisions.push(*decision);
        Ok(())
    }
}

impl Log {
    fn pupil_plot(&self, session: &SessionReport, staging: &Staging) -> Result<(), Failure> {
        let since = |t: TimeNs| (t - session.t_origin).seconds();
        let samples: Vec<PupilSampleMark> = self
            .decisions
            .iter()
            .map(|decision| PupilSampleMark {
                t_s: since(decision.sample.t_sample),
                raw_mm: f64::from(decision.sample.diameter_mm),
                accepted: decision.verdict == Verdict::Accepted,
            })
            .collect();
        let estimate: Vec<(f64, f64)> = self
            .first_fields
            .iter()
            .filter_map(|field| {
                let frame = self.frames.iter().find(|frame| frame.frame == field.frame_id)?;
                let estimate = frame.pupil_estimate.unwrap_or(frame.pupil);
                Some((since(field.t_present), f64::from(estimate.mm())))
            })
            .collect();
        let seen: Vec<_> = MockSource::new(SCENARIO, MOCK_SEED)
            .take_while(|sample| sample.sample.t_sample.seconds() < session.summary.duration_s)
            .collect();
        let truth: Vec<(f64, f64)> = seen
            .chunks_exact(2)
            .map(|eyes| {
                let mean_mm = 0.5 * (eyes[0].truth_mm + eyes[1].truth_mm);
                (eyes[0].sample.t_sample.seconds(), f64::from(mean_mm))
            })
            .collect();
        PupilPlot { unit: None, of_log: false, samples: &samples, estimate: &estimate, truth: &truth }
            .save(&staging.path("pupil.svg"))
    }

    fn latency_plot(&self, session: &SessionReport, staging: &Staging) -> Result<(), Failure> {
        let since = |t: TimeNs| (t - session.t_origin).seconds();
        let ms = |span: TimeNs| span.seconds() * 1e3;
        let mut render = Vec::new();
        for field in &self.first_fields {
            let Some(frame) = self.frames.iter().find(|frame| frame.frame == field.frame_id) else { continue };
            if frame.is_computed {
                render.push((since(field.t_present), ms(frame.t_submit - frame.t_wake)));
            }
        }
        let [photon, missed] = self.latencies(since);
        LatencyPlot { render_ms: &render, sample_to_photon_ms: &photon, missed: &missed }
            .save(&staging.path("latency.svg"))
    }

    /// Each frame's time from sample to photons, as the summary counts it, by when its first light was, and of these
    /// those of frames that were late.
    fn latencies(&self, since: impl Fn(TimeNs) -> f64) -> [Vec<(f64, f64)>; 2] {
        let late: HashSet<u64> =
            self.first_fields.iter().filter(|field| field.deadline_missed).map(|field| field.frame_id).collect();
        let (mut all, mut missed) = (Vec::new(), Vec::new());
        for light in &self.lights {
            let Some(latency) = light.sample_to_photon else { continue };
            let mark = (since(light.t), latency.seconds() * 1e3);
            all.push(mark);
            if late.contains(&light.frame) {
                missed.push(mark);
            }
        }
        [all, missed]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use holod_slm_output::TimestampSource;
    use holod_slm_output::laser::DarkReason;

    #[test]
    fn latencies_are_those_of_first_lights_whichever_field_that_was() {
        let folder = tempfile::tempdir().unwrap();
        let frames_csv = FrameLog::create(folder.path()).unwrap();
        let mut log =
            Log { frames_csv, frames: Vec::new(), first_fields: Vec::new(), lights: Vec::new(), decisions: Vec::new() };
        let ms = |ms: i64| TimeNs(1_000_000 * ms);
        // The first field of frame 2 is late and dark, and of its second one it is told when it was lit.
        for (frame, t_ms, latency_ms) in [(1, 100, Some(45)), (2, 125, Some(53)), (3, 150, None)] {
            let is_lit = frame != 2;
            let t_present = ms(t_ms - 5);
            let field = FieldEvent {
                frame_id: frame,
                field: 0,
                colour: Colour::Red,
                t_submit: t_present,
                t_desired_present: t_present,
                t_present,
                t_settled: t_present,
                t_end: ms(t_ms),
                timestamp_source: TimestampSource::Software,
                laser_on: is_lit.then_some(t_present),
                laser_off: is_lit.then_some(ms(t_ms)),
                dark: (!is_lit).then_some(DarkReason::Late),
                repeated: false,
                deadline_missed: frame == 2,
            };
            let sample_to_photon = latency_ms.map(ms);
            log.first_light(&FirstLight { frame, t: ms(t_ms), sample_to_photon, picture_to_photon: None });
            log.field(&field).unwrap();
        }
        let [all, late] = log.latencies(|t| t.seconds());
        let expected = [(0.1, 45.0), (0.125, 53.0)];
        let alike = |marks: &[(f64, f64)], expected: &[(f64, f64)]| {
            marks.len() == expected.len()
                && marks.iter().zip(expected).all(|(a, b)| (a.0 - b.0).abs() < 1e-9 && (a.1 - b.1).abs() < 1e-9)
        };
        assert!(alike(&all, &expected), "{all:?}");
        assert!(alike(&late, &expected[1..]), "{late:?}");
        assert!(!alike(&all, &[(0.1, 45.0), (0.125, 53.1)]) && !alike(&all, &expected[1..]));
    }
}
