"""How far the adjustable layers reach, by depth and pupil (the paper's figure 13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from holod_training.judging import Bench, network_field
from holod_training.network import AdjustableLayer, FieldNetwork
from holod_training.shards import Shard, Stack

DEPTH_INTERVALS = 5


@torch.no_grad()
def offset_statistics(network: FieldNetwork, shards: list[Shard], bench: Bench) -> list[dict[str, Any]]:
    """Mean and standard deviation of the taps' offset lengths, in panel pixels, over pixels, taps and scenes.

    One row for each adjustable layer, pupil and fifth of the depth range that any pixel lies in.
    """
    sums: dict[tuple[str, float, int], Tensor] = {}
    for shard in shards:
        for index, pupil in enumerate(shard.pupils_mm):
            stack = bench.read(shard, index)
            for name, offsets in _offsets(network, stack).items():
                height, width = offsets.shape[-2:]
                scale = stack.depth.shape[-1] / width
                length = scale * torch.linalg.vector_norm(offsets[0].unflatten(0, (-1, 2)), dim=1).double()
                depth = F.adaptive_avg_pool2d(stack.depth[None], (height, width))[0]
                interval = (depth * DEPTH_INTERVALS).long().clamp(0, DEPTH_INTERVALS - 1)
                for k in range(DEPTH_INTERVALS):
                    chosen = length[:, interval == k].flatten().cpu()
                    part = torch.stack((torch.ones_like(chosen).sum(), chosen.sum(), chosen.square().sum()))
                    sums[name, pupil, k] = sums.get((name, pupil, k), torch.zeros_like(part)) + part
    optics = bench.optics
    rows = []
    for (name, pupil, k), (count, total, squares) in sums.items():
        if count > 0:
            mean = float(total / count)
            rows.append(
                {
                    "layer": name,
                    "pupil_mm": pupil,
                    "from_dpt": round(optics.dioptres(k / DEPTH_INTERVALS), 4),
                    "to_dpt": round(optics.dioptres((k + 1) / DEPTH_INTERVALS), 4),
                    "mean_px": mean,
                    "deviation_px": max(0.0, float(squares / count) - mean**2) ** 0.5,
                }
            )
    return rows


def _offsets(network: FieldNetwork, stack: Stack) -> dict[str, Tensor]:
    """What each adjustable layer's g_o predicts for one scene, [1, 18, h, w], by the layer's name."""
    found: dict[str, Tensor] = {}

    def keep(name: str) -> Callable[[nn.Module, tuple[Tensor, ...]], None]:
        def hook(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
            assert isinstance(module, AdjustableLayer)
            found[name] = module.offsets(*inputs)

        return hook

    handles = [
        module.register_forward_pre_hook(keep(name))
        for name, module in network.named_modules()
        if isinstance(module, AdjustableLayer)
    ]
    try:
        network_field(network, stack, stack.pupil_mm)
    finally:
        for handle in handles:
            handle.remove()
    return found
