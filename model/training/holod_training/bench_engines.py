"""One weights file in holod and in PyTorch, in turn on one machine: from picture, depth and pupil to panel levels."""

from __future__ import annotations

import copy
import dataclasses
import datetime
import importlib.metadata
import json
import logging
import os
import platform
import re
import shlex
import statistics
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from holod_training.expected_stack import ExpectedStackNetwork
from holod_training.export import check_takes_pictures, load_weights
from holod_training.network import DirectNetwork, FieldNetwork
from holod_training.optics import double_phase_phasors, levels, upsample_half_band

WHOLE, NETS = "whole frame", "networks only"
HOLOD, EAGER = "holod", "PyTorch, eager"
HALF = "PyTorch, channels-last, the networks in half precision"
# Of which `holod bench` times frames, too.
PUPIL_MM = 3.0
LEVELS = 256
# Levels of two engines that do the same are one apart where rounding decides, and farther where a phase is undefined.
LEVELS_APART, SHARE_FARTHER_APART = 1, 1e-3
# Outputs of the nets, over the largest one: in single precision, and in half.
NETS_TOLERANCE, HALF_NETS_TOLERANCE = 1e-3, 0.05
# The same of levels of a network in half precision: those whose phase is nearly undefined are anywhere.
HALF_LEVELS_APART, HALF_SHARE_FARTHER_APART = 4, 0.1
REASON_CHARACTERS = 160
# With more of the CPUs' time taken by other programs, threads that wait for each other wait for those.
QUIET_SHARE = 0.05


class BenchError(ValueError):
    """Engines that cannot be compared; the message says what was found and what to do."""


@dataclass(frozen=True)
class Plan:
    """What is timed: `calls` frames of each engine in each of `rounds`, the engines in turn."""

    weights: Path
    holod: Path
    width: int
    height: int
    rounds: int
    calls: int
    device: torch.device
    # That of holod on a GPU.
    backend: str = "auto"

    def __post_init__(self) -> None:
        if self.width < 2 or self.height < 2 or self.width % 2 or self.height % 2:
            raise BenchError(f"--resolution: found {self.width}x{self.height}, expected even numbers, as the trainer")
        if self.rounds < 1 or self.calls < 1:
            raise BenchError(f"found {self.rounds} rounds of {self.calls} calls, expected at least one of each")

    @property
    def resolution(self) -> str:
        return f"{self.width}x{self.height}"


@dataclass(frozen=True)
class HolodTimes:
    """Medians of one `holod bench`; the layers' where it knows them, threads where it is on a CPU."""

    renderer: str
    frame_ms: float
    layers_ms: float | None
    threads: int | None


@dataclass(frozen=True)
class Row:
    """One engine at one part of the work: the median of each round, or why there is none."""

    part: str
    engine: str
    rounds_ms: tuple[float, ...] = ()
    skipped: str | None = None

    @property
    def median_ms(self) -> float:
        return statistics.median(self.rounds_ms)

    def times_of(self, other: Row) -> float:
        """How many times the other's time it takes: the median over rounds, each compared with itself alone."""
        return statistics.median(own / its for own, its in zip(self.rounds_ms, other.rounds_ms, strict=True))


class PanelLevels(nn.Module):
    """A network and what follows it, to the levels of an 8-bit panel."""

    def __init__(self, network: FieldNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, amplitude: Tensor, depth: Tensor, pupil_mm: Tensor) -> Tensor:
        """amplitude [1, 3, H, W], depth [1, H, W], pupil_mm [1] -> uint8 [1, 3, H, W]."""
        config = self.network.config
        field = self.network(amplitude, depth, pupil_mm)
        if config.grid == "half-band":
            field = upsample_half_band(field)
        return levels(double_phase_phasors(field, config.amplitude_constant).angle()).to(torch.uint8)


