//! A page for browsers: the room in three dimensions, the motes, live.
//!
//! `/` is the page, which needs nothing from anywhere else; `/snapshot` what is known now, with trails; `/events` pushes
//! what is known, without trails, as server-sent events. Everything is read-only.
//!
//! # Design
//! One thread makes the text of a snapshot, once for everybody and only while somebody watches. Each connection has a
//! thread and a deadline for each thing that it has to do: who does not read is let go, and nobody else notices. A
//! watcher that is slower than the snapshots misses some. Connections are counted, requests are short: memory does not
//! grow.
//!
//! Any page in a browser may send requests to this computer. Names that another page could have pointed here are
//! refused (`may_ask`), and no answer may be read by another page.
//!
//! What can go wrong: the port is taken. One that was asked for is an error; instead of the usual one a free one is used.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{Builder, sleep};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

use super::model::{self, Event, Shared, Snapshot};
use super::output::Sink;

/// Where the page is, unless told.
pub const USUAL: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8015);
/// Connections at a time: a handful of people, each with a page and what it asks for.
pub const CONNECTIONS: usize = 32;
/// Time between two snapshots: as smooth as a mote's reports.
const EVERY: Duration = Duration::from_millis(100);
/// It grows with a swarm, so that a browser can follow: so many bytes a second,
const BYTES_PER_S: usize = 2_000_000;
/// up to this.
const SELDOM: Duration = Duration::from_secs(2);
/// How long a request may take to arrive.
const REQUEST: Duration = Duration::from_secs(5);
/// Bytes of a request: a browser sends one of about 700.
const REQUEST_BYTES: usize = 8192;
/// Lines of its head.
const HEADERS: usize = 64;
/// How long an answer, or one snapshot, may take to leave.
pub const SLOW: Duration = Duration::from_secs(3);
/// How long a closing connection may still talk.
const LINGER: Duration = Duration::from_millis(300);
/// Points of all trails in one answer: 2 MB of them.
const TRAIL_POINTS: usize = 50_000;

const PAGE: &str = include_str!("web/page.html");

/// The server; it goes when this is dropped.
pub struct Web {
    at: SocketAddr,
    house: Arc<House>,
}

/// What all its threads share.
struct House {
    shared: Shared,
    names: Vec<String>,
    over: AtomicBool,
    connections: AtomicUsize,
    watching: AtomicUsize,
    let_go: AtomicU64,
    latest: Mutex<Latest>,
    news: Condvar,
}

/// The last snapshot that was made, and how many there were.
#[derive(Default)]
struct Latest {
    number: u64,
    text: Arc<str>,
}

/// One less when this goes.
struct Leaving<'a>(&'a AtomicUsize);

impl Drop for Leaving<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Reads `ADDRESS:PORT`, `ADDRESS` or `PORT`.
///
/// # Errors
/// It is none of them.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    let as_port = || text.parse().map(|port| SocketAddr::new(USUAL.ip(), port));
    let as_ip = || text.parse().map(|ip: IpAddr| SocketAddr::new(ip, USUAL.port()));
    let named = |name: &str| name.parse::<u16>().map(|port| SocketAddr::new(USUAL.ip(), port));
    if let Some(port) = text.strip_prefix("localhost:") {
        return named(port).map_err(|_| format!("{port:?} is no port"));
    }
    text.parse().or_else(|_| as_ip()).or_else(|_| as_port()).map_err(|_| {
        format!("{text:?} is no address of this computer; {USUAL} is one, and 0.0.0.0:{} all of them", USUAL.port())
    })
}

impl Web {
    /// Begins to serve; without an address at [`USUAL`], or beside it where that is taken.
    ///
    /// # Errors
    /// The address is taken, or not of this computer.
    pub fn open(asked: Option<SocketAddr>, shared: Shared) -> Result<Self> {
        let listener = match asked {
            Some(at) => TcpListener::bind(at).with_context(|| format!("{at}: cannot be served"))?,
            None => TcpListener::bind(USUAL)
                .or_else(|_| TcpListener::bind((USUAL.ip(), 0)))
                .with_context(|| format!("{}: cannot be served", USUAL.ip()))?,
        };
        let at = listener.local_addr().context("a port without an address")?;
        let computer = super::computer().to_ascii_lowercase();
        let house = Arc::new(House {
            shared,
            names: vec!["localhost".to_owned(), format!("{computer}.local"), computer],
            over: AtomicBool::new(false),
            connections: AtomicUsize::new(0),
            watching: AtomicUsize::new(0),
            let_go: AtomicU64::new(0),
            latest: Mutex::default(),
            news: Condvar::new(),
        });
        let (maker, door) = (house.clone(), house.clone());
        Builder::new().name("snapshots".into()).spawn(move || maker.make())?;
        Builder::new().name("door".into()).spawn(move || door.answer(&listener))?;
        Ok(Self { at, house })
    }

