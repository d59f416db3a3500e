"""What a method costs: run time in this very run, parameters, operations a pixel."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from holod_training.config import NetworkConfig
from holod_training.judging import Method
from holod_training.network import FieldNetwork
from holod_training.shards import Stack
from holod_training.variants import build_network

COUNTED_SIZE_PX = 512


def operations_per_pixel(config: NetworkConfig) -> float:
    """Floating-point operations a panel pixel of one frame, counted on 512x512: two a product and sum of convolutions
    and matrices, 8 a bilinear tap, 5·log2(n) a value of a complex FFT of n values and half of it of a real one."""

    def fft(share: float) -> Any:
        def count(shape: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
            largest = max(shape, out_shape, key=math.prod)
            return int(share * 5 * math.prod(largest) * math.log2(largest[-1] * largest[-2]))

        return count

    def taps(shape: Any, *_: Any, out_shape: Any = None, **__: Any) -> int:
        return 8 * math.prod(out_shape)

    aten = torch.ops.aten
    mapping = {
        aten._fft_c2c: fft(1),
        aten._fft_r2c: fft(0.5),
        aten._fft_c2r: fft(0.5),
        aten.grid_sampler_2d: taps,
    }
    size = COUNTED_SIZE_PX
    with torch.device("meta"):
        # Specialists choose by the pupil's value, which meta tensors do not have; one of them runs.
        network = build_network(dataclasses.replace(config, specialists_mm=()))
        images = (config.planes, 3) if config.architecture == "focal-stack" else (3,)
        amplitude, depth = torch.zeros(1, *images, size, size), torch.zeros(1, size, size)
        pupil = torch.zeros(1)
    with FlopCounterMode(display=False, custom_mapping=mapping) as counter, torch.no_grad():
        network(amplitude, depth, pupil)
    return counter.get_total_flops() / size**2


@torch.no_grad()
def network_cost(network: FieldNetwork) -> dict[str, Any]:
    """Parameters, and `operations_per_pixel`."""
    return {
        "parameters": sum(p.numel() for p in network.parameters()),
        "operations_per_px": operations_per_pixel(network.config),
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
