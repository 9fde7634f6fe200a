//! Who may ask. Pages of other sites can make a browser send requests here; these checks tell them from our own page.

use std::net::IpAddr;

use crate::{Refusal, ServeConfig, http::Request};

/// A new token: 192 random bits in hexadecimal digits.
pub fn draw_token() -> String {
    format!("{:032x}{:016x}", rand::random::<u128>(), rand::random::<u64>())
}

/// The name of the cookie that holds the token. Cookies of a host are sent to all its ports: each has a name of its own.
pub fn cookie(request: &Request) -> String {
    let port = request.header("host").and_then(|host| host.rsplit_once(':')?.1.parse::<u16>().ok());
    format!("freerange_token_{}", port.unwrap_or(80))
}

/// What is checked of every request.
pub struct Guard {
    host: IpAddr,
    names: Vec<String>,
    token: Option<String>,
}

/// The host of an authority, without its port.
fn host_of(authority: &str) -> Option<&str> {
    let (host, rest) = match authority.strip_prefix('[') {
        Some(v6) => v6.split_once(']')?,
        None => authority.split_at(authority.find(':').unwrap_or(authority.len())),
    };
    let port = rest.is_empty() || rest.strip_prefix(':').is_some_and(|p| p.parse::<u16>().is_ok());
    (port && !host.is_empty()).then_some(host)
}

/// Compares in a time that does not tell where texts differ.
fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |all, (x, y)| all | (x ^ y)) == 0
}

impl Guard {
    pub fn new(config: &ServeConfig) -> Self {
        let names = config.names.iter().map(|n| n.to_ascii_lowercase()).collect();
        Self { host: config.host, names, token: config.token.clone() }
    }

    /// A name that is not ours means that somebody's name was bent to our address (DNS rebinding); an address cannot be bent. Any port
    /// may be forwarded here.
    fn knows(&self, authority: &str) -> bool {
        let Some(host) = host_of(authority) else { return false };
        let host = host.to_ascii_lowercase();
        match host.parse::<IpAddr>() {
            Ok(address) => address == self.host || address.is_loopback() || self.host.is_unspecified(),
            Err(_) => host == "localhost" || self.names.contains(&host),
        }
    }

    /// Refuses requests that pages of others made.
    pub fn check_place(&self, request: &Request) -> Result<(), Refusal> {
        let host = request.header("host").ok_or_else(|| Refusal::new(400, "the request has no Host"))?;
        if !self.knows(host) {
            return Err(Refusal::new(421, "this Host is not served here: ask whoever started the server"));
        }
        if let Some(origin) = request.header("origin") {
            let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
            if !authority.is_some_and(|a| a.eq_ignore_ascii_case(host)) {
                return Err(Refusal::new(403, "requests of other origins are refused"));
            }
        }
        // Following a link to the page is fine; anything else across sites is not.
        let landing =
            request.method == "GET" && request.path == "/" && request.header("sec-fetch-mode") == Some("navigate");
        match request.header("sec-fetch-site") {
            None | Some("same-origin" | "none") => Ok(()),
            Some(_) if landing => Ok(()),
            Some(_) => Err(Refusal::new(403, "requests of other sites are refused")),
        }
    }

    /// Whether the request knows the token, where there is one.
    pub fn admits(&self, request: &Request) -> bool {
        let Some(token) = &self.token else { return true };
        let bearer = request.header("authorization").and_then(|v| v.strip_prefix("Bearer "));
        let name = cookie(request);
        let cookie = request
            .header("cookie")
            .and_then(|v| v.split(';').find_map(|pair| pair.trim().strip_prefix(&*name)?.strip_prefix('=')));
        [bearer, cookie].into_iter().flatten().any(|told| same(told, token))
    }

    /// Whether there is a token.
    pub fn asks(&self) -> bool {
        self.token.is_some()
    }

    /// Whether `told`, from a form, is the token.
    pub fn is_token(&self, told: &str) -> bool {
        self.token.as_deref().is_some_and(|token| same(told, token))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_are_known_by_address_or_name() {
        let at = |host: &str, names: &[&str]| {
            let names = names.iter().map(|n| n.to_string()).collect();
            Guard::new(&ServeConfig { host: host.parse().unwrap(), names, ..ServeConfig::default() })
        };
        let loopback = at("127.0.0.1", &["Studio.example"]);
        for fine in ["localhost:8000", "LOCALHOST", "127.0.0.1:1", "[::1]:80", "studio.example:443"] {
            assert!(loopback.knows(fine), "{fine}");
        }
        for odd in [
            "",
            "evil.example",
            "localhost.evil.example",
            "192.168.0.7",
            "localhost:80:80",
            "localhost:x",
            "[::1",
            "127.0.0.1.nip.example",
            ":80",
        ] {
            assert!(!loopback.knows(odd), "{odd}");
        }
        assert!(at("0.0.0.0", &[]).knows("192.168.0.7:80") && !at("0.0.0.0", &[]).knows("evil.example"));
        assert!(same("abc", "abc") && !same("abc", "abd") && !same("abc", "ab"));
    }
}
