"""The training run: a folder with config.json, metrics.jsonl, curves.png, checkpoint.pt and weights.safetensors."""

from __future__ import annotations

import copy
import datetime
import io
import json
import math
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from holod_training.benches import BenchDraw
from holod_training.config import NetworkConfig, OpticsConfig, require
from holod_training.curves import plot_curves
from holod_training.expected_stack import with_refined_stack
from holod_training.export import (
    WeightsError,
    check_folder,
    load_weights,
    read_checkpoint,
    read_metadata,
    save_weights,
    write_beside,
)
from holod_training.foam import REGION_PX
from holod_training.focal_stack import check_focuses
from holod_training.loss import (
    LIGHT_WINDOWS_PX,
    PERCEPTUAL_PLANES,
    WINDOW_PX,
    LossWeights,
    focus_loss,
    inner,
    option_of,
)
from holod_training.lpips import SMALLEST_PX, Lpips
from holod_training.metrics import Judgement, JudgementError, judge, psnr_db
from holod_training.network import FieldNetwork
from holod_training.optics import Eye, HalfBandEye, coc_px, shown_by_panel
from holod_training.optimizer import OPTIMIZERS, make_optimizer
from holod_training.rivals import flat_oracle
from holod_training.sampling import AugmentConfig, Sampler
from holod_training.shards import Shard, Stack, check_border, check_pupils, open_held_out
from holod_training.variants import build_network, network_amplitude

VALIDATION_PUPILS_MM = (2.0, 3.0, 4.0)
PRECISIONS = ("f32", "bf16")
# By which factor scenes may lie outside what a network is told of.
TOLD = 1.01
PERCEPTUAL_STREAM = 2
# What of TrainConfig only programs can set: errors name it by its key.
WITHOUT_OPTION = ("final_rate_share", "gradient_clip", "ema_decay", "log_every", "checkpoint_every", "rescan_every")


# What may be another when a run is resumed: where it lies, how long and how carefully it goes on, when it is looked at.
CHANGED_ON_RESUMING = (
    *("shards", "validation", "out", "initial_weights"),
    *("steps", "learning_rate", "final_rate_share", "warm_up_steps", "gradient_clip", "precision"),
    *("log_every", "validate_every", "checkpoint_every", "rescan_every"),
    *("validation_scenes", "validation_border_px", "stop_below_slope", "network.amplitude_constant"),
)


class TrainingError(RuntimeError):
    """A run that must not go on; the message says why and what to do."""


