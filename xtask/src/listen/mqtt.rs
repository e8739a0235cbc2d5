//! What is known of each mote, at a broker.
//!
//! One retained topic per mote, `PREFIX/PAN/MOTE`, so that whoever subscribes knows at once where everything is; and
//! `PREFIX/gateway/NAME` with `online` or `offline`, which the broker itself says when this program is killed.
//! `docs/listening.md` lists topic and payload.
//!
//! # Design
//! Several gateways may hear the same mote. One of them speaks for it: whoever said the newest sequence first, in the
//! order in which the broker hands the messages on, which is the same order for all of them. It publishes at once. The
//! others hold a report back for a while, each for another, and drop it when the speaker says that sequence or a newer one
//! meanwhile; when nobody does, they publish it, and whoever came first speaks from then on. So a mote that two gateways
//! hear equally well and equally fast is published once, and a gateway that no longer hears it is followed by another within
//! half a second. Two may still say the same where both begin, or both take over, within the time a message takes.
//!
//! What can go wrong: no broker, or one that goes away. It is tried again every second while everything else goes on, and
//! what happened meanwhile is not sent late: only the newest of each mote is, the rest is counted. So is what was on its
//! way: this gateway reads its own messages too, and what the broker has not handed back by the time the line is lost was
//! not delivered. One that was never reached, or that is not there in the end, is an error in the end.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};
use rumqttc::{Client, Connection, ConnectionError, Event as Wire, LastWill, MqttOptions, Packet, QoS};
use serde::{Deserialize, Serialize};

use super::model::{self, Event, MoteNews, Shared};
use super::output::Sink;

/// Least time between two messages of one mote.
const EVERY: Duration = Duration::from_millis(100);
/// How long a report is held back where another gateway speaks for the mote: that one's next message is due, and another.
const HELD: Duration = Duration::from_millis(200);
/// And more, at random, so that of several one is the first; that alone where nobody speaks yet. They look every 50 ms.
const SCATTER: Duration = Duration::from_millis(300);
/// After so long a mote may have started anew: another gateway's last sequence no longer counts.
const FOREIGN: Duration = Duration::from_secs(5);
/// How long the broker may say nothing.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Messages that may wait for the network: a swarm's of a second.
const WAITING: usize = 16_384;
/// Bytes of a message at most, as MQTT has it (3.1.1, 2.2.3).
const LONGEST: usize = 268_435_455;
/// How long the last message may take.
const GOODBYE: Duration = Duration::from_secs(2);
/// How long after a broker was not there it is tried again.
const AGAIN: Duration = Duration::from_secs(1);

/// Where to publish.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Broker {
    /// Name or address.
    pub host: String,
    /// 1883 as a rule.
    pub port: u16,
    /// What topics begin with.
    pub prefix: String,
    /// What this gateway is called.
    pub gateway: String,
    /// Who it says it is, where the broker asks.
    pub login: Option<Login>,
}

/// A name and its password, which shows itself to nobody.
#[derive(Clone, PartialEq, Eq)]
pub struct Login {
    name: String,
    password: String,
}

impl Login {
    /// The password is the first line of a file.
    ///
    /// # Errors
    /// There is no such file, or nothing in its first line.
    pub fn read(name: &str, file: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
        let password = text.lines().next().unwrap_or_default();
        ensure!(!password.is_empty(), "{}:1: no password", file.display());
        Ok(Self { name: name.to_owned(), password: password.to_owned() })
    }
}

impl std::fmt::Debug for Login {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.name)
    }
}

/// Reads `HOST` or `HOST:PORT`.
///
/// # Errors
/// It is neither.
pub fn address(text: &str) -> Result<(String, u16), String> {
    let (host, port) = match text.rsplit_once(':') {
        None => (text, 1883),
        // An address of six has colons of its own.
        Some((host, port)) if !host.contains(':') || host.ends_with(']') => {
            (host, port.parse().map_err(|_| format!("{port:?} is no port"))?)
        }
        Some(_) => (text, 1883),
    };
    let host = host.trim_start_matches('[').trim_end_matches(']');
    if host.is_empty() { Err("names no host".to_owned()) } else { Ok((host.to_owned(), port)) }
}

