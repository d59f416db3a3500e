"""The training loss: the paper's two terms, plain and in-focus squared errors, and a squared focus error."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

IN_FOCUS_PX = 2.0


@dataclass(frozen=True)
class LossWeights:
    absolute: float = 1.0
    gradient: float = 1.0
    squared: float = 8.0
    focus: float = 15.0
    coc_floor_px: float = 0.2
    in_focus: float = 0.0


@dataclass(frozen=True)
class LossParts:
    """`total` carries the gradient; the rest are plain numbers to log."""

    total: Tensor
    psnr_db: float
    slope: float
    correlation: float


def sharpness_weight(coc_px: Tensor, floor_px: float) -> Tensor:
    """W = 1/log2(1 + max(C, floor)): what is in focus counts most."""
    return 1 / torch.log2(1 + coc_px.clamp_min(floor_px))


def in_focus_weight(coc_px: Tensor) -> Tensor:
    """1 where the scene is sharp, falling softly through 1/2 at the CoC that metrics call in focus."""
    return 1 / (1 + (coc_px / IN_FOCUS_PX) ** 4)


def inner(x: Tensor, border_px: int) -> Tensor:
    """Without a border on the last two axes."""
    return x[..., border_px : x.shape[-2] - border_px, border_px : x.shape[-1] - border_px]


def focus_loss(picture: Tensor, target: Tensor, coc_px: Tensor, weights: LossWeights) -> LossParts:
    """picture, target [K, 3, H, W] linear light at every focus of one pupil; coc_px [K, H, W] for these focuses.

    The focus error compares P_k − mean_k P with R_k − mean_k R *squared*: an absolute error would pull sparse
    differences to their median, zero, and the network would show one blurred picture at every depth.
    In-focus pixels are a few per cent of a stack: only a weight on *their* squared error makes them sharp.
    """
    w = sharpness_weight(coc_px, weights.coc_floor_px)[:, None]
    error = picture - target
    dx = error[..., :, 1:] - error[..., :, :-1]
    dy = error[..., 1:, :] - error[..., :-1, :]
    squared_error = error.square()
    squared = squared_error.mean()
    centred_error = error - error.mean(dim=0)
    total = (
        weights.absolute * (w * error.abs()).mean()
        + weights.gradient * ((w[..., 1:] * dx.abs()).mean() + (w[..., 1:, :] * dy.abs()).mean())
        + weights.squared * squared
        + weights.focus * centred_error.square().mean()
        + weights.in_focus * (in_focus_weight(coc_px)[:, None] * squared_error).mean()
    )
    with torch.no_grad():
        r = target - target.mean(dim=0)
        p = centred_error + r
        pr, rr, pp = (p * r).sum(), r.square().sum(), p.square().sum()
        return LossParts(
            total=total,
            psnr_db=float(-10 * torch.log10(squared.clamp_min(1e-12))),
            slope=float(pr / rr.clamp_min(1e-12)),
            correlation=float(pr / (pp * rr).sqrt().clamp_min(1e-12)),
        )
