import math

import pytest
import torch
import torch.nn.functional as F

from holod_training.metrics import Judgement, JudgementError, focus_response, gradient_energy, judge, ssim


def pictures(seed: int, planes: int = 4, size: int = 40) -> torch.Tensor:
    return torch.rand(planes, 3, size, size, generator=torch.Generator().manual_seed(seed))


def direct_ssim(a: torch.Tensor, b: torch.Tensor) -> float:
    """SSIM by its definition: one 2-D window, convolved."""
    x = torch.arange(11.0) - 5
    g = torch.exp(-x.square() / 4.5)
    window = torch.outer(g, g) / g.sum() ** 2

    def mean(t: torch.Tensor) -> torch.Tensor:
        return F.conv2d(t.flatten(0, 1)[:, None], window[None, None])

    ma, mb = mean(a), mean(b)
    va, vb, ab = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return float(((2 * ma * mb + 1e-4) * (2 * ab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))).mean())


def test_ssim_equals_its_definition() -> None:
    a, b = pictures(1), pictures(2)
    near = 0.7 * a + 0.3 * b
    assert ssim(a, near) == pytest.approx(direct_ssim(a, near), abs=1e-5)
    assert ssim(a, a) == pytest.approx(1, abs=1e-5)
    assert ssim(a, b) < 0.2


def test_focus_response_against_least_squares() -> None:
    target, noise = pictures(1).double(), pictures(2).double()
    picture = 0.4 * target + 0.2 * noise + 0.1
    slope, correlation = focus_response(picture, target)
    p, r = ((t - t.mean(0)).flatten() for t in (picture, target))
    assert slope == pytest.approx(float(torch.linalg.lstsq(r[:, None], p[:, None]).solution))
    assert correlation == pytest.approx(float(torch.corrcoef(torch.stack((p, r)))[0, 1]))
    assert focus_response(target.mean(0).expand_as(target), target) == (0.0, 0.0)
    assert all(math.isnan(v) for v in focus_response(picture, target.mean(0).expand_as(target)))


def test_judge_parts_and_border() -> None:
    target = pictures(1)
    picture = target.clone()
    picture[..., :4, :] += 5.0
    coc = torch.full((4, 40, 40), 5.0)
    coc[:, :, :20], coc[:, :, 30:] = 1.0, 10.0
    picture[..., 8:32, 8:20] += 0.1
    picture[..., 8:32, 30:32] += 0.01
    found = judge(picture, target, coc, border_px=8)
    assert found.psnr_in_focus_db == pytest.approx(20, abs=1e-3)
    assert found.psnr_out_of_focus_db == pytest.approx(40, abs=1e-2)
    assert found.psnr_db == pytest.approx(-10 * math.log10(0.5 * 0.01 + 2 / 24 * 1e-4), abs=1e-3)


def test_means_leave_out_what_is_unknown() -> None:
    a = Judgement(30, math.nan, 20, 0.5, 0.6, 0.7)
    b = Judgement(20, 25, 20, 0.3, 0.6, 0.7)
    mean = Judgement.mean([a, b])
    assert (mean.psnr_db, mean.psnr_in_focus_db, mean.slope) == (25, 25, pytest.approx(0.4))
    assert "psnr_in_focus_db" not in a.known()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_picture_that_is_no_light_has_no_figures(value: float) -> None:
    """But in the border, which nobody judges. NaN in a figure is left out of means, as an empty part's."""
    target, blur = pictures(1), torch.full((len(pictures(1)), *pictures(1).shape[-2:]), 1.0)
    picture = target.clone()
    picture[0, 0, 0, 0] = value
    assert judge(picture, target, blur, 1).ssim == pytest.approx(1)
    with pytest.raises(JudgementError, match="found a picture with values that are no numbers"):
        judge(picture, target, blur, 0)


def test_gradient_energy_counts_the_area_only() -> None:
    picture = torch.zeros(3, 8, 8)
    picture[..., 1::2] = 1.0
    area = torch.zeros(8, 8, dtype=torch.bool)
    area[2:6, 2:6] = True
    # Every horizontal step is 1, every vertical one 0, as many of each.
    assert gradient_energy(picture, area) == pytest.approx(0.5)
    picture[:, :2] = 100
    assert gradient_energy(picture, area) == pytest.approx(0.5)
