//! Vectors and reset.

use crate::{console, exceptions, faults};

unsafe extern "C" {
    static _stack_top: u32;
}

/// One entry of the vector table.
#[derive(Clone, Copy)]
#[repr(C)]
pub union Vector {
    stack: *const u32,
    handler: unsafe extern "C" fn(),
    reset: unsafe extern "C" fn() -> !,
    reserved: u32,
}

// SAFETY: the table is only read, and only by the core.
unsafe impl Sync for Vector {}

#[unsafe(link_section = ".vectors")]
#[unsafe(no_mangle)]
static VECTORS: [Vector; 48] = {
    let mut table = [Vector { reserved: 0 }; 48];
    table[0] = Vector { stack: &raw const _stack_top };
    table[1] = Vector { reset: Reset };
    table[3] = Vector { handler: faults::hard_fault };
    table[11] = Vector { handler: exceptions::supervisor_call };
    table[14] = Vector { handler: exceptions::interrupt };
    table[15] = Vector { handler: exceptions::interrupt };
    let mut n = 16;
    while n < 48 {
        table[n] = Vector { handler: exceptions::interrupt };
        n += 1;
    }
    table
};

#[unsafe(no_mangle)]
unsafe extern "C" fn Reset() -> ! {
    crate::main()
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo) -> ! {
    console::say("panic", &[]);
    console::exit(101)
}
