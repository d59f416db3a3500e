import dataclasses

import pytest
import torch
import torch.nn.functional as F
from test_plane_light import COUNT, DISTANCES_M, OPTICS, smooth

from holod_training.expected_stack import expected_stack, layer_cover, with_refined_stack
from holod_training.optics import coc_px
from holod_training.plane_light import LIT, feed_back
from holod_training.rivals import rgbd_blur
from holod_training.variants import build_network, variant


def test_a_point_becomes_its_disc_of_confusion_and_is_sharp_at_its_own_layer() -> None:
    size, pupil_mm, layer = 128, 4.0, 1
    amplitude = torch.zeros(1, 3, size, size)
    amplitude[:, 1, 64:66, 64:66] = 1
    depth = torch.full((1, size, size), (layer + 0.5) / COUNT)
    stack = expected_stack(amplitude, depth, torch.tensor([pupil_mm]), OPTICS, COUNT, 2)[0]
    assert stack.shape == (COUNT, 3, size // 2, size // 2)
    sharp = torch.zeros(size // 2, size // 2)
    sharp[32, 32] = 1
    torch.testing.assert_close(stack[layer, 1], sharp, atol=1e-5, rtol=0)
    assert stack[:, (0, 2)].abs().max() < 1e-6
    for focus in (3, 7):
        dpt = OPTICS.dioptres((focus + 0.5) / COUNT)
        diameter = coc_px(OPTICS, depth[0, :1, :1], [dpt], pupil_mm).item() / 2
        away = torch.hypot(torch.arange(64.0)[:, None] - 32, torch.arange(64.0) - 32)
        inside, around = stack[focus, 1][away < diameter / 2 - 2], stack[focus, 1][away > diameter / 2 + 4]
        disc = 4 / (torch.pi * diameter**2)
        assert inside.mean().item() == pytest.approx(disc, rel=0.1)
        assert around.mean().item() < 0.05 * disc


def test_a_white_scene_stays_white_across_a_step_in_depth_and_the_pupil_sets_the_blur() -> None:
    amplitude, depth = torch.ones(2, 3, 64, 64), torch.full((2, 64, 64), 0.05)
    depth[:, :, 32:] = 0.95
    pupils = torch.tensor([2.0, 4.0])
    white = expected_stack(amplitude, depth, pupils, OPTICS, COUNT, 2)
    torch.testing.assert_close(white, torch.ones_like(white), atol=1e-3, rtol=0)
    amplitude[:, :, :, :32] = 0
    step = expected_stack(amplitude, depth, pupils, OPTICS, COUNT, 2)[:, 0, 0, 16]
    width = [int(((row > 0.1) & (row < 0.9)).sum()) for row in step]
    assert width[1] > 1.5 * width[0] > 0


def test_what_lies_near_the_border_of_two_layers_is_shared_by_both() -> None:
    depth = torch.tensor([3.0, 3.2, 3.5, 3.8]).repeat_interleave(2).expand(1, 2, 8) / COUNT
    cover = layer_cover(depth, COUNT, 2)[0, :, 0]
    torch.testing.assert_close(cover[2:5], torch.tensor([[0.5, 0.25, 0, 0], [0.5, 0.75, 1, 0.75], [0, 0, 0, 0.25]]))
    assert cover.sum() == 4
    # Beyond the volume's ends there is no layer to share with.
    ends = layer_cover(torch.tensor([0.0, 1.0]).repeat_interleave(2).expand(1, 2, 4), COUNT, 2)[0, :, 0]
    assert (ends[0, 0], ends[-1, 1], ends.sum()) == (1, 1, 2)


def test_the_stack_is_near_what_composes_far_to_near_on_the_full_grid() -> None:
    """Of a slanted wall with blotches; a stack for another pupil is much farther."""
    amplitude = F.interpolate(smooth(6, 1), size=(96, 96), mode="nearest")
    depth = torch.linspace(0, 1, 96).expand(1, 96, 96).contiguous()
    centres = [OPTICS.dioptres((k + 0.5) / COUNT) for k in range(COUNT)]
    expected = F.avg_pool2d(rgbd_blur(amplitude[0], depth[0], OPTICS, centres, 3.0), 2)

    def error(pupil_mm: float) -> float:
        found = expected_stack(amplitude, depth, torch.tensor([pupil_mm]), OPTICS, COUNT, 2)[0]
        return float((found - expected)[..., 12:-12].square().mean())

    assert error(3.0) < 5e-4 and error(1.0) > 4 * error(3.0)


@pytest.mark.parametrize("refined", [False, True])
def test_the_field_takes_its_share_before_the_second_net_sees_it(refined: bool) -> None:
    torch.manual_seed(4)
    network = build_network(dataclasses.replace(variant("expected-stack"), channels=4, refined_stack=refined))
    amplitude, depth, pupil = torch.rand(1, 3, 32, 32), torch.rand(1, 32, 32), torch.tensor([3.0])
    trace: dict[str, torch.Tensor] = {}
    with torch.no_grad():
        found = network(amplitude, depth, pupil, trace)
        wanted = told_amplitude = expected_stack(amplitude, depth, pupil, OPTICS, COUNT, 2).sqrt()
        if refined:
            changes = trace["lighting.layer_7"][:, LIT * COUNT :].view(1, COUNT, 3, 16, 16)
            wanted = (wanted + 0.3 * changes).clamp_min(0)
            assert (wanted - told_amplitude).abs().mean() > 0.002
        weight = 1 + layer_cover(depth, COUNT, 2)[:, :, None]
        lack, change = feed_back(trace["carried"], wanted, weight, pupil, OPTICS, DISTANCES_M, 2)
        field = trace["carried"] + 0.5 * change
        real, imaginary = trace["correction.layer_9"].split(3, dim=1)
    torch.testing.assert_close(found, field + 0.3 * torch.complex(real, imaginary), rtol=1e-5, atol=1e-5)
    told, seen = trace["lighting.encoded"], trace["correction.encoded"]
    torch.testing.assert_close(told[:, 22:], told_amplitude.flatten(1, 2) - 0.4)
    expected = (field.real, field.imag, told, change.real, change.imag, lack.flatten(1, 2))
    torch.testing.assert_close(seen, torch.cat(expected, dim=1))
    assert change.abs().mean() > 0.005


def test_a_refined_stack_may_not_be_darker_than_black() -> None:
    torch.manual_seed(4)
    network = build_network(dataclasses.replace(variant("refined-stack"), channels=4))
    amplitude, depth, pupil = torch.rand(1, 3, 32, 32), torch.rand(1, 32, 32), torch.tensor([3.0])
    with torch.no_grad():
        network.lighting[-1].bias[LIT * COUNT :] = -100
        trace: dict[str, torch.Tensor] = {}
        network(amplitude, depth, pupil, trace)
    assert trace["carried"].abs().max() == 0


def test_a_network_goes_on_as_one_that_refines_its_stack() -> None:
    torch.manual_seed(4)
    plain, refined = (build_network(variant(name)) for name in ("expected-stack-small", "refined-stack-small"))
    refined.load_state_dict(with_refined_stack(plain.state_dict()))
    scene = torch.rand(1, 3, 32, 32), torch.rand(1, 32, 32), torch.tensor([3.0])
    with torch.no_grad():
        torch.testing.assert_close(refined(*scene), plain(*scene), rtol=1e-5, atol=1e-6)
        refined.lighting[-1].bias[-1] = 0.5
        assert (refined(*scene) - plain(*scene)).abs().max() > 1e-3
