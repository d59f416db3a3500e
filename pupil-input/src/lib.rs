//! Pupil samples from trackers and logs: decode, gate, filter, estimate.
//!
//! ```text
//! bytes ─► wire ─► PupilSample ─► clock ─► gate ─► filter ─► Estimator ─► pupil_at(t)
//! ```
//!
//! [`Tracker::start`] runs all of it on a thread of its own; [`Estimator`] is the same without a thread or a clock, for
//! tests and for logs that are read as fast as they can be.

mod clock;
mod counters;
mod estimator;
mod filter;
mod gate;
mod sample;
pub mod source;
mod spec;
mod tracker;
pub mod wire;

pub use clock::ClockModel;
pub use counters::{Counter, CounterSnapshot};
pub use estimator::{Decision, EstimateSnapshot, Estimator, EstimatorSettings, PupilEstimate, PupilState};
pub use filter::FilterSettings;
pub use gate::{GateSettings, Rejection, Verdict};
pub use sample::{PupilSample, SampleEye};
pub use source::mock::{MockSample, MockSource, Scenario};
pub use source::replay::{LogFault, LogFormat, Recording, ReplayError};
pub use source::serial::SerialError;
pub use spec::{ReplaySpeed, SpecError, TrackerSpec};
pub use tracker::{
    DecisionTap, EstimateReader, Link, MOCK_SEED, Tracker, TrackerControl, TrackerError, TrackerHandle, host_now,
};
