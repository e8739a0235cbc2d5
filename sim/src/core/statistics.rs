//! What was measured of every exception.
//!
//! Latency and length of the handlers decide whether an edge is seen in time; they cost nothing to keep, because they
//! change only when an exception is entered or left.
//!
//! What can go wrong: latency counts from the moment the exception became pending, so an interrupt that pended while
//! disabled shows the time it was disabled.

use super::nvic::EXCEPTIONS;

/// The record of one exception number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ExceptionRecord {
    /// How often it was entered.
    pub count: u64,
    /// The longest time from pending to the first instruction of the handler, in cycles.
    pub worst_latency: u64,
    /// The longest time from the first instruction of the handler to the end of its last, in cycles, without the
    /// exceptions that preempted it.
    pub worst_own_cycles: u64,
    /// The sum of those times over all entries.
    pub total_own_cycles: u64,
}

#[derive(Debug, Clone, Copy)]
struct Running {
    number: u8,
    preparing_since: u64,
    running_since: u64,
    preempted: u64,
}

/// The records of all exceptions.
#[derive(Debug, Clone)]
pub struct Statistics {
    records: [ExceptionRecord; EXCEPTIONS],
    running: Vec<Running>,
}

impl Default for Statistics {
    fn default() -> Self {
        Self { records: [ExceptionRecord::default(); EXCEPTIONS], running: Vec::new() }
    }
}

impl Statistics {
    /// The record of exception `number`; external line n has number 16 + n.
    pub fn of(&self, number: u8) -> &ExceptionRecord {
        &self.records[usize::from(number)]
    }

    /// Starts all records anew, for instance after initialisation.
    pub fn clear(&mut self) {
        self.records = [ExceptionRecord::default(); EXCEPTIONS];
    }

    pub(crate) fn forget_running(&mut self) {
        self.running.clear();
    }

    pub(crate) fn enter(&mut self, number: u8, pended_at: u64, preparing_since: u64, now: u64) {
        let record = &mut self.records[usize::from(number)];
        record.count += 1;
        record.worst_latency = record.worst_latency.max(now.saturating_sub(pended_at));
        self.running.push(Running { number, preparing_since, running_since: now, preempted: 0 });
    }

    /// Ends the handler that runs: its last instruction ended at `last`, the interrupted code goes on at `resumed`.
    pub(crate) fn leave(&mut self, last: u64, resumed: u64) {
        let Some(ended) = self.running.pop() else {
            return;
        };
        let own = last - ended.running_since - ended.preempted;
        let record = &mut self.records[usize::from(ended.number)];
        record.worst_own_cycles = record.worst_own_cycles.max(own);
        record.total_own_cycles += own;
        if let Some(below) = self.running.last_mut() {
            below.preempted += resumed - ended.preparing_since;
        }
    }
}
