import dataclasses

import pytest
import torch
import torch.nn.functional as F

from holod_training.config import OpticsConfig
from holod_training.expected_stack import expected_stack, feed_back, layer_cover
from holod_training.layered import carry
from holod_training.optics import coc_px, frequencies, pupil_mask
from holod_training.rivals import rgbd_blur
from holod_training.variants import build_network, variant

OPTICS = OpticsConfig()
COUNT = 8


def smooth(seed: int, pictures: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(pictures, 3, 4, 4, generator=generator)
    return F.interpolate(0.3 + 0.6 * coarse, size=(32, 32), mode="bicubic").clamp(0.2, 1)


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


def test_feedback_sets_right_what_an_eye_lacks_at_a_layer_through_its_pupil() -> None:
    torch.manual_seed(3)
    layer = 6
    distance_m = OPTICS.distance_m(OPTICS.dioptres((layer + 0.5) / COUNT))
    wanted_there = torch.polar(smooth(1), smooth(2))
    wrong = wanted_there.clone()
    wrong[..., 10:20, 10:20] *= 0.7
    field = carry(wrong, OPTICS, 2, -distance_m)
    # Every other layer wants what it gets already.
    centres = [OPTICS.distance_m(OPTICS.dioptres((k + 0.5) / COUNT)) for k in range(COUNT)]
    wanted = torch.stack([carry(field, OPTICS, 2, u).abs() for u in centres], dim=1)
    wanted[:, layer] = wanted_there.abs()
    weight = torch.ones(2, COUNT, 1, 1, 1)

    # The second eye's pupil lets but a part of the band through.
    lack, change = feed_back(field, wanted, weight, torch.tensor([5.0, 1.0]), OPTICS, 2)
    torch.testing.assert_close(lack[0, layer], wanted_there[0].abs() - wrong[0].abs(), atol=1e-4, rtol=0)
    assert lack[0, [k for k in range(COUNT) if k != layer]].abs().max() < 1e-4
    mended = carry(field + COUNT * change, OPTICS, 2, distance_m)
    torch.testing.assert_close(mended[0], wanted_there[0], atol=1e-3, rtol=0)
    assert (carry(field, OPTICS, 2, distance_m)[0] - wanted_there[0]).abs().max() > 0.1
    frequency = frequencies(32, 16e-6)
    narrow = torch.fft.ifft2(torch.fft.fft2(wrong[1]) * pupil_mask(OPTICS, frequency, frequency, 1.0))
    torch.testing.assert_close(lack[1, layer], wanted_there[1].abs() - narrow.abs(), atol=1e-3, rtol=0)
    beyond = torch.fft.fft2(change).abs()[..., 0, 15:18].amax(dim=(1, 2))
    assert beyond[1] < 1e-3 * beyond[0]

    # A layer's weight scales its change.
    heavier = weight.clone()
    heavier[:, layer] = 3
    other = feed_back(field, wanted, heavier, torch.tensor([5.0, 1.0]), OPTICS, 2)[1]
    torch.testing.assert_close(other[0], 3 * change[0], atol=1e-4, rtol=1e-3)


def test_the_field_takes_its_share_before_the_second_net_sees_it() -> None:
    torch.manual_seed(4)
    network = build_network(dataclasses.replace(variant("expected-stack"), channels=4))
    amplitude, depth, pupil = torch.rand(1, 3, 32, 32), torch.rand(1, 32, 32), torch.tensor([3.0])
    trace: dict[str, torch.Tensor] = {}
    with torch.no_grad():
        found = network(amplitude, depth, pupil, trace)
        wanted = expected_stack(amplitude, depth, pupil, OPTICS, COUNT, 2).sqrt()
        weight = 1 + layer_cover(depth, COUNT, 2)[:, :, None]
        lack, change = feed_back(trace["carried"], wanted, weight, pupil, OPTICS, 2)
        field = trace["carried"] + 0.5 * change
        real, imaginary = trace["correction.layer_9"].split(3, dim=1)
    torch.testing.assert_close(found, field + 0.3 * torch.complex(real, imaginary), rtol=1e-5, atol=1e-5)
    told, seen = trace["lighting.encoded"], trace["correction.encoded"]
    torch.testing.assert_close(told[:, 21:], wanted.flatten(1, 2) - 0.4)
    expected = (field.real, field.imag, told, change.real, change.imag, lack.flatten(1, 2))
    torch.testing.assert_close(seen, torch.cat(expected, dim=1))
    assert change.abs().mean() > 0.005


def test_untrained_masks_share_the_light_evenly() -> None:
    network = build_network(variant("expected-stack"))
    wanted = smooth(5, 1)[:, None].expand(1, COUNT, 3, 32, 32)
    with torch.no_grad():
        field = network.light_layers(torch.zeros(1, 4 * COUNT, 32, 32), wanted)
        distances_m = [OPTICS.distance_m(OPTICS.dioptres((k + 0.5) / COUNT)) for k in range(COUNT)]
        light = wanted[:, 0].to(torch.complex64) / COUNT
        expected = sum(carry(light, OPTICS, 2, -u) for u in distances_m)
    torch.testing.assert_close(field, expected, atol=1e-4, rtol=1e-4)
