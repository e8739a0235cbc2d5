//! A plan in integers: the unit of length, every Q format, and the numbers in them.
//!
//! What can go wrong: parallax that changes sign or varies too much, rays too close to parallel, a room too large for 32
//! bits. Each refuses the plan, with the number that broke a limit.

use super::super::solver::{self, Calib, Fast, General, Linear, Row, Scene};
use super::lines::lines;
use super::plan::{Divide, Frame, Plan, Seen};
use super::sight::{MARGIN, Range, Sight, Sights, V, dot, mean, transposed};
use super::{Refusal, Room, Station, fixed, q_for, refuse, unfixed};

/// The rows of a station.
pub(super) const ROWS: [&str; 2] = ["azimuth", "elevation"];
/// Share of the volume in which a form may be blind where none serves all of it.
const BLIND: f64 = 0.05;

/// Quantises x kx + y ky + k into a sum in `q` with kx and ky in `q_k`: what rounding takes from kx and ky on the
/// mean it gives back through the constant.
fn linear([kx, ky, k]: V, [q, q_k]: [i32; 2], [x, y]: [f64; 2], half: f64) -> Linear {
    let (ix, iy) = (fixed(kx, q_k), fixed(ky, q_k));
    let lost = (kx - unfixed(ix, q_k)) * x + (ky - unfixed(iy, q_k)) * y;
    Linear { x: ix, y: iy, one: fixed(k + lost + half, q) }
}

/// One row to divide by and the sights for which it does.
struct Group {
    frame: Frame,
    calm: Vec<Seen>,
    seen: Vec<Seen>,
    wild: Vec<Seen>,
    beyond: Vec<Seen>,
}

impl Group {
    /// Everything is seen through one row, turned so that its parallax is positive.
    fn whole(room: &Room, first: usize, rows: [usize; 2], sights: &Sights) -> Result<Group, Refusal> {
        let mut frame = Frame::new(room, first, rows);
        if frame.see(&sights.clean[0]).a3 < 0.0 {
            frame.flip();
        }
        let see = |sights: &[Sight]| sights.iter().map(|s| frame.see(s)).collect::<Vec<_>>();
        let (calm, seen) = (see(&sights.clean), see(&sights.noisy));
        let (wild, beyond) = (see(&sights.wild), see(&sights.beyond));
        let least = Range::of(calm.iter().chain(&seen).map(|s| s.a3)).min;
        if least <= 0.0 {
            return refuse(format!("parallax in {} changes sign; its least", ROWS[rows[0]]), least);
        }
        Ok(Group { frame, calm, seen, wild, beyond })
    }

    /// The sights whose parallax in this row, turned so that most of it is positive, is large enough to divide by.
    fn most(room: &Room, first: usize, rows: [usize; 2], sights: &Sights) -> Result<Group, Refusal> {
        let mut frame = Frame::new(room, first, rows);
        if 2 * sights.clean.iter().filter(|s| frame.see(s).a3 < 0.0).count() > sights.clean.len() {
            frame.flip();
        }
        let see = |sights: &[Sight]| sights.iter().map(|s| frame.see(s)).collect::<Vec<_>>();
        let (calm, seen) = (see(&sights.clean), see(&sights.noisy));
        let (wild, beyond) = (see(&sights.wild), see(&sights.beyond));
        let mut group = Group { frame, calm, seen, wild, beyond };
        let least = least(parallax_format(std::slice::from_ref(&group)));
        for seen in [&mut group.calm, &mut group.seen, &mut group.wild] {
            seen.retain(|s| s.a3 >= least);
        }
        ensure_sighted(std::slice::from_ref(&group), sights)?;
        Ok(group)
    }

    /// The sights whose parallax is larger in this row than in the other, and at least `least`.
    fn part(room: &Room, first: usize, rows: [usize; 2], sights: &Sights, least: f64) -> Group {
        let frame = Frame::new(room, first, rows);
        let see = |sights: &[Sight]| {
            let seen = sights.iter().map(|s| frame.see(s));
            seen.filter(|s| s.a3.abs() >= s.a4.abs() && s.a3.abs() >= least).collect::<Vec<_>>()
        };
        let (calm, seen) = (see(&sights.clean), see(&sights.noisy));
        let (wild, beyond) = (see(&sights.wild), see(&sights.beyond));
        Group { frame, calm, seen, wild, beyond }
    }
}

