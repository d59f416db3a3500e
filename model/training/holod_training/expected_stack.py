"""The `expected-stack` network: what an eye should see at each depth, as far as a picture and its depth tell; light for
it on every depth layer; what that lacks, fed back; a correction."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.layered import encode, layer_centres_m, layer_numbers
from holod_training.network import CORRECTION_SHARE, OUTPUT_CHANNELS, FieldNetwork, Trunk, run_traced
from holod_training.optics import frequencies, intensity, pupil_mask, transfer

# The least share of a white scene's light by which what is seen is divided.
LEAST_COVER = 0.02
# Below it a disc's spectrum is 1.
LEAST_ARGUMENT = 1e-3
# Keeps the phase of what is dark defined.
DARK = 1e-6
FEEDBACK_SHARE = 0.5
SHARPNESS = 1.0


def inside_layers(depth: Tensor, count: int) -> Tensor:
    """Which points of depth [N, H, W] lie in each of `count` layers, bool [N, count, H, W]."""
    layer = layer_numbers(depth, count)
    return torch.stack([layer == k for k in range(count)], dim=1)


def layer_cover(depth: Tensor, count: int, scale: int) -> Tensor:
    """The share of each block of depth [N, H, W] that lies in each of `count` layers, [N, count, h, w]."""
    return F.avg_pool2d(inside_layers(depth, count).to(depth.dtype), scale)


@lru_cache(maxsize=8)
def layer_carriers(
    optics: OpticsConfig, count: int, scale: int, height: int, width: int, dtype: torch.dtype, device: str
) -> Tensor:
    """Transfer functions [count, 3, height, width] from the SLM plane to where the middle of each depth layer is
    imaged, on a grid of `scale` times the panel's pitch."""
    fy, fx = (frequencies(size, scale * optics.pitch_m, device) for size in (height, width))
    return transfer(optics, fx, fy, layer_centres_m(optics, count)).to(dtype)


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


def feed_back(
    field: Tensor, wanted: Tensor, weight: Tensor, pupil_mm: Tensor, optics: OpticsConfig, scale: int
) -> tuple[Tensor, Tensor]:
    """What eyes with pupils [N] lack of the amplitudes `wanted` [N, layers, 3, h, w] when they focus on each layer, and
    the mean of the changes of `field` [N, 3, h, w] at the SLM plane that would give it, each with its `weight`
    [N, layers, 1, h, w]: one step of Gerchberg and Saxton (1972) at all layers at once, with the phases that are there.
    Pupils of 2.3 mm and more cut nothing of the half band of the default bench.
    """
    height, width = field.shape[-2:]
    fy, fx = (frequencies(size, scale * optics.pitch_m, field.device) for size in (height, width))
    pupil = pupil_mask(optics, fx, fy, pupil_mm[:, None, None])
    carriers = layer_carriers(optics, wanted.shape[1], scale, height, width, field.dtype, str(field.device))
    arriving = torch.fft.ifft2((torch.fft.fft2(field) * pupil)[:, None] * carriers)
    amplitude = torch.sqrt(intensity(arriving) + DARK)
    lack = wanted - amplitude
    changes = torch.fft.fft2(arriving * (weight * lack / amplitude)) * carriers.conj()
    return lack, torch.fft.ifft2(changes.mean(dim=1) * pupil)


class ExpectedStackNetwork(FieldNetwork):
    """Both nets are told `expected_stack` at the `depth_layers`. Net 1 (`lighting`) gives each layer a mask of 0 to 1,
    which starts at one over their number, and a phase for each colour: what is expected there, through the mask, lights
    the layer, and all of it is carried to the SLM plane. That field takes a learned share of what `feed_back` finds
    lacking, of which what is in focus weighs more by a learned factor; net 2 (`correction`) sees the field, the change
    and the lack, and adds a residual.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.scale = 2
        stack = 3 * config.depth_layers
        maps = 5 * self.scale**2 + 1 + stack
        self.lighting = Trunk(
            config,
            inputs=maps,
            outputs=4 * config.depth_layers,
            layers=config.layers,
            dilations=config.dilations,
            adjustable_layers=config.adjustable_layers,
            last_share=0.15,
        )
        self.correction = Trunk(
            config,
            inputs=2 * OUTPUT_CHANNELS + maps + stack,
            outputs=OUTPUT_CHANNELS,
            layers=config.correction_layers,
            dilations=config.correction_dilations,
            adjustable_layers=(),
            last_share=0.1,
        )
        self.feedback_share = nn.Parameter(torch.tensor([FEEDBACK_SHARE]))
        self.sharpness = nn.Parameter(torch.tensor([SHARPNESS]))

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """`trace`, where given, receives what each stage puts out: both nets' `encoded`, `layer_{i}` and `offsets_{i}`
        under their names and a dot, the field that arrives from the layers under `carried` (before any feedback)."""
        optics, count = self.config.optics, self.config.depth_layers
        wanted = expected_stack(amplitude, depth, pupil_mm, optics, count, self.scale).sqrt()
        maps = encode(amplitude, depth, pupil_mm, self.scale)
        maps = torch.cat((maps, wanted.flatten(1, 2) - 0.4), dim=1)
        field = self.light_layers(run_traced("lighting", self.lighting, maps, pupil_mm, trace), wanted)
        if trace is not None:
            trace["carried"] = field
        weight = 1 + self.sharpness * layer_cover(depth, count, self.scale)[:, :, None]
        lack, change = feed_back(field, wanted, weight, pupil_mm, optics, self.scale)
        field = field + self.feedback_share * change
        seen = torch.cat((field.real, field.imag, maps, change.real, change.imag, lack.flatten(1, 2)), dim=1)
        residual = run_traced("correction", self.correction, seen, pupil_mm, trace)
        return field + CORRECTION_SHARE * torch.complex(residual[:, :3].contiguous(), residual[:, 3:].contiguous())

    def light_layers(self, out: Tensor, wanted: Tensor) -> Tensor:
        """The field at the SLM plane, complex [N, 3, h, w], from net 1's output and amplitudes [N, layers, 3, h, w]."""
        count = self.config.depth_layers
        phase, mask = out.unflatten(1, (count, 4)).split((3, 1), dim=2)
        phase = math.pi * phase
        light = torch.sigmoid(mask - math.log(count - 1)) * wanted
        planes = torch.complex(light * torch.cos(phase), light * torch.sin(phase))
        height, width = planes.shape[-2:]
        device = str(planes.device)
        carriers = layer_carriers(self.config.optics, count, self.scale, height, width, planes.dtype, device)
        return torch.fft.ifft2((torch.fft.fft2(planes) * carriers.conj()).sum(dim=1))
