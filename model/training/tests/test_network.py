import math

import pytest
import torch
import torch.nn.functional as F
from torchvision.ops import deform_conv2d

from holod_training.config import ConfigError, NetworkConfig, OpticsConfig, TrainedRange
from holod_training.network import AdjustableLayer, DirectNetwork, conditions, gather_conv3x3


def random_layer(dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(3)
    x = torch.randn(2, 5, 11, 14, generator=g, dtype=dtype)
    # Up to several pixels, so that taps leave the picture on every side.
    offsets = 4 * torch.randn(2, 18, 11, 14, generator=g, dtype=dtype)
    weight = torch.randn(7, 5, 3, 3, generator=g, dtype=dtype)
    bias = torch.randn(7, generator=g, dtype=dtype)
    return x, offsets, weight, bias


def test_gather_equals_torchvision_forward_and_backward() -> None:
    inputs = random_layer(torch.float64)
    results = []
    for layer in (gather_conv3x3, lambda *a: deform_conv2d(*a, padding=1)):
        leaves = [t.clone().requires_grad_() for t in inputs]
        out = layer(*leaves)
        out.square().sum().backward()
        results.append([out.detach(), *(leaf.grad for leaf in leaves)])
    for ours, oracle in zip(*results, strict=True):
        torch.testing.assert_close(ours, oracle, rtol=1e-9, atol=1e-9)


def test_gather_comparator_rejects_swapped_dy_dx() -> None:
    x, offsets, weight, bias = random_layer(torch.float64)
    swapped = offsets.view(2, 9, 2, 11, 14).flip(2).reshape_as(offsets)
    oracle = deform_conv2d(x, offsets, weight, bias, padding=1)
    with pytest.raises(AssertionError):
        torch.testing.assert_close(gather_conv3x3(x, swapped, weight, bias), oracle, rtol=1e-9, atol=1e-9)


def test_adjustable_layer_is_algorithm_1() -> None:
    torch.manual_seed(1)
    layer = AdjustableLayer(channels=6, hidden=5, leaky_slope=0.1).double()
    x = torch.randn(2, 6, 9, 10, dtype=torch.float64)
    told = torch.tensor([[-0.7, 0.2], [0.5, -1.0]], dtype=torch.float64)
    together = layer(x, told)
    for n in range(2):
        h = told[n]
        for index, linear in enumerate(layer.modulation):
            h = F.linear(h, linear.weight, linear.bias)
            h = F.leaky_relu(h, 0.1) if index < 2 else h
        gamma, beta = h[: 18 * 6].view(18, 6), h[18 * 6 :]
        weight = layer.offset.weight * (1 + gamma)[:, :, None, None]
        offsets = F.conv2d(x[n : n + 1], weight, layer.offset.bias + beta, padding=1)
        oracle = deform_conv2d(x[n : n + 1], offsets, layer.weight, layer.bias, padding=1)
        torch.testing.assert_close(together[n : n + 1], oracle)


@pytest.mark.parametrize("grid", ["half-band", "full"])
def test_direct_network_written_out(grid: str) -> None:
    """The network again as one flat list of operations, with torchvision's deformable layer."""
    torch.manual_seed(2)
    network = DirectNetwork(NetworkConfig(grid=grid, layers=6, channels=8, adjustable_layers=(3,))).double()
    state = network.state_dict()
    a = torch.rand(1, 3, 12, 16, dtype=torch.float64)
    d = torch.rand(1, 12, 16, dtype=torch.float64)
    s = 2.2
    # Pixels of blur between the ends of 0 to 20/7 dpt; the mean of λ·(f/p)²·V for 638, 520 and 450 nm.
    blur, fresnel = math.log2(s * 100 / 7 / 40), math.log2(536e-9 * 5000**2 * 20 / 7 / 40)
    x = torch.cat((a, d[:, None] - 0.5, (3 + 2 * blur) * (d[:, None] - 0.5)), 1)
    if grid == "half-band":
        blocks = x.view(1, 5, 6, 2, 8, 2).permute(0, 1, 3, 5, 2, 4)
        x = blocks.reshape(1, 20, 6, 8)
    x = torch.cat((x, torch.full_like(x[:, :1], blur), torch.full_like(x[:, :1], fresnel)), 1)

    def conv(i: int, t: torch.Tensor) -> torch.Tensor:
        weight, bias = state[f"layers.{i}.weight"], state[f"layers.{i}.bias"]
        if i != 3:
            return F.conv2d(t, weight, bias, padding=1)
        offsets = network.layers[3].offsets(t, torch.tensor([[blur, fresnel]], dtype=torch.float64))
        return deform_conv2d(t, offsets, weight, bias, padding=1)

    h = F.leaky_relu(conv(0, x), 0.1)
    for first in (1, 3):
        h = F.leaky_relu(0.5 * conv(first + 1, F.leaky_relu(conv(first, h), 0.1)) + h, 0.1)
    out = conv(5, h)
    base = a.view(1, 3, 6, 2, 8, 2).mean((3, 5)) if grid == "half-band" else a
    torch.testing.assert_close(
        network(a, d, torch.tensor([s], dtype=torch.float64)),
        torch.complex(base + out[:, :3], out[:, 3:].contiguous()),
    )


def test_benches_that_are_alike_in_pixels_are_told_alike() -> None:
    """6.4 um with 32 mm has the same pixels a dioptre as 8 um with 40 mm; what lies outside the trained range is told
    as its nearest end."""
    config = NetworkConfig(trained=TrainedRange((20.0, 80.0), (10.0, 160.0)))
    pupils = torch.tensor([1.0, 2.8, 5.0, 8.0], dtype=torch.float64)
    default = conditions(config, OpticsConfig(), pupils)
    torch.testing.assert_close(default[:, 0].exp2() * 40, torch.tensor([20.0, 40, 500 / 7, 80]).double())
    torch.testing.assert_close(default[:, 1].exp2() * 40, torch.full((4,), 268 / 7).double())
    alike = conditions(config, OpticsConfig(pixel_pitch_um=6.4, eyepiece_focal_length_mm=32.0), pupils)
    torch.testing.assert_close(alike, default)
    gaea = conditions(config, OpticsConfig(pixel_pitch_um=3.74), pupils)
    assert (gaea[:, 1] == 2.0).all() and (gaea[:, 0] > default[:, 0])[1:3].all()
    with pytest.raises(AssertionError):
        torch.testing.assert_close(conditions(config, OpticsConfig(pixel_pitch_um=7.0), pupils), default)


def test_pupil_changes_the_field() -> None:
    torch.manual_seed(4)
    network = DirectNetwork(NetworkConfig(layers=6, channels=8, adjustable_layers=(3,)))
    a, d = torch.rand(1, 3, 16, 16), torch.full((1, 16, 16), 0.5)
    offsets = []
    for s in (1.0, 5.0):
        trace: dict[str, torch.Tensor] = {}
        network(a, d, torch.tensor([s]), trace)
        offsets.append(trace["offsets_3"])
    assert (offsets[0] - offsets[1]).abs().max() > 0.01


def test_config_round_trip_and_errors() -> None:
    config = NetworkConfig(layers=20, adjustable_layers=(9, 11))
    assert NetworkConfig.from_json(config.to_json()) == config
    with pytest.raises(ConfigError, match="unknown keys: depht"):
        NetworkConfig.from_json(config.to_json().replace('"layers"', '"depht": 1, "layers"'))
    with pytest.raises(ConfigError, match="keys missing: grid"):
        NetworkConfig.from_json(config.to_json().replace('"grid": "half-band", ', ""))
    with pytest.raises(ConfigError, match=r"adjustable_layers: found \(13,\)"):
        NetworkConfig(adjustable_layers=(13,))
    with pytest.raises(ConfigError, match="not JSON"):
        NetworkConfig.from_json("{")
