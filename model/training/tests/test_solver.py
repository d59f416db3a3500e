import pytest
import torch
from conftest import write_shard

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.judging import Bench, network_field
from holod_training.loss import LossWeights, focus_loss
from holod_training.metrics import judge
from holod_training.network import DirectNetwork
from holod_training.optics import (
    double_phase,
    half_band_samples,
    panel_field,
    shown_by_panel,
    stop_half_band,
    upsample_half_band,
)
from holod_training.rivals import layered_asm
from holod_training.shards import Shard, Stack
from holod_training.solver import Solution, SolverConfig, optimise

OPTICS = OpticsConfig()
CONSTANT = 1.4
BENCH = Bench(OPTICS, CONSTANT, 4)


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Stack:
    folder = tmp_path_factory.mktemp("solver")
    return Shard(write_shard(folder / "scene_000000.safetensors", size=(32, 48), pupils_mm=(2.0,))).read(0)


def start(stack: Stack) -> torch.Tensor:
    return layered_asm(stack.amplitude, stack.depth, OPTICS)


def psnr_db(stack: Stack, field: torch.Tensor) -> float:
    picture = BENCH.look(BENCH.panel(field)[0], stack.pupil_mm, stack.focus_dpt)
    return judge(picture, stack.target, BENCH.blur_px(stack), 4).psnr_db


def solve(stack: Stack, **changes: object) -> Solution:
    return optimise(stack, start(stack), OPTICS, CONSTANT, SolverConfig(**{"iterations": 40, **changes}))


def test_samples_undo_upsampling() -> None:
    low = torch.randn(3, 8, 12, dtype=torch.complex64, generator=torch.Generator().manual_seed(1))
    full = upsample_half_band(low)
    torch.testing.assert_close(upsample_half_band(half_band_samples(full)), full)


def test_what_the_panel_shows_is_double_phase(stack: Stack) -> None:
    """One field inside the constant and one that is clipped, against the encoder of the evaluation."""
    for gain in (1.0, 3.0):
        field = stop_half_band(gain * start(stack))
        phase, clipped = double_phase(field, CONSTANT)
        assert (clipped > 0) == (gain > 1)
        expected = half_band_samples(panel_field(phase) * CONSTANT)
        found = shown_by_panel(half_band_samples(field), CONSTANT, stack.depth.shape)
        assert (found - expected).abs().max() < 5e-3
        on_the_panels_grid = shown_by_panel(field, CONSTANT, stack.depth.shape)
        assert (half_band_samples(on_the_panels_grid) - expected).abs().max() < 5e-3


def test_it_beats_its_start_and_itself_with_more_iterations(stack: Stack) -> None:
    few, more = solve(stack, iterations=10), solve(stack)
    assert more.last_loss < few.last_loss < few.first_loss == more.first_loss
    assert psnr_db(stack, more.field) > psnr_db(stack, start(stack)) + 1
    assert more.field.shape == (1, 3, 32, 48)
    frames = torch.stack((start(stack), torch.zeros_like(start(stack))))
    assert optimise(stack, frames, OPTICS, CONSTANT, SolverConfig(iterations=0)).last_loss == more.first_loss
    none = solve(stack, iterations=0)
    assert none.last_loss == none.first_loss
    torch.testing.assert_close(none.field[0], start(stack), atol=1e-4, rtol=0)


def test_the_loss_is_the_one_of_training(stack: Stack) -> None:
    field = start(stack)
    picture = BENCH.look(BENCH.panel(field)[0], stack.pupil_mm, stack.focus_dpt)
    weights = LossWeights(in_focus=50)
    expected = focus_loss(picture, stack.target, BENCH.blur_px(stack), weights).total
    # The panel rounds to levels, which the solver does not: that is the half per cent.
    assert solve(stack, iterations=0, loss=weights).first_loss == pytest.approx(float(expected), rel=5e-3)


def test_multiplexed_frames_raise_quality(stack: Stack) -> None:
    one, two = solve(stack, iterations=80), solve(stack, iterations=80, frames=2)
    assert two.field.shape == (2, 3, 32, 48)
    assert psnr_db(stack, two.field) > psnr_db(stack, one.field) + 0.3
    alone = max(psnr_db(stack, frame) for frame in two.field)
    assert psnr_db(stack, two.field) > alone + 0.3


def test_weight_on_what_is_in_focus_buys_sharpness(stack: Stack) -> None:
    def in_focus_db(weight: float) -> float:
        solution = solve(stack, loss=LossWeights(in_focus=weight))
        picture = BENCH.look(BENCH.panel(solution.field)[0], stack.pupil_mm, stack.focus_dpt)
        return judge(picture, stack.target, BENCH.blur_px(stack), 4).psnr_in_focus_db

    assert in_focus_db(300) > in_focus_db(0) + 0.5


def test_it_starts_from_a_network_on_either_grid(stack: Stack) -> None:
    for grid in ("half-band", "full"):
        network = DirectNetwork(NetworkConfig(grid=grid, layers=4, channels=8, adjustable_layers=(1,)))
        with torch.no_grad():
            field = network_field(network, stack, 2.0)
        solution = optimise(stack, field, OPTICS, CONSTANT, SolverConfig(iterations=3))
        assert solution.last_loss < solution.first_loss


def test_frames_are_averaged_and_large_stacks_come_in_parts(stack: Stack, monkeypatch: pytest.MonkeyPatch) -> None:
    field = start(stack)
    other = 0.5 * field.flip(-1)
    focus = stack.focus_dpt
    both = BENCH.look(torch.stack((field, other)), 2.0, focus)
    torch.testing.assert_close(both, (BENCH.look(field, 2.0, focus) + BENCH.look(other, 2.0, focus)) / 2)
    monkeypatch.setattr("holod_training.judging.KEPT_EYE_ELEMENTS", 1)
    torch.testing.assert_close(Bench(OPTICS, CONSTANT, 4).look(field, 2.0, focus), BENCH.look(field, 2.0, focus))
