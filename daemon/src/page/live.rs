//! What viewers are told: the newest snapshot, and batches of what happened, each put into words once for all of them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use arc_swap::ArcSwapOption;
use axum::body::Bytes;
use holod_calibration::TimeNs;
use serde::Serialize;
use tokio::sync::broadcast;

use super::latencies::Latencies;
use crate::logging::Line;
use crate::snapshot::Snapshot;
use crate::tally_by::{Reason, TallyBy};

/// What a viewer who comes is told of what was before: ten seconds.
const REMEMBERED: usize = 100;
/// A viewer who is slower than this misses some.
const IN_FLIGHT: usize = 32;

/// All that viewers share.
#[derive(Default)]
pub(super) struct Live {
    /// The newest; nothing before the first.
    pub(super) snapshot: ArcSwapOption<Published>,
    pub(super) latencies: Latencies,
    pub(super) viewers: AtomicUsize,
    /// Requests that were refused.
    pub(super) refused: TallyBy<Refused>,
    channel: Mutex<Channel>,
}

/// How the run was.
pub(super) struct Published {
    pub(super) snapshot: Snapshot,
    /// When, on the host's clock.
    pub(super) t: TimeNs,
}

/// Why a request was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refused {
    /// It came without the token.
    Token,
    /// It asked for this machine by a name that is none of its own.
    Name,
    /// Another site's page made a browser ask.
    Site,
    /// Too many connections were open.
    Connections,
    /// Too many browsers watched.
    Viewers,
    /// It asked for an eye that nobody has.
    Query,
    /// Too many asked for a picture.
    Busy,
}

impl Reason for Refused {
    const ALL: &'static [Self] =
        &[Self::Token, Self::Name, Self::Site, Self::Connections, Self::Viewers, Self::Query, Self::Busy];

    fn name(self) -> &'static str {
        match self {
            Self::Token => "token",
            Self::Name => "name",
            Self::Site => "site",
            Self::Connections => "connections",
            Self::Viewers => "viewers",
            Self::Query => "query",
            Self::Busy => "busy",
        }
    }
}

/// What is sent to everybody, and what newcomers are told first.
struct Channel {
    sender: Option<broadcast::Sender<Bytes>>,
    newest_snapshot: Option<Bytes>,
    batches: VecDeque<Bytes>,
}

impl Default for Channel {
    fn default() -> Self {
        Self { sender: Some(broadcast::Sender::new(IN_FLIGHT)), newest_snapshot: None, batches: VecDeque::new() }
    }
}

impl Live {
    /// Tells everybody how the run is at host time `t`.
    pub(super) fn publish(&self, snapshot: &Snapshot, t: TimeNs) {
        let event = event("snapshot", snapshot);
        self.snapshot.store(Some(Arc::new(Published { snapshot: snapshot.clone(), t })));
        let mut channel = self.channel();
        channel.newest_snapshot = Some(event.clone());
        channel.send(event);
    }

    /// Tells everybody what happened.
    pub(super) fn hand_out(&self, batch: Batch) {
        let event = event("batch", &batch);
        let mut channel = self.channel();
        if channel.batches.len() == REMEMBERED {
            channel.batches.pop_front();
        }
        channel.batches.push_back(event.clone());
        channel.send(event);
    }

    /// What came before, and what comes from now on; nothing where the run is over.
    pub(super) fn watch(&self) -> Option<(Vec<Bytes>, broadcast::Receiver<Bytes>)> {
        let channel = self.channel();
        let receiver = channel.sender.as_ref()?.subscribe();
        let before = channel.newest_snapshot.iter().chain(&channel.batches).cloned().collect();
        Some((before, receiver))
    }

    /// Tells everybody that the run is over.
    pub(super) fn end(&self) {
        let mut channel = self.channel();
        channel.send(event("end", &()));
        channel.sender = None;
    }

