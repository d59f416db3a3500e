"""Benches that labs might have, at random, to train networks on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from holod_training.config import ConfigError, OpticsConfig, TrainedRange

# Of trials for one bench: of 3,000, one in 2 fitted a blur of 30 to 60 px, one in 11 of 8 px, one in 150 of 5 px.
MOST_TRIALS = 10_000

# Blur: what training scenes are rendered for. Diffraction: of a 3.74 µm panel with 40 mm the reddest laser has 217 px²
# over 2.857 dpt, of a 12.5 µm panel with 30 mm the bluest 7.3 px².
ANY_BENCH = TrainedRange(volume_blur_px=(5.0, 115.0), volume_fresnel_px2=(8.0, 240.0))


@dataclass(frozen=True)
class BenchDraw:
    """Random benches: each value uniform within its range, lengths and ratios by their logarithm.

    The share `default` of benches is the default one, where it lies in what is `trained` and can show a scene's blur to
    a pupil of `pupil_mm`; of the rest `at_infinity` have their far end there. Wavelengths are red's, green's and blue's
    of lasers that are sold.
    """

    trained: TrainedRange = ANY_BENCH
    default: float = 0.25
    at_infinity: float = 0.6
    pupil_mm: tuple[float, float] = (1.0, 8.0)
    pixels_per_rad: tuple[float, float] = (1_600.0, 18_000.0)
    pixel_pitch_um: tuple[float, float] = (3.6, 12.5)
    volume_dpt: tuple[float, float] = (1.0, 4.0)
    farthest_dpt: float = 1.0
    wavelengths_nm: tuple[tuple[float, float], ...] = ((630.0, 665.0), (512.0, 536.0), (442.0, 475.0))

    def draw(self, volume_blur_px: float, rng: np.random.Generator) -> OpticsConfig:
        """A bench on which some eye's pupil has this blur over the depth volume. Raises ConfigError for a blur that no
        bench of these ranges shows."""
        least_mm, most_mm = self.pupil_mm
        bench = OpticsConfig()
        shows = least_mm <= bench.pupil_mm(volume_blur_px) <= most_mm
        if rng.random() < self.default and shows and self._trained(bench):
            return bench
        for _ in range(MOST_TRIALS):
            bench = self._any(rng)
            if least_mm <= bench.pupil_mm(volume_blur_px) <= most_mm and self._trained(bench):
                return bench
        raise ConfigError(
            f"benches: none of {MOST_TRIALS} has a volume_blur_px of {volume_blur_px:.1f} for a pupil of "
            f"{least_mm:g} to {most_mm:g} mm; train on scenes that blur less or more, or widen the benches' ranges"
        )

    def _any(self, rng: np.random.Generator) -> OpticsConfig:
        def log_uniform(low: float, high: float) -> float:
            return math.exp(rng.uniform(math.log(low), math.log(high)))

        pitch_um = log_uniform(*self.pixel_pitch_um)
        far = 0.0 if rng.random() < self.at_infinity else rng.uniform(0, self.farthest_dpt)
        red, green, blue = (rng.uniform(low, high) for low, high in self.wavelengths_nm)
        return OpticsConfig(
            wavelengths_nm=(red, green, blue),
            pixel_pitch_um=pitch_um,
            eyepiece_focal_length_mm=1e-3 * pitch_um * log_uniform(*self.pixels_per_rad),
            depth_far_dpt=far,
            depth_near_dpt=far + rng.uniform(*self.volume_dpt),
        )

    def _trained(self, bench: OpticsConfig) -> bool:
        least, most = self.trained.volume_fresnel_px2
        return all(least <= fresnel <= most for fresnel in bench.volume_fresnel_px2)
