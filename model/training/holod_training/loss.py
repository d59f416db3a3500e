"""The training loss: the paper's terms, squared errors plain, in focus and of what stays sharp out of it, focus errors,
and a teacher's pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.foam import foam_energy

IN_FOCUS_PX = 2.0
# Blur over the depth volume for which the weight of what is in focus is meant, and above which it grows no more: a
# pupil of 2 mm and one of 5 mm on the default bench.
IN_FOCUS_BLUR_PX = 200 / 7
MOST_IN_FOCUS_BLUR_PX = 500 / 7
PERCEPTUAL_PLANES = 5
# Marks are faint at the edges of their discs; black is exactly 0.
LEAST_LIGHT = 1e-6
AWAY_PX = 16
STRUCTURE_SCALES = 3
WINDOW_PX = 8
# Wider than a pupil of 1 mm spreads a pixel by diffraction, and about what one of 8 mm blurs it over; and the light, in
# white pixels, from which on a window's error counts in proportion.
LIGHT_WINDOWS_PX = (16, 64)
LIGHT_FLOOR_PX = 1.25


@dataclass(frozen=True)
class LossWeights:
    """The weight of each term, and the CoC below which sharpness counts no more.

    `in_focus` is for a pupil of 2 mm on the default bench: what is in focus is a share of a stack that falls as the
    blur over the depth volume grows, so `for_bench` lets its weight grow in proportion, or by another power,
    `in_focus_growth`: with 2 wide pupils lose less of their sharpness. On benches of more diffraction than the default
    one, which blurs what is in focus, too, it grows by the power `in_focus_diffraction_growth` of green's, and that of
    `outlines` by `outlines_diffraction_growth`.
    `absolute` and `gradient` are the paper's: |P − R| and |∇P − ∇R| weighted by W; so is a perceptual error of some
    planes: `lpips` where a run has its weights, `structure` needs none. `outlines` is |∇P − ∇R|² where the scene is out
    of focus: what stands there of a mark is small in every other term. `black` is the light where there should be
    none for 16 px around, which squares nearly to nothing and is seen all the same; `light` is how far the mean light
    of windows is off, in proportion: a small mark that cannot be sharp is nearest to its target, by every other term,
    when it is dim. `teacher` counts only where there is one.
    """

    absolute: float = 1.0
    gradient: float = 1.0
    squared: float = 8.0
    focus: float = 15.0
    coc_floor_px: float = 0.2
    in_focus: float = 0.0
    in_focus_growth: float = 1.0
    in_focus_diffraction_growth: float = 0.0
    focus_absolute: float = 0.0
    outlines: float = 0.0
    outlines_diffraction_growth: float = 0.0
    black: float = 0.0
    light: float = 0.0
    foam: float = 0.0
    structure: float = 0.0
    lpips: float = 1.0
    teacher: float = 8.0

    def for_bench(self, optics: OpticsConfig, pupil_mm: float) -> LossWeights:
        blur = min(optics.volume_blur_px(pupil_mm), MOST_IN_FOCUS_BLUR_PX) / IN_FOCUS_BLUR_PX
        (_, green, _), (_, of_default, _) = optics.volume_fresnel_px2, OpticsConfig().volume_fresnel_px2
        diffraction = max(1.0, green / of_default)
        return replace(
            self,
            in_focus=self.in_focus * blur**self.in_focus_growth * diffraction**self.in_focus_diffraction_growth,
            outlines=self.outlines * diffraction**self.outlines_diffraction_growth,
        )


def option_of(loss_key: str) -> str:
    """The command line's name of a value of `LossWeights`."""
    return f"--{loss_key.replace('_', '-')}" + ("" if loss_key.endswith(("_px", "_growth")) else "-weight")


@dataclass(frozen=True)
class LossParts:
    """`total` carries the gradient; the rest are plain numbers to log. `terms` are as yet without their weights."""

    total: Tensor
    terms: dict[str, float]
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


