//! The page, in a browser: frames go into the program as a capture through a pipe, and what a person would see is read back.
//! The browser is Debian's chromium, told what to do through its debugging pipe; without it those tests are skipped.
#![cfg(unix)]

#[path = "listen/port.rs"]
mod port;
#[path = "listen/running.rs"]
mod running;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{ChildStderr, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use fixed::types::{I6F10, I16F16, U0F16};
use lighthouse_mote::frame::{self, Header, Health, Level, Lock, Report};
use running::Running;
use serde_json::{Value, json};
use xtask::listen::desk;
use xtask::listen::model::{self, Signal, Swarm};
use xtask::listen::simulate;
use xtask::listen::web::Web;
use xtask::pcap;

/// Long where something has to come on a busy computer.
const LONG: Duration = Duration::from_secs(120);

// --- the program, and what is in its air ---

/// Starts the program with a page; where that is, and what it complains of, which somebody has to take.
fn serve(words: &[&str], address: &str) -> (Running, SocketAddr, ChildStderr) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
    command.args(words).args(["--plain", "--web", address]).env_remove("LIGHTHOUSE_CALIB");
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut running = Running(command.spawn().expect("it starts"));
    let mut said = BufReader::new(running.0.stderr.take().unwrap());
    let lines = said.by_ref().lines().map_while(Result::ok);
    let url = lines.filter_map(|line| line.strip_prefix("Page: http://").map(str::to_owned)).next();
    let at = url.expect("an address").trim_end_matches('/').parse().expect("an address");
    (running, at, said.into_inner())
}

/// A program that listens to a pipe and serves a page.
struct Listener {
    running: Running,
    air: Option<ChildStdin>,
    at: SocketAddr,
    /// Whoever cannot say what is wrong goes wrong.
    _complaints: ChildStderr,
}

impl Listener {
    fn start(address: &str) -> Self {
        Self::start_with(&[], address)
    }

    fn start_with(words: &[&str], address: &str) -> Self {
        let (mut running, at, complaints) = serve(&[&["listen", "--capture", "-"], words].concat(), address);
        let mut air = running.0.stdin.take().unwrap();
        let mut head = Vec::new();
        pcap::write(&[], &mut head).unwrap();
        air.write_all(&head).unwrap();
        Self { running, air: Some(air), at, _complaints: complaints }
    }

    /// A frame at so many tenths of a second.
    fn hear(&mut self, tenths: u32, frame: &[u8]) {
        let length = frame.len() as u32;
        let words = [tenths / 10, tenths % 10 * 100_000, length, length];
        let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        bytes.extend(frame);
        let air = self.air.as_mut().expect("still there");
        air.write_all(&bytes).unwrap();
        air.flush().unwrap();
    }

    /// The capture ends, and with it the listening.
    fn end(mut self) {
        drop(self.air.take());
        assert!(self.running.0.wait().unwrap().success());
    }
}

/// Report number `sequence` of a mote whose clock says so many tenths of a second.
fn report(mote: u16, sequence: u16, tenths: u32, position: [f64; 3]) -> Vec<u8> {
    let report = Report {
        time: tenths.wrapping_mul(1_000_000),
        half_turn_q8: 83_333 << 8,
        position: position.map(I16F16::from_num),
        velocity: [3.0, 0.0, 4.0].map(I6F10::from_num),
        sd: [0.002, 0.003, 0.006].map(U0F16::from_num),
        mismatch: U0F16::from_num(0.0025),
        level: Level::Full,
        stations: 3,
        ..Report::default()
    };
    frame::emit(Header { pan: 0x4C48, mote, sequence }, &report).to_vec()
}

fn health(mote: u16, sequence: u16, lock: Lock) -> Vec<u8> {
    let health = Health { half_turn_q8: 83_333 << 8, lock, ..Health::default() };
    frame::emit_health(Header { pan: 0x4C48, mote, sequence }, &health).to_vec()
}

// --- the server ---

/// Sends bytes and reads the answer to its end.
fn ask_raw(at: SocketAddr, request: &[u8]) -> String {
    let mut stream = TcpStream::connect(at).expect("it answers");
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream.write_all(request).unwrap();
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8_lossy(&answer).into_owned()
}

