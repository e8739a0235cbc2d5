//! The terminal: a table of motes, the room from above, what was turned away.
//!
//! What can go wrong: a terminal too small for everything; the room gives way first, then columns.

use std::time::Duration;

use anyhow::Result;
use ratatui::crossterm::event::{self, KeyCode, KeyEventKind, KeyModifiers};
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::canvas::{Canvas, Line as Stroke, Points};
use ratatui::widgets::{Block, Cell, Paragraph, Row, Table};
use ratatui::{DefaultTerminal, Frame};

use super::model::{MoteNews, RoomNews, Snapshot, SourceState};

/// Points of a trail that the room shows: 10 s.
pub const TRAIL: usize = 100;
/// Columns that the table needs.
const TABLE_WIDTH: u16 = 112;
/// Columns below which the room is not shown.
const ROOM_WIDTH: u16 = 30;
/// A terminal cell is about so many times as high as wide.
const CELL_HEIGHT: f64 = 2.0;
/// A mote that was silent so long is grey, seconds.
const SILENT_S: f64 = 3.0;
/// A mismatch beyond this is worth a look, metres: ten times what stations that stand where the file says leave.
const MISMATCH_M: f64 = 0.02;
/// Colours of motes, told apart on dark and on light.
const COLOURS: [Color; 6] =
    [Color::Cyan, Color::Green, Color::Yellow, Color::Magenta, Color::LightBlue, Color::LightRed];

/// What the person at the keyboard wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wish {
    /// Nothing.
    Stay,
    /// To go.
    Leave,
}

/// The terminal, taken over until this is dropped.
pub struct Dashboard {
    terminal: DefaultTerminal,
    first: usize,
}

impl Dashboard {
    /// Takes it over.
    ///
    /// # Errors
    /// It is none.
    pub fn open() -> Result<Self> {
        Ok(Self { terminal: ratatui::try_init()?, first: 0 })
    }

    /// Draws everything anew.
    ///
    /// # Errors
    /// The terminal is gone.
    pub fn draw(&mut self, all: &Snapshot, notes: &[String]) -> Result<()> {
        self.first = self.first.min(all.motes.len().saturating_sub(1));
        self.terminal.draw(|frame| draw(frame, all, notes, self.first))?;
        Ok(())
    }

    /// What was typed since the last time.
    ///
    /// # Errors
    /// The terminal is gone.
    pub fn typed(&mut self) -> Result<Wish> {
        while event::poll(Duration::ZERO)? {
            let event::Event::Key(key) = event::read()? else { continue };
            if key.kind == KeyEventKind::Release {
                continue;
            }
            match key.code {
                KeyCode::Char('q') | KeyCode::Esc => return Ok(Wish::Leave),
                KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => return Ok(Wish::Leave),
                KeyCode::Down => self.first += 1,
                KeyCode::Up => self.first = self.first.saturating_sub(1),
                KeyCode::PageDown => self.first += 20,
                KeyCode::PageUp => self.first = self.first.saturating_sub(20),
                KeyCode::Home => self.first = 0,
                _ => {}
            }
        }
        Ok(Wish::Stay)
    }
}

impl Drop for Dashboard {
    fn drop(&mut self) {
        ratatui::restore();
    }
}

/// Draws a snapshot; the table begins with mote number `first`.
pub fn draw(frame: &mut Frame<'_>, all: &Snapshot, notes: &[String], first: usize) {
    let foot = foot(all, notes);
    let [head_at, body, foot_at] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Min(4),
        Constraint::Length((foot.len() as u16).min(frame.area().height / 3)),
    ])
    .areas(frame.area());
    let (table_at, room_at) = if body.width >= TABLE_WIDTH + ROOM_WIDTH {
        let [table, room] =
            Layout::horizontal([Constraint::Length(TABLE_WIDTH), Constraint::Min(ROOM_WIDTH)]).areas(body);
        (table, Some(room))
    } else if body.height >= 24 {
        let rows = (all.motes.len() as u16 + 3).clamp(6, body.height / 2);
        let [table, room] = Layout::vertical([Constraint::Length(rows), Constraint::Min(8)]).areas(body);
        (table, Some(room))
    } else {
        (body, None)
    };
    frame.render_widget(head(all), head_at);
    table(frame, all, first, table_at);
    if let Some(room_at) = room_at {
        room(frame, all, room_at);
    }
    frame.render_widget(Paragraph::new(foot), foot_at);
}