/// The Q format of the parallax: in the volume it fits; beyond it wraps at most once, which shows in the sign.
fn parallax_format(groups: &[Group]) -> i32 {
    let both = |s: &Seen| [s.a3, s.a4];
    let inside = groups.iter().flat_map(|g| g.seen.iter().chain(&g.calm));
    let outside = groups.iter().flat_map(|g| &g.beyond);
    let (inside, outside) = (Range::of(inside.flat_map(both)), Range::of(outside.flat_map(both)));
    q_for(inside.magnitude()).min(q_for(outside.magnitude()) + 1).min(32)
}

/// The least parallax that the reciprocal takes, at Q format `q_a`.
fn least(q_a: i32) -> f64 {
    solver::LEAST * 2f64.powi(30 - q_a) / (1.0 - 2.0 * MARGIN)
}

/// Refuses groups that leave out too much of the volume.
fn ensure_sighted(groups: &[Group], sights: &Sights) -> Result<(), Refusal> {
    let served: usize = groups.iter().map(|g| g.seen.len()).sum();
    let blind = 1.0 - served as f64 / sights.noisy.len() as f64;
    if blind > BLIND {
        return refuse("the rays are too close to parallel over a share of the volume of", blind);
    }
    Ok(())
}

/// The rows to divide by under `plan`, and the sights for which each does.
fn groups(room: &Room, plan: Plan, sights: &Sights) -> Result<Vec<Group>, Refusal> {
    match plan.divide {
        Divide::Row(row) => return Ok(vec![Group::whole(room, plan.first, [row, 1 - row], sights)?]),
        Divide::Most(row) => return Ok(vec![Group::most(room, plan.first, [row, 1 - row], sights)?]),
        Divide::Larger => {}
    }
    let all = [[0, 1], [1, 0]].map(|rows| Group::part(room, plan.first, rows, sights, 0.0));
    let least = least(parallax_format(&all));
    let groups: Vec<Group> =
        [[0, 1], [1, 0]].into_iter().map(|rows| Group::part(room, plan.first, rows, sights, least)).collect();
    ensure_sighted(&groups, sights)?;
    if let Some(group) = groups.iter().find(|g| g.wild.len() < 300) {
        return refuse("too few points divide by the other row", group.wild.len() as f64);
    }
    Ok(groups)
}

/// The groups of a plan, and what of the sights beyond the volume comes through.
struct View<'a> {
    groups: &'a [Group],
    passing: Vec<&'a Seen>,
    /// The least parallax that is let through.
    least: f64,
    /// The Q format of the parallax.
    q_a: i32,
}