    /// What to type into a browser.
    #[must_use]
    pub fn url(&self) -> String {
        // Whoever serves everywhere is found here too.
        match self.at.ip() {
            ip if ip.is_unspecified() => format!("http://localhost:{}/", self.at.port()),
            _ => format!("http://{}/", self.at),
        }
    }

    /// Where it is.
    #[must_use]
    pub fn at(&self) -> SocketAddr {
        self.at
    }

    /// Pages that are told what happens.
    #[must_use]
    pub fn watching(&self) -> usize {
        self.house.watching.load(Ordering::Relaxed)
    }

    /// Watchers that were let go because they did not read.
    #[must_use]
    pub fn let_go(&self) -> u64 {
        self.house.let_go.load(Ordering::Relaxed)
    }
}

impl Drop for Web {
    fn drop(&mut self) {
        self.close();
    }
}

impl Web {
    fn close(&mut self) {
        if self.house.over.swap(true, Ordering::Relaxed) {
            return;
        }
        self.house.publish();
        // The door sees it at its next visitor.
        let here = if self.at.ip().is_unspecified() { USUAL.ip() } else { self.at.ip() };
        let _ = TcpStream::connect_timeout(&SocketAddr::new(here, self.at.port()), LINGER);
        // Pages hear that it is over, if they listen.
        let until = Instant::now() + LINGER;
        while self.watching() > 0 && Instant::now() < until {
            sleep(Duration::from_millis(5));
        }
    }
}

impl Sink for Web {
    fn event(&mut self, _: &Event) -> Result<()> {
        Ok(())
    }

    fn tick(&mut self) -> Result<()> {
        Ok(())
    }

    fn end(&mut self) -> Result<()> {
        self.close();
        Ok(())
    }

    fn note(&self) -> Option<String> {
        if self.house.is_over() {
            return None;
        }
        let slow = match self.let_go() {
            0 => String::new(),
            count => format!(", {count} too slow"),
        };
        Some(format!("page at {}: {} watching{slow}", self.url(), self.watching()))
    }
}

