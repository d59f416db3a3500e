//! The feed's messages, as bytes. The protocol's page is `daemon/doc/feed.md`.

use holod_calibration::{Dioptres, Resolution, TimeNs};
use holod_model::scene::{LiveColour, LiveDepth, LiveFormat};

use crate::source::PictureView;

/// The newest version of the protocol, and the first one in which a picture may say how it was taken.
pub(super) const VERSION: u32 = 2;
/// Slots of a client's shared memory: one that it writes, one that is read, one that waits.
pub(super) const SLOTS: usize = 3;
/// The longest message that a client sends; one more byte shows that one is longer.
pub(super) const LONGEST: usize = HELLO_BYTES;

const HELLO_BYTES: usize = 64;
const FRAME_BYTES: usize = 40;
const NAME: std::ops::Range<usize> = 32..HELLO_BYTES;
/// More than an 8K picture has.
const SIDE_MAX: u32 = 1 << 16;
const PIXELS_MAX: usize = 7680 * 4320;
/// Nobody sees nearer than this.
const NEAREST_DPT: f32 = 20.0;
/// Which of a picture's optional figures are given.
const HAS_FOCUS: u32 = 1;
const HAS_FIELD_OF_VIEW: u32 = 2;
/// Colour and depth begin at multiples of this.
const ALIGNMENT: usize = 64;

/// What a client says.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Message {
    /// `HELO`: what its pictures will be like.
    Hello {
        version: u32,
        /// How they are stored.
        format: LiveFormat,
        /// What it is called.
        name: String,
    },
    /// `FRAM`: a picture is in a slot.
    Frame {
        slot: u32,
        sequence: u64,
        /// When it was taken, where the client says so: any time, which may be none that there has been.
        t_taken: Option<TimeNs>,
        /// How it was taken.
        view: PictureView,
    },
}

/// What is wrong with a message: what was found and what is expected.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub(super) struct Wrong(pub(super) String);

impl Message {
    /// Reads one message.
    ///
    /// # Errors
    /// [`Wrong`] for everything that the protocol does not know.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, Wrong> {
        match bytes.get(..4) {
            Some(b"HELO") => hello(&of_length(bytes, "HELO")?),
            Some(b"FRAM") => frame(&of_length(bytes, "FRAM")?),
            _ => {
                let found: String = bytes.iter().take(8).map(|byte| format!("{byte:02x} ")).collect();
                Err(Wrong(format!("a message that begins with {found}was found, expected HELO or FRAM")))
            }
        }
    }
}

