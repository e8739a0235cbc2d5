//! Frames from a capture: a file, a file that still grows, or a pipe.
//!
//! Both of Wireshark's formats are read, with the three link types in which IEEE 802.15.4 is captured: with its frame
//! check sequence, without it, and with a header of the sniffer's own before it.
//!
//! What can go wrong: bytes that are no capture, a capture of another network, an end in the middle of a frame. Each
//! complaint names the file.

use std::borrow::Cow;
use std::io::{Cursor, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use lighthouse_mote::frame::fcs;
use pcap_file::DataLink;
use pcap_file::pcap::PcapReader;
use pcap_file::pcapng::blocks::interface_description::InterfaceDescriptionOption;
use pcap_file::pcapng::{Block, PcapNgReader};

/// How a pcapng file begins.
const PCAPNG: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];
/// How long to wait before looking whether a file has grown.
const LOOK_AGAIN: Duration = Duration::from_millis(50);

/// One frame of a capture, with what the capture says of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Record<'a> {
    /// Since 1970, as the capture has it; a simple packet of pcapng has none.
    pub at: Option<Duration>,
    /// Which interface, by its name if it has one.
    pub interface: (u32, Option<&'a str>),
    /// The frame with its check sequence; none if the sniffer's own header makes no sense.
    pub frame: Option<Cow<'a, [u8]>>,
    /// Received power, dBm.
    pub rssi_dbm: Option<f32>,
    /// Link quality.
    pub lqi: Option<u8>,
}

/// Hands each frame, check sequence included, to `take` until that says `false` or the capture ends.
pub fn frames(name: &str, from: impl Read, mut take: impl FnMut(&[u8]) -> bool) -> Result<()> {
    // A frame whose sniffer stumbled is a frame lost.
    records(name, from, |record| record.frame.as_deref().is_none_or(&mut take))
}

/// The same with all that the capture says.
pub fn records(name: &str, mut from: impl Read, mut take: impl FnMut(&Record<'_>) -> bool) -> Result<()> {
    let mut magic = [0; 4];
    from.read_exact(&mut magic).with_context(|| format!("{name}: is too short for a capture"))?;
    let from = Cursor::new(magic).chain(from);
    if magic == PCAPNG {
        let mut reader = PcapNgReader::new(from).with_context(|| format!("{name}: cannot be read as pcapng"))?;
        let mut number = 0;
        while let Some(block) = reader.next_block() {
            number += 1;
            let block = block.with_context(|| format!("{name}: block {number}"))?.into_owned();
            let (id, ticks, data) = match block {
                Block::EnhancedPacket(packet) => (packet.interface_id, Some(packet.timestamp), packet.data),
                Block::SimplePacket(packet) => (0, None, packet.data),
                _ => continue,
            };
            let interface = reader
                .interfaces()
                .get(id as usize)
                .ok_or_else(|| anyhow!("{name}: block {number}: a frame of an interface nobody described"))?;
            let (mut called, mut resolution) = (None, MICROSECONDS);
            for option in &interface.options {
                match option {
                    InterfaceDescriptionOption::IfName(name) => called = Some(name.as_ref()),
                    InterfaceDescriptionOption::IfTsResol(power) => resolution = *power,
                    _ => {}
                }
            }
            // The crate takes every tick for a nanosecond.
            let at = ticks.map(|ticks| ticks_of(ticks.as_nanos(), resolution));
            let mut record = record(name, interface.linktype, &data)?;
            (record.at, record.interface) = (at, (id, called));
            if !take(&record) {
                break;
            }
        }
        return Ok(());
    }
    let mut reader = PcapReader::new(from).with_context(|| format!("{name}: is neither pcap nor pcapng"))?;
    let link = reader.header().datalink;
    let mut number = 0;
    while let Some(packet) = reader.next_packet() {
        number += 1;
        let packet = packet.with_context(|| format!("{name}: frame {number}"))?;
        let record = Record { at: Some(packet.timestamp), ..record(name, link, &packet.data)? };
        if !take(&record) {
            break;
        }
    }
    Ok(())
}

/// What pcapng's `if_tsresol` is where it is not given: 10^-6 s.
const MICROSECONDS: u8 = 6;

/// Ticks of 10^-resolution s, or of 2^-resolution s where the highest bit is set (pcapng, 4.2).
fn ticks_of(ticks: u128, resolution: u8) -> Duration {
    let power = i32::from(resolution & 0x7F);
    if resolution & 0x80 == 0 && power <= 9 {
        let each = 10u128.pow(9 - power.unsigned_abs());
        return Duration::from_nanos(u64::try_from(ticks * each).unwrap_or(u64::MAX));
    }
    let base: f64 = if resolution & 0x80 == 0 { 10.0 } else { 2.0 };
    Duration::try_from_secs_f64(ticks as f64 * base.powi(-power)).unwrap_or_default()
}

fn record<'a>(name: &str, link: DataLink, data: &'a [u8]) -> Result<Record<'a>> {
    let mut record = Record { at: None, interface: (0, None), frame: None, rssi_dbm: None, lqi: None };
    record.frame = match link {
        DataLink::IEEE802_15_4 => Some(Cow::Borrowed(data)),
        DataLink::IEEE802_15_4_NOFCS => Some(Cow::Owned(with_check(data))),
        DataLink::IEEE802_15_4_TAP => tap(data).map(|tap| {
            (record.rssi_dbm, record.lqi) = (tap.rssi_dbm, tap.lqi);
            if tap.has_check { Cow::Borrowed(tap.frame) } else { Cow::Owned(with_check(tap.frame)) }
        }),
        other => bail!("{name}: link type {other:?} is not IEEE 802.15.4 (195, 230 or 283)"),
    };
    Ok(record)
}

