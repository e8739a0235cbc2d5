//! One page to look at: can the calibration be trusted, and what does it look like.
//!
//! The page needs nothing else: pictures are SVG inside it, the one that turns is a few lines of script, and every
//! number is there without the script.
//!
//! What can go wrong: a wild residual would squeeze the others flat, so the frames hold what the kept ones need, and
//! what lies beyond is drawn on the border.

mod precision;
mod residuals;
mod views;

use std::fmt::Write as _;

use nalgebra::Vector3;
use serde_json::json;

use super::judgement::{Figures, Grade, Judgement, OUTSIDE, length};
use super::room::Room;
use super::session::ROTORS;
use super::solve::{Residual, Station};
use crate::svg::{escape, figure};

/// What the page shows.
pub struct Report<'a> {
    /// What was calibrated from, for the headline.
    pub title: &'a str,
    /// The verdict.
    pub judgement: &'a Judgement,
    /// The numbers behind it.
    pub figures: &'a Figures,
    /// The solved stations.
    pub stations: &'a [Station; 2],
    /// Every paired sighting.
    pub residuals: &'a [Residual],
    /// Where the mote was, in the order of time.
    pub path: &'a [[f64; 3]],
    /// Whether the path is a list of places and not a walk.
    pub places: bool,
    /// Why a term was fitted or not, and what was found out about the input: sentences.
    pub evidence: &'a [String],
    /// Other numbers: name and value.
    pub facts: &'a [(String, String)],
    /// Where it comes from.
    pub provenance: &'a [(String, toml::Value)],
    /// The room file and what it bakes to.
    pub room: &'a Room,
}

/// Standard deviation of each rotor's angle for the map of precision, radians.
fn sigma(figures: &Figures) -> [f64; 4] {
    figures.rotors.map(|rotor| rotor.rms_deg.to_radians())
}

const STYLE: &str = "\
body{font:15px/1.5 Helvetica,Arial,'DejaVu Sans',sans-serif;color:#1f2933;background:#f4f6f8;margin:0}\
main{max-width:1120px;margin:0 auto;padding:24px 32px 48px;background:#fff}\
h1{font-size:24px;margin:0 0 12px}h2{font-size:18px;margin:36px 0 6px}\
p{margin:6px 0;max-width:90ch}.soft{color:#68747f}\
.verdict{font-size:17px;padding:12px 16px;border-left:6px solid;border-radius:3px;margin:12px 0 20px;max-width:none}\
.trusted{border-color:#2f855a;background:#edf7f0}.doubtful{border-color:#c27803;background:#fdf6e7}\
.refused{border-color:#c53030;background:#fdeeee}\
table{border-collapse:collapse;margin:8px 0}th,td{padding:3px 14px 3px 0;text-align:right;border-bottom:1px solid #e3e7eb;\
font-variant-numeric:tabular-nums}th:first-child,td:first-child{text-align:left}\
.words td{text-align:left;vertical-align:top;overflow-wrap:anywhere}.words td:first-child:not(:last-child){white-space:nowrap;color:#68747f}\
svg{display:block;max-width:100%;height:auto;margin:6px 0}canvas{border:1px solid #cbd2d9;cursor:grab;touch-action:none;max-width:100%}\
pre{background:#f4f6f8;padding:12px;overflow:auto;font-size:13px}";

