//! The control socket's requests, for the fuzzers.

use std::sync::LazyLock;

use super::{NewPattern, Order, Preparer, Request};

static PREPARER: LazyLock<Preparer> = LazyLock::new(Preparer::of_a_small_rig);

/// A line of JSON. It is understood and obeyed as far as no file is named, or refused in words.
///
/// # Panics
/// Where a request that is written down and read is written down as another one, or a pupil is taken that no eye has.
pub fn request(line: &[u8]) {
    let request: Request = match Request::from_line(line) {
        Ok(request) => request,
        Err(why) => {
            assert!(!why.is_empty());
            return;
        }
    };
    // The text of a figure may be a neighbour's, that of an infinite one is `null`: texts are compared after one more
    // round.
    let again = |request: &Request| {
        let written = serde_json::to_vec(request).expect("a request can be written");
        let read: Request = Request::from_line(&written).expect("what was written can be read");
        (written, read)
    };
    let (_, read) = again(&request);
    let (written, read) = again(&read);
    assert_eq!(again(&read).0, written, "{request:?}");
    if matches!(request, Request::Scene { .. } | Request::Weights { .. }) {
        return;
    }
    match PREPARER.prepare(&request) {
        Ok(Order::Pupil(Some(pupil))) => assert!((0.5..=9.0).contains(&pupil.mm()), "{pupil:?}"),
        Ok(Order::Pattern(Some(NewPattern { levels, .. }))) => {
            assert_eq!(levels.layout(), PREPARER.encoder.layout(), "a pattern of another panel");
        }
        Ok(_) => {}
        Err(why) => assert!(!why.is_empty()),
    }
}
