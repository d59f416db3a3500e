import dataclasses
import math
import re
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from holod_training.config import ConfigError, NetworkConfig, OpticsConfig, TrainedRange
from holod_training.costs import operations_per_pixel
from holod_training.layered import LayeredNetwork, blurred
from holod_training.metrics import focus_response
from holod_training.network import DirectNetwork
from holod_training.optics import (
    Eye,
    half_band_mask,
    propagate,
    stop_half_band,
    upsample_half_band,
)
from holod_training.rivals import layered_asm
from holod_training.shards import Stack
from holod_training.variants import VARIANTS, build_network, network_amplitude, variant

SHIPPED = Path(__file__).parents[2] / "weights" / "standard.safetensors"
SIZE = 16
PUPIL_BLIND = {"ablation-no-pupil", "deh-like"}


def scene(config: NetworkConfig, pictures: int, size: int = SIZE) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(5)
    images = (config.planes, 3) if config.architecture == "focal-stack" else (3,)
    return torch.rand(pictures, *images, size, size, generator=g), torch.rand(pictures, size, size, generator=g)


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_learns_from_every_parameter_and_sees_the_pupil(name: str) -> None:
    config = variant(name)
    torch.manual_seed(1)
    network = build_network(config)
    amplitude, depth = scene(config, 3)
    fields = network(amplitude, depth, torch.tensor([2.0, 3.0, 4.0]))
    grid = SIZE // 2 if config.grid == "half-band" else SIZE
    frames = (config.frames,) if config.frames > 1 else ()
    assert fields.shape == (3, *frames, 3, grid, grid)
    assert fields.is_complex()
    fields.abs().square().sum().backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert parameter.grad.abs().max() > 0, key
    with torch.no_grad():
        one, other = (network(amplitude[:1], depth[:1], torch.tensor([s])) for s in (1.0, 5.0))
    difference = (one - other).abs().max()
    assert difference == 0 if name in PUPIL_BLIND else difference > 1e-4


def test_the_table_is_what_it_says() -> None:
    assert variant("half-band-14") == NetworkConfig()
    assert [variant(f"direct-{n}").layers for n in (26, 20, 14)] == [26, 20, 14]
    for name, parameters in (
        ("layered-8", 104_346),
        ("half-band-layered", 179_426),
        ("half-band-layered-small", 69_162),
        ("half-band-layered-small-no-prior", 66_561),
        ("expected-stack", 203_340),
        ("expected-stack-small", 81_476),
        ("refined-stack", 210_276),
        ("refined-stack-small", 85_382),
        ("refined-stack-fast", 27_492),
        ("focal-stack-feedback", 215_427),
    ):
        assert sum(p.numel() for p in build_network(variant(name)).parameters()) == parameters, name
    # Two operations a weight of each 3x3 convolution, the offsets' too; taps and FFTs are a few per cent.
    convolutions = 2 * 9 * (9 * 24 + 10 * 24 * 24 + 24 * 24 + 24 * 18 + 12 * 24 + 4 * 24 * 24 + 24 * 6)
    assert convolutions < operations_per_pixel(variant("layered-8")) < 1.06 * convolutions
    assert operations_per_pixel(variant("refined-stack-fast")) < 15_000
    with pytest.raises(ConfigError, match="variant: found 'layered-5'"):
        variant("layered-5")


