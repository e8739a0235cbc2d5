//! Every stage of the mote as a function by itself, for `cargo xtask bench` to call and count.
//!
//! Each `stage_*` function takes what the stage before left in memory, runs the library's code with the baked room, as
//! the firmware does, and leaves its own result. A stage is therefore counted with its loads and stores; `stage_empty`
//! is what a call costs without any stage. `reference_*` functions take the angles of `stage_fix`.
//!
//! The virtual mote calls these functions one by one, in an order made by its light. Run as a program, as QEMU does,
//! it walks through some of them with inputs of its own and prints how long that took, so that another's count of
//! instructions stands beside ours.
//!
//! What can go wrong: the compiler sees what a stage will be called with and computes less. Inputs and states are in
//! memory that functions with C names, callable by anybody, write.
#![no_std]
#![no_main]

mod reference;
mod timer;

use core::cell::UnsafeCell;
use core::hint::black_box;
use core::mem::MaybeUninit;

use cortex_m_rt::{ExceptionFrame, entry, exception};
use fixed::types::{I6F10, I16F16, U0F16};
use lighthouse_mote::angle::{self, Bearing};
use lighthouse_mote::chain::{Classifier, Flashes, Seen, Sighting, Solver};
use lighthouse_mote::edge::Edge;
use lighthouse_mote::fix::{self, Angle, Solution};
use lighthouse_mote::frame::secured::Key;
use lighthouse_mote::frame::{self, Aligned, Header, Level, Report};
use lighthouse_mote::pulse::{self, Pulse};
use lighthouse_mote::sweep::{self, Axis, HalfTurn, Light, Station, Sweep};
use lighthouse_mote::time::{Span, Ticks};
use lighthouse_mote::track;
use micromath::F32Ext;
use nalgebra::RealField;
use reference::Room;
use semihosting::{print, println};

use calib::{CONFIG, MOTE, PAN};

/// The room, as baked by build.rs.
mod calib {
    include!(concat!(env!("OUT_DIR"), "/calib.rs"));
}

/// Memory that the host also reads and writes, between two calls.
#[repr(transparent)]
pub struct Shared<T>(UnsafeCell<T>);

// SAFETY: one core, and nothing here runs in an interrupt.
unsafe impl<T> Sync for Shared<T> {}

impl<T> Shared<T> {
    /// # Safety
    /// No other reference to the content may be alive.
    #[allow(clippy::mut_from_ref, reason = "that is what the caller promises")]
    unsafe fn get(&self) -> &mut T {
        // SAFETY: as promised by the caller.
        unsafe { &mut *self.0.get() }
    }
}

/// Azimuth and elevation of station A, azimuth and elevation of station B: what `stage_fix` and the references solve.
#[unsafe(no_mangle)]
pub static ANGLES: Shared<[i32; 4]> = Shared(UnsafeCell::new([0; 4]));

/// What `stage_fix` found, x, y, z, Q16 m.
#[unsafe(no_mangle)]
pub static POSITION: Shared<[i32; 3]> = Shared(UnsafeCell::new([0; 3]));

/// What the latest reference found, x, y, z, m.
#[unsafe(no_mangle)]
pub static POINT: Shared<[f32; 3]> = Shared(UnsafeCell::new([0.0; 3]));

/// What lies between the stages, and their states.
struct Rig {
    pulse: Pulse,
    sweep: Sweep,
    bearing: Bearing,
    heading: track::Sweep,
    solution: Solution,
    sighting: Sighting,
    lit: Sighting,
    report: Report,
    frame: Aligned,
    counter: u32,
    pulses: pulse::State,
    sweeps: sweep::State,
    angles: angle::State,
    track: track::State,
    classifier: Classifier,
    solver: Solver,
    heard: Ticks,
    known: u8,
    room_f32: Room<f32>,
    room_f64: Room<f64>,
    /// Angles of [`POINTS`], for the program's own walk.
    walk: [[i32; 4]; POINTS.len()],
}

static RIG: Shared<MaybeUninit<Rig>> = Shared(UnsafeCell::new(MaybeUninit::uninit()));

fn rig() -> &'static mut Rig {
    // SAFETY: every function takes the rig once, and none calls another that does while it holds it; `reset` is the
    // first to be called.
    unsafe { RIG.get().assume_init_mut() }
}

/// Inside the room, within both stations' view, m.
const POINTS: [[f32; 3]; 8] = [
    [0.55, 1.0, 0.8],
    [0.30, 0.9, 0.6],
    [0.80, 1.2, 0.9],
    [0.40, 1.3, 1.0],
    [0.70, 0.8, 0.7],
    [0.25, 1.1, 0.9],
    [0.60, 1.0, 0.3],
    [0.50, 0.9, 0.5],
];

