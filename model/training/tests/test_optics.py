import math

import pytest
import torch

from holod_training.config import OpticsConfig
from holod_training.optics import (
    Eye,
    HalfBandEye,
    coc_px,
    double_phase,
    double_phase_phasors,
    frequencies,
    half_band_mask,
    intensity,
    panel_field,
    propagate,
    propagate_padded,
    pupil_mask,
    through_levels,
    upsample_half_band,
)

OPTICS = OpticsConfig()


def gaussian_beam(size: int, waist_m: float, wavelength_m: float, z_m: float) -> torch.Tensor:
    """Saleh and Teich, eq. 3.1-7, without exp(j·k·z): an analytic solution of the paraxial wave equation."""
    x = (torch.arange(size, dtype=torch.float64) - size // 2) * OPTICS.pitch_m
    r2 = x[None, :] ** 2 + x[:, None] ** 2
    z0 = math.pi * waist_m**2 / wavelength_m
    width = waist_m * math.sqrt(1 + (z_m / z0) ** 2)
    curvature = 0.0 if z_m == 0 else 1 / (z_m * (1 + (z0 / z_m) ** 2))
    phase = math.pi / wavelength_m * r2 * curvature - math.atan2(z_m, z0)
    return waist_m / width * torch.exp(-r2 / width**2) * torch.polar(torch.ones_like(phase), phase)


@pytest.mark.parametrize("method", [propagate, propagate_padded])
@pytest.mark.parametrize("z_m", [-0.004, 0.002, 0.0045])
def test_asm_spreads_a_gaussian_beam(method, z_m: float) -> None:
    waist = 60e-6
    start = torch.stack([gaussian_beam(128, waist, w, 0.0) for w in OPTICS.wavelengths_m])
    expected = torch.stack([gaussian_beam(128, waist, w, z_m) for w in OPTICS.wavelengths_m])
    found = method(start, OPTICS, z_m)
    assert (found - expected).abs().max() < 2e-4
    assert (found - start).abs().max() > 1e-2, "the beam must change at all"


def test_asm_comparator_rejects_the_wrong_direction() -> None:
    start = torch.stack([gaussian_beam(128, 60e-6, w, 0.0) for w in OPTICS.wavelengths_m])
    expected = torch.stack([gaussian_beam(128, 60e-6, w, 0.0045) for w in OPTICS.wavelengths_m])
    assert (propagate(start, OPTICS, -0.0045) - expected).abs().max() > 1e-2


def test_padding_keeps_light_from_wrapping_round() -> None:
    field = torch.zeros(3, 64, 64, dtype=torch.complex128)
    ramp = torch.polar(torch.ones(64, dtype=torch.float64), 2 * math.pi * 0.2 * torch.arange(64, dtype=torch.float64))
    field[..., -24:] = ramp[-24:]
    far = 0.006
    wrapped, padded = (intensity(m(field, OPTICS, far))[..., :16].sum() for m in (propagate, propagate_padded))
    assert wrapped > 5 * padded


def low_field(h: int = 24, w: int = 32) -> torch.Tensor:
    g = torch.Generator().manual_seed(5)
    return torch.complex(
        torch.randn(3, h, w, generator=g, dtype=torch.float64),
        torch.randn(3, h, w, generator=g, dtype=torch.float64),
    )


def test_upsampled_field_is_strictly_half_band() -> None:
    low = low_field()
    full = upsample_half_band(low)
    spectrum = torch.fft.fft2(full)
    mask = half_band_mask(*full.shape[-2:])
    assert spectrum[..., ~mask].abs().max() < 1e-9
    assert spectrum[..., mask].abs().max() > 1


@pytest.mark.parametrize("size", [4, 5, 6, 7, 196, 392, 412, 1012])
def test_the_bin_at_a_quarter_is_stopped_whatever_the_size(size: int) -> None:
    inside = [4 * min(k, size - k) < size for k in range(size)]
    assert half_band_mask(1, size)[0].tolist() == half_band_mask(size, 1)[:, 0].tolist() == inside


def test_upsampling_keeps_a_wave_where_it_was() -> None:
    """exp(j·2π(…)) sampled at block centres becomes the same wave at pixel positions."""
    h, w = 24, 32
    u, v = 3 / (2 * w), -2 / (2 * h)

    def wave(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        angle = 2 * math.pi * (u * x[None, :] + v * y[:, None])
        return torch.polar(torch.ones_like(angle), angle)

    rows, columns = torch.arange(h, dtype=torch.float64), torch.arange(w, dtype=torch.float64)
    low = wave(2 * rows + 0.5, 2 * columns + 0.5)
    full = wave(torch.arange(2 * h, dtype=torch.float64), torch.arange(2 * w, dtype=torch.float64))
    torch.testing.assert_close(upsample_half_band(low), full)


@pytest.mark.parametrize("pupil_mm", [1.0, 1.7, 4.0])
def test_training_eye_equals_full_eye(pupil_mm: float) -> None:
    low = low_field(25, 32).to(torch.complex64)
    focus = [0.0, 1.1, 2.8]
    fast = HalfBandEye(OPTICS, 50, 64, focus, "cpu").look(low, pupil_mm)
    slow = Eye(OPTICS, 50, 64, focus).look(upsample_half_band(low), pupil_mm)
    torch.testing.assert_close(fast, slow, rtol=1e-4, atol=1e-4)


def test_eye_comparator_rejects_another_pupil() -> None:
    low = low_field().to(torch.complex64)
    fast = HalfBandEye(OPTICS, 48, 64, [0.0], "cpu").look(low, 1.0)
    slow = Eye(OPTICS, 48, 64, [0.0]).look(upsample_half_band(low), 1.2)
    assert not torch.allclose(fast, slow, rtol=1e-4, atol=1e-4)


def test_pupil_mask_is_a_disc_of_the_eyes_radius() -> None:
    f = frequencies(256, OPTICS.pitch_m)
    mask = pupil_mask(OPTICS, f, f, 1.0)
    step = float(f[1])
    for colour, wavelength in enumerate(OPTICS.wavelengths_m):
        area = math.pi * (0.5e-3 / (wavelength * 0.04)) ** 2
        assert mask[colour].sum() * step**2 == pytest.approx(area, rel=0.02)


def test_double_phase_round_trip_through_the_stop() -> None:
    """A smooth field comes back: the checkerboard's mean is the field over K, its difference is stopped."""
    y, x = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
    amplitude = 0.6 + 0.3 * torch.cos(2 * math.pi * x / 64) * torch.cos(2 * math.pi * y / 64)
    field = torch.polar(amplitude, 1.5 * torch.sin(2 * math.pi * (x + y) / 128)).expand(3, -1, -1)
    phase, clipped = double_phase(field, 1.4)
    assert clipped == 0
    assert phase.min() >= 0 and phase.max() < 2 * math.pi
    spectrum = torch.fft.fft2(panel_field(phase)) * half_band_mask(128, 128)
    back = torch.fft.ifft2(spectrum) * 1.4
    assert (back - field).abs().max() < 0.02
    assert (panel_field(phase) * 1.4 - field).abs().max() > 0.3, "before the stop the checkerboard must be there"


def test_double_phase_sign_and_clipping() -> None:
    a = math.acos(0.5)
    phase, clipped = double_phase(torch.full((1, 2, 3), 0.7, dtype=torch.complex64), 1.4)
    minus = 2 * math.pi - a
    torch.testing.assert_close(phase, torch.tensor([[[minus, a, minus], [a, minus, a]]]), atol=1e-5, rtol=0)
    assert clipped == 0
    field = torch.full((1, 2, 2), 0.7, dtype=torch.complex64)
    field[0, 1, 1] = 3.0
    assert double_phase(field, 1.4)[1] == 0.25


def marks_on_black() -> torch.Tensor:
    """Two dots of unlike phases and a diagonal line, and the noise that a network leaves on black."""
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    line = torch.exp(-((x - y - 10) ** 2) / 4.5) * ((x > 30) & (x < 100))
    dots = [torch.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 4.5) for cx, cy in ((20, 60), (100, 20))]
    noise = torch.rand(96, 128, generator=torch.Generator().manual_seed(2)) * 2 * math.pi
    field = torch.complex(dots[0] + line, dots[1]) + torch.polar(torch.full_like(noise, 0.004), noise)
    return field.expand(3, -1, -1)


def light_and_dark(phase: torch.Tensor, field: torch.Tensor) -> tuple[float, float]:
    """As an eye sees a pattern: all light over the field's, and the mean where that is dark."""
    eye = Eye(OPTICS, *field.shape[-2:], [0.0])
    wanted, seen = eye.look(field, 3.0), eye.look(panel_field(phase), 3.0) * 1.25**2
    return float(seen.sum() / wanted.sum()), float(seen[wanted < 1e-3].mean())


def test_black_stays_black_around_bright_marks() -> None:
    field = marks_on_black()
    light, dark = light_and_dark(double_phase(field, 1.25)[0], field)
    assert 0.85 < light < 1.15 and dark < 5e-4
    spread = torch.acos((field.abs() / 1.25).clamp(max=1))
    odd = (torch.arange(96)[:, None] + torch.arange(128)) % 2 == 1
    light, dark = light_and_dark(field.angle() + torch.where(odd, spread, -spread), field)
    assert light > 1.3 and dark > 5e-3, "the comparison does not tell the plain pair"


def test_dim_pictures_keep_their_light() -> None:
    """What is dark beside nothing bright is no darkness: a smooth field of 1 % of the light."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    field = torch.polar(0.1 + 0.05 * torch.cos(x / 9), 0.2 * x - 0.15 * y + torch.sin(y / 7)).expand(3, -1, -1)
    stop = half_band_mask(64, 64)
    shown = torch.fft.ifft2(torch.fft.fft2(panel_field(double_phase(field, 1.25)[0]) * 1.25) * stop)
    inside = (slice(None), slice(8, -8), slice(8, -8))
    assert intensity(shown - field)[inside].mean() < 2e-3 * intensity(field)[inside].mean()
    assert intensity(shown - 0.95 * field)[inside].mean() > 2e-3 * intensity(field)[inside].mean()


def test_double_phase_has_a_gradient_everywhere() -> None:
    field = marks_on_black()[:1].clone()
    field[:, :40] = 0
    field[:, 50:60] *= 20
    field.requires_grad_()
    double_phase_phasors(field, 1.25).angle().square().sum().backward()
    assert field.grad is not None and torch.view_as_real(field.grad).isfinite().all()
    assert field.grad.abs().max() > 0


def test_coc_of_the_default_bench() -> None:
    depth = torch.tensor([[0.0, 1.0]])
    blur = coc_px(OPTICS, depth, [1 / 0.35], 3.0)
    assert blur[0, 0, 0] == pytest.approx(42.857, abs=1e-3)
    assert blur[0, 0, 1] == pytest.approx(0, abs=1e-3)


def test_levels_are_the_nearest_ones_on_the_circle() -> None:
    step = math.pi / 2
    phase = torch.tensor([0.0, 0.49 * step, 0.51 * step, 3.4 * step, 3.6 * step])
    torch.testing.assert_close(through_levels(phase, bit_depth=2) / step, torch.tensor([0.0, 0.0, 1.0, 3.0, 0.0]))
    many = torch.linspace(0, 2 * math.pi, 1001)[:-1]
    assert (panel_field(through_levels(many)) - panel_field(many)).abs().max() <= math.pi / 256 + 1e-6
    assert len(through_levels(torch.linspace(0, 2 * math.pi, 9999)).unique()) == 256


def test_blur_and_diffraction_go_by_the_depth_of_the_volume_not_by_where_it_lies() -> None:
    far = OpticsConfig(depth_far_dpt=0.5, depth_near_dpt=3.0)
    from_infinity = OpticsConfig(depth_far_dpt=0.0, depth_near_dpt=2.5)
    expected = [nm * 1e-9 * 5000**2 * 2.5 for nm in (638, 520, 450)]
    assert far.volume_fresnel_px2 == pytest.approx(expected)
    assert far.volume_fresnel_px2 == pytest.approx(from_infinity.volume_fresnel_px2)
    assert far.volume_blur_px(3.0) == pytest.approx(37.5) == from_infinity.volume_blur_px(3.0)
    assert far.pupil_mm(37.5) == pytest.approx(3.0)