/// A frame and the check sequence that belongs to it.
#[must_use]
pub fn with_check(bytes: &[u8]) -> Vec<u8> {
    let mut frame = bytes.to_vec();
    frame.extend(fcs(bytes).to_le_bytes());
    frame
}

/// What stands behind a TAP header, and what that says.
struct Tap<'a> {
    frame: &'a [u8],
    has_check: bool,
    rssi_dbm: Option<f32>,
    lqi: Option<u8>,
}

/// Takes a TAP header apart (github.com/jkcko/ieee802.15.4-tap: version, length, then type-length-values; type 0 says
/// which check sequence, 1 the power in dBm as a float, 10 the link quality).
fn tap(data: &[u8]) -> Option<Tap<'_>> {
    let word = |at: usize| Some(usize::from(u16::from_le_bytes(data.get(at..at + 2)?.try_into().ok()?)));
    let length = word(2)?;
    let mut tap = Tap { frame: data.get(length..)?, has_check: false, rssi_dbm: None, lqi: None };
    let mut at = 4;
    while at + 4 <= length {
        let value = data.get(at + 4..).unwrap_or(&[]);
        match word(at)? {
            0 => tap.has_check = *value.first()? == 1,
            1 => tap.rssi_dbm = value.first_chunk().map(|bytes| f32::from_le_bytes(*bytes)),
            10 => tap.lqi = value.first().copied(),
            _ => {}
        }
        at += 4 + word(at + 2)?.next_multiple_of(4);
    }
    Some(tap)
}

/// A TAP header for a frame with its check sequence: the counterpart of `tap`.
#[must_use]
pub fn tap_header(rssi_dbm: Option<f32>, lqi: Option<u8>) -> Vec<u8> {
    let mut header = vec![0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0];
    if let Some(rssi_dbm) = rssi_dbm {
        header.extend([1, 0, 4, 0]);
        header.extend(rssi_dbm.to_le_bytes());
    }
    if let Some(lqi) = lqi {
        header.extend([10, 0, 1, 0, lqi, 0, 0, 0]);
    }
    let length = header.len() as u8;
    header[2] = length;
    header
}

/// Asks whoever reads a file that grows for its end as it is now.
#[derive(Debug, Default)]
pub struct EndOfNow {
    asked: AtomicU64,
    answered: AtomicU64,
}

impl EndOfNow {
    /// A question, by its number.
    pub fn ask(&self) -> u64 {
        self.asked.fetch_add(1, Ordering::AcqRel) + 1
    }

    /// Whether everything has been read that was there when it was asked.
    pub fn is_reached(&self, question: u64) -> bool {
        self.answered.load(Ordering::Acquire) >= question
    }
}

/// A file that may still grow: its end is a pause, until somebody says that it is enough.
#[derive(Debug)]
pub struct Growing<R> {
    from: R,
    end: Arc<EndOfNow>,
    enough: Arc<AtomicBool>,
}

impl<R: Read> Growing<R> {
    /// `end` answers at each pause; setting `enough` ends the waiting.
    pub fn new(from: R, end: Arc<EndOfNow>, enough: Arc<AtomicBool>) -> Self {
        Self { from, end, enough }
    }
}

