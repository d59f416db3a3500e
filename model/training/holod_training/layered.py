"""The `layered` network: what the objects' surfaces should send out is learned, physics carries it."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.network import (
    CONDITIONS,
    OUTPUT_CHANNELS,
    FieldNetwork,
    blur_scale,
    constant_maps,
    corrected,
    first_net,
    run_traced,
    second_net,
)
from holod_training.optics import frequencies, stop_half_band, transfer

LOG_FLOOR = 0.03
LOG_OFFSET = 1.66
SIGMAS_PX = (1.0, 2.5, 6.0)
PRIOR_GAINS = (-0.5, -1.0, 0.0)
REFERENCE_NM = 520.0


@lru_cache(maxsize=32)
def carrier(
    optics: OpticsConfig, scale: int, height: int, width: int, distance_m: float, dtype: torch.dtype, device: str
) -> Tensor:
    """The transfer function [3, height, width] of one distance on a grid of `scale` times the panel's pitch."""
    fy, fx = (frequencies(size, scale * optics.pitch_m, device) for size in (height, width))
    return transfer(optics, fx, fy, [distance_m])[0].to(dtype)


@lru_cache(maxsize=8)
def gaussians(height: int, width: int, sigmas: tuple[float, ...], dtype: torch.dtype, device: str) -> Tensor:
    """Spectra of circular Gaussian blurs, [len(sigmas), 1, H, W // 2 + 1]: exp(−2π²σ²f²); sigmas in samples."""
    fy = frequencies(height, 1.0, device)[:, None]
    fx = torch.fft.rfftfreq(width, dtype=torch.float64, device=device)
    sigma = torch.tensor(sigmas, dtype=torch.float64, device=device)[:, None, None]
    return torch.exp(-2 * math.pi**2 * sigma**2 * (fx**2 + fy**2))[:, None].to(dtype)


def blurred(x: Tensor, sigmas: tuple[float, ...]) -> Tensor:
    """x [N, 3, H, W] -> [N, len(sigmas), 3, H, W]; sigmas in samples."""
    height, width = x.shape[-2:]
    kernels = gaussians(height, width, sigmas, x.dtype, str(x.device))
    return torch.fft.irfft2(torch.fft.rfft2(x)[:, None] * kernels, s=(height, width))


def carry(field: Tensor, optics: OpticsConfig, scale: int, distance_m: float) -> Tensor:
    """A field [..., 3, h, w] a distance further, as `optics.propagate`; kernels are kept."""
    kernel = carrier(optics, scale, *field.shape[-2:], distance_m, field.dtype, str(field.device))
    return torch.fft.ifft2(torch.fft.fft2(field) * kernel)


def layer_numbers(depth: Tensor, count: int) -> Tensor:
    """Which of `count` layers of equal depth, 0 the farthest, each point of `depth` lies in."""
    return (depth * count).long().clamp(0, count - 1)


def layer_centres_m(optics: OpticsConfig, count: int) -> list[float]:
    """Metres from the SLM plane to where the middle of each of `count` layers is imaged, far to near."""
    return [optics.distance_m(optics.dioptres((k + 0.5) / count)) for k in range(count)]


def compose(source: Tensor, depth: Tensor, optics: OpticsConfig, count: int, scale: int = 1) -> Tensor:
    """The field at the SLM plane, complex [N, 3, h, w], of `count` equal layers of depth [N, H, W] whose points send
    out `source` [N, 3, h, w]: f ← f·(1 − m) + O·m from far to near, by ASM between layers and at last back.

    m covers a layer and its next nearer one: slanted surfaces show no seams. On a grid of `scale` times the panel's
    pitch it is the share of a block.
    """
    centres = layer_centres_m(optics, count)
    layer = layer_numbers(depth, count)[:, None]
    field = torch.zeros_like(source)
    for k in range(count):
        if k:
            field = carry(field, optics, scale, centres[1] - centres[0])
        cover = F.avg_pool2d(((layer == k) | (layer == k + 1)).to(source.real.dtype), scale)
        field = field + (source - field) * cover
    return carry(field, optics, scale, -centres[-1])


def encode(amplitude: Tensor, depth: Tensor, told: Tensor, scale: int) -> Tensor:
    """amplitude [N, 3, H, W], depth [N, H, W], told [N, CONDITIONS] -> what nets know of a scene, [N, maps, h, w]."""
    centred = depth[:, None] - 0.5
    x = F.pixel_unshuffle(torch.cat((amplitude - 0.4, 2 * centred, centred * blur_scale(told)), dim=1), scale)
    return torch.cat((x, constant_maps(told, x)), dim=1)


