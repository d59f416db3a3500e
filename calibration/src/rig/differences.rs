//! What one rig has that another has not, by the keys of the rig file.

use super::{Lasers, Model, Panel, Rig, Tracker, VideoMargins};
use crate::DisplayGeometry;

/// A key of the rig file, and whether two rigs have the same there.
type Compared = (&'static str, bool);

impl Rig {
    /// The keys, such as `tracker.hold_ms`, whose figures in `self` are not those in `other`. A panel profile counts as
    /// the keys that it gives, a file as what was read from it, `model.weights_file` as `model.network`, a depth's two
    /// spellings as `optics.depth_far` and `optics.depth_near`. Comments are no difference.
    pub fn differences(&self, other: &Self) -> Vec<&'static str> {
        // Here and below fields are named one by one, so that a new one must be thought of.
        let Self { name, panel, geometry: _, relay_magnification: _, lasers, tracker, model, provenance: _ } = self;
        let tables: [&[Compared]; 7] = [
            &[("name", *name == other.name)],
            &compared_pixels(self, other),
            &compared_panels(panel, &other.panel),
            &compared_optics(self, other),
            &compared_lasers(lasers, &other.lasers),
            &compared_trackers(tracker, &other.tracker),
            &compared_models(model, &other.model),
        ];
        tables.into_iter().flatten().filter_map(|&(key, same)| (!same).then_some(key)).collect()
    }
}

fn compared_pixels(rig: &Rig, other: &Rig) -> [Compared; 7] {
    let (resolution, other_resolution) = (rig.geometry.resolution, other.geometry.resolution);
    let (margins, other_margins) = (rig.panel.video_margins, other.panel.video_margins);
    // Without margins the video frame is the panel.
    let is_framed = [margins, other_margins] != [VideoMargins::default(); 2];
    let (video, other_video) = (margins.around(resolution), other_margins.around(other_resolution));
    [
        ("panel.width_px", resolution.width == other_resolution.width),
        ("panel.height_px", resolution.height == other_resolution.height),
        ("panel.video_width_px", !is_framed || video.width == other_video.width),
        ("panel.video_height_px", !is_framed || video.height == other_video.height),
        ("panel.video_left_px", margins.left == other_margins.left),
        ("panel.video_top_px", margins.top == other_margins.top),
        ("panel.pixel_pitch_um", rig.geometry.pixel_pitch == other.geometry.pixel_pitch),
    ]
}

fn compared_panels(panel: &Panel, other: &Panel) -> [Compared; 15] {
    let Panel {
        refresh_hz,
        mode,
        field_order,
        channel_order,
        frames_per_colour,
        bit_depth,
        packing,
        video_margins: _,
        orientation,
        phase_sign,
        stroke_rad,
        out_of_stroke,
        lut,
        flatness_rad,
        settle,
        latency,
    } = panel;
    [
        ("panel.refresh_hz", *refresh_hz == other.refresh_hz),
        ("panel.mode", *mode == other.mode),
        ("panel.field_order", *field_order == other.field_order),
        ("panel.channel_order", *channel_order == other.channel_order),
        ("panel.frames_per_colour", *frames_per_colour == other.frames_per_colour),
        ("panel.bit_depth", *bit_depth == other.bit_depth),
        ("panel.packing", *packing == other.packing),
        ("panel.orientation", *orientation == other.orientation),
        ("panel.phase_sign", *phase_sign == other.phase_sign),
        ("panel.stroke_pi", *stroke_rad == other.stroke_rad),
        ("panel.out_of_stroke", *out_of_stroke == other.out_of_stroke),
        ("panel.settle_ms", *settle == other.settle),
        ("panel.latency_ms", *latency == other.latency),
        ("panel.lut_file", *lut == other.lut),
        ("panel.flatness_file", *flatness_rad == other.flatness_rad),
    ]
}