fn of_length<const N: usize>(bytes: &[u8], what: &str) -> Result<[u8; N], Wrong> {
    bytes.try_into().map_err(|_| Wrong(format!("{what} of {} bytes was found, expected {N} bytes", bytes.len())))
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_ne_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_ne_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

fn hello(bytes: &[u8; HELLO_BYTES]) -> Result<Message, Wrong> {
    let wrong = |what: &str, found: String, expected: &str| {
        Err(Wrong(format!("HELO: {what} {found} was found, expected {expected}")))
    };
    let version = u32_at(bytes, 4);
    if !(1..=VERSION).contains(&version) {
        return wrong("version", version.to_string(), "1 or 2");
    }
    let (width, height) = (u32_at(bytes, 8), u32_at(bytes, 12));
    let resolution = Resolution { width: width as usize, height: height as usize };
    let sides = 1..=SIDE_MAX;
    if !sides.contains(&width) || !sides.contains(&height) || resolution.pixels() > PIXELS_MAX {
        return wrong("a size of", resolution.to_string(), "1x1 to 7680x4320 pixels");
    }
    let colour = match u32_at(bytes, 16) {
        1 => LiveColour::Rgba8,
        2 => LiveColour::Rgba16F,
        3 => LiveColour::PlanarF32,
        other => return wrong("colour format", other.to_string(), "1, 2 or 3"),
    };
    let plane_dpt = f32::from_bits(u32_at(bytes, 24));
    let depth = match u32_at(bytes, 20) {
        0 if (0.0..=NEAREST_DPT).contains(&plane_dpt) => LiveDepth::Plane(Dioptres(plane_dpt.into())),
        0 => return wrong("plane_dpt", plane_dpt.to_string(), "0 to 20 dioptres (0 is infinity)"),
        _ if plane_dpt != 0.0 => return wrong("plane_dpt", plane_dpt.to_string(), "0, as the pictures have depth"),
        1 => LiveDepth::MillimetresU16,
        2 => LiveDepth::MetresF16,
        3 => LiveDepth::DioptresF16,
        4 => LiveDepth::MetresF32,
        5 => LiveDepth::DioptresF32,
        other => return wrong("depth format", other.to_string(), "0 to 5"),
    };
    if u32_at(bytes, 28) != 0 {
        return wrong("in the reserved bytes", u32_at(bytes, 28).to_string(), "0");
    }
    let name = bytes[NAME].split(|&byte| byte == 0).next().unwrap_or_default();
    // What a terminal or a log would take for an order has no place in a name.
    let name: String = String::from_utf8_lossy(name).chars().filter(|&c| !(c.is_control() || is_unseen(c))).collect();
    let name = if name.trim().is_empty() { "unnamed".to_owned() } else { name.trim().to_owned() };
    Ok(Message::Hello { version, format: LiveFormat { resolution, colour, depth }, name })
}

/// Whether a character is not seen itself, and may change how those around it are: their direction, their line.
const fn is_unseen(c: char) -> bool {
    matches!(
        c,
        '\u{ad}'
            | '\u{61c}'
            | '\u{180e}'
            | '\u{200b}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}'
            | '\u{feff}'
            | '\u{fff9}'..='\u{fffb}'
            | '\u{e0000}'..='\u{e007f}'
    )
}

fn frame(bytes: &[u8; FRAME_BYTES]) -> Result<Message, Wrong> {
    let t_taken = Some(TimeNs(u64_at(bytes, 16) as i64)).filter(|t| t.0 != 0);
    Ok(Message::Frame { slot: u32_at(bytes, 4), sequence: u64_at(bytes, 8), t_taken, view: view(bytes)? })
}

/// How a picture was taken, of which nothing need be said.
fn view(bytes: &[u8; FRAME_BYTES]) -> Result<PictureView, Wrong> {
    let wrong = |found: String, expected: &str| Err(Wrong(format!("FRAM: {found} was found, expected {expected}")));
    let given = u32_at(bytes, 24);
    if given & !(HAS_FOCUS | HAS_FIELD_OF_VIEW) != 0 {
        return wrong(format!("given figures {given:#x}"), "a sum of 1 (focus) and 2 (field of view), or 0");
    }
    let figures = [28, 32, 36].map(|at| f32::from_bits(u32_at(bytes, at)));
    let [focus_dpt, across_deg, up_deg] = figures;
    let (has_focus, has_field) = (given & HAS_FOCUS != 0, given & HAS_FIELD_OF_VIEW != 0);
    if !has_focus && focus_dpt.to_bits() != 0 || !has_field && (across_deg.to_bits() | up_deg.to_bits()) != 0 {
        return wrong(format!("figures {figures:?} of which {given} are given"), "0 for those that are not");
    }
    if has_focus && !(0.0..=NEAREST_DPT).contains(&focus_dpt) {
        return wrong(format!("a focus of {focus_dpt} dioptres"), "0 to 20 (0 is infinity)");
    }
    let is_angle = |deg: f32| deg > 0.0 && deg < 180.0;
    if has_field && !(is_angle(across_deg) && is_angle(up_deg)) {
        return wrong(format!("a field of view of {across_deg} x {up_deg} degrees"), "more than 0 and less than 180");
    }
    Ok(PictureView {
        focus_dpt: has_focus.then_some(focus_dpt),
        field_of_view_deg: has_field.then_some([across_deg, up_deg]),
    })
}

/// Where the parts of a picture lie in the shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    /// From one slot to the next.
    pub(super) slot_bytes: usize,
    /// Colours; they begin with their slot.
    pub(super) colour_bytes: usize,
    /// From a slot's beginning to its depths.
    pub(super) depth_offset: usize,
    pub(super) depth_bytes: usize,
}

