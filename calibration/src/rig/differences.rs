//! What one rig has that another has not, by the keys of the rig file.

use super::{Lasers, Model, Panel, Rig, Tracker, VideoMargins};
use crate::DisplayGeometry;

impl Rig {
    /// The keys, such as `tracker.hold_ms`, whose figures in `self` are not those in `other`. A panel profile counts as
    /// the keys that it gives, a file as what was read from it, `model.weights_file` as `model.network`, a depth's two
    /// spellings as `optics.depth_far` and `optics.depth_near`. Comments are no difference.
    pub fn differences(&self, other: &Self) -> Vec<&'static str> {
        // Named one by one, so that a new field must be thought of here.
        let Self { name, panel, geometry, relay_magnification, lasers, tracker, model, provenance: _ } = self;
        let Panel {
            refresh_hz,
            mode,
            field_order,
            channel_order,
            frames_per_colour,
            bit_depth,
            packing,
            video_margins,
            orientation,
            phase_sign,
            stroke_rad,
            out_of_stroke,
            lut,
            flatness_rad,
            settle,
            latency,
        } = panel;
        let DisplayGeometry { resolution, pixel_pitch, wavelengths, eyepiece_focal_length, depth_far, depth_near } =
            geometry;
        // The relay is in both, up to what division rounds off.
        let theirs = other.geometry.eyepiece_focal_length.0 * other.relay_magnification;
        let same_eyepiece = (eyepiece_focal_length.0 * relay_magnification / theirs - 1.0).abs() < 1e-12;
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
        let Tracker { spec, eye, scale, fallback, hold } = tracker;
        let Model { weights, gpu, pupil_step } = model;
        // Without margins the video frame is the panel.
        let is_framed = [*video_margins, other.panel.video_margins] != [VideoMargins::default(); 2];
        let video = video_margins.around(*resolution);
        let other_video = other.panel.video_margins.around(other.geometry.resolution);
        [
            ("name", *name == other.name),
            ("panel.width_px", resolution.width == other.geometry.resolution.width),
            ("panel.height_px", resolution.height == other.geometry.resolution.height),
            ("panel.video_width_px", !is_framed || video.width == other_video.width),
            ("panel.video_height_px", !is_framed || video.height == other_video.height),
            ("panel.video_left_px", video_margins.left == other.panel.video_margins.left),
            ("panel.video_top_px", video_margins.top == other.panel.video_margins.top),
            ("panel.pixel_pitch_um", *pixel_pitch == other.geometry.pixel_pitch),
            ("panel.refresh_hz", *refresh_hz == other.panel.refresh_hz),
            ("panel.mode", *mode == other.panel.mode),
            ("panel.field_order", *field_order == other.panel.field_order),
            ("panel.channel_order", *channel_order == other.panel.channel_order),
            ("panel.frames_per_colour", *frames_per_colour == other.panel.frames_per_colour),
            ("panel.bit_depth", *bit_depth == other.panel.bit_depth),
            ("panel.packing", *packing == other.panel.packing),
            ("panel.orientation", *orientation == other.panel.orientation),
            ("panel.phase_sign", *phase_sign == other.panel.phase_sign),
            ("panel.stroke_pi", *stroke_rad == other.panel.stroke_rad),
            ("panel.out_of_stroke", *out_of_stroke == other.panel.out_of_stroke),
            ("panel.settle_ms", *settle == other.panel.settle),
            ("panel.latency_ms", *latency == other.panel.latency),
            ("panel.lut_file", *lut == other.panel.lut),
            ("panel.flatness_file", *flatness_rad == other.panel.flatness_rad),
            ("optics.wavelengths_nm", *wavelengths == other.geometry.wavelengths),
            ("optics.relay_magnification", *relay_magnification == other.relay_magnification),
            ("optics.eyepiece_focal_length_mm", same_eyepiece),
            ("optics.depth_far", *depth_far == other.geometry.depth_far),
            ("optics.depth_near", *depth_near == other.geometry.depth_near),
            ("lasers.driver", *driver == other.lasers.driver),
            ("lasers.power_mw", *power_mw == other.lasers.power_mw),
            ("lasers.power_limit_mw", *power_limit_mw == other.lasers.power_limit_mw),
            ("lasers.head_limit_mw", *head_limit_mw == other.lasers.head_limit_mw),
            ("lasers.on_delay_ms", *on_delay == other.lasers.on_delay),
            ("lasers.lit_ms", *width == other.lasers.width),
            ("lasers.heartbeat_timeout_ms", *heartbeat_timeout == other.lasers.heartbeat_timeout),
            ("lasers.stall_timeout_ms", *stall_timeout == other.lasers.stall_timeout),
            ("lasers.gated_by_panel", *gated_by_panel == other.lasers.gated_by_panel),
            ("lasers.accept_no_heartbeat", *accept_no_heartbeat == other.lasers.accept_no_heartbeat),
            ("tracker.spec", *spec == other.tracker.spec),
            ("tracker.eye", *eye == other.tracker.eye),
            ("tracker.scale_mm_per_unit", *scale == other.tracker.scale),
            ("tracker.fallback_mm", *fallback == other.tracker.fallback),
            ("tracker.hold_ms", *hold == other.tracker.hold),
            ("model.network", *weights == other.model.weights),
            ("model.gpu", *gpu == other.model.gpu),
            ("model.pupil_step_mm", *pupil_step == other.model.pupil_step),
        ]
        .into_iter()
        .filter_map(|(key, same)| (!same).then_some(key))
        .collect()
    }
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