/// What is published of a mote.
#[derive(Debug, Serialize)]
struct Payload<'a> {
    gateway: &'a str,
    time_unix_s: f64,
    #[serde(flatten)]
    mote: &'a MoteNews,
}

/// What is read of one, ours among them.
#[derive(Debug, Deserialize)]
struct Said {
    gateway: String,
    sequence: u16,
}

/// Who speaks for each topic.
type Speakers = Arc<Mutex<BTreeMap<String, Speaker>>>;

/// A gateway that speaks for a mote.
#[derive(Debug, Clone)]
struct Speaker {
    /// None for this one.
    gateway: Option<String>,
    /// What it said last.
    sequence: u16,
    said: Instant,
}

impl Speaker {
    /// Whether this was said already, or something after it.
    fn has_said(&self, sequence: u16) -> bool {
        self.said.elapsed() < FOREIGN && sequence.wrapping_sub(self.sequence).cast_signed() <= 0
    }
}

/// Whose: PAN, mote, twin.
type Whose = (u16, u16, u8);

/// A report that is held back.
#[derive(Debug, Clone, Copy)]
struct Held {
    sequence: u16,
    until: Instant,
}

/// How the line is; both its ends know it.
#[derive(Debug, Default)]
struct State {
    is_open: bool,
    /// It was, once.
    was_open: bool,
    /// Nothing more is to be said.
    is_over: bool,
    /// Why it is not open, if it has been tried.
    cause: Option<String>,
    /// How often it was lost.
    losses: u64,
    /// Messages that the broker took, or is about to.
    published: u64,
    /// Of these, what it has not handed back yet.
    under_way: u64,
    /// Messages that never came to it.
    undelivered: u64,
    /// What nobody should miss.
    alarms: Vec<String>,
}

impl State {
    /// What is under way will not come.
    fn give_up(&mut self) {
        let lost = std::mem::take(&mut self.under_way);
        self.published -= lost;
        self.undelivered += lost;
    }
}

/// A line to a broker.
pub struct Mqtt {
    broker: Broker,
    shared: Shared,
    client: Client,
    line: Option<JoinHandle<()>>,
    state: Arc<Mutex<State>>,
    speakers: Speakers,
    /// What is to be published next.
    news: BTreeSet<Whose>,
    /// What was due while the broker was away.
    overdue: BTreeSet<Whose>,
    held: BTreeMap<Whose, Held>,
    last: Instant,
    left_to_others: u64,
}

impl Mqtt {
    /// Begins to talk to a broker.
    ///
    /// # Errors
    /// The prefix or the name is none that a topic can have.
    pub fn open(broker: Broker, shared: Shared) -> Result<Self> {
        broker.check()?;
        let id = format!("{}-{}-{}", broker.prefix, broker.gateway, std::process::id());
        let mut options = MqttOptions::new(id, &broker.host, broker.port);
        options.set_keep_alive(KEEP_ALIVE);
        // What others put under the same prefix is none of ours, and no reason to hang up.
        options.set_max_packet_size(LONGEST, LONGEST);
        if let Some(Login { name, password }) = &broker.login {
            options.set_credentials(name, password);
        }
        options.set_last_will(LastWill::new(gateway_topic(&broker), "offline", QoS::AtLeastOnce, true));
        let (client, connection) = Client::new(options, WAITING);
        let state = Arc::<Mutex<State>>::default();
        let speakers = Speakers::default();
        let line =
            Line { broker: broker.clone(), client: client.clone(), state: state.clone(), speakers: speakers.clone() };
        let line = spawn(move || line.run(connection));
        Ok(Self {
            broker,
            shared,
            client,
            line: Some(line),
            state,
            speakers,
            news: BTreeSet::new(),
            overdue: BTreeSet::new(),
            held: BTreeMap::new(),
            last: Instant::now(),
            left_to_others: 0,
        })
    }

