//! Which of a connector's modes is the panel's own, and how long its parts take.

use drm::control::{Mode, ModeFlags};
use holod_calibration::{Resolution, TimeNs};

/// A mode's rate may be off the rig's by this part.
const RATE_TOLERANCE: f64 = 1e-3;

/// Refreshes a second; 0 of a mode that has no pixels.
pub(crate) fn refresh_hz(mode: &Mode) -> f64 {
    let pixels = f64::from(mode.hsync().2) * f64::from(mode.vsync().2) * f64::from(mode.vscan().max(1));
    let half_frames = if mode.flags().contains(ModeFlags::INTERLACE) { 2.0 } else { 1.0 };
    let doubled = if mode.flags().contains(ModeFlags::DBLSCAN) { 2.0 } else { 1.0 };
    if pixels == 0.0 { 0.0 } else { f64::from(mode.clock()) * 1e3 * half_frames / doubled / pixels }
}

/// From one refresh to the next.
pub(crate) fn period(mode: &Mode) -> TimeNs {
    TimeNs::from_seconds(1.0 / refresh_hz(mode))
}

/// The vertical blank, at whose begin the controller takes a new picture and at whose end scan-out begins.
pub(crate) fn blank(mode: &Mode) -> TimeNs {
    let (lines, total) = (f64::from(mode.size().1), f64::from(mode.vsync().2));
    TimeNs::from_seconds((total - lines) / total / refresh_hz(mode))
}

pub(crate) fn resolution(mode: &Mode) -> Resolution {
    let (width, height) = mode.size();
    Resolution { width: width.into(), height: height.into() }
}

/// The mode of exactly `size` whose rate is nearest to `hz`, if one is near enough. Interlaced, line-doubled and stereo
/// modes show other pixels than they are sent.
pub(crate) fn choose(modes: &[Mode], size: Resolution, hz: f64) -> Option<Mode> {
    let stereo = 0x1f << 14;
    let other = ModeFlags::INTERLACE | ModeFlags::DBLSCAN | ModeFlags::DBLCLK | ModeFlags::from_bits_retain(stereo);
    let distance = |mode: &&Mode| (refresh_hz(mode) - hz).abs();
    modes
        .iter()
        .filter(|mode| resolution(mode) == size && !mode.flags().intersects(other) && mode.vscan() <= 1)
        .filter(|mode| distance(mode) <= hz * RATE_TOLERANCE)
        .min_by(|a, b| distance(a).total_cmp(&distance(b)))
        .copied()
}

/// All modes, for messages: each size with its rates.
pub(crate) fn list(modes: &[Mode]) -> String {
    let mut sizes: Vec<(Resolution, Vec<String>)> = Vec::new();
    for mode in modes {
        let size = resolution(mode);
        let interlaced = if mode.flags().contains(ModeFlags::INTERLACE) { " interlaced" } else { "" };
        let rate = format!("{:.3}{interlaced}", refresh_hz(mode));
        match sizes.iter_mut().find(|(known, _)| *known == size) {
            Some((_, rates)) if rates.contains(&rate) => {}
            Some((_, rates)) => rates.push(rate),
            None => sizes.push((size, vec![rate])),
        }
    }
    let line = |(size, rates): &(Resolution, Vec<String>)| {
        format!("{} by {} at {} Hz", size.width, size.height, rates.join(", "))
    };
    if sizes.is_empty() { "none".to_owned() } else { sizes.iter().map(line).collect::<Vec<_>>().join("; ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FULL_HD: Resolution = Resolution { width: 1920, height: 1080 };

    /// CEA-861's 1920x1080 timing with another clock, kHz.
    fn full_hd(clock: u32, flags: ModeFlags) -> Mode {
        Mode::from(drm_ffi::drm_mode_modeinfo {
            clock,
            hdisplay: 1920,
            hsync_start: 2008,
            hsync_end: 2052,
            htotal: 2200,
            vdisplay: 1080,
            vsync_start: 1084,
            vsync_end: 1089,
            vtotal: 1125,
            flags: flags.bits(),
            ..Default::default()
        })
    }

    #[test]
    fn a_mode_lasts_as_its_standard_says() {
        let mode = full_hd(148_500, ModeFlags::empty());
        assert_eq!(refresh_hz(&mode), 60.0);
        assert_eq!(period(&mode), TimeNs(16_666_667));
        assert_eq!(blank(&mode), TimeNs(666_667));
        assert_eq!(refresh_hz(&full_hd(74_250, ModeFlags::INTERLACE)), 60.0);
    }

    #[test]
    fn the_nearest_rate_is_taken_and_no_other_size() {
        let modes = [148_350, 148_500, 165_000].map(|clock| full_hd(clock, ModeFlags::empty()));
        let clock = |hz: f64| choose(&modes, FULL_HD, hz).map(|mode| mode.clock());
        assert_eq!(clock(60.0), Some(148_500));
        assert_eq!(clock(59.94), Some(148_350));
        assert_eq!(clock(66.7), Some(165_000));
        assert_eq!(clock(60.2), None);
        assert_eq!(clock(30.0), None);
        let taller = Resolution { height: 1200, ..FULL_HD };
        assert_eq!(choose(&modes, taller, 60.0), None);
    }

    #[test]
    fn modes_that_show_other_pixels_are_not_taken() {
        for flags in [ModeFlags::INTERLACE, ModeFlags::DBLSCAN, ModeFlags::_3D_FRAME_PACKING] {
            let mode = full_hd(148_500, flags);
            assert_eq!(choose(&[mode], FULL_HD, refresh_hz(&mode)), None, "{flags:?}");
        }
        assert!(choose(&[full_hd(148_500, ModeFlags::PHSYNC | ModeFlags::PVSYNC)], FULL_HD, 60.0).is_some());
    }

    #[test]
    fn the_list_names_each_size_once() {
        let modes = [148_500, 148_350, 148_500].map(|clock| full_hd(clock, ModeFlags::empty()));
        assert_eq!(list(&modes), "1920 by 1080 at 60.000, 59.939 Hz");
        assert_eq!(list(&[]), "none");
    }
}
