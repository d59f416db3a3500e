"""The training run: a folder with config.json, metrics.jsonl, curves.png, checkpoint.pt and weights.safetensors."""

from __future__ import annotations

import copy
import dataclasses
import datetime
import io
import json
import math
import os
import platform
import sys
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from holod_training.config import NetworkConfig, OpticsConfig
from holod_training.curves import plot_curves
from holod_training.export import save_weights, write_beside
from holod_training.loss import LossWeights, focus_loss, inner
from holod_training.metrics import Judgement, judge
from holod_training.network import DirectNetwork
from holod_training.optics import Eye, HalfBandEye, coc_px
from holod_training.sampling import AugmentConfig, Sampler
from holod_training.shards import Shard, Stack, open_shards

VALIDATION_PUPILS_MM = (2.0, 3.0, 4.0)


class TrainingError(RuntimeError):
    """A run that must not go on; the message says why and what to do."""


@dataclass(frozen=True)
class TrainConfig:
    shards: str
    out: str
    steps: int
    validation: str | None = None
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    crop: int = 160
    border_px: int = 24
    validation_border_px: int = 24
    batch: int = 1
    learning_rate: float = 2e-3
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

    def learning_rate_at(self, step: int) -> float:
        """Linear warm-up, then cosine to `final_rate_share` of the peak."""
        warm = min(1.0, (step + 1) / max(1, self.warm_up_steps))
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, self.steps))))
        return self.learning_rate * warm * (self.final_rate_share + (1 - self.final_rate_share) * cosine)


@cache
def half_band_eye(
    optics: OpticsConfig, height: int, width: int, focus_dpt: tuple[float, ...], device: str
) -> HalfBandEye:
    return HalfBandEye(optics, height, width, list(focus_dpt), device)


@cache
def full_eye(optics: OpticsConfig, height: int, width: int, focus_dpt: tuple[float, ...], device: str) -> Eye:
    return Eye(optics, height, width, list(focus_dpt), device)