def test_configs_that_do_not_fit_say_which_key() -> None:
    for changes, message in (
        ({"dilations": (1, 2)}, "dilations: found .* expected none, or 14 numbers"),
        ({"dilations": (2,) * 14}, "dilations: .* expected 1 at the adjustable layers"),
        ({"conditioning": "some"}, "conditioning: found 'some'"),
        ({"correction_dilations": (1, 2)}, r"correction_dilations: found \(1, 2\), expected none, or 10 numbers"),
        ({"correction_dilations": (0,) * 10}, "correction_dilations: .* of at least 1"),
        ({"architecture": "layered", "pupil_inputs": False}, "pupil_inputs: found False, expected true"),
        ({"architecture": "focal-stack", "frames": 2}, "frames: found 2"),
        ({"architecture": "expected-stack", "grid": "full"}, "grid: found 'full', expected 'half-band' for `expected"),
        ({"architecture": "expected-stack", "pupil_inputs": False}, "pupil_inputs: found False, expected true"),
        ({"architecture": "layered", "refined_stack": True}, "refined_stack: found True, expected false"),
        ({"architecture": "expected-stack", "feedback": True}, "feedback: found True, expected false"),
        ({"architecture": "focal-stack", "grid": "full", "feedback": True}, "feedback: .* a half-band `focal-stack`"),
        ({"trained": TrainedRange((9.0, 5.0))}, r"trained\.volume_blur_px: found \[9.0, 5.0\], expected two"),
        ({"trained": TrainedRange((5.0, 9.0), (0.0, 5.0))}, r"trained\.volume_fresnel_px2: .* two above 0"),
        ({"trained": TrainedRange((20.0, math.inf))}, r"trained\.volume_blur_px: found \[20\.0, inf\], expected two"),
        ({"amplitude_constant": math.inf}, "amplitude_constant: found inf, expected a number above 0"),
        ({"specialists_mm": (3.0, 2.0)}, "specialists_mm: .* rising order"),
    ):
        with pytest.raises(ConfigError, match=message):
            NetworkConfig(**changes)


@pytest.mark.parametrize(
    ("key", "good", "bad", "expected"),
    [
        ("layers", (4, 64), (2, 9, 66), "an even number from 4 to 64"),
        ("correction_layers", (4, 64), (2, 5, 66), "an even number from 4 to 64"),
        ("channels", (1, 256), (0, 257), "1 to 256"),
        ("depth_layers", (2, 64), (1, 65), "2 to 64"),
        ("modulation_hidden", (1, 1024), (0, 1025), "1 to 1024"),
        (
            "adjustable_layers",
            ((), (1, 2, 12)),
            ((0,), (13,), (7, 3), (5, 5)),
            "layers of the body, 1 to 12, in rising",
        ),
    ],
)
def test_no_network_is_larger_than_the_engines_take(
    key: str, good: tuple[object, ...], bad: tuple[object, ...], expected: str
) -> None:
    others = {"adjustable_layers": ()} if key == "layers" else {}
    for value in good:
        assert getattr(NetworkConfig(**{key: value}, **others), key) == value
    for value in bad:
        with pytest.raises(ConfigError, match=re.escape(f"{key}: found {value!r}, expected {expected}")):
            NetworkConfig(**{key: value}, **others)


def test_files_of_known_networks_are_unchanged_and_new_keys_appear_where_they_differ() -> None:
    with safe_open(SHIPPED, framework="pt") as file:
        text = file.metadata()["config"]
    assert NetworkConfig.from_json(text).to_json() == text
    for name, config in VARIANTS.items():
        assert NetworkConfig.from_json(config.to_json()) == config, name
    assert '"frames": 2' in variant("two-frames").to_json()
    assert "frames" not in variant("direct-26").to_json()


def test_dilations_reach_the_convolutions() -> None:
    layers = build_network(variant("half-band-dilated")).layers
    plain = [i for i in range(10) if i != 5]
    assert [layers[i].dilation[0] for i in plain] == [1, 1, 2, 4, 8, 8, 4, 2, 1]
    assert [layer.dilation[0] for layer in build_network(variant("layered-8")).correction] == [1, 1, 2, 4, 2, 1]


def test_blur_input_is_the_mean_blur_over_all_focuses() -> None:
    network = DirectNetwork(NetworkConfig(grid="full", layers=4, adjustable_layers=(1,), blur_input=True))
    depth = torch.linspace(0, 1, 16).expand(1, 16, 16)
    encoded = network.encode(torch.zeros(1, 3, 16, 16), depth, torch.tensor([[0.5, 0.1]]))
    focus = (torch.arange(1000) + 0.5) / 1000
    mean = 4 * (depth[0, 0, :, None] - focus).abs().mean(dim=1)
    torch.testing.assert_close(encoded[0, 5, 0], mean, rtol=1e-4, atol=1e-4)


