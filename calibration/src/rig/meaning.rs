//! What a rig's figures mean, for a person who checks a bench.

use std::f64::consts::{PI, TAU};
use std::fmt;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use serde::Serialize;

use super::{LaserDriver, Lasers, LevelPhase, Orientation, Panel, PanelMode, PanelProfile, Rig, Tracker, VideoMargins};
use crate::{Colour, PerColour, PupilDiameter, Resolution, TimeNs};

/// The pupils for which blur is worked out.
const PUPILS_MM: [f32; 3] = [2.0, 3.0, 4.0];

/// The ranges, in radians, of tables that may hold multiples of π.
const IN_PI: RangeInclusive<f64> = 1.5..=2.1;

/// Above this a stroke leaves so few levels that somebody should know.
const LONG_STROKE_RAD: f64 = 2.5 * PI;

/// Powers below this, with limits below that, may be in watts.
const LOW_POWER_MW: f64 = 0.01;
const LOW_LIMIT_MW: f64 = 0.1;

/// A figure for each colour.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "the names say it")]
pub struct PerColourFigures<T = f64> {
    pub red: T,
    pub green: T,
    pub blue: T,
}

/// What follows from a rig file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Meaning {
    /// `name` of the rig file, or the name of the file.
    pub name: String,
    /// The rig file; empty for the built-in rig.
    pub origin: String,
    /// Hash of the rig file's text, hexadecimal; absent for the built-in rig.
    pub text_hash: Option<String>,
    /// The panel profile behind the rig file's own keys.
    pub panel_profile: Option<String>,
    /// Panel width in pixels.
    pub width_px: usize,
    /// Panel height in pixels.
    pub height_px: usize,
    /// The video frame around the panel's pixels; absent where it is theirs.
    pub video: Option<VideoMeaning>,
    /// Angle that one pixel subtends at the eye.
    pub pixel_angle_mrad: f64,
    /// Field of view across the panel's width and height.
    pub field_of_view_deg: [f64; 2],
    /// Vergence of the far end of the depth range.
    pub depth_far_dpt: f64,
    /// Vergence of the near end of the depth range.
    pub depth_near_dpt: f64,
    /// Distance of the far end in metres; absent at infinity.
    pub depth_far_m: Option<f64>,
    /// Distance of the near end in metres.
    pub depth_near_m: f64,
    /// Distance u = f²·D from the panel to the image plane of the far end.
    pub u_far_mm: f64,
    /// Distance u = f²·D from the panel to the image plane of the near end.
    pub u_near_mm: f64,
    /// Width λf/p of the eyebox.
    pub eyebox_mm: PerColourFigures,
    /// Width λf/2p of the part of the eyebox that light with a smooth phase fills: the half band that the 4f stop lets
    /// through.
    pub half_band_eyebox_mm: PerColourFigures,
    /// The largest blur over the depth range that such light can show, λ·(f/p)²·V/2.
    pub smooth_phase_blur_px: PerColourFigures,
    /// Half-angle λ/2p to which the panel can send light.
    pub panel_half_angle_mrad: PerColourFigures,
    /// The blur of a point at one end of the depth range for an eye focused at the other.
    pub blurs: Vec<BlurMeaning>,
    /// How one colour field passes.
    pub field: FieldMeaning,
    /// The light that it brings.
    pub lasers: LaserMeaning,
    /// The tracker, and what holds without it.
    pub tracker: TrackerMeaning,
    /// By how much a pupil must move until holograms are made for another one.
    pub pupil_step_mm: f64,
    /// The largest change of blur that is left to that.
    pub pupil_step_px: f64,
    /// Bits of one level.
    pub bit_depth: u8,
    /// Where these bits travel on the video link.
    pub packing: String,
    /// The calibration files in use, each applied once.
    pub files: Vec<ActiveFile>,
    /// What a person should know before the lasers are armed.
    pub notes: Vec<String>,
}

/// The largest blur for one pupil.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BlurMeaning {
    /// Diameter of the pupil, millimetres.
    pub pupil_mm: f64,
    /// Diameter of the largest circle of confusion.
    pub largest_blur_px: f64,
    /// Half-angle s/2f that light must leave the panel with to fill the pupil.
    pub half_angle_needed_mrad: f64,
    /// That half-angle over the panel's own; above 1 the panel cannot fill the pupil.
    pub share_of_panel_band: PerColourFigures,
}