impl<'a> View<'a> {
    fn of(groups: &'a [Group], plan: Plan) -> Result<View<'a>, Refusal> {
        let inside = groups.iter().flat_map(|g| g.seen.iter().chain(&g.calm));
        let least = Range::of(inside.map(|s| s.a3.abs())).min * (1.0 - MARGIN);
        let q_a = parallax_format(groups);
        let normal = least * 2f64.powi(q_a - 30);
        if normal < solver::LEAST {
            return refuse("the parallax varies too much: its least, when its greatest is between 1 and 2", normal);
        }
        // Beyond the volume every point must come out right, too, wherever its parallax lets it through.
        let positive = plan.divide != Divide::Larger;
        let passes = |s: &&Seen| s.a3.abs() >= least && !(positive && s.a3 < 0.0);
        let passing = groups.iter().flat_map(|g| &g.beyond).filter(passes).collect();
        Ok(View { groups, passing, least, q_a })
    }

    /// Over the volume.
    fn over(&self, f: impl Fn(&Seen) -> f64) -> Range {
        Range::of(self.groups.iter().flat_map(|g| g.seen.iter().chain(&g.calm)).map(f))
    }

    /// Wherever a point comes through.
    fn out(&self, f: impl Fn(&Seen) -> f64) -> Range {
        self.over(&f).and(Range::of(self.passing.iter().map(|s| f(s))))
    }

    /// On the mean over the volume.
    fn centre(&self, f: impl Fn(&Seen) -> f64) -> f64 {
        let all: Vec<f64> = self.groups.iter().flat_map(|g| &g.calm).map(f).collect();
        mean(all.into_iter())
    }

    /// log2 of the unit of length in metres: baselines below 1 unit, Z / a3 below 2^32 in the product of N (Q16) and the
    /// reciprocal (Q14).
    fn unit_shift(&self) -> Result<i32, Refusal> {
        let beyond = self.groups.iter().flat_map(|g| &g.beyond).flat_map(|s| [s.d3, s.d4]);
        let d = Range::of(beyond).and(self.over(|s| s.d3)).and(self.over(|s| s.d4));
        let z = self.over(|s| s.z);
        if z.min <= 0.0 {
            return refuse("a point of the volume lies behind a station; its depth in metres", z.min);
        }
        let z_unit = (self.out(|s| s.z).magnitude() / 2f64.powi(self.q_a - 28)).log2().ceil();
        Ok(d.magnitude().log2().ceil().max(z_unit).max(0.0) as i32)
    }
}

/// Half of what a shift by `shift` from `q` cuts.
fn half(shift: i32, q: i32) -> f64 {
    2f64.powi(shift - 1 - q)
}

/// v3: its whole part, the rest, and the shift of that.
struct Depth {
    whole: f64,
    rest: Linear,
    shift: i32,
}

impl Depth {
    fn of(view: &View<'_>, r3: V, centre: [f64; 2]) -> Depth {
        let v3 = view.out(|s| s.v3);
        let whole = ((v3.min + v3.max) / 2.0).round();
        let q_v = q_for((v3.max - whole).max(whole - v3.min) * (1.0 + MARGIN)).min(33);
        let shift = q_v - (view.q_a - 15);
        let rest = linear([r3[0], r3[1], r3[2] - whole], [q_v, q_v - 15], centre, half(shift, q_v));
        Depth { whole, rest, shift }
    }
}

/// The Q formats of a position: Z in q_z, X and Y in q_x, their sum with R1^T in q_p.
struct Formats {
    q_x: i32,
    q_z: i32,
    q_p: i32,
    /// The farthest coordinate, in units.
    reach: f64,
}

impl Formats {
    fn of(view: &View<'_>, first: &Station, unit: f64) -> Formats {
        let to_world = transposed(first.rotation);
        let axis = |i: usize, s: &Seen| first.position[i] + s.z * dot(to_world[i], s.u);
        let reach = [0, 1, 2].map(|i| view.out(|s| axis(i, s)).magnitude()).into_iter().fold(0.0, f64::max) / unit;
        let q_p = q_for(reach).min(32);
        let wide = view.out(|s| s.x1 * s.z).magnitude().max(view.out(|s| s.y1 * s.z).magnitude()) / unit;
        let q_x = (q_p + 1) / 2;
        Formats { q_x, q_z: (q_for(wide) - 15).min(q_x), q_p, reach }
    }