@dataclass(frozen=True)
class TrainConfig:
    shards: str
    out: str
    steps: int
    validation: str | None = None
    network: NetworkConfig = field(default_factory=NetworkConfig)
    # Each crop on a random bench; without, on that which its scene was rendered for.
    benches: BenchDraw | None = None
    loss: LossWeights = field(default_factory=LossWeights)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    crop: int = 160
    border_px: int = 24
    validation_border_px: int = 24
    batch: int = 1
    learning_rate: float = 2e-3
    optimizer: str = "muon"
    final_rate_share: float = 0.03
    warm_up_steps: int = 30
    gradient_clip: float = 1.0
    ema_decay: float = 0.999
    seed: int = 1
    log_every: int = 50
    validate_every: int = 1000
    checkpoint_every: int = 500
    rescan_every: int = 250
    validation_scenes: int = 8
    stop_below_slope: float = 0.1
    initial_weights: str | None = None
    # bf16: convolutions only; FFTs, taps of deformable layers and the loss stay f32.
    precision: str = "f32"
    # The loss is of what a panel shows after double phase with this constant; without, of the field itself.
    double_phase: float | None = None
    # A weights file whose pictures the loss compares too, at weight `loss.teacher`.
    teacher: str | None = None
    # Files of LPIPS's weights, see `lpips.py`; both or none.
    lpips_backbone: str | None = None
    lpips_linear: str | None = None

    def __post_init__(self) -> None:
        """Raises ConfigError for what no run can do."""
        periods = ("log_every", "validate_every", "checkpoint_every", "rescan_every")
        for key in ("steps", "batch", "validation_scenes", *periods):
            self._require(key, getattr(self, key) >= 1, "at least 1")
        for key in ("border_px", "validation_border_px", "warm_up_steps"):
            self._require(key, getattr(self, key) >= 0, "at least 0")
        # A half-band grid has a value for each 2x2 pixels.
        self._require("crop", self.crop >= 2 and self.crop % 2 == 0, "an even number of at least 2")
        self._require("border_px", 2 * self.border_px < self.crop, f"less than half the crop of {self.crop} px")
        for least_px, wanted, what in (
            (WINDOW_PX, self.loss.structure, "structure"),
            (REGION_PX, self.loss.foam, "foam"),
            (SMALLEST_PX, self.lpips_backbone or self.lpips_linear, "LPIPS"),
        ):
            least_px += 2 * self.border_px
            about = f"at least {least_px} for {what} within a border of {self.border_px} px"
            self._require("crop", not wanted or self.crop >= least_px, about)
        light_px = min(LIGHT_WINDOWS_PX)
        self._require("crop", not self.loss.light or self.crop >= light_px, f"at least {light_px} for the light")
        one_bench = self.benches is None or self.batch == 1
        self._require("batch", one_bench, "1 where each crop has a bench of its own; torchrun adds more")
        self._require("precision", self.precision in PRECISIONS, f"one of {', '.join(PRECISIONS)}")
        self._require("optimizer", self.optimizer in OPTIMIZERS, f"one of {', '.join(OPTIMIZERS)}")
        self._require("learning_rate", 0 < self.learning_rate < math.inf, "a number above 0")
        self._require("gradient_clip", self.gradient_clip > 0, "a number above 0")
        for key in ("final_rate_share", "ema_decay"):
            self._require(key, 0 <= getattr(self, key) <= 1, "0 to 1")
        self._require("seed", 0 <= self.seed < 2**63, "a whole number from 0 to 2^63 - 1")
        self._require("stop_below_slope", not math.isnan(self.stop_below_slope), "a number")
        constant = self.double_phase
        self._require("double_phase", constant is None or 0 < constant < math.inf, "a number above 0")
        for chance, value in asdict(self.augment).items():
            name = "--faulty-depth" if chance == "faulty_depth" else f"augment.{chance}"
            require(name, value, 0 <= value <= 1, "0 to 1")
        for term, value in asdict(self.loss).items():
            # Sharpness has a logarithm of the floor below it.
            above = term == "coc_floor_px"
            met = 0 < value < math.inf if above else 0 <= value < math.inf
            require(option_of(term), value, met, "a number above 0" if above else "a number of at least 0")

    def _require(self, key: str, met: bool, expected: str) -> None:
        name = key if key in WITHOUT_OPTION else f"--{key.replace('_', '-')}"
        require(name, getattr(self, key), met, expected)

    def learning_rate_at(self, step: int) -> float:
        """Linear warm-up, then cosine to `final_rate_share` of the peak."""
        warm = min(1.0, (step + 1) / max(1, self.warm_up_steps))
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, self.steps))))
        return self.learning_rate * warm * (self.final_rate_share + (1 - self.final_rate_share) * cosine)


def _by_option(config: dict[str, Any]) -> dict[str, Any]:
    """A run's config as config.json has it, by dotted keys; of files that the loss takes, whether there are any."""
    values = json.loads(json.dumps(config))
    found = {key: value for key, value in values.items() if key not in ("network", "loss", "augment")}
    for part in ("network", "loss", "augment"):
        found |= {f"{part}.{key}": value for key, value in values.get(part, {}).items()}
    for path in ("teacher", "lpips_backbone", "lpips_linear"):
        found[path] = "a file" if found.get(path) else "none"
    return found


# Scenes may each have their own focuses: only the eyes of scenes that have the same are worth keeping.
@lru_cache(maxsize=8)
def half_band_eye(
    optics: OpticsConfig, height: int, width: int, focus_dpt: tuple[float, ...], device: str
) -> HalfBandEye:
    return HalfBandEye(optics, height, width, list(focus_dpt), device)


@lru_cache(maxsize=8)
def full_eye(optics: OpticsConfig, height: int, width: int, focus_dpt: tuple[float, ...], device: str) -> Eye:
    return Eye(optics, height, width, list(focus_dpt), device)


