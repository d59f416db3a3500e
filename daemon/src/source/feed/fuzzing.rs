//! The live feed's messages and pictures, for the fuzzers.

use holod_calibration::{DisplayGeometry, Resolution};
use holod_model::RgbdFrame;
use holod_model::scene::{Fit, LiveReader};

use super::message::{LONGEST, Layout, Message, Wrong, nope};

const TARGET: Resolution = Resolution { width: 24, height: 16 };
/// Larger pictures take longer and show nothing more.
const PIXELS_MAX: usize = 4096;

/// A client's first message and, behind it, the bytes of its picture, again and again; the first says how it is fitted.
///
/// # Panics
/// Where a message is taken that cannot be obeyed, refused without a word, or a frame holds a figure outside 0 to 1.
pub fn client(bytes: &[u8]) {
    let (first, rest) = bytes.split_at(bytes.len().min(LONGEST));
    let format = match Message::parse(first) {
        Ok(Message::Hello { format, name, .. }) => {
            assert!(!name.is_empty() && !name.contains(char::is_control), "{name:?}");
            assert!(Layout::of(&format).bytes() < 1 << 32, "{format:?}");
            format
        }
        Ok(Message::Frame { .. }) => return,
        Err(Wrong(why)) => {
            assert!(!why.is_empty() && nope(&why).len() <= 1024, "{why}");
            return;
        }
    };
    if format.resolution.pixels() > PIXELS_MAX || rest.is_empty() {
        return;
    }
    let part = |length: usize, offset: usize| -> Vec<u8> {
        rest.iter().copied().cycle().skip(offset % rest.len()).take(length).collect()
    };
    let layout = Layout::of(&format);
    let (colour, depth) = (part(layout.colour_bytes, 0), part(layout.depth_bytes, layout.depth_offset));
    let fit = [Fit::Native, Fit::Contain, Fit::Cover, Fit::Crop][usize::from(rest[0] % 4)];
    let Ok(mut reader) = LiveReader::new(format, &DisplayGeometry::DEFAULT, TARGET, fit) else { return };
    let mut frame = RgbdFrame::black(TARGET);
    let is_shown = reader.check(&depth).is_ok();
    match reader.make(&colour, &depth, &mut frame) {
        Ok(_) => {
            assert!(is_shown, "{format:?} was refused");
            let figures = frame.amplitude.iter().chain(&frame.depth_normalised);
            assert!(figures.into_iter().all(|figure| (0.0..=1.0).contains(figure)), "{fit:?} of {format:?}");
        }
        Err(error) => assert!(!is_shown && !error.to_string().is_empty()),
    }
}