impl<R: Read> Read for Growing<R> {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        loop {
            // Before looking: what is asked meanwhile may be of bytes that come after the look.
            let asked = self.end.asked.load(Ordering::Acquire);
            let count = self.from.read(bytes)?;
            if count > 0 || bytes.is_empty() || self.enough.load(Ordering::Relaxed) {
                return Ok(count);
            }
            self.end.answered.store(asked, Ordering::Release);
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::slice;

    use super::*;
    use crate::pcap::{self, Frame};

    fn read(bytes: &[u8]) -> Result<Vec<Vec<u8>>> {
        let mut out = Vec::new();
        frames("air.pcap", bytes, |frame| {
            out.push(frame.to_vec());
            true
        })?;
        Ok(out)
    }

    /// A classic capture of `data`, as another program would write it: big-endian, nanoseconds.
    fn foreign(link: u32, data: &[u8]) -> Vec<u8> {
        let length = data.len() as u32;
        let words = [0xA1B2_3C4D, 0x0002_0004, 0, 0, 65_535, link, 5, 6, length, length];
        let mut bytes: Vec<u8> = words.iter().flat_map(|word: &u32| word.to_be_bytes()).collect();
        bytes.extend(data);
        bytes
    }

    #[test]
    fn what_a_run_writes_is_read_back() {
        let all: Vec<Frame> = (0..3).map(|n| Frame { micros: n, bytes: vec![n as u8; 20] }).collect();
        let mut bytes = Vec::new();
        pcap::write(&all, &mut bytes).unwrap();
        assert_eq!(read(&bytes).unwrap(), all.into_iter().map(|frame| frame.bytes).collect::<Vec<_>>());
    }

    #[test]
    fn a_frame_without_its_check_sequence_gets_it_back() {
        let whole = pcap::tests::data_frame(7, b"light");
        let bare = &whole[..whole.len() - 2];
        assert_eq!(read(&foreign(195, &whole)).unwrap(), slice::from_ref(&whole));
        assert_eq!(read(&foreign(230, bare)).unwrap(), slice::from_ref(&whole));
        // Version 0, 12 bytes: check sequence of type 1, 16 bits, padded.
        let tap = [&[0, 0, 12, 0, 0, 0, 1, 0, 1, 0, 0, 0], &whole[..]].concat();
        assert_eq!(read(&foreign(283, &tap)).unwrap(), slice::from_ref(&whole));
        let tap = [&[0, 0, 12, 0, 0, 0, 1, 0, 0, 0, 0, 0], bare].concat();
        assert_eq!(read(&foreign(283, &tap)).unwrap(), [whole]);
        assert!(read(&foreign(283, &[0, 0, 60, 0, 1])).unwrap().is_empty());
    }

    #[test]
    fn a_capture_of_something_else_is_refused_by_name() {
        let said = format!("{:#}", read(&foreign(1, b"ethernet")).unwrap_err());
        assert!(said.starts_with("air.pcap: link type ETHERNET is not IEEE 802.15.4"), "{said}");
        for bytes in [&b"time_s,x_m\n0,1,2,3,4,5,6,7,8,9,0,1\n"[..], b"ab"] {
            let said = format!("{:#}", read(bytes).unwrap_err());
            assert!(said.starts_with("air.pcap: is "), "{said}");
        }
        let mut cut = foreign(195, b"a frame that ends too early");
        cut.truncate(cut.len() - 3);
        assert!(format!("{:#}", read(&cut).unwrap_err()).starts_with("air.pcap: frame 1"));
    }

    #[test]
    fn a_growing_file_is_read_on_until_it_is_enough() {
        use std::io::Write;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("air.pcap");
        let mut bytes = Vec::new();
        let all: Vec<Frame> = (0..2).map(|n| Frame { micros: n, bytes: vec![n as u8; 20] }).collect();
        pcap::write(&all, &mut bytes).unwrap();
        // The second frame comes in two parts, later.
        let half = bytes.len() - 10;
        std::fs::write(&path, &bytes[..half]).unwrap();
        let (end, enough) = (Arc::new(EndOfNow::default()), Arc::default());
        let growing = Growing::new(std::fs::File::open(&path).unwrap(), end.clone(), enough);
        let question = end.ask();
        let writer = std::thread::spawn(move || {
            while !end.is_reached(question) {
                std::thread::sleep(LOOK_AGAIN);
            }
            std::fs::OpenOptions::new().append(true).open(path).unwrap().write_all(&bytes[half..]).unwrap();
        });
        let mut seen = 0;
        frames("air.pcap", growing, |_| {
            seen += 1;
            seen < 2
        })
        .unwrap();
        writer.join().unwrap();
        assert_eq!(seen, 2);
    }
}
