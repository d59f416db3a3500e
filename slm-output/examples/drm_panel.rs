//! Drives a connector as holod does, with patterns that are known, and tells what came of it: what `tests/qemu/display`
//! judges. It can be run on any machine with a connector to spare.
//!
//! - `drm_panel show CONNECTOR WIDTHxHEIGHT@HZ MODE [refreshes=N] [losses=N] [crc=FOLDER]
//!   [margins=LEFT,RIGHT,TOP,BOTTOM] [wrong=level|submission]`
//!   shows a new frame as often as the panel takes one, until `losses` losses are over and N refreshes have come since.
//!   `crc` is the controller's folder in debugfs (such as `/sys/kernel/debug/dri/0/crtc-0/crc`), whose check sums of
//!   what was scanned out are compared with those of the patterns; only vkms's are known. `margins` are of the video
//!   frame around the panel, in pixels of the mode. `wrong` is there so that a test of this can be shown to fail:
//!   `level` expects another level in one pattern, `submission` leaves out a frame now and then.
//! - `drm_panel steal PROCESS CARD MILLISECONDS` takes the card away from a process, as a session manager does, is its
//!   master for a while, and lets it go.
//! - `drm_panel hold CARD MILLISECONDS` is the card's master for a while.
//!
//! It prints lines of JSON. MODE is channel-packed, field-sequential or monochrome.

use std::error::Error;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use crc::{Algorithm, Crc};
use drm::Device;
use holod_calibration::rig::{Panel, PanelMode, Rig, VideoMargins};
use holod_calibration::{Colour, Resolution, TimeNs, host_now};
use holod_slm_output::fields::FrameTag;
use holod_slm_output::present::drm::{DrmPanel, DrmTarget, Verdict};
use holod_slm_output::present::{FrameSink, PanelSetup, PresentedRefresh, Presenter, TimestampSource, frame_channel};
use holod_slm_output::{FrameLayout, LevelsFrame};
use holod_tests::counting::{self, Counting};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde_json::json;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

/// Patterns that follow one another; each differs from its neighbours in every row.
const PATTERNS: u64 = 7;
const LIMIT: TimeNs = TimeNs(240_000_000_000);
const RECOVER_EVERY: Duration = Duration::from_millis(100);

#[global_allocator]
static COUNTING: Counting = Counting;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let done = match words[..] {
        ["show", connector, mode, panel_mode, ref options @ ..] => show(connector, mode, panel_mode, options),
        ["steal", process, card, milliseconds] => steal(process, Path::new(card), milliseconds),
        ["hold", card, milliseconds] => hold(Path::new(card), milliseconds),
        _ => Err("drm_panel show|steal|hold ...: see the head of slm-output/examples/drm_panel.rs".into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            tell(&json!({ "refused": why.to_string() }));
            ExitCode::FAILURE
        }
    }
}

fn tell(line: &serde_json::Value) {
    // Nobody may be reading any more.
    let _ = writeln!(io::stdout(), "{line}");
}

struct Options {
    refreshes: usize,
    losses: usize,
    crc: Option<PathBuf>,
    wrong_level: bool,
    wrong_submission: bool,
    margins: VideoMargins,
}

fn parse_options(words: &[&str]) -> Result<Options, Box<dyn Error>> {
    let mut options = Options {
        refreshes: 1000,
        losses: 0,
        crc: None,
        wrong_level: false,
        wrong_submission: false,
        margins: VideoMargins::default(),
    };
    for word in words {
        match word.split_once('=') {
            Some(("refreshes", count)) => options.refreshes = count.parse()?,
            Some(("losses", count)) => options.losses = count.parse()?,
            Some(("crc", folder)) => options.crc = Some(folder.into()),
            Some(("margins", pixels)) => {
                let pixels: Vec<usize> = pixels.split(',').map(str::parse).collect::<Result<_, _>>()?;
                let [left, right, top, bottom] = pixels[..] else { return Err("margins=LEFT,RIGHT,TOP,BOTTOM".into()) };
                options.margins = VideoMargins { left, right, top, bottom };
            }
            Some(("wrong", "level")) => options.wrong_level = true,
            Some(("wrong", "submission")) => options.wrong_submission = true,
            _ => return Err(format!("no option is `{word}`").into()),
        }
    }
    Ok(options)
}