fn head(all: &Snapshot) -> Line<'static> {
    let heard = all.motes.iter().filter(|mote| mote.silent_s < SILENT_S).count();
    let rate = all.motes.iter().fold(0.0, |rate, mote| rate + mote.fixes_per_s);
    let open = all.sources.iter().filter(|source| source.state == SourceState::Open).count();
    let mut spans = vec![
        Span::styled(" listen ", Style::new().add_modifier(Modifier::REVERSED)),
        Span::raw(format!(
            " {}   {} motes, {heard} heard   {rate:.0} fixes/s   {open} of {} receivers   ",
            clock(all.time_s),
            all.motes.len(),
            all.sources.len()
        )),
    ];
    if all.motes.iter().any(|mote| mote.is_conflict) {
        spans.push(Span::styled(" two motes with one id ", Style::new().bg(Color::Red).fg(Color::White)));
        spans.push(Span::raw("  "));
    }
    if all.motes.iter().any(|mote| mote.has_refused_twin) {
        spans.push(Span::styled(" a mote's twin is refused ", Style::new().bg(Color::Yellow).fg(Color::Black)));
        spans.push(Span::raw("  "));
    }
    spans.push(Span::styled("q leaves", Style::new().fg(Color::DarkGray)));
    Line::from(spans)
}

fn clock(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    format!("{}:{:02}:{:02}", whole / 3600, whole / 60 % 60, whole % 60)
}

/// Heads, widths, and which columns give way first: the largest.
const COLUMNS: [(&str, u16, u8); 13] = [
    ("mote", 11, 0),
    ("level", 7, 0),
    ("x m", 7, 0),
    ("y m", 7, 0),
    ("z m", 7, 0),
    ("m/s", 5, 5),
    ("+-mm", 5, 4),
    ("mism", 5, 6),
    ("age", 5, 3),
    ("per s", 5, 2),
    ("lost", 6, 1),
    ("MHz", 7, 7),
    ("lock", 20, 1),
];

/// Which columns fit.
fn columns(width: u16) -> Vec<usize> {
    let fit = |least: u8| (0..COLUMNS.len()).filter(|n| COLUMNS[*n].2 <= least).collect::<Vec<_>>();
    let wide = |columns: &Vec<usize>| columns.iter().map(|n| COLUMNS[*n].1 + 1).sum::<u16>() <= width + 1;
    (0..=7).rev().map(fit).find(wide).unwrap_or_else(|| fit(0))
}

fn table(frame: &mut Frame<'_>, all: &Snapshot, first: usize, at: Rect) {
    let columns = columns(at.width.saturating_sub(2));
    let rows = all.motes.iter().enumerate().skip(first).take(at.height.into()).map(|(n, mote)| row(n, mote, &columns));
    let head = Row::new(columns.iter().map(|n| COLUMNS[*n].0)).style(Style::new().add_modifier(Modifier::BOLD));
    let more = all.motes.len().saturating_sub(first + at.height.saturating_sub(3) as usize);
    let title = if more > 0 || first > 0 { format!(" motes ({more} more below) ") } else { " motes ".to_owned() };
    let widths = columns.iter().map(|n| Constraint::Length(COLUMNS[*n].1));
    frame.render_widget(Table::new(rows, widths).header(head).block(Block::bordered().title(title)), at);
}

