//! Who is told what happens in a run: the record, the page, a comparison with a report.

use std::sync::Arc;

use holod_calibration::TimeNs;
use holod_calibration::rig::Rig;
use holod_pupil_input::Decision;
use holod_slm_output::present::PanelLook;
use holod_slm_output::{FieldEvent, PanelEncoder};

use crate::control::Request;
use crate::failure::Failure;
use crate::frame_record::FrameRecord;
use crate::snapshot::Snapshot;

/// Is told of everything in the run, on the control thread, in the order in which it happened there.
pub trait Observer {
    /// Whether it wants to look at what the panel shows, which costs memory for three frames.
    fn wants_look(&self) -> bool {
        false
    }
    /// Every part is at work.
    fn began(&mut self, _bench: &mut Began) {}
    /// A frame was made.
    fn frame(&mut self, _record: &FrameRecord) -> Result<(), Failure> {
        Ok(())
    }
    /// A field was shown and is over.
    fn field(&mut self, _event: &FieldEvent) -> Result<(), Failure> {
        Ok(())
    }
    /// A frame was lit for the first time.
    fn first_light(&mut self, _light: &FirstLight) {}
    /// The gate decided on a sample.
    fn decision(&mut self, _decision: &Decision) -> Result<(), Failure> {
        Ok(())
    }
    /// A person has changed something, at host time `t`.
    fn order(&mut self, _t: TimeNs, _request: &Request) -> Result<(), Failure> {
        Ok(())
    }
    /// What can be said of the run now: each second, and when state or lasers have changed.
    fn snapshot(&mut self, _snapshot: &Snapshot) {}
    /// About ten times a second.
    fn tick(&mut self) -> Result<(), Failure> {
        Ok(())
    }
}

/// A run whose parts are at work.
pub struct Began {
    /// When its time began.
    pub t_origin: TimeNs,
    /// The bench that is run, with what options changed of its file.
    pub rig: Rig,
    /// Turns levels back into phase.
    pub encoder: Arc<PanelEncoder>,
    /// How holograms are computed.
    pub engine: String,
    /// Looks at the panel: for the first observer that takes it.
    pub look: Option<PanelLook>,
}

/// The first light of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstLight {
    /// Number of the frame.
    pub frame: u64,
    /// The middle of its first lit field.
    pub t: TimeNs,
    /// Since the newest tracker sample that its pupil rests on.
    pub sample_to_photon: Option<TimeNs>,
    /// Since a feed's client took its picture; of a picture that is shown for another pupil again, nothing.
    pub picture_to_photon: Option<TimeNs>,
}

/// Nobody where there is none.
impl<O: Observer> Observer for Option<O> {
    fn wants_look(&self) -> bool {
        self.as_ref().is_some_and(O::wants_look)
    }
    fn began(&mut self, bench: &mut Began) {
        if let Some(observer) = self {
            observer.began(bench);
        }
    }
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.as_mut().map_or(Ok(()), |observer| observer.frame(record))
    }
    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.as_mut().map_or(Ok(()), |observer| observer.field(event))
    }
    fn first_light(&mut self, light: &FirstLight) {
        if let Some(observer) = self {
            observer.first_light(light);
        }
    }
    fn decision(&mut self, decision: &Decision) -> Result<(), Failure> {
        self.as_mut().map_or(Ok(()), |observer| observer.decision(decision))
    }
    fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        self.as_mut().map_or(Ok(()), |observer| observer.order(t, request))
    }
    fn snapshot(&mut self, snapshot: &Snapshot) {
        if let Some(observer) = self {
            observer.snapshot(snapshot);
        }
    }
    fn tick(&mut self) -> Result<(), Failure> {
        self.as_mut().map_or(Ok(()), O::tick)
    }
}

/// Two, the first one first.
impl<A: Observer, B: Observer> Observer for (A, B) {
    fn wants_look(&self) -> bool {
        self.0.wants_look() || self.1.wants_look()
    }
    fn began(&mut self, bench: &mut Began) {
        self.0.began(bench);
        self.1.began(bench);
    }
    fn frame(&mut self, record: &FrameRecord) -> Result<(), Failure> {
        self.0.frame(record)?;
        self.1.frame(record)
    }
    fn field(&mut self, event: &FieldEvent) -> Result<(), Failure> {
        self.0.field(event)?;
        self.1.field(event)
    }
    fn first_light(&mut self, light: &FirstLight) {
        self.0.first_light(light);
        self.1.first_light(light);
    }
    fn decision(&mut self, decision: &Decision) -> Result<(), Failure> {
        self.0.decision(decision)?;
        self.1.decision(decision)
    }
    fn order(&mut self, t: TimeNs, request: &Request) -> Result<(), Failure> {
        self.0.order(t, request)?;
        self.1.order(t, request)
    }
    fn snapshot(&mut self, snapshot: &Snapshot) {
        self.0.snapshot(snapshot);
        self.1.snapshot(snapshot);
    }
    fn tick(&mut self) -> Result<(), Failure> {
        self.0.tick()?;
        self.1.tick()
    }
}
