import pytest
import torch

from holod_training.loss import LossWeights, focus_loss, in_focus_weight, inner, sharpness_weight


def stack(seed: int) -> torch.Tensor:
    return torch.rand(4, 3, 10, 12, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


COC = torch.rand(4, 10, 12, generator=torch.Generator().manual_seed(9), dtype=torch.float64) * 20


def test_loss_is_zero_only_at_the_target() -> None:
    target = stack(1)
    assert focus_loss(target, target, COC, LossWeights()).total == 0
    assert focus_loss(target + 0.01, target, COC, LossWeights()).total > 1e-3


def test_gradient_agrees_with_finite_differences() -> None:
    target = stack(1)[:2, :, :5, :4]
    picture = stack(2)[:2, :, :5, :4].requires_grad_()
    assert torch.autograd.gradcheck(lambda p: focus_loss(p, target, COC[:2, :5, :4], LossWeights()).total, picture)


def test_only_the_focus_term_sees_how_planes_differ() -> None:
    """A flat stack and one with as much error but the right differences: the focus term prefers the second."""
    target = stack(1)
    flat = target.mean(dim=0).expand_as(target)
    shifted = target + (flat - target).square().mean().sqrt()
    focus_only = LossWeights(absolute=0, gradient=0, squared=0, focus=1)
    squared_only = LossWeights(absolute=0, gradient=0, squared=1, focus=0)
    assert focus_loss(shifted, target, COC, focus_only).total < 1e-20
    assert focus_loss(flat, target, COC, focus_only).total > 0.01
    same = [focus_loss(p, target, COC, squared_only).total for p in (flat, shifted)]
    assert same[0] == pytest.approx(same[1])


def test_the_flat_stack_has_no_slope_and_half_the_refocus_has_half() -> None:
    target = stack(1)
    mean = target.mean(dim=0)
    assert focus_loss(mean.expand_as(target), target, COC, LossWeights()).slope == pytest.approx(0, abs=1e-9)
    half = focus_loss(mean + 0.5 * (target - mean), target, COC, LossWeights())
    assert half.slope == pytest.approx(0.5)
    assert half.correlation == pytest.approx(1)


def test_sharp_pixels_weigh_most() -> None:
    w = sharpness_weight(torch.tensor([0.0, 0.2, 1.0, 57.0]), 0.2)
    assert w[0] == w[1] > w[2] == 1 > w[3] > 0
    assert w[0] == pytest.approx(3.80, abs=0.01)


def test_the_in_focus_term_sees_sharp_pixels_only() -> None:
    target = stack(1)
    coc = torch.full_like(COC, 30.0)
    coc[:, :5] = 0.5
    sharp, blurred = target.clone(), target.clone()
    sharp[..., :5, :] += 0.1
    blurred[..., 5:, :] += 0.1
    only = LossWeights(absolute=0, gradient=0, squared=0, focus=0, in_focus=1)
    assert focus_loss(sharp, target, coc, only).total == pytest.approx(0.005, rel=0.01)
    assert focus_loss(blurred, target, coc, only).total < 1e-6
    assert in_focus_weight(torch.tensor([0.0, 2.0])).tolist() == [1.0, 0.5]


def test_inner_leaves_out_the_border_on_every_side() -> None:
    x = torch.zeros(2, 9, 11)
    x[:, 3:-3, 3:-3] = 1
    assert inner(x, 3).shape == (2, 3, 5)
    assert inner(x, 3).min() == 1
