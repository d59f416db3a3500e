"""The `direct` network: (amplitude, depth, pupil) to the complex field at the SLM plane."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.config import NetworkConfig

TAPS = 9
OUTPUT_CHANNELS = 6


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
    """The same layer on whichever implementation is fast where `x` lives."""
    if x.is_cuda:
        from torchvision.ops import deform_conv2d

        return deform_conv2d(x, offsets, weight, bias, padding=1)
    return gather_conv3x3(x, offsets, weight, bias)


class OffsetPredictor(nn.Module):
    """g_o: a 3x3 convolution C -> 18 whose parameters are W0 ⊙ (1 + γ(s)) and b0 + β(s)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        outputs = 2 * TAPS
        bound = 0.5 / math.sqrt(9 * channels)
        self.weight = nn.Parameter(torch.empty(outputs, channels, 3, 3).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
        """x [N, C, H, W], gamma [N, 18, C], beta [N, 18] -> offsets [N, 18, H, W]."""
        n, channels, height, width = x.shape
        weight = self.weight * (1 + gamma)[..., None, None]
        bias = self.bias + beta
        offsets = F.conv2d(
            x.reshape(1, n * channels, height, width),
            weight.flatten(0, 1),
            bias.flatten(),
            padding=1,
            groups=n,
        )
        return offsets.view(n, -1, height, width)


class AdjustableLayer(nn.Module):
    """The adjustable deformable layer (ADC), the paper's Algorithm 1."""

    def __init__(self, channels: int, hidden: int, leaky_slope: float) -> None:
        super().__init__()
        bound = 1 / math.sqrt(9 * channels)
        self.weight = nn.Parameter(torch.empty(channels, channels, 3, 3).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(channels).uniform_(-bound, bound))
        self.offset = OffsetPredictor(channels)
        outputs = 2 * TAPS
        first, second = nn.Linear(1, hidden), nn.Linear(hidden, hidden)
        last = nn.Linear(hidden, outputs * channels + outputs)
        # A weaker start leaves the conditioning on the pupil asleep.
        nn.init.normal_(last.weight, std=0.5 / math.sqrt(hidden))
        nn.init.zeros_(last.bias)
        self.modulation = nn.ModuleList([first, second, last])
        self.leaky_slope = leaky_slope

    def modulate(self, pupil_mm: Tensor) -> tuple[Tensor, Tensor]:
        """pupil_mm [N] -> gamma [N, 18, C], beta [N, 18]."""
        h = ((pupil_mm - 3) / 2)[:, None]
        h = F.leaky_relu(self.modulation[0](h), self.leaky_slope)
        h = F.leaky_relu(self.modulation[1](h), self.leaky_slope)
        h = self.modulation[2](h)
        outputs = self.offset.bias.numel()
        return h[:, :-outputs].view(len(h), outputs, -1), h[:, -outputs:]

    def offsets(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return self.offset(x, *self.modulate(pupil_mm))

    def forward(self, x: Tensor, pupil_mm: Tensor) -> Tensor:
        return deformable_conv3x3(x, self.offsets(x, pupil_mm), self.weight, self.bias)


class DirectNetwork(nn.Module):
    """Layers 0 .. L-1; the body in residual pairs, with adjustable layers in place of some plain ones."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.channels
        layers: list[nn.Module] = [nn.Conv2d(21 if config.grid == "half-band" else 6, channels, 3, padding=1)]
        for index in range(1, config.layers - 1):
            if index in config.adjustable_layers:
                layers.append(AdjustableLayer(channels, config.modulation_hidden, config.leaky_slope))
            else:
                layers.append(nn.Conv2d(channels, channels, 3, padding=1))
        last = nn.Conv2d(channels, OUTPUT_CHANNELS, 3, padding=1)
        with torch.no_grad():
            for parameter, share in zip(last.parameters(), (0.1, 0.0), strict=True):
                parameter.mul_(share)
        self.layers = nn.ModuleList([*layers, last])

    def encode(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        """amplitude [N, 3, H, W], depth [N, H, W], pupil_mm [N] -> the first layer's input."""
        s = pupil_mm[:, None, None, None]
        centred = depth[:, None] - 0.5
        x = torch.cat((amplitude, centred, s * centred), dim=1)
        if self.config.grid == "half-band":
            x = F.pixel_unshuffle(x, 2)
        constant = ((s - 3) / 2).expand(-1, 1, *x.shape[2:])
        return torch.cat((x, constant), dim=1)

    def forward(
        self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor, trace: dict[str, Tensor] | None = None
    ) -> Tensor:
        """The field on the network's own grid, complex [N, 3, h, w]; half-band: h = H/2, samples at block centres.

        `trace`, where given, receives every layer's output map (after its activation) under `layer_{i}` and an
        adjustable layer's offsets under `offsets_{i}`.
        """
        x = self.encode(amplitude, depth, pupil_mm)
        if trace is not None:
            trace["encoded"] = x

        def convolve(index: int, x: Tensor) -> Tensor:
            layer = self.layers[index]
            if isinstance(layer, AdjustableLayer):
                if trace is not None:
                    trace[f"offsets_{index}"] = layer.offsets(x, pupil_mm)
                return layer(x, pupil_mm)
            return layer(x)

        def activate(index: int, x: Tensor) -> Tensor:
            x = F.leaky_relu(x, self.config.leaky_slope)
            if trace is not None:
                trace[f"layer_{index}"] = x
            return x

        h = activate(0, convolve(0, x))
        for first in range(1, self.config.layers - 1, 2):
            y = activate(first, convolve(first, h))
            h = activate(first + 1, 0.5 * convolve(first + 1, y) + h)
        last = self.config.layers - 1
        out = convolve(last, h)
        if trace is not None:
            trace[f"layer_{last}"] = out
        base = F.avg_pool2d(amplitude, 2) if self.config.grid == "half-band" else amplitude
        return torch.complex(base + out[:, :3], out[:, 3:].contiguous())