impl House {
    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }

    /// Makes a snapshot for those who watch; how long its text is.
    fn publish(&self) -> usize {
        // Looked at under the lock, written down outside.
        let all = model::lock(&self.shared).snapshot(0);
        let text: Arc<str> = json(&all).into();
        let length = text.len();
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        *latest = Latest { number: latest.number + 1, text };
        drop(latest);
        self.news.notify_all();
        length
    }

    fn make(&self) {
        while !self.is_over() {
            let length = if self.watching.load(Ordering::Relaxed) > 0 { self.publish() } else { 0 };
            let fit = Duration::from_secs_f64(length as f64 / BYTES_PER_S as f64);
            sleep(fit.clamp(EVERY, SELDOM));
        }
    }

    fn answer(self: Arc<Self>, listener: &TcpListener) {
        while !self.is_over() {
            let Ok((mut stream, _)) = listener.accept() else {
                // Too many open files, as a rule: somebody will close one.
                sleep(EVERY);
                continue;
            };
            let before = self.connections.fetch_add(1, Ordering::Relaxed);
            let house = self.clone();
            let talk = move || {
                let _leaving = Leaving(&house.connections);
                // Whoever is gone is gone.
                let _ = match before < CONNECTIONS {
                    true => house.talk(&mut stream),
                    false => plain(&mut stream, "503 Service Unavailable"),
                };
                close(&mut stream);
            };
            // To be told that it is full takes a place too. Without one the closing socket says it.
            let is_there = before < 2 * CONNECTIONS && Builder::new().name("visitor".into()).spawn(talk).is_ok();
            if !is_there {
                self.connections.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }

    fn talk(&self, stream: &mut TcpStream) -> io::Result<()> {
        stream.set_nodelay(true)?;
        let mut bytes = Vec::with_capacity(1024);
        let until = Instant::now() + REQUEST;
        let asked = loop {
            match parse(&bytes, &self.names) {
                Asked::Unfinished if bytes.len() >= REQUEST_BYTES => break Asked::Long,
                Asked::Unfinished => {}
                asked => break asked,
            }
            let mut more = [0; 1024];
            match receive(stream, &mut more, until)? {
                0 if bytes.is_empty() => return Ok(()),
                0 => break Asked::Not,
                count => bytes.extend_from_slice(&more[..count]),
            }
        };
        match asked {
            Asked::Path(path) => match path.as_str() {
                "/" | "/index.html" => respond(stream, "200 OK", "text/html; charset=utf-8", PAGE.as_bytes()),
                "/snapshot" => respond(stream, "200 OK", "application/json", self.whole().as_bytes()),
                "/events" => self.tell(stream),
                _ => plain(stream, "404 Not Found"),
            },
            Asked::Other => plain(stream, "405 Method Not Allowed"),
            Asked::Elsewhere => plain(stream, "403 Forbidden"),
            Asked::Long => plain(stream, "431 Request Header Fields Too Large"),
            Asked::Unfinished | Asked::Not => plain(stream, "400 Bad Request"),
        }
    }

    /// All that is known, with trails as long as there is room for.
    fn whole(&self) -> String {
        let mut all = model::lock(&self.shared).snapshot(model::TRAIL);
        let each = TRAIL_POINTS / all.motes.len().max(1);
        for mote in &mut all.motes {
            let old = mote.trail.len().saturating_sub(each);
            mote.trail.drain(..old);
        }
        json(&all)
    }

    /// Tells one watcher what happens, until it no longer listens.
    fn tell(&self, stream: &mut TcpStream) -> io::Result<()> {
        self.watching.fetch_add(1, Ordering::Relaxed);
        let _leaving = Leaving(&self.watching);
        let told = self.tell_all(stream);
        let is_slow = told
            .as_ref()
            .is_err_and(|error| matches!(error.kind(), io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock));
        if is_slow {
            self.let_go.fetch_add(1, Ordering::Relaxed);
        }
        told
    }

    fn tell_all(&self, stream: &mut TcpStream) -> io::Result<()> {
        let head = head("200 OK", "text/event-stream", None);
        send(stream, head.as_bytes(), Instant::now() + SLOW)?;
        let mut seen = 0;
        loop {
            let latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
            let waited = self
                .news
                .wait_timeout_while(latest, SELDOM, |latest| latest.number == seen && !self.is_over())
                .unwrap_or_else(PoisonError::into_inner);
            let (number, text) = (waited.0.number, waited.0.text.clone());
            drop(waited);
            let until = Instant::now() + SLOW;
            if number != seen {
                seen = number;
                send(stream, b"data: ", until)?;
                send(stream, text.as_bytes(), until)?;
                send(stream, b"\n\n", until)?;
            }
            if self.is_over() {
                return send(stream, b"event: end\ndata:\n\n", until);
            }
        }
    }
}

fn json(all: &Snapshot) -> String {
    // Strings, numbers and names of fields: there is nothing in it that JSON cannot say.
    serde_json::to_string(all).unwrap_or_default()
}

/// What somebody asked for.
#[derive(Debug, PartialEq, Eq)]
enum Asked {
    /// There is more to come.
    Unfinished,
    /// This.
    Path(String),
    /// Something else than to get it.
    Other,
    /// It, from another computer by the name it uses.
    Elsewhere,
    /// Too much.
    Long,
    /// Nothing that HTTP knows.
    Not,
}

fn parse(bytes: &[u8], names: &[String]) -> Asked {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Partial) => return Asked::Unfinished,
        Ok(httparse::Status::Complete(_)) => {}
        Err(httparse::Error::TooManyHeaders) => return Asked::Long,
        Err(_) => return Asked::Not,
    }
    let mut hosts = request.headers.iter().filter(|header| header.name.eq_ignore_ascii_case("host"));
    let (Some(host), None) = (hosts.next(), hosts.next()) else { return Asked::Not };
    let Ok(host) = std::str::from_utf8(host.value) else { return Asked::Not };
    if !may_ask(host, names) {
        return Asked::Elsewhere;
    }
    if request.method != Some("GET") {
        return Asked::Other;
    }
    let path = request.path.unwrap_or_default();
    Asked::Path(path.split_once('?').map_or(path, |(path, _)| path).to_owned())
}

/// Whether a browser that calls us so can be trusted to mean us: an address, or a name that only this computer gives
/// itself. Any other name may be of a page whose owner lets it point here (DNS rebinding).
fn may_ask(host: &str, names: &[String]) -> bool {
    let host = host.trim();
    let name = match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']'));
    bare.is_some_and(|six| six.parse::<std::net::Ipv6Addr>().is_ok())
        || name.parse::<Ipv4Addr>().is_ok()
        || names.iter().any(|known| known.eq_ignore_ascii_case(name))
}

/// The head of an answer. Nothing is kept, nothing comes from elsewhere, nobody else may frame or read it.
fn head(status: &str, kind: &str, length: Option<usize>) -> String {
    let length = length.map(|length| format!("Content-Length: {length}\r\n")).unwrap_or_default();
    let allow = if status.starts_with("405") { "Allow: GET\r\n" } else { "" };
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\n{length}{allow}Connection: close\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nCross-Origin-Resource-Policy: same-origin\r\n\
         Content-Security-Policy: default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
         connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n\r\n"
    )
}

