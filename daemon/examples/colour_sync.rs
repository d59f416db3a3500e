//! What an eye sees when the lasers are in step with the panel's fields, and when they are one field late:
//! `cargo run --release -p holod --example colour_sync -- FILE.png`.
//!
//! A session runs on the virtual panel with simulated lasers; its presented levels and laser windows go through
//! [`holod_daemon::exposure`], as they were and with every window moved by a field.

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use holod_calibration::rig::Rig;
use holod_calibration::{Colour, Dioptres, Resolution, TimeNs};
use holod_daemon::cli::Backend;
use holod_daemon::exposure::{Exposure, PatternOnPanel};
use holod_daemon::failure::{Exit, Failure};
use holod_daemon::pictures::{Sheet, Tile, screen_picture};
use holod_daemon::results;
use holod_daemon::session::{self, Observer, SessionPlan, ShownLevels};
use holod_daemon::source::Pictures;
use holod_daemon::source::scene::{self, Frames};
use holod_model::Weights;
use holod_model::optics::{Eye, SimulatedEye};
use holod_pupil_input::{Scenario, TrackerSpec};
use holod_slm_output::laser::LaserEdge;
use holod_slm_output::present::ReportFaults;
use holod_slm_output::{FieldEvent, OutputSpec};

const SIZE: Resolution = Resolution { width: 224, height: 224 };
const DURATION: Duration = Duration::from_secs(20);
/// The sample scene's near card.
const FOCUS: Dioptres = Dioptres(2.5);

fn main() -> ExitCode {
    let Some(out) = std::env::args_os().nth(1) else {
        eprintln!("name the PNG to write");
        return ExitCode::from(Exit::Usage as u8);
    };
    match run(Path::new(&out)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("{failure}");
            ExitCode::from(failure.exit as u8)
        }
    }
}

/// The fields that were shown, in order.
#[derive(Default)]
struct Fields(Vec<FieldEvent>);

impl Observer for Fields {
    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.0.push(*event);
        Ok(())
    }
}

fn run(out: &Path) -> Result<(), Failure> {
    let mut rig = Rig::default();
    rig.geometry.resolution = SIZE;
    let weights = Weights::builtin_small();
    let amplitude_constant = weights.config().amplitude_constant;
    let plan = SessionPlan {
        rig: rig.clone(),
        rig_again: None,
        hangups: None,
        weights,
        backend: Backend::Cpu,
        pictures: Pictures::Scene(Arc::new(Frames {
            frames: vec![Arc::new(scene::sample_frame(SIZE))],
            fps: None,
            reports: Vec::new(),
            name: "the built-in scene".into(),
        })),
        output: OutputSpec::Headless(ReportFaults::NONE),
        tracker: TrackerSpec::Mock(Scenario::Steady),
        ports_of_others: Vec::new(),
        pupil: None,
        record_tracker: None,
        record: None,
        frame_limit: None,
        duration: Some(DURATION),
        keep_levels: true,
        hash_levels: false,
    };
    let mut fields = Fields::default();
    let session = session::run(plan, &mut fields)?;
    let nothing = |what| Failure::new(Exit::Unavailable, format!("{what} within {DURATION:?}: give the machine rest"));
    let ShownLevels { pupil, levels, .. } = session.shown.last().ok_or_else(|| nothing("no frame was shown"))?;

    // A colour frame of these levels that was lit throughout, the field before it and the one after it.
    let of_frame = |event: &FieldEvent| event.frame_id == levels.tag().frame_id;
    let begin = fields.0.windows(5).position(|five| {
        five.iter().all(of_frame) && five[1].field == 0 && five[1..4].iter().all(|event| event.laser_off.is_some())
    });
    let shown = &fields.0[begin.ok_or_else(|| nothing("no frame was shown twice"))?..][..5];
    let planes = Colour::ALL.map(|colour| levels.unpack_colour(colour).levels);
    let patterns: Vec<_> = shown
        .iter()
        .map(|event| PatternOnPanel {
            colour: event.colour,
            levels: &planes[event.colour.index()],
            t_present: event.t_present,
            t_end: event.t_end,
        })
        .collect();
    let lit = shown[1..4].iter().filter_map(|event| Some((event.colour, event.laser_on?, event.laser_off?)));
    let edges: Vec<_> = lit
        .flat_map(|(colour, on, off)| [LaserEdge { t: on, colour, on: true }, LaserEdge { t: off, colour, on: false }])
        .collect();

    let eye = Eye { pupil: *pupil, focus: FOCUS };
    let mut optics = SimulatedEye::new(&rig.geometry, SIZE);
    let field = rig.panel.field_period();
    let mut tile = |caption: &str, late: TimeNs| {
        let edges: Vec<_> = edges.iter().map(|edge| LaserEdge { t: edge.t + late, ..*edge }).collect();
        let exposure =
            Exposure { rig: &rig, encoder: &session.encoder, amplitude_constant, patterns: &patterns, edges: &edges };
        let seen = exposure.seen(&mut optics, eye, shown[0].t_present, shown[4].t_end);
        Tile { caption: caption.into(), picture: screen_picture(&seen.picture) }
    };
    let tiles = vec![tile("in step", TimeNs(0)), tile("lasers one field late", field)];
    let sheet = Sheet { title: "One colour frame".into(), rows: vec![tiles], footer: Vec::new() };
    results::save_png(sheet.draw(), out)
}