/// One colour field, in time from the panel's update.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FieldMeaning {
    /// How the fields reach the panel.
    pub mode: String,
    /// The panel's refresh rate.
    pub refresh_hz: f64,
    /// Complete colour frames a second.
    pub colour_frames_hz: f64,
    /// The colour of each field of a colour frame, in the order in which they are shown.
    pub order: Vec<String>,
    /// The channel of the video that carries each of them, in channel-packed mode.
    pub channels: Option<[&'static str; 3]>,
    /// Length of one field.
    pub period_ms: f64,
    /// When the phase has settled.
    pub settled_ms: f64,
    /// From the display's refresh to the panel's update with its video.
    pub latency_ms: f64,
    /// Who lights the laser for this field alone: `laser-box` or `panel`; absent where it is on while it is armed.
    pub gated_by: Option<&'static str>,
    /// When the laser goes on; absent where no box switches it for this field.
    pub laser_on_ms: Option<f64>,
    /// When the laser goes off; absent likewise.
    pub laser_off_ms: Option<f64>,
    /// Share of the field for which the laser is lit: 1 where it is on while it is armed. Absent where the panel gates
    /// it, which holod does not know the times of.
    pub lit_share: Option<f64>,
    /// Share of all time for which one colour is lit; absent likewise.
    pub time_share: Option<f64>,
}

/// A video frame that is larger than the panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct VideoMeaning {
    /// Its width in pixels.
    pub width_px: usize,
    /// Its height in pixels.
    pub height_px: usize,
    /// The column that the panel shows first.
    pub left_px: usize,
    /// The row that it shows first.
    pub top_px: usize,
}

/// The lasers and what keeps them in bounds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LaserMeaning {
    /// `simulated`, `serial`, `ready-beam` or `text`.
    pub driver: String,
    /// The ports that it uses.
    pub ports: Vec<PathBuf>,
    /// Optical power at the panel while a colour is lit; absent of a laser that is not there.
    pub power_mw: PerColourFigures<Option<f64>>,
    /// Greatest power that the rig allows; absent where it says none, and of a laser that is not there.
    pub power_limit_mw: PerColourFigures<Option<f64>>,
    /// What the laser itself is told, of those that are told another power than that at the panel.
    pub head_power_mw: PerColourFigures<Option<f64>>,
    /// Greatest power that the rig allows the laser itself; absent where it says none.
    pub head_limit_mw: PerColourFigures<Option<f64>>,
    /// The one colour that the panel's mode shows, in monochrome mode.
    pub shown: Option<&'static str>,
    /// What holds in place of a limit that is absent.
    pub power_max_mw: f64,
    /// Power at the panel of lasers that are set to 100 %, of those that are set in percent.
    pub full_power_mw: Option<PerColourFigures>,
    /// The lasers go dark by themselves when they have heard nothing for this long; absent where they stay lit when
    /// holod dies.
    pub heartbeat_timeout_ms: Option<f64>,
    /// They go dark when one hologram has stayed for this long; absent where that follows from the frames' time.
    pub stall_timeout_ms: Option<f64>,
}

/// What `[tracker]` comes to, with what holds where it says nothing.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrackerMeaning {
    /// As on the command line; absent where the rig names none.
    pub spec: Option<String>,
    /// `left`, `right`, `both` or `better`.
    pub eye: String,
    /// Millimetres for one unit of the tracker's figure; absent where the rig says none.
    pub scale_mm_per_unit: Option<f64>,
    /// The diameter after a long loss.
    pub fallback_mm: f64,
    /// How long the last good diameter is held before.
    pub hold_ms: f64,
}

/// A calibration file that is in use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ActiveFile {
    /// What is read from it: `lut` or `flatness`.
    pub kind: String,
    /// The colour that it serves.
    pub colour: String,
    /// Its path as it was opened: a relative one of the rig file is behind its folder.
    pub path: PathBuf,
}

impl<T> From<PerColour<T>> for PerColourFigures<T> {
    fn from(figures: PerColour<T>) -> Self {
        let [red, green, blue] = figures.0;
        Self { red, green, blue }
    }
}