    /// R1^T and position 1: the columns of X and Y with the constant, and that of Z.
    fn world(&self, view: &View<'_>, first: &Station, unit: f64, position_shift: i32) -> ([Linear; 3], [i32; 3]) {
        let &Formats { q_x, q_z, q_p, .. } = self;
        let to_world = transposed(first.rotation);
        let [x, y, z] =
            [view.centre(|s| s.x1 * s.z), view.centre(|s| s.y1 * s.z), view.centre(|s| s.z)].map(|c| c / unit);
        let world_z = to_world.map(|r| fixed(r[2], q_p - q_z));
        let world = [0, 1, 2].map(|i| {
            let [kx, ky, kz] = to_world[i];
            // X, Y and Z are cut, not rounded.
            let cut = half(0, q_x) * (kx + ky) + half(0, q_z) * kz;
            let lost = (kz - unfixed(world_z[i], q_p - q_z)) * z;
            let one = first.position[i] / unit + cut + lost;
            linear([kx, ky, one], [q_p, q_p - q_x], [x, y], half(position_shift, q_p))
        });
        (world, world_z)
    }
}

/// The numbers under `plan`, or why they do not fit.
pub(super) fn form(room: &Room, plan: Plan, sights: &Sights, gate: f64) -> Result<Calib, Refusal> {
    let groups = groups(room, plan, sights)?;
    let view = View::of(&groups, plan)?;
    let unit_shift = view.unit_shift()?;
    let (q_a, unit) = (view.q_a, 2f64.powi(unit_shift));
    let frame = &groups[0].frame;
    let [r1, r2, r3] = frame.r21;
    let centre = [view.centre(|s| s.x1), view.centre(|s| s.y1)];
    let (x2, y2) = (mean(groups[0].calm.iter().map(|s| s.x2)), mean(groups[0].calm.iter().map(|s| s.y2)));

    let depth = Depth::of(&view, r3, centre);
    // tan() comes with half a Q15 unit, which whole multiples must give back.
    let excess = unfixed(solver::HALF, 28);
    let row = |r: V| {
        let whole = [0, 1].map(|i| -r[i].round());
        let given = (depth.whole + whole[0] + whole[1]) * excess;
        let rest = [-r[0] - whole[0], -r[1] - whole[1], -r[2] - given];
        Row { whole: whole.map(|x| x as i32), rest: linear(rest, [q_a, q_a - 15], centre, 0.0) }
    };

    let baseline_depth = fixed(frame.t[2] / unit, 16);
    let lost = frame.t[2] / unit - unfixed(baseline_depth, 16);
    // m is cut to Q15, which makes the mismatch too large by half a unit of it times d3.
    let cut = match plan.divide {
        Divide::Row(_) | Divide::Most(_) => 2f64.powi(-16) * view.centre(|s| s.d3) / unit,
        Divide::Larger => 0.0,
    };
    let baseline = [
        fixed(frame.t[0] / unit - lost * x2 + half(15, 31), 31),
        fixed(frame.t[1] / unit - lost * y2 + half(15, 31) - cut, 31),
    ];

    let formats = Formats::of(&view, &frame.first, unit);
    let &Formats { q_x, q_z, q_p, reach } = &formats;
    let position_shift = q_p - 16 - unit_shift;
    let (side_shift, z_shift) = (15 + q_z - q_x, 60 - q_a - q_z);
    if position_shift < 1 || side_shift < 1 || z_shift < 0 || depth.shift < 1 {
        return refuse("the room is too large for its formats; its reach in metres", reach * unit);
    }
    let (world, world_z) = formats.world(&view, &frame.first, unit, position_shift);
    let scene = Scene {
        order: frame.order,
        depth: depth.rest,
        depth_shift: depth.shift as u32,
        depth_whole: depth.whole as i32,
        whole_shift: (q_a - 28) as u32,
        least: fixed(view.least, q_a),
        baseline,
        baseline_depth,
        gate_shift: (gate / unit * 65536.0).log2().round() as u32,
        z_shift: z_shift as u32,
        side_shift: side_shift as u32,
        world,
        world_z,
        position_shift: position_shift as u32,
        unit_shift: unit_shift as u32,
    };
    let lines = |g: &Group| lines([&g.calm, &g.seen, &g.wild], gate, unit, q_z - 1);
    // A bake is done once or a few times by a program; its rooms may stay.
    match groups.as_slice() {
        [only] => {
            let far = [-r2[0], -r2[1], -r2[2] - depth.whole * excess];
            let far = linear(far, [q_a, q_a - 15], centre, half(15, q_a));
            Ok(Calib::Fast(Fast { scene, near: row(r1), far, lines: Box::leak(Box::new(lines(only)?)) }))
        }
        [first, second, ..] => {
            let lines = Box::leak(Box::new([lines(first)?, lines(second)?]));
            Ok(Calib::General(General { scene, rows: [row(r1), row(r2)], lines }))
        }
        [] => refuse("no plan", 0.0),
    }
}
