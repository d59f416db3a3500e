"""The bench in numbers: propagation, the half band, the eye, double phase.

FFTs here are circular; a border is left out of losses and metrics instead of padding.
"""

from __future__ import annotations

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor

from holod_training.config import OpticsConfig

# Of double phase. A pixel is dark below DARK_SHARE of the rms amplitude of its tile, at least below LEAST_DARK and at
# most below MOST_DARK of the amplitude constant. model/src/optics/double_phase.rs has the same numbers.
TILE_PX = 32
DARK_SHARE = 0.5
LEAST_DARK, MOST_DARK = 0.01, 0.08
CORRECTION_GAIN = 2.0


def frequencies(size: int, pitch_m: float, device: torch.device | str = "cpu") -> Tensor:
    """Cycles per metre of an FFT's bins, float64 [size]."""
    return torch.fft.fftfreq(size, pitch_m, dtype=torch.float64, device=device)


def _phase(angle: Tensor) -> Tensor:
    """exp(j·angle), complex128."""
    return torch.polar(torch.ones_like(angle), angle)


def transfer(optics: OpticsConfig, fx: Tensor, fy: Tensor, distances_m: list[float]) -> Tensor:
    """Angular spectrum transfer functions, complex128 [K, 3, len(fy), len(fx)], constant phase exp(j·k·u) dropped.

    exp(j·2π·u·(sqrt(1/λ² − fx² − fy²) − 1/λ)) inside 1/λ, 0 outside (Goodman, Introduction to Fourier Optics).
    """
    squared = fx[None, :] ** 2 + fy[:, None] ** 2
    per_colour = []
    for wavelength in optics.wavelengths_m:
        axial2 = wavelength**-2 - squared
        # sqrt(a) − 1/λ without cancellation.
        axial = -squared / (torch.sqrt(axial2.clamp_min(0)) + 1 / wavelength)
        u = torch.tensor(distances_m, dtype=torch.float64, device=fx.device)[:, None, None]
        per_colour.append(_phase(2 * math.pi * u * axial) * (axial2 > 0))
    return torch.stack(per_colour, dim=1)


def propagate(field: Tensor, optics: OpticsConfig, distance_m: float) -> Tensor:
    """The field [..., 3, H, W] a distance further; positive goes from the SLM plane towards the images."""
    height, width = field.shape[-2:]
    fy = frequencies(height, optics.pitch_m, field.device)
    fx = frequencies(width, optics.pitch_m, field.device)
    return torch.fft.ifft2(torch.fft.fft2(field) * transfer(optics, fx, fy, [distance_m])[0].to(field.dtype))


def propagate_padded(field: Tensor, optics: OpticsConfig, distance_m: float) -> Tensor:
    """The same without wrapping round: zero-padded to twice the size, band-limited (Matsushima, Shimobaba 2009)."""
    height, width = field.shape[-2:]
    fy = frequencies(2 * height, optics.pitch_m, field.device)
    fx = frequencies(2 * width, optics.pitch_m, field.device)
    kernel = transfer(optics, fx, fy, [distance_m])[0]
    limits = []
    for wavelength in optics.wavelengths_m:
        limit_y, limit_x = (
            1 / (wavelength * math.sqrt((2 * distance_m / (2 * size * optics.pitch_m)) ** 2 + 1))
            for size in (height, width)
        )
        limits.append((fy.abs() <= limit_y)[:, None] & (fx.abs() <= limit_x)[None, :])
    spectrum = torch.fft.fft2(field, s=(2 * height, 2 * width)) * (kernel * torch.stack(limits)).to(field.dtype)
    return torch.fft.ifft2(spectrum)[..., :height, :width]


def half_band_mask(height: int, width: int, device: torch.device | str = "cpu") -> Tensor:
    """The 4f stop: |fx|, |fy| < 1/4 cycle per pixel, bool [H, W]."""
    rows, columns = (_in_half_band(size, device) for size in (height, width))
    return rows[:, None] & columns[None, :]


def _in_half_band(size: int, device: torch.device | str) -> Tensor:
    """By whole numbers, so that no rounding decides on the bin at a quarter."""
    bins = torch.arange(size, device=device)
    return 4 * torch.minimum(bins, size - bins) < size


def stop_half_band(field: Tensor) -> Tensor:
    """What the 4f stop lets through of a field [..., H, W] on the panel's grid."""
    height, width = field.shape[-2:]
    return torch.fft.ifft2(torch.fft.fft2(field) * half_band_mask(height, width, field.device))


