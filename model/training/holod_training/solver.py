"""Direct optimisation of one scene's field: slow, and as good as one coherent frame (or several) can get."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from holod_training.config import OpticsConfig
from holod_training.loss import LossWeights, focus_loss
from holod_training.optics import HalfBandEye, coc_px, half_band_samples, shown_by_panel, upsample_half_band
from holod_training.shards import Stack

NOISE_SIGMA = 0.03


@dataclass(frozen=True)
class SolverConfig:
    """`frames` fields are shown one after the other, and their intensities averaged. Of several frames each starts
    `spread` (rms, in amplitude) away from the given start: twins would have the same gradient for ever. At most
    `planes` focal planes take part, spread evenly over the stack."""

    iterations: int = 200
    frames: int = 1
    loss: LossWeights = field(default_factory=LossWeights)
    learning_rate: float = 0.03
    final_rate_share: float = 0.05
    spread: float = 0.1
    planes: int = 12
    seed: int = 1


@dataclass(frozen=True)
class Solution:
    """field [frames, 3, H, W], half band; the loss that it began and that it ended with."""

    field: Tensor
    first_loss: float
    last_loss: float


def smooth_noise(shape: tuple[int, ...], seed: int) -> Tensor:
    """Complex noise of rms 1, [..., h, w], its spectrum a Gaussian of σ 0.03 cycles per sample: no speckle."""
    noise = torch.randn(shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(seed))
    fy, fx = torch.fft.fftfreq(shape[-2]), torch.fft.fftfreq(shape[-1])
    passed = torch.exp(-(fy[:, None] ** 2 + fx[None, :] ** 2) / (2 * NOISE_SIGMA**2))
    low = torch.fft.ifft2(torch.fft.fft2(noise) * passed)
    return low / low.abs().square().mean().sqrt()


@torch.enable_grad()
def optimise(
    stack: Stack, start: Tensor, optics: OpticsConfig, amplitude_constant: float, config: SolverConfig
) -> Solution:
    """Adam on the field itself, towards the stack's target.

    start: complex [3, H, W], of which the half band counts; of frames [N, 3, H, W] the first. The loss is the
    training's own, of what the panel shows after double phase. The best field met is returned, so it never ends above
    where it began.
    """
    chosen = torch.linspace(0, len(stack.focus_dpt) - 1, min(config.planes, len(stack.focus_dpt))).round().long()
    focus = [stack.focus_dpt[k] for k in chosen]
    target = stack.target[chosen.to(stack.target.device)]
    height, width = stack.depth.shape
    eye = HalfBandEye(optics, height, width, focus, stack.depth.device)
    blur = coc_px(optics, stack.depth, focus, stack.pupil_mm)
    first = start if start.dim() == 3 else start[0]
    samples = half_band_samples(first).repeat(config.frames, 1, 1, 1)
    if config.frames > 1:
        samples += config.spread * smooth_noise(tuple(samples.shape), config.seed).to(samples.device)
    low = torch.view_as_real(samples).requires_grad_()
    adam = torch.optim.Adam([low], config.learning_rate, betas=(0.9, 0.99))
    first_loss = best_loss = math.inf
    best = low.detach().clone()
    for iteration in range(config.iterations + 1):
        frames = shown_by_panel(torch.view_as_complex(low), amplitude_constant, (height, width))
        picture = torch.stack([eye.look(frame, stack.pupil_mm) for frame in frames]).mean(dim=0)
        loss = focus_loss(picture, target, blur, config.loss.for_bench(optics, stack.pupil_mm)).total
        if iteration == 0:
            first_loss = loss.item()
        if loss.item() < best_loss:
            best_loss = loss.item()
            best.copy_(low.detach())
        if iteration == config.iterations:
            break
        share = 0.5 * (1 + math.cos(math.pi * iteration / config.iterations))
        adam.param_groups[0]["lr"] = config.learning_rate * (
            config.final_rate_share + (1 - config.final_rate_share) * share
        )
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()
    return Solution(upsample_half_band(torch.view_as_complex(best)), first_loss, best_loss)
