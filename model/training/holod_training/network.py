"""The parts of every network, and the `direct` one: (amplitude, depth, pupil) to the complex field at the SLM plane."""

from __future__ import annotations

import math
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import NetworkConfig, OpticsConfig

TAPS = 9
OUTPUT_CHANNELS = 6
# Of a correcting net's output, in the field.
CORRECTION_SHARE = 0.3
# What a network is told of a bench and a pupil: `Conditions`.
CONDITIONS = 2
REFERENCE_BLUR_PX = 40.0
REFERENCE_FRESNEL_PX2 = 40.0


def conditions(config: NetworkConfig, optics: OpticsConfig, pupil_mm: Tensor) -> Tensor:
    """What networks are told of a bench and pupils [N], [N, CONDITIONS]: log2 of the blur over the depth volume in
    panel pixels, of 40; and log2 of λ·(f/p)²·V, the mean of three colours, of 40. Both within what was trained."""

    def told(value: Tensor, trained: tuple[float, float], reference: float) -> Tensor:
        return torch.log2(value.clamp(*trained) / reference)

    fresnel_px2 = sum(optics.volume_fresnel_px2) / len(optics.volume_fresnel_px2)
    blur = told(pupil_mm * optics.volume_blur_px(1.0), config.trained.volume_blur_px, REFERENCE_BLUR_PX)
    fresnel = torch.full_like(pupil_mm, fresnel_px2)
    return torch.stack((blur, told(fresnel, config.trained.volume_fresnel_px2, REFERENCE_FRESNEL_PX2)), dim=1)


def blur_scale(told: Tensor) -> Tensor:
    """What D − ½ is multiplied by in the maps that networks are told, [N, 1, 1, 1]: by 3 at 40 px of blur, by 2 more
    for each doubling. Near the pupil in millimetres on the default bench."""
    return (3 + 2 * told[:, 0])[:, None, None, None]


def constant_maps(told: Tensor, like: Tensor) -> Tensor:
    """`conditions` as maps [N, CONDITIONS, h, w] of the size of `like` [N, C, h, w]."""
    return told[:, :, None, None].expand(-1, -1, *like.shape[2:])