fn respond(stream: &mut TcpStream, status: &str, kind: &str, body: &[u8]) -> io::Result<()> {
    let until = Instant::now() + SLOW;
    send(stream, head(status, kind, Some(body.len())).as_bytes(), until)?;
    send(stream, body, until)
}

fn plain(stream: &mut TcpStream, status: &str) -> io::Result<()> {
    respond(stream, status, "text/plain; charset=utf-8", format!("{status}\n").as_bytes())
}

/// Sends all of it by then.
fn send(stream: &mut TcpStream, mut bytes: &[u8], until: Instant) -> io::Result<()> {
    while !bytes.is_empty() {
        stream.set_write_timeout(Some(left(until)?))?;
        match stream.write(bytes) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(count) => bytes = &bytes[count..],
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Receives something by then; 0 at the end.
fn receive(stream: &mut TcpStream, into: &mut [u8], until: Instant) -> io::Result<usize> {
    loop {
        stream.set_read_timeout(Some(left(until)?))?;
        match stream.read(into) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            other => return other,
        }
    }
}

fn left(until: Instant) -> io::Result<Duration> {
    let left = until.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
}

/// Hears a visitor out: a socket that is closed over unread bytes takes the answer with it.
fn close(stream: &mut TcpStream) {
    if stream.shutdown(Shutdown::Write).is_err() {
        return;
    }
    let until = Instant::now() + LINGER;
    let mut rest = [0; 1024];
    while receive(stream, &mut rest, until).is_ok_and(|count| count > 0) {}
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::listen::model::Cause;

    fn names() -> Vec<String> {
        ["localhost", "desk.local", "desk"].map(str::to_owned).to_vec()
    }

    #[test]
    fn an_address_is_read_as_people_write_it() {
        for (text, at) in [
            ("127.0.0.1:8020", "127.0.0.1:8020"),
            ("0.0.0.0", "0.0.0.0:8015"),
            ("9000", "127.0.0.1:9000"),
            ("localhost:9000", "127.0.0.1:9000"),
            ("[::1]:9000", "[::1]:9000"),
            ("::1", "[::1]:8015"),
        ] {
            assert_eq!(address(text), Ok(at.parse().unwrap()), "{text}");
        }
        for text in ["", "take1", "70000", "localhost:x", "1.2.3", "127.0.0.1:"] {
            assert!(address(text).is_err(), "{text}");
        }
    }

    #[test]
    fn only_addresses_and_the_own_names_may_ask() {
        for host in
            ["127.0.0.1:8015", "127.0.0.1", "[::1]:8015", "[::1]", "localhost:1", "LocalHost", "desk", "desk.local:80"]
        {
            assert!(may_ask(host, &names()), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "evil.example:8015",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "::1]",
            "[x]",
            "desk:",
        ] {
            assert!(!may_ask(host, &names()), "{host}");
        }
    }

    #[test]
    fn a_request_is_read_up_to_its_end() {
        let of = |text: &str| parse(text.as_bytes(), &names());
        let whole = "GET /events?x=1 HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n";
        for end in 0..whole.len() {
            assert_eq!(of(&whole[..end]), Asked::Unfinished, "{end}");
        }
        assert_eq!(of(whole), Asked::Path("/events".into()));
        assert_eq!(of("POST / HTTP/1.1\r\nHost: localhost\r\n\r\n"), Asked::Other);
        assert_eq!(of("GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n"), Asked::Elsewhere);
        assert_eq!(of("GET / HTTP/1.1\r\n\r\n"), Asked::Not, "no host");
        assert_eq!(of("GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n"), Asked::Not, "two");
        assert_eq!(of("PRI * HTTP/2.0\r\n\r\n"), Asked::Not);
        let many: String = (0..HEADERS).map(|n| format!("X-{n}: 1\r\n")).collect();
        assert_eq!(of(&format!("GET / HTTP/1.1\r\nHost: localhost\r\n{many}\r\n")), Asked::Long);
    }

    #[test]
    fn the_page_says_of_every_cause_what_the_terminal_says() {
        for cause in Cause::ALL {
            let name = serde_json::to_value(cause).unwrap();
            let line = format!("{}: \"{}\"", name.as_str().unwrap(), cause.words());
            assert!(PAGE.contains(&line), "{line}");
        }
    }

    #[test]
    fn the_page_fetches_nothing_from_elsewhere() {
        assert!(!PAGE.contains("://") && !PAGE.contains("@import") && !PAGE.contains("src="));
    }

    proptest! {
        #[test]
        fn any_bytes_at_all_are_a_request_or_none(bytes: Vec<u8>, host: String) {
            let _ = parse(&bytes, &names());
            let elsewhere = host + ".example";
            prop_assert!(!may_ask(&elsewhere, &names()));
        }
    }
}