fn row(n: usize, mote: &MoteNews, columns: &[usize]) -> Row<'static> {
    let dash = || "-".to_owned();
    let mut name = mote.key.clone();
    if mote.is_conflict || mote.has_refused_twin {
        name.push('!');
    }
    let fix = mote.fix.as_ref();
    let place = fix.and_then(|fix| fix.position_m);
    let place = |axis: usize| place.map_or_else(dash, |place| format!("{:7.3}", place[axis]));
    let sd = fix.and_then(|fix| fix.sd_m).map(|sd| sd.iter().map(|sd| sd * sd).sum::<f64>().sqrt());
    let mismatch = fix.map(|fix| fix.mismatch_m);
    let asked = mote.frames + mote.lost;
    let lost = if asked > 0 { 100.0 * mote.lost as f64 / asked as f64 } else { 0.0 };
    let condition = mote.condition.as_ref();
    let lock = match condition {
        None => dash(),
        Some(condition) => condition.lock_reason.map_or_else(|| "locked".to_owned(), str::to_owned),
    };
    let is_locked = condition.is_some_and(|condition| condition.lock_reason.is_none());
    let is_silent = mote.silent_s >= SILENT_S;
    let plain = Style::new();
    let cells = [
        Cell::new(name).style(if mote.is_conflict { plain.fg(Color::Red) } else { plain.fg(colour(n)) }),
        Cell::new(fix.map_or("-", |fix| fix.level)).style(match fix.map(|fix| fix.level) {
            Some("full") => plain.fg(Color::Green),
            Some("tracked") => plain.fg(Color::Yellow),
            _ => plain.fg(Color::Red),
        }),
        Cell::new(place(0)),
        Cell::new(place(1)),
        Cell::new(place(2)),
        Cell::new(fix.and_then(|fix| fix.speed_m_per_s).map_or_else(dash, |speed| format!("{speed:5.2}"))),
        Cell::new(sd.map_or_else(dash, |sd| format!("{:5.1}", 1e3 * sd))),
        Cell::new(mismatch.map_or_else(dash, |mismatch| format!("{:5.1}", 1e3 * mismatch)))
            .style(if mismatch > Some(MISMATCH_M) { plain.fg(Color::Red) } else { plain }),
        Cell::new(if is_silent { short(mote.silent_s) } else { fix.map_or_else(dash, |fix| short(fix.angle_age_s)) }),
        Cell::new(format!("{:5.1}", mote.fixes_per_s)),
        Cell::new(format!("{lost:5.1}%")).style(if lost >= 10.0 { plain.fg(Color::Red) } else { plain }),
        Cell::new(
            condition.and_then(|condition| condition.clock_hz).map_or_else(dash, |hz| format!("{:7.4}", hz / 1e6)),
        ),
        Cell::new(lock).style(if is_locked { plain } else { plain.fg(Color::Red) }),
    ];
    let cells = columns.iter().map(|n| cells[*n].clone());
    Row::new(cells).style(if is_silent { plain.add_modifier(Modifier::DIM) } else { plain })
}

/// A time in five characters.
fn short(seconds: f64) -> String {
    match seconds {
        s if s < 1.0 => format!("{:3.0}ms", 1e3 * s),
        s if s < 100.0 => format!("{s:4.1}s"),
        s if s < 6000.0 => format!("{:4.0}m", s / 60.0),
        s => format!("{:4.0}h", s / 3600.0),
    }
}

fn colour(n: usize) -> Color {
    COLOURS[n % COLOURS.len()]
}

/// What of the world is drawn to the right and upwards: the axis along which the stations look up goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plan {
    /// Index of the world's axis to the right.
    pub right: usize,
    /// Index of the axis upwards.
    pub up: usize,
}

const AXES: [char; 3] = ['x', 'y', 'z'];

/// How the room is seen from above.
#[must_use]
pub fn plan(room: Option<&RoomNews>) -> Plan {
    // Row 1 of a rotation is the station's up in the world.
    let vertical = room.map_or(2, |room| {
        let share = |axis: usize| room.stations.iter().map(|station| station.rotation[1][axis]).sum::<f64>().abs();
        (0..3).max_by(|one, other| share(*one).total_cmp(&share(*other))).unwrap_or(2)
    });
    match vertical {
        0 => Plan { right: 1, up: 2 },
        1 => Plan { right: 0, up: 2 },
        _ => Plan { right: 0, up: 1 },
    }
}