fn ask(at: SocketAddr, path: &str) -> String {
    ask_raw(at, format!("GET {path} HTTP/1.1\r\nHost: {at}\r\n\r\n").as_bytes())
}

fn body(answer: &str) -> &str {
    answer.split_once("\r\n\r\n").expect("a head").1
}

/// A server over motes that nobody moves.
fn served(motes: u16) -> Web {
    let text = include_str!("../../calib/default.toml");
    let calibration = xtask::calib::schema::read("default.toml", text).unwrap();
    let (desk, _) = desk(Some(model::RoomNews::of("default.toml", &calibration)));
    let mut all: std::sync::MutexGuard<'_, Swarm> = model::lock(&desk.shared);
    let source = all.add_source("simulation", "simulation");
    let scene = simulate::scene("d", &calibration).unwrap();
    simulate::Swarm::new(&scene, 0x4C48, motes, 10.0).until(2.0, |at_s, bytes| {
        all.hear(at_s, source, bytes, Signal::default());
    });
    drop(all);
    Web::open(Some("127.0.0.1:0".parse().unwrap()), desk.shared).expect("a free port")
}

#[test]
fn it_answers_what_it_has_and_refuses_the_rest() {
    let web = served(3);
    let at = web.at();
    let page = ask(at, "/");
    assert!(page.starts_with("HTTP/1.1 200 OK\r\n") && body(&page).starts_with("<!doctype html>"), "{page}");
    assert!(page.contains("Content-Security-Policy: default-src 'none';") && page.contains("\r\nConnection: close"));
    let snapshot = ask(at, "/snapshot?now");
    let all: Value = serde_json::from_str(body(&snapshot)).expect("JSON");
    assert_eq!((&all["format"], all["motes"].as_array().unwrap().len()), (&json!(model::FORMAT), 3));
    assert!(!all["motes"][0]["trail"].as_array().unwrap().is_empty() && !snapshot.contains("Access-Control"));
    for path in ["/nothing", "/events/", "/../Cargo.toml", "//", "/snapshot/1", "http://127.0.0.1/"] {
        assert!(ask(at, path).starts_with("HTTP/1.1 404 Not Found\r\n"), "{path}");
    }
    let long = format!("GET / HTTP/1.1\r\nHost: {at}\r\nX: {}", "x".repeat(9000));
    for (request, status) in [
        ("POST /snapshot HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc", "405 Method Not Allowed"),
        ("GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", "403 Forbidden"),
        ("GET /snapshot HTTP/1.1\r\nHost: 127.0.0.1.evil.example:80\r\n\r\n", "403 Forbidden"),
        ("GET / HTTP/1.1\r\n\r\n", "400 Bad Request"),
        ("\x16\x03\x01\x02 client hello\r\n\r\n", "400 Bad Request"),
        ("nonsense\r\n\r\n", "400 Bad Request"),
        (&long, "431 Request Header Fields Too Large"),
    ] {
        let answer = ask_raw(at, request.as_bytes());
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}\r\n")), "{request:?}: {answer}");
    }
    assert!(
        ask_raw(at, format!("GET / HTTP/1.1\r\nHost: localhost:{}\r\n\r\n", at.port()).as_bytes()).contains(" 200 ")
    );
}

#[test]
fn a_port_that_was_asked_for_and_is_taken_is_an_error() {
    let web = served(1);
    let (desk, _) = desk(None);
    let error = Web::open(Some(web.at()), desk.shared.clone()).err().expect("taken");
    assert!(format!("{error:#}").starts_with(&format!("{}: cannot be served", web.at())), "{error:#}");
    // Whoever did not ask gets another.
    let (one, two) = (Web::open(None, desk.shared.clone()).unwrap(), Web::open(None, desk.shared).unwrap());
    assert_ne!(one.at().port(), two.at().port());
}

/// Opens the events and reads their head.
fn watch(at: SocketAddr) -> BufReader<TcpStream> {
    let mut stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream.write_all(format!("GET /events HTTP/1.1\r\nHost: {at}\r\n\r\n").as_bytes()).unwrap();
    BufReader::new(stream)
}

