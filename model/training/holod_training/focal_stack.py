"""The `focal-stack` network: N images focused at N depths in, phases and masks for N planes out."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import ConfigError, NetworkConfig, OpticsConfig
from holod_training.network import (
    CONDITIONS,
    OUTPUT_CHANNELS,
    FieldNetwork,
    Trunk,
    constant_maps,
    corrected,
    first_net,
    run_traced,
    second_net,
)
from holod_training.optics import frequencies, transfer
from holod_training.plane_light import FEEDBACK_SHARE, LIT, feed_back, light_planes
from holod_training.shards import Shard, ShardError, Stack, same_focuses


def planes_dpt(config: NetworkConfig, optics: OpticsConfig) -> list[float]:
    """Where the images are focused on a bench, far to near."""
    return [optics.dioptres(k / (config.planes - 1)) for k in range(config.planes)]


def check_focuses(shard: Shard, config: NetworkConfig) -> None:
    """Raises ShardError for a scene with other focuses than a focal-stack network takes on the scene's bench."""
    expected = tuple(planes_dpt(config, shard.optics))
    if not same_focuses(shard.focus_dpt, expected):
        raise ShardError(
            f"{shard.path}: focus_dpt is {shard.focus_dpt}, expected those that a focal-stack network takes, "
            f"{expected}; render such scenes with `holod-scenes generate --planes {config.planes}`"
        )


def focal_amplitudes(config: NetworkConfig, stack: Stack) -> Tensor:
    """The focal images' amplitudes [planes, 3, H, W]. Raises ConfigError where a stack has other focuses."""
    expected = planes_dpt(config, stack.optics)
    found = stack.focus_dpt
    if not same_focuses(found, expected):
        raise ConfigError(
            f"planes: found focal images at {', '.join(f'{f:.3f}' for f in found)} dpt, "
            f"the network takes {', '.join(f'{e:.3f}' for e in expected)}; render such scenes or change `planes`"
        )
    return stack.target.clamp_min(0).sqrt()


@lru_cache(maxsize=8)
def carriers_back(
    config: NetworkConfig, optics: OpticsConfig, height: int, width: int, dtype: torch.dtype, device: str
) -> Tensor:
    """Transfer functions [planes, 3, h, w] from every plane to the SLM plane on the network's grid, half band."""
    pitch_m = optics.pitch_m * (2 if config.grid == "half-band" else 1)
    fy, fx = (frequencies(size, pitch_m, device) for size in (height, width))
    limit = 0.25 / optics.pitch_m * (1 - 1e-9)
    inside = (fy.abs() < limit)[:, None] & (fx.abs() < limit)
    return (transfer(optics, fx, fy, [-optics.distance_m(d) for d in planes_dpt(config, optics)]) * inside).to(dtype)


def checked(amplitude: Tensor, config: NetworkConfig) -> Tensor:
    """Raises ConfigError for what is no batch of focal images."""
    if amplitude.dim() != 5 or amplitude.shape[1] != config.planes:
        expected = f"[N, {config.planes}, 3, H, W]"
        raise ConfigError(f"planes: found input of shape {list(amplitude.shape)}, expected {expected}")
    return amplitude


def with_conditions(x: Tensor, told: Tensor, config: NetworkConfig) -> Tensor:
    """x [N, C, h, w] and, where the network is told its pupil, `constant_maps`."""
    return torch.cat((x, constant_maps(told, x)), dim=1) if config.pupil_inputs else x


class FocalStackNetwork(FieldNetwork):
    """Σ_n ASM(mask_n · A_n · exp(jφ_n), −u_n): each image lights its own plane, through a mask of 0 to 1.

    Masks start at 1/N and phases near 0.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        spatial = 3 * config.planes * (4 if config.grid == "half-band" else 1)
        self.layers = Trunk(
            config,
            inputs=spatial + CONDITIONS * config.pupil_inputs,
            outputs=LIT * config.planes,
            layers=config.layers,
            dilations=config.dilations,
            adjustable_layers=config.adjustable_layers,
            last_share=0.1,
        )

    def forward(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        """amplitude [N, planes, 3, H, W] from `focal_amplitudes`; depth is not looked at."""
        count = self.config.planes
        amplitude = checked(amplitude, self.config)
        n = len(amplitude)
        x = amplitude.flatten(1, 2)
        lit = amplitude
        if self.config.grid == "half-band":
            lit = F.avg_pool2d(x, 2).unflatten(1, (count, 3))
            x = F.pixel_unshuffle(x, 2)
        told = self.told(pupil_mm)
        x = with_conditions(x, told, self.config)
        out = self.layers(x, told).to(amplitude.dtype).view(n, count, 4, *x.shape[2:])
        phase = math.pi * out[:, :, :3]
        light = torch.sigmoid(out[:, :, 3:] - math.log(count - 1)) * lit
        planes = torch.complex(light * torch.cos(phase), light * torch.sin(phase))
        kernels = carriers_back(self.config, self.optics, *x.shape[2:], planes.dtype, str(planes.device))
        return torch.fft.ifft2((torch.fft.fft2(planes) * kernels).sum(dim=1))


class FedBackFocalStackNetwork(FieldNetwork):
    """`expected-stack` with the true images: net 1 (`lighting`) gives phases and masks for their planes, the field
    takes a learned share of what `feed_back` finds lacking of them, net 2 (`correction`) sees field, change and lack
    and adds a residual. What is in focus is not known without depth, so no lack weighs more than another."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.scale = 2
        images = 3 * config.planes
        maps = images * self.scale**2 + CONDITIONS * config.pupil_inputs
        self.lighting = first_net(config, maps, LIT * config.planes)
        self.correction = second_net(config, 2 * OUTPUT_CHANNELS + maps + images)
        self.feedback_share = nn.Parameter(torch.tensor([FEEDBACK_SHARE]))

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """amplitude [N, planes, 3, H, W] from `focal_amplitudes`; depth is not looked at. `trace`, where given,
        receives what each stage puts out, as that of `expected-stack` does."""
        optics, told = self.optics, self.told(pupil_mm)
        images = checked(amplitude, self.config).flatten(1, 2)
        maps = with_conditions(F.pixel_unshuffle(images, self.scale) - 0.4, told, self.config)
        wanted = F.avg_pool2d(images.square(), self.scale).sqrt().unflatten(1, (-1, 3))
        distances_m = tuple(optics.distance_m(d) for d in planes_dpt(self.config, optics))
        out = run_traced("lighting", self.lighting, maps, told, trace)
        field = light_planes(out, wanted, optics, distances_m, self.scale)
        if trace is not None:
            trace["carried"] = field
        lack, change = feed_back(field, wanted, 1.0, pupil_mm, optics, distances_m, self.scale)
        field = field + self.feedback_share * change
        seen = torch.cat((field.real, field.imag, maps, change.real, change.imag, lack.flatten(1, 2)), dim=1)
        residual = run_traced("correction", self.correction, seen, told, trace)
        return corrected(field, residual)