def test_the_nearest_specialist_serves() -> None:
    torch.manual_seed(3)
    network = build_network(variant("ablation-three-deformable"))
    amplitude, depth = scene(network.config, 3)
    with torch.no_grad():
        together = network(amplitude, depth, torch.tensor([2.4, 3.2, 9.0]))
        for n, serving in enumerate(network.networks):
            alone = serving(amplitude[n : n + 1], depth[n : n + 1], torch.tensor([1.0]))
            torch.testing.assert_close(together[n : n + 1], alone)


def test_the_eye_averages_the_intensities_of_frames() -> None:
    g = torch.Generator().manual_seed(2)
    frames = torch.complex(*torch.randn(2, 2, 3, 16, 16, generator=g))
    eye = Eye(OpticsConfig(), 16, 16, [0.5, 2.0, 2.5])
    mean = (eye.look(frames[0], 3.0) + eye.look(frames[1], 3.0)) / 2
    torch.testing.assert_close(eye.look(frames, 3.0), mean)
    assert (eye.look(frames.mean(dim=0), 3.0) - mean).abs().max() > 0.1


GRIDS = ("full", "half-band")


def unlearned(grid: str, **changes: object) -> LayeredNetwork:
    """A layered network whose learned parts put out zero."""
    config = variant("layered-8" if grid == "full" else "half-band-layered")
    network = LayeredNetwork(dataclasses.replace(config, **changes))
    with torch.no_grad():
        for trunk in (network.surface, network.correction):
            trunk[-1].weight.zero_()
    return network


def composed(amplitude: torch.Tensor, depth: torch.Tensor, grid: str, pitch_um: float, layers: int = 8) -> torch.Tensor:
    """Layers with occlusion and zero phase, written out for one scene [3, H, W]: complex [3, h, w], no 4f stop."""
    optics = OpticsConfig(pixel_pitch_um=pitch_um)

    def low(x: torch.Tensor) -> torch.Tensor:
        return x if grid == "full" else sum(x[..., i::2, j::2] for i in (0, 1) for j in (0, 1)) / 4

    source = low(amplitude).to(torch.complex64)
    field, reached_m = torch.zeros_like(source), 0.0
    for k in range(layers):
        centre_m = optics.distance_m(optics.dioptres((k + 0.5) / layers))
        field = propagate(field, optics, centre_m - reached_m)
        behind = (depth < k / layers) | (depth >= (k + 2) / layers)
        field = low(behind.float()) * field + low((~behind).float()) * source
        reached_m = centre_m
    return propagate(field, optics, -reached_m)