/// The text of the next snapshot.
fn next_event(from: &mut impl BufRead) -> String {
    loop {
        let mut line = String::new();
        assert!(from.read_line(&mut line).expect("in time") > 0, "it ended");
        if let Some(text) = line.strip_prefix("data: ") {
            return text.to_owned();
        }
    }
}

#[test]
fn who_does_not_read_is_let_go_and_nobody_waits_for_it() {
    // Snapshots of a megabyte, which soon fill what lies between.
    let web = served(1000);
    let idle: Vec<_> = (0..2).map(|_| watch(web.at())).collect();
    // Nor for whoever asks letter by letter.
    let mut slow = TcpStream::connect(web.at()).unwrap();
    slow.write_all(b"GET /ev").unwrap();
    let mut reader = watch(web.at());
    let until = Instant::now() + LONG;
    let first = next_event(&mut reader);
    while web.let_go() < 2 || web.watching() > 1 {
        next_event(&mut reader);
        assert!(Instant::now() < until, "{} watch, {} let go", web.watching(), web.let_go());
    }
    next_event(&mut reader);
    assert_eq!((web.watching(), web.let_go()), (1, 2));
    let all: Value = serde_json::from_str(&first).expect("JSON");
    assert_eq!(all["motes"].as_array().unwrap().len(), 1000);
    drop(idle);
    // When all is over it is said.
    let end = std::thread::spawn(move || {
        let mut rest = String::new();
        let _ = reader.read_to_string(&mut rest);
        rest
    });
    drop(web);
    assert!(end.join().unwrap().ends_with("event: end\ndata:\n\n"));
}

#[test]
fn more_visitors_than_there_are_places_are_told_so() {
    let web = served(1);
    let mut watchers: Vec<_> = (0..xtask::listen::web::CONNECTIONS).map(|_| watch(web.at())).collect();
    for watcher in &mut watchers {
        next_event(watcher);
    }
    let answer = ask(web.at(), "/");
    assert!(answer.starts_with("HTTP/1.1 503 Service Unavailable\r\n"), "{answer}");
    drop(watchers);
    let until = Instant::now() + LONG;
    while !ask(web.at(), "/").starts_with("HTTP/1.1 200 OK\r\n") {
        assert!(Instant::now() < until, "no place again");
        std::thread::sleep(Duration::from_millis(50));
    }
}

// --- the browser ---

/// A browser with one page, told what to do through its debugging pipe.
struct Browser {
    _running: Running,
    _home: tempfile::TempDir,
    to: ChildStdin,
    from: Receiver<Value>,
    last: u64,
    session: Option<String>,
    /// What the page threw or the browser complained about.
    complaints: Vec<Value>,
}

