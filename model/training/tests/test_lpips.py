"""Against torchvision's AlexNet with random weights: the real ones are the user's."""

from pathlib import Path

import pytest
import torch
import torchvision
from safetensors.torch import save_file

from holod_training.config import ConfigError
from holod_training.lpips import Lpips


def random_lpips_files(folder: Path) -> tuple[Path, Path]:
    g = torch.Generator().manual_seed(6)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    backbone, linear = {}, {}
    for stage, (index, shape) in enumerate(shapes.items()):
        bound = (3 / (shape[1] * shape[2] * shape[3])) ** 0.5
        backbone[f"features.{index}.weight"] = (2 * torch.rand(shape, generator=g) - 1) * 2 * bound
        backbone[f"features.{index}.bias"] = (2 * torch.rand(shape[0], generator=g) - 1) * 0.1
        linear[f"lin{stage}.model.1.weight"] = torch.rand(1, shape[0], 1, 1, generator=g)
    torch.save(backbone, folder / "alexnet.pth")
    save_file(linear, folder / "linear.safetensors")
    return folder / "alexnet.pth", folder / "linear.safetensors"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return random_lpips_files(tmp_path_factory.mktemp("lpips"))


def test_distance_is_that_of_torchvisions_features(files: tuple[Path, Path]) -> None:
    g = torch.Generator().manual_seed(1)
    picture, target = torch.rand(2, 2, 3, 64, 80, generator=g)
    tensors, lines = torch.load(files[0]), Lpips(*files)
    with torch.device("meta"):
        features = torchvision.models.alexnet(weights=None).features
    stages = {k.removeprefix("features."): v for k, v in tensors.items()}
    features.load_state_dict(stages, assign=True)

    def maps(light: torch.Tensor) -> list[torch.Tensor]:
        encoded = torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        x = (encoded * 2 - 1 - torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1)) / torch.tensor(
            [0.458, 0.448, 0.450]
        ).view(3, 1, 1)
        found = []
        for index, layer in enumerate(features):
            x = layer(x)
            if index in (1, 4, 7, 9, 11):
                found.append(torch.nn.functional.normalize(x, dim=1))
        return found

    with torch.no_grad():
        expected = torch.zeros(2)
        for stage, (p, t) in enumerate(zip(maps(picture), maps(target), strict=True)):
            weight = lines.get_buffer(f"linear_{stage}")[0]
            expected += ((p - t).square() * weight).sum(dim=1).mean(dim=(1, 2))
        found = lines(picture, target)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    assert (expected > 0.01).all() and abs(float(expected[0] - expected[1])) > 1e-4


def test_equal_pictures_are_zero_apart_and_gradients_are_finite_in_the_dark(files: tuple[Path, Path]) -> None:
    lpips = Lpips(*files)
    picture = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(2))
    assert lpips(picture, picture) == 0
    dark = torch.zeros(1, 3, 64, 64, requires_grad=True)
    lpips(dark, picture).sum().backward()
    assert torch.isfinite(dark.grad).all()
    assert not list(lpips.parameters())


def test_files_that_do_not_fit_are_named(files: tuple[Path, Path], tmp_path: Path) -> None:
    backbone, linear = files
    with pytest.raises(ConfigError, match=r"linear\.safetensors: features\.0\.weight: found nothing"):
        Lpips(linear, backbone)
    wrong = torch.load(backbone)
    wrong["features.6.bias"] = torch.zeros(5)
    torch.save(wrong, tmp_path / "wrong.pth")
    with pytest.raises(ConfigError, match=r"features\.6\.bias: found \(5,\), expected a tensor of shape \(384,\)"):
        Lpips(tmp_path / "wrong.pth", linear)
    (tmp_path / "noise.pth").write_bytes(b"noise")
    with pytest.raises(ConfigError, match="not a readable file of tensors"):
        Lpips(tmp_path / "noise.pth", linear)
    with pytest.raises(ConfigError, match="63 at least"):
        Lpips(backbone, linear)(torch.rand(1, 3, 60, 64), torch.rand(1, 3, 60, 64))