fn compared_optics(rig: &Rig, other: &Rig) -> [Compared; 5] {
    let DisplayGeometry { resolution: _, pixel_pitch: _, wavelengths, eyepiece_focal_length, depth_far, depth_near } =
        &rig.geometry;
    // The relay is in both, up to what division rounds off.
    let theirs = other.geometry.eyepiece_focal_length.0 * other.relay_magnification;
    let same_eyepiece = (eyepiece_focal_length.0 * rig.relay_magnification / theirs - 1.0).abs() < 1e-12;
    [
        ("optics.wavelengths_nm", *wavelengths == other.geometry.wavelengths),
        ("optics.relay_magnification", rig.relay_magnification == other.relay_magnification),
        ("optics.eyepiece_focal_length_mm", same_eyepiece),
        ("optics.depth_far", *depth_far == other.geometry.depth_far),
        ("optics.depth_near", *depth_near == other.geometry.depth_near),
    ]
}

fn compared_lasers(lasers: &Lasers, other: &Lasers) -> [Compared; 10] {
    let Lasers {
        driver,
        power_mw,
        power_limit_mw,
        head_limit_mw,
        on_delay,
        width,
        heartbeat_timeout,
        stall_timeout,
        gated_by_panel,
        accept_no_heartbeat,
    } = lasers;
    [
        ("lasers.driver", *driver == other.driver),
        ("lasers.power_mw", *power_mw == other.power_mw),
        ("lasers.power_limit_mw", *power_limit_mw == other.power_limit_mw),
        ("lasers.head_limit_mw", *head_limit_mw == other.head_limit_mw),
        ("lasers.on_delay_ms", *on_delay == other.on_delay),
        ("lasers.lit_ms", *width == other.width),
        ("lasers.heartbeat_timeout_ms", *heartbeat_timeout == other.heartbeat_timeout),
        ("lasers.stall_timeout_ms", *stall_timeout == other.stall_timeout),
        ("lasers.gated_by_panel", *gated_by_panel == other.gated_by_panel),
        ("lasers.accept_no_heartbeat", *accept_no_heartbeat == other.accept_no_heartbeat),
    ]
}

fn compared_trackers(tracker: &Tracker, other: &Tracker) -> [Compared; 5] {
    let Tracker { spec, eye, scale, fallback, hold } = tracker;
    [
        ("tracker.spec", *spec == other.spec),
        ("tracker.eye", *eye == other.eye),
        ("tracker.scale_mm_per_unit", *scale == other.scale),
        ("tracker.fallback_mm", *fallback == other.fallback),
        ("tracker.hold_ms", *hold == other.hold),
    ]
}

fn compared_models(model: &Model, other: &Model) -> [Compared; 3] {
    let Model { weights, gpu, pupil_step } = model;
    [
        ("model.network", *weights == other.weights),
        ("model.gpu", *gpu == other.gpu),
        ("model.pupil_step_mm", *pupil_step == other.pupil_step),
    ]
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn a_rig_differs_by_what_was_changed_and_by_nothing_else() {
        let rig = Rig::default();
        for (found, instead, keys) in [
            ("", "# a comment\n", &[][..]),
            ("hold_ms = 1000.0", "hold_ms = 400.0", &["tracker.hold_ms"]),
            ("lit_ms = 3.0", "lit_ms = 2.5", &["lasers.lit_ms"]),
            ("phase_sign", "orientation = \"mirror-y\"\nphase_sign", &["panel.orientation"]),
            ("width_px = 1920", "width_px = 1910", &["panel.width_px"]),
            ("red = 638.0", "red = 633.0", &["optics.wavelengths_nm"]),
            ("eye = \"both\"", "eye = \"left\"", &["tracker.eye"]),
            ("network = \"standard\"", "network = \"small\"", &["model.network"]),
            ("[model]", "[model]\npupil_step_mm = 0", &["model.pupil_step_mm"]),
            ("settle_ms", "latency_ms = 3\nsettle_ms", &["panel.latency_ms"]),
            ("depth_near_m = 0.35", "depth_near_m = 0.25", &["optics.depth_near"]),
        ] {
            let text = Rig::BUILT_IN_TOML.replacen(found, instead, 1);
            let other = Rig::parse(&text, Path::new("bench.toml")).unwrap();
            assert_eq!(other.differences(&rig), keys, "{instead}");
            assert_eq!(rig.differences(&other), keys, "{instead}");
        }
    }
}
