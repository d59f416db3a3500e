//! What an eye sees of the levels that are on the panel, for whoever asks.

use std::collections::VecDeque;
use std::io::Cursor;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use holod_calibration::rig::Rig;
use holod_calibration::{Colour, Dioptres, PupilDiameter};
use holod_model::optics::{Eye, SimulatedEye};
use holod_slm_output::present::PanelLook;
use holod_slm_output::{LevelsFrame, PanelEncoder};
use rustix::process::setpriority_process;
use tokio::sync::oneshot;

use crate::frame_record::FrameRecord;
use crate::pictures::{screen_picture, shown_pattern};

/// Pictures that may be asked for at once.
const WAITING: usize = 4;
/// A picture of the same eye that is younger is good enough.
const FRESH: Duration = Duration::from_millis(250);
/// How long a new frame may take to come on the panel.
const FRAME_WITHIN: Duration = Duration::from_secs(3);
/// The eye's buffers, some of the largest that there are, are given back after so long without a question.
const IDLE: Duration = Duration::from_secs(20);
/// Frames whose pupil is remembered: more than are on their way to the panel.
const REMEMBERED: usize = 256;
/// Below the network's own workers.
const NICENESS: i32 = 15;

/// An eye that somebody wants to look with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Gaze {
    /// What it is focused at.
    pub(super) focus: Dioptres,
    /// Its pupil; that of the frame where it is left out.
    pub(super) pupil: Option<PupilDiameter>,
}

/// What an eye sees.
#[derive(Clone, Debug)]
pub(super) struct Seen {
    /// As a PNG file.
    pub(super) png: Bytes,
    /// The frame on the panel.
    pub(super) frame: u64,
    /// The pupil that the frame was made for.
    pub(super) made_for: PupilDiameter,
    /// The pupil that looks.
    pub(super) pupil: PupilDiameter,
}

/// Why an eye sees nothing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum Blind {
    #[error("the run has not begun, or is over")]
    NoRun,
    #[error("others are looking: ask again")]
    Busy,
    #[error("no new frame came on the panel within {FRAME_WITHIN:?}, or the panel cannot say what it shows")]
    NoFrame,
    #[error(
        "the panel shows level {level} in {colour}, whose phase its look-up table does not say: look again after the test \
         pattern, or add the level to lut_file"
    )]
    UnknownLevel { colour: Colour, level: u16 },
}

struct Question {
    gaze: Gaze,
    answer: oneshot::Sender<Result<Seen, Blind>>,
}

/// What a frame was made with.
#[derive(Clone, Copy)]
struct Made {
    frame: u64,
    pupil: PupilDiameter,
    amplitude_constant: f32,
}

/// Where pictures are asked for. The thread that makes them ends with the last of these.
#[derive(Clone, Default)]
pub(super) struct EyeDesk {
    questions: Arc<Mutex<Option<SyncSender<Question>>>>,
    made: Arc<Mutex<VecDeque<Made>>>,
}

impl EyeDesk {
    /// Starts to answer.
    ///
    /// # Errors
    /// There is no thread for it.
    pub(super) fn open(&self, rig: Rig, encoder: Arc<PanelEncoder>, look: PanelLook) -> std::io::Result<()> {
        let (sender, questions) = mpsc::sync_channel(WAITING);
        let thread = EyeThread { rig, encoder, look, made: Arc::clone(&self.made), eye: None, newest: None };
        std::thread::Builder::new().name("holod-eye".into()).spawn(move || thread.run(&questions))?;
        *self.questions.lock().unwrap_or_else(PoisonError::into_inner) = Some(sender);
        Ok(())
    }

    /// Takes note of a frame.
    pub(super) fn note(&self, record: &FrameRecord) {
        let mut made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
        if made.len() == REMEMBERED {
            made.pop_front();
        }
        let FrameRecord { frame, pupil, amplitude_constant, .. } = *record;
        made.push_back(Made { frame, pupil, amplitude_constant });
    }