/// Draws the page.
pub fn html(report: &Report) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width\"><title>{0}</title><style>{STYLE}</style></head><body><main>\n<h1>{0}</h1>\n",
        escape(report.title)
    );
    let class = match report.judgement.grade {
        Grade::Trusted => "trusted",
        Grade::Doubtful => "doubtful",
        Grade::Refused => "refused",
    };
    let _ = writeln!(page, "<p class=\"verdict {class}\">{}</p>", escape(&report.judgement.sentence));
    numbers(&mut page, report);
    section(
        &mut page,
        "Residuals",
        &format!(
            "Measured less predicted angle of every {}, and how often. Kept ones are blue; red ones were turned away, and \
             sit on the border where they lie beyond it.",
            if report.places { "average: at each place" } else { "sweep that has a truth: over time" }
        ),
        &residuals::over_time(report),
    );
    section(
        &mut page,
        "What each station sees",
        "Angles in the image plane of each station: blue rings where the light was measured, orange dots where the solved \
         room says it must be. A dot in its ring is a good fit.",
        &residuals::image_planes(report),
    );
    section(
        &mut page,
        "The room from three sides",
        "Stations and where they look, the path, rays along measured angles, and the volume that the mote is told of.",
        &views::sides(report),
    );
    section(
        &mut page,
        "The room to turn",
        "Drag to turn, scroll to come nearer.",
        &format!(
            "<canvas id=\"room\" width=\"1056\" height=\"560\"></canvas><noscript><p>Needs a script; the three sides above \
             show the same.</p></noscript>\n<script>const R={};\n{}</script>",
            scene(report),
            include_str!("report/room.js")
        ),
    );
    // What is left at a place is the scatter of averages.
    let one = if report.places { "an average like those at the places" } else { "one sweep" };
    section(
        &mut page,
        "How exact a place will be",
        &format!(
            "Standard deviation (all three axes together) of a place found from {one} of each of the four rotors, from \
             where the stations stand and how much each rotor's residuals scatter. Three slices through the middle of the \
             path; the tracker, which averages over time, does better. Grey: out of a rotor's light."
        ),
        &precision::slices(report),
    );
    words(&mut page, "What was found out", report.evidence.iter().map(|sentence| (None, sentence.as_str())));
    let shown = |value: &toml::Value| value.as_str().map_or_else(|| value.to_string(), str::to_string);
    let provenance: Vec<String> = report.provenance.iter().map(|(_, value)| shown(value)).collect();
    words(
        &mut page,
        "Where it comes from",
        report.provenance.iter().zip(&provenance).map(|((key, _), value)| (Some(key.as_str()), value.as_str())),
    );
    let _ = writeln!(page, "<h2>The room file</h2>\n<pre>{}</pre>\n</main></body></html>", escape(&report.room.text));
    page
}

fn section(page: &mut String, title: &str, caption: &str, body: &str) {
    let _ = writeln!(page, "<h2>{title}</h2>\n<p class=\"soft\">{caption}</p>\n{body}");
}

fn words<'a>(page: &mut String, title: &str, rows: impl Iterator<Item = (Option<&'a str>, &'a str)>) {
    let _ = writeln!(page, "<h2>{title}</h2>\n<table class=\"words\">");
    for (key, value) in rows {
        let key = key.map(|key| format!("<td>{}</td>", escape(key))).unwrap_or_default();
        let _ = writeln!(page, "<tr>{key}<td>{}</td></tr>", escape(value));
    }
    page.push_str("</table>\n");
}

fn numbers(page: &mut String, report: &Report) {
    let counted = if report.places { "averages at places" } else { "sweeps with a truth" };
    let _ = writeln!(
        page,
        "<table><tr><th>rotor</th><th>{counted}</th><th>turned away</th><th>RMS, degrees</th><th>median, degrees</th>\
         <th>RMS held out, degrees</th><th>phase, rad</th></tr>"
    );
    for (index, (name, rotor)) in ROTORS.iter().zip(&report.figures.rotors).enumerate() {
        let phase = report.stations[index / 2].factory[index % 2].phase;
        let _ = writeln!(
            page,
            "<tr><td>{name}</td><td>{}</td><td>{} %</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            rotor.paired,
            figure(100.0 * rotor.rejected, 1),
            figure(rotor.rms_deg, 3),
            figure(rotor.median_deg, 3),
            figure(rotor.held_out_deg, 3),
            figure(phase, 4)
        );
    }
    page.push_str("</table>\n<table class=\"words\">\n");
    let mut rows: Vec<(String, String)> =
        vec![("mean error on light held out of the fit".into(), length(report.figures.held_out_m))];
    rows.extend(report.figures.outside.map(|outside| (OUTSIDE.into(), outside.words())));
    rows.push(("condition number of the fit".into(), format!("{:.0}", report.figures.condition)));
    for (key, value) in rows.iter().chain(report.facts) {
        let _ = writeln!(page, "<tr><td>{}</td><td>{}</td></tr>", escape(key), escape(value));
    }
    page.push_str("</table>\n");
}