    fn channel(&self) -> MutexGuard<'_, Channel> {
        self.channel.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Channel {
    fn send(&mut self, event: Bytes) {
        if let Some(sender) = &self.sender {
            // Nobody watches.
            let _nobody = sender.send(event);
        }
    }
}

/// Counts a viewer for as long as it lives.
pub(super) struct Viewer(Arc<Live>);

impl Viewer {
    /// Nothing where there are `most` already.
    pub(super) fn come(live: &Arc<Live>, most: usize) -> Option<Self> {
        let one_more = |viewers: usize| (viewers < most).then_some(viewers + 1);
        live.viewers.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_more).ok()?;
        Some(Self(Arc::clone(live)))
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.0.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What happened in a tenth of a second. Times are seconds since the run began.
#[derive(Default, Serialize)]
pub(super) struct Batch {
    pub(super) samples: Vec<TakenSample>,
    pub(super) frames: Vec<MadeFrame>,
    pub(super) fields: Vec<ShownField>,
    pub(super) light: Vec<Light>,
    pub(super) log: Vec<Line>,
}

/// When it came, whose eye, millimetres (null for no number), why it was not believed.
#[derive(Serialize)]
pub(super) struct TakenSample(pub(super) f64, pub(super) char, pub(super) f32, pub(super) Option<&'static str>);

/// Number, when the loop woke, the pupil in millimetres, what that rests on, and milliseconds to the engine's start, to
/// its end, to the submission; whether its levels were computed.
#[derive(Serialize)]
pub(super) struct MadeFrame(
    pub(super) u64,
    pub(super) f64,
    pub(super) f32,
    pub(super) &'static str,
    pub(super) f64,
    pub(super) f64,
    pub(super) f64,
    pub(super) bool,
);

/// Frame, colour from red, from, until, its laser's from and until, and what is remarkable about it.
#[derive(Serialize)]
pub(super) struct ShownField(
    pub(super) u64,
    pub(super) usize,
    pub(super) f64,
    pub(super) f64,
    pub(super) Option<f64>,
    pub(super) Option<f64>,
    pub(super) &'static str,
);

/// When, and milliseconds since the tracker's sample and since the feed's picture.
#[derive(Serialize)]
pub(super) struct Light(pub(super) f64, pub(super) Option<f64>, pub(super) Option<f64>);

/// A server-sent event, ready for the wire. JSON has no line breaks that are not escaped.
fn event(name: &str, data: &impl Serialize) -> Bytes {
    let data = serde_json::to_string(data).expect("numbers, texts and lists");
    Bytes::from(format!("event: {name}\ndata: {data}\n\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(bytes: &Bytes) -> &str {
        std::str::from_utf8(bytes).unwrap()
    }

    #[test]
    fn a_newcomer_is_told_what_was_and_then_what_comes() {
        let live = Live::default();
        live.publish(&Snapshot { state: "dark".into(), ..Snapshot::default() }, TimeNs(0));
        live.publish(&Snapshot { state: "running".into(), ..Snapshot::default() }, TimeNs(0));
        for t in 0..REMEMBERED + 5 {
            live.hand_out(Batch { light: vec![Light(t as f64, None, None)], ..Batch::default() });
        }
        let (before, mut receiver) = live.watch().unwrap();
        assert_eq!(before.len(), REMEMBERED + 1);
        assert!(text(&before[0]).contains(r#""state":"running""#));
        assert!(text(&before[1]).contains(r#""light":[[5.0,null,null]]"#), "{}", text(&before[1]));
        live.hand_out(Batch { samples: vec![TakenSample(1.5, 'L', f32::NAN, Some("lost"))], ..Batch::default() });
        let batch = receiver.try_recv().unwrap();
        assert!(
            text(&batch).starts_with("event: batch\ndata: {\"samples\":[[1.5,\"L\",null,\"lost\"]],"),
            "{}",
            text(&batch)
        );
        live.end();
        assert_eq!(text(&receiver.try_recv().unwrap()), "event: end\ndata: null\n\n");
        assert!(live.watch().is_none());
    }

    #[test]
    fn so_many_may_watch_and_no_more() {
        let live = Arc::new(Live::default());
        let first = Viewer::come(&live, 2);
        let second = Viewer::come(&live, 2);
        assert!(first.is_some() && second.is_some() && Viewer::come(&live, 2).is_none());
        drop(first);
        assert!(Viewer::come(&live, 2).is_some());
    }
}