def structure_loss(picture: Tensor, target: Tensor) -> Tensor:
    """1 − a multi-scale structural similarity of [K, 3, H, W], peak 1; 0 for equal pictures, at most 2.

    After Wang, Simoncelli and Bovik 2003: contrast and structure at every scale, luminance at the coarsest. Windows
    are plain 8x8 squares every 4 pixels, and scales are averaged, not multiplied: that keeps gradients alive where a
    scale fails. Scales of fewer pixels than a window are left out. Raises ValueError where not even the first fits.
    """
    if min(picture.shape[-2:]) < WINDOW_PX:
        raise ValueError(f"pictures of {tuple(picture.shape[-2:])} pixels have no {WINDOW_PX}-pixel window")

    def mean(t: Tensor) -> Tensor:
        return F.avg_pool2d(t, WINDOW_PX, stride=WINDOW_PX // 2)

    c1, c2 = 0.01**2, 0.03**2
    scales: list[Tensor] = []
    while True:
        mp, mt = mean(picture), mean(target)
        vp, vt = mean(picture * picture) - mp * mp, mean(target * target) - mt * mt
        similarity = (2 * (mean(picture * target) - mp * mt) + c2) / (vp + vt + c2)
        picture, target = F.avg_pool2d(picture, 2), F.avg_pool2d(target, 2)
        if len(scales) + 1 == STRUCTURE_SCALES or min(picture.shape[-2:]) < WINDOW_PX:
            luminance = (2 * mp * mt + c1) / (mp * mp + mt * mt + c1)
            scales.append((luminance * similarity).mean())
            return 1 - torch.stack(scales).mean()
        scales.append(similarity.mean())


def dark_area(target: Tensor) -> Tensor:
    """Where a stack [K, 3, H, W] is black at every focus and so is all within 16 px each way, [H, W] bool."""
    lit = (target.amax(dim=(0, 1)) > LEAST_LIGHT).float()
    return F.max_pool2d(lit[None, None], 2 * AWAY_PX + 1, stride=1, padding=AWAY_PX)[0, 0] == 0


def light_loss(picture: Tensor, target: Tensor) -> Tensor:
    """Mean of |light − wanted light| / (wanted light + that of 1.25 white pixels) of windows of [K, 3, H, W], 16 and 64
    px wide, half a window apart; the wider ones are left out where a picture is smaller."""
    errors: list[Tensor] = []
    for window in LIGHT_WINDOWS_PX:
        if errors and min(picture.shape[-2:]) < window:
            break
        seen, wanted = (F.avg_pool2d(t, window, window // 2) for t in (picture, target))
        errors.append(((seen - wanted).abs() / (wanted + LIGHT_FLOOR_PX / window**2)).mean())
    return torch.stack(errors).mean()


def focus_loss(
    picture: Tensor,
    target: Tensor,
    coc_px: Tensor,
    weights: LossWeights,
    perceptual_planes: Tensor | None = None,
    lpips: Callable[[Tensor, Tensor], Tensor] | None = None,
    teacher: Tensor | None = None,
    border_px: int = 0,
) -> LossParts:
    """picture, target [K, 3, H, W] linear light at every focus of one pupil; coc_px [K, H, W] for these focuses.

    border_px: left out on every side, where a crop lacks the light of what is beyond; but for `black` and `light`: a
    network whose light by the edges nothing weighs leaves a rim there, bright on black or dark on all else.

    perceptual_planes: indices of the planes for `structure` and `lpips`; all of them where left out.
    lpips: distances [N] of pictures [N, 3, H, W] of linear light.
    teacher [K, 3, H, W]: the pictures of another network, for in-network distillation.

    The focus error compares P_k − mean_k P with R_k − mean_k R *squared*: an absolute error would pull sparse
    differences to their median, zero, and the network would show one blurred picture at every depth.
    In-focus pixels are a few per cent of a stack: only a weight on *their* squared error makes them sharp.
    """
    terms = {}
    if weights.black:
        terms["black"] = (picture * dark_area(target)).mean()
    if weights.light:
        terms["light"] = light_loss(picture, target)
    picture, target, coc_px = (inner(t, border_px) for t in (picture, target, coc_px))
    w = sharpness_weight(coc_px, weights.coc_floor_px)[:, None]
    error = picture - target
    dx = error[..., :, 1:] - error[..., :, :-1]
    dy = error[..., 1:, :] - error[..., :-1, :]
    squared_error = error.square()
    squared = squared_error.mean()
    centred_error = error - error.mean(dim=0)
    terms |= {
        "absolute": (w * error.abs()).mean(),
        "gradient": (w[..., 1:] * dx.abs()).mean() + (w[..., 1:, :] * dy.abs()).mean(),
        "squared": squared,
        "focus": centred_error.square().mean(),
        "in_focus": (in_focus_weight(coc_px)[:, None] * squared_error).mean(),
    }
    if weights.outlines:
        blurred = 1 - in_focus_weight(coc_px)[:, None]
        terms["outlines"] = (blurred[..., 1:] * dx.square()).mean() + (blurred[..., 1:, :] * dy.square()).mean()
    if weights.foam:
        energy, pixels = foam_energy(picture, target, coc_px)
        terms["foam"] = energy / pixels.clamp_min(1)
    if weights.focus_absolute:
        terms["focus_absolute"] = centred_error.abs().mean()
    chosen = slice(None) if perceptual_planes is None else perceptual_planes
    if weights.structure:
        terms["structure"] = structure_loss(picture[chosen], target[chosen])
    if lpips is not None:
        terms["lpips"] = lpips(picture[chosen], target[chosen]).mean()
    if teacher is not None:
        terms["teacher"] = (picture - inner(teacher, border_px)).square().mean()
    total = sum((getattr(weights, name) * value for name, value in terms.items()), picture.new_zeros(()))
    with torch.no_grad():
        r = target - target.mean(dim=0)
        p = centred_error + r
        pr, rr, pp = (p * r).sum(), r.square().sum(), p.square().sum()
        return LossParts(
            total=total,
            terms=dict(zip(terms, torch.stack(list(terms.values())).tolist(), strict=True)),
            psnr_db=float(-10 * torch.log10(squared.clamp_min(1e-12))),
            slope=float(pr / rr.clamp_min(1e-12)),
            correlation=float(pr / (pp * rr).sqrt().clamp_min(1e-12)),
        )
