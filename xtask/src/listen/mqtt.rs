//! What is known of each mote, at a broker.
//!
//! One retained topic per mote, `PREFIX/PAN/MOTE`, so that whoever subscribes knows at once where everything is; and
//! `PREFIX/gateway/NAME` with `online` or `offline`, which the broker itself says when this program is killed.
//! `docs/listening.md` lists topic and payload.
//!
//! # Design
//! Several gateways may hear the same mote. Each listens to the topics that it writes, and keeps silent about a report
//! whose sequence another has published already, or a newer one: the fastest speaks, and when that one no longer hears
//! the mote the next does. Two that are equally fast may both say the same; it is the same topic and sequence.
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
/// After so long another gateway's last message no longer counts.
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

/// What is read of another gateway's.
#[derive(Debug, Deserialize)]
struct Foreign {
    gateway: String,
    sequence: u16,
}

/// Topics and what other gateways said there last.
type Others = Arc<Mutex<BTreeMap<String, (u16, Instant)>>>;

/// A line to a broker.
pub struct Mqtt {
    broker: Broker,
    shared: Shared,
    client: Client,
    line: Option<JoinHandle<()>>,
    is_open: Arc<AtomicBool>,
    over: Arc<AtomicBool>,
    others: Others,
    news: BTreeSet<(u16, u16, u8)>,
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
        let others = Others::default();
        let line = Line {
            broker: broker.clone(),
            client: client.clone(),
            is_open: is_open.clone(),
            over: over.clone(),
            others: others.clone(),
        };
        let line = spawn(move || line.run(connection));
        Ok(Self {
            broker,
            shared,
            client,
            line: Some(line),
            is_open,
            over,
            others,
            news: BTreeSet::new(),
            last: Instant::now(),
            published: 0,
            left_to_others: 0,
            dropped: Arc::default(),
        })
    }

    fn publish(&mut self) -> Result<()> {
        let time_unix_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let motes: Vec<MoteNews> = {
            let swarm = model::lock(&self.shared);
            let news = std::mem::take(&mut self.news);
            news.into_iter().filter_map(|(pan, mote, twin)| swarm.mote(pan, mote, twin, 0)).collect()
        };
        for mote in &motes {
            let topic = format!("{}/{}", self.broker.prefix, mote.key);
            let others = self.others.lock().unwrap_or_else(PoisonError::into_inner);
            let said = others.get(&topic).is_some_and(|(sequence, when)| {
                when.elapsed() < FOREIGN && sequence.wrapping_sub(mote.sequence).cast_signed() >= 0
            });
            drop(others);
            if said {
                self.left_to_others += 1;
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
        self.news.insert((origin.pan, origin.mote, origin.twin));
        Ok(())
    }

    fn tick(&mut self) -> Result<()> {
        if self.last.elapsed() < EVERY || !self.is_open.load(Ordering::Relaxed) {
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
            let _ = self.publish();
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
    others: Others,
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
                    if let Ok(foreign) = serde_json::from_slice::<Foreign>(&message.payload)
                        && foreign.gateway != self.broker.gateway
                        // What was there before says nothing of now.
                        && !message.retain
                    {
                        let mut others = self.others.lock().unwrap_or_else(PoisonError::into_inner);
                        if others.len() < model::MOTES || others.contains_key(&message.topic) {
                            others.insert(message.topic, (foreign.sequence, Instant::now()));
                        } else {
                            others.retain(|_, (_, when)| when.elapsed() < FOREIGN);
                        }
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