impl Layout {
    /// The layout of pictures of `format`.
    pub(super) fn of(format: &LiveFormat) -> Self {
        let (colour_bytes, depth_bytes) = (format.colour_bytes(), format.depth_bytes());
        let depth_offset = colour_bytes.next_multiple_of(ALIGNMENT);
        Self {
            slot_bytes: (depth_offset + depth_bytes).next_multiple_of(ALIGNMENT),
            colour_bytes,
            depth_offset,
            depth_bytes,
        }
    }

    /// Bytes of all slots together.
    pub(super) const fn bytes(&self) -> usize {
        SLOTS * self.slot_bytes
    }

    /// The message `RING`: slots, and the places of colours and depths within one.
    pub(super) fn ring(&self) -> [u8; 48] {
        let mut bytes = [0; 48];
        bytes[..4].copy_from_slice(b"RING");
        bytes[4..8].copy_from_slice(&(SLOTS as u32).to_ne_bytes());
        let numbers = [self.slot_bytes, 0, self.colour_bytes, self.depth_offset, self.depth_bytes];
        for (cell, number) in bytes[8..].chunks_exact_mut(8).zip(numbers) {
            cell.copy_from_slice(&(number as u64).to_ne_bytes());
        }
        bytes
    }
}

/// What became of a picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// It was read whole and takes the place of the one before.
    Taken,
    /// A newer one came before it was read.
    Overtaken,
    /// It cannot be shown, and why.
    Refused(String),
    /// Another client's pictures are shown.
    NotShown,
}

/// The message `FREE`: what became of the picture in a slot, with the reason where it was refused.
pub(super) fn free(slot: u32, sequence: u64, outcome: &Outcome) -> Vec<u8> {
    let (code, text) = match outcome {
        Outcome::Taken => (0_u32, ""),
        Outcome::Overtaken => (1, ""),
        Outcome::Refused(why) => (2, why.as_str()),
        Outcome::NotShown => (3, ""),
    };
    let numbers = [slot.to_ne_bytes().as_slice(), &sequence.to_ne_bytes(), &code.to_ne_bytes(), &[0; 4]].concat();
    [b"FREE", numbers.as_slice(), text.as_bytes()].concat()
}

