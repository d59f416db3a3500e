import dataclasses

import pytest
import torch

from holod_training.config import OpticsConfig
from holod_training.loss import (
    LossWeights,
    focus_loss,
    in_focus_weight,
    inner,
    light_loss,
    sharpness_weight,
    structure_loss,
)

TERMS = ("absolute", "gradient", "squared", "focus", "in_focus", "outlines", "focus_absolute", "structure", "teacher")
NONE = {name: 0.0 for name in TERMS}


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


@pytest.mark.parametrize("term", TERMS)
def test_each_term_alone_is_zero_at_the_target_positive_elsewhere_and_has_the_gradient(term: str) -> None:
    weights = LossWeights(**{**NONE, term: 2.0})
    target, picture = stack(1), stack(2)
    away = focus_loss(picture, target, COC, weights, teacher=target)
    assert focus_loss(target, target, COC, weights, teacher=target).total == pytest.approx(0, abs=1e-12)
    assert away.total > 0.01
    assert away.total.item() == pytest.approx(2 * away.terms[term])
    small = stack(2)[:2, :1, :8, :8].clone().requires_grad_()
    shown = target[:2, :1, :8, :8]
    assert torch.autograd.gradcheck(
        lambda p: focus_loss(p, shown, COC[:2, :8, :8], weights, teacher=shown).total, small
    )


def test_every_term_is_logged_and_the_total_is_their_weighted_sum() -> None:
    weights = LossWeights(**{name: 0.5 + index for index, name in enumerate(TERMS)})
    parts = focus_loss(stack(2), stack(1), COC, weights, teacher=stack(3))
    assert set(parts.terms) == set(TERMS)
    assert parts.total.item() == pytest.approx(sum(getattr(weights, k) * v for k, v in parts.terms.items()))
    assert "teacher" not in focus_loss(stack(2), stack(1), COC, weights).terms


def test_outlines_are_edges_out_of_focus() -> None:
    weights = LossWeights(**{**NONE, "outlines": 1.0})
    target = torch.full((2, 3, 12, 12), 0.5, dtype=torch.float64)
    coc = torch.zeros(2, 12, 12, dtype=torch.float64)
    coc[1] = 20
    edge = torch.zeros(12, 12, dtype=torch.float64)
    edge[:, 6:] = 0.2

    def outlines(plane: int, error: torch.Tensor) -> float:
        picture = target.clone()
        picture[plane] += error
        return focus_loss(picture, target, coc, weights).total.item()

    assert outlines(0, edge) == pytest.approx(0, abs=1e-12)
    assert outlines(1, torch.full_like(edge, 0.2)) == pytest.approx(0, abs=1e-12)
    assert outlines(1, edge) == pytest.approx(0.2**2 / 22, rel=1e-3)
    assert outlines(1, edge.T) == pytest.approx(0.2**2 / 22, rel=1e-3)
    # Of a plane that is sharp on its left, and then above, an edge counts where it lies in the blurred rest.
    coc[1, :, :8] = 0
    assert outlines(1, edge) == pytest.approx(0, abs=1e-12)
    assert outlines(1, edge.roll(3, dims=1)) > 0.2**2 / 23
    coc[1] = coc[1].T.clone()
    assert outlines(1, edge.T) == pytest.approx(0, abs=1e-12)
    assert outlines(1, edge.T.roll(3, dims=0)) > 0.2**2 / 23


def test_structure_looks_at_the_chosen_planes_only() -> None:
    target = stack(1)
    picture = target.clone()
    picture[2] = stack(2)[2]
    weights = LossWeights(**{**NONE, "structure": 1.0})
    others, all_planes = (
        focus_loss(picture, target, COC, weights, perceptual_planes=planes).total
        for planes in (torch.tensor([0, 3, 1]), None)
    )
    assert others == pytest.approx(0, abs=1e-12)
    assert all_planes > 0.1


def test_structure_hears_blur_at_fine_scales_and_brightness_at_the_coarsest() -> None:
    target = torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 0.5
    blurred = torch.nn.functional.avg_pool2d(target, 3, stride=1, padding=1)
    assert structure_loss(blurred, target) > 0.1
    brighter = structure_loss(target + 0.2, target)
    assert 0 < brighter < 0.1
    with pytest.raises(ValueError, match="no 8-pixel window"):
        structure_loss(target[..., :7], target[..., :7])


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


def test_a_wider_pupil_weighs_the_in_focus_term_more_and_no_other() -> None:
    weights = LossWeights(in_focus=7.0, squared=3.0)

    def of_pupil(of: LossWeights, mm: float) -> LossWeights:
        return of.for_bench(OpticsConfig(), mm)

    assert of_pupil(weights, 2.0).in_focus == pytest.approx(7.0)
    assert dataclasses.replace(of_pupil(weights, 4.0), in_focus=7.0) == weights
    assert [of_pupil(weights, s).in_focus for s in (1.0, 4.0, 5.0, 8.0)] == pytest.approx([3.5, 14.0, 17.5, 17.5])
    squarely = dataclasses.replace(weights, in_focus_growth=2.0)
    assert [of_pupil(squarely, s).in_focus for s in (1.0, 2.0, 4.0)] == pytest.approx([1.75, 7.0, 28.0])
    assert of_pupil(LossWeights(), 5.0) == LossWeights()