def discs(size: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    """Smooth bright discs, far on the left and near on the right: amplitude [1, 3, H, W], depth [1, H, W]."""
    y, x = torch.arange(size)[:, None] - size / 2, torch.arange(size)
    light = sum(torch.exp(-(y**2 + (x - centre) ** 2) / 30) for centre in (size / 4, 3 * size / 4))
    depth = torch.where(x < size / 2, 0.06, 0.94).expand(1, size, size).contiguous()
    return (0.1 + 0.8 * light).sqrt().expand(1, 3, size, size).contiguous(), depth


def on_the_panel(network: LayeredNetwork, amplitude: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
    """The field [3, H, W] of one scene at s = 3 mm."""
    with torch.no_grad():
        field = network(amplitude, depth, torch.tensor([3.0]))[0]
    return field if network.config.grid == "full" else upsample_half_band(field)


@pytest.mark.parametrize("grid", GRIDS)
def test_layered_without_learning_or_prior_is_layers_of_objects_carried_on_its_own_grid(grid: str) -> None:
    amplitude, depth = scene(variant("layered-8"), 1, 32)
    pitch_um, other_um = (8.0, 16.0) if grid == "full" else (16.0, 8.0)

    def found(**changes: object) -> torch.Tensor:
        with torch.no_grad():
            return unlearned(grid, **changes)(amplitude, depth, torch.tensor([3.0]))[0]

    def expected(pitch: float) -> torch.Tensor:
        field = composed(amplitude[0], depth[0], grid, pitch)
        return stop_half_band(field) if grid == "full" else field

    ours = found(transport_prior=False)
    torch.testing.assert_close(ours, expected(pitch_um), rtol=1e-4, atol=1e-4)
    for wrong in (expected(other_um), found(), found(transport_prior=False, depth_layers=4)):
        assert (ours - wrong).abs().max() > 0.05
    if grid == "full":
        torch.testing.assert_close(ours, layered_asm(amplitude[0], depth[0], OpticsConfig()), rtol=1e-4, atol=1e-4)


def test_half_band_without_learning_is_the_layered_rival_of_a_smooth_scene() -> None:
    """What the grid of half the resolution leaves out is little where the picture has nothing finer."""
    amplitude, depth = discs()
    rival = layered_asm(amplitude[0], depth[0], OpticsConfig())

    def error(network: LayeredNetwork, turned: bool = False) -> float:
        field = on_the_panel(network, amplitude, 1 - depth if turned else depth)
        return float((field - rival).abs().square().mean().sqrt() / rival.abs().square().mean().sqrt())

    assert error(unlearned("half-band", transport_prior=False)) < 0.03
    assert error(unlearned("half-band")) > 0.1
    assert error(unlearned("half-band", transport_prior=False), turned=True) > 0.1


@pytest.mark.parametrize("grid", GRIDS)
def test_the_prior_has_no_sign_at_mid_depth_and_the_reference_wavelength_sets_its_size(grid: str) -> None:
    network = unlearned(grid)
    amplitude, _ = discs()

    def phase(depth: float) -> torch.Tensor:
        trace: dict[str, torch.Tensor] = {}
        with torch.no_grad():
            network(amplitude, torch.full((1, 48, 48), depth), torch.tensor([3.0]), trace)
        return trace["source"][0].angle()

    assert phase(0.5).abs().max() < 1e-5
    torch.testing.assert_close(phase(0.9), -phase(0.1))
    for colour, nm in ((0, 638), (2, 450)):
        torch.testing.assert_close(phase(0.1)[colour] * nm, phase(0.1)[1] * 520, rtol=1e-4, atol=1e-2)
    light = amplitude if grid == "full" else torch.nn.functional.avg_pool2d(amplitude, 2)
    sigmas = (1.0, 2.5) if grid == "full" else (0.5, 1.25)
    narrow, wide = (blurred(torch.log(light.square() + 0.03), sigmas) + 1.66)[0]
    expected = math.tanh(4 * 0.4) * (-0.5 * narrow[1] - wide[1])
    torch.testing.assert_close(phase(0.1)[1], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_prior_refocuses_more_than_no_phase(grid: str) -> None:
    """Against Gaussian blur that grows away from each disc's depth: the wrong sign would lower the slope."""
    amplitude, depth = discs()
    optics = OpticsConfig()
    focus = [optics.dioptres(0.06), optics.dioptres(0.94)]
    light = amplitude[0].square()
    soft = blurred(light[None], (4.0,))[0, 0]
    near = depth[0] > 0.5
    target = torch.stack((torch.where(near, soft, light), torch.where(near, light, soft)))
    eye = Eye(optics, 48, 48, focus)

    def slope(**changes: object) -> float:
        return focus_response(eye.look(on_the_panel(unlearned(grid, **changes), amplitude, depth), 8.0), target)[0]

    assert slope() > slope(transport_prior=False) + 0.1


@pytest.mark.parametrize("grid", GRIDS)
def test_the_second_net_adds_three_tenths_of_its_output_to_the_carried_field(grid: str) -> None:
    """And a trace changes nothing."""
    config = dataclasses.replace(variant("half-band-layered-small"), grid=grid, channels=4)
    torch.manual_seed(2)
    network = build_network(config).double()
    amplitude, depth = (t.double() for t in scene(config, 2))
    pupil = torch.tensor([2.0, 4.0], dtype=torch.float64)
    trace: dict[str, torch.Tensor] = {}
    with torch.no_grad():
        field = network(amplitude, depth, pupil, trace)
        assert torch.equal(network(amplitude, depth, pupil), field)
    assert field.dtype == torch.complex128
    residual = torch.complex(*trace["correction.layer_5"].split(3, dim=1))
    expected = trace["carried"] + 0.3 * residual
    torch.testing.assert_close(field, expected if grid == "half-band" else stop_half_band(expected))
    assert residual.abs().mean() > 1e-3
    seen = trace["correction.encoded"]
    torch.testing.assert_close(torch.complex(seen[:, :3], seen[:, 3:6]), trace["carried"])
    torch.testing.assert_close(seen[:, 6:], trace["surface.encoded"][:, : seen.shape[1] - 6])


@pytest.mark.parametrize("grid", ["full", "half-band"])
def test_a_focal_stack_of_one_open_plane_is_its_image_carried_back(grid: str) -> None:
    config = dataclasses.replace(variant("focal-stack"), grid=grid, planes=3)
    network = build_network(config)
    amplitude, depth = scene(config, 1, 32)
    with torch.no_grad():
        network.layers[-1].weight.zero_()
        # Of each plane's four outputs the last is the mask.
        network.layers[-1].bias.copy_(torch.tensor([0.0, 0, 0, -90, 0, 0, 0, 90, 0, 0, 0, -90]))
        field = network(amplitude, depth, torch.tensor([3.0]))[0]
    optics, shown = network.optics, amplitude[0, 1]
    if grid == "half-band":
        shown = torch.nn.functional.avg_pool2d(shown, 2)
        optics = dataclasses.replace(optics, pixel_pitch_um=16.0)
    back = propagate(shown.to(torch.complex64), optics, -optics.distance_m(optics.dioptres(0.5)))
    if grid == "full":
        back = torch.fft.ifft2(torch.fft.fft2(back) * half_band_mask(32, 32))
        torch.testing.assert_close(field, back, rtol=1e-4, atol=1e-4)
    else:
        # The low grid's Nyquist bins are outside the half band.
        spectrum = torch.fft.fft2(back)
        spectrum[:, 8] = 0
        spectrum[:, :, 8] = 0
        torch.testing.assert_close(field, torch.fft.ifft2(spectrum), rtol=1e-4, atol=1e-4)


def test_a_fed_back_focal_stack_of_one_open_plane_lacks_nothing_there() -> None:
    config = dataclasses.replace(variant("focal-stack-feedback"), planes=3)
    network = build_network(config)
    amplitude = torch.full((1, 3, 3, 32, 32), 0.5)
    amplitude[:, 1] = torch.nn.functional.interpolate(
        0.4 + 0.3 * torch.rand(1, 3, 4, 4), size=(32, 32), mode="bilinear"
    )
    with torch.no_grad():
        network.lighting[-1].weight.zero_()
        network.lighting[-1].bias.copy_(torch.tensor([0.0, 0, 0, -90, 0, 0, 0, 90, 0, 0, 0, -90]))
        seen: list[torch.Tensor] = []
        network.correction.register_forward_hook(lambda _, inputs, out: seen.extend((inputs[0], out)))
        field = network(amplitude, torch.rand(1, 32, 32), torch.tensor([5.0]))[0]
    told, residual = seen
    lack = told[0, -9:].unflatten(0, (3, 3))
    assert lack[1].abs().max() < 1e-3 < 0.01 < lack[0].abs().mean()
    wanted = torch.nn.functional.avg_pool2d(amplitude[0, 1].square(), 2).sqrt()
    optics = dataclasses.replace(network.optics, pixel_pitch_um=16.0)
    back = propagate(wanted.to(torch.complex64), optics, -optics.distance_m(optics.dioptres(0.5)))
    change = torch.complex(*told[0, -15:-9].split(3))
    assert change.abs().mean() > 1e-3
    before = torch.complex(*told[0, :6].split(3))
    torch.testing.assert_close(before, back + 0.5 * change, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(field, before + 0.3 * torch.complex(*residual[0].split(3)), rtol=1e-5, atol=1e-5)


def test_focal_stacks_focused_elsewhere_are_refused() -> None:
    config = variant("focal-stack")
    target = torch.rand(3, 3, 8, 8)
    stack = Stack(target[0], target[0, 0], target, 3.0, (0.0, 1.0, 2.857))
    with pytest.raises(ConfigError, match=r"planes: found focal images at 0\.000, 1\.000, 2\.857 dpt"):
        network_amplitude(config, stack)
    with pytest.raises(ConfigError, match="planes: found input of shape"):
        build_network(config)(target[:1], target[:1, 0], torch.tensor([3.0]))
    three = dataclasses.replace(config, planes=3)
    fitting = dataclasses.replace(stack, focus_dpt=(0.0, 1.42857, 2.85714))
    torch.testing.assert_close(network_amplitude(three, fitting).square(), target)
