//! What listening to a swarm costs: processor, memory, losses, over time.
//!
//! The listener is this program once more, reading a capture from a pipe at the pace at which a swarm would send; the
//! motes are made here, so that the listener is weighed alone. It records to disk meanwhile, unless that takes long.
//!
//! What can go wrong: a computer too busy to make the frames in time; the rate that was reached is printed.

use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::{Value, json};

use super::simulate::{self, Swarm};
use crate::calib::schema;
use crate::pcap::{self, Frame};
use crate::{trust, whole};

/// The share of one core that listening may take.
const CPU_LIMIT: f64 = 0.5;
/// Trails and queues have filled after so long, seconds.
const WARM_S: f64 = 30.0;
/// What memory may grow by after that.
const GROWTH: f64 = 1.05;
/// A swarm of a thousand fills 3 MB of disk a second: longer than this the listener does not record, seconds.
const RECORDED_S: f64 = 300.0;
/// Lines of the table.
const LINES: f64 = 12.0;
/// How often frames are made.
const STEP: Duration = Duration::from_millis(20);

/// Weighs the listener and prints it.
///
/// # Errors
/// It takes more than half a core, grows, or loses a frame.
pub fn measure(calib: &Path, motes: u16, rate: f64, seconds: f64) -> Result<()> {
    ensure!(Path::new("/proc/self/stat").exists(), "memory and processor time are read from /proc, which is not here");
    let calibration = schema::open(calib)?;
    let scene = simulate::scene(&calib.display().to_string(), &calibration)?;
    let mut swarm = Swarm::new(&scene, calibration.mote.pan, motes, rate).under(trust::key_of(&calibration)?);
    let records = seconds <= RECORDED_S;
    let too = if records { "; the listener records" } else { "" };
    println!("{motes} motes, {:.0} frames a second, for {seconds} s{too}", swarm.frames_per_s());
    let dir = tempfile::tempdir().context("a folder for the recording")?;
    let summary = dir.path().join("summary.json");
    let mut listener = Command::new(std::env::current_exe().context("this program's own name")?);
    listener.args(["listen", "--capture", "-", "--plain", "--calib"]).arg(calib).arg("--summary").arg(&summary);
    // The room's own are of motes that are there.
    listener.arg("--counters").arg(dir.path().join("counters"));
    if records {
        listener.arg("--record").arg(dir.path().join("take"));
    }
    let mut child =
        listener.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().context("cannot start the listener")?;
    let mut to = BufWriter::with_capacity(1 << 16, child.stdin.take().context("a pipe to the listener")?);
    let mut capture = Vec::new();
    pcap::write(&[], &mut capture)?;
    let header = capture.len();
    to.write_all(&capture)?;
    let started = Instant::now();
    let (mut sent, mut lines, mut warm, mut last) = (0u64, 1.0, None, (0.0, 0.0));
    println!("{:>8} {:>10} {:>8} {:>8}", "s", "frames", "cpu %", "RSS MB");
    loop {
        let now_s = started.elapsed().as_secs_f64();
        let mut broken = None;
        swarm.until(now_s.min(seconds), |at_s, bytes| {
            sent += 1;
            capture.clear();
            let frame = Frame { micros: (1e6 * at_s) as u64, bytes: bytes.to_vec() };
            let written = pcap::write(&[frame], &mut capture).map_err(std::io::Error::other);
            broken = broken.take().or(written.and_then(|()| to.write_all(&capture[header..])).err());
        });
        if let Some(error) = broken {
            bail!("the listener stopped listening: {error}");
        }
        to.flush().context("the listener stopped listening")?;
        let over = now_s >= seconds;
        if over || now_s >= lines * seconds / LINES {
            lines += 1.0;
            let (cpu_s, rss) = weigh(child.id())?;
            let share = (cpu_s - last.1) / (now_s - last.0);
            last = (now_s, cpu_s);
            println!("{now_s:8.1} {sent:10} {:8.1} {:8.1}", 100.0 * share, rss / 1e6);
            if now_s >= WARM_S && warm.is_none() {
                warm = Some(rss);
            }
            if over {
                drop(to);
                let weight = Weight { seconds, share: cpu_s / now_s, rss, growth: warm.map(|warm| rss / warm) };
                return judge(child, &summary, motes, sent, &weight);
            }
        }
        sleep(STEP);
    }
}

/// What the listener took.
struct Weight {
    seconds: f64,
    /// Of one core.
    share: f64,
    /// Bytes, in the end.
    rss: f64,
    /// Of that since it was warm.
    growth: Option<f64>,
}

fn judge(
    mut child: std::process::Child,
    summary: &Path,
    motes: u16,
    sent: u64,
    &Weight { seconds, share, rss, growth }: &Weight,
) -> Result<()> {
    ensure!(child.wait().context("lost sight of the listener")?.success(), "the listener failed");
    let all: Value = serde_json::from_slice(&std::fs::read(summary).context("the listener's summary")?)?;
    let empty = Vec::new();
    let heard = all["motes"].as_array().unwrap_or(&empty);
    let sum = |name: &str| heard.iter().filter_map(|mote| mote[name].as_u64()).sum::<u64>();
    let (frames, lost, rejects) = (sum("frames"), sum("lost"), &all["rejects"]);
    println!(
        "{} motes; {sent} frames sent, {frames} heard, {lost} lost, rejected {rejects}; {:.1} % of one core{}",
        heard.len(),
        100.0 * share,
        growth.map_or(String::new(), |growth| format!("; memory {growth:.3} times that after {WARM_S} s"))
    );
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../target/listen/measured-{seconds}.json"));
    let figures = json!({
        "motes": motes,
        "seconds": seconds,
        "frames": frames,
        "lost": lost,
        "percent_of_a_core": 100.0 * share,
        "rss_mb": rss / 1e6,
    });
    whole::json(&path, &figures)?;
    ensure!(heard.len() == usize::from(motes), "{} motes of {motes} are known", heard.len());
    ensure!(frames == sent && lost == 0, "{} frames did not arrive", sent - frames);
    ensure!(share < CPU_LIMIT, "{:.0} % of one core is more than {:.0} %", 100.0 * share, 100.0 * CPU_LIMIT);
    ensure!(growth.is_none_or(|growth| growth < GROWTH), "memory grows");
    Ok(())
}

/// Processor seconds and resident bytes of a process (proc_pid_stat(5): fields 14, 15 and 24; a tick is 10 ms and a page
/// 4 KiB on every Linux that this runs on).
fn weigh(id: u32) -> Result<(f64, f64)> {
    const TICK_S: f64 = 0.01;
    const PAGE: f64 = 4096.0;
    let text = std::fs::read_to_string(format!("/proc/{id}/stat")).context("the listener is gone")?;
    // The name in parentheses may hold spaces.
    let rest = text.rsplit_once(')').map_or("", |(_, rest)| rest);
    let field = |number: usize| rest.split_whitespace().nth(number - 3).and_then(|field| field.parse::<f64>().ok());
    match (field(14), field(15), field(24)) {
        (Some(user), Some(system), Some(pages)) => Ok(((user + system) * TICK_S, pages * PAGE)),
        _ => bail!("/proc/{id}/stat makes no sense"),
    }
}
