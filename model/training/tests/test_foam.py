import math

import pytest
import torch

from holod_training.foam import foam_energy
from holod_training.loss import LossWeights, focus_loss
from holod_training.metrics import judge

GREY = torch.full((2, 3, 64, 96), 0.4)
BLURRED = torch.full((2, 64, 96), 9.0)


def stripes(period_px: int, swing: float = 0.1) -> torch.Tensor:
    """Square stripes of `swing` about grey, half of which is each of two levels."""
    sign = 1 - 2 * (torch.arange(96) % period_px >= period_px // 2).float()
    return GREY + swing * sign


def mean_foam(picture: torch.Tensor, target: torch.Tensor, coc_px: torch.Tensor) -> float:
    energy, pixels = foam_energy(picture, target, coc_px)
    return float(energy / pixels)


@pytest.mark.parametrize("period_px", [4, 8, 16])
def test_structure_that_a_target_lacks_is_foam_with_all_its_energy(period_px: int) -> None:
    assert mean_foam(stripes(period_px), GREY, BLURRED) == pytest.approx(0.01, rel=1e-4)


def test_what_is_finer_or_coarser_than_an_eye_sees_as_foam_does_not_count() -> None:
    assert mean_foam(stripes(2), GREY, BLURRED) == pytest.approx(0, abs=1e-9)
    assert mean_foam(GREY + 0.1, GREY, BLURRED) == pytest.approx(0, abs=1e-9)


def test_only_what_exceeds_the_targets_own_structure_is_foam() -> None:
    shifted = stripes(8).roll(3, dims=-1)
    assert mean_foam(stripes(8), stripes(8), BLURRED) == 0
    assert mean_foam(GREY, stripes(8), BLURRED) == 0, "less structure than the target's"
    assert mean_foam(stripes(8), shifted, BLURRED) == pytest.approx(0.0075, rel=1e-4), "blocks stand still"
    assert mean_foam(stripes(8, 0.2), stripes(8), BLURRED) == pytest.approx(0.03, rel=1e-4)


def test_only_what_is_out_of_focus_counts() -> None:
    coc_px = BLURRED.clone()
    coc_px[:, :, :32] = 8.0
    spoiled = GREY.clone()
    spoiled[..., :32] = stripes(8)[..., :32]
    assert mean_foam(spoiled, GREY, coc_px) == 0
    assert mean_foam(stripes(8), GREY, coc_px) == pytest.approx(0.01, rel=1e-4), "a mean over what is out of focus"


def test_a_picture_without_room_for_a_region_is_refused_in_words() -> None:
    with pytest.raises(ValueError, match=r"\(64, 31\) pixels have no region of 32x32; take a larger crop"):
        foam_energy(GREY[..., :31], GREY[..., :31], BLURRED[..., :31])


def test_a_judgement_carries_it_and_a_small_or_sharp_scene_has_none() -> None:
    found = judge(stripes(8), GREY, BLURRED, 0, with_ssim=False)
    assert found.foam == pytest.approx(0.01, rel=1e-4)
    assert math.isnan(judge(stripes(8), GREY, torch.zeros_like(BLURRED), 0, with_ssim=False).foam)
    assert math.isnan(judge(stripes(8), GREY, BLURRED, 20, with_ssim=False).foam)


def test_the_loss_takes_it_where_it_has_a_weight() -> None:
    picture = stripes(8).requires_grad_()
    without = focus_loss(picture, GREY, BLURRED, LossWeights())
    weighed = focus_loss(picture, GREY, BLURRED, LossWeights(foam=100.0))
    assert "foam" not in without.terms
    assert weighed.terms["foam"] == pytest.approx(0.01, rel=1e-4)
    assert float((weighed.total - without.total).detach()) == pytest.approx(1.0, rel=1e-3)
    (gradient,) = torch.autograd.grad(weighed.total - without.total.detach(), picture)
    assert float((gradient * (picture.detach() - GREY)).sum()) > 0, "less of it is a lower loss"
