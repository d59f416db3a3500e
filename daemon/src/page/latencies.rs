//! How long things take, as histograms.

use holod_calibration::TimeNs;
use prometheus_client::metrics::histogram::Histogram;

use crate::session::FirstLight;

/// Bounds of the histograms: from a frame of a fast panel to a slide show.
const BOUNDS_S: [f64; 14] = [0.002, 0.004, 0.006, 0.008, 0.012, 0.016, 0.024, 0.032, 0.048, 0.064, 0.1, 0.2, 0.5, 2.0];

/// How long things take.
pub(super) struct Latencies {
    pub(super) frame: Histogram,
    pub(super) sample_to_photon: Histogram,
    pub(super) picture_to_photon: Histogram,
}

impl Default for Latencies {
    fn default() -> Self {
        let histogram = || Histogram::new(BOUNDS_S);
        Self { frame: histogram(), sample_to_photon: histogram(), picture_to_photon: histogram() }
    }
}

impl Latencies {
    pub(super) fn frame(&self, time: TimeNs) {
        self.frame.observe(time.seconds());
    }

    pub(super) fn light(&self, light: &FirstLight) {
        for (histogram, time) in
            [(&self.sample_to_photon, light.sample_to_photon), (&self.picture_to_photon, light.picture_to_photon)]
        {
            if let Some(time) = time {
                // A counter whose sum falls is refused as a whole; two clocks may differ by a little.
                histogram.observe(time.seconds().max(0.0));
            }
        }
    }
}