    /// What `gaze` sees of the next new frame.
    pub(super) async fn look(&self, gaze: Gaze) -> Result<Seen, Blind> {
        let (answer, answered) = oneshot::channel();
        {
            let questions = self.questions.lock().unwrap_or_else(PoisonError::into_inner);
            let asked = questions.as_ref().ok_or(Blind::NoRun)?.try_send(Question { gaze, answer });
            asked.map_err(|full| match full {
                TrySendError::Full(_) => Blind::Busy,
                TrySendError::Disconnected(_) => Blind::NoRun,
            })?;
        }
        answered.await.unwrap_or(Err(Blind::NoRun))
    }
}

struct EyeThread {
    rig: Rig,
    encoder: Arc<PanelEncoder>,
    look: PanelLook,
    made: Arc<Mutex<VecDeque<Made>>>,
    eye: Option<SimulatedEye>,
    newest: Option<(Gaze, Instant, Seen)>,
}

impl EyeThread {
    fn run(mut self, questions: &Receiver<Question>) {
        if let Err(error) = setpriority_process(None, NICENESS) {
            tracing::debug!("the page's pictures are made at ordinary priority: {error}");
        }
        // Its one thread inherits that; the usual pool's would take all cores.
        let pool = match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
            Ok(pool) => pool,
            Err(error) => {
                tracing::warn!("the page will show no picture: {error}");
                return;
            }
        };
        loop {
            match questions.recv_timeout(IDLE) {
                Ok(Question { gaze, answer }) => {
                    if !answer.is_closed() {
                        // Whoever asked may have gone.
                        let _gone = answer.send(pool.install(|| self.see(gaze)));
                    }
                }
                Err(RecvTimeoutError::Timeout) => (self.eye, self.newest) = (None, None),
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn see(&mut self, gaze: Gaze) -> Result<Seen, Blind> {
        if let Some((before, t, seen)) = &self.newest
            && *before == gaze
            && t.elapsed() < FRESH
        {
            return Ok(seen.clone());
        }
        let encoder = Arc::clone(&self.encoder);
        let levels = self.next_frame().ok_or(Blind::NoFrame)?;
        let frame = levels.tag().frame_id;
        // A test pattern may show any level.
        for colour in Colour::ALL {
            let shown = levels.unpack_colour(colour).levels;
            if let Some(pixel) = encoder.unknown_level(colour, &shown) {
                return Err(Blind::UnknownLevel { colour, level: shown[pixel] });
            }
        }
        let pattern = shown_pattern(&encoder, levels);
        let made = self.made_with(frame).ok_or(Blind::NoFrame)?;
        let pupil = gaze.pupil.unwrap_or(made.pupil);
        let geometry = &self.rig.geometry;
        let eye = self.eye.get_or_insert_with(|| SimulatedEye::new(geometry, pattern.resolution));
        let looking = Eye { pupil, focus: gaze.focus };
        let picture = eye.view_weighted(&pattern, made.amplitude_constant, looking, self.rig.light());
        let mut png = Cursor::new(Vec::new());
        screen_picture(&picture).write_to(&mut png, image::ImageFormat::Png).expect("memory takes everything");
        let seen = Seen { png: png.into_inner().into(), frame: made.frame, made_for: made.pupil, pupil };
        self.newest = Some((gaze, Instant::now(), seen.clone()));
        Ok(seen)
    }

    /// What a frame was made with, which may reach the control thread later than the panel.
    fn made_with(&self, frame: u64) -> Option<Made> {
        let found = || {
            let made = self.made.lock().unwrap_or_else(PoisonError::into_inner);
            made.iter().find(|made| made.frame == frame).copied()
        };
        patiently(found)
    }

    /// The levels of the next frame that comes on the panel.
    fn next_frame(&mut self) -> Option<&LevelsFrame> {
        // What somebody asked for who did not wait for it.
        let _old = self.look.take();
        self.look.ask();
        patiently(|| self.look.is_there().then_some(()))?;
        self.look.take()
    }
}

/// What `look` finds within the time that a frame may take.
fn patiently<T>(look: impl Fn() -> Option<T>) -> Option<T> {
    let t_end = Instant::now() + FRAME_WITHIN;
    loop {
        let found = look();
        if found.is_some() || Instant::now() > t_end {
            return found;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}
