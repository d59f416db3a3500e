//! Where a person's orders come in, and the ways into the other threads.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, mpsc};

use holod_calibration::rig::WeightsChoice;

use super::frame_loop::Change;
use crate::control::{ControlServer, Ordered, Preparer, Steering};
use crate::dark_note::{DarkNote, Found, Left};
use crate::memory;
use crate::runtime_folder;
use crate::source::PictureSink;

/// The ways into the other threads.
pub(super) struct Changes {
    pub(super) steering: Arc<Steering>,
    pub(super) sink: Arc<Mutex<PictureSink>>,
    /// With the number of the order that brings it.
    pub(super) places: rtrb::Producer<(u32, Change)>,
    pub(super) retired: rtrb::Consumer<Change>,
    /// The weights that are in use, for those who make requests ready.
    pub(super) weights: Arc<Mutex<WeightsChoice>>,
}

/// The control socket, and what it may change.
pub(super) struct Desk {
    server: Option<(ControlServer, mpsc::Receiver<Ordered>)>,
    pub(super) changes: Changes,
    keeps_dark: bool,
    pub(super) dark_note: DarkNote,
    /// A person is known to have asked for the darkness.
    is_dark_by_order: bool,
    /// It was said that the note on it cannot be left.
    note_is_refused: bool,
    /// Orders that took effect: lines of `orders.jsonl`.
    pub(super) orders: u32,
    /// What is shown in place of holograms.
    pub(super) pattern: Option<String>,
}

impl Desk {
    /// A run goes on without one where it cannot be had, and says so. `found`: whether the lasers are kept dark from
    /// the beginning.
    pub(super) fn open(preparer: Preparer, changes: Changes, found: &Found) -> Self {
        let dark_note = preparer.dark_note.clone();
        let server = runtime_folder::own()
            .ok_or_else(|| "no folder for it".into())
            .and_then(|folder| ControlServer::listen(folder.join(format!("control-{}", std::process::id())), preparer));
        let server = match server {
            Ok(server) => Some(server),
            Err(error) => {
                tracing::warn!("`holod ctl` cannot reach this run: {error}");
                None
            }
        };
        let keeps_dark = !matches!(found, Found::Nothing);
        let is_dark_by_order = matches!(found, Found::Note(_));
        let note_is_refused = false;
        Self { server, changes, keeps_dark, dark_note, is_dark_by_order, note_is_refused, orders: 0, pattern: None }
    }

    /// A person asked for dark lasers, or takes that back. What became of the note on it.
    pub(super) fn keep_dark(&mut self) -> Left {
        (self.keeps_dark, self.is_dark_by_order) = (true, true);
        self.leave_note()
    }

    /// Which notes stay all the same.
    pub(super) fn arm(&mut self) -> Option<String> {
        (self.keeps_dark, self.is_dark_by_order) = (false, false);
        self.dark_note.take_away()
    }

    /// Leaves the note again where its folder was taken away while the run goes on.
    pub(super) fn keep_note(&mut self) {
        if self.is_dark_by_order {
            self.leave_note();
        }
    }

    fn leave_note(&mut self) -> Left {
        let left = self.dark_note.leave();
        if let Some(error) = left.error.as_ref().filter(|_| !self.note_is_refused) {
            tracing::warn!("a holod that starts after a failure would light the lasers: {error}");
        }
        self.note_is_refused = left.error.is_some();
        left
    }

    pub(super) fn socket(&self) -> Option<PathBuf> {
        self.server.as_ref().map(|(server, _)| server.socket().to_owned())
    }

    /// How many requests were refused, by reason.
    pub(super) fn refused(&self) -> BTreeMap<String, u64> {
        self.server.as_ref().map(|(server, _)| server.refused()).unwrap_or_default()
    }

    pub(super) fn is_paused(&self) -> bool {
        self.changes.steering.is_paused()
    }

    pub(super) fn keeps_dark(&self) -> bool {
        self.keeps_dark
    }

    pub(super) fn pattern(&self) -> Option<&str> {
        self.pattern.as_deref()
    }

    /// Has the rig file read again, because a signal asks for it.
    pub(super) fn reload(&self) {
        match &self.server {
            Some((server, _)) => server.reload_by_signal(),
            None => tracing::error!("SIGHUP: the rig file cannot be read again without a control socket"),
        }
    }

    /// Gives back what nobody needs any more.
    pub(super) fn tidy(&mut self) {
        self.give_back();
        self.changes.sink.lock().unwrap_or_else(PoisonError::into_inner).tidy();
    }

    /// An engine's buffers are most of what holod has.
    pub(super) fn give_back(&mut self) {
        while let Ok(retired) = self.changes.retired.pop() {
            let is_large = matches!(retired, Change::Engine(..));
            drop(retired);
            if is_large {
                memory::give_back();
            }
        }
    }

    /// The number of the order that is being carried out.
    pub(super) fn next_order(&self) -> u32 {
        self.orders + 1
    }

    pub(super) fn next(&self) -> Option<Ordered> {
        self.server.as_ref()?.1.try_recv().ok()
    }
}
