//! Bytes of trackers to samples: pure, incremental, one file for each format.
//!
//! A decoder is pushed bytes as they come and tells what they hold. However the bytes of a stream are split, the events
//! are the same; formats that come in messages (a HID report, a datagram) are pushed one message at a time instead.

mod buffer;
mod checksum;
pub mod delimited;
pub mod field;
pub mod hid_descriptor;
pub mod iscan;
pub mod line;
pub mod livetrack;
pub(crate) mod neon;
pub mod open_gaze;
pub mod packet;
pub(crate) mod pupil_labs_core;
pub mod pupilext;
pub mod report;
#[cfg(test)]
pub(crate) mod testing;
mod text;
pub mod usages;

use holod_calibration::TimeNs;

use crate::SampleEye;

pub use checksum::{ChecksumKind, Crc};
use delimited::{DelimitedDecoder, DelimitedSettings};
use iscan::{IscanDecoder, IscanSettings};
use livetrack::{LiveTrackDecoder, LiveTrackSettings};
use open_gaze::{OpenGazeDecoder, OpenGazeSettings};
use packet::{PacketDecoder, PacketSettings};
use pupilext::{PupilExtDecoder, PupilExtSettings};
use report::{ReportDecoder, ReportSettings};
use usages::{Undescribed, UsageSettings};

/// A sample as the wire gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WireSample {
    /// The tracker's own clock; its origin means nothing. None where the wire carries no time: the time of arrival
    /// stands in for it.
    pub t_device: Option<TimeNs>,
    /// Which eye it was taken of.
    pub eye: SampleEye,
    /// Diameter in millimetres, by the profile's conversion; in the tracker's own unit where only the rig's scale knows
    /// the conversion. Means nothing unless `valid`.
    pub diameter_mm: f32,
    /// The tracker's confidence, 0..=1; 1 where it gives none.
    pub confidence: f32,
    /// Distance between the lids in millimetres, from trackers that measure it.
    pub aperture_mm: Option<f32>,
    /// The tracker's running number, where it has one.
    pub sequence: Option<u64>,
    /// False where the tracker itself says that it sees no pupil.
    pub valid: bool,
}

crate::named::named! {
    /// Why bytes were rejected.
    pub enum WireFault {
        /// Longer than any message of the format.
        TooLong = "wire_too_long",
        /// Shorter than a message of the format.
        TooShort = "wire_too_short",
        /// Not of the format's form.
        Malformed = "wire_malformed",
        /// A version of the format that is not known.
        UnknownVersion = "wire_unknown_version",
        /// The checksum is missing or does not match.
        BadChecksum = "wire_bad_checksum",
        /// A field is not a number.
        BadNumber = "wire_bad_number",
        /// The eye is none that the format knows.
        BadEye = "wire_bad_eye",
        /// A figure is NaN or infinite.
        NotFinite = "wire_not_finite",
        /// The size is negative, and that is not the format's word for a lost pupil.
        Negative = "wire_negative",
        /// The confidence lies outside its range.
        BadConfidence = "wire_bad_confidence",
        /// A field that a sample needs is not there.
        MissingField = "wire_missing_field",
        /// Bytes between two messages that belong to neither.
        OutOfStep = "wire_out_of_step",
        /// It has more views, of another eye or camera, than the profile.
        MoreViews = "wire_more_views",
        /// The pupil is seen, and has no size in millimetres: the tracker was not calibrated.
        Uncalibrated = "wire_uncalibrated",
        /// A figure behind the last column that has a name.
        MoreFields = "wire_more_fields",
    }
}

impl WireFault {
    /// Whether a pupil's figure is no size, as some trackers send through a blink: a lost sample is told beside it, but
    /// of the first two by PupilEXT and LiveTrack, so that its neighbours are not believed.
    pub(crate) const fn is_of_a_figure(self) -> bool {
        matches!(self, Self::NotFinite | Self::Negative | Self::Uncalibrated)
    }
}