fn parse_panel(mode: &str, panel_mode: &str) -> Result<(Panel, Resolution), Box<dyn Error>> {
    let (size, refresh_hz) = mode.split_once('@').ok_or("WIDTHxHEIGHT@HZ")?;
    let (width, height) = size.split_once('x').ok_or("WIDTHxHEIGHT@HZ")?;
    let modes = [PanelMode::ChannelPacked, PanelMode::FieldSequential, PanelMode::Monochrome(Colour::Green)];
    let mode = modes.into_iter().find(|mode| mode.name() == panel_mode);
    let mode = mode.ok_or_else(|| format!("no panel mode is `{panel_mode}`"))?;
    let panel = Panel { refresh_hz: refresh_hz.parse()?, mode, ..Rig::default().panel };
    Ok((panel, Resolution { width: width.parse()?, height: height.parse()? }))
}

/// Noise that is another one for each seed, 8 bits.
fn pattern(layout: FrameLayout, seed: u64) -> LevelsFrame {
    let mut frame = LevelsFrame::new(layout);
    for colour in Colour::ALL {
        let mut state = seed as u32 * 3 + colour.index() as u32 + 1;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u16
        };
        let levels: Vec<u16> = (0..layout.resolution.pixels()).map(|_| noise()).collect();
        frame.field_mut(colour).write(&levels);
    }
    frame
}

/// The R, G and B of the video frame's pixel `index` at `field`.
fn pixel(frame: &LevelsFrame, field: usize, index: usize) -> [u16; 3] {
    let FrameLayout { resolution: Resolution { width, height }, video_margins: VideoMargins { left, top, .. }, .. } =
        frame.layout();
    let video_width = frame.layout().video_resolution().width;
    let (column, row) = (index % video_width, index / video_width);
    if !(left..left + width).contains(&column) || !(top..top + height).contains(&row) {
        return [0; 3];
    }
    let index = (row - top) * width + column - left;
    match frame.layout().mode {
        PanelMode::ChannelPacked => [0, 1, 2].map(|channel| frame.samples()[3 * index + channel]),
        _ => [frame.plane(frame.layout().colour_of_field(field))[index]; 3],
    }
}

/// What vkms makes a check sum of: for each pixel A, R, G and B of 16 bits.
fn vkms_crc(frame: &LevelsFrame, field: usize, wrong: bool) -> u32 {
    const PLAIN: Algorithm<u32> = Algorithm { init: 0, xorout: 0, ..crc::CRC_32_ISO_HDLC };
    let crc = Crc::<u32>::new(&PLAIN);
    let mut digest = crc.digest();
    for index in 0..frame.layout().video_resolution().pixels() {
        let [red, green, mut blue] = pixel(frame, field, index);
        if wrong && index == 1234 {
            blue ^= 1;
        }
        for channel in [0xffff, red * 257, green * 257, blue * 257] {
            digest.update(&channel.to_le_bytes());
        }
    }
    digest.finalize()
}

/// The controller's check sums, one for each refresh.
struct Crcs {
    data: File,
    seen: Vec<(u32, u32)>,
}

impl Crcs {
    fn open(folder: &Path) -> io::Result<Self> {
        fs::write(folder.join("control"), "auto")?;
        let nonblock = rustix::fs::OFlags::NONBLOCK.bits() as i32;
        let data = OpenOptions::new().read(true).custom_flags(nonblock).open(folder.join("data"))?;
        Ok(Self { data, seen: Vec::new() })
    }