impl Meaning {
    pub(super) fn of(rig: &Rig) -> Self {
        let geometry = &rig.geometry;
        let field_of_view_deg = [geometry.resolution.width, geometry.resolution.height].map(|pixels| {
            let half_width_m = pixels as f64 * geometry.pixel_pitch.0 / 2.0;
            2.0 * (half_width_m / geometry.eyepiece_focal_length.0).atan().to_degrees()
        });
        let panel_half_angle = geometry.panel_half_angle_rad();
        let blurs = PUPILS_MM.map(|pupil_mm| {
            let pupil = PupilDiameter::from_mm(pupil_mm);
            let needed_rad = geometry.blur_half_angle_rad(pupil);
            BlurMeaning {
                pupil_mm: f64::from(pupil_mm),
                largest_blur_px: geometry.largest_coc_px(pupil),
                half_angle_needed_mrad: needed_rad * 1e3,
                share_of_panel_band: panel_half_angle.map(|there_is_rad| needed_rad / there_is_rad).into(),
            }
        });
        Self {
            name: rig.name.clone(),
            origin: rig.provenance.origin.clone(),
            text_hash: rig.provenance.hash_text(),
            panel_profile: rig.provenance.panel_profile.map(str::to_owned),
            width_px: geometry.resolution.width,
            height_px: geometry.resolution.height,
            video: VideoMeaning::of(rig),
            pixel_angle_mrad: geometry.pixel_angle_rad() * 1e3,
            field_of_view_deg,
            depth_far_dpt: geometry.depth_far.0,
            depth_near_dpt: geometry.depth_near.0,
            depth_far_m: (geometry.depth_far.0 > 0.0).then(|| 1.0 / geometry.depth_far.0),
            depth_near_m: 1.0 / geometry.depth_near.0,
            u_far_mm: geometry.image_distance(geometry.depth_far).0 * 1e3,
            u_near_mm: geometry.image_distance(geometry.depth_near).0 * 1e3,
            eyebox_mm: geometry.eyebox().map(|width| width.0 * 1e3).into(),
            half_band_eyebox_mm: geometry.half_band_eyebox().map(|width| width.0 * 1e3).into(),
            smooth_phase_blur_px: geometry.volume_fresnel_px2().map(|px2| px2 / 2.0).into(),
            panel_half_angle_mrad: panel_half_angle.map(|angle_rad| angle_rad * 1e3).into(),
            blurs: blurs.to_vec(),
            field: FieldMeaning::of(rig),
            lasers: LaserMeaning::of(&rig.lasers, rig.panel.mode),
            tracker: TrackerMeaning::of(&rig.tracker),
            pupil_step_mm: rig.pupil_step().0 * 1e3,
            pupil_step_px: geometry.largest_coc_px(PupilDiameter::from_mm((rig.pupil_step().0 * 1e3) as f32)),
            bit_depth: rig.panel.bit_depth,
            packing: rig.panel.packing.name().into(),
            files: active_files(rig),
            notes: notes(rig),
        }
    }
}

impl VideoMeaning {
    fn of(rig: &Rig) -> Option<Self> {
        let margins = rig.panel.video_margins;
        let Resolution { width, height } = margins.around(rig.geometry.resolution);
        (margins != VideoMargins::default()).then_some(Self {
            width_px: width,
            height_px: height,
            left_px: margins.left,
            top_px: margins.top,
        })
    }
}

impl fmt::Display for VideoMeaning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { width_px, height_px, left_px, top_px } = self;
        write!(f, "in a video frame of {width_px}x{height_px} from column {left_px}, row {top_px} on")
    }
}

impl FieldMeaning {
    fn of(rig: &Rig) -> Self {
        let panel = &rig.panel;
        let period_ms = 1e3 / (panel.refresh_hz * panel.mode.fields_per_refresh());
        let settled_ms = milliseconds(panel.settle);
        let laser_on_ms = settled_ms + milliseconds(rig.lasers.on_delay);
        let lit_ms = milliseconds(rig.lasers.width);
        let gated_by = match &rig.lasers {
            lasers if lasers.driver.gates_fields() => Some("laser-box"),
            lasers if lasers.gated_by_panel && panel.mode == PanelMode::ChannelPacked => Some("panel"),
            _ => None,
        };
        let by_box = gated_by == Some("laser-box");
        let share = |of_box: f64| match gated_by {
            None => Some(1.0),
            Some(_) => by_box.then_some(of_box),
        };
        let lit_share = lit_ms / period_ms;
        let first = panel.colour_of_field(0);
        let fields_of_colour = (0..panel.fields()).filter(|&field| panel.colour_of_field(field) == first).count();
        Self {
            mode: panel.mode.name().into(),
            refresh_hz: panel.refresh_hz,
            colour_frames_hz: 1e3 / (panel.fields() as f64 * period_ms),
            order: (0..panel.fields()).map(|field| panel.colour_of_field(field).name().to_owned()).collect(),
            channels: (panel.mode == PanelMode::ChannelPacked).then(|| panel.channel_order.map(Colour::name)),
            period_ms,
            settled_ms,
            latency_ms: milliseconds(panel.latency),
            gated_by,
            lit_share: share(lit_share),
            time_share: share(lit_share * fields_of_colour as f64 / panel.fields() as f64),
            laser_on_ms: by_box.then_some(laser_on_ms),
            laser_off_ms: by_box.then_some(laser_on_ms + lit_ms),
        }
    }
}

