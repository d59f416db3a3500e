import copy
from pathlib import Path

import pytest
import torch
from test_train import CPU, tiny
from torch import nn

from holod_training import cli
from holod_training.config import ConfigError
from holod_training.optimizer import Muon, make_optimizer, orthogonalised
from holod_training.train import Run, TrainConfig

KERNELS = ((16, 8, 3, 3), (64, 2, 3, 3), (24, 24, 3, 3))
OTHERS = ((6, 8, 3, 3), (24,), (18, 24))


def random(shape: tuple[int, ...], seed: int = 1) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def moved(optimizer: torch.optim.Optimizer, parameter: nn.Parameter, count: int, first: int = 0) -> list[torch.Tensor]:
    """What each of a few steps with random gradients adds to a parameter."""
    steps = []
    for step in range(first, first + count):
        before = parameter.detach().clone()
        parameter.grad = 1e-3 * random(tuple(parameter.shape), 10 + step)
        optimizer.step()
        steps.append(parameter.detach() - before)
    return steps


@pytest.mark.parametrize("shape", [(8, 300), (300, 8), (24, 216), (64, 18)])
@pytest.mark.parametrize("unevenness", [1, 10])
def test_orthogonalised_matrices_keep_their_directions_and_stretch_all_alike(
    shape: tuple[int, int], unevenness: float
) -> None:
    u, s, vt = torch.linalg.svd(random(shape), full_matrices=False)
    matrix = u @ torch.diag(s * torch.linspace(1, 1 / unevenness, len(s))) @ vt
    along = u.T @ orthogonalised(matrix) @ vt.T
    assert along.diag().min() > 0.6 and along.diag().max() < 1.3
    assert (along - torch.diag(along.diag())).abs().max() < 1e-3
    torch.testing.assert_close(orthogonalised(1e-4 * matrix), orthogonalised(matrix), rtol=1e-3, atol=1e-3)
    as_long = matrix * len(s) ** 0.5 / matrix.norm()
    assert unevenness == 1 or torch.linalg.svdvals(as_long).min() < 0.6, "the comparison is blind"
    assert orthogonalised(torch.zeros(shape)).abs().max() == 0


@pytest.mark.parametrize("shape", KERNELS)
def test_a_kernels_step_is_as_large_as_a_usual_one_of_adam(shape: tuple[int, ...]) -> None:
    """0.2 · lr whatever the gradient's size, in the direction of its orthogonalised momentum."""
    parameter = nn.Parameter(random(shape))
    first, second = moved(Muon([parameter], 0.01), parameter, 2)
    for step in (first, second):
        assert float(step.square().mean().sqrt()) == pytest.approx(0.2 * 0.01, rel=0.2)
    old, new = (1e-3 * random(shape, seed).flatten(1) for seed in (10, 11))
    mean = 0.05 * 0.95 * old + 0.05 * new
    size = 0.2 * 0.01 * max(mean.shape) ** 0.5
    expected = -size * orthogonalised(0.05 * new + 0.95 * mean)
    torch.testing.assert_close(second.flatten(1), expected, rtol=1e-3, atol=1e-6)
    without = -size * orthogonalised(mean)
    assert (second.flatten(1) - without).abs().max() > 1e-4, "the comparison is blind"


@pytest.mark.parametrize("shape", OTHERS)
def test_what_is_no_large_kernel_follows_adam(shape: tuple[int, ...]) -> None:
    def walk(make: type[torch.optim.Optimizer], **options: object) -> torch.Tensor:
        parameter = nn.Parameter(random(shape))
        moved(make([parameter], lr=0.01, **options), parameter, 5)
        return parameter.detach()

    ours = walk(Muon)
    torch.testing.assert_close(ours, walk(torch.optim.Adam, betas=(0.9, 0.99)), rtol=1e-6, atol=1e-7)
    with pytest.raises(AssertionError):
        torch.testing.assert_close(ours, walk(torch.optim.Adam), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("shape", [KERNELS[0], OTHERS[0]])
def test_the_state_goes_on_bit_for_bit_after_a_checkpoint(shape: tuple[int, ...], tmp_path: Path) -> None:
    parameter = nn.Parameter(random(shape))
    whole = Muon([parameter], 0.01)
    moved(whole, parameter, 3)
    torch.save({"state": whole.state_dict(), "parameter": parameter.detach()}, tmp_path / "checkpoint.pt")
    moved(whole, parameter, 3, first=3)
    loaded = torch.load(tmp_path / "checkpoint.pt", weights_only=True)

    def resumed(with_state: bool) -> torch.Tensor:
        again = nn.Parameter(loaded["parameter"].clone())
        optimizer = Muon([again], 0.01)
        if with_state:
            optimizer.load_state_dict(copy.deepcopy(loaded["state"]))
        moved(optimizer, again, 3, first=3)
        return again.detach()

    assert torch.equal(resumed(with_state=True), parameter.detach())
    assert not torch.equal(resumed(with_state=False), parameter.detach())


def test_parameters_without_a_gradient_stay() -> None:
    used, unused = nn.Parameter(random(KERNELS[0])), nn.Parameter(random(OTHERS[0]))
    moved(Muon([used, unused], 0.01), used, 2)
    assert torch.equal(unused.detach(), random(OTHERS[0]))


def test_a_run_takes_the_optimizer_that_it_names(shards: Path, tmp_path: Path) -> None:
    weights = {}
    for name, kind in (("muon", Muon), ("adam", torch.optim.Adam)):
        run = Run(tiny(shards, tmp_path, optimizer=name), CPU)
        assert type(run.optimizer) is type(make_optimizer(name, run.network.parameters(), 1e-3)) is kind
        run.train_step()
        weights[name] = run.network.get_parameter("layers.0.weight").detach()
    assert not torch.equal(weights["muon"], weights["adam"])
    with pytest.raises(ConfigError, match="--optimizer: found 'sgd', expected one of muon, adam"):
        tiny(shards, tmp_path, optimizer="sgd")


def test_the_option_names_the_optimizer() -> None:
    def config(*options: str) -> TrainConfig:
        common = ["train", "--shards", "s", "--out", "o", "--steps", "1"]
        return cli._train_config(cli._parser().parse_args([*common, *options]))

    assert config().optimizer == TrainConfig("", "", 1).optimizer == "muon"
    assert config("--optimizer", "adam").optimizer == "adam"
    with pytest.raises(SystemExit):
        config("--optimizer", "sgd")
