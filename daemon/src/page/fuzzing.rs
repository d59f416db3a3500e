//! The status page's door and queries, for the fuzzers.

use std::net::IpAddr;

use axum::extract::Query;
use axum::http::header::{AUTHORIZATION, COOKIE, HOST};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, Uri};

use super::door::{Admission, Door, Token};
use super::server::gaze_of;

/// What opens the door here.
pub const TOKEN: &str = "0123456789abcdef";

/// A request as four lines: query, and the headers Host, Cookie and Authorization.
///
/// # Panics
/// Where somebody comes in who has no token, or asks for another machine; or a gaze is taken that no eye has.
pub fn request(text: &str) {
    let mut lines = text.split('\n');
    let query = lines.next().unwrap_or_default();
    let mut headers = HeaderMap::new();
    for name in [HOST, COOKIE, AUTHORIZATION] {
        if let Some(value) = lines.next().and_then(|line| HeaderValue::from_str(line).ok()) {
            headers.insert(name, value);
        }
    }
    if !matches!(Door::Token(Token(TOKEN.into())).decide(Some(query), &headers), Admission::Refused(_)) {
        assert!(text.contains(TOKEN), "somebody came in without the token");
    }
    if !matches!(Door::OwnName.decide(None, &headers), Admission::Refused(_)) {
        let host = headers[HOST].to_str().unwrap_or_default();
        // Another reader of hosts than the door's own.
        if let Ok(authority) = host.parse::<Authority>() {
            let name = authority.host().trim_matches(['[', ']']);
            let is_own =
                name.eq_ignore_ascii_case("localhost") || name.parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
            assert!(is_own, "{host} is no name of this machine");
        }
    }
    let Ok(uri) = format!("/eye.png?{query}").parse::<Uri>() else { return };
    match gaze_of(Query::try_from_uri(&uri)) {
        Ok(gaze) => {
            assert!((-1.0..=20.0).contains(&gaze.focus.0), "{gaze:?}");
            assert!(gaze.pupil.is_none_or(|pupil| (0.5..=9.0).contains(&pupil.mm())), "{gaze:?}");
        }
        Err(why) => assert!(!why.is_empty()),
    }
}
