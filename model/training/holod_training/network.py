"""The parts of every network, and the `direct` one: (amplitude, depth, pupil) to the complex field at the SLM plane."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import NetworkConfig

TAPS = 9
OUTPUT_CHANNELS = 6
# Of a correcting net's output, in the field.
CORRECTION_SHARE = 0.3


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
    """g_m: the pupil to γ and β of a `ScaledConvolution`, a small MLP."""

    def __init__(self, channels: int, outputs: int, hidden: int, leaky_slope: float) -> None:
        first, second = nn.Linear(1, hidden), nn.Linear(hidden, hidden)
        last = nn.Linear(hidden, outputs * channels + outputs)
        # A weaker start leaves the conditioning on the pupil asleep.
        nn.init.normal_(last.weight, std=0.5 / math.sqrt(hidden))
        nn.init.zeros_(last.bias)
        super().__init__([first, second, last])
        self.outputs = outputs
        self.leaky_slope = leaky_slope

    def forward(self, pupil_mm: Tensor) -> tuple[Tensor, Tensor]:
        """pupil_mm [N] -> gamma [N, O, C], beta [N, O]."""
        h = ((pupil_mm - 3) / 2)[:, None]
        h = F.leaky_relu(self[0](h), self.leaky_slope)
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

    def offsets(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return self.offset(x)

    def forward(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return deformable_conv3x3(x, self.offsets(x, pupil_mm), self.weight, self.bias)


class AdjustableLayer(DeformableLayer):
    """The adjustable deformable layer (ADC), the paper's Algorithm 1: the pupil modulates g_o, which gives offsets."""

    def __init__(self, channels: int, hidden: int, leaky_slope: float) -> None:
        super().__init__(channels)
        self.modulation = Modulation(channels, 2 * TAPS, hidden, leaky_slope)

    def offset_predictor(self, channels: int) -> nn.Module:
        return ScaledConvolution(channels, 2 * TAPS, 0.5 / math.sqrt(9 * channels))

    def offsets(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return self.offset(x, *self.modulation(pupil_mm))


class ModulatedLayer(nn.Module):
    """A plain 3x3 convolution that the pupil modulates: no offsets."""

    def __init__(self, channels: int, hidden: int, leaky_slope: float) -> None:
        super().__init__()
        self.kernel = ScaledConvolution(channels, channels, 1 / math.sqrt(9 * channels))
        self.modulation = Modulation(channels, channels, hidden, leaky_slope)

    def forward(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return self.kernel(x, *self.modulation(pupil_mm))


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

    def forward(self, x: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None) -> Tensor:
        """x [N, inputs, h, w], pupil_mm [N] -> [N, outputs, h, w].

        `trace`, where given, receives every layer's output map (after its activation) under `layer_{i}` and a
        deformable layer's offsets under `offsets_{i}`.
        """

        def convolve(index: int, x: Tensor) -> Tensor:
            layer = self[index]
            if isinstance(layer, nn.Conv2d):
                return layer(x)
            if trace is not None and isinstance(layer, DeformableLayer):
                trace[f"offsets_{index}"] = layer.offsets(x, pupil_mm)
            return layer(x, pupil_mm)

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


def run_traced(name: str, trunk: Trunk, x: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None) -> Tensor:
    """The trunk's output in the precision of `x`; `trace`, where given, receives its input and layers as `NAME.…`."""
    inner: dict[str, Tensor] | None = None if trace is None else {"encoded": x}
    out: Tensor = trunk(x, pupil_mm, inner)
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
    """What all variants are: (amplitude, depth, pupil_mm) to complex fields on the grid of `config`.

    amplitude [N, 3, H, W] (focal-stack: [N, planes, 3, H, W]), depth [N, H, W] 0 far .. 1 near, pupil_mm [N] ->
    [N, 3, h, w], or [N, frames, 3, h, w] for time-multiplexed frames. half-band: h = H/2, samples at block centres.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config


class DirectNetwork(FieldNetwork):
    """The field at the SLM plane as a residual to the amplitude."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        spatial = 4 + config.pupil_inputs + config.blur_input
        self.layers = Trunk(
            config,
            inputs=spatial * (4 if config.grid == "half-band" else 1) + config.pupil_inputs,
            outputs=OUTPUT_CHANNELS * config.frames,
            layers=config.layers,
            dilations=config.dilations,
            adjustable_layers=config.adjustable_layers,
            last_share=0.1,
        )

    def encode(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        """amplitude [N, 3, H, W], depth [N, H, W], pupil_mm [N] -> the first layer's input."""
        s = pupil_mm[:, None, None, None]
        centred = depth[:, None] - 0.5
        maps = [amplitude, centred]
        if self.config.pupil_inputs:
            maps.append(s * centred)
        if self.config.blur_input:
            # s·∫|D − t| dt over all focuses t of the volume.
            maps.append(s * (centred.square() + 0.25))
        x = torch.cat(maps, dim=1)
        if self.config.grid == "half-band":
            x = F.pixel_unshuffle(x, 2)
        if not self.config.pupil_inputs:
            return x
        constant = ((s - 3) / 2).expand(-1, 1, *x.shape[2:])
        return torch.cat((x, constant), dim=1)

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """`trace`, where given, receives the first layer's input under `encoded` and what `Trunk` puts there."""
        x = self.encode(amplitude, depth, pupil_mm)
        if trace is not None:
            trace["encoded"] = x
        out = self.layers(x, pupil_mm, trace).to(amplitude.dtype)
        base = F.avg_pool2d(amplitude, 2) if self.config.grid == "half-band" else amplitude
        frames = [
            torch.complex(base + part[:, :3], part[:, 3:].contiguous()) for part in out.split(OUTPUT_CHANNELS, dim=1)
        ]
        return frames[0] if len(frames) == 1 else torch.stack(frames, dim=1)