/// 8.333 ms at 10 MHz.
const HALF_TURN: u32 = 83_333;

fn nothing_seen() -> Sighting {
    Sighting { seen: Seen::Lost, flashes: Flashes::default(), pulses_lost: 0 }
}

/// Starts everything anew. To be called before anything else.
#[unsafe(no_mangle)]
pub extern "C" fn reset() {
    let half_turn = HalfTurn::from_ticks_q8(HALF_TURN << 8).unwrap_or_default();
    let at = Ticks(0);
    let walk = POINTS.map(seen_from_the_stations);
    // SAFETY: nobody else holds the rig.
    let rig = unsafe { RIG.get() }.write(Rig {
        pulse: Pulse { start: at, width: Span(0) },
        sweep: Sweep { station: Station::A, axis: Axis::Azimuth, at, since_sync: Span(0), half_turn },
        bearing: Bearing { station: Station::A, axis: Axis::Azimuth, angle: Angle(0), at, half_turn },
        heading: track::Sweep { station: Station::A, axis: Axis::Azimuth, angle: Angle(0), elapsed: 0 },
        solution: Solution { position: [0; 3], mismatch: 0 },
        sighting: nothing_seen(),
        lit: nothing_seen(),
        report: Report::default(),
        frame: Aligned::BLANK,
        counter: 0,
        pulses: pulse::State::default(),
        sweeps: sweep::State::default(),
        angles: angle::State::default(),
        track: track::State::default(),
        classifier: Classifier::default(),
        solver: Solver::default(),
        heard: at,
        known: 0,
        room_f32: Room::new(&CONFIG.room.stations),
        room_f64: Room::new(&CONFIG.room.stations),
        walk,
    });
    let start = POINTS[0].map(|axis| (axis * 65536.0) as i32);
    track::start(&CONFIG.track, &CONFIG.room, &mut rig.track, start, 0);
}

/// The angles under which the stations see a point.
fn seen_from_the_stations(point: [f32; 3]) -> [i32; 4] {
    let mut angles = [0; 4];
    for (pose, angles) in CONFIG.room.stations.iter().zip(angles.chunks_exact_mut(2)) {
        let away: [f32; 3] = core::array::from_fn(|k| point[k] - pose.position[k] as f32 / (1 << 24) as f32);
        let [right, up, ahead] =
            pose.axes.data.0.map(|axis| axis.iter().zip(away).map(|(entry, away)| *entry as f32 * away).sum::<f32>());
        for (angle, side) in angles.iter_mut().zip([right, up]) {
            *angle = (RealField::atan2(side, ahead) * ((1 << 20) as f32 / core::f32::consts::PI)) as i32;
        }
    }
    angles
}

/// Puts the inputs of step `step` of the program's own walk where the stages look for them.
///
/// Pulses are those of a mote half way through every sweep; everything else is of points one after another.
#[unsafe(no_mangle)]
#[inline(never)]
pub extern "C" fn prepare(step: u32) {
    let rig = rig();
    let (slot, which) = (step / 3, step % 3);
    let start = slot * HALF_TURN;
    let (rotor, elevation) = (slot & 3, slot & 1);
    // 10 ticks are 1 us; the flashes' widths and distance as in `lighthouse_mote::sweep`.
    let flash = |skips: bool| 625 + 104 * elevation + 417 * u32::from(skips);
    let (after, width) = match which {
        0 => (0, flash(rotor < 2)),
        1 => (4170, flash(rotor >= 2)),
        _ => (HALF_TURN / 2, 100),
    };
    rig.pulse = Pulse { start: Ticks(start + after), width: Span(width) };

    let station = if step & 2 == 0 { Station::B } else { Station::A };
    let axis = if step & 1 == 0 { Axis::Azimuth } else { Axis::Elevation };
    let rotor = 2 * station as usize + axis as usize;
    rig.sweep.station = station;
    rig.sweep.axis = axis;
    rig.sweep.at = Ticks(start);
    rig.sweep.since_sync = Span(HALF_TURN / 2 + (step & 0xff) * 37);

    let angles = &rig.walk[step as usize % POINTS.len()];
    // SAFETY: nobody else holds the angles.
    unsafe { *ANGLES.get() = *angles };
    rig.heading = track::Sweep { station, axis, angle: Angle(rig.walk[0][rotor]), elapsed: 256 };

    rig.report = Report {
        time: start,
        half_turn_q8: HALF_TURN << 8,
        position: angles.first_chunk().copied().unwrap_or_default().map(I16F16::from_bits),
        mismatch: U0F16::from_bits(step as u16),
        level: Level::Full,
        stations: 3,
        velocity: [I6F10::from_bits(step as i16); 3],
        ..Report::default()
    };
}

/// A call without a stage.
#[unsafe(no_mangle)]
pub extern "C" fn stage_empty(_: u32, _: u32) -> u32 {
    0
}

