"""The numbers that judge a hologram: never PSNR alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache

import torch
from torch import Tensor

from holod_training.loss import IN_FOCUS_PX, inner

OUT_OF_FOCUS_PX = 8.0


@dataclass(frozen=True)
class Judgement:
    """One scene at one pupil, or a mean over scenes. A part of the picture that is empty gives NaN."""

    psnr_db: float
    psnr_in_focus_db: float
    psnr_out_of_focus_db: float
    slope: float
    correlation: float
    ssim: float

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
    p = (picture - picture.mean(dim=0)).double()
    r = (target - target.mean(dim=0)).double()
    pr, rr, pp = (p * r).sum(), r.square().sum(), p.square().sum()
    if rr <= 1e-12:
        return math.nan, math.nan
    return float(pr / rr), float(pr / (pp * rr).sqrt()) if pp > 1e-12 else 0.0


def ssim(picture: Tensor, target: Tensor) -> float:
    """Wang et al. 2004: 11x11 Gaussian, σ 1.5, peak 1, over [K, 3, H, W]; windows that fit only, mean of all."""
    rows, columns = _gaussian_windows(picture.shape[-2]), _gaussian_windows(picture.shape[-1])

    def blur(t: Tensor) -> Tensor:
        return rows @ t @ columns.T

    mp, mt = blur(picture), blur(target)
    vp = blur(picture * picture) - mp * mp
    vt = blur(target * target) - mt * mt
    covariance = blur(picture * target) - mp * mt
    c1, c2 = 0.01**2, 0.03**2
    return float((((2 * mp * mt + c1) * (2 * covariance + c2)) / ((mp**2 + mt**2 + c1) * (vp + vt + c2))).mean())


@cache
def _gaussian_windows(size: int) -> Tensor:
    """The 11-tap Gaussian at every place where it fits, as a banded matrix [size - 10, size]."""
    x = torch.arange(11, dtype=torch.float32) - 5
    g = torch.exp(-x.square() / (2 * 1.5**2))
    band = torch.zeros(size - 10, size)
    for row in range(size - 10):
        band[row, row : row + 11] = g / g.sum()
    return band


def judge(picture: Tensor, target: Tensor, coc_px: Tensor, border_px: int, with_ssim: bool = True) -> Judgement:
    """picture, target [K, 3, H, W] linear light; coc_px [K, H, W]; a border is left out."""
    picture, target, coc_px = (inner(t, border_px) for t in (picture, target, coc_px))
    error = (picture - target).square()
    sharp = (coc_px < IN_FOCUS_PX)[:, None].expand_as(error)
    blurred = (coc_px > OUT_OF_FOCUS_PX)[:, None].expand_as(error)
    slope, correlation = focus_response(picture, target)
    return Judgement(
        psnr_db=psnr_db(error),
        psnr_in_focus_db=psnr_db(error[sharp]),
        psnr_out_of_focus_db=psnr_db(error[blurred]),
        slope=slope,
        correlation=correlation,
        ssim=ssim(picture, target) if with_ssim else math.nan,
    )


def gradient_energy(picture: Tensor, area: Tensor) -> float:
    """Mean squared forward difference of [3, H, W] over pixels of `area` [H, W] whose neighbours lie in it too."""
    dx = (picture[:, :, 1:] - picture[:, :, :-1]).square()
    dy = (picture[:, 1:] - picture[:, :-1]).square()
    in_x = area[:, 1:] & area[:, :-1]
    in_y = area[1:] & area[:-1]
    total = (dx * in_x).sum() + (dy * in_y).sum()
    return float(total / (picture.shape[0] * (in_x.sum() + in_y.sum()).clamp_min(1)))
