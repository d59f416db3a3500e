"""The numbers that judge a hologram: never PSNR alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from holod_training.foam import OUT_OF_FOCUS_PX, REGION_PX, foam_energy
from holod_training.loss import IN_FOCUS_PX, inner

SSIM_WINDOW_PX = 11


class JudgementError(ValueError):
    """A picture that has no figures; the message says whose, where that is known, and why."""


@dataclass(frozen=True)
class Judgement:
    """One scene at one pupil, or a mean over scenes. NaN: of a part of the picture that is empty, or not asked for."""

    psnr_db: float
    psnr_in_focus_db: float
    psnr_out_of_focus_db: float
    slope: float
    correlation: float
    ssim: float
    foam: float = math.nan
    lpips: float = math.nan

    def known(self) -> dict[str, float]:
        """Without what is NaN: JSON has no word for it."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if not math.isnan(value)}

    @staticmethod
    def mean(of: list[Judgement]) -> Judgement:
        def average(name: str) -> float:
            values = [v for j in of if not math.isnan(v := getattr(j, name))]
            return sum(values) / len(values) if values else math.nan

        return Judgement(**{f.name: average(f.name) for f in fields(Judgement)})


def psnr_db(squared_error: Tensor) -> float:
    """Peak 1; NaN for no pixels."""
    return float(-10 * torch.log10(squared_error.double().mean().clamp_min(1e-12)))


def focus_response(picture: Tensor, target: Tensor) -> tuple[float, float]:
    """Slope and correlation of P_k − mean_k P on R_k − mean_k R over all pixels, colours and planes [K, 3, H, W].

    1 is the target's full refocus, 0 the same picture at all planes; a flat picture has correlation 0.
    """
    picture_mean, target_mean = picture.mean(dim=0), target.mean(dim=0)
    pr = rr = pp = 0.0
    for shown, wanted in zip(picture, target, strict=True):
        p, r = (shown - picture_mean).double(), (wanted - target_mean).double()
        pr += float((p * r).sum())
        rr += float(r.square().sum())
        pp += float(p.square().sum())
    if rr <= 1e-12:
        return math.nan, math.nan
    return pr / rr, pr / math.sqrt(pp * rr) if pp > 1e-12 else 0.0


def ssim(picture: Tensor, target: Tensor) -> float:
    """Wang et al. 2004: 11x11 Gaussian, σ 1.5, peak 1, over [K, 3, H, W]; windows that fit only, mean of all."""
    return sum(_ssim_map(p, t).double().mean().item() for p, t in zip(picture, target, strict=True)) / len(target)


def _ssim_map(picture: Tensor, target: Tensor) -> Tensor:
    mp, mt = _windowed(picture), _windowed(target)
    vp = _windowed(picture * picture) - mp * mp
    vt = _windowed(target * target) - mt * mt
    covariance = _windowed(picture * target) - mp * mt
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mp * mt + c1) * (2 * covariance + c2)) / ((mp**2 + mt**2 + c1) * (vp + vt + c2))


def _windowed(light: Tensor) -> Tensor:
    """The Gaussian mean [..., H - 10, W - 10] where the window fits. Eleven shifted sums a way: on a CPU eight times
    faster than a convolution of one channel, and without a matrix that grows with the picture."""
    taps = [math.exp(-((k - 5) ** 2) / (2 * 1.5**2)) for k in range(SSIM_WINDOW_PX)]
    for dim in (-1, -2):
        size = light.shape[dim] - (SSIM_WINDOW_PX - 1)
        total = torch.zeros_like(light.narrow(dim, 0, size))
        for k, tap in enumerate(taps):
            total.add_(light.narrow(dim, k, size), alpha=tap / sum(taps))
        light = total
    return light


def judge(
    picture: Tensor,
    target: Tensor,
    coc_px: Tensor,
    border_px: int,
    with_ssim: bool = True,
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Judgement:
    """picture, target [K, 3, H, W] linear light; coc_px [K, H, W]; a border is left out. Plane by plane: a stack of
    fifty focuses in full HD leaves no room for copies. `lpips`: distances [N] of pictures [N, 3, H, W].

    Raises JudgementError for a picture with values that are no numbers: NaN in a Judgement is an empty part."""
    picture, target, coc_px = (inner(t, border_px) for t in (picture, target, coc_px))
    whole, sharp, blurred = _Mean(), _Mean(), _Mean()
    foam, foam_pixels = 0.0, 0.0
    for shown, wanted, blur in zip(picture, target, coc_px, strict=True):
        error = (shown - wanted).square()
        whole.add(error)
        sharp.add(error[:, blur < IN_FOCUS_PX])
        blurred.add(error[:, blur > OUT_OF_FOCUS_PX])
        if min(blur.shape) >= REGION_PX:
            energy, pixels = foam_energy(shown[None], wanted[None], blur[None])
            foam, foam_pixels = foam + energy.item(), foam_pixels + pixels.item()
    if not math.isfinite(whole.total):
        raise JudgementError("found a picture with values that are no numbers, expected finite light")
    slope, correlation = focus_response(picture, target)
    return Judgement(
        psnr_db=whole.psnr_db(),
        psnr_in_focus_db=sharp.psnr_db(),
        psnr_out_of_focus_db=blurred.psnr_db(),
        slope=slope,
        correlation=correlation,
        ssim=ssim(picture, target) if with_ssim else math.nan,
        foam=foam / foam_pixels if foam_pixels else math.nan,
        lpips=math.nan if lpips is None else _mean_distance(lpips, picture, target),
    )


def _mean_distance(distance: Callable[[Tensor, Tensor], Tensor], picture: Tensor, target: Tensor) -> float:
    planes = zip(picture.split(1), target.split(1), strict=True)
    return sum(float(distance(shown, wanted)) for shown, wanted in planes) / len(target)


class _Mean:
    """Of squared errors that come in parts."""

    def __init__(self) -> None:
        self.total = 0.0
        self.count = 0

    def add(self, squared_error: Tensor) -> None:
        self.total += squared_error.double().sum().item()
        self.count += squared_error.numel()

    def psnr_db(self) -> float:
        return -10 * math.log10(max(self.total / self.count, 1e-12)) if self.count else math.nan


def gradient_energy(picture: Tensor, area: Tensor) -> float:
    """Mean squared forward difference of [3, H, W] over pixels of `area` [H, W] whose neighbours lie in it too."""
    dx = (picture[:, :, 1:] - picture[:, :, :-1]).square()
    dy = (picture[:, 1:] - picture[:, :-1]).square()
    in_x = area[:, 1:] & area[:, :-1]
    in_y = area[1:] & area[:-1]
    total = (dx * in_x).sum() + (dy * in_y).sum()
    return float(total / (picture.shape[0] * (in_x.sum() + in_y.sum()).clamp_min(1)))