class HalfNet(nn.Module):
    """A net in half precision and channels-last, between inputs and outputs in single."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = copy.deepcopy(net).half().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, x: Tensor, told: Tensor, trace: dict[str, Tensor] | None = None) -> Tensor:
        output: Tensor = self.net(_channels_last(x.half()), told.half(), trace)
        return output.float()


class Nets(nn.Module):
    """The convolution nets of a network alone, each with an input of its own."""

    def __init__(self, nets: list[nn.Module]) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)

    def forward(self, told: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(net(x, told) for net, x in zip(self.nets, inputs, strict=True))


# Does the work once, and gives its levels or its nets' outputs.
Work = Callable[[], tuple[Tensor, ...]]
# Part, engine, and what prepares it; raises whatever a compiler or exporter raises.
Attempt = tuple[str, str, Callable[[], Work]]


def bench_engines(plan: Plan, command: list[str]) -> dict[str, Any]:
    """Times every engine and returns what `markdown` prints. Raises BenchError, WeightsError.

    This process and holod's are kept to as many CPUs as torch has threads.
    """
    with _on_cpus(torch.get_num_threads()) as cpus:
        works = _torch_engines(plan)
        before = _CpuTime.now(cpus)
        rows, renderer = _rows(plan, works)
        others_share = _CpuTime.now(cpus).taken_by_others_since(before)
    return {
        "date": datetime.date.today().isoformat(),
        "machine": _machine(plan.device),
        "threads": torch.get_num_threads(),
        "cpu_share_of_other_programs": others_share,
        "versions": _versions(plan.holod),
        "renderer": renderer,
        "weights": plan.weights.name,
        "resolution": plan.resolution,
        "rounds": plan.rounds,
        "calls": plan.calls,
        "command": shlex.join(command),
        "engines": [_as_json(row, rows) for row in rows],
    }


def _rows(plan: Plan, works: dict[tuple[str, str], Work | str]) -> tuple[list[Row], str]:
    found: dict[tuple[str, str], list[float]] = {key: [] for key, work in works.items() if callable(work)}
    of_holod: list[HolodTimes] = []
    for _ in range(plan.rounds):
        of_holod.append(run_holod(plan, torch.get_num_threads()))
        for key, rounds_ms in found.items():
            work = works[key]
            assert callable(work)
            rounds_ms.append(statistics.median(_calls_ms(work, plan)))
    layers_ms = tuple(times.layers_ms for times in of_holod if times.layers_ms is not None)
    no_layers = None if layers_ms else "its renderer does not tell the layers' times"
    rows = [
        Row(WHOLE, HOLOD, tuple(times.frame_ms for times in of_holod)),
        Row(NETS, HOLOD, layers_ms, no_layers),
    ]
    for (part, engine), work in works.items():
        if callable(work):
            rows.append(Row(part, engine, tuple(found[part, engine])))
        else:
            rows.append(Row(part, engine, skipped=work))
    return sorted(rows, key=lambda row: row.part != WHOLE), of_holod[-1].renderer


def run_holod(plan: Plan, threads: int) -> HolodTimes:
    """One `holod bench` of the plan's calls. Raises BenchError where it fails, or computes on other threads."""
    backend = "cpu" if plan.device.type == "cpu" else plan.backend
    options = ["--weights", str(plan.weights), "--resolution", plan.resolution, "--repeat", str(plan.calls)]
    command = [str(plan.holod), "bench", "--json", "--backend", backend, "--duration", "0s", *options]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise BenchError(f"{plan.holod}: cannot be run ({error}); build it by `cargo build --release`") from error
    if done.returncode != 0:
        raise BenchError(f"{shlex.join(command)}: exit code {done.returncode}: {done.stderr.strip()[-500:]}")
    times = parse_holod(done.stdout)
    if plan.device.type != "cpu" and not times.renderer.startswith("gpu"):
        raise BenchError(f"{plan.holod}: found {times.renderer}, expected a GPU; install its driver, or --device cpu")
    if times.threads not in (None, threads):
        raise BenchError(f"{plan.holod}: computes on {times.threads} threads, expected {threads}: name --threads")
    return times


