//! Frames from a capture: a file, a file that still grows, or a pipe.
//!
//! Both of Wireshark's formats are read, with the three link types in which IEEE 802.15.4 is captured: with its frame
//! check sequence, without it, and with a header of the sniffer's own before it.
//!
//! What can go wrong: bytes that are no capture, a capture of another network, an end in the middle of a frame, a length
//! that nobody would write: the reading ends there, and each complaint names the file. Where only what stands within a
//! block of pcapng makes no sense, that is a record without a frame, and the next block is read.

use std::borrow::Cow;
use std::io::{BufReader, Read};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use lighthouse_mote::frame::fcs;
use pcap_file::pcap::{PcapHeader, PcapParser};
use pcap_file::pcapng::blocks::{
    ENHANCED_PACKET_BLOCK, INTERFACE_DESCRIPTION_BLOCK, PACKET_BLOCK, SIMPLE_PACKET_BLOCK,
};
use pcap_file::{DataLink, Endianness, TsResolution};

/// How a pcapng file begins.
const PCAPNG: [u8; 4] = [0x0A, 0x0D, 0x0D, 0x0A];
/// Bytes of the classic format's header, and before each of its frames.
const HEADER: usize = 24;
const FRAME_HEADER: usize = 16;
/// The longest frame of any capture: libpcap's own limit. A length above is damage, and nobody waits for so many bytes.
const LONGEST_FRAME: usize = 1 << 18;
/// Bytes of a block with nothing in it, and of the longest: Wireshark's own limit.
const BLOCK: RangeInclusive<usize> = 12..=1 << 24;
/// What a section says in the order of its bytes.
const BYTE_ORDER: usize = 0x1A2B_3C4D;
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
pub fn records(name: &str, from: impl Read, take: impl FnMut(&Record<'_>) -> bool) -> Result<()> {
    let mut from = Bytes { from: BufReader::new(from), next: Vec::new() };
    ensure!(from.has(PCAPNG.len()).with_context(|| name.to_string())?, "{name}: is too short for a capture");
    if from.next == PCAPNG { blocks(name, from, take) } else { packets(name, from, take) }
}

/// What comes next.
struct Bytes<R> {
    from: BufReader<R>,
    next: Vec<u8>,
}

impl<R: Read> Bytes<R> {
    /// Reads until so many bytes are there; false where they end before.
    fn has(&mut self, count: usize) -> std::io::Result<bool> {
        let more = count.saturating_sub(self.next.len());
        self.from.by_ref().take(more as u64).read_to_end(&mut self.next)?;
        Ok(self.next.len() >= count)
    }

    /// The four at a place that is there.
    fn word(&self, at: usize, endianness: Endianness) -> usize {
        let bytes = self.next.get(at..at + 4).and_then(|bytes| bytes.first_chunk()).copied().unwrap_or_default();
        match endianness {
            Endianness::Big => u32::from_be_bytes(bytes) as usize,
            Endianness::Little => u32::from_le_bytes(bytes) as usize,
        }
    }
}

/// The classic format.
fn packets(name: &str, mut from: Bytes<impl Read>, mut take: impl FnMut(&Record<'_>) -> bool) -> Result<()> {
    ensure!(from.has(HEADER).with_context(|| name.to_string())?, "{name}: is neither pcap nor pcapng");
    let parsed = PcapParser::new(&from.next);
    let (_, parser) = parsed.with_context(|| format!("{name}: is neither pcap nor pcapng"))?;
    let PcapHeader { datalink, endianness, ts_resolution, .. } = parser.header();
    let each = match ts_resolution {
        TsResolution::MicroSecond => Duration::from_micros(1),
        TsResolution::NanoSecond => Duration::from_nanos(1),
    };
    for number in 1.. {
        let whole = || format!("{name}: frame {number}");
        from.next.clear();
        if !from.has(FRAME_HEADER).with_context(whole)? {
            ensure!(from.next.is_empty(), "{}: ends in the middle", whole());
            break;
        }
        let length = from.word(8, endianness);
        ensure!(length <= LONGEST_FRAME, "{}: {length} bytes, which no frame has", whole());
        ensure!(from.has(FRAME_HEADER + length).with_context(whole)?, "{}: ends in the middle", whole());
        let at = Duration::from_secs(from.word(0, endianness) as u64) + each * from.word(4, endianness) as u32;
        let mut record = record(name, datalink, &from.next[FRAME_HEADER..])?;
        record.at = Some(at);
        if !take(&record) {
            break;
        }
    }
    Ok(())
}

/// The newer one. A crate reads its blocks too, but refuses the whole capture for an option that it stumbles over
/// (pcap-file 2.0 over every `if_tzone`), so what is needed of a section and of an interface is read here.
fn blocks(name: &str, mut from: Bytes<impl Read>, mut take: impl FnMut(&Record<'_>) -> bool) -> Result<()> {
    let mut section = Section { endianness: Endianness::Little, interfaces: Vec::new() };
    for number in 1.. {
        let block = || format!("{name}: block {number}");
        if !from.has(*BLOCK.start()).with_context(block)? {
            ensure!(from.next.is_empty(), "{}: ends in the middle", block());
            break;
        }
        // A section says itself which end its numbers begin with.
        if from.next.starts_with(&PCAPNG) {
            let ends = [Endianness::Big, Endianness::Little];
            let said = ends.into_iter().find(|endianness| from.word(8, *endianness) == BYTE_ORDER);
            let endianness = said.with_context(|| format!("{}: cannot be read as pcapng", block()))?;
            section = Section { endianness, interfaces: Vec::new() };
        }
        let length = from.word(4, section.endianness);
        ensure!(BLOCK.contains(&length) && length.is_multiple_of(4), "{}: {length} bytes, which no block has", block());
        ensure!(from.has(length).with_context(block)?, "{}: ends in the middle", block());
        let again = from.word(length - 4, section.endianness);
        ensure!(again == length, "{}: {length} bytes in front and {again} behind", block());
        let kind = from.word(0, section.endianness) as u32;
        // Names, statistics and whatever will come are passed over.
        if kind == INTERFACE_DESCRIPTION_BLOCK {
            let interface = Interface::read(&from.next[8..length - 4], section.endianness);
            let interface = interface.with_context(|| format!("{}: an interface without a link type", block()))?;
            section.interfaces.push(interface);
        } else if matches!(kind, ENHANCED_PACKET_BLOCK | PACKET_BLOCK | SIMPLE_PACKET_BLOCK)
            && !take(&packet(name, &from, kind, &section)?)
        {
            break;
        }
        from.next.clear();
    }
    Ok(())
}

/// A part of a capture that one computer wrote.
struct Section {
    endianness: Endianness,
    interfaces: Vec<Interface>,
}

/// Where frames were captured (pcapng, 4.2).
struct Interface {
    link: DataLink,
    name: Option<String>,
    /// Of its times, as [`ticks_of`] takes it.
    resolution: u8,
    /// To be added to its times, seconds.
    offset_s: i64,
}

impl Interface {
    /// Reads the body of a block. Of its options only these are looked at: name, resolution, offset.
    fn read(body: &[u8], endianness: Endianness) -> Option<Self> {
        const NAME: u16 = 2;
        const RESOLUTION: u16 = 9;
        const OFFSET: u16 = 14;
        let half = |bytes: [u8; 2]| match endianness {
            Endianness::Big => u16::from_be_bytes(bytes),
            Endianness::Little => u16::from_le_bytes(bytes),
        };
        let (head, mut rest) = body.split_first_chunk::<8>()?;
        let link = DataLink::from(u32::from(half([head[0], head[1]])));
        let mut interface = Self { link, name: None, resolution: MICROSECONDS, offset_s: 0 };
        while let Some((&[a, b, c, d], behind)) = rest.split_first_chunk() {
            let (code, length) = (half([a, b]), usize::from(half([c, d])));
            let Some(value) = behind.get(..length) else { break };
            rest = behind.get(length.next_multiple_of(4)..).unwrap_or_default();
            match (code, value) {
                (0, _) => break,
                (NAME, name) => interface.name = Some(String::from_utf8_lossy(name).into_owned()),
                (RESOLUTION, [power]) => interface.resolution = *power,
                (OFFSET, bytes) => {
                    let Ok(bytes) = bytes.try_into() else { continue };
                    interface.offset_s = match endianness {
                        Endianness::Big => i64::from_be_bytes(bytes),
                        Endianness::Little => i64::from_le_bytes(bytes),
                    };
                }
                _ => {}
            }
        }
        Some(interface)
    }

    /// When that many of its ticks are, since 1970.
    fn at(&self, ticks: u64) -> Duration {
        let (at, offset) = (ticks_of(ticks, self.resolution), Duration::from_secs(self.offset_s.unsigned_abs()));
        if self.offset_s < 0 { at.saturating_sub(offset) } else { at.saturating_add(offset) }
    }
}

/// A block that holds a frame (pcapng, 4.3, 4.4 and appendix A), which is there to its end.
fn packet<'a>(name: &str, from: &'a Bytes<impl Read>, kind: u32, section: &'a Section) -> Result<Record<'a>> {
    let endianness = section.endianness;
    let word = |at| from.word(at, endianness);
    let body = &from.next[..from.next.len() - 4];
    // The simple one says how long the frame was on the air; what stands behind that fills the block.
    let (id, ticks, data) = match kind {
        SIMPLE_PACKET_BLOCK => (0, None, body.get(12..).map(|data| &data[..data.len().min(word(8))])),
        _ => (
            match (kind, endianness) {
                (PACKET_BLOCK, Endianness::Big) => word(8) >> 16,
                (PACKET_BLOCK, Endianness::Little) => word(8) & 0xFFFF,
                _ => word(8),
            },
            Some((word(12) as u64) << 32 | word(16) as u64),
            body.get(28..).and_then(|data| data.get(..word(20))),
        ),
    };
    let damaged = Record { at: None, interface: (id as u32, None), frame: None, rssi_dbm: None, lqi: None };
    let Some((data, interface)) = data.zip(section.interfaces.get(id)) else { return Ok(damaged) };
    let at = ticks.map(|ticks| interface.at(ticks));
    Ok(Record { at, interface: (id as u32, interface.name.as_deref()), ..record(name, interface.link, data)? })
}

/// What pcapng's `if_tsresol` is where it is not given: 10^-6 s.
const MICROSECONDS: u8 = 6;

/// Ticks of 10^-resolution s, or of 2^-resolution s where the highest bit is set (pcapng, 4.2).
fn ticks_of(ticks: u64, resolution: u8) -> Duration {
    let power = i32::from(resolution & 0x7F);
    if resolution & 0x80 == 0 && power <= 9 {
        let each = 10u64.pow(9 - power.unsigned_abs());
        return Duration::from_nanos(ticks.saturating_mul(each));
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
    use pcap_file::pcapng::blocks::SECTION_HEADER_BLOCK;
    use proptest::prelude::*;

    use super::*;

    fn read(bytes: &[u8]) -> Result<Vec<Vec<u8>>> {
        let mut out = Vec::new();
        frames("air.pcap", bytes, |frame| {
            out.push(frame.to_vec());
            true
        })?;
        Ok(out)
    }

    /// A data frame between short addresses.
    fn whole() -> Vec<u8> {
        with_check(b"\x41\x88\x07\xCD\xAB\xFF\xFF\x01\x00light")
    }

    /// A classic capture, as another program would write it: big-endian, nanoseconds.
    fn foreign(link: u32, frames: &[&[u8]]) -> Vec<u8> {
        let mut words = vec![0xA1B2_3C4D, 0x0002_0004, 0, 0, 65_535, link];
        let mut bytes = Vec::new();
        for data in frames {
            words.extend([5, 6, data.len() as u32, data.len() as u32]);
            bytes.extend(words.drain(..).flat_map(u32::to_be_bytes));
            bytes.extend(*data);
        }
        bytes
    }

    /// A block of pcapng, its body filled up to whole words.
    fn block(endianness: Endianness, kind: u32, words: &[u32], data: &[u8]) -> Vec<u8> {
        let bytes = |word: u32| if endianness == Endianness::Big { word.to_be_bytes() } else { word.to_le_bytes() };
        let length = (12 + 4 * words.len() + data.len().next_multiple_of(4)) as u32;
        let mut all: Vec<u8> = [kind, length].iter().chain(words).flat_map(|word| bytes(*word)).collect();
        all.extend(data);
        all.resize(length as usize - 4, 0);
        all.extend(bytes(length));
        all
    }

    /// A section with an interface of link type 195, as either kind of computer writes it.
    fn section(endianness: Endianness) -> Vec<u8> {
        section_with(endianness, &[])
    }

    /// The same with options of the interface.
    fn section_with(endianness: Endianness, options: &[(u16, &[u8])]) -> Vec<u8> {
        let (version, link) = if endianness == Endianness::Big { (1 << 16, 195 << 16) } else { (1, 195) };
        let head = block(endianness, SECTION_HEADER_BLOCK, &[BYTE_ORDER as u32, version, u32::MAX, u32::MAX], &[]);
        let half = |half: u16| if endianness == Endianness::Big { half.to_be_bytes() } else { half.to_le_bytes() };
        let mut bytes = Vec::new();
        for (code, value) in options {
            bytes.extend([half(*code), half(value.len() as u16)].concat());
            bytes.extend(*value);
            bytes.resize(bytes.len().next_multiple_of(4), 0);
        }
        [head, block(endianness, INTERFACE_DESCRIPTION_BLOCK, &[link, 0], &bytes)].concat()
    }

    #[test]
    fn a_frame_without_its_check_sequence_gets_it_back() {
        let whole = whole();
        let bare = &whole[..whole.len() - 2];
        assert_eq!(read(&foreign(195, &[&whole])).unwrap(), [&whole[..]]);
        assert_eq!(read(&foreign(230, &[bare])).unwrap(), [&whole[..]]);
        // Version 0, 12 bytes: check sequence of type 1, 16 bits, padded.
        let tap = [&[0, 0, 12, 0, 0, 0, 1, 0, 1, 0, 0, 0], &whole[..]].concat();
        assert_eq!(read(&foreign(283, &[&tap])).unwrap(), [&whole[..]]);
        let tap = [&[0, 0, 12, 0, 0, 0, 1, 0, 0, 0, 0, 0], bare].concat();
        assert_eq!(read(&foreign(283, &[&tap])).unwrap(), [whole]);
        assert!(read(&foreign(283, &[&[0, 0, 60, 0, 1]])).unwrap().is_empty());
    }

    #[test]
    fn a_capture_of_something_else_is_refused_by_name() {
        let said = format!("{:#}", read(&foreign(1, &[b"ethernet"])).unwrap_err());
        assert!(said.starts_with("air.pcap: link type ETHERNET is not IEEE 802.15.4"), "{said}");
        for bytes in [&b"time_s,x_m\n0,1,2,3,4,5,6,7,8,9,0,1\n"[..], b"ab", b"time_s"] {
            let said = format!("{:#}", read(bytes).unwrap_err());
            assert!(said.starts_with("air.pcap: is "), "{said}");
        }
        let mut cut = foreign(195, &[b"a frame that ends too early"]);
        cut.truncate(cut.len() - 3);
        assert!(format!("{:#}", read(&cut).unwrap_err()).starts_with("air.pcap: frame 1: ends"));
        assert!(format!("{:#}", read(&cut[..30]).unwrap_err()).starts_with("air.pcap: frame 1: ends"));
    }

    /// A pipe that stays open: whoever waits for more than was written waits for ever.
    struct Open<'a>(&'a [u8]);

    impl Read for Open<'_> {
        fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
            assert!(!self.0.is_empty(), "it waits");
            self.0.read(to)
        }
    }

    #[test]
    fn nobody_waits_for_a_length_that_cannot_be() {
        let mut classic = foreign(195, &[&whole(), &whole()]);
        let second = HEADER + FRAME_HEADER + whole().len();
        classic[second + 8..][..4].copy_from_slice(&0x4000_0000u32.to_be_bytes());
        let mut newer = section(Endianness::Little);
        let third = newer.len();
        newer.extend(block(Endianness::Little, ENHANCED_PACKET_BLOCK, &[0, 0, 0, 3, 3], b"abc"));
        for (bytes, at, says) in [
            (classic, None, "air: frame 2: 1073741824 bytes, which no frame has"),
            (newer.clone(), Some((third + 4, 0x0200_0000u32)), "air: block 3: 33554432 bytes, which no block has"),
            (newer.clone(), Some((third + 4, 8)), "air: block 3: 8 bytes, which no block has"),
            (newer, Some((third + 4, 32)), "air: block 3: 32 bytes in front and 6513249 behind"),
        ] {
            let mut bytes = bytes;
            if let Some((at, value)) = at {
                bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            }
            let error = records("air", Open(&bytes), |_| true).unwrap_err();
            assert!(format!("{error:#}").starts_with(says), "{error:#}");
        }
    }

    #[test]
    fn a_frame_longer_than_the_capture_keeps_is_a_frame_cut_short() {
        let mut bytes = foreign(195, &[&whole()]);
        // It keeps so many bytes, and the frame had more.
        bytes[16..20].copy_from_slice(&(whole().len() as u32).to_be_bytes());
        bytes[36..40].copy_from_slice(&100u32.to_be_bytes());
        assert_eq!(read(&bytes).unwrap(), [whole()]);
    }

    #[test]
    fn every_kind_of_block_with_a_frame_is_read_and_a_damaged_one_costs_itself() {
        let frame = &whole()[..];
        let length = frame.len() as u32;
        for endianness in [Endianness::Big, Endianness::Little] {
            let obsolete_id = if endianness == Endianness::Big { 0 } else { 0xABCD << 16 };
            let whole = |kind, words: &[u32]| block(endianness, kind, words, frame);
            let stream = [
                section(endianness),
                whole(ENHANCED_PACKET_BLOCK, &[0, 1, 2, length, length]),
                // Of an interface nobody described; longer than its block.
                whole(ENHANCED_PACKET_BLOCK, &[7, 1, 2, length, length]),
                whole(ENHANCED_PACKET_BLOCK, &[0, 1, 2, length + 4, length]),
                block(endianness, SIMPLE_PACKET_BLOCK, &[], &[]),
                block(endianness, 0x0BAD_0BAD, &[1, 2, 3], b"of the future"),
                whole(SIMPLE_PACKET_BLOCK, &[length]),
                whole(PACKET_BLOCK, &[obsolete_id, 1, 2, length, length]),
                // Another section, of another computer.
                section(if endianness == Endianness::Big { Endianness::Little } else { Endianness::Big }),
            ];
            let mut read = Vec::new();
            records("air", &stream.concat()[..], |record| {
                read.push((record.frame.as_deref().map(<[u8]>::to_vec), record.at));
                true
            })
            .unwrap();
            let at = Some(Duration::from_micros(1 << 32 | 2));
            let good = |at| (Some(frame.to_vec()), at);
            let bad = (None, None);
            assert_eq!(read, [good(at), bad.clone(), bad.clone(), bad, good(None), good(at)], "{endianness:?}");
        }
    }

    #[test]
    fn options_that_nobody_needs_are_passed_over_and_the_others_are_read_behind_them() {
        let frame = &whole()[..];
        let length = frame.len() as u32;
        for endianness in [Endianness::Big, Endianness::Little] {
            let long = |number: i64| match endianness {
                Endianness::Big => number.to_be_bytes(),
                Endianness::Little => number.to_le_bytes(),
            };
            let [ahead, behind] = [long(1000), long(-1)];
            // A time zone of four bytes (if_tzone), one of one, as some write it, and one of none; a speed that is none; a
            // text that is no text.
            let odd: [(u16, &[u8]); 5] = [(10, &[0, 0, 14, 16]), (10, &[1]), (10, &[]), (8, &[1, 2]), (3, b"\xFF\xFE")];
            let read = |options: &[(u16, &[u8])]| {
                let frame = block(endianness, ENHANCED_PACKET_BLOCK, &[0, 0, 7_000, length, length], frame);
                let mut read = Vec::new();
                records("air", &[section_with(endianness, options), frame].concat()[..], |record| {
                    let name = record.interface.1.map(str::to_owned);
                    read.push((name, record.at, record.frame.as_deref().map(<[u8]>::to_vec)));
                    true
                })
                .unwrap();
                let [(name, Some(at), Some(frame))] = &read[..] else { panic!("{read:?}") };
                assert_eq!(frame, &whole());
                (name.clone(), at.as_micros())
            };
            assert_eq!(read(&odd), (None, 7_000));
            let known: [(u16, &[u8]); 3] = [(2, b"roof"), (9, &[3]), (14, &ahead)];
            let roof = Some("roof".to_owned());
            assert_eq!(read(&[&odd[..], &known].concat()), (roof.clone(), 1_007_000_000));
            assert_eq!(read(&[&known[..2], &odd, &[(14, &behind)]].concat()), (roof.clone(), 6_000_000));
            // Nothing behind the end of the options counts, and an option that runs out of its block ends them.
            assert_eq!(read(&[known[0], (0, &[]), known[1]]), (roof.clone(), 7_000));
            assert_eq!(read(&[known[1], (14, &[0; 4])]), (None, 7_000_000));
        }
    }

    #[test]
    fn a_growing_file_is_read_on_until_it_is_enough() {
        use std::io::Write;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("air.pcap");
        let bytes = foreign(195, &[&whole(), &whole()]);
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

    proptest! {
        #[test]
        fn what_a_header_says_of_a_frame_is_read_back(
            rssi_dbm in prop::option::of(-128.0f32..127.0),
            lqi: Option<u8>,
            frame in prop::collection::vec(any::<u8>(), 0..128),
        ) {
            let data = [&tap_header(rssi_dbm, lqi)[..], &frame].concat();
            let record = record("air", DataLink::IEEE802_15_4_TAP, &data).unwrap();
            prop_assert_eq!((record.rssi_dbm, record.lqi), (rssi_dbm, lqi));
            prop_assert_eq!(record.frame.as_deref(), Some(&frame[..]));
        }
    }
}
