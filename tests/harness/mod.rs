//! What a test needs on the emulated Cortex-M0: a log, a panic that ends the run, a fault that does not hang.
//!
//! What can go wrong: a fault without a handler spins for ever, and a panic printed as plain text would land in the
//! middle of the binary log. So both end the run with an exit code of their own, and the panic speaks through the log.

// Brings the critical section that the log is written in.
use cortex_m as _;
use cortex_m_rt::ExceptionFrame;
use defmt_semihosting as _;
use semihosting::process::exit;

/// Exit code after a failed assertion.
const PANICKED: i32 = 1;
/// Exit code after a fault: an unaligned access, a stack that ran into the vectors, an instruction of a larger core.
const FAULTED: i32 = 2;

#[panic_handler]
fn panic(info: &core::panic::PanicInfo) -> ! {
    defmt::error!("{}", defmt::Display2Format(info));
    exit(PANICKED)
}

/// `defmt::panic!` has logged its message before it comes here.
#[defmt::panic_handler]
fn defmt_panic() -> ! {
    exit(PANICKED)
}

#[cortex_m_rt::exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    defmt::error!("fault at {=u32:#x}, called from {=u32:#x}", frame.pc(), frame.lr());
    exit(FAULTED)
}