/// What some bytes turned out to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WireEvent {
    /// A sample. A message about two eyes is two of these.
    Sample(WireSample),
    /// A message that is no sample and no fault: a comment, a header, an acknowledgement.
    Note,
    /// A message that is no sample, with the reason; where only the pupil's figure is none, a lost sample comes behind
    /// it, but of PupilEXT and LiveTrack.
    Rejected(WireFault),
    /// What was left of a message when reading began in its middle; not a fault.
    Partial,
    /// The tracker's own clock, told by itself: it showed this, or a little more, when the bytes came.
    Clock(TimeNs),
}

/// Bytes in, events out. After it is made it allocates nothing.
pub trait Decoder: Send {
    /// Takes bytes and calls `on_event` for each message that they complete.
    fn push(&mut self, bytes: &[u8], on_event: &mut dyn FnMut(WireEvent));

    /// Ends the stream: a last line without its ending is read, anything else that is incomplete is dropped.
    fn finish(&mut self, on_event: &mut dyn FnMut(WireEvent));

    /// Begins again on a link that was opened anew, with what the tracker says once of what it sends, as it may have
    /// gone on meanwhile; false where there is no such thing, and a new decoder does as well.
    fn rejoin(&mut self) -> bool {
        false
    }
}

/// How a tracker's bytes are read: every decoder, with its settings.
#[derive(Clone, Debug, PartialEq)]
pub enum Format {
    /// holod's own protocol for microcontrollers, a line a sample.
    Lines,
    /// Lines of text with a fixed set of columns.
    Delimited(DelimitedSettings),
    /// Binary packets with a sync word, as a stream.
    Packet(PacketSettings),
    /// Binary messages that come whole: HID reports, datagrams.
    Report(ReportSettings),
    /// Binary packets of ISCAN's ETL series.
    Iscan(IscanSettings),
    /// Rows of text of Cambridge Research Systems' LiveTrack.
    LiveTrack(LiveTrackSettings),
    /// Gazepoint's Open Gaze records.
    OpenGaze(OpenGazeSettings),
    /// PupilEXT's rows or objects.
    PupilExt(PupilExtSettings),
    /// HID reports, by the device's descriptor.
    Usages(UsageSettings),
    /// Pupil Labs Core's MessagePack maps.
    CoreMsgpack,
    /// Pupil Labs Neon's gaze stream, RTP and RTCP as RTSP interleaves them.
    NeonRtp,
}

impl Format {
    /// The kind's name in a profile.
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::Lines => "holod",
            Self::Delimited(_) => "delimited",
            Self::Packet(_) => "packet",
            Self::Report(_) => "report",
            Self::Usages(_) => "usages",
            Self::Iscan(_) => "iscan",
            Self::LiveTrack(_) => "livetrack",
            Self::OpenGaze(_) => "open-gaze",
            Self::PupilExt(_) => "pupilext",
            Self::CoreMsgpack => "core",
            Self::NeonRtp => "neon",
        }
    }

    /// A decoder for a stream that may be joined in the middle of a message.
    pub fn decoder(&self) -> Box<dyn Decoder> {
        match self {
            Self::Lines => Box::new(line::LineDecoder::joining()),
            Self::Delimited(settings) => Box::new(DelimitedDecoder::joining(settings)),
            Self::Packet(settings) => Box::new(PacketDecoder::joining(settings)),
            Self::Report(settings) => Box::new(ReportDecoder::new(settings)),
            Self::Iscan(settings) => Box::new(IscanDecoder::new(settings.clone())),
            Self::LiveTrack(settings) => Box::new(LiveTrackDecoder::new(*settings)),
            Self::OpenGaze(settings) => Box::new(OpenGazeDecoder::new(*settings)),
            Self::PupilExt(settings) => Box::new(PupilExtDecoder::new(*settings)),
            Self::Usages(_) => Box::new(Undescribed),
            Self::CoreMsgpack => Box::new(pupil_labs_core::CoreDecoder),
            Self::NeonRtp => Box::new(neon::NeonDecoder::new()),
        }
    }
}
