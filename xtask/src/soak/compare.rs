//! Whether the end of a life is like its beginning.
//!
//! Every round meets the same scenes, so a figure of one round is a draw from one distribution as long as nothing wears
//! out. Two tests per figure: the mean of the last hour's rounds against that of the first hour's, and the slope of a
//! line through all rounds, each within [`SIGMAS`] of its standard error as the rounds' own scatter gives it.
//!
//! What can go wrong: with few rounds the scatter is not known and nothing is compared; it says so. A scatter that grew
//! by itself would hide in it; the rounds' figures are in the summary.

use serde_json::{Value, json};

use super::watch::Round;

/// Standard errors that are chance: Student's t with 46 degrees of freedom exceeds it once in 800 either way, and a soak
/// makes 16 such tests, so one soak in fifty fails by chance.
const SIGMAS: f64 = 3.45;
/// Rounds from which on their scatter is known.
const ENOUGH: usize = 8;

/// One figure, first and last.
#[derive(Debug)]
struct Row {
    name: &'static str,
    first: f64,
    last: f64,
    /// How much the two may differ.
    bound: f64,
    /// By how much it goes up over the whole life, and how much of that is chance.
    trend: f64,
    trend_bound: f64,
}

/// All figures.
#[derive(Debug)]
pub(super) struct Comparison {
    rows: Vec<Row>,
    rounds: usize,
}

impl Comparison {
    /// Of the first `hour` rounds and the last.
    pub(super) fn of(rounds: &[Round], hour: usize) -> Self {
        let compared = if rounds.len() >= ENOUGH { &Round::FIGURES[..] } else { &[] };
        let row = |&(name, figure): &(&'static str, fn(&Round) -> f64)| {
            let values: Vec<f64> = rounds.iter().map(figure).collect();
            Row::of(name, &values, hour)
        };
        Self { rows: compared.iter().map(row).collect(), rounds: rounds.len() }
    }

    pub(super) fn broken(&self) -> Vec<String> {
        let differs = |row: &&Row| !row.holds();
        self.rows
            .iter()
            .filter(differs)
            .map(|row| format!("the last hour is not like the first: {}", row.name))
            .collect()
    }

    pub(super) fn summary(&self) -> Value {
        let row = |row: &Row| {
            json!({
                "figure": row.name, "first_hour": row.first, "last_hour": row.last, "bound": row.bound,
                "trend": row.trend, "trend_bound": row.trend_bound,
            })
        };
        self.rows.iter().map(row).collect()
    }
}

impl Row {
    fn of(name: &'static str, values: &[f64], hour: usize) -> Self {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let (first, last) = (mean(&values[..hour]), mean(&values[values.len() - hour..]));
        let n = values.len() as f64;
        let (centre, all) = ((n - 1.0) / 2.0, mean(values));
        let place = |i: usize| i as f64 - centre;
        let spread = values.iter().enumerate().map(|(i, _)| place(i) * place(i)).sum::<f64>();
        let slope = values.iter().enumerate().map(|(i, value)| place(i) * (value - all)).sum::<f64>() / spread;
        // About the line, so that a trend does not excuse itself.
        let left = |(i, value): (usize, &f64)| value - all - slope * place(i);
        let sd = (values.iter().enumerate().map(|v| left(v) * left(v)).sum::<f64>() / (n - 2.0)).sqrt();
        Self {
            name,
            first,
            last,
            bound: SIGMAS * sd * (2.0 / hour as f64).sqrt(),
            trend: slope * (n - 1.0),
            trend_bound: SIGMAS * sd / spread.sqrt() * (n - 1.0),
        }
    }

    fn holds(&self) -> bool {
        (self.last - self.first).abs() <= self.bound && self.trend.abs() <= self.trend_bound
    }
}

impl std::fmt::Display for Comparison {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.rows.is_empty() {
            return write!(f, "{} rounds are too few to compare the last hour with the first", self.rounds);
        }
        write!(
            f,
            "{:<30} {:>10} {:>10} {:>10} {:>9} | {:>10} {:>9}",
            "figure", "first hour", "last hour", "difference", "bound", "trend", "bound"
        )?;
        for row in &self.rows {
            let Row { name, first, last, bound, trend, trend_bound } = row;
            let verdict = if row.holds() { "" } else { "  DIFFERS" };
            let difference = last - first;
            write!(
                f,
                "\n{name:<30} {first:>10.3} {last:>10.3} {difference:>+10.3} {bound:>9.3} | {trend:>+10.3} {trend_bound:>9.3}{verdict}"
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Plus and minus one in no order that keeps step with anything.
    fn scatter(n: usize) -> f64 {
        if (n * n * 7 + n * 3) % 11 < 5 { 1.0 } else { -1.0 }
    }

    #[test]
    fn scatter_alone_is_no_difference_and_a_trend_or_a_jump_is_one() {
        let holds = |figure: fn(usize) -> f64| {
            let values: Vec<f64> = (0..48).map(|n| figure(n) + scatter(n)).collect();
            Row::of("figure", &values, 2).holds()
        };
        assert!(holds(|_| 100.0));
        assert!(!holds(|n| 100.0 + 0.1 * n as f64));
        assert!(!holds(|n| if n < 46 { 100.0 } else { 110.0 }));
    }
}