    fn read(&mut self) -> io::Result<()> {
        let mut line = [0; 64];
        loop {
            match self.data.read(&mut line) {
                Ok(0) => return Ok(()),
                Ok(length) => {
                    let text = String::from_utf8_lossy(&line[..length]).into_owned();
                    let mut words =
                        text.split_whitespace().map(|word| u32::from_str_radix(word.trim_start_matches("0x"), 16));
                    if let (Some(Ok(refresh)), Some(Ok(crc))) = (words.next(), words.next()) {
                        self.seen.push((refresh, crc));
                    }
                }
                Err(why) if why.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(why) => return Err(why),
            }
        }
    }
}

/// What is noted while the panel runs.
struct Notes {
    refreshes: Vec<PresentedRefresh>,
    tick_ns: Vec<i64>,
    allocations: u64,
    before_their_time: u64,
}

fn show(connector: &str, mode: &str, panel_mode: &str, options: &[&str]) -> Result<(), Box<dyn Error>> {
    let options = parse_options(options)?;
    let (panel, video) = parse_panel(mode, panel_mode)?;
    let video_margins = options.margins;
    let VideoMargins { left, right, top, bottom } = video_margins;
    let resolution = Resolution { width: video.width - left - right, height: video.height - top - bottom };
    let panel = Panel { video_margins, ..panel };
    let layout = FrameLayout::new(&panel, resolution);
    let patterns: Vec<LevelsFrame> = (0..PATTERNS).map(|seed| pattern(layout, seed)).collect();
    let flat = LevelsFrame::new(layout);
    let (mut sink, mut source) = frame_channel(&flat);
    let target = DrmTarget { connector: connector.to_owned(), card: None };
    let t_begin = host_now();
    let mut presenter = DrmPanel::open(&target, &PanelSetup { panel, flat })?;
    tell_checks(&presenter, t_begin);

    raise_priority();
    let mut crcs = options.crc.as_deref().map(Crcs::open).transpose()?;
    let mut notes = Notes {
        refreshes: Vec::with_capacity(100_000),
        tick_ns: Vec::with_capacity(400_000),
        allocations: 0,
        before_their_time: 0,
    };
    let (mut losses, mut told) = (0, false);
    let mut frame_id = 0;
    submit(&mut sink, &patterns, &mut frame_id, &options);
    while losses < options.losses || notes.refreshes.len() < options.refreshes {
        if (host_now() - t_begin) > LIMIT {
            return Err(
                format!("after {} refreshes and {losses} losses the time was over", notes.refreshes.len()).into()
            );
        }
        let now = host_now();
        let before = (counting::here(), notes.refreshes.len());
        let ticked = presenter.tick(now, &mut source, &mut |refresh| {
            notes.before_their_time += u64::from(refresh.t_present > now);
            notes.refreshes.push(refresh);
        });
        notes.allocations += counting::here() - before.0;
        notes.tick_ns.push((host_now() - now).0);
        if let Err(fault) = ticked {
            losses += 1;
            tell(&json!({ "lost": fault.to_string(), "t_ms": (host_now() - t_begin).0 / 1_000_000 }));
            wait_for_it(&mut presenter, t_begin)?;
            tell(&json!({ "back_t_ms": (host_now() - t_begin).0 / 1_000_000 }));
            notes.refreshes.clear();
            notes.tick_ns.clear();
            // The frame that was on its way is lost.
            submit(&mut sink, &patterns, &mut frame_id, &options);
            continue;
        }
        // A frame for each colour frame's start, once the last one has been shown.
        if notes.refreshes[before.1..].iter().any(|refresh| starts_frame(refresh, frame_id)) {
            submit(&mut sink, &patterns, &mut frame_id, &options);
        }
        if notes.refreshes.len() >= 30 && !told {
            told = true;
            tell(&json!({ "showing": std::process::id() }));
        }
        if let Some(crcs) = &mut crcs {
            crcs.read()?;
        }
        sleep_until(&presenter)?;
    }
    if let Some(crcs) = &mut crcs {
        // The check sum of the last refresh comes a little after it.
        std::thread::sleep(Duration::from_millis(50));
        crcs.read()?;
    }
    report(&mut notes, &presenter, layout);
    if let Some(crcs) = crcs {
        compare(&notes.refreshes, &crcs.seen, &patterns, options.wrong_level);
    }
    Ok(())
}

