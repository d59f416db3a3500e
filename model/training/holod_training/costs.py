"""What a method costs: run time in this very run, parameters, operations a pixel."""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from holod_training.judging import Method, network_field
from holod_training.shards import Stack


def _fft_operations(shape: tuple[int, ...], dim: list[int], *_: Any, **__: Any) -> int:
    """5·N·log2 N real operations a complex transform of N points (Cooley and Tukey's usual count)."""
    points = math.prod(shape[d] for d in dim)
    return round(math.prod(shape) / points * 5 * points * math.log2(points))


@torch.no_grad()
def network_cost(network: FieldNetwork, stack: Stack) -> dict[str, Any]:
    """Parameters, and floating-point operations for each of the picture's pixels: convolutions and matrix products
    (two for each multiply-add) and FFTs; what merely moves or scales numbers is not counted."""
    counter = FlopCounterMode(display=False, custom_mapping={torch.ops.aten._fft_c2c: _fft_operations})
    with counter:
        network_field(network, stack, stack.pupil_mm)
    return {
        "parameters": sum(p.numel() for p in network.parameters()),
        "operations_per_px": counter.get_total_flops() / stack.depth.numel(),
    }


def time_methods(methods: list[Method], stack: Stack, calls: int) -> list[dict[str, Any]]:
    """Every method on one scene at one pupil: the median of its calls, in turn with the others', on one CPU thread.

    On the CPU the process's own time is taken, which other programs do not stretch; on a GPU wall time. A slow method
    (`scenes` set) is called once.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        seconds: dict[str, list[float]] = {method.name: [] for method in methods}
        for method in methods:
            if method.scenes is None:
                method.field(stack, stack.pupil_mm)
        for call in range(calls):
            for method in methods:
                if method.scenes is None or call == 0:
                    seconds[method.name].append(_seconds(method, stack))
    finally:
        torch.set_num_threads(threads)
    ours = statistics.median(seconds[methods[0].name])
    return [
        {
            "method": name,
            "seconds": statistics.median(of),
            "calls": len(of),
            "ratio_to_ours": statistics.median(of) / ours,
        }
        for name, of in seconds.items()
    ]


def _seconds(method: Method, stack: Stack) -> float:
    if not stack.depth.is_cuda:
        began = time.process_time()
        method.field(stack, stack.pupil_mm)
        return time.process_time() - began
    torch.cuda.synchronize()
    began = time.perf_counter()
    method.field(stack, stack.pupil_mm)
    torch.cuda.synchronize()
    return time.perf_counter() - began
