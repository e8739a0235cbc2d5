//! The sensor ADC, which is not there.
//!
//! Neither its conversion time nor what it would convert is known here, so a program that uses it is told so at the
//! first access instead of being given a made-up sample.
//!
//! What can go wrong: every access is a bus fault.

/// Start of a conversion, offset from the ADC base (SCuM-3C test code, memory_map.h:18-21).
const START: u32 = 0x00_0000;
/// The converted sample.
const DATA: u32 = 0x04_0000;

/// What an access at `offset` is answered with.
pub(super) fn refusal(offset: u32) -> &'static str {
    match offset {
        START | DATA => "the ADC is not simulated",
        _ => "no ADC register here",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_adc_says_that_it_is_not_simulated() {
        assert_eq!(refusal(START), "the ADC is not simulated");
        assert_eq!(refusal(DATA), "the ADC is not simulated");
        assert_eq!(refusal(4), "no ADC register here");
    }
}
