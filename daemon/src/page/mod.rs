//! The status page: what a run does, in a browser, and its figures for Prometheus. Off unless `--page` asks for it. The
//! page is described in `daemon/doc/page.md`.
//!
//! | Part | Does | Thread |
//! |---|---|---|
//! | [`Page`] | gathers what the run says, ten times a second | the control thread |
//! | `live` | the newest snapshot, and a batch of events once for all viewers | shared |
//! | `server` | HTTP: files, events, pictures, figures | `holod-page` (tokio), gives way |
//! | `eye` | what an eye sees of the levels on the panel | `holod-eye`, gives way to everything |
//!
//! It only tells. Whoever can open it can change nothing: that is `holod ctl`'s.

mod address;
mod door;
mod eye;
#[cfg(fuzzing)]
pub mod fuzzing;
mod give_up;
mod latencies;
mod live;
mod metrics;
mod server;

use std::sync::Arc;

use holod_calibration::{TimeNs, host_now};
use holod_pupil_input::{Decision, Verdict};
use holod_slm_output::FieldEvent;

pub use self::address::{AddressError, PageAddress};
use self::door::Token;
use self::eye::EyeDesk;
use self::live::{Batch, Light, Live, ShownField, TakenSample};
use self::server::PageServer;
use crate::cli::PageArgs;
use crate::failure::{Exit, Failure};
use crate::frame_record::FrameRecord;
use crate::logging;
use crate::session::{Began, FirstLight, Observer};
use crate::snapshot::Snapshot;

/// Refuses an address that others could reach without a token.
///
/// # Errors
/// It is one.
pub fn judge(args: &PageArgs) -> Result<(), Failure> {
    let judged = args.page.as_ref().map_or(Ok(()), |address| address.may_be_served(args.page_token.is_some()));
    judged.map_err(Failure::because(Exit::Usage))
}

/// A page that is served for as long as this lives.
pub struct Page {
    live: Arc<Live>,
    eye: EyeDesk,
    gathered: Batch,
    t_origin: TimeNs,
    log_seen: u64,
    _server: PageServer,
}

impl Page {
    /// Serves the page that `args` ask for.
    ///
    /// # Errors
    /// The address cannot be had, or would be open to others without a token.
    pub fn open(args: &PageArgs) -> Result<Option<Self>, Failure> {
        let Some(address) = &args.page else { return Ok(None) };
        judge(args)?;
        let token = args.page_token.as_deref().map(Token::read).transpose().map_err(Failure::because(Exit::Config))?;
        let live = Arc::new(Live::default());
        let eye = EyeDesk::default();
        let server = PageServer::start(address, token, Arc::clone(&live), eye.clone())
            .map_err(Failure::because(Exit::Unavailable))?;
        tracing::info!("the status page is at {}", server.place());
        Ok(Some(Self { live, eye, gathered: Batch::default(), t_origin: TimeNs(0), log_seen: 0, _server: server }))
    }

    /// Seconds since the run began, to a microsecond.
    fn seconds(&self, t: TimeNs) -> f64 {
        ((t - self.t_origin).0 / 1000) as f64 / 1e6
    }
}

impl Observer for Page {
    fn wants_look(&self) -> bool {
        true
    }

    fn began(&mut self, bench: &mut Began) {
        self.t_origin = bench.t_origin;
        if let Some(look) = bench.look.take()
            && let Err(error) = self.eye.open(bench.rig.clone(), Arc::clone(&bench.encoder), look)
        {
            tracing::warn!("the page will show no picture: {error}");
        }
    }

    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.eye.note(record);
        if record.is_computed {
            self.live.latencies.frame(record.t_submit - record.t_wake);
        }
        let milliseconds = |from: TimeNs, to: TimeNs| ((to - from).0 / 1000) as f64 / 1e3;
        self.gathered.frames.push(live::MadeFrame(
            record.frame,
            self.seconds(record.t_wake),
            record.pupil.mm(),
            record.pupil_state.name(),
            milliseconds(record.t_wake, record.t_render_begin),
            milliseconds(record.t_render_begin, record.t_render_end),
            milliseconds(record.t_render_end, record.t_submit),
            record.is_computed,
        ));
        Ok(())
    }

    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        let mark = match event.dark {
            Some(reason) => reason.name(),
            None if event.repeated => "repeated",
            None if event.deadline_missed => "late",
            None => "",
        };
        self.gathered.fields.push(ShownField(
            event.frame_id,
            event.colour.index(),
            self.seconds(event.t_present),
            self.seconds(event.t_end),
            event.laser_on.map(|t| self.seconds(t)),
            event.laser_off.map(|t| self.seconds(t)),
            mark,
        ));
        Ok(())
    }

    fn first_light(&mut self, light: &FirstLight) {
        self.live.latencies.light(light);
        let milliseconds = |time: Option<TimeNs>| time.map(|time| (time.0 / 1000) as f64 / 1e3);
        self.gathered.light.push(Light(
            self.seconds(light.t),
            milliseconds(light.sample_to_photon),
            milliseconds(light.picture_to_photon),
        ));
    }

    fn decision(&mut self, decision: &Decision) -> Result<(), Failure> {
        let sample = &decision.sample;
        let refused = match decision.verdict {
            Verdict::Accepted => None,
            Verdict::Rejected(reason) => Some(reason.name()),
        };
        let t_s = self.seconds(sample.t_arrival);
        self.gathered.samples.push(TakenSample(t_s, sample.eye.letter(), sample.diameter_mm, refused));
        Ok(())
    }

    fn snapshot(&mut self, snapshot: &Snapshot) {
        self.live.publish(snapshot, host_now());
    }

    fn tick(&mut self) -> Result<(), Failure> {
        self.gathered.log = logging::recent_since(&mut self.log_seen);
        self.live.hand_out(std::mem::take(&mut self.gathered));
        Ok(())
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.live.end();
    }
}