impl Browser {
    fn start(url: &str, size: (u32, u32), is_phone: bool) -> Option<Self> {
        let is_there = Command::new("chromium").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        if !is_there.is_ok_and(|status| status.success()) {
            eprintln!("skipped: chromium is not installed (Debian: apt-get install chromium)");
            return None;
        }
        let home = tempfile::tempdir().unwrap();
        // The pipe is file 3 to the browser and file 4 from it. No name is ever looked up: it works offline or not at all.
        let script = "exec chromium --headless --remote-debugging-pipe --no-sandbox --disable-gpu --disable-quic \
             --no-first-run --disable-background-networking --disable-component-update --disable-sync \
             --disable-dev-shm-usage --host-resolver-rules='MAP * ~NOTFOUND, EXCLUDE 127.0.0.1' \"--user-data-dir=$0\" \
             3<&0 4>&1 </dev/null >/dev/null 2>&1";
        let mut command = Command::new("sh");
        command.arg("-c").arg(script).arg(home.path()).env("HOME", home.path());
        let mut running = Running(command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("a shell"));
        let (say, from) = channel();
        let mut said = BufReader::new(running.0.stdout.take().unwrap());
        std::thread::spawn(move || {
            let mut message = Vec::new();
            while said.read_until(0, &mut message).is_ok_and(|count| count > 0) {
                message.pop();
                let Ok(value) = serde_json::from_slice(&message) else { return };
                if say.send(value).is_err() {
                    return;
                }
                message.clear();
            }
        });
        let to = running.0.stdin.take().unwrap();
        let mut browser =
            Self { _running: running, _home: home, to, from, last: 0, session: None, complaints: Vec::new() };
        let target = browser.order("Target.createTarget", json!({ "url": "about:blank" }))["targetId"].clone();
        let attached = browser.order("Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
        browser.session = Some(attached["sessionId"].as_str().expect("a session").to_owned());
        for domain in ["Page", "Runtime", "Log"] {
            browser.order(&format!("{domain}.enable"), json!({}));
        }
        browser.resize(size, is_phone);
        browser.order("Page.navigate", json!({ "url": url }));
        Some(browser)
    }

    fn resize(&mut self, (width, height): (u32, u32), is_phone: bool) {
        let ratio = if is_phone { 2 } else { 1 };
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": ratio, "mobile": is_phone });
        self.order("Emulation.setDeviceMetricsOverride", metrics);
        self.order("Emulation.setTouchEmulationEnabled", json!({ "enabled": is_phone }));
    }

    /// Has something done and waits for what comes of it.
    fn order(&mut self, method: &str, parameters: Value) -> Value {
        self.ask(method, parameters).unwrap_or_else(|error| panic!("{method}: {error}"))
    }

    /// The same where it may be refused.
    fn ask(&mut self, method: &str, parameters: Value) -> Result<Value, Value> {
        self.last += 1;
        let mut message = json!({ "id": self.last, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        let mut bytes = serde_json::to_vec(&message).unwrap();
        bytes.push(0);
        self.to.write_all(&bytes).expect("the browser runs");
        let until = Instant::now() + LONG;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            let message = self.from.recv_timeout(left).unwrap_or_else(|error| panic!("{method}: {error}"));
            let method_said = message["method"].as_str().unwrap_or_default();
            if method_said == "Runtime.exceptionThrown"
                || method_said == "Log.entryAdded" && message["params"]["entry"]["level"] == "error"
            {
                self.complaints.push(message["params"].clone());
            }
            if message["id"] == self.last {
                return match message.get("error") {
                    None => Ok(message["result"].clone()),
                    Some(error) => Err(error.clone()),
                };
            }
        }
    }

    /// The value of an expression in the page.
    fn value(&mut self, expression: &str) -> Value {
        self.evaluated(expression).unwrap_or_else(|error| panic!("{expression}: {error}"))
    }

    fn evaluated(&mut self, expression: &str) -> Result<Value, Value> {
        let asked = json!({ "expression": expression, "returnByValue": true });
        let result = self.ask("Runtime.evaluate", asked)?;
        match result.get("exceptionDetails") {
            None => Ok(result["result"]["value"].clone()),
            Some(thrown) => Err(thrown.clone()),
        }
    }

    fn until(&mut self, what: &str, expression: &str) {
        let until = Instant::now() + LONG;
        // While the page is loading there is nothing to ask, or nobody.
        while self.evaluated(expression) != Ok(json!(true)) {
            if Instant::now() > until {
                let text = self.value("document.body.innerText");
                panic!("{what} did not happen: {text}\n{:?}", self.complaints);
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// What a cell of the table says.
    fn cell(&mut self, mote: &str, key: &str) -> String {
        let cell = format!("document.querySelector('tr[data-key=\"{mote}\"] td[data-k={key}] span').textContent");
        self.value(&cell).as_str().expect("a text").to_owned()
    }

    fn until_cell(&mut self, mote: &str, key: &str, text: &str) {
        let cell = format!("document.querySelector('tr[data-key=\"{mote}\"] td[data-k={key}] span')?.textContent");
        self.until(&format!("{mote} {key} {text}"), &format!("{cell} === {}", json!(text)));
    }

    /// Kept where a person asks for it: a picture of the page.
    fn picture(&mut self, name: &str) {
        let Some(dir) = std::env::var_os("WEB_PICTURES") else { return };
        let shot = self.order("Page.captureScreenshot", json!({ "format": "png" }));
        let path = std::path::Path::new(&dir).join(format!("{name}.png.base64"));
        std::fs::write(path, shot["data"].as_str().unwrap()).unwrap();
    }

    fn drag(&mut self, from: (f64, f64), to: (f64, f64)) {
        for (kind, (x, y)) in [("mousePressed", from), ("mouseMoved", to), ("mouseReleased", to)] {
            let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
            self.order("Input.dispatchMouseEvent", event);
        }
    }

    /// Pixels of the canvas that are not empty, by whether they are of a colour (`r, g, b`, to 16).
    fn pixels(&mut self, colour: Option<[u8; 3]>) -> u64 {
        self.value(&count_pixels(colour)).as_u64().expect("a count")
    }
}

/// The expression for it.
fn count_pixels(colour: Option<[u8; 3]>) -> String {
    let [r, g, b] = colour.unwrap_or_default();
    let is = match colour {
        None => "d[n + 3] > 0".to_owned(),
        Some(_) => format!(
            "d[n + 3] > 60 && Math.abs(d[n] - {r}) < 16 && Math.abs(d[n + 1] - {g}) < 16 && Math.abs(d[n + 2] - {b}) < 16"
        ),
    };
    format!(
        "(() => {{ const c = document.getElementById('room'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; \
         let count = 0; for (let n = 0; n < d.length; n += 4) if ({is}) count++; return count; }})()"
    )
}

/// The first mote's colour on the page, and the second's.
const FIRST: [u8; 3] = [0x56, 0xB4, 0xE9];
const SECOND: [u8; 3] = [0xE6, 0x9F, 0x00];

#[test]
fn a_browser_shows_the_motes_that_were_sent_and_follows_them() {
    // A port that it can have once more when it has ended.
    let mut listener = Listener::start(&format!("127.0.0.1:{}", port::free()));
    let Some(mut browser) = Browser::start(&format!("http://{}/", listener.at), (800, 600), false) else { return };
    browser.until("the page lives", "document.body.dataset.state === 'live'");
    assert_eq!(browser.pixels(Some(FIRST)), 0);
    // Two motes; one is not locked, one frame is damaged, one is lost.
    for n in 0..20u16 {
        let tenths = u32::from(n);
        let along = f64::from(n) / 20.0;
        listener.hear(tenths, &report(3, n, tenths, [0.25 + 0.5 * along, 1.0, -0.125]));
        if n != 9 {
            listener.hear(tenths, &report(8, n, tenths, [1.0, 0.5, 0.5 * along]));
        }
    }
    listener.hear(19, &health(3, 20, Lock::Locked));
    listener.hear(19, &health(8, 20, Lock::OneStation));
    let mut damaged = report(3, 21, 20, [9.0, 9.0, 9.0]);
    damaged[20] ^= 1;
    listener.hear(20, &damaged);
    browser.until_cell("4c48/3", "x", "0.725");
    browser.until_cell("4c48/8", "z", "0.475");
    browser.until("the reject", "document.querySelector('#rejects li')?.textContent === '1 check sequence wrong'");
    for (key, text) in [
        ("mote", "4c48/3"),
        ("level", "full"),
        ("y", "1.000"),
        ("z", "-0.125"),
        ("speed", "5.00"),
        // The root of 4 + 9 + 36.
        ("sd", "7.0"),
        ("mismatch", "2.5"),
        ("rate", "10.0"),
        ("lost", "0.0 %"),
        // 83,333 ticks in a 120th of a second.
        ("clock", "10.0000"),
        ("lock", "locked"),
    ] {
        assert_eq!(browser.cell("4c48/3", key), text, "{key}");
    }
    // One of 21.
    assert_eq!(browser.cell("4c48/8", "lost"), "4.8 %");
    let reason = model::lock_reason(Lock::OneStation).expect("a reason");
    assert_eq!(browser.cell("4c48/8", "lock"), reason);
    assert_eq!(browser.value("document.querySelectorAll('#motes tr').length"), 2);
    // Both are drawn, in their colours.
    browser.until("drawn", "document.body.dataset.placed === '2'");
    let (first, second) = (browser.pixels(Some(FIRST)), browser.pixels(Some(SECOND)));
    assert!(first > 60 && second > 60 && browser.pixels(None) > 3000, "{first} {second}");
    assert_eq!(browser.value("document.querySelectorAll('tr.stale').length"), 0);
    // Whoever comes later sees where they came from: the page sees a moment of them, the server has kept the rest.
    // The page that is there stays until the new one comes.
    browser.value("window.isOld = true");
    browser.order("Page.reload", json!({}));
    let drawn_again = "!window.isOld && document.body.dataset.placed === '2' && document.body.dataset.snapshots > 1";
    browser.until("drawn again", drawn_again);
    let (trail, other) = (browser.pixels(Some(FIRST)), browser.pixels(Some(SECOND)));
    browser.picture("desk");
    // At once: the next snapshot begins new trails.
    let [first, second] = [FIRST, SECOND].map(|colour| {
        let bare = format!("(trails.clear(), draw(), {})", count_pixels(Some(colour)));
        browser.value(&bare).as_u64().expect("a count")
    });
    assert!(trail > first + 15 && other > second + 15, "{first} {second}, with trails {trail} {other}");
    // It moves on, and says so.
    listener.hear(22, &report(3, 22, 22, [0.75, 1.25, -0.5]));
    browser.until_cell("4c48/3", "z", "-0.500");
    // Silence is shown.
    listener.hear(60, &report(3, 23, 60, [0.75, 1.25, -0.5]));
    browser.until("stale", "document.querySelector('tr[data-key=\"4c48/8\"]').classList.contains('stale')");
    assert_eq!(browser.cell("4c48/8", "age"), "silent 4 s");
    // The room is turned by hand and zoomed with the wheel.
    let before = browser.value("document.getElementById('room').toDataURL()");
    browser.drag((300.0, 200.0), (420.0, 240.0));
    browser.order(
        "Input.dispatchMouseEvent",
        json!({ "type": "mouseWheel", "x": 300, "y": 200, "deltaX": 0, "deltaY": -240 }),
    );
    browser.until("turned", "Number(document.body.dataset.yaw) > 1.5 && Number(document.body.dataset.zoom) > 1.2");
    browser.until("another picture", &format!("document.getElementById('room').toDataURL() !== {before}"));
    // Everything came from us.
    let elsewhere = "performance.getEntriesByType('resource').filter(one => !one.name.startsWith(location.origin) && !one.name.startsWith('data:')).length";
    assert_eq!(browser.value(elsewhere), 0);
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    // The end is said, and a new beginning at the same place is noticed.
    let at = listener.at;
    listener.end();
    browser.until("the end", "document.body.dataset.state === 'ended' && !document.getElementById('lost').hidden");
    let mut again = Listener::start(&at.to_string());
    again.hear(0, &report(5, 0, 0, [0.5, 0.5, 0.5]));
    browser.until_cell("4c48/5", "x", "0.500");
    assert_eq!(browser.value("document.querySelectorAll('#motes tr').length"), 1);
    assert_eq!(browser.value("document.getElementById('lost').hidden"), true);
    // A program that is killed says nothing; the page does.
    drop(again);
    browser.until("lost", "document.body.dataset.state === 'lost' && !document.getElementById('lost').hidden");
    let said = browser.value("document.getElementById('lost').textContent");
    assert!(said.as_str().unwrap().starts_with("Connection lost"), "{said}");
    browser.picture("lost");
}

#[test]
fn a_replay_is_watched_at_its_own_pace_to_its_end() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("take");
    let dir = dir.to_str().expect("a plain path");
    // Twenty minutes of a mote that goes along x, a tenth of a millimetre each tenth of a second, and of one that is still.
    const TENTHS: u16 = 12_000;
    let mut listener = Listener::start_with(&["--record", dir], "127.0.0.1:0");
    for n in 0..TENTHS {
        let tenths = u32::from(n);
        listener.hear(tenths, &report(3, n, tenths, [1e-4 * f64::from(n), 1.0, -0.125]));
        if n % 10 == 0 {
            listener.hear(tenths, &report(8, n / 10, tenths, [1.0, 0.5, 0.25]));
        }
    }
    let mut damaged = report(3, TENTHS, u32::from(TENTHS), [9.0, 9.0, 9.0]);
    damaged[20] ^= 1;
    listener.hear(u32::from(TENTHS), &damaged);
    listener.end();
    // At its own pace, time is the recording's.
    let (replay, at, _complaints) = serve(&["replay", dir], "127.0.0.1:0");
    let Some(mut browser) = Browser::start(&format!("http://{at}/"), (800, 600), false) else { return };
    browser.until("the page lives", "document.body.dataset.state === 'live'");
    browser.until("both are shown", "document.body.dataset.placed === '2'");
    browser.until_cell("4c48/8", "z", "0.250");
    browser.until_cell("4c48/3", "rate", "10.0");
    let x = "Number(document.querySelector('tr[data-key=\"4c48/3\"] td[data-k=x] span').textContent)";
    let (began, from) = (Instant::now(), browser.value(x).as_f64().expect("a number"));
    browser.until("it goes on", &format!("{x} >= {from} + 0.003"));
    // 3 mm are 3 s, less what the rounding to millimetres hides.
    assert!(began.elapsed() > Duration::from_millis(1900), "{:?}", began.elapsed());
    assert_eq!(browser.value("document.querySelectorAll('#rejects li').length"), 0);
    assert_eq!(browser.cell("4c48/3", "lost"), "0.0 %");
    // The room is the one it was recorded in.
    assert!(browser.pixels(None) > 3000);
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    drop(replay);
    browser.until("lost", "document.body.dataset.state === 'lost'");
    // Forty times as fast it comes to its end while somebody watches, at the same address, and says so.
    let (mut replay, again, _complaints) = serve(&["replay", dir, "--speed", "40"], &at.to_string());
    assert_eq!(again, at);
    browser.until("it is back", "document.body.dataset.state === 'live'");
    browser.until("the end", "document.body.dataset.state === 'ended' && !document.getElementById('lost').hidden");
    assert!(replay.0.wait().unwrap().success());
    assert_eq!(browser.cell("4c48/3", "x"), "1.200");
    assert_eq!(browser.value("document.querySelector('#rejects li')?.textContent"), "1 check sequence wrong");
    assert_eq!(browser.value("document.querySelectorAll('#motes tr').length"), 2);
    browser.picture("replay");
}

#[test]
fn a_phone_shows_two_motes_with_one_id_and_is_turned_by_fingers() {
    let mut listener = Listener::start("127.0.0.1:0");
    let Some(mut browser) = Browser::start(&format!("http://{}/", listener.at), (390, 844), true) else { return };
    for n in 0..60u16 {
        let tenths = u32::from(n);
        let (sin, cos) = (0.1 * f64::from(n)).sin_cos();
        listener.hear(tenths, &report(5, n, tenths, [0.5 + 0.4 * cos, 1.0, 0.4 * sin]));
        listener.hear(tenths, &report(5, 30_000 + n, 2000 + tenths, [0.5, 1.0 + 0.5 * sin, 0.3]));
    }
    browser.until("told apart", "document.querySelectorAll('#motes tr').length === 2");
    browser.until("flagged", "[...document.querySelectorAll('.twin')].filter(flag => !flag.hidden).length === 2");
    let conflict = browser.value("document.getElementById('conflict').textContent");
    assert_eq!(conflict, "More than one mote says that it is 4c48/5: give one of them another id.");
    // Nothing is beside the screen.
    assert_eq!(browser.value("document.documentElement.scrollWidth <= 390"), true);
    let finger = |browser: &mut Browser, kind: &str, points: &[(f64, f64)]| {
        let points: Vec<Value> =
            points.iter().enumerate().map(|(id, (x, y))| json!({ "x": x, "y": y, "id": id })).collect();
        browser.order("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
    };
    browser.picture("phone");
    let middle = browser.value("(() => { const at = document.getElementById('room').getBoundingClientRect(); return at.top + at.height / 2; })()");
    let y = middle.as_f64().unwrap();
    finger(&mut browser, "touchStart", &[(150.0, y)]);
    finger(&mut browser, "touchMove", &[(250.0, y)]);
    finger(&mut browser, "touchEnd", &[]);
    browser.until("turned", "Number(document.body.dataset.yaw) > 1");
    finger(&mut browser, "touchStart", &[(150.0, y), (250.0, y)]);
    finger(&mut browser, "touchMove", &[(100.0, y), (300.0, y)]);
    finger(&mut browser, "touchEnd", &[]);
    browser.until("zoomed", "Number(document.body.dataset.zoom) > 1.5");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}
