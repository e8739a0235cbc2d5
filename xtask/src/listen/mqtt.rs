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
//! What can go wrong: no broker, or one that goes away. It is tried again every second, and what happened meanwhile is
//! not sent late: only the newest counts.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};
use rumqttc::{Client, Connection, Event as Wire, LastWill, MqttOptions, Packet, QoS};
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
/// How long the last message may take.
const GOODBYE: Duration = Duration::from_secs(2);

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

/// A line to a broker.
pub struct Mqtt {
    broker: Broker,
    shared: Shared,
    client: Client,
    line: Option<JoinHandle<()>>,
    is_open: Arc<AtomicBool>,
    over: Arc<AtomicBool>,
    speakers: Speakers,
    news: BTreeSet<Whose>,
    held: BTreeMap<Whose, Held>,
    last: Instant,
    published: u64,
    left_to_others: u64,
    dropped: Arc<AtomicU64>,
}

impl Mqtt {
    /// Begins to talk to a broker.
    ///
    /// # Errors
    /// The prefix or the name is none that a topic can have.
    pub fn open(broker: Broker, shared: Shared) -> Result<Self> {
        for part in [&broker.prefix, &broker.gateway] {
            if part.is_empty() || part.contains(['#', '+', '\0']) {
                bail!("{part:?} cannot be part of a topic");
            }
        }
        let id = format!("{}-{}-{}", broker.prefix, broker.gateway, std::process::id());
        let mut options = MqttOptions::new(id, &broker.host, broker.port);
        options.set_keep_alive(KEEP_ALIVE);
        options.set_last_will(LastWill::new(gateway_topic(&broker), "offline", QoS::AtLeastOnce, true));
        let (client, connection) = Client::new(options, WAITING);
        let is_open = Arc::new(AtomicBool::new(false));
        let over = Arc::new(AtomicBool::new(false));
        let speakers = Speakers::default();
        let line = Line {
            broker: broker.clone(),
            client: client.clone(),
            is_open: is_open.clone(),
            over: over.clone(),
            speakers: speakers.clone(),
        };
        let line = spawn(move || line.run(connection));
        Ok(Self {
            broker,
            shared,
            client,
            line: Some(line),
            is_open,
            over,
            speakers,
            news: BTreeSet::new(),
            held: BTreeMap::new(),
            last: Instant::now(),
            published: 0,
            left_to_others: 0,
            dropped: Arc::default(),
        })
    }

    /// Publishes what is new, but for what another is to say.
    fn publish(&mut self) -> Result<()> {
        let news = std::mem::take(&mut self.news);
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
            match self.client.try_publish(topic, QoS::AtMostOnce, true, payload) {
                Ok(()) => self.published += 1,
                Err(_) => {
                    self.dropped.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
        Ok(())
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
        if !self.is_open.load(Ordering::Relaxed) {
            return Ok(());
        }
        self.release()?;
        if self.last.elapsed() < EVERY {
            return Ok(());
        }
        self.last = Instant::now();
        self.publish()
    }

    fn note(&self) -> Option<String> {
        let Broker { host, port, .. } = &self.broker;
        let state = if self.is_open.load(Ordering::Relaxed) { "" } else { ": not there" };
        let dropped = self.dropped.load(Ordering::Relaxed);
        let (published, left) = (self.published, self.left_to_others);
        Some(format!("broker {host}:{port}{state}, {published} published, {left} left to others, {dropped} dropped"))
    }
}

impl Drop for Mqtt {
    fn drop(&mut self) {
        // A replay that is over at once is still published, if there is a broker.
        let until = Instant::now() + GOODBYE;
        while !self.is_open.load(Ordering::Relaxed) && Instant::now() < until {
            sleep(Duration::from_millis(10));
        }
        self.over.store(true, Ordering::Relaxed);
        if self.is_open.load(Ordering::Relaxed) {
            let until = Instant::now() + GOODBYE;
            // What is held back is said by another meanwhile, or by us.
            let _ = self.publish();
            while self.release().is_ok() && !self.held.is_empty() && Instant::now() < until {
                sleep(Duration::from_millis(10));
            }
            let _ = self.client.try_publish(gateway_topic(&self.broker), QoS::AtLeastOnce, true, "offline");
            let _ = self.client.try_disconnect();
        }
        let until = Instant::now() + GOODBYE;
        while let Some(line) = &self.line
            && !line.is_finished()
            && Instant::now() < until
        {
            sleep(Duration::from_millis(10));
        }
    }
}

/// The other end of the queue: the network.
struct Line {
    broker: Broker,
    client: Client,
    is_open: Arc<AtomicBool>,
    over: Arc<AtomicBool>,
    speakers: Speakers,
}

impl Line {
    fn run(self, mut connection: Connection) {
        for said in connection.iter() {
            match said {
                Ok(Wire::Incoming(Packet::ConnAck(_))) => {
                    let _ = self.client.try_publish(gateway_topic(&self.broker), QoS::AtLeastOnce, true, "online");
                    let _ = self.client.try_subscribe(format!("{}/+/+", self.broker.prefix), QoS::AtMostOnce);
                    self.is_open.store(true, Ordering::Relaxed);
                }
                Ok(Wire::Incoming(Packet::Publish(message))) => {
                    // What was there before says nothing of now.
                    if !message.retain
                        && let Ok(said) = serde_json::from_slice::<Said>(&message.payload)
                    {
                        self.heard(message.topic, said);
                    }
                }
                Ok(_) => {}
                Err(_) => {
                    self.is_open.store(false, Ordering::Relaxed);
                    if self.over.load(Ordering::Relaxed) {
                        return;
                    }
                    sleep(Duration::from_secs(1));
                }
            }
        }
    }
}

impl Line {
    /// Takes a message in the broker's order.
    fn heard(&self, topic: String, Said { gateway, sequence }: Said) {
        let gateway = (gateway != self.broker.gateway).then_some(gateway);
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
