//! Pupil samples from trackers and logs: decode, gate, filter, estimate.
//!
//! ```text
//! bytes ─► wire ─► PupilSample ─► clock ─► gate ─► filter ─► Estimator ─► pupil_at(t)
//! ```
//!
//! [`Tracker::start`] runs all of it on a thread of its own; [`Estimator`] is the same without a thread or a clock, for
//! tests and for logs that are read as fast as they can be.
//!
//! # What the estimate costs and gives
//!
//! A sample is believed 30 ms after it was taken, when its successors have shown that no blink was beginning
//! ([`GateSettings::lead`]). The filter bridges that time by extrapolation, so the estimate of the present moment lags
//! much less than the gate. With the default settings, as `tests/eye.rs` measures and bounds them:
//!
//! | | |
//! |---|---|
//! | lag at the onset of a ramp of 1.3 to 5.5 mm/s ([`STATED_LAG`] bounds it), sensor noise 0.06 mm at 200 Hz | 42 ms |
//! | lag on the same ramp, from 200 ms after its onset | 18 ms |
//! | noise of the estimate over noise of one sample, at 60 / 200 / 1000 Hz | 0.61 / 0.44 / 0.29 |
//! | rms error on the mock's `steady` / `light-steps` / `sweep` / `blinks`, sensor noise 0.05 mm | 0.02 / 0.05 / 0.04 / 0.03 mm |
//! | worst error while tracking, on the same (`light-steps` has a constriction that begins behind a blink) | 0.09 / 0.53 / 0.27 / 0.12 mm |
//! | after a blink, until samples are believed again | 50 ms trailing guard and 30 ms lead |
//! | a step no pupil can make (a lid, or a change missed) of 1.5 mm is believed after | about 0.6 s |
//!
//! Flicker in pixels of blur, the error of predictions and through blinks, and how other filters do:
//! `doc/estimate.md`. Scenarios of the simulated eye: [`Script`].
//!
//! A pupil is held for as long as the rig says ([`rig::Tracker::hold`](holod_calibration::rig::Tracker::hold)), then
//! slides to the fallback at 1.3 mm/s; when samples come back, what is shown meets them at 4 mm/s. Neither is
//! faster than the peak of the light reflex, 5.5 mm/s.

mod cells;
mod clock;
mod clock_watch;
mod counters;
mod estimator;
pub mod export;
mod filter;
#[cfg(fuzzing)]
pub mod fuzzing;
mod gate;
mod import;
mod named;
mod profile;
mod record;
mod refusals;
mod sample;
mod sequence;
mod simulate;
mod size_unit;
pub mod source;
mod spec;
mod stamp;
mod tracker;
mod usb_ids;
pub mod wire;

pub use clock::{ClockModel, ClockReport};
pub use clock_watch::ClockWatch;
pub use counters::{Counter, CounterSnapshot};
pub use estimator::{
    BetterSettings, Decision, EstimateSnapshot, Estimator, EstimatorSettings, PupilEstimate, PupilState, STATED_LAG,
};
pub use filter::FilterSettings;
pub use gate::{GateSettings, Rejection, Verdict};
pub use import::{
    Blink, BlinkCounts, EyeInfo, FaultCount, LogFault, LogFaults, LogFormat, LogInfo, Range, Recording, ReplayError,
};
pub use profile::{Command, DEFAULT_PROFILE, HidSettings, NetworkSettings, Profile, ProfileError, SerialSettings};
pub use record::{RecordError, RecordFiles, RecordStatus, payloads, with_header};
pub use refusals::{Refusal, RefusalChange, RefusalWatch};
pub use sample::{PupilSample, SampleEye};
pub use simulate::{MOCK_SEED, MockSample, MockSource, Scenario, Script, ScriptError};
pub use size_unit::{Figures, SizeUnit};

pub use holod_calibration::host_now;
pub use source::SourceError;
pub use source::commands::CommandError;
pub use source::hid::{HidDeviceInfo, HidError, RULE_FILE, hid_devices, udev_rule};
pub use source::serial::identity::{SerialPortInfo, UsbPort, serial_ports};
pub use source::serial::{SerialError, adapter_delay_warning, serial_port_warnings};
pub use source::server::ServerError;
pub use source::tcp::NetworkError;
pub use spec::{HostPort, ReplaySpeed, SpecError, TrackerSpec};
pub use tracker::{
    ChangeError, DecisionTap, EstimateReader, Link, Tracker, TrackerControl, TrackerError, TrackerHandle,
    TrackerOptions, scaled_millimetres,
};
pub use usb_ids::UsbIds;