def see(config: NetworkConfig, field_: Tensor, stack: Stack, pupil_mm: float) -> Tensor:
    """The pictures [K, 3, H, W] that the stack's focuses show of one network output [3, h, w]."""
    height, width = stack.depth.shape
    if config.grid == "half-band":
        eye = half_band_eye(config.optics, height, width, stack.focus_dpt, str(field_.device))
        return eye.look(field_, pupil_mm)
    return full_eye(config.optics, height, width, stack.focus_dpt, str(field_.device)).look(field_, pupil_mm)


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
        self.network = DirectNetwork(config.network).to(device)
        if config.initial_weights:
            from holod_training.export import load_weights

            self.network.load_state_dict(load_weights(Path(config.initial_weights)).state_dict())
        self.average = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.trained: nn.Module = DistributedDataParallel(self.network) if world > 1 else self.network
        self.sampler = Sampler(
            Path(config.shards), config.network.optics, config.crop, config.seed, rank, config.augment
        )
        self.validation: list[Shard] = []
        if config.validation:
            self.validation = open_shards(Path(config.validation), config.network.optics, config.validation_scenes)

    def train_step(self) -> dict[str, float]:
        config = self.config
        if self.step % config.rescan_every == 0:
            self.sampler.rescan()
        rate = config.learning_rate_at(self.step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        stacks = [s.to(self.device) for s in self.sampler.draw(self.step, config.batch)]
        pupils = torch.tensor([s.pupil_mm for s in stacks], device=self.device)
        fields = self.trained(
            torch.stack([s.amplitude for s in stacks]), torch.stack([s.depth for s in stacks]), pupils
        )
        parts = []
        for low, stack in zip(fields, stacks, strict=True):
            border = config.border_px
            picture = see(config.network, low, stack, stack.pupil_mm)
            blur = coc_px(config.network.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)
            parts.append(
                focus_loss(inner(picture, border), inner(stack.target, border), inner(blur, border), config.loss)
            )
        loss = torch.stack([p.total for p in parts]).mean()
        if not torch.isfinite(loss):
            raise TrainingError(f"step {self.step}: the loss is {loss.item()}; lower the learning rate")
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
        }

    @torch.no_grad()
    def _average(self) -> None:
        decay = min(self.config.ema_decay, (1 + self.step) / (10 + self.step))
        for averaged, live in zip(self.average.parameters(), self.network.parameters(), strict=True):
            averaged.lerp_(live, 1 - decay)

    @torch.no_grad()
    def validate(self) -> dict[str, dict[str, float]]:
        """The averaged weights on held-out scenes, before double phase: {"2.0": {psnr_db: ...}, ...}."""
        result = {}
        for wanted in VALIDATION_PUPILS_MM:
            judged = []
            for shard in self.validation:
                index = min(range(len(shard.pupils_mm)), key=lambda i: abs(shard.pupils_mm[i] - wanted))
                stack = shard.read(index).to(self.device)
                low = self.average(
                    stack.amplitude[None],
                    stack.depth[None],
                    torch.tensor([stack.pupil_mm], device=self.device),
                )[0]
                picture = see(self.config.network, low, stack, stack.pupil_mm)
                blur = coc_px(self.config.network.optics, stack.depth, list(stack.focus_dpt), stack.pupil_mm)
                judged.append(judge(picture, stack.target, blur, self.config.validation_border_px, with_ssim=False))
            result[str(wanted)] = Judgement.mean(judged).known()
        return result

    def state(self) -> dict[str, Any]:
        return {
            "format": "holod-checkpoint-1",
            "step": self.step,
            "seconds": self.seconds,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "shards": self.sampler.names,
            "provenance": self.provenance(),
            "config": json.dumps(dataclasses.asdict(self.config)),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        self.step = state["step"]
        self.seconds = state["seconds"]
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.sampler.use(state["shards"])

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


def train(config: TrainConfig, device: torch.device, resume: bool = False) -> Path:
    """Runs to the last step and returns the weights file. Raises TrainingError, ShardError, WeightsError."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        return _train(config, device, resume, rank, world)
    finally:
        if world > 1:
            dist.destroy_process_group()


def _train(config: TrainConfig, device: torch.device, resume: bool, rank: int, world: int) -> Path:
    out = Path(config.out)
    run = Run(config, device, rank, world)
    checkpoint = out / "checkpoint.pt"
    if resume:
        if not checkpoint.is_file():
            raise TrainingError(f"{checkpoint}: no checkpoint to resume; start without --resume")
        run.load_state(torch.load(checkpoint, map_location=device, weights_only=True))
    elif checkpoint.exists():
        raise TrainingError(f"{out}: holds a run already; go on with --resume or choose another --out")
    log = RunLog(out, config, resume) if rank == 0 else None
    weights = out / "weights.safetensors"
    progress = tqdm(
        total=config.steps,
        initial=run.step,
        disable=rank != 0,
        unit="step",
        mininterval=1 if sys.stderr.isatty() else 60,
    )
    window: list[dict[str, float]] = []
    began = time.monotonic() - run.seconds
    while run.step < config.steps:
        window.append(run.train_step())
        run.seconds = time.monotonic() - began
        progress.update()
        done = run.step == config.steps
        if log and (run.step % config.log_every == 0 or done):
            means = {key: sum(w[key] for w in window) / len(window) for key in window[0]}
            log.write("train", run, {**means, "shards": len(run.sampler.shards)})
            progress.set_postfix(loss=f"{means['loss']:.4f}", slope=f"{means['slope']:.3f}")
            window.clear()
        if run.step % config.checkpoint_every == 0 or done:
            # Every rank meets here, so that none runs ahead of the files.
            if rank == 0:
                run.save_checkpoint()
            if world > 1:
                dist.barrier()
        if log and (run.step % config.validate_every == 0 or done):
            measured = run.validate()
            log.write("validation", run, {"pupils": measured})
            metrics = {"validation_before_double_phase": measured} if measured else {}
            save_weights(weights, run.average, metrics, run.provenance())
            plot_curves(out)
            _stop_if_flat(run, measured)
    progress.close()
    return weights


def _stop_if_flat(run: Run, measured: dict[str, dict[str, float]]) -> None:
    config = run.config
    if not run.validation or run.step < 0.1 * config.steps:
        return
    slope = measured["2.0"]["slope"]
    if slope < config.stop_below_slope:
        raise TrainingError(
            f"step {run.step}: focus slope {slope:.3f} at s = 2 mm is below {config.stop_below_slope}: the network "
            "shows one blurred picture at every depth; raise the focus weight or start again with another seed"
        )


class RunLog:
    """config.json and metrics.jsonl of a run folder."""

    def __init__(self, out: Path, config: TrainConfig, resume: bool) -> None:
        out.mkdir(parents=True, exist_ok=True)
        write_beside(out / "config.json", json.dumps(dataclasses.asdict(config), indent=1).encode())
        self.path = out / "metrics.jsonl"
        if not resume:
            self.path.unlink(missing_ok=True)

    def write(self, kind: str, run: Run, values: dict[str, Any]) -> None:
        row = {"kind": kind, "step": run.step, "seconds": round(run.seconds, 1), **values}
        with self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")
