"""What the network must beat: holograms made without learning, and the oracle that has no focus. And what a
display without holograms would show of the same input."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.layered import LOG_FLOOR, LOG_OFFSET, SIGMAS_PX, compose, drift_phase
from holod_training.optics import coc_px, frequencies, propagate, stop_half_band

OCCLUSION_LAYERS = 8
SMOOTH_PHASE_LAYERS = 24
RGBD_BLUR_LAYERS = 32
SHARP_PX = 0.7
ANTI_ALIASING_SIGMA_PX = 0.7


def all_in_focus(amplitude: Tensor, depth: Tensor, optics: OpticsConfig) -> Tensor:
    """The picture's amplitude with zero phase at the middle of the depth volume: sharp there, hardly blurred elsewhere.

    amplitude [3, H, W], depth [H, W] (unused) -> complex [3, H, W] at the SLM plane, half band.
    """
    middle = optics.distance_m(optics.dioptres(0.5))
    return stop_half_band(propagate(amplitude.to(torch.complex64), optics, -middle))


def layered_asm(amplitude: Tensor, depth: Tensor, optics: OpticsConfig, layers: int = OCCLUSION_LAYERS) -> Tensor:
    """Equal depth layers composed far to near with occlusion (`layered.compose`), zero phase on the object (or
    `amplitude`'s own). Same shapes as `all_in_focus`."""
    return stop_half_band(compose(amplitude.to(torch.complex64)[None], depth[None], optics, layers)[0])


def smooth_phase(amplitude: Tensor, depth: Tensor, optics: OpticsConfig) -> Tensor:
    """Every pixel in focus at its own depth, its phase that of one axial plane wave there, so smooth in the hologram.

    Twenty-four layers with occlusion instead of `layered_asm`'s eight, and the anti-aliasing Gaussian of double phase
    (3x3, σ 0.7 px) on the complex field before the 4f stop: the kind of target that smooth-phase networks learn.
    """
    field = layered_asm(amplitude, depth, optics, SMOOTH_PHASE_LAYERS)
    return stop_half_band(
        torch.complex(
            gaussian_blur(field.real, ANTI_ALIASING_SIGMA_PX, radius_px=1),
            gaussian_blur(field.imag, ANTI_ALIASING_SIGMA_PX, radius_px=1),
        )
    )


def transport_of_intensity(amplitude: Tensor, depth: Tensor, optics: OpticsConfig) -> Tensor:
    """`layered_asm` of an object whose phase makes light drift from bright to dark where it is out of focus.

    φ = (520 nm / λ) · Σ_j g_j · tanh(4·(½ − D)) · (G_σj(log(I + 0.03)) + 1.66), σ = 1, 2.5, 6 px, g = −0.5, −1, 0.
    Near objects take the other sign than far ones, since the drift turns round behind the volume's middle. The blurs go
    on with the edge's value, where those of the layered network are circular.
    """
    logarithm = torch.log(amplitude.square() + LOG_FLOOR)
    logs = torch.stack([gaussian_blur(logarithm, sigma) for sigma in SIGMAS_PX]) + LOG_OFFSET
    phase = drift_phase(depth[None] - 0.5, logs, optics)
    return layered_asm(torch.polar(amplitude, phase), depth, optics)


def gaussian_blur(light: Tensor, sigma_px: float, radius_px: int | None = None) -> Tensor:
    """[3, H, W] blurred on itself, the edge's value going on outside; cut off at 3 σ or `radius_px`."""
    radius = radius_px or int(3 * sigma_px + 0.5)
    x = torch.arange(-radius, radius + 1, dtype=light.dtype, device=light.device)
    window = torch.exp(-x.square() / (2 * sigma_px**2))
    window = (window / window.sum()).expand(len(light), 1, 1, -1)
    padded = F.pad(light[None], (radius, radius, radius, radius), mode="replicate")
    rows = F.conv2d(padded, window, groups=len(light))
    return F.conv2d(rows, window.transpose(-2, -1), groups=len(light))[0]


def rgbd_blur(
    amplitude: Tensor, depth: Tensor, optics: OpticsConfig, focus_dpt: list[float], pupil_mm: float
) -> Tensor:
    """The focal stack [K, 3, H, W] that a simple display of incoherent light would show which knows the picture and its
    depth alone: layers, each blurred by its disc of confusion, composed far to near, and divided by the light that a
    white scene would have, for where nothing is known behind an edge. Blur is circular.

    It has no hologram and none of its faults, but guesses nothing of what is hidden: a network may do better.
    """
    height, width = depth.shape
    light = amplitude.square()
    layer = (depth * RGBD_BLUR_LAYERS).long().clamp(0, RGBD_BLUR_LAYERS - 1)
    centres = (torch.arange(RGBD_BLUR_LAYERS, dtype=depth.dtype, device=depth.device) + 0.5) / RGBD_BLUR_LAYERS
    blurs_px = coc_px(optics, centres[None], focus_dpt, pupil_mm)[:, 0]
    fy = frequencies(height, 1.0, depth.device)[:, None]
    fx = torch.fft.rfftfreq(width, dtype=torch.float64, device=depth.device)
    turns = (math.pi * torch.sqrt(fx**2 + fy**2)).to(depth.dtype)
    # White and the three colours.
    seen = torch.zeros(len(focus_dpt), 4, height, width, dtype=depth.dtype, device=depth.device)
    for k in range(RGBD_BLUR_LAYERS):
        inside = (layer == k).to(depth.dtype)
        if not inside.any():
            continue
        sharp = torch.cat((inside[None], light * inside))
        spectrum = torch.fft.rfft2(sharp)
        for plane, blur_px in zip(seen, blurs_px[:, k].tolist(), strict=True):
            blurred = sharp
            if blur_px > SHARP_PX:
                # A disc's spectrum.
                x = (blur_px * turns).clamp_min(1e-4)
                blurred = torch.fft.irfft2(spectrum * (2 * torch.special.bessel_j1(x) / x), s=(height, width))
            plane.mul_(1 - blurred[0].clamp(0, 1)).add_(blurred)
    return seen[:, 1:].div_(seen[:, :1].clamp_min(1e-3))


def flat_oracle(target: Tensor) -> Tensor:
    """The mean of the target stack [K, 3, H, W] at every focus: it wins PSNR and has no focus at all."""
    return target.mean(dim=0, keepdim=True).expand_as(target)
