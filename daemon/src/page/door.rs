//! Who may come in: whoever has the token, or, where there is none, whoever really asked for this machine.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, COOKIE, HOST, LOCATION, SET_COOKIE, WWW_AUTHENTICATE};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use subtle::ConstantTimeEq;

use super::live::{Live, Refused};

const SHORTEST: usize = 16;

/// The secret that opens the page to other machines.
pub(super) struct Token(pub(super) String);

/// Why a file gives no token.
#[derive(Debug, thiserror::Error)]
pub(super) enum TokenError {
    #[error("--page-token {}: {error}", .file.display())]
    Read { file: PathBuf, error: std::io::Error },
    #[error(
        "--page-token {}: others may read it (mode {mode:04o}), expected a file of yours alone: chmod 600 {}",
        .file.display(), .file.display()
    )]
    Open { file: PathBuf, mode: u32 },
    #[error(
        "--page-token {}: {found}, expected one line of at least {SHORTEST} letters, digits, - or _, such as \
         `openssl rand -hex 16` makes",
        .file.display()
    )]
    Content { file: PathBuf, found: String },
}

impl Token {
    /// The one line of `file`.
    pub(super) fn read(file: &Path) -> Result<Self, TokenError> {
        let cannot = |error| TokenError::Read { file: file.to_owned(), error };
        let mode = fs::metadata(file).map_err(cannot)?.mode() & 0o7777;
        if mode & 0o077 != 0 {
            return Err(TokenError::Open { file: file.to_owned(), mode });
        }
        let text = fs::read_to_string(file).map_err(cannot)?;
        let token = text.trim();
        let wrong = |found: String| Err(TokenError::Content { file: file.to_owned(), found });
        if let Some(wrong_one) = token.chars().find(|c| !(c.is_ascii_alphanumeric() || "-_".contains(*c))) {
            return wrong(format!("found {wrong_one:?} in it"));
        }
        if token.len() < SHORTEST {
            return wrong(format!("found {} characters", token.len()));
        }
        Ok(Self(token.to_owned()))
    }

    fn is(&self, offered: &str) -> bool {
        self.0.as_bytes().ct_eq(offered.as_bytes()).into()
    }
}

/// What is asked of everybody who comes.
pub(super) enum Door {
    /// That it shows the token, in a header, a cookie or the address.
    Token(Token),
    /// That the browser asked for this machine by one of its own names: a page from elsewhere whose name was made to
    /// lead here has another.
    OwnName,
    /// Nothing: the file system has asked.
    Open,
}

/// Whether somebody has passed the door on a connection.
#[derive(Clone, Default)]
pub(super) struct Passed(Arc<AtomicBool>);

