"""The `layered` network: what the objects' surfaces should send out is learned, physics carries it."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.network import FieldNetwork, Trunk
from holod_training.optics import frequencies, half_band_mask, transfer

LOG_FLOOR = 0.03
LOG_OFFSET = 1.66
PHASE_SIGMAS_PX = (1.0, 2.5, 6.0)
PRIOR_GAINS = (-0.5, -1.0, 0.0)
AMPLITUDE_SIGMAS_PX = (2.0, 5.0, 10.0)
MIDDLE_DILATIONS = (1, 1, 2, 4, 2, 1)
REFERENCE_NM = 520.0


@lru_cache(maxsize=32)
def carrier(
    optics: OpticsConfig, height: int, width: int, distance_m: float, dtype: torch.dtype, device: str, stop: bool
) -> Tensor:
    """The transfer function [3, H, W] of one distance on the panel's grid, with the 4f stop where `stop` is set."""
    fy, fx = (frequencies(size, optics.pitch_m, device) for size in (height, width))
    kernel = transfer(optics, fx, fy, [distance_m])[0]
    return (kernel * half_band_mask(height, width, device) if stop else kernel).to(dtype)


@lru_cache(maxsize=8)
def gaussians(height: int, width: int, sigmas_px: tuple[float, ...], dtype: torch.dtype, device: str) -> Tensor:
    """Spectra of circular Gaussian blurs, [len(sigmas), 1, H, W // 2 + 1]: exp(−2π²σ²f²)."""
    fy = frequencies(height, 1.0, device)[:, None]
    fx = torch.fft.rfftfreq(width, dtype=torch.float64, device=device)
    sigma = torch.tensor(sigmas_px, dtype=torch.float64, device=device)[:, None, None]
    return torch.exp(-2 * math.pi**2 * sigma**2 * (fx**2 + fy**2))[:, None].to(dtype)


def blurred(x: Tensor, sigmas_px: tuple[float, ...]) -> Tensor:
    """x [N, 3, H, W] -> [N, len(sigmas), 3, H, W]."""
    height, width = x.shape[-2:]
    kernels = gaussians(height, width, sigmas_px, x.dtype, str(x.device))
    return torch.fft.irfft2(torch.fft.rfft2(x)[:, None] * kernels, s=(height, width))


class LayeredNetwork(FieldNetwork):
    """Net 1 (`surface`) gives each pixel and colour a phase, a correction of amplitude, and gates of three blurs;
    `depth_layers` are composed far to near with occlusion; net 2 (`middle`) adds a residual in the volume's middle.

    With `transport_prior` the phase starts where light flows from bright to dark away from focus, as a wider pupil
    makes it: φ ∝ tanh(4·(½ − D)) · G_σ(log(I + 0.03)), from the transport of intensity I·∇φ ∝ −∇I.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        phases, amplitudes = len(PHASE_SIGMAS_PX), len(AMPLITUDE_SIGMAS_PX)
        self.surface = Trunk(
            config,
            inputs=9 if config.transport_prior else 6,
            outputs=3 * (2 + amplitudes + (phases if config.transport_prior else 0)),
            layers=config.layers,
            dilations=config.dilations,
            adjustable_layers=config.adjustable_layers,
            last_share=0.15,
        )
        self.middle = Trunk(
            config,
            inputs=12,
            outputs=6,
            layers=len(MIDDLE_DILATIONS),
            dilations=MIDDLE_DILATIONS,
            adjustable_layers=(),
            last_share=0.1,
        )

    def forward(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        optics = self.config.optics
        s = pupil_mm[:, None, None, None]
        centred = depth[:, None] - 0.5
        conditions = torch.cat((2 * centred, centred * s, ((s - 2.5) / 2).expand_as(centred)), dim=1)
        source = self.surface_light(amplitude, centred, conditions, pupil_mm)
        field, reached_m = self.compose(source, depth)
        middle_m = optics.distance_m(optics.dioptres(0.5))
        field = self.carry(field, middle_m - reached_m)
        inputs = torch.cat((field.real, field.imag, amplitude, conditions), dim=1)
        residual = 0.3 * self.middle(inputs, pupil_mm).to(amplitude.dtype)
        field = field + torch.complex(residual[:, :3].contiguous(), residual[:, 3:].contiguous())
        return self.carry(field, -middle_m, stop=True)

    def surface_light(self, amplitude: Tensor, centred: Tensor, conditions: Tensor, pupil_mm: Tensor) -> Tensor:
        """What each surface point sends out, complex [N, 3, H, W]; `centred` is D − ½, [N, 1, H, W]."""
        n, _, height, width = amplitude.shape
        inputs = [amplitude - 0.4, conditions]
        if self.config.transport_prior:
            logs = blurred(torch.log(amplitude.square() + LOG_FLOOR), PHASE_SIGMAS_PX) + LOG_OFFSET
            inputs.append(logs[:, 1])
        out = self.surface(torch.cat(inputs, dim=1), pupil_mm).to(amplitude.dtype)
        out = out.view(n, -1, 3, height, width)
        correction, phase, gates = out[:, 0], out[:, 1], out[:, 2:]
        blurs = blurred(amplitude, AMPLITUDE_SIGMAS_PX) - amplitude[:, None]
        strength = amplitude + 0.5 * correction + (gates[:, : len(AMPLITUDE_SIGMAS_PX)] * blurs).sum(dim=1)
        if self.config.transport_prior:
            gains = amplitude.new_tensor(PRIOR_GAINS)[:, None, None, None]
            drift = gains * torch.tanh(-4 * centred)[:, None] + gates[:, len(AMPLITUDE_SIGMAS_PX) :]
            colours = amplitude.new_tensor([REFERENCE_NM / nm for nm in self.config.optics.wavelengths_nm])
            phase = phase + colours[:, None, None] * (drift * logs).sum(dim=1)
        return torch.complex(strength * torch.cos(phase), strength * torch.sin(phase))

    def compose(self, source: Tensor, depth: Tensor) -> tuple[Tensor, float]:
        """The field behind the nearest layer and its u in metres: f ← f·(1 − m) + O·m, by ASM between layers.

        m covers a layer and its next nearer one: slanted surfaces show no seams.
        """
        optics, count = self.config.optics, self.config.depth_layers
        centres = [optics.distance_m(optics.dioptres((k + 0.5) / count)) for k in range(count)]
        layer = (depth * count).long().clamp(0, count - 1)[:, None]
        field = torch.zeros_like(source)
        for k in range(count):
            if k:
                field = self.carry(field, centres[1] - centres[0])
            field = torch.where((layer == k) | (layer == k + 1), source, field)
        return field, centres[-1]

    def carry(self, field: Tensor, distance_m: float, stop: bool = False) -> Tensor:
        height, width = field.shape[-2:]
        kernel = carrier(self.config.optics, height, width, distance_m, field.dtype, str(field.device), stop)
        return torch.fft.ifft2(torch.fft.fft2(field) * kernel)