/// Both edges of a pulse, at these ticks; 1 when they made one.
#[unsafe(no_mangle)]
pub extern "C" fn stage_pulse(rise: u32, fall: u32) -> u32 {
    let rig = rig();
    let early = pulse::step(&mut rig.pulses, Edge::rise(Ticks(rise)));
    match pulse::step(&mut rig.pulses, Edge::fall(Ticks(fall))).or(early) {
        Some(pulse) => {
            rig.pulse = pulse;
            1
        }
        None => 0,
    }
}

/// The pulse; 0 when it says nothing, 1 a flash, 2 a laser, 3 the cycle was lost.
#[unsafe(no_mangle)]
pub extern "C" fn stage_sweep(_: u32, _: u32) -> u32 {
    let rig = rig();
    match sweep::step(&CONFIG.sweep, &mut rig.sweeps, rig.pulse) {
        None => 0,
        Some(Light::Sync(_)) => 1,
        Some(Light::Sweep(sweep)) => {
            rig.sweep = sweep;
            2
        }
        Some(Light::Lost) => 3,
    }
}

/// The laser; 1 when it is within view.
#[unsafe(no_mangle)]
pub extern "C" fn stage_angle(_: u32, _: u32) -> u32 {
    let rig = rig();
    match angle::step(&CONFIG.angle, &mut rig.angles, rig.sweep) {
        Some(bearing) => {
            rig.bearing = bearing;
            1
        }
        None => 0,
    }
}

/// Hands the bearing to fix and tracker; 1 when all four angles are known.
#[unsafe(no_mangle)]
pub extern "C" fn pass_on() -> u32 {
    let rig = rig();
    let Bearing { station, axis, angle, at, half_turn } = rig.bearing;
    let rotor = 2 * station as usize + axis as usize;
    // SAFETY: nobody else holds the angles.
    unsafe { ANGLES.get()[rotor] = angle.0 };
    rig.known |= 1 << rotor;
    let units = half_turn.share(at.since(rig.heard)) >> (sweep::HALF_TURN_BITS - track::PER_HALF_TURN.ilog2());
    rig.heard = at;
    rig.heading = track::Sweep { station, axis, angle, elapsed: units.min(u32::from(u16::MAX)) as u16 };
    u32::from(rig.known == 0xf)
}

/// Four angles to a position; 1 when there is one.
#[unsafe(no_mangle)]
pub extern "C" fn stage_fix(_: u32, _: u32) -> u32 {
    // SAFETY: nobody else holds either.
    let (angles, position) = unsafe { (ANGLES.get(), POSITION.get()) };
    match fix::solve(&CONFIG.fix.calib, &angles.map(Angle)) {
        Ok(solution) => {
            *position = solution.position;
            rig().solution.mismatch = solution.mismatch;
            1
        }
        Err(_) => 0,
    }
}

/// Starts the tracker from the latest fix; 1 when it does.
#[unsafe(no_mangle)]
pub extern "C" fn start_track() -> u32 {
    let rig = rig();
    // SAFETY: nobody else holds the position.
    let position = unsafe { *POSITION.get() };
    u32::from(track::start(&CONFIG.track, &CONFIG.room, &mut rig.track, position, rig.solution.mismatch))
}

/// The angle to the tracker; 0 when it was believed, 1 when there is no track, 2 otherwise.
#[unsafe(no_mangle)]
pub extern "C" fn stage_track(_: u32, _: u32) -> u32 {
    let rig = rig();
    track::step(&CONFIG.track, &CONFIG.room, &mut rig.track, &rig.heading) as u32
}

/// The firmware's first half at once: both edges of a pulse to a sighting; 1 when there is one.
#[unsafe(no_mangle)]
pub extern "C" fn stage_classify(rise: u32, fall: u32) -> u32 {
    let rig = rig();
    let early = rig.classifier.step(&CONFIG, Edge::rise(Ticks(rise)));
    match rig.classifier.step(&CONFIG, Edge::fall(Ticks(fall))).or(early) {
        Some(sighting) => {
            rig.sighting = sighting;
            1
        }
        None => 0,
    }
}

/// The firmware's second half at once: the sighting to a report; 1 when there is one.
#[unsafe(no_mangle)]
pub extern "C" fn stage_solve(_: u32, _: u32) -> u32 {
    let rig = rig();
    match rig.solver.step(&CONFIG, &rig.sighting) {
        Some(report) => {
            rig.report = report;
            1
        }
        None => 0,
    }
}

/// Makes the sighting one of nothing, so that the second half does no more than report.
#[unsafe(no_mangle)]
pub extern "C" fn darken() {
    let rig = rig();
    rig.lit = rig.sighting;
    if let Seen::Sweep(sweep) = rig.sighting.seen {
        rig.sighting.seen = Seen::Nothing { at: sweep.at, half_turn: sweep.half_turn };
    }
}

