"""LPIPS (Zhang et al. 2018) with the AlexNet backbone, from weights files that the user has.

The backbone file is torchvision's AlexNet state dict (keys `features.0.weight` ...), the linear file that of the
authors' version 0.1 (keys `lin0.model.1.weight` ...); both as `torch.save` wrote them or as safetensors.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from holod_training.config import ConfigError
from holod_training.srgb import srgb_encoded

# (index in torchvision's `features`, inputs, outputs, kernel, stride, padding, whether a 3x3 pooling by 2 comes before)
CONVOLUTIONS = (
    (0, 3, 64, 11, 4, 2, False),
    (3, 64, 192, 5, 1, 2, True),
    (6, 192, 384, 3, 1, 1, True),
    (8, 384, 256, 3, 1, 1, False),
    (10, 256, 256, 3, 1, 1, False),
)
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
SMALLEST_PX = 63


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Raises ConfigError for a file that cannot be read as a dictionary of tensors."""
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, SafetensorError, pickle.UnpicklingError) as error:
        raise ConfigError(f"{path}: not a readable file of tensors ({error})") from error
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: found {type(found).__name__}, expected a state dict")
    return found


class Lpips(nn.Module):
    """Distance of pictures: [N, 3, H, W] linear light, twice, to [N]; 0 for equal ones. Nothing in it is trained.

    Raises ConfigError for a tensor that is missing or of another shape.
    """

    def __init__(self, backbone: Path, linear: Path) -> None:
        super().__init__()
        features, lines = read_tensors(backbone), read_tensors(linear)
        for stage, (index, inputs, outputs, kernel, *_) in enumerate(CONVOLUTIONS):
            weight = f"features.{index}.weight", (outputs, inputs, kernel, kernel)
            self._take(f"weight_{stage}", backbone, features, *weight)
            self._take(f"bias_{stage}", backbone, features, f"features.{index}.bias", (outputs,))
            self._take(f"linear_{stage}", linear, lines, f"lin{stage}.model.1.weight", (1, outputs, 1, 1))
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None])

    def _take(self, name: str, path: Path, tensors: dict[str, Tensor], key: str, shape: tuple[int, ...]) -> None:
        found = tuple(tensors[key].shape) if key in tensors else "nothing"
        if found != shape:
            raise ConfigError(f"{path}: {key}: found {found}, expected a tensor of shape {shape}")
        self.register_buffer(name, tensors[key].float())

    def _features(self, light: Tensor) -> list[Tensor]:
        """Each stage's map, of unit length over channels."""
        x = (2 * srgb_encoded(light) - 1 - self.get_buffer("shift")) / self.get_buffer("scale")
        result = []
        for stage, (*_, stride, padding, pooled) in enumerate(CONVOLUTIONS):
            x = F.max_pool2d(x, 3, stride=2) if pooled else x
            weight, bias = self.get_buffer(f"weight_{stage}"), self.get_buffer(f"bias_{stage}")
            x = F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
            result.append(x / (x.square().sum(dim=1, keepdim=True) + 1e-20).sqrt())
        return result

    @staticmethod
    def open(
        backbone: Path | str | None, linear: Path | str | None, device: torch.device | str = "cpu"
    ) -> Lpips | None:
        """None where neither file is named. Raises ConfigError for one without the other."""
        if backbone and linear:
            return Lpips(Path(backbone), Path(linear)).to(device)
        if backbone or linear:
            raise ConfigError("LPIPS: found one of its two weights files, expected backbone and linear, or neither")
        return None

    def forward(self, picture: Tensor, target: Tensor) -> Tensor:
        if min(picture.shape[-2:]) < SMALLEST_PX:
            raise ConfigError(
                f"LPIPS: found pictures of {tuple(picture.shape[-2:])} px, expected {SMALLEST_PX} at least"
            )
        total = picture.new_zeros(len(picture))
        for stage, (p, t) in enumerate(zip(self._features(picture), self._features(target), strict=True)):
            total = total + F.conv2d((p - t).square(), self.get_buffer(f"linear_{stage}")).mean(dim=(1, 2, 3))
        return total
