//! A table with the columns `time_s, x_m, y_m, z_m` (or `x_mm, y_mm, z_mm`), in any order and among others.
//!
//! What can go wrong: a column missing, a row that has not as many cells as the header. The header is shown.

use anyhow::{Result, anyhow, bail, ensure};

use super::samples::{Samples, Truth, rows};

/// Reads the table.
pub(super) fn read(name: &str, text: &str) -> Result<Truth> {
    let mut rows = rows(name, text);
    let Some(header) = rows.next() else { bail!("{name}: the file is empty") };
    let (line, header) = header?;
    let places = |column: &str| header.iter().position(|cell| cell == column);
    let shown = || header.iter().collect::<Vec<_>>().join(",");
    let needed = |column: &str| {
        places(column).ok_or_else(|| {
            anyhow!(
                "{name}:{line}: column {column} is missing; the header is `{}`. Known: a table with time_s and x_m, \
                y_m, z_m (or x_mm, y_mm, z_mm), or what Motive exports",
                shown()
            )
        })
    };
    let time = needed("time_s")?;
    let units: [&str; 3] = if places("x_mm").is_some() { ["x_mm", "y_mm", "z_mm"] } else { ["x_m", "y_m", "z_m"] };
    let mut columns = [0; 3];
    for (column, unit) in columns.iter_mut().zip(units) {
        *column = needed(unit)?;
    }
    let mut samples = Samples::new(name, if units[0] == "x_mm" { 1000.0 } else { 1.0 });
    for row in rows {
        let (line, row) = row?;
        ensure!(
            row.len() == header.len(),
            "{name}:{line}: {} cells where the header has {} columns: `{}`",
            row.len(),
            header.len(),
            row.iter().collect::<Vec<_>>().join(",")
        );
        let cell = |column: usize| row.get(column).unwrap_or("");
        let place = std::array::from_fn(|axis| (units[axis], cell(columns[axis])));
        samples.push(line, ("time_s", cell(time)), place)?;
    }
    Ok(Truth {
        samples: samples.samples,
        attitudes: Vec::new(),
        lost: samples.lost,
        what: "a table of places".to_string(),
    })
}