    fn is_open(&self) -> bool {
        lock(&self.state).is_open
    }

    /// Keeps what is due until the broker is back, and counts what that takes the place of.
    fn wait(&mut self) {
        // Who speaks for whom will have changed.
        self.news.extend(std::mem::take(&mut self.held).into_keys());
        if self.last.elapsed() < EVERY {
            return;
        }
        self.last = Instant::now();
        let news = std::mem::take(&mut self.news);
        let replaced = news.into_iter().filter(|whose| !self.overdue.insert(*whose)).count();
        lock(&self.state).undelivered += replaced as u64;
    }

    /// Publishes what is new, but for what another is to say.
    fn publish(&mut self) -> Result<()> {
        let mut news = std::mem::take(&mut self.news);
        news.append(&mut self.overdue);
        self.say(news.into_iter().map(|whose| (whose, None)))
    }

    /// Publishes what was held back long enough, but for what another has said meanwhile.
    fn release(&mut self) -> Result<()> {
        let now = Instant::now();
        let due: Vec<_> = self.held.extract_if(.., |_, held| held.until <= now).collect();
        self.say(due.into_iter().map(|(whose, held)| (whose, Some(held))))
    }

    fn say(&mut self, news: impl Iterator<Item = (Whose, Option<Held>)>) -> Result<()> {
        let time_unix_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let motes: Vec<(Whose, Option<Held>, MoteNews)> = {
            let swarm = model::lock(&self.shared);
            news.filter_map(|(whose, held)| {
                let (pan, mote, twin) = whose;
                Some((whose, held, swarm.mote(pan, mote, twin, 0)?))
            })
            .collect()
        };
        for (whose, held, mote) in &motes {
            let topic = format!("{}/{}", self.broker.prefix, mote.key);
            let speakers = self.speakers.lock().unwrap_or_else(PoisonError::into_inner);
            let speaker = speakers.get(&topic).cloned();
            drop(speakers);
            let has_said = |sequence| speaker.as_ref().is_some_and(|speaker| speaker.has_said(sequence));
            let is_ours = speaker.as_ref().is_some_and(|speaker| speaker.gateway.is_none());
            if !is_ours && has_said(mote.sequence) {
                self.left_to_others += 1;
                continue;
            }
            // Where another has said what was held back, it is about to say this too.
            if !is_ours && held.is_none_or(|held| has_said(held.sequence)) {
                let at_least = if speaker.is_some() { HELD } else { Duration::ZERO };
                let until = Instant::now() + at_least + SCATTER.mul_f64(fastrand::f64());
                self.held.insert(*whose, Held { sequence: mote.sequence, until });
                continue;
            }
            let payload = Payload { gateway: &self.broker.gateway, time_unix_s, mote };
            let payload = serde_json::to_vec(&payload).context("a mote that is no JSON")?;
            let mut state = lock(&self.state);
            if !state.is_open {
                // Only just: it is due again.
                self.news.insert(*whose);
            } else if self.client.try_publish(topic, QoS::AtMostOnce, true, payload).is_ok() {
                state.published += 1;
                state.under_way += 1;
            } else {
                state.undelivered += 1;
            }
        }
        Ok(())
    }
}

impl Broker {
    /// Whether topics can be made of it.
    ///
    /// # Errors
    /// What they cannot be made of.
    pub fn check(&self) -> Result<()> {
        for part in [&self.prefix, &self.gateway] {
            ensure!(!part.is_empty() && !part.contains(['#', '+', '\0']), "{part:?} cannot be part of a topic");
        }
        Ok(())
    }
}

impl std::fmt::Display for Broker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // An address of six has colons of its own.
        let Self { host, port, .. } = self;
        if host.contains(':') { write!(f, "broker [{host}]:{port}") } else { write!(f, "broker {host}:{port}") }
    }
}

fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits until it is so, for a while.
fn wait(is_so: impl Fn() -> bool) {
    let until = Instant::now() + GOODBYE;
    while !is_so() && Instant::now() < until {
        sleep(Duration::from_millis(10));
    }
}

fn gateway_topic(broker: &Broker) -> String {
    format!("{}/gateway/{}", broker.prefix, broker.gateway)
}

impl Sink for Mqtt {
    fn event(&mut self, event: &Event) -> Result<()> {
        let (Event::Fix(super::model::Fix { origin, .. }) | Event::Health(super::model::HealthNews { origin, .. })) =
            event
        else {
            return Ok(());
        };
        let whose = (origin.pan, origin.mote, origin.twin);
        if !self.held.contains_key(&whose) {
            self.news.insert(whose);
        }
        Ok(())
    }

    fn tick(&mut self) -> Result<()> {
        if !self.is_open() {
            self.wait();
            return Ok(());
        }
        self.release()?;
        if self.last.elapsed() < EVERY {
            return Ok(());
        }
        self.last = Instant::now();
        self.publish()
    }

    fn end(&mut self) -> Result<()> {
        let Some(line) = self.line.take() else { return Ok(()) };
        // A replay that is over at once is still published, if there is a broker.
        wait(|| self.is_open());
        lock(&self.state).is_over = true;
        let is_there = self.is_open();
        if is_there {
            // What is held back is said by another meanwhile, or by us.
            self.publish()?;
            let until = Instant::now() + GOODBYE;
            while !self.held.is_empty() && Instant::now() < until {
                sleep(Duration::from_millis(10));
                self.release()?;
            }
            wait(|| lock(&self.state).under_way == 0);
            let _ = self.client.try_publish(gateway_topic(&self.broker), QoS::AtLeastOnce, true, "offline");
            let _ = self.client.try_disconnect();
        }
        wait(|| line.is_finished());
        self.news.append(&mut self.overdue);
        self.news.extend(std::mem::take(&mut self.held).into_keys());
        let mut state = lock(&self.state);
        state.give_up();
        state.undelivered += std::mem::take(&mut self.news).len() as u64;
        let State { was_open, undelivered, cause, .. } = &*state;
        let cause = cause.as_deref().unwrap_or("no answer");
        ensure!(*was_open, "{} was never reached: {cause}; nothing was published", self.broker);
        ensure!(is_there, "{} went away and did not come back: {cause}; {undelivered} not delivered", self.broker);
        Ok(())
    }

    fn alarm(&mut self) -> Option<String> {
        let alarms = std::mem::take(&mut lock(&self.state).alarms);
        (!alarms.is_empty()).then(|| alarms.join("\n"))
    }

    fn note(&self) -> Option<String> {
        let State { is_open, was_open, is_over, cause, losses, published, undelivered, .. } = &*lock(&self.state);
        let how = match cause {
            _ if *is_open || *was_open && *is_over && self.line.is_none() => String::new(),
            Some(cause) if *was_open => format!(", lost: {cause}"),
            Some(cause) => format!(", not reached: {cause}"),
            None => ", not reached yet".to_owned(),
        };
        let losses = match losses {
            0 => String::new(),
            1 => ", lost once".to_owned(),
            losses => format!(", lost {losses} times"),
        };
        let (broker, left) = (&self.broker, self.left_to_others);
        Some(format!(
            "{broker}{how}: {published} published, {left} left to others, {undelivered} not delivered{losses}"
        ))
    }
}

impl Drop for Mqtt {
    fn drop(&mut self) {
        // Whoever waits for an error has called `end`.
        let _ = self.end();
    }
}

/// The other end of the queue: the network.
struct Line {
    broker: Broker,
    client: Client,
    state: Arc<Mutex<State>>,
    speakers: Speakers,
}