fn tell_checks(presenter: &DrmPanel, t_begin: TimeNs) {
    let checks: Vec<_> = presenter
        .checks()
        .iter()
        .map(|check| json!([check.name, check.found, check.wanted, format!("{:?}", check.verdict).to_lowercase()]))
        .collect();
    let wrong = presenter.checks().iter().filter(|check| check.verdict == Verdict::Wrong).count();
    tell(&json!({ "opened_ms": (host_now() - t_begin).0 / 1_000_000, "wrong": wrong, "checks": checks }));
}

/// That of holod's own panel thread, where it may.
fn raise_priority() {
    let priority = ThreadPriority::Crossplatform(10.try_into().expect("a priority below 100"));
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    if set_thread_priority_and_policy(thread_native_id(), priority, policy).is_err() {
        tell(&json!({ "ordinary_priority": true }));
    }
}

/// Whether the newest frame has begun, or one that was left out is missing.
fn starts_frame(refresh: &PresentedRefresh, frame_id: u64) -> bool {
    refresh.field == 0 && (refresh.repeated || refresh.frame.is_some_and(|tag| tag.frame_id == frame_id))
}

fn submit(sink: &mut FrameSink, patterns: &[LevelsFrame], frame_id: &mut u64, options: &Options) {
    *frame_id += 1;
    if options.wrong_submission && *frame_id % 50 == 49 {
        return;
    }
    let levels = &patterns[(*frame_id % PATTERNS) as usize];
    let frame = sink.acquire();
    for colour in Colour::ALL {
        frame.field_mut(colour).write(&levels.unpack_colour(colour).levels);
    }
    let now = host_now();
    sink.submit(FrameTag { frame_id: *frame_id, t_submit: now, t_desired_present: now, keep: None });
}

fn wait_for_it(presenter: &mut DrmPanel, t_begin: TimeNs) -> Result<(), Box<dyn Error>> {
    let mut said = None;
    loop {
        match presenter.recover(host_now()) {
            Ok(()) => return Ok(()),
            Err(fault) if said != Some(fault) => {
                said = Some(fault);
                tell(&json!({ "not_yet": fault.to_string() }));
            }
            Err(_) => {}
        }
        if host_now() - t_begin > LIMIT {
            return Err("the panel did not come back".into());
        }
        std::thread::sleep(RECOVER_EVERY);
    }
}

fn sleep_until(presenter: &DrmPanel) -> io::Result<()> {
    let rest_ns = (presenter.t_next() - host_now()).0.max(0);
    let timeout = Timespec { tv_sec: rest_ns / 1_000_000_000, tv_nsec: rest_ns % 1_000_000_000 };
    let wake = presenter.wake_fd().map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
    match poll(wake.into_iter().collect::<Vec<_>>().as_mut_slice(), Some(&timeout)) {
        Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
        Err(why) => Err(why.into()),
    }
}