fn room(frame: &mut Frame<'_>, all: &Snapshot, at: Rect) {
    let Plan { right, up } = plan(all.room.as_ref());
    let flat = |place: [f64; 3]| (place[right], place[up]);
    let stations: Vec<_> = all.room.iter().flat_map(|room| &room.stations).collect();
    let corners = all.room.iter().flat_map(|room| [room.min_m, room.max_m]).flatten();
    let motes = all.motes.iter().filter_map(|mote| mote.fix?.position_m);
    let places: Vec<(f64, f64)> =
        corners.chain(stations.iter().map(|station| station.position_m)).chain(motes).map(flat).collect();
    let block = Block::bordered().title(format!(" from above: {} to the right, {} up ", AXES[right], AXES[up]));
    let inner = block.inner(at);
    let (x, y) = window(&places, f64::from(inner.width), f64::from(inner.height) * CELL_HEIGHT);
    let canvas = Canvas::default().block(block).marker(Marker::Braille).x_bounds(x).y_bounds(y).paint(|context| {
        if let Some((min, max)) = all.room.as_ref().and_then(|room| room.min_m.zip(room.max_m)) {
            let ((x1, y1), (x2, y2)) = (flat(min), flat(max));
            for (a, b) in [((x1, y1), (x2, y1)), ((x2, y1), (x2, y2)), ((x2, y2), (x1, y2)), ((x1, y2), (x1, y1))] {
                context.draw(&Stroke { x1: a.0, y1: a.1, x2: b.0, y2: b.1, color: Color::DarkGray });
            }
        }
        for (n, mote) in all.motes.iter().enumerate() {
            let trail: Vec<(f64, f64)> =
                mote.trail.iter().map(|[_, x, y, z]| flat([*x, *y, *z].map(f64::from))).collect();
            context.draw(&Points { coords: &trail, color: colour(n) });
        }
        context.layer();
        for station in &stations {
            let (x1, y1) = flat(station.position_m);
            // Row 2: where it looks.
            let (dx, dy) = flat(station.rotation[2]);
            let length = 0.12 * (x[1] - x[0]);
            let (x2, y2) = (x1 + length * dx, y1 + length * dy);
            context.draw(&Stroke { x1, y1, x2, y2, color: Color::White });
            context.print(
                x1,
                y1,
                Line::styled(station.name.to_string(), Style::new().add_modifier(Modifier::REVERSED)),
            );
        }
        for (n, mote) in all.motes.iter().enumerate() {
            let Some(place) = mote.fix.and_then(|fix| fix.position_m) else { continue };
            let (x, y) = flat(place);
            // Numbers of a few, dots of many.
            let mark = if all.motes.len() <= 30 { mote.mote.to_string() } else { "o".to_owned() };
            context.print(x, y, Line::styled(mark, Style::new().fg(colour(n)).add_modifier(Modifier::BOLD)));
        }
    });
    frame.render_widget(canvas, at);
}

/// What of the plane is shown: all places, a margin, and both axes to the same scale.
fn window(places: &[(f64, f64)], width: f64, height: f64) -> ([f64; 2], [f64; 2]) {
    let span = |of: fn(&(f64, f64)) -> f64| {
        let (low, high) = places
            .iter()
            .map(of)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        if low <= high { (0.5 * (low + high), 1.1 * (high - low)) } else { (0.0, 2.0) }
    };
    let ((x, wide), (y, high)) = (span(|place| place.0), span(|place| place.1));
    let per_cell = (wide / width.max(1.0)).max(high / height.max(1.0)).max(1e-3);
    let (wide, high) = (0.5 * per_cell * width.max(1.0), 0.5 * per_cell * height.max(1.0));
    ([x - wide, x + wide], [y - high, y + high])
}