def see(field_: Tensor, stack: Stack) -> Tensor:
    """The pictures [K, 3, H, W] that the stack's focuses show of one network output [3, h, w]."""
    height, width = stack.depth.shape
    eye_of = full_eye if field_.shape[-2:] == stack.depth.shape else half_band_eye
    return eye_of(stack.optics, height, width, stack.focus_dpt, str(field_.device)).look(field_, stack.pupil_mm)


class Run:
    """One rank's share of a run; everything that a checkpoint holds is an attribute."""

    def __init__(self, config: TrainConfig, device: torch.device, rank: int = 0, world: int = 1) -> None:
        self.config = config
        self.device = device
        self.rank = rank
        self.world = world
        self.step = 0
        self.seconds = 0.0
        torch.manual_seed(config.seed)
        self.network = build_network(config.network).to(device)
        if config.initial_weights:
            self.network.load_state_dict(self._initial_weights(Path(config.initial_weights)))
        self.teacher = self._teacher(Path(config.teacher)) if config.teacher else None
        self.lpips = Lpips.open(config.lpips_backbone, config.lpips_linear, device)
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = make_optimizer(config.optimizer, self.network.parameters(), config.learning_rate)
        self.trained: nn.Module = self.network
        if world > 1:
            # A batch may have no pupil for one of the specialists.
            unused = bool(config.network.specialists_mm)
            self.trained = DistributedDataParallel(self.network, find_unused_parameters=unused)
        self.sampler = Sampler(
            Path(config.shards),
            config.crop,
            config.seed,
            rank,
            config.augment,
            config.network.specialists_mm,
            self._focal_stacks(),
            config.benches,
        )
        self.validation: list[Shard] = []
        if config.validation:
            self.validation = open_held_out(Path(config.validation), limit=config.validation_scenes)
            check_border(self.validation, config.validation_border_px, "--validation-border-px")
            check_pupils(self.validation, VALIDATION_PUPILS_MM)
            self._check_told(config.validation, self.validation[0].optics)
            for shard in self.validation if config.network.architecture == "focal-stack" else []:
                check_focuses(shard, config.network)

    def _focal_stacks(self) -> list[NetworkConfig]:
        """The networks, of the student and its teacher, that take a focal stack as their input."""
        networks = [self.config.network, *([self.teacher.config] if self.teacher else [])]
        return [network for network in networks if network.architecture == "focal-stack"]

    def _initial_weights(self, path: Path) -> dict[str, Tensor]:
        source = load_weights(path)
        found, wanted = source.state_dict(), self.network.state_dict()
        plain = source.config.architecture == "expected-stack" and not source.config.refined_stack
        if self.config.network.refined_stack and plain and not source.config.specialists_mm:
            found = with_refined_stack(found)
        if {k: v.shape for k, v in found.items()} != {k: v.shape for k, v in wanted.items()}:
            raise TrainingError(
                f"{path}: its network has other layers than this run's; start from the same variant, "
                "or one that refines its stack from the same without"
            )
        return found

    def _teacher(self, path: Path) -> FieldNetwork:
        return load_weights(path).to(self.device).requires_grad_(False)

    def _fields(self, network: nn.Module, config: NetworkConfig, stacks: list[Stack], depths: list[Tensor]) -> Tensor:
        pupils = torch.tensor([s.pupil_mm for s in stacks], device=self.device)
        amplitudes = torch.stack([network_amplitude(config, s) for s in stacks])
        bare = network.module if isinstance(network, DistributedDataParallel) else network
        cast(FieldNetwork, bare).on(stacks[0].optics)
        return network(amplitudes, torch.stack(depths), pupils)

    def _check_benches(self, benches: list[OpticsConfig]) -> None:
        """A network computes with one bench at a time, and is told diffraction within its range alone."""
        if any(bench != benches[0] for bench in benches):
            raise TrainingError(
                f"{self.config.shards}: found scenes of several benches in a batch of {self.config.batch}, expected "
                "one bench: train with `--batch 1` (torchrun adds more), or with scenes of one bench"
            )
        if self.config.benches is None:
            self._check_told(self.config.shards, benches[0])

    def _check_told(self, folder: str, bench: OpticsConfig) -> None:
        trained, found = self.config.network.trained, bench.volume_fresnel_px2
        if trained.outside(bench) > TOLD:
            least, most = trained.volume_fresnel_px2
            raise TrainingError(
                f"{folder}: found scenes of a bench whose diffraction is {min(found):.1f} to "
                f"{max(found):.1f} px2, expected {least:g} to {most:g}, which the network is told: give this bench's "
                "`--volume-fresnel-px2` and `--volume-blur-px` (`holod check` says them), or `--benches any`"
            )

    def _check_blurs(self) -> None:
        """Of a pupil outside its range a network is told the nearest within. Runs that began so go on."""
        (least, most), (low, high) = self.config.network.trained.volume_blur_px, self.sampler.volume_blurs_px()
        if low < least / TOLD or high > most * TOLD:
            raise TrainingError(
                f"{self.config.shards}: found scenes whose pupils blur by {low:.1f} to {high:.1f} px over the depth "
                f"volume, expected {least:g} to {most:g} px, which the network is told: train with `--volume-blur-px "
                f"{min(least, math.floor(low)):g},{max(most, math.ceil(high)):g}`, or with scenes of other `--pupils`"
            )

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.precision == "bf16")

    def _seen(self, field_: Tensor, stack: Stack) -> Tensor:
        """What the loss is of: pictures of the field, or of what a panel shows of it."""
        if self.config.double_phase:
            height, width = stack.depth.shape
            field_ = shown_by_panel(field_, self.config.double_phase, (height, width))
        return see(field_, stack)

    def _taught(self, stacks: list[Stack]) -> list[Tensor] | None:
        """The teacher's pictures; it is given the true depth."""
        if self.teacher is None:
            return None
        config = self.teacher.config
        with torch.no_grad(), self._precision():
            fields = self._fields(self.teacher, config, stacks, [s.depth for s in stacks])
        with torch.no_grad():
            return [self._seen(f, stack) for f, stack in zip(fields, stacks, strict=True)]

    def _perceptual_planes(self, stacks: list[Stack]) -> list[Tensor]:
        """Five random planes of each stack."""
        rng = np.random.default_rng((self.config.seed, self.rank, self.step, PERCEPTUAL_STREAM))
        counts = [len(s.focus_dpt) for s in stacks]
        return [torch.from_numpy(rng.permutation(count)[:PERCEPTUAL_PLANES]).to(self.device) for count in counts]

    def train_step(self) -> dict[str, float]:
        config = self.config
        if self.step % config.rescan_every == 0:
            self.sampler.rescan()
        rate = config.learning_rate_at(self.step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        stacks = [s.to(self.device) for s in self.sampler.draw(self.step, config.batch)]
        self._check_benches([s.optics for s in stacks])
        if self.step == 0:
            self._check_blurs()
        with self._precision():
            fields = self._fields(self.trained, config.network, stacks, [s.given_depth for s in stacks])
        taught = self._taught(stacks)
        perceptual_planes = self._perceptual_planes(stacks)
        parts = []
        for index, (low, stack) in enumerate(zip(fields, stacks, strict=True)):
            picture = self._seen(low, stack)
            blur = coc_px(stack.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)
            parts.append(
                focus_loss(
                    picture,
                    stack.target,
                    blur,
                    config.loss.for_bench(stack.optics, stack.pupil_mm),
                    perceptual_planes[index],
                    self.lpips,
                    taught[index] if taught else None,
                    config.border_px,
                )
            )
        loss = torch.stack([p.total for p in parts]).mean()
        if not torch.isfinite(loss):
            raise TrainingError(f"step {self.step}: the loss is {loss.item()}: {self._likely_cause()}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_clip)
        self.optimizer.step()
        self._average()
        self.step += 1
        n = len(parts)
        return {
            "loss": loss.item(),
            "psnr_db": sum(p.psnr_db for p in parts) / n,
            "slope": sum(p.slope for p in parts) / n,
            "correlation": sum(p.correlation for p in parts) / n,
            "gradient_norm": float(norm),
            **{f"loss_{name}": sum(p.terms[name] for p in parts) / n for name in parts[0].terms},
        }

    def _likely_cause(self) -> str:
        """Of a loss that is no number, and what to do."""
        config = self.config
        for path, network in ((config.initial_weights, self.network), (config.teacher, self.teacher)):
            if self.step == 0 and path and network and not all(p.isfinite().all() for p in network.parameters()):
                return f"{path} has values that are no numbers; name other weights"
        if self.step == 0:
            change = "no step has changed a weight, so it is not the learning rate; lower the loss's weights"
            return f"{change}{self._or_wider()}"
        return self._diverged()

    def _diverged(self) -> str:
        return (
            "the run diverged; lower --learning-rate, lengthen --warm-up-steps, lower the weight of the term that "
            f"grew, loss_* in {Path(self.config.out) / 'metrics.jsonl'}{self._or_wider()}"
        )

    def _or_wider(self) -> str:
        return ", or train with --precision f32" if self.config.precision == "bf16" else ""

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.ema_decay, (1 + self.step) / (10 + self.step))
        for averaged, live in zip(self.average.parameters(), self.network.parameters(), strict=True):
            averaged.lerp_(live, 1 - decay)

    @torch.no_grad()
    def validate(self) -> dict[str, dict[str, float]]:
        """The averaged weights on held-out scenes, before double phase: {"2.0": {psnr_db: ..., flat_oracle_db: ..}}.
        Raises TrainingError where they give no numbers."""
        result = {}
        for wanted in VALIDATION_PUPILS_MM:
            judged = []
            for shard in self.validation:
                stack = shard.read(shard.nearest_pupil(wanted)).to(self.device)
                low = self._fields(self.average, self.config.network, [stack], [stack.depth])[0]
                picture = see(low, stack)
                blur = coc_px(stack.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)
                try:
                    judged.append(judge(picture, stack.target, blur, self.config.validation_border_px, with_ssim=False))
                except JudgementError as error:
                    raise TrainingError(
                        f"step {self.step}: {shard.path} at s = {wanted:g} mm: {error}: {self._diverged()}"
                    ) from error
            result[str(wanted)] = Judgement.mean(judged).known() | self.flat_oracle_db.get(str(wanted), {})
        return result

    @cached_property
    def flat_oracle_db(self) -> dict[str, dict[str, float]]:
        """What the one picture scores that is shown at every focus, on the same scenes."""
        border = self.config.validation_border_px

        def score(stack: Stack) -> float:
            return psnr_db(inner(flat_oracle(stack.target) - stack.target, border).square())

        scores = {
            pupil: [score(shard.read(shard.nearest_pupil(pupil))) for shard in self.validation]
            for pupil in VALIDATION_PUPILS_MM
        }
        return {str(p): {"flat_oracle_db": sum(of) / len(of)} for p, of in scores.items() if of}

    def state(self) -> dict[str, Any]:
        return {
            "format": "holod-checkpoint-1",
            "step": self.step,
            "seconds": self.seconds,
            "processes": self.world,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "shards": self.sampler.names,
            "provenance": self.provenance(),
            "config": json.dumps(asdict(self.config)),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        stored = json.loads(state["config"])
        in_focus = stored["loss"].get("in_focus", 0)
        if "optimizer" not in stored and in_focus:
            raise TrainingError(
                f"{self.config.out}: loss.in_focus: found {in_focus} in a checkpoint from before that weight grew with "
                "the pupil, so that its loss would change; go on with the version that began it, or start again from "
                "its weights with --initial-weights"
            )
        if other := self._other_options(stored):
            raise TrainingError(
                f"{self.config.out}: {'; '.join(other)}; resume with the options that config.json there has, or go on "
                "with others in a folder of its own by --initial-weights"
            )
        # Older checkpoints do not say of how many.
        if (processes := state.get("processes", self.world)) != self.world:
            raise TrainingError(
                f"{self.config.out}: found a checkpoint of {processes} process(es), expected {self.world}: each adds "
                f"crops to every step; resume with `torchrun --nproc-per-node={processes}`, or go on in a folder of "
                "its own by --initial-weights"
            )
        try:
            self.network.load_state_dict(state["network"])
            self.average.load_state_dict(state["average"])
        except RuntimeError as error:
            raise TrainingError(
                f"{self.config.out}: its checkpoint is of a network with other layers than this run's; "
                "resume with the network's options as config.json there has them"
            ) from error
        self.step = state["step"]
        self.seconds = state["seconds"]
        self.optimizer.load_state_dict(state["optimizer"])
        self.sampler.use(state["shards"])

    def _other_options(self, stored: dict[str, Any]) -> list[str]:
        """In what the config of a checkpoint is another than this run's, of all that makes network, loss and crops."""
        # Runs from before there was a choice had Adam; what else a checkpoint does not have was as it is by default.
        usual = {**asdict(TrainConfig("", "", 1)), "optimizer": "adam"}
        default, found, given = (_by_option(config) for config in (usual, stored, asdict(self.config)))
        return [
            f"{key}: found a checkpoint of {found.get(key, default[key])!r}, expected {value!r}"
            for key, value in given.items()
            if key not in CHANGED_ON_RESUMING and found.get(key, default[key]) != value
        ]

    def save_checkpoint(self) -> None:
        buffer = io.BytesIO()
        torch.save(self.state(), buffer)
        write_beside(Path(self.config.out) / "checkpoint.pt", buffer.getvalue())

    def provenance(self) -> dict[str, Any]:
        return {
            "script": "python -m holod_training train",
            "seed": self.config.seed,
            "steps": self.step,
            "of_steps": self.config.steps,
            "hours": round(self.seconds / 3600, 3),
            "scenes": len(self.sampler.shards),
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": f"{self.device.type}, {platform.machine()}, {self.world} x {torch.get_num_threads()} thread(s)",
            "torch": torch.__version__.split("+")[0],
        }


class Interrupt:
    """Whether somebody pressed Ctrl-C."""

    def __init__(self) -> None:
        self.came = False

    @contextmanager
    def heeded(self) -> Iterator[None]:
        """Keeps the first one for the end of the step; the next ends the run at once, as ever. Of several processes,
        which would stop at different steps, and outside the main thread each does. Where it is ignored, as in the
        background of a script, it stays so."""
        before = signal.getsignal(signal.SIGINT)
        is_one_of_several = int(os.environ.get("WORLD_SIZE", "1")) > 1
        is_main_thread = threading.current_thread() is threading.main_thread()
        if is_one_of_several or not is_main_thread or before is signal.SIG_IGN:
            yield
            return

        def come(number: int, frame: object) -> None:
            self.came = True
            signal.signal(signal.SIGINT, before)
            print("ends after this step; Ctrl-C again ends at once", file=sys.stderr)

        signal.signal(signal.SIGINT, come)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


def train(config: TrainConfig, device: torch.device, resume: bool = False) -> Path:
    """Runs to the last step and returns the weights file. Raises TrainingError, ShardError, WeightsError, and
    KeyboardInterrupt after a step with its checkpoint."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    interrupt = Interrupt()
    try:
        with interrupt.heeded():
            return _train(config, device, resume, rank, world, interrupt)
    finally:
        if world > 1:
            dist.destroy_process_group()


def _train(
    config: TrainConfig, device: torch.device, resume: bool, rank: int, world: int, interrupt: Interrupt
) -> Path:
    out = Path(config.out)
    check_folder(out)
    run = Run(config, device, rank, world)
    checkpoint = out / "checkpoint.pt"
    if resume:
        if not checkpoint.is_file():
            raise TrainingError(f"{checkpoint}: no checkpoint to resume; start without --resume")
        run.load_state(_state_in(checkpoint, device))
        if run.step > config.steps:
            raise TrainingError(f"--steps: found {config.steps}, expected at least {run.step}, where {checkpoint} is")
    elif checkpoint.exists():
        raise TrainingError(f"{out}: holds a run already; go on with --resume or choose another --out")
    first = run.step
    log: RunLog | None = None
    weights = out / "weights.safetensors"
    if rank == 0 and first == config.steps and _steps_of(weights) != first:
        # It ended between its last checkpoint and its weights; those that are there, if any, are of an earlier step.
        _validate(run, RunLog(out, config, first, is_to_validate=True), weights)
    progress = tqdm(
        total=config.steps,
        initial=run.step,
        disable=rank != 0,
        unit="step",
        mininterval=1 if sys.stderr.isatty() else 60,
    )
    window: list[dict[str, float]] = []
    saved: int | None = None
    began = time.monotonic() - run.seconds
    while run.step < config.steps:
        window.append(run.train_step())
        if rank == 0 and log is None:
            # A run that fails before its first step is done leaves nothing behind.
            log = RunLog(out, config, first)
        run.seconds = time.monotonic() - began
        progress.update()
        done = run.step == config.steps
        if log and (run.step % config.log_every == 0 or done):
            means = {key: sum(w[key] for w in window) / len(window) for key in window[0]}
            log.write("train", run, {**means, "shards": len(run.sampler.shards)})
            progress.set_postfix(loss=f"{means['loss']:.4f}", slope=f"{means['slope']:.3f}")
            window.clear()
        if run.step % config.checkpoint_every == 0 or done or interrupt.came:
            # Every rank meets here, so that none runs ahead of the files.
            if rank == 0:
                run.save_checkpoint()
            saved = run.step
            if world > 1:
                dist.barrier()
        if log and (run.step % config.validate_every == 0 or done):
            _validate(run, log, weights)
        if interrupt.came:
            if saved != run.step:
                # It came while this step was validated.
                run.save_checkpoint()
            left = (
                f"{weights} is of the last step" if done else f"{checkpoint} is of step {run.step}: go on with --resume"
            )
            raise KeyboardInterrupt(left)
    progress.close()
    return weights


def _state_in(checkpoint: Path, device: torch.device) -> dict[str, Any]:
    try:
        return read_checkpoint(checkpoint, device)
    except WeightsError as error:
        raise TrainingError(
            f"{error}; go on from {checkpoint.with_name('weights.safetensors')} by --initial-weights with an --out of "
            "its own"
        ) from error


def _steps_of(weights: Path) -> int | None:
    """After how many steps a weights file was written; None where there is none that can be read."""
    try:
        steps: int | None = read_metadata(weights)["provenance"].get("steps")
    except WeightsError:
        return None
    return steps


def _validate(run: Run, log: RunLog, weights: Path) -> None:
    """Judges the averaged weights and writes them. Raises TrainingError for a run that is flat."""
    measured = run.validate()
    log.write("validation", run, {"pupils": measured})
    metrics = {"validation_before_double_phase": measured} if measured else {}
    save_weights(weights, run.average, metrics, run.provenance())
    plot_curves(Path(run.config.out))
    _stop_if_flat(run, measured)


def _stop_if_flat(run: Run, measured: dict[str, dict[str, float]]) -> None:
    config = run.config
    if not run.validation or run.step < 0.1 * config.steps:
        return
    slope = measured["2.0"].get("slope", math.nan)
    if math.isnan(slope):
        raise TrainingError(
            f"{config.validation}: found scenes that look the same at every focus at s = 2 mm; expected depth in them"
        )
    if slope < config.stop_below_slope:
        raise TrainingError(
            f"step {run.step}: focus slope {slope:.3f} at s = 2 mm is below {config.stop_below_slope}: the network "
            "shows one blurred picture at every depth; raise the focus weight or start again with another seed"
        )


class RunLog:
    """config.json and metrics.jsonl of a run folder. A run that goes on from a step writes anew what came after it, and
    what validation found at the step itself where that is done again."""

    def __init__(self, out: Path, config: TrainConfig, step: int, is_to_validate: bool = False) -> None:
        out.mkdir(parents=True, exist_ok=True)
        write_beside(out / "config.json", json.dumps(asdict(config), indent=1).encode())
        self.path = out / "metrics.jsonl"
        rows = self.path.read_text().splitlines(keepends=True) if step and self.path.exists() else []
        # A run that was killed may have left half a row.
        kept = [json.loads(row) for row in rows if row.endswith("\n")]
        kept = [
            row
            for row in kept
            if row["step"] < step or (row["step"] == step and not (is_to_validate and row["kind"] == "validation"))
        ]
        write_beside(self.path, "".join(json.dumps(row) + "\n" for row in kept).encode())

    def write(self, kind: str, run: Run, values: dict[str, Any]) -> None:
        row = {"kind": kind, "step": run.step, "seconds": round(run.seconds, 1), **values}
        try:
            with self.path.open("a") as file:
                file.write(json.dumps(row) + "\n")
        except OSError as error:
            error.filename = error.filename or str(self.path)
            raise
