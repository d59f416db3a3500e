//! Where the page is served.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

/// Where the page is served: a port of this machine, an address and port, or a Unix socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PageAddress {
    /// An address and a port for TCP.
    Tcp(SocketAddr),
    /// A Unix socket, which this user and the group may open.
    Unix(PathBuf),
}

/// Why a page is not served there.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    /// It is no address.
    #[error("found `{0}`, expected a port such as 8420, an address such as 192.168.1.5:8420, or unix:PATH")]
    Form(String),
    /// Others could reach it.
    #[error(
        "--page {0}: other machines reach this address, so it needs a token: --page-token FILE, a file that only you may \
         read with at least 16 characters in it. On this machine alone --page {1} does without"
    )]
    Open(SocketAddr, u16),
}

impl PageAddress {
    /// Whether others than those who sit at this machine can reach it only with a token.
    ///
    /// # Errors
    /// They could without.
    pub(super) fn may_be_served(&self, has_token: bool) -> Result<(), AddressError> {
        match self {
            Self::Tcp(address) if !has_token && !address.ip().is_loopback() => {
                Err(AddressError::Open(*address, address.port()))
            }
            _ => Ok(()),
        }
    }
}

impl FromStr for PageAddress {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        if let Some(path) = text.strip_prefix("unix:").filter(|path| !path.is_empty()) {
            return Ok(Self::Unix(path.into()));
        }
        if let Ok(port) = text.parse() {
            return Ok(Self::Tcp(SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), port)));
        }
        let text = text.strip_prefix("localhost:").map_or(text.to_owned(), |port| format!("127.0.0.1:{port}"));
        text.parse().map(Self::Tcp).map_err(|_| AddressError::Form(text))
    }
}

impl fmt::Display for PageAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "http://{address}/"),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_open_ones_need_a_token() {
        let read = |text: &str| text.parse::<PageAddress>().unwrap();
        assert_eq!(read("8420").to_string(), "http://127.0.0.1:8420/");
        assert_eq!(read("localhost:80"), read("127.0.0.1:80"));
        assert_eq!(read("unix:/run/holod/page"), PageAddress::Unix("/run/holod/page".into()));
        for local in ["8420", "[::1]:8420", "unix:/x", "127.1.2.3:1"] {
            assert_eq!(read(local).may_be_served(false), Ok(()), "{local}");
        }
        for open in ["0.0.0.0:8420", "192.168.1.5:8420", "[::]:8420"] {
            let error = read(open).may_be_served(false).unwrap_err().to_string();
            assert!(error.contains("--page-token FILE") && error.contains("--page 8420 does without"), "{error}");
            assert_eq!(read(open).may_be_served(true), Ok(()));
        }
        for wrong in ["", "x", "70000", "unix:", "1.2.3.4", "bench:8420"] {
            assert!(matches!(wrong.parse::<PageAddress>(), Err(AddressError::Form(_))), "{wrong}");
        }
    }
}