def parse_holod(text: str) -> HolodTimes:
    """What `holod bench --json` printed. Raises BenchError."""
    try:
        report = json.loads(text)
        layers, ceilings = report["layers"], report["ceilings"]
        return HolodTimes(
            renderer=str(report["renderer"]),
            frame_ms=float(report["frame"]["median_ms"]),
            layers_ms=None if layers is None else float(layers["median_ms"]),
            threads=None if ceilings is None else int(ceilings["threads"]),
        )
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise BenchError(f"not a report of `holod bench --json` ({error!r}); build holod from this tree") from error


@torch.no_grad()
def _torch_engines(plan: Plan) -> dict[tuple[str, str], Work | str]:
    """Each part and engine, with its work or why it cannot do it."""
    network = load_weights(plan.weights).to(plan.device)
    check_takes_pictures(network.config, plan.weights)
    whole = PanelLevels(network).eval()
    generator = torch.Generator().manual_seed(1)
    amplitude = torch.rand(1, 3, plan.height, plan.width, generator=generator).to(plan.device)
    # All depth layers have a share of it.
    depth = torch.linspace(0, 1, plan.width, device=plan.device).expand(1, plan.height, -1).contiguous()
    pupil_mm = torch.tensor([PUPIL_MM], device=plan.device)
    frame = (amplitude, depth, pupil_mm)
    frame_channels_last = (_channels_last(amplitude), depth, pupil_mm)
    nets, seen = _nets(network, frame)
    told = network.told(pupil_mm)
    inputs, inputs_channels_last = (told, *seen), (told, *(_channels_last(x) for x in seen))

    def compiled_nets() -> Work:
        partly = copy.deepcopy(whole)
        for net in _nets_of(partly.network).values():
            net.compile()
        return _work(partly, frame)

    def engines(part: str, module: nn.Module, like: tuple[Tensor, ...], last: tuple[Tensor, ...]) -> list[Attempt]:
        moved = copy.deepcopy(module).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        return [
            (part, EAGER, lambda: _work(module, like)),
            (part, "PyTorch, channels-last", lambda: _work(moved, last)),
            (part, "PyTorch, torch.compile", lambda: _work(torch.compile(module), like)),
            (part, "ONNX Runtime", lambda: _onnx_work(module, like, plan.device)),
        ]

    attempts = engines(WHOLE, whole, frame, frame_channels_last)
    attempts.append((WHOLE, "PyTorch, torch.compile of the networks, the rest eager", compiled_nets))
    attempts += engines(NETS, nets, inputs, inputs_channels_last)
    if plan.device.type == "cuda":
        attempts.append((WHOLE, HALF, lambda: _work(_in_half_precision(whole), frame)))
        attempts.append((NETS, HALF, lambda: _work(_in_half_precision(nets), inputs)))

    works: dict[tuple[str, str], Work | str] = {}
    expected: dict[str, tuple[Tensor, ...]] = {}
    for part, engine, attempt in attempts:
        try:
            with _silence():
                work = attempt()
                found = work()
        except Exception as error:
            works[part, engine] = reason(error)
            continue
        like, half = expected.setdefault(part, found), engine == HALF
        same = levels_agree(found[0], like[0], half) if part == WHOLE else nets_agree(found, like, half)
        works[part, engine] = work if same else f"its results are not those of {EAGER}"
    return works


def _nets(network: FieldNetwork, frame: tuple[Tensor, ...]) -> tuple[Nets, list[Tensor]]:
    """The convolution nets, and what they see of a frame."""
    trace: dict[str, Tensor] = {}
    network(*frame, trace)
    nets = _nets_of(network)
    return Nets(list(nets.values())).eval(), [trace[name] for name in nets]


def _in_half_precision(module: nn.Module) -> nn.Module:
    """A copy of `PanelLevels` or `Nets` whose nets are in half precision."""
    copied = copy.deepcopy(module)
    if isinstance(copied, Nets):
        copied.nets = nn.ModuleList(HalfNet(net) for net in copied.nets)
    elif isinstance(copied, PanelLevels):
        for name in ("lighting", "correction", "layers"):
            if hasattr(copied.network, name):
                setattr(copied.network, name, HalfNet(getattr(copied.network, name)))
    return copied