impl Line {
    fn run(self, mut connection: Connection) {
        while let Ok(said) = connection.recv() {
            match said {
                Ok(Wire::Incoming(Packet::ConnAck(_))) => self.opened(),
                Ok(Wire::Incoming(Packet::Publish(message))) => {
                    // What was there before says nothing of now.
                    if !message.retain
                        && let Ok(said) = serde_json::from_slice::<Said>(&message.payload)
                    {
                        self.heard(message.topic, said);
                    }
                }
                Ok(_) => {}
                Err(error) => {
                    let mut state = lock(&self.state);
                    if state.is_over {
                        if !std::mem::take(&mut state.is_open) {
                            state.cause = Some(cause(&error));
                        }
                        return;
                    }
                    self.closed(&mut state, &error);
                    // Of what waits in the queue only the newest counts, and that comes again.
                    connection.eventloop.clean();
                    drop(state);
                    sleep(AGAIN);
                }
            }
        }
    }

    fn opened(&self) {
        let _ = self.client.try_publish(gateway_topic(&self.broker), QoS::AtLeastOnce, true, "online");
        let _ = self.client.try_subscribe(format!("{}/+/+", self.broker.prefix), QoS::AtMostOnce);
        let mut state = lock(&self.state);
        (state.is_open, state.was_open) = (true, true);
        if state.cause.take().is_some() {
            state.alarms.push(format!("{}: is there", self.broker));
        }
    }

    fn closed(&self, state: &mut State, error: &ConnectionError) {
        let cause = cause(error);
        let what = if state.is_open { "lost" } else { "cannot be reached" };
        if state.cause.is_none() {
            state.alarms.push(format!(
                "{}: {what}: {cause}; it is tried again every {} s, and all else goes on",
                self.broker,
                AGAIN.as_secs()
            ));
        }
        state.losses += u64::from(state.is_open);
        state.give_up();
        state.is_open = false;
        state.cause = Some(cause);
    }
}

/// Why there is no broker, without the words of the crate around it.
fn cause(error: &ConnectionError) -> String {
    match error {
        ConnectionError::Io(error) => error.to_string(),
        ConnectionError::MqttState(rumqttc::StateError::Io(error)) => error.to_string(),
        ConnectionError::MqttState(error) => error.to_string(),
        ConnectionError::ConnectionRefused(code) => format!("it refuses this client: {code:?}"),
        ConnectionError::NetworkTimeout | ConnectionError::FlushTimeout => "no answer".to_owned(),
        other => other.to_string(),
    }
}

impl Line {
    /// Takes a message in the broker's order.
    fn heard(&self, topic: String, Said { gateway, sequence }: Said) {
        let gateway = (gateway != self.broker.gateway).then_some(gateway);
        if gateway.is_none() {
            let mut state = lock(&self.state);
            state.under_way = state.under_way.saturating_sub(1);
        }
        let mut speakers = self.speakers.lock().unwrap_or_else(PoisonError::into_inner);
        match speakers.get(&topic) {
            Some(speaker) if speaker.gateway != gateway && speaker.has_said(sequence) => return,
            None if speakers.len() >= model::MOTES => speakers.retain(|_, speaker| speaker.said.elapsed() < FOREIGN),
            _ => {}
        }
        speakers.insert(topic, Speaker { gateway, sequence, said: Instant::now() });
    }
}

#[cfg(test)]
mod tests {
    use super::address;

    #[test]
    fn a_broker_is_a_host_and_perhaps_a_port() {
        assert_eq!(address("desk"), Ok(("desk".into(), 1883)));
        assert_eq!(address("10.0.0.2:1884"), Ok(("10.0.0.2".into(), 1884)));
        assert_eq!(address("[::1]:1884"), Ok(("::1".into(), 1884)));
        assert_eq!(address("fe80::1"), Ok(("fe80::1".into(), 1883)));
        assert!(address("desk:door").is_err() && address(":1").is_err());
    }
}