impl LaserMeaning {
    fn of(lasers: &Lasers, mode: PanelMode) -> Self {
        let Lasers { driver, power_mw, power_limit_mw, head_limit_mw, heartbeat_timeout, stall_timeout, .. } = lasers;
        let full_power_mw = match driver {
            LaserDriver::ReadyBeam { full_power_uw, .. } => Some(full_power_uw.map(|uw| f64::from(uw) / 1e3).into()),
            _ => None,
        };
        let of_lasers = |figure: &dyn Fn(Colour) -> Option<f64>| {
            PerColour(Colour::ALL.map(|colour| driver.has(colour).then(|| figure(colour)).flatten())).into()
        };
        Self {
            driver: driver.name().into(),
            ports: driver.paths().into_iter().map(PathBuf::from).collect(),
            power_mw: of_lasers(&|colour| Some(power_mw[colour])),
            power_limit_mw: of_lasers(&|colour| power_limit_mw[colour]),
            head_power_mw: of_lasers(&|colour| {
                let head_uw = driver.head_power_uw(colour, Lasers::whole_uw(power_mw[colour]))?;
                Some(head_uw as f64 / 1e3)
            }),
            head_limit_mw: of_lasers(&|colour| head_limit_mw[colour]),
            shown: match mode {
                PanelMode::Monochrome(colour) => Some(colour.name()),
                PanelMode::ChannelPacked | PanelMode::FieldSequential => None,
            },
            power_max_mw: Lasers::POWER_MAX_MW,
            full_power_mw,
            heartbeat_timeout_ms: driver.has_heartbeat().then(|| milliseconds(*heartbeat_timeout)),
            stall_timeout_ms: stall_timeout.map(milliseconds),
        }
    }
}

impl TrackerMeaning {
    fn of(tracker: &Tracker) -> Self {
        Self {
            spec: tracker.spec.clone(),
            eye: tracker.eye.name().into(),
            scale_mm_per_unit: tracker.scale,
            fallback_mm: rounded(f64::from(tracker.fallback.mm())),
            hold_ms: milliseconds(tracker.hold),
        }
    }
}

impl Rig {
    /// What a run, too, should say of the rig's figures before it shows anything: phases that cannot be shown, and
    /// figures that are likely to be in another unit.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = self.panel_warnings();
        warnings.extend(self.times_in_seconds());
        warnings.extend(self.lasers.powers_in_watts());
        warnings
    }

    /// What of [`Self::warnings`] is in whatever the panel shows: phases and levels that it does without, in colours
    /// that are lit.
    pub fn panel_warnings(&self) -> Vec<String> {
        let light = self.light();
        let lit: Vec<Colour> = Colour::ALL.into_iter().filter(|&colour| light[colour] > 0.0).collect();
        self.panel.warnings(&lit)
    }

    /// Times of a field that are so short that they would also fit into it if they were in seconds, and a latency that
    /// would be within its bounds.
    fn times_in_seconds(&self) -> Option<String> {
        let field_ns = self.panel.field_period().0;
        let times = [
            ("settle_ms", self.panel.settle, field_ns / 1000),
            ("latency_ms", self.panel.latency, 100_000),
            ("on_delay_ms", self.lasers.on_delay, field_ns / 1000),
            ("lit_ms", self.lasers.width, field_ns / 1000),
        ];
        let short = times.into_iter().filter(|(_, TimeNs(ns), least_ns)| (1..*least_ns).contains(ns));
        let short: Vec<_> = short.map(|(key, time, _)| (key, time)).collect();
        // A delay as short as that is nothing odd by itself.
        if short.iter().all(|(key, _)| *key == "on_delay_ms") {
            return None;
        }
        let written = |per_unit: f64| {
            let figures = short.iter().map(|(key, TimeNs(ns))| format!("{key} = {}", *ns as f64 / per_unit));
            figures.collect::<Vec<_>>().join(", ")
        };
        Some(format!(
            "{}: short for a field of {:.3} ms; where that is in seconds, write {}",
            written(1e6),
            field_ns as f64 / 1e6,
            written(1e3)
        ))
    }
}