def test_more_diffraction_than_the_default_benchs_weighs_the_in_focus_term_more_where_that_is_asked() -> None:
    short, long = (dataclasses.replace(OpticsConfig(), eyepiece_focal_length_mm=mm) for mm in (20.0, 80.0))
    plain, growing = LossWeights(in_focus=7.0), LossWeights(in_focus=7.0, in_focus_diffraction_growth=1.5)

    def at_equal_blur(of: LossWeights, optics: OpticsConfig) -> float:
        return of.for_bench(optics, optics.pupil_mm(200 / 7)).in_focus

    assert [at_equal_blur(plain, bench) for bench in (short, long)] == pytest.approx([7.0, 7.0])
    # Four times the default's: it goes with the square of the focal length.
    assert [at_equal_blur(growing, bench) for bench in (short, long)] == pytest.approx([7.0, 7.0 * 8.0])


def test_more_diffraction_weighs_outlines_more_where_that_is_asked() -> None:
    short, long = (dataclasses.replace(OpticsConfig(), eyepiece_focal_length_mm=mm) for mm in (20.0, 80.0))
    plain, growing = LossWeights(outlines=5.0), LossWeights(outlines=5.0, outlines_diffraction_growth=0.5)
    assert [plain.for_bench(bench, 3.0).outlines for bench in (short, long)] == pytest.approx([5.0, 5.0])
    assert [growing.for_bench(bench, 3.0).outlines for bench in (short, long)] == pytest.approx([5.0, 10.0])


def test_light_where_there_should_be_none_is_weighed_and_no_other() -> None:
    """What is seen of it is its light, not its square: a thousandth of white everywhere counts as a thousandth."""
    target = torch.zeros(2, 3, 64, 64)
    target[..., 48:] = 0.5
    picture, coc = target + 1e-3, torch.full((2, 64, 64), 9.0)
    loss = focus_loss(picture, target, coc, LossWeights(black=30.0))
    assert loss.terms["black"] == pytest.approx(0.5e-3, rel=1e-4), "half of it is 16 px and more from light"
    assert float(loss.total - focus_loss(picture, target, coc, LossWeights()).total) == pytest.approx(0.015, rel=1e-3)
    brighter = target.clone()
    brighter[..., 32:] += 0.1
    assert focus_loss(brighter, target, coc, LossWeights(black=30.0)).terms["black"] == 0
    assert "black" not in loss_terms(LossWeights())


def test_a_border_counts_for_black_and_light_alone() -> None:
    """A rim there is light that a viewer sees, or misses; all else by the edges is not known of a crop."""
    target = torch.zeros(1, 3, 48, 48)
    coc = torch.full((1, 48, 48), 9.0)
    weights = LossWeights(black=30.0, light=1.0)
    lit, dimmed = target.clone(), target + 0.5
    lit[..., :2] = 0.24
    terms = focus_loss(lit, target, coc, weights, border_px=8).terms
    assert terms.pop("black") == pytest.approx(0.01)
    assert terms.pop("light") > 0 and all(value == 0 for value in terms.values()), terms
    dimmed[..., :2] = 0.3
    terms = focus_loss(dimmed, target + 0.5, coc, weights, border_px=8).terms
    assert terms.pop("light") > 0.005 and all(value == 0 for value in terms.values()), terms
    assert focus_loss(lit, target, coc, weights).terms["absolute"] > 0


def test_a_mark_that_lacks_light_is_told_from_one_that_is_not_sharp() -> None:
    """A dot of one pixel, spread over eight by eight of the same window, and at half its light."""
    dot = torch.zeros(1, 3, 32, 32)
    dot[..., 12, 12] = 1.0
    spread = torch.zeros(1, 3, 32, 32)
    spread[..., 8:16, 8:16] = 1 / 64
    assert light_loss(spread, dot) < 1e-6
    dimmed = float(light_loss(0.5 * dot, dot))
    assert dimmed > 0.01 and float(light_loss(0.5 * spread, dot)) == pytest.approx(dimmed, rel=1e-4)
    terms = focus_loss(0.5 * dot, dot, torch.ones(1, 32, 32), LossWeights(light=2.0)).terms
    assert terms["light"] == pytest.approx(dimmed)
    assert "light" not in loss_terms(LossWeights())


def loss_terms(weights: LossWeights) -> set[str]:
    ones = torch.ones(1, 3, 16, 16)
    return set(focus_loss(ones, ones, torch.ones(1, 16, 16), weights).terms)


def test_inner_leaves_out_the_border_on_every_side() -> None:
    x = torch.zeros(2, 9, 11)
    x[:, 3:-3, 3:-3] = 1
    assert inner(x, 3).shape == (2, 3, 5)
    assert inner(x, 3).min() == 1