fn report(notes: &mut Notes, presenter: &DrmPanel, layout: FrameLayout) {
    // The first refreshes are those that make the clock believed.
    let begin =
        notes.refreshes.iter().position(|refresh| refresh.timestamp_source == TimestampSource::Hardware).unwrap_or(0);
    let believed = &notes.refreshes[begin..];
    let pairs = || believed.windows(2).map(|pair| (&pair[0], &pair[1]));
    let intervals_us = || pairs().map(|(a, b)| (b.t_present - a.t_present).0 / 1000);
    let id = |refresh: &PresentedRefresh| refresh.frame.map_or(0, |tag| tag.frame_id);
    let counted = |a: &PresentedRefresh, b: &PresentedRefresh| {
        a.refresh_count.zip(b.refresh_count).is_some_and(|(a, b)| b == a + 1)
    };
    let follows = |a: &PresentedRefresh, b: &PresentedRefresh| {
        let per_refresh = layout.fields_per_refresh();
        let next_field = (a.field + per_refresh) % layout.fields();
        b.field == next_field && id(b) == id(a) + u64::from(next_field == 0)
    };
    notes.tick_ns.sort_unstable();
    let tick_us = |share: f64| notes.tick_ns[((notes.tick_ns.len() - 1) as f64 * share) as usize] / 1000;
    let faults = presenter.flip_faults();
    tell(&json!({
        "refreshes": notes.refreshes.len(),
        "before_believed": begin,
        "hardware": believed.iter().filter(|refresh| refresh.timestamp_source == TimestampSource::Hardware).count(),
        "repeated": believed.iter().filter(|refresh| refresh.repeated).count(),
        "not_counted_on_by_one": pairs().filter(|(a, b)| !counted(a, b)).count(),
        "not_the_next_field_of_the_next_frame": pairs().filter(|(a, b)| !follows(a, b)).count(),
        "reported_before_their_time": notes.before_their_time,
        "interval_us": [intervals_us().min(), intervals_us().max()],
        "tick_us": { "median": tick_us(0.5), "p99": tick_us(0.99), "max": tick_us(1.0) },
        "allocations_in_tick": notes.allocations,
        "disbelieved": format!("{faults:?}"),
    }));
}

/// Each refresh's check sum beside that of the levels that were meant for it.
fn compare(refreshes: &[PresentedRefresh], crcs: &[(u32, u32)], patterns: &[LevelsFrame], wrong_level: bool) {
    let layout = patterns[0].layout();
    let mut expected: Vec<Vec<u32>> = Vec::new();
    for (index, frame) in patterns.iter().enumerate() {
        let fields = (0..layout.fields()).step_by(layout.fields_per_refresh());
        expected.push(fields.map(|field| vkms_crc(frame, field, wrong_level && index == 3)).collect());
    }
    let (mut equal, mut different, mut missing) = (0, 0, 0);
    for refresh in refreshes {
        let (Some(tag), Some(count)) = (refresh.frame, refresh.refresh_count) else { continue };
        let meant = expected[(tag.frame_id % PATTERNS) as usize][refresh.field / layout.fields_per_refresh()];
        match crcs.iter().find(|(of, _)| *of == count as u32) {
            Some((_, crc)) if *crc == meant => equal += 1,
            Some(_) => different += 1,
            None => missing += 1,
        }
    }
    let distinct: std::collections::BTreeSet<_> = expected.iter().flatten().collect();
    tell(&json!({ "crc": { "equal": equal, "different": different, "missing": missing, "patterns": distinct.len() } }));
}

/// A card, for what a session manager does with it.
struct Card(File);

impl AsFd for Card {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl Device for Card {}

fn steal(process: &str, card: &Path, milliseconds: &str) -> Result<(), Box<dyn Error>> {
    let id = rustix::process::Pid::from_raw(process.parse()?).ok_or("no process has the number 0")?;
    let process_fd = rustix::process::pidfd_open(id, rustix::process::PidfdFlags::empty())?;
    let mut taken = 0;
    for entry in fs::read_dir(format!("/proc/{process}/fd"))? {
        let entry = entry?;
        if fs::read_link(entry.path()).is_ok_and(|target| target == card) {
            let number = entry.file_name().to_string_lossy().parse()?;
            let flags = rustix::process::PidfdGetfdFlags::empty();
            let theirs = Card(rustix::process::pidfd_getfd(&process_fd, number, flags)?.into());
            theirs.release_master_lock()?;
            taken += 1;
        }
    }
    tell(&json!({ "taken": taken }));
    hold(card, milliseconds)
}

fn hold(card: &Path, milliseconds: &str) -> Result<(), Box<dyn Error>> {
    let card = Card(OpenOptions::new().read(true).write(true).open(card)?);
    card.acquire_master_lock()?;
    tell(&json!({ "master": std::process::id() }));
    std::thread::sleep(Duration::from_millis(milliseconds.parse()?));
    Ok(())
}
