"""Every network that can be trained, each a config of one set of parts."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from holod_training.config import ConfigError, NetworkConfig
from holod_training.expected_stack import ExpectedStackNetwork
from holod_training.focal_stack import FedBackFocalStackNetwork, FocalStackNetwork, focal_amplitudes
from holod_training.layered import LayeredNetwork
from holod_training.network import DirectNetwork, FieldNetwork
from holod_training.shards import Stack

DEFAULT_VARIANT = "half-band-14"
ABLATION_PUPILS_MM = (2.0, 3.0, 4.0)

_HALF_BAND = NetworkConfig()
_LAYERED = NetworkConfig(
    architecture="layered",
    grid="full",
    layers=12,
    channels=24,
    adjustable_layers=(5,),
    dilations=(1, 1, 2, 4, 8, 1, 8, 4, 2, 1, 1, 1),
    correction_layers=6,
    correction_dilations=(1, 1, 2, 4, 2, 1),
)
_HALF_BAND_LAYERED = NetworkConfig(architecture="layered", layers=8, adjustable_layers=(4,))
_EXPECTED = replace(_HALF_BAND_LAYERED, architecture="expected-stack")
_EXPECTED_SMALL = replace(_EXPECTED, layers=4, channels=24, adjustable_layers=(2,), correction_layers=6, depth_layers=6)


def _direct(layers: int) -> NetworkConfig:
    return NetworkConfig(grid="full", layers=layers, channels=24, adjustable_layers=(layers // 2,))


VARIANTS: dict[str, NetworkConfig] = {
    "direct-26": _direct(26),
    "direct-20": _direct(20),
    "direct-14": _direct(14),
    DEFAULT_VARIANT: _HALF_BAND,
    "half-band-8": replace(_HALF_BAND, layers=8, channels=24, adjustable_layers=(4,)),
    "half-band-dilated": replace(
        _HALF_BAND, layers=10, adjustable_layers=(5,), dilations=(1, 1, 2, 4, 8, 1, 8, 4, 2, 1)
    ),
    "half-band-3-adc": replace(_HALF_BAND, adjustable_layers=(3, 7, 11)),
    "half-band-blur-input": replace(_HALF_BAND, blur_input=True),
    "two-frames": replace(_HALF_BAND, frames=2),
    "half-band-layered": _HALF_BAND_LAYERED,
    "half-band-layered-no-prior": replace(_HALF_BAND_LAYERED, transport_prior=False),
    "half-band-layered-small": replace(
        _HALF_BAND_LAYERED, layers=4, channels=24, adjustable_layers=(2,), correction_layers=6
    ),
    "half-band-layered-small-no-prior": replace(
        _HALF_BAND_LAYERED, layers=4, channels=24, adjustable_layers=(2,), correction_layers=6, transport_prior=False
    ),
    "layered-4": replace(_LAYERED, depth_layers=4),
    "layered-8": _LAYERED,
    "layered-12": replace(_LAYERED, depth_layers=12),
    "layered-4-no-prior": replace(_LAYERED, depth_layers=4, transport_prior=False),
    "layered-8-no-prior": replace(_LAYERED, transport_prior=False),
    "layered-12-no-prior": replace(_LAYERED, depth_layers=12, transport_prior=False),
    "expected-stack": _EXPECTED,
    "expected-stack-small": _EXPECTED_SMALL,
    "refined-stack": replace(_EXPECTED, refined_stack=True),
    "refined-stack-small": replace(_EXPECTED_SMALL, refined_stack=True),
    "refined-stack-fast": replace(
        _EXPECTED_SMALL, channels=16, adjustable_layers=(), correction_layers=4, depth_layers=4, refined_stack=True
    ),
    "focal-stack": replace(_HALF_BAND, architecture="focal-stack"),
    "focal-stack-feedback": replace(_HALF_BAND_LAYERED, architecture="focal-stack", feedback=True),
    "ablation-three-plain": replace(
        _HALF_BAND, adjustable_layers=(), pupil_inputs=False, specialists_mm=ABLATION_PUPILS_MM
    ),
    "ablation-three-deformable": replace(
        _HALF_BAND, conditioning="deformable", pupil_inputs=False, specialists_mm=ABLATION_PUPILS_MM
    ),
    "deh-like": replace(_HALF_BAND, adjustable_layers=(), pupil_inputs=False, specialists_mm=(3.0,)),
    "ablation-modulated": replace(_HALF_BAND, conditioning="modulated"),
    "ablation-no-pupil": replace(_HALF_BAND, adjustable_layers=(), pupil_inputs=False),
}
_FAMILIES = {
    "direct": DirectNetwork,
    "layered": LayeredNetwork,
    "expected-stack": ExpectedStackNetwork,
    "focal-stack": FocalStackNetwork,
}


def variant(name: str) -> NetworkConfig:
    """Raises ConfigError for a name that the table does not have."""
    if name not in VARIANTS:
        raise ConfigError(f"variant: found {name!r}, expected one of {', '.join(VARIANTS)}")
    return VARIANTS[name]


def build_network(config: NetworkConfig) -> FieldNetwork:
    """A network with new weights from torch's generator."""
    if config.specialists_mm:
        return SpecialistNetwork(config)
    return FedBackFocalStackNetwork(config) if config.feedback else _FAMILIES[config.architecture](config)


def network_amplitude(config: NetworkConfig, stack: Stack) -> Tensor:
    """The first input of a network for one stack, without the batch axis. Raises ConfigError."""
    return focal_amplitudes(config, stack) if config.architecture == "focal-stack" else stack.amplitude


class SpecialistNetwork(FieldNetwork):
    """One whole network for each pupil of `specialists_mm`; the nearest serves, and none is told its pupil. Of one
    alone: as diffraction-engineered holography is trained (Yang et al. 2022), for one aperture."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        single = replace(config, specialists_mm=())
        self.networks = nn.ModuleList([build_network(single) for _ in config.specialists_mm])

    def forward(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        known = pupil_mm.new_tensor(self.config.specialists_mm)
        nearest = (pupil_mm[:, None] - known).abs().argmin(dim=1).tolist()
        fields = [
            self.networks[index](amplitude[n : n + 1], depth[n : n + 1], pupil_mm[n : n + 1])
            for n, index in enumerate(nearest)
        ]
        return torch.cat(fields)