impl Lasers {
    /// Powers of real lasers that are so low, with limits that are none or low, too, that they may be in watts.
    fn powers_in_watts(&self) -> Vec<String> {
        if self.driver == LaserDriver::Simulated {
            return Vec::new();
        }
        let doubtful = self.power_mw.iter().filter(|&(colour, &power_mw)| {
            let limit_mw = self.power_limit_mw[colour].unwrap_or(0.0);
            self.driver.has(colour) && power_mw > 0.0 && power_mw < LOW_POWER_MW && limit_mw < LOW_LIMIT_MW
        });
        let notes = doubtful.map(|(colour, power_mw)| {
            format!(
                "{colour}: the laser's power is {power_mw} mW; where power_mw is in watts, write {}",
                (power_mw * 1e9).round() / 1e6
            )
        });
        notes.collect()
    }
}

impl Panel {
    /// Phases and levels that the panel does without in these colours.
    fn warnings(&self, colours: &[Colour]) -> Vec<String> {
        let mut warnings = self.short_strokes(colours);
        warnings.extend(self.long_strokes(colours));
        let levels = 1usize << self.bit_depth;
        let tables = colours.iter().filter_map(|&colour| Some((colour, self.lut[colour].as_ref()?.len())));
        warnings.extend(tables.filter(|(_, named)| *named < levels).map(|(colour, named)| {
            format!("{colour}: of {levels} levels only the {named} in the table are used; none is put between them")
        }));
        let is_unordered = |colour: &Colour| self.lut[*colour].as_ref().is_some_and(|table| !is_in_order(table));
        warnings.extend(colours.iter().copied().filter(is_unordered).map(|colour| {
            format!(
                "{colour}: the phases in the table neither rise nor fall with the level: they are taken as they stand, \
                 and phase_sign is not applied to them"
            )
        }));
        warnings
    }

    /// The widest part of the circle that no level of `colour` reaches, and the widest step elsewhere, in radians.
    fn gap_and_step(&self, colour: Colour) -> [f64; 2] {
        let stroke_rad = self.stroke_rad[colour];
        let Some(table) = &self.lut[colour] else {
            return [TAU - stroke_rad, stroke_rad / f64::from((1u32 << self.bit_depth) - 1)];
        };
        let mut phases_rad: Vec<f64> = table.iter().map(|entry| entry.phase_rad).collect();
        if is_in_order(table) {
            let step_rad = phases_rad.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
            return [TAU - stroke_rad, step_rad];
        }
        phases_rad.iter_mut().for_each(|phase_rad| *phase_rad = phase_rad.rem_euclid(TAU));
        phases_rad.sort_by(f64::total_cmp);
        let across_0 = phases_rad[0] + TAU - phases_rad[phases_rad.len() - 1];
        let steps = phases_rad.windows(2).map(|pair| pair[1] - pair[0]).chain([across_0]);
        steps.fold([0.0; 2], |[gap, step], next| [gap.max(next), step.max(next.min(gap))])
    }

    /// For each of `colours` whose stroke is much more than 2π, how few levels that leaves.
    fn long_strokes(&self, colours: &[Colour]) -> Vec<String> {
        let levels = 1u32 << self.bit_depth;
        let strokes = colours.iter().map(|&colour| (colour, self.stroke_rad[colour]));
        let long = strokes.filter(|&(colour, stroke_rad)| self.lut[colour].is_none() && stroke_rad > LONG_STROKE_RAD);
        // All of them would be radians, and hardly any panel has less than half a wave.
        let may_be_radians = self.stroke_rad.0.iter().all(|stroke_rad| stroke_rad / PI >= PI);
        let notes = long.map(|(colour, stroke_rad)| {
            let stroke_pi = stroke_rad / PI;
            let last_level = (f64::from(levels - 1) * TAU / stroke_rad) as u32;
            let mut said = format!(
                "{colour}: of {levels} levels only 0 to {last_level} are used, the first 2 π of the panel's \
                 {stroke_pi:.3} π"
            );
            if may_be_radians {
                said += &format!("; where stroke_pi is in radians, write {:.3}", stroke_pi / PI);
            }
            said
        });
        notes.collect()
    }

    /// For each of `colours` whose levels leave a gap on the circle, what becomes of the phases that cannot be shown.
    fn short_strokes(&self, colours: &[Colour]) -> Vec<String> {
        let notes = colours.iter().filter_map(|&colour| {
            let [gap_rad, step_rad] = self.gap_and_step(colour);
            // The top level of a 2π panel stands one step short of 2π.
            if gap_rad <= 1.5 * step_rad {
                return None;
            }
            let stroke_rad = TAU - gap_rad;
            let is_in_pi = self.lut[colour].is_some() && IN_PI.contains(&stroke_rad);
            Some(format!(
                "{colour}: the panel's stroke is {:.3} π; phases between that and 2 π cannot be shown and {}{}",
                stroke_rad / PI,
                self.out_of_stroke.meaning(),
                if is_in_pi { "; where the phases in its table are multiples of π, multiply them by π" } else { "" }
            ))
        });
        notes.collect()
    }
}

