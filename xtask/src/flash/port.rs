//! Which programmer is plugged in, and where.
//!
//! What can go wrong: none, several with nobody to ask, or a port that does not tell what is behind it. Each says what
//! to type.

use std::io::{BufRead, Write};
use std::path::Path;

use anyhow::{Result, bail};
use serialport::{SerialPortInfo, SerialPortType};

/// Who writes the SCuM-3C's memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Programmer {
    /// An nRF52840-DK with the firmware of scum-sdk's scum_programmer
    Nrf,
    /// A Teensy with the firmware of the SCuM test code
    Teensy,
}

impl std::fmt::Display for Programmer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Nrf => "nrf",
            Self::Teensy => "teensy",
        })
    }
}

/// SEGGER: the debugger on an nRF52840-DK, which also is its serial port.
pub const SEGGER: u16 = 0x1366;
/// PJRC's vendor number is shared by many, so the product counts too: Teensyduino's serial ports, alone (0x0483) or with
/// other interfaces.
const PJRC: u16 = 0x16C0;
const TEENSY_SERIAL: std::ops::RangeInclusive<u16> = 0x0483..=0x048C;

/// A programmer and its port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Which.
    pub programmer: Programmer,
    /// Where.
    pub port: String,
    /// The USB serial number, if it has one.
    serial: Option<String>,
}

/// The ports of this computer.
///
/// # Errors
/// The system does not tell.
pub fn all() -> Result<Vec<SerialPortInfo>> {
    // The crate takes this folder for granted.
    if cfg!(target_os = "linux") && !Path::new("/sys/class/tty").is_dir() {
        return Ok(Vec::new());
    }
    Ok(serialport::available_ports()?)
}

/// The programmers among `ports`, one port each.
#[must_use]
pub fn programmers(ports: &[SerialPortInfo]) -> Vec<Found> {
    first_of_each(boards(ports, which))
        .into_iter()
        .map(|Board { what, port, serial }| Found { programmer: what, port, serial })
        .collect()
}

/// A board on USB, and its port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Board<T> {
    /// Which kind.
    pub what: T,
    /// Where.
    pub port: String,
    /// The USB serial number, if it has one.
    pub serial: Option<String>,
}

/// The ports whose vendor and product `which` knows, in the order of their names.
pub fn boards<T>(ports: &[SerialPortInfo], which: impl Fn(u16, u16) -> Option<T>) -> Vec<Board<T>> {
    let mut found: Vec<Board<T>> = ports
        .iter()
        // macOS has every port twice; this is the one that waits for a modem to ring.
        .filter(|port| !port.port_name.starts_with("/dev/tty."))
        .filter_map(|port| {
            let SerialPortType::UsbPort(usb) = &port.port_type else { return None };
            let what = which(usb.vid, usb.pid)?;
            Some(Board { what, port: port.port_name.clone(), serial: usb.serial_number.clone() })
        })
        .collect();
    found.sort_by(|a, b| a.port.cmp(&b.port));
    found
}

/// Of a board that has two ports the first: a debugger's leads to the application, as scum-sdk has it.
#[must_use]
pub fn first_of_each<T>(found: Vec<Board<T>>) -> Vec<Board<T>> {
    let mut kept: Vec<Board<T>> = Vec::new();
    for one in found {
        if one.serial.is_none() || !kept.iter().any(|before| before.serial == one.serial) {
            kept.push(one);
        }
    }
    kept
}

fn which(vendor: u16, product: u16) -> Option<Programmer> {
    match vendor {
        SEGGER => Some(Programmer::Nrf),
        PJRC if TEENSY_SERIAL.contains(&product) => Some(Programmer::Teensy),
        _ => None,
    }
}

/// Decides: what was asked for, or what there is, or what the person at `input` says.
///
/// # Errors
/// Nothing fits, or there are several and `input` is `None` or says nothing useful.
pub fn choose(
    ports: &[SerialPortInfo],
    port: Option<&str>,
    programmer: Option<Programmer>,
    input: Option<&mut dyn BufRead>,
) -> Result<Found> {
    let there = programmers(ports);
    if let Some(port) = port {
        let known = boards(ports, which).into_iter().find(|board| board.port == port).map(|board| board.what);
        let Some(programmer) = programmer.or(known) else {
            bail!("{port} does not tell what is behind it: add --programmer nrf or --programmer teensy");
        };
        return Ok(Found { programmer, port: port.to_owned(), serial: None });
    }
    let fit: Vec<Found> =
        there.into_iter().filter(|found| programmer.is_none_or(|asked| asked == found.programmer)).collect();
    match &fit[..] {
        [] => {
            let others: Vec<&str> = ports.iter().map(|port| port.port_name.as_str()).collect();
            let among = if others.is_empty() { "none at all".to_owned() } else { others.join(", ") };
            let who = programmer.map_or(String::new(), |programmer| format!(" {programmer}"));
            bail!(
                "no{who} programmer found: neither a J-Link (USB 1366) nor a Teensy (USB 16c0:0483) among the serial \
                 ports ({among}); plug it in, or name its port with --port and --programmer"
            )
        }
        [one] => Ok(one.clone()),
        several => ask(several, input),
    }
}

fn ask(several: &[Found], input: Option<&mut dyn BufRead>) -> Result<Found> {
    let list: Vec<String> = several.iter().map(|found| format!("{} ({})", found.port, found.programmer)).collect();
    let Some(input) = input else {
        bail!("several programmers: {}; name one with --port", list.join(", "));
    };
    for (n, line) in list.iter().enumerate() {
        println!("  {}  {line}", n + 1);
    }
    print!("Which programmer? [1] ");
    std::io::stdout().flush()?;
    let mut answer = String::new();
    input.read_line(&mut answer)?;
    let answer = answer.trim();
    let chosen = if answer.is_empty() { Some(1) } else { answer.parse::<usize>().ok() };
    match chosen.and_then(|number| several.get(number.checked_sub(1)?)) {
        Some(found) => Ok(found.clone()),
        None => bail!("{answer:?} is none of 1 ..= {}", several.len()),
    }
}
