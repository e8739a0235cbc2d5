//! The TS4231 from power-on to its watch state, over the two wires that later carry the light.
//!
//! Facts are those of its maker's data sheet and public configuration library. E and D are pulled up inside the chip and
//! driven by both ends, so nobody else may pull them. The levels say the state:
//!
//! | E | D | state |
//! |---|---|---|
//! | low | low | fresh from power-on; D goes high while it sees light |
//! | high | high | its configuration can be written |
//! | low | high | asleep |
//! | high | low | on watch; E goes low while it sees light, D follows the carrier |
//!
//! A transfer is a clock on E and data on D: D falls while E is high (start), one direction bit (0 writes), 14 bits, the
//! highest first, each taken as E rises; D rises while E is high (stop). A chip fresh from power-on listens only after
//! it has seen light once.
//!
//! What can go wrong: no light yet; a wire that is not there; a chip that reads back another word. Each is said, and
//! whoever called tries again.

/// Which way a wire is driven.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drive {
    /// To ground.
    Low,
    /// To the supply.
    High,
    /// Not by us.
    Released,
}

/// The two wires, and time.
pub trait Wires {
    /// Drives E.
    fn e(&mut self, drive: Drive);
    /// Drives D.
    fn d(&mut self, drive: Drive);
    /// Whether E and D are high.
    fn levels(&mut self) -> (bool, bool);
    /// Lets so many microseconds pass, or more.
    fn wait_us(&mut self, us: u32);
}

/// What the levels of the wires say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(target_os = "none", derive(defmt::Format))]
pub enum State {
    /// Has seen no light since power-on.
    Fresh,
    /// Its configuration can be written.
    Open,
    /// Asleep.
    Asleep,
    /// On watch.
    Watching,
    /// Every look said something else.
    Unclear,
}

/// Why there is no watch state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(target_os = "none", derive(defmt::Format))]
pub enum Failure {
    /// Fresh from power-on, and no light came.
    Dark,
    /// It did not open for configuration.
    Closed(State),
    /// It reads back this word.
    Word(u16),
    /// It was configured, but does not watch.
    NotWatching(State),
}

/// The configuration: 14 bits, the maker's value for Lighthouse light.
pub const WORD: u16 = 0x392b;
const BITS: u32 = 14;
/// From one level to the next, us: the library's.
const STEP_US: u32 = 1;
/// From one look at the wires to the next, us: longer than the longest flash, 135 us, so that one flash spoils one look.
const LOOK_US: u32 = 500;
/// What its analog part takes to wake, us.
const WAKE_US: u32 = 100;
/// How long to wait for a first light, in steps: 1 s, 360 flashes of two stations.
const LIGHT_STEPS: u32 = 1_000_000;

/// Takes the chip to its watch state.
pub fn start(wires: &mut impl Wires) -> Result<(), Failure> {
    release(wires);
    if state(wires) == State::Fresh && !light_came(wires) {
        return Err(Failure::Dark);
    }
    open(wires);
    let opened = state(wires);
    if opened != State::Open {
        return Err(Failure::Closed(opened));
    }
    write(wires, WORD);
    let word = read(wires);
    if word != WORD {
        return Err(Failure::Word(word));
    }
    watch(wires);
    match state(wires) {
        State::Watching => Ok(()),
        other => Err(Failure::NotWatching(other)),
    }
}

/// What two of three looks say: light comes when it likes and changes the levels.
pub fn state(wires: &mut impl Wires) -> State {
    let looks: [State; 3] = core::array::from_fn(|_| {
        let look = match wires.levels() {
            (false, false) => State::Fresh,
            (true, true) => State::Open,
            (false, true) => State::Asleep,
            (true, false) => State::Watching,
        };
        wires.wait_us(LOOK_US);
        look
    });
    let [first, second, third] = looks;
    if first == second || first == third {
        first
    } else if second == third {
        second
    } else {
        State::Unclear
    }
}

/// Waits for D to rise and to fall again.
fn light_came(wires: &mut impl Wires) -> bool {
    let mut lit = false;
    for _ in 0..LIGHT_STEPS {
        match wires.levels().1 {
            true => lit = true,
            false if lit => return true,
            false => {}
        }
        wires.wait_us(STEP_US);
    }
    false
}

/// Two clocks on E, then D from low to high.
fn open(wires: &mut impl Wires) {
    for _ in 0..2 {
        e(wires, Drive::Low);
        e(wires, Drive::High);
    }
    d(wires, Drive::Low);
    d(wires, Drive::High);
    release(wires);
}

fn write(wires: &mut impl Wires, word: u16) {
    begin(wires);
    send(wires, false);
    for bit in (0..BITS).rev() {
        send(wires, word >> bit & 1 != 0);
    }
    end(wires);
}

fn read(wires: &mut impl Wires) -> u16 {
    begin(wires);
    // D is let go of while E is still high: from the fall of E on, the chip drives it.
    d(wires, Drive::High);
    e(wires, Drive::High);
    d(wires, Drive::Released);
    e(wires, Drive::Low);
    let mut word = 0;
    for _ in 0..BITS {
        e(wires, Drive::High);
        word = word << 1 | u16::from(wires.levels().1);
        e(wires, Drive::Low);
    }
    end(wires);
    word
}

/// From the open state: E falls before D, and both are let go of, E last.
fn watch(wires: &mut impl Wires) {
    d(wires, Drive::High);
    e(wires, Drive::High);
    e(wires, Drive::Low);
    d(wires, Drive::Low);
    d(wires, Drive::Released);
    e(wires, Drive::High);
    e(wires, Drive::Released);
    wires.wait_us(WAKE_US);
}

/// Start.
fn begin(wires: &mut impl Wires) {
    e(wires, Drive::High);
    d(wires, Drive::High);
    d(wires, Drive::Low);
    e(wires, Drive::Low);
}

/// Stop.
fn end(wires: &mut impl Wires) {
    d(wires, Drive::Low);
    e(wires, Drive::High);
    d(wires, Drive::High);
    release(wires);
}

fn send(wires: &mut impl Wires, bit: bool) {
    d(wires, if bit { Drive::High } else { Drive::Low });
    e(wires, Drive::High);
    e(wires, Drive::Low);
}

fn release(wires: &mut impl Wires) {
    e(wires, Drive::Released);
    d(wires, Drive::Released);
}

fn e(wires: &mut impl Wires, drive: Drive) {
    wires.e(drive);
    wires.wait_us(STEP_US);
}

fn d(wires: &mut impl Wires, drive: Drive) {
    wires.d(drive);
    wires.wait_us(STEP_US);
}