/// Whether the phase rises or falls with the level throughout.
pub(super) fn is_in_order(table: &[LevelPhase]) -> bool {
    let phases_rad = || table.iter().map(|entry| entry.phase_rad);
    phases_rad().is_sorted() || phases_rad().is_sorted_by(|a, b| a >= b)
}

fn milliseconds(TimeNs(ns): TimeNs) -> f64 {
    ns as f64 / 1e6
}

/// A figure rounded to three decimals.
fn rounded(figure: f64) -> f64 {
    (figure * 1e3).round() / 1e3
}

fn active_files(rig: &Rig) -> Vec<ActiveFile> {
    let kinds = [("lut", &rig.provenance.lut_files), ("flatness", &rig.provenance.flatness_files)];
    let files = kinds.into_iter().flat_map(|(kind, files)| {
        files.iter().filter_map(move |(colour, file)| {
            Some(ActiveFile { kind: kind.into(), colour: colour.name().into(), path: file.as_ref()?.path.clone() })
        })
    });
    files.collect()
}

fn notes(rig: &Rig) -> Vec<String> {
    let mut notes = rig.warnings();
    notes.extend(laser_notes(rig));
    notes.extend(optics_notes(rig));
    if let Some(profile) = rig.provenance.panel_profile.and_then(PanelProfile::named)
        && !profile.unverified.is_empty()
    {
        notes.push(format!(
            "panel profile {} ({}): no source confirms {}; compare with the panel's data sheet",
            profile.name,
            profile.description,
            profile.unverified.join(", ")
        ));
    }
    if rig.lasers.driver == LaserDriver::Simulated {
        notes.push("the lasers are simulated: no light will be lit".into());
    }
    notes
}

fn laser_notes(rig: &Rig) -> Vec<String> {
    let mut notes = Vec::new();
    for (colour, power_mw) in rig.lasers.power_mw.iter().filter(|(colour, _)| rig.lasers.driver.has(*colour)) {
        if *power_mw == 0.0 {
            notes.push(format!("{colour}: the laser's power is 0, so this colour stays dark"));
        }
        let told_mw = f64::from(Lasers::whole_uw(*power_mw)) / 1e3;
        if told_mw < *power_mw * (1.0 - 1e-6) {
            notes.push(format!("{colour}: lit with {told_mw} mW, as lasers are told whole microwatts"));
        }
    }
    let slack = rig.panel.mode.window_slack(rig.panel.field_period());
    let room = rig.panel.field_period() - rig.panel.settle - rig.lasers.on_delay - slack;
    if rig.lasers.width > room && rig.lasers.driver.gates_fields() {
        notes.push(format!(
            "lit_ms is cut to {:.3}: a window ends {:.3} ms before its field at least, for a panel that is a little fast",
            room.0.max(0) as f64 / 1e6,
            slack.0 as f64 / 1e6
        ));
    }
    let unlimited = |colour: &Colour| rig.lasers.driver.has(*colour) && rig.lasers.power_limit_mw[*colour].is_none();
    let unlimited: Vec<&str> = Colour::ALL.into_iter().filter(unlimited).map(Colour::name).collect();
    if rig.lasers.driver != LaserDriver::Simulated && !unlimited.is_empty() {
        notes.push(format!(
            "{}: no power_limit_mw, so that a power_mw of up to {} is taken, a slip too: write what this bench's \
             optics allow an eye",
            unlimited.join(", "),
            Lasers::POWER_MAX_MW
        ));
    }
    if rig.lasers.gated_by_panel && rig.panel.mode != PanelMode::ChannelPacked {
        notes.push("gated_by_panel is without effect in this mode, in which lasers are on while they are armed".into());
    }
    let at_the_head = |colour: &Colour| match &rig.lasers.driver {
        LaserDriver::Text { transmission_ppb, .. } => {
            rig.lasers.driver.has(*colour) && transmission_ppb[*colour] == 1_000_000_000
        }
        _ => false,
    };
    let at_the_head: Vec<&str> = Colour::ALL.into_iter().filter(at_the_head).map(Colour::name).collect();
    if !at_the_head.is_empty() {
        notes.push(format!(
            "{}: the laser itself is told power_mw, of which fibre, polariser and lenses let less through to the \
             panel: write into transmission the share that does, and into head_limit_mw what the laser may be told",
            at_the_head.join(", ")
        ));
    }
    notes
}