def pupil_mask(optics: OpticsConfig, fx: Tensor, fy: Tensor, pupil_mm: float | Tensor, shift_mm: float = 0.0) -> Tensor:
    """The eye's pupil in the Fourier plane, bool [3, len(fy), len(fx)]: a disc of radius (s/2)/(λ·f), its centre
    `shift_mm` along x from the eyebox's. Of pupils [N, 1, 1], [N, 3, len(fy), len(fx)]."""
    masks = []
    for wavelength in optics.wavelengths_m:
        per_mm = 1e-3 / (wavelength * optics.focal_length_m)
        radius = torch.sqrt((fx[None, :] - shift_mm * per_mm) ** 2 + fy[:, None] ** 2)
        masks.append(radius < 0.5 * pupil_mm * per_mm)
    return torch.stack(masks, dim=-3)


def upsample_half_band(low: Tensor) -> Tensor:
    """Fourier upsampling by 2: complex [..., h, w] with samples at the centres of 2x2 blocks -> [..., 2h, 2w].

    The result is strictly half band (the low grid's Nyquist bins are dropped) and keeps the amplitude.
    """
    h, w = low.shape[-2:]
    spectrum = torch.fft.fft2(low)
    fy, fx = frequencies(2 * h, 1.0, low.device), frequencies(2 * w, 1.0, low.device)
    full = torch.zeros(*low.shape[:-2], 2 * h, 2 * w, dtype=low.dtype, device=low.device)
    low_rows, rows = kept_bins(h, low.device)
    low_columns, columns = kept_bins(w, low.device)
    full[..., rows[:, None], columns] = spectrum[..., low_rows[:, None], low_columns]
    shift = _phase(-2 * math.pi * 0.5 * (fy[:, None] + fx[None, :]))
    return torch.fft.ifft2(full * (4 * shift).to(low.dtype))