def drift_phase(centred: Tensor, logs: Tensor, optics: OpticsConfig, gates: Tensor | float = 0.0) -> Tensor:
    """The phase [..., 3, h, w] that makes light drift from bright to dark where it is out of focus:
    (520 nm / λ) · Σ_j (g_j · tanh(4·(½ − D)) + gate_j) · L_j, from D − ½ [..., 1, h, w], blurs of log(I + 0.03) + 1.66
    and gates [..., len(SIGMAS_PX), 3, h, w]."""
    gains = centred.new_tensor(PRIOR_GAINS)[:, None, None, None]
    drift = gains * torch.tanh(-4 * centred).unsqueeze(-4) + gates
    colours = centred.new_tensor([REFERENCE_NM / nm for nm in optics.wavelengths_nm])
    return colours[:, None, None] * (drift * logs).sum(dim=-4)


class LayeredNetwork(FieldNetwork):
    """Net 1 (`surface`) gives each point of the network's grid and each colour a correction of amplitude, a phase, and
    gates of three blurs; `depth_layers` are composed far to near with occlusion and carried to the SLM plane; net 2
    (`correction`) sees that field and adds a residual to it.

    With `transport_prior` the phase starts where light flows from bright to dark away from focus, as a wider pupil
    makes it: φ ∝ tanh(4·(½ − D)) · G_σ(log(I + 0.03)), from the transport of intensity I·∇φ ∝ −∇I.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.scale = 2 if config.grid == "half-band" else 1
        maps = 5 * self.scale**2 + CONDITIONS
        prior, blurs = 3 * config.transport_prior, len(SIGMAS_PX)
        self.surface = first_net(config, maps + prior, 3 * (2 + blurs * (1 + config.transport_prior)))
        self.correction = second_net(config, OUTPUT_CHANNELS + maps)

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """`trace`, where given, receives what each stage puts out: both nets' `encoded`, `layer_{i}` and `offsets_{i}`
        under their names and a dot, the light of the surfaces under `source`, the carried field under `carried`."""
        told = self.told(pupil_mm)
        maps = encode(amplitude, depth, told, self.scale)
        light = self.mean(amplitude)
        blurs = blurred(torch.cat((light, torch.log(light.square() + LOG_FLOOR)), dim=1), self.sigmas)
        soft, logs = blurs[:, :, :3], blurs[:, :, 3:] + LOG_OFFSET
        seen = torch.cat((maps, logs[:, 1]), dim=1) if self.config.transport_prior else maps
        out = run_traced("surface", self.surface, seen, told, trace)
        source = self.surface_light(out, light, self.mean(depth[:, None] - 0.5), soft, logs)
        field = compose(source, depth, self.optics, self.config.depth_layers, self.scale)
        if trace is not None:
            trace |= {"source": source, "carried": field}
        seen = torch.cat((field.real, field.imag, maps), dim=1)
        residual = run_traced("correction", self.correction, seen, told, trace)
        field = corrected(field, residual)
        return field if self.scale == 2 else stop_half_band(field)

    @property
    def sigmas(self) -> tuple[float, ...]:
        return tuple(sigma / self.scale for sigma in SIGMAS_PX)

    def mean(self, x: Tensor) -> Tensor:
        """Onto the network's grid."""
        return F.avg_pool2d(x, self.scale)

    def surface_light(self, out: Tensor, light: Tensor, centred: Tensor, soft: Tensor, logs: Tensor) -> Tensor:
        """What each surface point sends out, complex [N, 3, h, w], from net 1's output, amplitude [N, 3, h, w],
        D − ½ [N, 1, h, w], and the blurs of amplitude and log intensity [N, len(SIGMAS_PX), 3, h, w]."""
        count = len(SIGMAS_PX)
        out = out.unflatten(1, (-1, 3))
        correction, phase, gates = out[:, 0], out[:, 1], out[:, 2:]
        strength = light + 0.5 * correction + (gates[:, :count] * (soft - light[:, None])).sum(dim=1)
        if self.config.transport_prior:
            phase = phase + drift_phase(centred, logs, self.optics, gates[:, count:])
        return torch.complex(strength * torch.cos(phase), strength * torch.sin(phase))
