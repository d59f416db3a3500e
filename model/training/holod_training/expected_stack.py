"""The `expected-stack` network: what an eye should see at each depth, as far as a picture and its depth tell; light for
it on every depth layer; what that lacks, fed back; a correction."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.layered import encode, layer_centres_m
from holod_training.network import (
    CONDITIONS,
    OUTPUT_CHANNELS,
    FieldNetwork,
    corrected,
    first_net,
    run_traced,
    second_net,
)
from holod_training.optics import frequencies
from holod_training.plane_light import FEEDBACK_SHARE, LIT, feed_back, light_planes

# The least share of a white scene's light by which what is seen is divided.
LEAST_COVER = 0.02
# Below it a disc's spectrum is 1.
LEAST_ARGUMENT = 1e-3
SHARPNESS = 1.0
# Of each block of 2x2 pixels, in layers.
LAYER_SHIFTS = ((-0.375, 0.125), (0.375, -0.125))
# Net 1's further outputs for each depth layer of a refined stack: changes of three amplitudes.
REFINED = 3
REFINED_SHARE = 0.3


def inside_layers(depth: Tensor, count: int) -> Tensor:
    """Which points of depth [N, H, W] are placed in each of `count` layers, bool [N, count, H, W].

    The four pixels of a block are moved by fractions of a layer before they are placed, so that blocks near the border
    of two layers are shared by both: on a slanted plane sharpness goes over from one to the next.
    """
    height, width = depth.shape[-2:]
    shift = depth.new_tensor(LAYER_SHIFTS).repeat(-(-height // 2), -(-width // 2))[:height, :width]
    layer = (depth * count + shift).long().clamp(0, count - 1)
    return torch.stack([layer == k for k in range(count)], dim=1)


def layer_cover(depth: Tensor, count: int, scale: int) -> Tensor:
    """The share of each block of depth [N, H, W] that lies in each of `count` layers, [N, count, h, w]."""
    return F.avg_pool2d(inside_layers(depth, count).to(depth.dtype), scale)


def expected_stack(
    amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, optics: OpticsConfig, count: int, scale: int
) -> Tensor:
    """Intensities [N, count, 3, h, w] that eyes with pupils [N] would see of a picture, amplitude [N, 3, H, W] and
    depth [N, H, W], focused at the middle of each of `count` layers of depth: each layer blurred by its disc of
    confusion, their sum over that of a white scene. Blur is circular, no layer hides another, and nothing is guessed
    of what is hidden.

    The spectrum of a disc of diameter d that holds 1 is 2·J1(x)/x with x = π·d·|f| (Goodman, Introduction to Fourier
    Optics: the circle function).
    """
    inside = inside_layers(depth, count)[:, :, None].to(amplitude.dtype)
    parts = torch.cat((inside, amplitude.square()[:, None] * inside), dim=2)
    parts = F.avg_pool2d(parts.flatten(0, 1), scale).unflatten(0, (-1, count))
    height, width = parts.shape[-2:]

    fy = frequencies(height, 1.0, depth.device)[:, None]
    fx = torch.fft.rfftfreq(width, dtype=torch.float64, device=depth.device)
    turns = (math.pi * torch.sqrt(fx**2 + fy**2)).to(amplitude.dtype)
    layer_dpt = (optics.depth_near_dpt - optics.depth_far_dpt) / count
    apart = torch.arange(count, device=depth.device)
    samples_per_mm = apart.to(amplitude.dtype) * (layer_dpt * 1e-3 / optics.pixel_angle_rad / scale)
    # [N, layers apart, h, w // 2 + 1]
    x = ((pupil_mm[:, None] * samples_per_mm)[..., None, None] * turns).clamp_min(LEAST_ARGUMENT)
    disc = 2 * torch.special.bessel_j1(x) / x
    disc = disc[:, (apart[:, None] - apart).abs()]
    spectrum = torch.fft.rfft2(parts)
    seen = torch.einsum("nklyx,nlcyx->nkcyx", disc.to(spectrum.dtype), spectrum)
    white, light = torch.fft.irfft2(seen, s=(height, width)).split((1, 3), dim=2)
    return (light / white.clamp_min(LEAST_COVER)).clamp_min(0)


def with_refined_stack(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The state of an `expected-stack` network as that of a refined one that refines nothing yet."""
    last = max(int(key.split(".")[1]) for key in state if key.startswith("lighting."))
    refined = dict(state)
    for name in (f"lighting.{last}.weight", f"lighting.{last}.bias"):
        rows = len(state[name]) // LIT * REFINED
        refined[name] = torch.cat((state[name], state[name].new_zeros(rows, *state[name].shape[1:])))
    return refined


class ExpectedStackNetwork(FieldNetwork):
    """Both nets are told `expected_stack` at the `depth_layers`. Net 1 (`lighting`) gives each layer a mask of 0 to 1,
    which starts at one over their number, and a phase for each colour: what is expected there, through the mask, lights
    the layer, and all of it is carried to the SLM plane. With `refined_stack` it first corrects these images for
    the light and for the feedback: unlike a blur without occlusion, it can tell what lies before what. The field takes
    a learned share of what `feed_back` finds lacking, of which what is in focus weighs more by a learned factor; net 2
    (`correction`) sees the field, the change and the lack, and adds a residual.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.scale = 2
        stack = 3 * config.depth_layers
        maps = 5 * self.scale**2 + CONDITIONS + stack
        self.lighting = first_net(config, maps, (LIT + REFINED * config.refined_stack) * config.depth_layers)
        self.correction = second_net(config, 2 * OUTPUT_CHANNELS + maps + stack)
        self.feedback_share = nn.Parameter(torch.tensor([FEEDBACK_SHARE]))
        self.sharpness = nn.Parameter(torch.tensor([SHARPNESS]))

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """`trace`, where given, receives what each stage puts out: both nets' `encoded`, `layer_{i}` and `offsets_{i}`
        under their names and a dot, the field that arrives from the layers under `carried` (before any feedback)."""
        optics, count = self.optics, self.config.depth_layers
        told = self.told(pupil_mm)
        wanted = expected_stack(amplitude, depth, pupil_mm, optics, count, self.scale).sqrt()
        maps = encode(amplitude, depth, told, self.scale)
        maps = torch.cat((maps, wanted.flatten(1, 2) - 0.4), dim=1)
        out = run_traced("lighting", self.lighting, maps, told, trace)
        if self.config.refined_stack:
            refined = out[:, LIT * count :].unflatten(1, (count, REFINED))
            wanted = (wanted + REFINED_SHARE * refined).clamp_min(0)
        distances_m = tuple(layer_centres_m(optics, count))
        field = light_planes(out[:, : LIT * count], wanted, optics, distances_m, self.scale)
        if trace is not None:
            trace["carried"] = field
        weight = 1 + self.sharpness * layer_cover(depth, count, self.scale)[:, :, None]
        lack, change = feed_back(field, wanted, weight, pupil_mm, optics, distances_m, self.scale)
        field = field + self.feedback_share * change
        seen = torch.cat((field.real, field.imag, maps, change.real, change.imag, lack.flatten(1, 2)), dim=1)
        residual = run_traced("correction", self.correction, seen, told, trace)
        return corrected(field, residual)