/// Rays drawn per station.
const RAYS: usize = 24;
/// Sweeps of a station's two rotors this near in time are one look, seconds: a slot apart and a little.
const LOOK_S: f64 = 0.02;
/// At most so many dots in a panel, and points of the path that turns.
const MOST: usize = 2000;

/// An azimuth and an elevation of one station that belong together.
#[derive(Clone, Copy)]
struct Look<'a> {
    az: &'a Residual,
    el: &'a Residual,
}

impl Look<'_> {
    fn kept(&self) -> bool {
        self.az.kept && self.el.kept
    }

    /// Both ends of the ray along the measured angles, metres.
    fn ray(&self, station: &Station) -> [[f64; 3]; 2] {
        let to_point = station.rotation * (self.az.position - station.position);
        let tangent = |own: f64, residual: f64| (own.atan2(to_point.z) + residual).tan();
        let c = Vector3::new(tangent(to_point.x, self.az.residual), tangent(to_point.y, self.el.residual), 1.0);
        let end = station.position + station.rotation.transpose() * c.normalize() * to_point.norm();
        [station.position.into(), end.into()]
    }
}

/// All looks of a station, in the order of time.
fn looks(residuals: &[Residual], station: usize) -> Vec<Look<'_>> {
    let of = |axis: usize| {
        let mut of: Vec<&Residual> = residuals.iter().filter(|r| r.station == station && r.axis == axis).collect();
        of.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        of
    };
    let (azimuths, elevations) = (of(0), of(1));
    let near = |az: &'_ Residual| {
        let after = elevations.partition_point(|el| el.at_s < az.at_s);
        let sides = [after.checked_sub(1).and_then(|before| elevations.get(before)), elevations.get(after)];
        let nearest = sides.into_iter().flatten().min_by(|a, b| {
            let off = |el: &Residual| (el.at_s - az.at_s).abs();
            off(a).total_cmp(&off(b))
        });
        nearest.copied().filter(|el| (el.at_s - az.at_s).abs() < LOOK_S)
    };
    azimuths.into_iter().filter_map(|az| Some(Look { az, el: near(az)? })).collect()
}

/// Evenly chosen rays of a station.
fn rays(report: &Report, station: usize) -> Vec<[[f64; 3]; 2]> {
    let looks: Vec<Look> = looks(report.residuals, station).into_iter().filter(Look::kept).collect();
    thin(&looks, RAYS).map(|look| look.ray(&report.stations[station])).collect()
}

/// At most `most` of the items, evenly chosen.
fn thin<T>(items: &[T], most: usize) -> impl Iterator<Item = &T> {
    let count = items.len().min(most);
    (0..count).map(move |n| &items[n * items.len() / count])
}

/// The room for the picture that turns.
fn scene(report: &Report) -> serde_json::Value {
    let rounded = |p: &[f64; 3]| p.map(|x| (x * 1e4).round() / 1e4);
    let stations: Vec<_> = report
        .stations
        .iter()
        .map(|station| {
            let rows: Vec<[f64; 3]> = station.rotation.row_iter().map(|row| [row[0], row[1], row[2]]).collect();
            json!({ "p": rounded(&station.position.into()), "r": rows })
        })
        .collect();
    let rays: Vec<Vec<_>> =
        (0..2).map(|station| rays(report, station).iter().map(|ray| ray.each_ref().map(rounded)).collect()).collect();
    let volume = report.room.held.volume;
    json!({
        "path": thin(report.path, MOST).map(rounded).collect::<Vec<_>>(),
        "places": report.places,
        "stations": stations,
        "rays": rays,
        "box": [rounded(&volume.min), rounded(&volume.max)],
    })
}