/// Makes the sighting what it was.
#[unsafe(no_mangle)]
pub extern "C" fn relight() {
    let rig = rig();
    rig.sighting = rig.lit;
}

/// The report to the bytes on the air.
#[unsafe(no_mangle)]
pub extern "C" fn stage_frame(_: u32, _: u32) -> u32 {
    let rig = rig();
    let header = Header { pan: PAN, mote: MOTE, sequence: rig.report.time as u16 };
    frame::emit_into(&mut rig.frame, header, &rig.report);
    rig.frame.bytes().len() as u32
}

/// The frame under the room's key, the cipher made for it; 1 when it was a plain one.
#[unsafe(no_mangle)]
pub extern "C" fn stage_seal(_: u32, _: u32) -> u32 {
    let rig = rig();
    rig.counter += 1;
    u32::from(Key::new(black_box(b"a room of its ow")).seal(&mut rig.frame, rig.counter))
}

/// A variance to a standard deviation.
#[unsafe(no_mangle)]
pub extern "C" fn stage_root(variance: u32, _: u32) -> u32 {
    track::square_root(variance.cast_signed()).cast_unsigned()
}

/// The same in single precision.
#[unsafe(no_mangle)]
pub extern "C" fn reference_root_f32(variance: u32, _: u32) -> u32 {
    F32Ext::sqrt(variance as f32) as u32
}

/// The paper's method in single precision; 1 when there is a position.
#[unsafe(no_mangle)]
pub extern "C" fn reference_svd_f32(_: u32, _: u32) -> u32 {
    // SAFETY: nobody else holds the angles.
    keep(rig().room_f32.by_singular_values(unsafe { *ANGLES.get() }))
}

/// The paper's method in double precision; 1 when there is a position.
#[unsafe(no_mangle)]
pub extern "C" fn reference_svd_f64(_: u32, _: u32) -> u32 {
    // SAFETY: nobody else holds the angles.
    let found = rig().room_f64.by_singular_values(unsafe { *ANGLES.get() });
    keep(found.map(|point| point.map(|axis| axis as f32)))
}

/// The normal equations in single precision; 1 when there is a position.
#[unsafe(no_mangle)]
pub extern "C" fn reference_normal_f32(_: u32, _: u32) -> u32 {
    // SAFETY: nobody else holds the angles.
    keep(rig().room_f32.by_normal_equations(unsafe { *ANGLES.get() }))
}

#[inline(always)]
fn keep(found: Option<[f32; 3]>) -> u32 {
    match found {
        Some(point) => {
            // SAFETY: nobody else holds the point.
            unsafe { *POINT.get() = point };
            1
        }
        None => 0,
    }
}

/// A function that is counted.
type Stage = extern "C" fn(u32, u32) -> u32;

/// What the program walks through, and in how many steps.
const WALK: [(&str, Stage, u32); 9] = [
    ("stage_pulse", stage_pulse, 1024),
    ("stage_sweep", stage_sweep, 1024),
    ("stage_angle", stage_angle, 1024),
    ("stage_fix", stage_fix, 1024),
    ("stage_track", stage_track, 1024),
    ("stage_frame", stage_frame, 1024),
    ("reference_svd_f32", reference_svd_f32, 16),
    ("reference_svd_f64", reference_svd_f64, 16),
    ("reference_normal_f32", reference_normal_f32, 64),
];

/// What the program itself does not call, so that the linker keeps it.
#[used]
static FOR_THE_HOST: ([extern "C" fn() -> u32; 2], [extern "C" fn(); 2], [Stage; 5]) = (
    [pass_on, start_track],
    [darken, relight],
    [stage_classify, stage_solve, stage_seal, stage_root, reference_root_f32],
);

/// Ticks that so many steps take.
#[inline(never)]
fn walk(stage: Stage, steps: u32) -> u32 {
    reset();
    let before = timer::now();
    for step in 0..steps {
        prepare(step);
        black_box(stage(step * 1000, step * 1000 + 500));
    }
    timer::now().wrapping_sub(before)
}

#[entry]
fn main() -> ! {
    timer::start();
    for (name, stage, steps) in WALK {
        let stage = black_box(stage);
        let (with, without) = (walk(stage, steps), walk(black_box(stage_empty), steps));
        println!("{name} {steps} {with} {without}");
    }
    semihosting::process::exit(0)
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    print!("panic\n");
    semihosting::process::exit(1)
}

// SAFETY: the handler touches no memory of the interrupted code; it ends the program.
#[exception]
unsafe fn HardFault(_: &ExceptionFrame) -> ! {
    semihosting::process::exit(2)
}