/// The message `NOPE`: why the client is not served.
pub(super) fn nope(why: &str) -> Vec<u8> {
    [b"NOPE", why.as_bytes()].concat()
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use super::*;

    const FORMAT: LiveFormat = LiveFormat {
        resolution: Resolution { width: 5, height: 3 },
        colour: LiveColour::Rgba8,
        depth: LiveDepth::MillimetresU16,
    };

    /// `HELO` with numbers in place of those of a good one.
    pub(in super::super) fn hello_with(changes: &[(usize, u32)]) -> [u8; HELLO_BYTES] {
        let mut bytes = [0; HELLO_BYTES];
        bytes[..4].copy_from_slice(b"HELO");
        bytes[NAME][..4].copy_from_slice(b"test");
        for &(at, number) in [(4, 1), (8, 5), (12, 3), (16, 1), (20, 1)].iter().chain(changes) {
            bytes[at..at + 4].copy_from_slice(&number.to_ne_bytes());
        }
        bytes
    }

    pub(in super::super) fn frame_of(slot: u32, sequence: u64, t_taken: i64) -> [u8; FRAME_BYTES] {
        let mut bytes = [0; FRAME_BYTES];
        bytes[..4].copy_from_slice(b"FRAM");
        bytes[4..8].copy_from_slice(&slot.to_ne_bytes());
        bytes[8..16].copy_from_slice(&sequence.to_ne_bytes());
        bytes[16..24].copy_from_slice(&t_taken.to_ne_bytes());
        bytes
    }

    fn frame_with(given: u32, figures: [f32; 3]) -> [u8; FRAME_BYTES] {
        let mut bytes = frame_of(0, 1, 0);
        for (cell, bits) in bytes[24..].chunks_exact_mut(4).zip([given].into_iter().chain(figures.map(f32::to_bits))) {
            cell.copy_from_slice(&bits.to_ne_bytes());
        }
        bytes
    }

    #[test]
    fn what_the_page_describes_is_read() {
        let hello = Message::parse(&hello_with(&[])).unwrap();
        assert_eq!(hello, Message::Hello { version: 1, format: FORMAT, name: "test".into() });
        let plane = Message::parse(&hello_with(&[(20, 0), (24, 1.5_f32.to_bits())])).unwrap();
        let Message::Hello { format, .. } = plane else { panic!() };
        assert_eq!(format.depth, LiveDepth::Plane(Dioptres(1.5)));
        let frame = |slot, sequence, t_taken| Message::Frame { slot, sequence, t_taken, view: PictureView::default() };
        assert_eq!(Message::parse(&frame_of(2, 1 << 40, 77)).unwrap(), frame(2, 1 << 40, Some(TimeNs(77))));
        assert_eq!(Message::parse(&frame_of(0, 0, 0)).unwrap(), frame(0, 0, None));
        assert_eq!(Message::parse(&frame_of(0, 0, -1)).unwrap(), frame(0, 0, Some(TimeNs(-1))));
        for (given, figures, focus_dpt, field_of_view_deg) in [
            (1, [1.25, 0.0, 0.0], Some(1.25), None),
            (2, [0.0, 60.0, 45.0], None, Some([60.0, 45.0])),
            (3, [0.0, 179.9, 0.1], Some(0.0), Some([179.9, 0.1])),
        ] {
            let Message::Frame { view, .. } = Message::parse(&frame_with(given, figures)).unwrap() else { panic!() };
            assert_eq!(view, PictureView { focus_dpt, field_of_view_deg });
        }
        let newer = Message::parse(&hello_with(&[(4, 2)])).unwrap();
        assert_eq!(newer, Message::Hello { version: 2, format: FORMAT, name: "test".into() });
    }

    #[test]
    fn what_the_page_does_not_describe_is_refused_in_words() {
        for (changes, said) in [
            (&[(4, 3)][..], "HELO: version 3 was found, expected 1 or 2"),
            (&[(4, 0)], "HELO: version 0 was found"),
            (&[(8, 0)], "HELO: a size of 0x3 was found"),
            (&[(8, 7680), (12, 4321)], "a size of 7680x4321"),
            (&[(8, u32::MAX), (12, u32::MAX)], "expected 1x1 to 7680x4320 pixels"),
            (&[(16, 4)], "colour format 4"),
            (&[(20, 6)], "depth format 6"),
            (&[(24, 1.0_f32.to_bits())], "plane_dpt 1 was found, expected 0, as the pictures have depth"),
            (&[(20, 0), (24, f32::NAN.to_bits())], "plane_dpt NaN"),
            (&[(20, 0), (24, 350.0_f32.to_bits())], "expected 0 to 20 dioptres"),
            (&[(28, 1)], "reserved"),
        ] {
            let wrong = Message::parse(&hello_with(changes)).unwrap_err();
            assert!(wrong.0.contains(said), "{wrong}");
        }
        assert!(Message::parse(&hello_with(&[])[..63]).unwrap_err().0.contains("63 bytes was found, expected 64"));
        assert!(Message::parse(b"GET / HTTP").unwrap_err().0.contains("47 45 54 20 2f 20 48 54 was found"));
        assert!(Message::parse(b"").is_err());
        for (given, figures, said) in [
            (4, [0.0; 3], "given figures 0x4 was found, expected a sum of 1 (focus) and 2"),
            (0, [0.0, 0.0, 1.0], "expected 0 for those that are not"),
            (2, [1.0, 60.0, 45.0], "expected 0 for those that are not"),
            (1, [20.1, 0.0, 0.0], "a focus of 20.1 dioptres was found, expected 0 to 20"),
            (1, [f32::NAN, 0.0, 0.0], "a focus of NaN"),
            (2, [0.0, 60.0, 0.0], "a field of view of 60 x 0 degrees was found, expected more than 0"),
            (2, [0.0, 180.0, 45.0], "less than 180"),
            (3, [1.0, f32::NAN, 45.0], "NaN x 45"),
        ] {
            let wrong = Message::parse(&frame_with(given, figures)).unwrap_err();
            assert!(wrong.0.contains(said), "{wrong}");
        }
    }

    proptest! {
        /// Whatever bytes come, they are a message that holod can obey, or are refused in words that fit into an
        /// answer.
        #[test]
        fn no_bytes_are_too_odd(
            kind in 0..3, noise in prop::collection::vec(any::<u8>(), 0..80), at in 0_usize..64, byte: u8,
        ) {
            let mut bytes = match kind {
                0 => noise,
                1 => hello_with(&[]).to_vec(),
                _ => frame_of(1, 2, 3).to_vec(),
            };
            if let Some(cell) = bytes.get_mut(at) {
                *cell = byte;
            }
            match Message::parse(&bytes) {
                Ok(Message::Hello { format, name, .. }) => {
                    prop_assert!(format.resolution.pixels() > 0 && Layout::of(&format).bytes() < 1 << 32);
                    prop_assert!(!name.is_empty() && !name.contains(char::is_control));
                }
                Ok(Message::Frame { .. }) => prop_assert_eq!(&bytes[..4], b"FRAM"),
                Err(Wrong(why)) => prop_assert!(!why.is_empty() && nope(&why).len() <= 1024, "{}", why),
            }
        }
    }

    #[test]
    fn names_are_fit_for_a_log() {
        let name_of = |name: &[u8]| {
            let mut bytes = hello_with(&[]);
            bytes[NAME].fill(0);
            bytes[NAME][..name.len()].copy_from_slice(name);
            let Ok(Message::Hello { name, .. }) = Message::parse(&bytes) else { panic!() };
            name
        };
        assert_eq!(name_of("Kamera für Tiefe".as_bytes()), "Kamera für Tiefe");
        assert_eq!(name_of(b"\x1b[2J\n"), "[2J");
        assert_eq!(name_of("a\u{202e}b\u{2028}c\u{2066}d".as_bytes()), "abcd");
        assert_eq!(name_of(b""), "unnamed");
        assert_eq!(name_of(&[b'x'; 32]).len(), 32);
        assert_eq!(name_of(b"\xff"), "\u{fffd}");
    }

    #[test]
    fn what_is_sent_stands_where_the_page_says() {
        let layout = Layout::of(&FORMAT);
        let expected = Layout { slot_bytes: 128, colour_bytes: 60, depth_offset: 64, depth_bytes: 30 };
        assert_eq!((layout, layout.bytes()), (expected, 384));
        let ring = layout.ring();
        assert_eq!((&ring[..4], u32_at(&ring, 4)), (&b"RING"[..], 3));
        assert_eq!([8, 16, 24, 32, 40].map(|at| u64_at(&ring, at)), [128, 0, 60, 64, 30]);
        let refused = free(1, 9, &Outcome::Refused("why".into()));
        assert_eq!((&refused[..4], u32_at(&refused, 4), u64_at(&refused, 8)), (&b"FREE"[..], 1, 9));
        assert_eq!((u32_at(&refused, 16), u32_at(&refused, 20), &refused[24..]), (2, 0, &b"why"[..]));
        let codes = [Outcome::Taken, Outcome::Overtaken, Outcome::NotShown].map(|one| u32_at(&free(0, 0, &one), 16));
        assert_eq!(codes, [0, 1, 3]);
        assert_eq!(nope("no"), b"NOPEno");
    }
}