def half_band_samples(field_: Tensor) -> Tensor:
    """What `upsample_half_band` undoes: the half band of [..., H, W] on a grid of half the size, at block centres."""
    height, width = field_.shape[-2:]
    fy, fx = frequencies(height, 1.0, field_.device), frequencies(width, 1.0, field_.device)
    angle = math.pi * (fy[:, None] + fx[None, :])
    shift = torch.polar(torch.ones_like(angle), angle)
    spectrum = torch.fft.fft2(field_) * (shift / 4).to(field_.dtype)
    low_rows, rows = kept_bins(height // 2, field_.device)
    low_columns, columns = kept_bins(width // 2, field_.device)
    low = torch.zeros(*field_.shape[:-2], height // 2, width // 2, dtype=field_.dtype, device=field_.device)
    low[..., low_rows[:, None], low_columns] = spectrum[..., rows[:, None], columns]
    return torch.fft.ifft2(low)


def kept_bins(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Bins below the low grid's Nyquist frequency: where they lie on the low grid, and on one of twice the size."""
    signed = torch.arange(-((size - 1) // 2), (size - 1) // 2 + 1, device=device)
    return signed % size, signed % (2 * size)


class Eye:
    """What a simulated eye sees of a field on the full grid: 4f stop, pupil, propagation, intensity."""

    def __init__(
        self,
        optics: OpticsConfig,
        height: int,
        width: int,
        focus_dpt: list[float],
        device: torch.device | str = "cpu",
    ) -> None:
        self.optics = optics
        self.fy = frequencies(height, optics.pitch_m, device)
        self.fx = frequencies(width, optics.pitch_m, device)
        self.stop = half_band_mask(height, width, device)
        self.transfer = transfer(optics, self.fx, self.fy, [optics.distance_m(d) for d in focus_dpt])

    def look(self, field: Tensor, pupil_mm: float) -> Tensor:
        """field complex [3, H, W] -> linear intensity [K, 3, H, W], one picture for each focus.

        Of time-multiplexed frames [F, 3, H, W] the eye sees the mean intensity.
        """
        spectrum = torch.fft.fft2(field) * (self.stop & pupil_mask(self.optics, self.fx, self.fy, pupil_mm))
        return _seen(spectrum, self.transfer.to(field.dtype))


class HalfBandEye:
    """The same for a field on the half-band grid, at the cost that training can bear.

    Only the low grid's spectrum is propagated. It is laid in bins 0 .. h-1 of the full one: that moves every
    frequency by a constant, a phase ramp in space, which no intensity shows; so the inverse FFT pads by itself.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        height: int,
        width: int,
        focus_dpt: list[float],
        device: torch.device | str,
    ) -> None:
        self.optics = optics
        self.size = (height, width)
        h, w = height // 2, width // 2
        pitch = 2 * optics.pitch_m
        self.fy = torch.fft.fftshift(frequencies(h, pitch, device))
        self.fx = torch.fft.fftshift(frequencies(w, pitch, device))
        kernel = transfer(optics, self.fx, self.fy, [optics.distance_m(d) for d in focus_dpt])
        limit = 0.25 / optics.pitch_m * (1 - 1e-9)
        inside = (self.fy.abs() < limit)[:, None] & (self.fx.abs() < limit)[None, :]
        # Samples of the low grid lie half a full pixel down and right.
        shift = _phase(-math.pi * optics.pitch_m * (self.fy[:, None] + self.fx[None, :]))
        self.kernel = (kernel * (4 * inside * shift)).to(torch.complex64)
        radius = [0.25 * math.sqrt(2) / optics.pitch_m * wl * optics.focal_length_m for wl in optics.wavelengths_m]
        self.widest_cut_mm = 2e3 * max(radius)

    def look(self, low: Tensor, pupil_mm: float) -> Tensor:
        """low complex [3, h, w] or frames [F, 3, h, w] -> linear intensity [K, 3, H, W], as `Eye.look`."""
        spectrum = torch.fft.fftshift(torch.fft.fft2(low), dim=(-2, -1))
        if pupil_mm < self.widest_cut_mm:
            spectrum = spectrum * pupil_mask(self.optics, self.fx, self.fy, pupil_mm)
        return _seen(spectrum, self.kernel, self.size)


def _seen(spectrum: Tensor, kernel: Tensor, size: tuple[int, int] | None = None) -> Tensor:
    """Mean intensity over the frames of spectrum [(F,) 3, h, w] after kernel [K, 3, h, w]."""
    if spectrum.dim() == 3:
        return intensity(torch.fft.ifft2(spectrum * kernel, s=size))
    return intensity(torch.fft.ifft2(spectrum[:, None] * kernel, s=size)).mean(dim=0)


def intensity(field: Tensor) -> Tensor:
    return field.real * field.real + field.imag * field.imag


def double_phase(field: Tensor, amplitude_constant: float) -> tuple[Tensor, float]:
    """Phase pattern in [0, 2π) for a field [..., H, W], and the share of pixels whose amplitude was clipped."""
    clipped = (field.abs() > amplitude_constant).float().mean().item()
    phase = torch.remainder(double_phase_phasors(field, amplitude_constant).angle(), 2 * math.pi)
    return torch.where(phase >= 2 * math.pi, torch.zeros_like(phase), phase), clipped


def double_phase_phasors(field: Tensor, amplitude_constant: float) -> Tensor:
    """Phasors, not of unit length, whose angles are the double phase of a field [..., H, W]. Has a gradient.

    With a field a = c/K, clipped to |a| ≤ 1, and a unit carrier u, the pair is u·(s ∓ j·sqrt(1 − s²)), s = Re(a·u*), in
    a checkerboard, minus where x + y is even. With u = a/|a| that is arg c ∓ acos |a| (Hsueh and Sawchuk 1978; Maimone
    2017), which throws light into the band wherever u changes from pixel to pixel, as it does where there is none. So
    u is smooth where it is dark; then the error, a less the phasor, through a binomial filter, is added twice: one
    step of Gerchberg and Saxton's (1972).
    """
    a = field / amplitude_constant
    a = a / a.abs().clamp_min(1)
    carrier = smooth_carrier(a)
    along = (a * carrier.conj()).real
    across = torch.sqrt((1 - along * along).clamp_min(1e-12))
    height, width = field.shape[-2:]
    rows = torch.arange(height, device=field.device)[:, None]
    columns = torch.arange(width, device=field.device)
    sign = torch.where((rows + columns) % 2 == 0, -1.0, 1.0)
    pair = carrier * torch.complex(along, sign.to(across.dtype) * across)
    return pair + CORRECTION_GAIN * _binomial(a - pair)


def smooth_carrier(a: Tensor) -> Tensor:
    """Unit phasors for a field [..., H, W] of amplitudes up to 1: its own where it is bright beside its surroundings,
    those of its brighter neighbours where it is dark.

    With weights of amplitude cubed, a block of 4x4 pixels has the phase of its mean, each quarter of it that of its own
    mean and a little of the block's, each pixel its own and a little of its quarter's. A little: as much as a pixel of
    half the rms amplitude of the tile of 32x32 around it has, within bounds.
    """
    light = intensity(a)
    weighted = a * light
    power = _spread(_tile_means(light, TILE_PX), TILE_PX, a)
    floor = (DARK_SHARE**2 * power).clamp(LEAST_DARK**2, MOST_DARK**2) ** 1.5
    block = _unit(_spread(_tile_means(weighted, 4), 4, a) + (LEAST_DARK / 2) ** 3)
    quarter = _unit(_spread(_tile_means(weighted, 2), 2, a) + floor * block)
    return _unit(weighted + floor * quarter)


def _unit(value: Tensor) -> Tensor:
    return value * torch.rsqrt(intensity(value).clamp_min(1e-30))


def _tile_means(value: Tensor, size: int) -> Tensor:
    """Means over tiles of size x size pixels, [..., ceil(H/size), ceil(W/size)]; beyond the edges there are zeros."""
    height, width = value.shape[-2:]
    padded = F.pad(value, (0, -width % size, 0, -height % size))
    return padded.unflatten(-1, (-1, size)).unflatten(-3, (-1, size)).mean(dim=(-3, -1))


def _spread(tiles: Tensor, size: int, like: Tensor) -> Tensor:
    """Each tile's value at each of its pixels."""
    spread = tiles.repeat_interleave(size, -2).repeat_interleave(size, -1)
    return spread[..., : like.shape[-2], : like.shape[-1]]


def _binomial(value: Tensor) -> Tensor:
    """[..., H, W] through 1 4 6 4 1 in both directions. Beyond its edges it is mirrored about the outermost pixels,
    which keeps a checkerboard one."""
    for dim in (-1, -2):
        size = value.shape[dim]
        at = torch.arange(-2, size + 2, device=value.device).abs()
        at = torch.where(at < size, at, 2 * (size - 1) - at).clamp(0, size - 1)
        mirrored = value.index_select(dim, at)
        taps = enumerate((0.0625, 0.25, 0.375, 0.25, 0.0625))
        value = functools.reduce(torch.add, (tap * mirrored.narrow(dim, k, size) for k, tap in taps))
    return value


def levels(phase: Tensor, bit_depth: int = 8) -> Tensor:
    """The levels, 0 to 2^bit_depth − 1, of a linear panel with a stroke of a full turn that are nearest to phases."""
    return torch.remainder(torch.round(phase / (2 * math.pi / 2**bit_depth)), 2**bit_depth)


def through_levels(phase: Tensor, bit_depth: int = 8) -> Tensor:
    """The phases that such a panel shows of them."""
    return levels(phase, bit_depth) * (2 * math.pi / 2**bit_depth)


def panel_field(phase: Tensor) -> Tensor:
    """What leaves a phase-only panel: exp(j·phase)."""
    return torch.polar(torch.ones_like(phase), phase)


def shown_by_panel(field: Tensor, amplitude_constant: float, size: tuple[int, int]) -> Tensor:
    """What a panel of `size` (height, width) shows of [..., h, w] after double phase, on the same grid: that of the
    panel or, of which the half band counts, one of half its size. Has a gradient."""
    half_band = field.shape[-2:] != size
    phasors = double_phase_phasors(upsample_half_band(field) if half_band else field, amplitude_constant)
    shown = amplitude_constant * phasors / phasors.abs().clamp_min(1e-6)
    return half_band_samples(shown) if half_band else shown


def coc_px(optics: OpticsConfig, depth: Tensor, focus_dpt: Tensor | list[float], pupil_mm: float) -> Tensor:
    """Diameter of the circle of confusion in panel pixels, [K, H, W] for depth [H, W] (0 far .. 1 near)."""
    focus = torch.as_tensor(focus_dpt, dtype=depth.dtype, device=depth.device)[:, None, None]
    dioptres = optics.depth_far_dpt + depth * (optics.depth_near_dpt - optics.depth_far_dpt)
    return (dioptres - focus).abs() * (pupil_mm * 1e-3 / optics.pixel_angle_rad)