def _nets_of(network: FieldNetwork) -> dict[str, nn.Module]:
    """The convolution nets by the names under which a trace has their inputs."""
    if isinstance(network, ExpectedStackNetwork):
        return {"lighting.encoded": network.lighting, "correction.encoded": network.correction}
    if isinstance(network, DirectNetwork):
        return {"encoded": network.layers}
    raise BenchError(f"found a {type(network).__name__}, expected a network that the engines run on pictures")


def _channels_last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def _work(module: Callable[..., Any], inputs: tuple[Tensor, ...]) -> Work:
    def work() -> tuple[Tensor, ...]:
        with torch.inference_mode():
            outputs = module(*inputs)
        return outputs if isinstance(outputs, tuple) else (outputs,)

    return work


def _onnx_work(module: nn.Module, inputs: tuple[Tensor, ...], device: torch.device) -> Work:
    """The module in ONNX Runtime. Raises what the exporter and the runtime raise."""
    import onnxruntime

    provider = "CPUExecutionProvider" if device.type == "cpu" else "CUDAExecutionProvider"
    if provider not in onnxruntime.get_available_providers():
        raise BenchError(f"this onnxruntime has no {provider}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "module.onnx"
        torch.onnx.export(module, inputs, path, dynamo=True, external_data=False, verbose=False)
        session = onnxruntime.InferenceSession(str(path), options, providers=[provider])
    names = [each.name for each in session.get_inputs()]
    fed = {name: x.cpu().numpy() for name, x in zip(names, inputs, strict=True)}
    return lambda: tuple(torch.from_numpy(output) for output in session.run(None, fed))


def _calls_ms(work: Work, plan: Plan) -> list[float]:
    """Milliseconds of each call, after one that warms up."""

    def finished() -> float:
        if plan.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    taken = []
    for _ in range(plan.calls + 1):
        began = finished()
        work()
        taken.append(1e3 * (finished() - began))
    return taken[1:]


def levels_agree(found: Tensor, expected: Tensor, half: bool = False) -> bool:
    """Whether two frames of levels are one apart at most, round the circle, at all but a few pixels; or where the
    networks of one are in half precision, a few apart."""
    if found.shape != expected.shape:
        return False
    apart = torch.remainder(found.cpu().int() - expected.cpu().int(), LEVELS)
    apart = torch.minimum(apart, LEVELS - apart)
    most_apart, most = (HALF_LEVELS_APART, HALF_SHARE_FARTHER_APART) if half else (LEVELS_APART, SHARE_FARTHER_APART)
    return (apart > most_apart).float().mean().item() <= most


def nets_agree(found: tuple[Tensor, ...], expected: tuple[Tensor, ...], half: bool = False) -> bool:
    """Whether all outputs of nets are the same but for rounding, of those of one in half precision or not."""
    tolerance = HALF_NETS_TOLERANCE if half else NETS_TOLERANCE

    def agree(one: Tensor, other: Tensor) -> bool:
        one, other = one.cpu(), other.cpu()
        return one.shape == other.shape and bool((one - other).abs().max() <= tolerance * other.abs().max())

    return len(found) == len(expected) and all(map(agree, found, expected))


def reason(error: BaseException) -> str:
    """The first line of what an error goes back to, for a table."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = re.sub(r"\x1b\[\d+m", "", str(error)).strip().splitlines()
    text = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
    return text if len(text) <= REASON_CHARACTERS else text[: REASON_CHARACTERS - 1] + "…"


@contextmanager
def _silence() -> Iterator[None]:
    """Compilers and exporters warn of much, and what fails is said in the table."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


@contextmanager
def _on_cpus(count: int) -> Iterator[set[int]]:
    """Keeps all threads of this process, and processes that it starts, to the first `count` of its CPUs: these."""
    before = os.sched_getaffinity(0)
    if count > len(before):
        raise BenchError(f"--threads: found {count}, expected at most the {len(before)} CPUs that there are")

    def keep_to(cpus: set[int]) -> None:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setaffinity(int(thread.name), cpus)

    cpus = set(sorted(before)[:count])
    keep_to(cpus)
    try:
        yield cpus
    finally:
        keep_to(before)


def busy_s(proc_stat: str, cpus: set[int], ticks_per_s: int) -> float:
    """Seconds that some CPUs were busy, by the text of /proc/stat: all but idle, waiting for disks, and guests, which
    are counted among the others."""
    of_cpu = {}
    for line in proc_stat.splitlines():
        name, *ticks = line.split()
        if re.fullmatch(r"cpu\d+", name):
            user, nice, system, _idle, _iowait, irq, softirq, steal = map(int, ticks[:8])
            of_cpu[int(name[3:])] = user + nice + system + irq + softirq + steal
    return sum(of_cpu[cpu] for cpu in cpus) / ticks_per_s


@dataclass(frozen=True)
class _CpuTime:
    """Seconds so far: the clock's times the CPUs, when these were busy, and what this process and its children took."""

    available: float
    busy: float
    own: float

    @staticmethod
    def now(cpus: set[int]) -> _CpuTime:
        busy = busy_s(Path("/proc/stat").read_text(), cpus, os.sysconf("SC_CLK_TCK"))
        return _CpuTime(time.monotonic() * len(cpus), busy, sum(os.times()[:4]))

    def taken_by_others_since(self, before: _CpuTime) -> float:
        """The share of the CPUs' time, 0 to 1: what engines lose to it differs, so that their ratios say little."""
        others = (self.busy - before.busy) - (self.own - before.own)
        return min(max(others / (self.available - before.available), 0.0), 1.0)


def _machine(device: torch.device) -> str:
    cpuinfo = Path("/proc/cpuinfo").read_text()
    named = re.search(r"^model name\s*: (.*)$", cpuinfo, re.MULTILINE)
    cpu = named[1].strip() if named else platform.machine()
    return cpu if device.type == "cpu" else f"{torch.cuda.get_device_name(device)}, {cpu}"


def _versions(holod: Path) -> list[str]:
    versions = [subprocess.run([holod, "--version"], capture_output=True, text=True, check=False).stdout.strip()]
    for package in ("torch", "onnxruntime"):
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _as_json(row: Row, rows: list[Row]) -> dict[str, Any]:
    if row.skipped is not None:
        return {"part": row.part, "engine": row.engine, "skipped": row.skipped}
    holod = next(other for other in rows if (other.part, other.engine) == (row.part, HOLOD))
    return {
        **{key: value for key, value in dataclasses.asdict(row).items() if key != "skipped"},
        "median_ms": row.median_ms,
        "times_holod": None if holod.skipped is not None else row.times_of(holod),
    }


def markdown(result: dict[str, Any]) -> str:
    """The table, and on what, when and by which command it was measured."""
    engines = result["engines"]
    warning = ""
    if result["cpu_share_of_other_programs"] > QUIET_SHARE:
        warning = ". **That is no quiet machine: the ratios below cannot be relied on**"
    lines = [
        f"{result['resolution']}, `{result['weights']}`, {result['machine']}, {result['threads']} threads, "
        f"{result['date']}; holod by {result['renderer']}; {', '.join(result['versions'])}. Medians of "
        f"{result['rounds']} rounds of {result['calls']} frames each, the engines in turn; other programs took "
        f"{result['cpu_share_of_other_programs']:.0%} of the CPUs' time{warning}:",
        "",
        "```",
        result["command"],
        "```",
        "",
        "| | engine | ms | lowest and highest round | times holod's |",
        "|---|---|---:|---:|---:|",
    ]
    for row in engines:
        if "skipped" in row:
            continue
        least, most = min(row["rounds_ms"]), max(row["rounds_ms"])
        times = "" if row["times_holod"] is None else f"{row['times_holod']:.2f}"
        lines.append(
            f"| {row['part']} | {row['engine']} | {row['median_ms']:.1f} | {least:.1f} to {most:.1f} | {times} |"
        )
    skipped = [row for row in engines if "skipped" in row]
    if skipped:
        lines += ["", "Not to be had:", ""]
        lines += [f"- {row['part']}, {row['engine']}: {row['skipped']}" for row in skipped]
    return "\n".join(lines) + "\n"
