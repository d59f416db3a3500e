//! A look at what is on the panel while it is driven.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::fields::LevelsFrame;

/// Looks at the levels that a panel shows: one copy for each time that it is asked, made by the panel's thread when the
/// next frame comes on.
#[derive(Debug)]
pub struct PanelLook {
    wanted: Arc<AtomicBool>,
    copies: triple_buffer::Output<LevelsFrame>,
}

impl PanelLook {
    /// Asks for the levels of the next new frame. They never come where the panel cannot say what it shows.
    pub fn ask(&self) {
        self.wanted.store(true, Ordering::Release);
    }

    /// Whether the levels that were asked for are there.
    pub fn is_there(&self) -> bool {
        self.copies.updated()
    }

    /// The levels that were asked for, once, when they are there.
    pub fn take(&mut self) -> Option<&LevelsFrame> {
        self.copies.update().then(|| self.copies.output_buffer())
    }
}

/// The end of the panel's thread. It neither waits nor allocates.
pub(crate) struct LookedAt {
    wanted: Arc<AtomicBool>,
    copies: triple_buffer::Input<LevelsFrame>,
}

impl LookedAt {
    pub(super) fn is_wanted(&self) -> bool {
        self.wanted.load(Ordering::Acquire)
    }

    pub(super) fn show(&mut self, shown: &LevelsFrame) {
        self.wanted.store(false, Ordering::Release);
        self.copies.input_buffer_mut().copy_from(shown);
        self.copies.publish();
    }
}

/// Both ends, with memory for frames like `blank`.
pub(crate) fn look(blank: &LevelsFrame) -> (LookedAt, PanelLook) {
    let (input, output) = triple_buffer::triple_buffer(blank);
    let wanted = Arc::new(AtomicBool::new(false));
    (LookedAt { wanted: Arc::clone(&wanted), copies: input }, PanelLook { wanted, copies: output })
}