fn foot(all: &Snapshot, notes: &[String]) -> Vec<Line<'static>> {
    let mut lines = Vec::new();
    for source in &all.sources {
        let state = match source.state {
            SourceState::Open => Span::styled("open   ", Style::new().fg(Color::Green)),
            SourceState::Waiting => Span::styled("waiting", Style::new().fg(Color::Yellow)),
            SourceState::Ended => Span::styled("ended  ", Style::new().fg(Color::DarkGray)),
        };
        let text =
            format!(" {} ({}): {} frames, {} rejected", source.name, source.kind, source.frames, source.rejected);
        let bad = if source.bad_bytes > 0 { format!(", {} bad bytes", source.bad_bytes) } else { String::new() };
        let unplugged = match source.unplugged {
            0 => String::new(),
            count => format!(", unplugged {count} times"),
        };
        let note = if source.note.is_empty() { String::new() } else { format!(": {}", source.note) };
        lines.push(Line::from(vec![state, Span::raw(text + &bad + &unplugged + &note)]));
    }
    lines.push(Line::raw(rejects(all)));
    lines.extend(all.refusals().map(|refusals| Line::styled(refusals, Style::new().fg(Color::Yellow))));
    lines.extend(notes.iter().cloned().map(Line::raw));
    lines
}

/// What was turned away, in a line.
#[must_use]
pub fn rejects(all: &Snapshot) -> String {
    let each: Vec<String> = all.rejects.iter().map(|(cause, count)| format!("{count} {}", cause.words())).collect();
    let rejected: u64 = all.rejects.values().sum();
    let each = if each.is_empty() { String::new() } else { format!(": {}", each.join(", ")) };
    format!("{} frames, {} heard twice, {rejected} rejected{each}", all.frames, all.duplicates)
}

#[cfg(test)]
mod tests {
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    use super::*;
    use crate::listen::model::{self, Cause, Signal};
    use crate::listen::simulate::{Swarm, scene};

    fn shown(motes: u16, width: u16, height: u16) -> String {
        let calibration =
            crate::calib::schema::read("default.toml", include_str!("../../../calib/default.toml")).unwrap();
        let mut all = model::Swarm::new(Some(RoomNews::of("default.toml", &calibration)));
        let source = all.add_source("/dev/ttyACM0", "nrf");
        all.source(source).unwrap().state = SourceState::Open;
        let mut swarm = Swarm::new(&scene("d", &calibration).unwrap(), 0x4C48, motes, 10.0);
        swarm.until(12.0, |at_s, bytes| {
            all.hear(at_s, source, bytes, Signal::default());
        });
        all.reject(12.0, source, Cause::Line, b"rubbish");
        let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        let all = all.snapshot(TRAIL);
        terminal.draw(|frame| draw(frame, &all, &["recording to take1".to_owned()], 0)).unwrap();
        let text = terminal.backend().to_string();
        println!("{text}");
        text
    }

    #[test]
    fn a_wide_terminal_shows_motes_and_room() {
        let text = shown(3, 170, 40);
        for word in ["4c48/3", "full", "locked", "10.0", "0.0%", "from above: x to the right, z up", "A", "B"] {
            assert!(text.contains(word), "{word}");
        }
        assert!(text.contains("open    /dev/ttyACM0 (nrf): "), "{text}");
        assert!(text.contains("1 rejected: 1 bad bytes from the receiver") && text.contains("recording to take1"));
        let dots = text.chars().filter(|c| ('\u{2801}'..='\u{28FF}').contains(c)).count();
        assert!(dots > 50, "trails and walls: {dots}");
    }

    #[test]
    fn a_usual_terminal_shows_what_fits() {
        let text = shown(3, 100, 40);
        assert!(text.contains("4c48/3") && text.contains("from above"), "{text}");
        // What does not fit goes as a whole column.
        assert!(!text.contains("MHz") && text.contains("locked") && text.contains("0.378"), "{text}");
        let text = shown(40, 80, 24);
        assert!(text.contains("more below") && text.contains("locked"), "{text}");
        // Nothing is too small.
        for size in [(1, 1), (10, 3), (30, 8)] {
            shown(2, size.0, size.1);
        }
    }
}
