//! Frames as a capture file that Wireshark opens.
//!
//! The classic format: a header that names the link type, then for each frame its time in
//! microseconds, its length and its bytes. Link type 195 is IEEE 802.15.4 with the frame check
//! sequence at the end, which is what a mote's radio sends.
//!
//! # What can go wrong
//! A frame longer than the 127 bytes of the radio cannot have been on air; it is refused.

use std::io::Write;

use anyhow::{Context, Result, ensure};

/// Marks the format, and with it the byte order and that times are in microseconds.
const MAGIC: u32 = 0xA1B2_C3D4;
/// LINKTYPE_IEEE802_15_4_WITHFCS.
const LINK_TYPE: u32 = 195;
/// The most a 2.4 GHz radio can send: aMaxPHYPacketSize.
const LONGEST: usize = 127;

/// A frame as it went on air.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Mote time at which it was sent, microseconds after boot.
    pub micros: u64,
    /// The frame from its frame control field to its check sequence.
    pub bytes: Vec<u8>,
}

/// Writes a capture of `frames` in their order.
pub fn write(frames: &[Frame], out: &mut impl Write) -> Result<()> {
    let mut bytes = Vec::new();
    bytes.extend(MAGIC.to_le_bytes());
    bytes.extend(2u16.to_le_bytes()); // version 2.4
    bytes.extend(4u16.to_le_bytes());
    bytes.extend([0; 8]); // time zone and accuracy, unused
    bytes.extend((LONGEST as u32).to_le_bytes());
    bytes.extend(LINK_TYPE.to_le_bytes());
    for (index, frame) in frames.iter().enumerate() {
        let length = frame.bytes.len();
        ensure!(length <= LONGEST, "frame {index} has {length} bytes; the radio sends {LONGEST}");
        let seconds = u32::try_from(frame.micros / 1_000_000).context("a frame after 136 years")?;
        bytes.extend(seconds.to_le_bytes());
        bytes.extend(((frame.micros % 1_000_000) as u32).to_le_bytes());
        bytes.extend((length as u32).to_le_bytes());
        bytes.extend((length as u32).to_le_bytes());
        bytes.extend(&frame.bytes);
    }
    out.write_all(&bytes)?;
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::process::Command;

    /// A data frame between short addresses with its check sequence (CRC-16 of ITU-T).
    pub(crate) fn data_frame(sequence: u8, payload: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0x41, 0x88, sequence, 0xCD, 0xAB, 0xFF, 0xFF, 0x01, 0x00];
        bytes.extend(payload);
        let fcs = bytes
            .iter()
            .fold(0u16, |crc, &byte| (0..8).fold(crc ^ u16::from(byte), |crc, _| (crc >> 1) ^ (0x8408 * (crc & 1))));
        bytes.extend(fcs.to_le_bytes());
        bytes
    }

    #[test]
    fn the_bytes_are_a_header_and_then_each_frame() {
        let frames = [Frame { micros: 3_000_007, bytes: vec![1, 2, 3] }];
        let mut out = Vec::new();
        write(&frames, &mut out).unwrap();
        assert_eq!(out.len(), 24 + 16 + 3);
        assert_eq!(out[..4], [0xD4, 0xC3, 0xB2, 0xA1]);
        assert_eq!(out[20..24], 195u32.to_le_bytes());
        assert_eq!(out[24..28], 3u32.to_le_bytes());
        assert_eq!(out[28..32], 7u32.to_le_bytes());
        assert_eq!(out[32..40], [3, 0, 0, 0, 3, 0, 0, 0]);
        assert_eq!(out[40..], [1, 2, 3]);
    }

    #[test]
    fn what_a_run_writes_is_read_back() {
        let all: Vec<Frame> = (0..3).map(|n| Frame { micros: n, bytes: vec![n as u8; 20] }).collect();
        let mut bytes = Vec::new();
        write(&all, &mut bytes).unwrap();
        let mut read = Vec::new();
        air::capture::records("air.pcap", &bytes[..], |record| {
            let micros = record.at.expect("a time").as_micros() as u64;
            read.push(Frame { micros, bytes: record.frame.as_deref().expect("a frame").to_vec() });
            true
        })
        .unwrap();
        assert_eq!(read, all);
    }

    #[test]
    fn a_frame_too_long_for_the_radio_is_refused() {
        let frames = [Frame { micros: 0, bytes: vec![0; 128] }];
        let error = write(&frames, &mut Vec::new()).unwrap_err();
        assert!(error.to_string().contains("128 bytes"), "{error}");
    }

    #[test]
    fn tshark_reads_the_frames_and_finds_their_check_sequences_right() {
        if Command::new("tshark").arg("--version").output().is_err() {
            eprintln!("skipped: tshark is not installed");
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("frames.pcap");
        let frames: Vec<Frame> =
            (0..5u8).map(|n| Frame { micros: u64::from(n) * 8_333, bytes: data_frame(n, b"a fix or so") }).collect();
        let mut file = std::fs::File::create(&path).unwrap();
        write(&frames, &mut file).unwrap();
        let fields = [
            "-T",
            "fields",
            "-e",
            "frame.time_relative",
            "-e",
            "wpan.seq_no",
            "-e",
            "wpan.fcs_ok",
            "-e",
            "wpan.dst_pan",
        ];
        let out = Command::new("tshark").arg("-r").arg(&path).args(fields).output().unwrap();
        let text = String::from_utf8(out.stdout).unwrap();
        let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split('\t').collect()).collect();
        assert_eq!(lines.len(), 5, "{text}");
        assert!(lines[3][0].starts_with("0.024999"), "{text}");
        assert_eq!(lines[3][1], "3");
        assert!(lines.iter().all(|l| l[2] == "1" || l[2].eq_ignore_ascii_case("true")), "{text}");
        assert_eq!(lines[0][3], "0xabcd", "{text}");
    }
}