fn optics_notes(rig: &Rig) -> Vec<String> {
    let mut notes = Vec::new();
    if rig.panel.orientation != Orientation::Normal {
        notes.push(format!("pictures lie on the panel in the orientation {}", rig.panel.orientation.name()));
    }
    if rig.relay_magnification != 1.0 {
        notes.push(format!(
            "the relay makes the panel's image {} times as large as the panel: all is computed as behind an eyepiece of \
             {:.2} mm and a relay of 1",
            rig.relay_magnification,
            rig.geometry.eyepiece_focal_length.0 * 1e3
        ));
    }
    let longest = rig.stop_colour();
    notes.push(format!(
        "the stop of the 4f relay is one for all colours: set it for {longest}, λ·F/2p = {:.2} mm wide for each \
         100 mm of the focal length F before it",
        100.0 * rig.geometry.wavelengths[longest].0 / (2.0 * rig.geometry.pixel_pitch.0)
    ));
    let filled_mm = rig.geometry.half_band_eyebox().map(|width| width.0 * 1e3);
    if filled_mm.0.into_iter().any(|width_mm| width_mm < f64::from(PUPILS_MM[PUPILS_MM.len() - 1])) {
        let filled_mm = PerColourFigures::from(filled_mm);
        notes.push(format!("the half band fills {filled_mm} mm of the eyebox; a wider pupil is not filled"));
    }
    notes
}

impl fmt::Display for PerColourFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "red {:.2}, green {:.2}, blue {:.2}", self.red, self.green, self.blue)
    }
}

impl fmt::Display for LaserMeaning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "lasers         {}", self.driver)?;
        self.ports.iter().try_for_each(|port| write!(f, " {}", port.display()))?;
        match self.heartbeat_timeout_ms {
            Some(timeout_ms) => write!(f, "; dark when nothing is heard of holod for {timeout_ms} ms")?,
            None => f.write_str("; without a heartbeat: lit when holod dies")?,
        }
        match self.stall_timeout_ms {
            Some(timeout_ms) => writeln!(f, ", or when one hologram has stayed for {timeout_ms} ms")?,
            None => writeln!(f)?,
        }
        let [powers_mw, limits_mw, heads_mw, head_limits_mw] =
            [self.power_mw, self.power_limit_mw, self.head_power_mw, self.head_limit_mw]
                .map(|PerColourFigures { red, green, blue }| PerColour([red, green, blue]));
        let powers = Colour::ALL.into_iter().filter_map(|colour| {
            let power_mw = powers_mw[colour]?;
            let dark =
                if self.shown.is_some_and(|shown| shown != colour.name()) { ", not lit in this mode" } else { "" };
            Some(match limits_mw[colour] {
                Some(limit_mw) => format!("{colour} {power_mw} mW of at most {limit_mw}{dark}"),
                None => {
                    format!("{colour} {power_mw} mW without a power_limit_mw ({} at most){dark}", self.power_max_mw)
                }
            })
        });
        writeln!(f, "power          {}", powers.collect::<Vec<_>>().join(", "))?;
        let heads = Colour::ALL.into_iter().filter_map(|colour| {
            let limit = head_limits_mw[colour].map_or(String::new(), |limit_mw| format!(" of at most {limit_mw}"));
            Some(format!("{colour} {} mW{limit}", heads_mw[colour]?))
        });
        let heads: Vec<_> = heads.collect();
        if !heads.is_empty() {
            writeln!(f, "at the laser   {}", heads.join(", "))?;
        }
        match &self.full_power_mw {
            Some(PerColourFigures { red, green, blue }) => {
                writeln!(f, "at 100 %       red {red}, green {green}, blue {blue} mW")
            }
            None => Ok(()),
        }
    }
}

impl fmt::Display for TrackerMeaning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { spec, eye, scale_mm_per_unit, fallback_mm, hold_ms } = self;
        let spec = spec.as_deref().unwrap_or("none named");
        let scale = match scale_mm_per_unit {
            Some(scale) => format!("{scale} mm for one unit of its figure"),
            None => "no scale_mm_per_unit".into(),
        };
        writeln!(
            f,
            "tracker        {spec}; eye: {eye}; {scale}; lost, the last is held for {hold_ms} ms, then {fallback_mm} mm"
        )
    }
}

