import torch
import torch.nn.functional as F

from holod_training.config import OpticsConfig
from holod_training.layered import carry, layer_centres_m
from holod_training.optics import frequencies, pupil_mask
from holod_training.plane_light import LIT, feed_back, light_planes

OPTICS = OpticsConfig()
COUNT = 8
DISTANCES_M = tuple(layer_centres_m(OPTICS, COUNT))


def smooth(seed: int, pictures: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(pictures, 3, 4, 4, generator=generator)
    return F.interpolate(0.3 + 0.6 * coarse, size=(32, 32), mode="bicubic").clamp(0.2, 1)


def test_feedback_sets_right_what_an_eye_lacks_at_a_layer_through_its_pupil() -> None:
    torch.manual_seed(3)
    layer = 6
    distance_m = DISTANCES_M[layer]
    wanted_there = torch.polar(smooth(1), smooth(2))
    wrong = wanted_there.clone()
    wrong[..., 10:20, 10:20] *= 0.7
    field = carry(wrong, OPTICS, 2, -distance_m)
    # Every other layer wants what it gets already.
    wanted = torch.stack([carry(field, OPTICS, 2, u).abs() for u in DISTANCES_M], dim=1)
    wanted[:, layer] = wanted_there.abs()
    weight = torch.ones(2, COUNT, 1, 1, 1)

    # The second eye's pupil lets but a part of the band through.
    lack, change = feed_back(field, wanted, weight, torch.tensor([5.0, 1.0]), OPTICS, DISTANCES_M, 2)
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
    other = feed_back(field, wanted, heavier, torch.tensor([5.0, 1.0]), OPTICS, DISTANCES_M, 2)[1]
    torch.testing.assert_close(other[0], 3 * change[0], atol=1e-4, rtol=1e-3)


def test_untrained_masks_share_the_light_evenly() -> None:
    wanted = smooth(5, 1)[:, None].expand(1, COUNT, 3, 32, 32)
    field = light_planes(torch.zeros(1, LIT * COUNT, 32, 32), wanted, OPTICS, DISTANCES_M, 2)
    light = wanted[:, 0].to(torch.complex64) / COUNT
    expected = sum(carry(light, OPTICS, 2, -u) for u in DISTANCES_M)
    torch.testing.assert_close(field, expected, atol=1e-4, rtol=1e-4)