def gather_conv3x3(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A deformable 3x3 convolution out of `grid_sample`: on a CPU its backward is far cheaper than torchvision's.

    x [N, C, H, W]; offsets [N, 18, H, W], channel 2k the dy and 2k + 1 the dx of tap k, row-major over the kernel,
    in pixels; weight [O, C, 3, 3]; zero outside the picture.
    """
    n, channels, height, width = x.shape
    taps = torch.arange(TAPS, device=x.device)
    rows = torch.arange(height, device=x.device, dtype=x.dtype)
    columns = torch.arange(width, device=x.device, dtype=x.dtype)
    delta = offsets.view(n, TAPS, 2, height, width)
    y = delta[:, :, 0] + ((taps // 3 - 1).to(x.dtype)[:, None, None] + rows[:, None])
    x_position = delta[:, :, 1] + ((taps % 3 - 1).to(x.dtype)[:, None, None] + columns)
    # grid_sample with align_corners=False reads position p at ((p + 1) * size - 1) / 2.
    grid = torch.stack(((2 * x_position + 1) / width - 1, (2 * y + 1) / height - 1), dim=-1)
    sampled = F.grid_sample(
        x, grid.view(n, TAPS * height, width, 2), mode="bilinear", padding_mode="zeros", align_corners=False
    )
    sampled = sampled.view(n, channels * TAPS, height * width)
    return (weight.flatten(1) @ sampled + bias[:, None]).view(n, -1, height, width)


def deformable_conv3x3(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The same layer on whichever implementation is fast where `x` lives, in the weights' precision: positions in
    bf16 would be off by half a pixel."""
    x, offsets = x.to(weight.dtype), offsets.to(weight.dtype)
    with torch.autocast("cuda" if x.is_cuda else "cpu", enabled=False):
        if x.is_cuda:
            from torchvision.ops import deform_conv2d

            return deform_conv2d(x, offsets, weight, bias, padding=1)
        return gather_conv3x3(x, offsets, weight, bias)


class ScaledConvolution(nn.Module):
    """A 3x3 convolution whose parameters are W0 ⊙ (1 + γ) and b0 + β, its own for each picture of a batch."""

    def __init__(self, channels: int, outputs: int, bound: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, channels, 3, 3).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
        """x [N, C, H, W], gamma [N, O, C], beta [N, O] -> [N, O, H, W]."""
        n, channels, height, width = x.shape
        weight = self.weight * (1 + gamma)[..., None, None]
        bias = self.bias + beta
        out = F.conv2d(
            x.reshape(1, n * channels, height, width),
            weight.flatten(0, 1),
            bias.flatten(),
            padding=1,
            groups=n,
        )
        return out.view(n, -1, height, width)


class Modulation(nn.ModuleList):
    """g_m: `conditions` to γ and β of a `ScaledConvolution`, a small MLP."""

    def __init__(self, channels: int, outputs: int, hidden: int, leaky_slope: float) -> None:
        first, second = nn.Linear(CONDITIONS, hidden), nn.Linear(hidden, hidden)
        last = nn.Linear(hidden, outputs * channels + outputs)
        # A weaker start leaves the conditioning on the pupil asleep.
        nn.init.normal_(last.weight, std=0.5 / math.sqrt(hidden))
        nn.init.zeros_(last.bias)
        super().__init__([first, second, last])
        self.outputs = outputs
        self.leaky_slope = leaky_slope

    def forward(self, told: Tensor) -> tuple[Tensor, Tensor]:
        """told [N, CONDITIONS] -> gamma [N, O, C], beta [N, O]."""
        h = F.leaky_relu(self[0](told), self.leaky_slope)
        h = F.leaky_relu(self[1](h), self.leaky_slope)
        h = self[2](h)
        return h[:, : -self.outputs].view(len(h), self.outputs, -1), h[:, -self.outputs :]


class DeformableLayer(nn.Module):
    """A 3x3 convolution that reads its taps where `offsets` says."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(9 * channels)
        self.weight = nn.Parameter(torch.empty(channels, channels, 3, 3).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(channels).uniform_(-bound, bound))
        self.offset = self.offset_predictor(channels)

    def offset_predictor(self, channels: int) -> nn.Module:
        predictor = nn.Conv2d(channels, 2 * TAPS, 3, padding=1)
        with torch.no_grad():
            for parameter, share in zip(predictor.parameters(), (0.5, 0.0), strict=True):
                parameter.mul_(share)
        return predictor

    def offsets(self, x: Tensor, told: Tensor) -> Tensor:
        return self.offset(x)

    def forward(self, x: Tensor, told: Tensor) -> Tensor:
        return deformable_conv3x3(x, self.offsets(x, told), self.weight, self.bias)


class AdjustableLayer(DeformableLayer):
    """The adjustable deformable layer (ADC), the paper's Algorithm 1: the pupil modulates g_o, which gives offsets."""

    def __init__(self, channels: int, hidden: int, leaky_slope: float) -> None:
        super().__init__(channels)
        self.modulation = Modulation(channels, 2 * TAPS, hidden, leaky_slope)

    def offset_predictor(self, channels: int) -> nn.Module:
        return ScaledConvolution(channels, 2 * TAPS, 0.5 / math.sqrt(9 * channels))

    def offsets(self, x: Tensor, told: Tensor) -> Tensor:
        return self.offset(x, *self.modulation(told))


class ModulatedLayer(nn.Module):
    """A plain 3x3 convolution that the pupil modulates: no offsets."""

    def __init__(self, channels: int, hidden: int, leaky_slope: float) -> None:
        super().__init__()
        self.kernel = ScaledConvolution(channels, channels, 1 / math.sqrt(9 * channels))
        self.modulation = Modulation(channels, channels, hidden, leaky_slope)

    def forward(self, x: Tensor, told: Tensor) -> Tensor:
        return self.kernel(x, *self.modulation(told))


class Trunk(nn.ModuleList):
    """Layers 0 .. L-1 of 3x3; the body in residual pairs h = act(½·y + skip), conditioned layers in place of some."""

    def __init__(
        self,
        config: NetworkConfig,
        inputs: int,
        outputs: int,
        layers: int,
        dilations: tuple[int, ...],
        adjustable_layers: tuple[int, ...],
        last_share: float,
    ) -> None:
        channels = config.channels
        dilations = dilations or (1,) * layers

        def conditioned() -> nn.Module:
            if config.conditioning == "deformable":
                return DeformableLayer(channels)
            kind = AdjustableLayer if config.conditioning == "adjustable" else ModulatedLayer
            return kind(channels, config.modulation_hidden, config.leaky_slope)

        def plain(index: int, of: int, to: int) -> nn.Module:
            return nn.Conv2d(of, to, 3, padding=dilations[index], dilation=dilations[index])

        first = plain(0, inputs, channels)
        body = [
            conditioned() if index in adjustable_layers else plain(index, channels, channels)
            for index in range(1, layers - 1)
        ]
        last = plain(layers - 1, channels, outputs)
        with torch.no_grad():
            for parameter, share in zip(last.parameters(), (last_share, 0.0), strict=True):
                parameter.mul_(share)
        super().__init__([first, *body, last])
        self.leaky_slope = config.leaky_slope

    def forward(self, x: Tensor, told: Tensor, trace: dict[str, Tensor] | None = None) -> Tensor:
        """x [N, inputs, h, w], told [N, CONDITIONS] -> [N, outputs, h, w].

        `trace`, where given, receives every layer's output map (after its activation) under `layer_{i}` and a
        deformable layer's offsets under `offsets_{i}`.
        """

        def convolve(index: int, x: Tensor) -> Tensor:
            layer = self[index]
            if isinstance(layer, nn.Conv2d):
                return layer(x)
            if trace is not None and isinstance(layer, DeformableLayer):
                trace[f"offsets_{index}"] = layer.offsets(x, told)
            return layer(x, told)

        def activate(index: int, x: Tensor) -> Tensor:
            x = F.leaky_relu(x, self.leaky_slope)
            if trace is not None:
                trace[f"layer_{index}"] = x
            return x

        h = activate(0, convolve(0, x))
        last = len(self) - 1
        for first in range(1, last, 2):
            y = activate(first, convolve(first, h))
            h = activate(first + 1, 0.5 * convolve(first + 1, y) + h)
        out = convolve(last, h)
        if trace is not None:
            trace[f"layer_{last}"] = out
        return out


def run_traced(name: str, trunk: Trunk, x: Tensor, told: Tensor, trace: dict[str, Tensor] | None) -> Tensor:
    """The trunk's output in the precision of `x`; `trace`, where given, receives its input and layers as `NAME.…`."""
    inner: dict[str, Tensor] | None = None if trace is None else {"encoded": x}
    out: Tensor = trunk(x, told, inner)
    if trace is not None and inner is not None:
        trace.update({f"{name}.{key}": value for key, value in inner.items()})
    return out.to(x.dtype)


def first_net(config: NetworkConfig, inputs: int, outputs: int) -> Trunk:
    """Of a network with two: what it gives is carried by physics to the SLM plane."""
    return Trunk(
        config,
        inputs=inputs,
        outputs=outputs,
        layers=config.layers,
        dilations=config.dilations,
        adjustable_layers=config.adjustable_layers,
        last_share=0.15,
    )


def second_net(config: NetworkConfig, inputs: int) -> Trunk:
    """Of a network with two: it sees the field at the SLM plane and gives the residual for `corrected`."""
    return Trunk(
        config,
        inputs=inputs,
        outputs=OUTPUT_CHANNELS,
        layers=config.correction_layers,
        dilations=config.correction_dilations,
        adjustable_layers=(),
        last_share=0.1,
    )


def corrected(field: Tensor, residual: Tensor) -> Tensor:
    """A field [N, 3, h, w] and its `second_net`'s residual [N, OUTPUT_CHANNELS, h, w]."""
    real, imaginary = residual.split(3, dim=1)
    return field + CORRECTION_SHARE * torch.complex(real.contiguous(), imaginary.contiguous())


class FieldNetwork(nn.Module):
    """What all variants are: (amplitude, depth, pupil_mm) to complex fields on the grid of `config`, for the bench that
    `on` chose: the default one before it is called.

    amplitude [N, 3, H, W] (focal-stack: [N, planes, 3, H, W]), depth [N, H, W] 0 far .. 1 near, pupil_mm [N] ->
    [N, 3, h, w], or [N, frames, 3, h, w] for time-multiplexed frames. half-band: h = H/2, samples at block centres.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.optics = OpticsConfig()

    def on(self, optics: OpticsConfig) -> Self:
        """The same network, which from now on makes fields for this bench."""
        self.optics = optics
        return self

    def told(self, pupil_mm: Tensor) -> Tensor:
        return conditions(self.config, self.optics, pupil_mm)


class DirectNetwork(FieldNetwork):
    """The field at the SLM plane as a residual to the amplitude."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        spatial = 4 + config.pupil_inputs + config.blur_input
        self.layers = Trunk(
            config,
            inputs=spatial * (4 if config.grid == "half-band" else 1) + CONDITIONS * config.pupil_inputs,
            outputs=OUTPUT_CHANNELS * config.frames,
            layers=config.layers,
            dilations=config.dilations,
            adjustable_layers=config.adjustable_layers,
            last_share=0.1,
        )

    def encode(self, amplitude: Tensor, depth: Tensor, told: Tensor) -> Tensor:
        """amplitude [N, 3, H, W], depth [N, H, W], told [N, CONDITIONS] -> the first layer's input."""
        centred = depth[:, None] - 0.5
        blur = blur_scale(told)
        maps = [amplitude, centred]
        if self.config.pupil_inputs:
            maps.append(blur * centred)
        if self.config.blur_input:
            # ∫|D − t| dt over all focuses t of the volume.
            maps.append(blur * (centred.square() + 0.25))
        x = torch.cat(maps, dim=1)
        if self.config.grid == "half-band":
            x = F.pixel_unshuffle(x, 2)
        return torch.cat((x, constant_maps(told, x)), dim=1) if self.config.pupil_inputs else x

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """`trace`, where given, receives the first layer's input under `encoded` and what `Trunk` puts there."""
        told = self.told(pupil_mm)
        x = self.encode(amplitude, depth, told)
        if trace is not None:
            trace["encoded"] = x
        out = self.layers(x, told, trace).to(amplitude.dtype)
        base = F.avg_pool2d(amplitude, 2) if self.config.grid == "half-band" else amplitude
        frames = [
            torch.complex(base + part[:, :3], part[:, 3:].contiguous()) for part in out.split(OUTPUT_CHANNELS, dim=1)
        ]
        return frames[0] if len(frames) == 1 else torch.stack(frames, dim=1)
