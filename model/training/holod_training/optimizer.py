"""Muon: steps that move every direction of a kernel alike."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

OPTIMIZERS = ("muon", "adam")
FEWEST_OUTPUTS = 8
NEWTON_SCHULZ_STEPS = 5
NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
# Makes the root mean square of an orthogonal step that of a usual step of Adam at the same learning rate.
STEP_RMS = 0.2


def orthogonalised(matrix: Tensor) -> Tensor:
    """Nearly U·Vᵀ of matrix = U·Σ·Vᵀ: singular values end between 0.7 and 1.2, but for those far below the largest."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide / wide.norm().clamp_min(1e-7)
    a, b, c = NEWTON_SCHULZ
    for _ in range(NEWTON_SCHULZ_STEPS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x if wide is matrix else x.T


class Muon(Optimizer):
    """Momentum, then the nearest orthogonal matrix, for each convolution kernel [outputs, inputs · 9] (Jordan et al.
    2024, size of a step as by Liu et al. 2025); Adam for biases, dense layers and kernels of fewer than 8 outputs."""

    def __init__(
        self,
        parameters: Iterable[Tensor],
        lr: float,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(parameters, {"lr": lr, "momentum": momentum, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                if parameter.dim() == 4 and parameter.shape[0] >= FEWEST_OUTPUTS:
                    self._orthogonal_step(parameter, group)
                else:
                    self._adam_step(parameter, group)

    def _orthogonal_step(self, parameter: Tensor, group: dict[str, Any]) -> None:
        gradient, keep = parameter.grad, group["momentum"]
        assert gradient is not None
        state = self.state[parameter]
        if "mean" not in state:
            state["mean"] = torch.zeros_like(parameter)
        mean = state["mean"]
        mean.lerp_(gradient, 1 - keep)
        direction = orthogonalised(gradient.lerp(mean, keep).flatten(1))
        size = STEP_RMS * max(direction.shape) ** 0.5
        parameter.add_(direction.view_as(parameter), alpha=-group["lr"] * size)

    def _adam_step(self, parameter: Tensor, group: dict[str, Any]) -> None:
        gradient = parameter.grad
        assert gradient is not None
        of_mean, of_square = group["betas"]
        state = self.state[parameter]
        if "mean" not in state:
            state |= {"step": 0, "mean": torch.zeros_like(parameter), "square": torch.zeros_like(parameter)}
        state["step"] += 1
        mean, square = state["mean"], state["square"]
        mean.lerp_(gradient, 1 - of_mean)
        square.lerp_(gradient.square(), 1 - of_square)
        spread = (square / (1 - of_square ** state["step"])).sqrt_().add_(group["eps"])
        parameter.addcdiv_(mean, spread, value=-group["lr"] / (1 - of_mean ** state["step"]))


def make_optimizer(name: str, parameters: Iterable[Tensor], lr: float) -> Optimizer:
    """`name` is one of OPTIMIZERS."""
    return Muon(parameters, lr) if name == "muon" else torch.optim.Adam(parameters, lr)
