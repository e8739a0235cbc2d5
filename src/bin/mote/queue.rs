//! A queue from one priority to another whose oldest entry is used where it lies.
//!
//! The transmitter sends a frame right out of it. A general queue copies once more, puts barriers around its indices
//! and divides by its length, for which the core has no instruction.
//!
//! The counts are compared modulo twice the length, so that a count that is wrong, for a bit of it has flipped, is a few
//! entries lost or read again and not four thousand million.
//!
//! What can go wrong: the queue is full; the writer is told, and drops what it has.

use core::cell::UnsafeCell;
use core::mem::MaybeUninit;
use core::sync::atomic::{AtomicU32, Ordering, compiler_fence};

use lighthouse_mote::frame::Aligned;

/// Room for `N` entries, a power of two.
#[repr(C)]
pub struct Queue<T, const N: usize> {
    /// Entries ever written, wrapping. The writer's.
    written: AtomicU32,
    /// Entries ever read, wrapping. The reader's.
    read: AtomicU32,
    /// The most that ever waited. The writer's.
    most: AtomicU32,
    entries: UnsafeCell<[MaybeUninit<T>; N]>,
}

// SAFETY: `split` makes one writer and one reader. Entries from `read` up to `written` are the reader's, all others the
// writer's; each moves its own count only when it is done with an entry, and the fences keep the compiler to that
// order. On one core the order of the instructions is the order of the accesses.
unsafe impl<T: Send, const N: usize> Sync for Queue<T, N> {}

/// What may be made of zeros.
///
/// # Safety
/// All bytes zero are a value of it.
pub unsafe trait Zeros {}

// SAFETY: it is bytes, and any will do.
unsafe impl Zeros for Aligned {}

/// The writer's end.
pub struct Writer<T: 'static, const N: usize>(&'static Queue<T, N>);

/// The reader's end.
pub struct Reader<T: 'static, const N: usize>(&'static Queue<T, N>);

impl<T: Copy, const N: usize> Queue<T, N> {
    /// Empty.
    pub const fn new() -> Self {
        const { assert!(N.is_power_of_two(), "the index is a mask") };
        let entries = UnsafeCell::new([const { MaybeUninit::zeroed() }; N]);
        Self { written: AtomicU32::new(0), read: AtomicU32::new(0), most: AtomicU32::new(0), entries }
    }

    /// The two ends.
    pub fn split(&'static mut self) -> (Writer<T, N>, Reader<T, N>) {
        (Writer(self), Reader(self))
    }

    /// Entries written and not yet read; more than `N` only where a count is wrong.
    #[inline(always)]
    fn waiting(&self) -> u32 {
        Self::between(self.read.load(Ordering::Relaxed), self.written.load(Ordering::Relaxed))
    }

    #[inline(always)]
    fn between(read: u32, written: u32) -> u32 {
        written.wrapping_sub(read) % (2 * N as u32)
    }

    #[inline(always)]
    fn entry(&self, count: u32) -> *mut MaybeUninit<T> {
        // SAFETY: the remainder is below `N`.
        unsafe { self.entries.get().cast::<MaybeUninit<T>>().add(count as usize % N) }
    }
}

impl<T: Copy, const N: usize> Writer<T, N> {
    /// The most entries that ever waited.
    pub fn most(&self) -> u8 {
        self.0.most.load(Ordering::Relaxed) as u8
    }

    /// Whether there is no room.
    pub fn is_full(&self) -> bool {
        self.0.waiting() >= N as u32
    }

    /// Appends `entry`; false where there is no room for it.
    #[inline(always)]
    #[must_use]
    pub fn push(&mut self, entry: T) -> bool {
        self.place().map(|place| place.put(entry)).is_some()
    }

    /// The place of the next entry, if there is room for it.
    #[inline(always)]
    pub fn place(&mut self) -> Option<Place<'_, T, N>> {
        let written = self.0.written.load(Ordering::Relaxed);
        let waiting = Queue::<T, N>::between(self.0.read.load(Ordering::Relaxed), written);
        if waiting >= N as u32 {
            return None;
        }
        if waiting >= self.0.most.load(Ordering::Relaxed) {
            self.0.most.store(waiting + 1, Ordering::Relaxed);
        }
        compiler_fence(Ordering::Acquire);
        Some(Place { queue: self, written })
    }

    /// Appends what `fill` makes of an old entry or of zeros; false where there is no room for it.
    #[inline(always)]
    #[must_use]
    pub fn fill(&mut self, fill: impl FnOnce(&mut T)) -> bool
    where
        T: Zeros,
    {
        // SAFETY: the place holds what was once written to it or, before that, zeros, which are a value as `Zeros` says.
        self.place().map(|place| place.write(|place| fill(unsafe { place.assume_init_mut() }))).is_some()
    }
}

/// Where there is room for an entry.
pub struct Place<'a, T: 'static, const N: usize> {
    queue: &'a mut Writer<T, N>,
    written: u32,
}

impl<T: Copy, const N: usize> Place<'_, T, N> {
    /// Appends `entry`.
    #[inline(always)]
    pub fn put(self, entry: T) {
        self.write(|place| {
            place.write(entry);
        });
    }

    /// Appends what `write` leaves in its place, which is to be a value.
    #[inline(always)]
    fn write(self, write: impl FnOnce(&mut MaybeUninit<T>)) {
        let Self { queue: Writer(queue), written } = self;
        // SAFETY: not between `read` and `written`, so the writer's, and there is one writer, borrowed.
        write(unsafe { &mut *queue.entry(written) });
        compiler_fence(Ordering::Release);
        queue.written.store(written.wrapping_add(1), Ordering::Relaxed);
    }
}

impl<T: Copy, const N: usize> Reader<T, N> {
    /// The most entries that ever waited.
    pub fn most(&self) -> u8 {
        self.0.most.load(Ordering::Relaxed) as u8
    }

    /// Whether more than one waits.
    pub fn has_several(&self) -> bool {
        self.0.waiting() > 1
    }

    /// The oldest entry.
    #[inline(always)]
    pub fn oldest(&self) -> Option<&T> {
        let read = self.0.read.load(Ordering::Relaxed);
        if Queue::<T, N>::between(read, self.0.written.load(Ordering::Relaxed)) == 0 {
            return None;
        }
        compiler_fence(Ordering::Acquire);
        // SAFETY: between `read` and `written`, so it was written, and nobody writes it before `pop`, which borrows.
        Some(unsafe { (*self.0.entry(read)).assume_init_ref() })
    }

    /// Is done with the oldest entry, if there is one.
    #[inline(always)]
    pub fn pop(&mut self) {
        let read = self.0.read.load(Ordering::Relaxed);
        if Queue::<T, N>::between(read, self.0.written.load(Ordering::Relaxed)) != 0 {
            compiler_fence(Ordering::Release);
            self.0.read.store(read.wrapping_add(1), Ordering::Relaxed);
        }
    }
}
