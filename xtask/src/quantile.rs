//! Quantiles of what was measured.
//!
//! What can go wrong: of no values there is none; it is not a number.

/// The value below which the part `q` of `values` lies, between neighbours in proportion. Sorts them.
pub fn quantile(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    values.sort_by(f64::total_cmp);
    let place = q * (values.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(values.len() - 1);
    values[below] + (values[above] - values[below]) * (place - below as f64)
}
