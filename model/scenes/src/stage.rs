//! Where a random scene is laid out: the picture's extent, and how far surfaces must reach beyond it.

use holod_model::scene_shard::SceneKind;

/// Room for the outermost rays of the widest pupil for which a scene is laid out.
#[derive(Clone, Copy)]
pub(super) struct Reach {
    /// Surfaces reach this far beyond the picture, so that rays never miss the background.
    pub(super) overscan_px: f32,
    /// Steepest plane, in dioptres per pixel: beyond it an aperture ray could meet the plane from behind.
    pub(super) steepest: f32,
    /// The same for walls and grounds.
    pub(super) steepest_wall: f32,
}

impl Reach {
    /// For pupils of up to 8 mm on the default bench, whose outermost ray goes 20 px a dioptre.
    pub(super) const USUAL: Self = Self { overscan_px: 60.0, steepest: 0.03, steepest_wall: 0.045 };

    /// For a pupil whose radius is this many pixels a dioptre: the usual where that is enough.
    pub(super) fn of_radius(radius_px_per_dpt: f32) -> Self {
        let wider = (radius_px_per_dpt / 20.0).max(1.0);
        let Self { overscan_px, steepest, steepest_wall } = Self::USUAL;
        Self { overscan_px: overscan_px * wider, steepest: steepest / wider, steepest_wall: steepest_wall / wider }
    }
}

/// The picture's extent and the size that random lengths scale with.
pub(super) struct Stage {
    pub(super) half_width: f32,
    pub(super) half_height: f32,
    /// 1 for a picture of 256 by 256 pixels. Half of what a larger picture gains is larger objects, half is more of
    /// them.
    pub(super) scale: f32,
    pub(super) near: f32,
    pub(super) kind: SceneKind,
    pub(super) reach: Reach,
}