impl Passed {
    pub(super) fn has(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// A door, and who counts those that it stops.
pub(super) struct Doorkeeper {
    pub(super) door: Door,
    pub(super) live: Arc<Live>,
}

/// What a door says to whoever comes.
pub(super) enum Admission {
    /// The request is answered.
    In,
    /// Come in by the cookie that this answer sets.
    ByCookie(Response),
    /// This answer takes the place of what was asked for.
    Refused(Response),
}

impl Door {
    /// Why it stops whom it stops.
    fn reason(&self) -> Refused {
        match self {
            Self::Token(_) => Refused::Token,
            Self::OwnName | Self::Open => Refused::Name,
        }
    }

    /// Decides by a request's query and headers.
    pub(super) fn decide(&self, query: Option<&str>, headers: &HeaderMap) -> Admission {
        match self {
            Self::Open => Admission::In,
            Self::OwnName => {
                let host = text(headers, HOST.as_str());
                if is_own_name(host) {
                    return Admission::In;
                }
                let said = format!(
                    "found the name `{host}`, expected localhost: holod's page is for this machine alone. From another \
                     machine use `ssh -L 8420:localhost:8420`, or give holod an address and --page-token\n"
                );
                Admission::Refused((StatusCode::MISDIRECTED_REQUEST, said).into_response())
            }
            Self::Token(token) => {
                if let Some(offered) = in_query(query).filter(|offered| token.is(offered)) {
                    return Admission::ByCookie(let_in(offered, headers));
                }
                if bearer(headers).into_iter().chain(in_cookies(headers)).any(|offered| token.is(offered)) {
                    return Admission::In;
                }
                let said = "a token is needed, the content of the file that holod was given with --page-token: open \
                            /?token=TOKEN once in a browser, or send the header `Authorization: Bearer TOKEN`\n";
                let refused = (StatusCode::UNAUTHORIZED, [(WWW_AUTHENTICATE, "Bearer")], said);
                Admission::Refused(refused.into_response())
            }
        }
    }
}

pub(super) async fn admit(
    State(keeper): State<Arc<Doorkeeper>>,
    Extension(passed): Extension<Passed>,
    request: Request,
    next: Next,
) -> Response {
    if is_of_another_site(request.headers()) {
        keeper.live.refused.count(Refused::Site);
        let said = "found a request that another site's page makes: open holod's page itself\n";
        return (StatusCode::FORBIDDEN, said).into_response();
    }
    match keeper.door.decide(request.uri().query(), request.headers()) {
        Admission::In => {
            passed.0.store(true, Ordering::Relaxed);
            next.run(request).await
        }
        Admission::ByCookie(answer) => answer,
        Admission::Refused(answer) => {
            keeper.live.refused.count(keeper.door.reason());
            answer
        }
    }
}

/// Whether a browser asks for something that another site's page loads, and not for a page to show: each eye's picture
/// is work.
fn is_of_another_site(headers: &HeaderMap) -> bool {
    text(headers, "sec-fetch-site") == "cross-site" && text(headers, "sec-fetch-dest") != "document"
}

/// Takes the token out of the address bar into a cookie. It comes with a link on another page, too, which the page can
/// afford as it only tells; what another page loads by itself comes without.
fn let_in(token: &str, headers: &HeaderMap) -> Response {
    let cookie = format!("{}={token}; HttpOnly; SameSite=Lax; Path=/", cookie_name(headers));
    let cookie = HeaderValue::from_str(&cookie).expect("a token has letters, digits, - and _");
    (StatusCode::SEE_OTHER, [(LOCATION, HeaderValue::from_static("/")), (SET_COOKIE, cookie)]).into_response()
}

fn in_query(query: Option<&str>) -> Option<&str> {
    query?.split('&').find_map(|pair| pair.strip_prefix("token="))
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (scheme, offered) = text(headers, AUTHORIZATION.as_str()).split_once(' ')?;
    scheme.eq_ignore_ascii_case("Bearer").then(|| offered.trim())
}

fn in_cookies(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let own_name = cookie_name(headers);
    let cookies = text(headers, COOKIE.as_str()).split(';').map(str::trim);
    let named = cookies.filter_map(|cookie| cookie.split_once('='));
    named.filter(move |(name, _)| *name == own_name).map(|(_, value)| value)
}

/// The cookie has the name of the port that the browser asked: it keeps those of all ports of a machine together.
fn cookie_name(headers: &HeaderMap) -> String {
    let port = text(headers, HOST.as_str()).rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
    port.map_or("holod_token".to_owned(), |port| format!("holod_token_{port}"))
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> &'a str {
    headers.get(name).and_then(|value| value.to_str().ok()).unwrap_or_default()
}

fn is_own_name(host: &str) -> bool {
    let (name, port) = match host.strip_prefix('[') {
        Some(rest) => rest.split_once(']').unwrap_or_default(),
        None => host.split_at(host.find(':').unwrap_or(host.len())),
    };
    if !port.is_empty() && port.strip_prefix(':').and_then(|port| port.parse::<u16>().ok()).is_none() {
        return false;
    }
    name.eq_ignore_ascii_case("localhost") || name.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn names_of_this_machine_are_known_from_others() {
        for own in ["localhost", "localhost:8420", "LOCALHOST:1", "127.0.0.1:8420", "[::1]:8420", "127.0.0.1"] {
            assert!(is_own_name(own), "{own}");
        }
        for other in [
            "",
            "example.org",
            "localhost.example.org:8420",
            "192.168.1.5:8420",
            "[fe80::1]:80",
            "[::1",
            "[::1]@example.org",
            "127.0.0.1:80@example.org",
        ] {
            assert!(!is_own_name(other), "{other}");
        }
    }

    #[test]
    fn what_another_sites_page_loads_is_told_from_what_somebody_opens() {
        let is_of_another = |pairs: &[(&'static str, &'static str)]| {
            let headers = pairs.iter().map(|&(name, text)| (name.parse().unwrap(), HeaderValue::from_static(text)));
            is_of_another_site(&headers.collect())
        };
        let [site, dest] = ["sec-fetch-site", "sec-fetch-dest"];
        for loaded in ["image", "iframe", "empty"] {
            assert!(is_of_another(&[(site, "cross-site"), (dest, loaded)]), "{loaded}");
            assert!(!is_of_another(&[(site, "same-origin"), (dest, loaded)]), "{loaded}");
        }
        // A link; a bookmark; a program.
        assert!(!is_of_another(&[(site, "cross-site"), (dest, "document")]));
        assert!(!is_of_another(&[(site, "none"), (dest, "document")]));
        assert!(!is_of_another(&[]));
    }

    #[test]
    fn a_token_is_known_by_its_ports_cookie_among_others_and_by_its_header() {
        const TOKEN: &str = "0123456789abcdef";
        let door = Door::Token(Token(TOKEN.into()));
        let headers = |pairs: &[(&str, &str)]| {
            let header = |text: &str| HeaderValue::from_str(text).unwrap();
            pairs.iter().map(|(name, text)| (name.parse().unwrap(), header(text))).collect::<HeaderMap>()
        };
        let is_in = |pairs: &[(&str, &str)]| matches!(door.decide(None, &headers(pairs)), Admission::In);
        let asked = headers(&[("host", "bench:8431")]);
        let Admission::ByCookie(answer) = door.decide(Some(&format!("token={TOKEN}")), &asked) else { panic!() };
        let cookie = answer.headers()[SET_COOKIE].to_str().unwrap().split(';').next().unwrap().to_owned();
        assert_eq!(cookie, format!("holod_token_8431={TOKEN}"));
        let both = format!("holod_token_8432=of-the-other-holod; holod_token_8431=an-older-one; {cookie}");
        assert!(is_in(&[("host", "bench:8431"), ("cookie", &both)]));
        assert!(!is_in(&[("host", "bench:8432"), ("cookie", &both)]));
        assert!(is_in(&[("authorization", &format!("bearer {TOKEN}"))]));
        assert!(!is_in(&[("authorization", TOKEN)]));
    }

    #[test]
    fn a_token_is_one_line_that_nobody_else_may_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("token");
        let read = |text: &str, mode| {
            fs::write(&file, text).unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(mode)).unwrap();
            Token::read(&file).map_err(|error| error.to_string())
        };
        let token = read("0123456789abcdef\n", 0o600).unwrap();
        assert!(token.is("0123456789abcdef"));
        assert!(!token.is("0123456789abcdeF") && !token.is("") && !token.is("0123456789abcdef0"));
        assert!(read("0123456789abcdef", 0o640).err().unwrap().contains("chmod 600"));
        assert!(read("short", 0o400).err().unwrap().contains("found 5 characters"));
        assert!(read("0123456789abcdef 0", 0o400).err().unwrap().contains("found ' '"));
        assert!(Token::read(&folder.path().join("none")).is_err());
    }
}