impl fmt::Display for Meaning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_view(f)?;
        self.write_eyebox(f)?;
        self.write_fields(f)?;
        write!(f, "{}{}", self.lasers, self.tracker)?;
        if self.pupil_step_mm == 0.0 {
            writeln!(f, "pupil step     none: each hologram is made for the pupil of its own time")?;
        } else {
            writeln!(
                f,
                "pupil step     {:.3} mm, {:.2} px of the largest blur: what moves less keeps its hologram",
                self.pupil_step_mm, self.pupil_step_px
            )?;
        }
        writeln!(f, "levels         {} bits, packing {}", self.bit_depth, self.packing)?;
        if self.files.is_empty() {
            writeln!(f, "files          none: phase is linear in the level, and the panel is taken as flat")?;
        }
        for file in &self.files {
            writeln!(f, "{:<14} {}: {}", file.kind, file.colour, file.path.display())?;
        }
        self.notes.iter().try_for_each(|note| writeln!(f, "note           {note}"))
    }
}

impl Meaning {
    /// The rig's name and file, and what of a scene it can show.
    fn write_view(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "rig            {}", self.name)?;
        if let Some(hash) = &self.text_hash {
            write!(f, " ({}, {hash})", self.origin)?;
        }
        writeln!(f)?;
        write!(f, "panel          {}x{} pixels", self.width_px, self.height_px)?;
        if let Some(video) = &self.video {
            write!(f, " {video}")?;
        }
        if let Some(profile) = &self.panel_profile {
            write!(f, ", profile {profile}")?;
        }
        let [across_deg, down_deg] = self.field_of_view_deg;
        writeln!(
            f,
            "; one pixel is {:.3} mrad, the view {across_deg:.1} x {down_deg:.1} degrees",
            self.pixel_angle_mrad
        )?;
        let far_m = self.depth_far_m.map_or("infinity".into(), |far_m| format!("{far_m:.2} m"));
        writeln!(
            f,
            "depth          {:.3} to {:.3} dioptres: {far_m} to {:.2} m, u = {:.3} to {:.3} mm",
            self.depth_far_dpt, self.depth_near_dpt, self.depth_near_m, self.u_far_mm, self.u_near_mm
        )
    }

    /// Where a pupil sees how much of the light, and how sharply.
    fn write_eyebox(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "eyebox         {} mm", self.eyebox_mm)?;
        writeln!(f, "half band      fills {} mm of the eyebox", self.half_band_eyebox_mm)?;
        writeln!(
            f,
            "               so light with a smooth phase is blurred by at most {} px",
            self.smooth_phase_blur_px
        )?;
        writeln!(f, "panel's band   {} mrad either side", self.panel_half_angle_mrad)?;
        self.blurs.iter().try_for_each(|blur| {
            writeln!(
                f,
                "pupil {} mm     blur up to {:.1} px; needs {:.1} mrad, of the panel's band {}",
                blur.pupil_mm, blur.largest_blur_px, blur.half_angle_needed_mrad, blur.share_of_panel_band
            )
        })
    }

    /// When each colour is on the panel, and lit.
    fn write_fields(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let field = &self.field;
        writeln!(
            f,
            "colour fields  {} at {} Hz: {}{}, {:.3} ms each, {:.1} colour frames a second",
            field.mode,
            field.refresh_hz,
            field.order.join(", "),
            field.channels.map_or(String::new(), |channels| format!(" in the channels {}", channels.join(", "))),
            field.period_ms,
            field.colour_frames_hz
        )?;
        if field.latency_ms > 0.0 {
            let refreshes = field.latency_ms * field.refresh_hz / 1e3;
            writeln!(
                f,
                "latency        {:.3} ms, {refreshes:.2} refreshes: so much later the panel shows what the display was given",
                field.latency_ms
            )?;
        }
        write!(f, "in one field   settled at {:.3} ms", field.settled_ms)?;
        match (field.laser_on_ms, field.laser_off_ms, field.lit_share, field.time_share) {
            (Some(on_ms), Some(off_ms), Some(lit_share), Some(time_share)) => writeln!(
                f,
                ", laser on at {on_ms:.3}, off at {off_ms:.3}: lit for {:.0} % of it, {} for {:.0} % of the time",
                lit_share * 100.0,
                self.lasers.shown.unwrap_or("each colour"),
                time_share * 100.0
            ),
            (.., None) => writeln!(f, "; lit as the panel gates the lasers, whatever on_delay_ms and lit_ms say"),
            _ => writeln!(
                f,
                "; the laser is on while it is armed: lit for 100 % of it, while the phase settles, too, whatever \
                 on_delay_ms and lit_ms say"
            ),
        }
    }
}
