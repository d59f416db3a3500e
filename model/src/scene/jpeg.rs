//! Whether a JPEG picture is whole: the decoder fills what was cut off with grey.

const START_OF_IMAGE: u8 = 0xd8;
const END_OF_IMAGE: u8 = 0xd9;

/// Whether the picture with which `bytes` begin has its end. What follows that, such as a phone's film or a second
/// picture, is not looked at.
pub(super) fn is_whole(bytes: &[u8]) -> bool {
    let Some(mut left) = bytes.strip_prefix(&[0xff, START_OF_IMAGE]) else { return false };
    while let Some((marker, rest)) = next_marker(left) {
        match marker {
            END_OF_IMAGE => return true,
            // Another picture begins before the end of this one.
            START_OF_IMAGE => return false,
            _ => {}
        }
        let length = rest.first_chunk().map(|length| usize::from(u16::from_be_bytes(*length)));
        let Some(after) = length.and_then(|length| rest.get(length..)) else { return false };
        left = after;
    }
    false
}

/// The next marker that has a segment or ends the picture, and what follows it. Coded data of a scan have none: there
/// every 0xff has a 0 behind it, but for restart markers.
fn next_marker(mut bytes: &[u8]) -> Option<(u8, &[u8])> {
    loop {
        let position = bytes.iter().position(|&byte| byte == 0xff)?;
        bytes = &bytes[position + 1..];
        let (&marker, rest) = bytes.split_first()?;
        match marker {
            // Any number of them may stand before a marker.
            0xff => {}
            0x00 | 0x01 | 0xd0..=0xd7 => bytes = rest,
            _ => return Some((marker, rest)),
        }
    }
}

#[cfg(test)]
mod tests {
    use image::codecs::jpeg::JpegEncoder;
    use image::{ImageBuffer, Rgb};
    use proptest::prelude::*;

    use super::*;

    /// 24x16, in ten scans with restart markers: `cjpeg -quality 60 -progressive -restart 1`.
    const PROGRESSIVE: &[u8] = include_bytes!("progressive.jpg");

    fn encoded(width: u32, height: u32, quality: u8, seed: u32) -> Vec<u8> {
        let value = |x: u32, y: u32| (x * 31 + y * 17).wrapping_add(seed).wrapping_mul(2_654_435_761).to_be_bytes();
        let picture = ImageBuffer::from_fn(width, height, |x, y| Rgb([value(x, y)[0], value(x, y)[1], value(x, y)[2]]));
        let mut bytes = Vec::new();
        picture.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, quality)).unwrap();
        bytes
    }

    /// `bytes` with `content` in an application segment before all others.
    fn with_segment(bytes: &[u8], content: &[u8]) -> Vec<u8> {
        let length = (content.len() as u16 + 2).to_be_bytes();
        [&bytes[..2], &[0xff, 0xe1], &length, content, &bytes[2..]].concat()
    }

    #[test]
    fn a_picture_is_whole_whatever_is_behind_or_inside_it() {
        let (main, thumbnail) = (encoded(40, 30, 80, 1), encoded(8, 6, 50, 2));
        for whole in [&main[..], &thumbnail, PROGRESSIVE, &with_segment(&main, &thumbnail)] {
            assert!(is_whole(whole));
            for behind in [&[0xff, 0xda, 0, 8][..], b"\0\0\0\x18ftypmp42\xff\xda\xff\xd9\xff\xda", &thumbnail, &[0xff]]
            {
                assert!(is_whole(&[whole, behind].concat()));
            }
            assert!((0..whole.len()).all(|length| !is_whole(&whole[..length])));
        }
        let filled = main.windows(2).position(|pair| pair == [0xff, 0xdb]).unwrap();
        assert!(is_whole(&[&main[..filled], &[0xff; 3], &main[filled..]].concat()), "0xff may stand before a marker");
    }

    #[test]
    fn a_picture_that_was_cut_is_not_made_whole_by_another_behind_it() {
        let (main, thumbnail) = (encoded(40, 30, 80, 1), encoded(8, 6, 50, 2));
        let scan = main.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap() + 14;
        for length in scan..main.len() - 1 {
            assert!(!is_whole(&[&main[..length], &thumbnail[..]].concat()), "{length}");
        }
        assert!(!is_whole(&[]) && !is_whole(b"\xff\xd8") && !is_whole(b"no JPEG\xff\xd9"));
    }

    proptest! {
        #[test]
        fn no_part_of_a_picture_is_a_whole_one(
            width in 1_u32..48, height in 1_u32..48, quality in 1_u8..=100, seed: u32, cut in 0.0..1.0,
        ) {
            let whole = encoded(width, height, quality, seed);
            prop_assert!(is_whole(&whole));
            prop_assert!(!is_whole(&whole[..(whole.len() as f64 * cut) as usize]));
            prop_assert!(!is_whole(&whole[..whole.len() - 1]));
        }

        #[test]
        fn any_bytes_get_an_answer(bytes: Vec<u8>) {
            is_whole(&[&[0xff, START_OF_IMAGE], &bytes[..]].concat());
        }
    }
}
