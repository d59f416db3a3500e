"""Which crop of which shard a training step sees, and how it is varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from holod_training.benches import BenchDraw
from holod_training.config import NetworkConfig
from holod_training.depth_faults import faulty_depth
from holod_training.focal_stack import check_focuses
from holod_training.shards import Shard, ShardError, Stack, shard_names

FAULTS_STREAM = 1


@dataclass(frozen=True)
class AugmentConfig:
    """Chances of each change. All are exact: thin-lens pictures are linear in the scene's light, pixel by pixel
    colour included, and the bench is symmetric under flips and quarter turns. Near and far are never swapped.
    `faulty_depth` is the chance that the network is given the depth of a poor camera (`depth_faults.py`)."""

    permute_colours: float = 0.5
    desaturate: float = 0.2
    dim: float = 0.3
    invert: float = 0.1
    dimmest: float = 0.3
    faulty_depth: float = 0.0


def augment(stack: Stack, config: AugmentConfig, rng: np.random.Generator) -> Stack:
    flip_y, flip_x, turn = (bool(b) for b in rng.integers(0, 2, 3))

    def turned(t: Tensor) -> Tensor:
        flips = [axis for axis, wanted in ((-2, flip_y), (-1, flip_x)) if wanted]
        t = t.flip(flips) if flips else t
        return t.transpose(-2, -1) if turn else t

    matrix = np.eye(3, dtype=np.float32)
    if rng.random() < config.permute_colours:
        matrix = matrix[rng.permutation(3)]
    if rng.random() < config.desaturate:
        share = np.float32(rng.random())
        matrix = (1 - share) * matrix + share / 3
    offset = 0.0
    if rng.random() < config.invert:
        matrix, offset = -matrix, 1.0
    if rng.random() < config.dim:
        gain = np.float32(rng.uniform(config.dimmest, 1))
        matrix, offset = matrix * gain, offset * float(gain)
    mix = torch.from_numpy(np.ascontiguousarray(matrix))

    def recoloured(light: Tensor) -> Tensor:
        if np.array_equal(matrix, np.eye(3)) and offset == 0:
            return light
        mixed = mix @ light.reshape(*light.shape[:-2], -1) + offset
        return mixed.reshape(light.shape)

    return replace(
        stack,
        image=recoloured(turned(stack.image)).clamp_min(0).contiguous(),
        depth=turned(stack.depth).contiguous(),
        target=recoloured(turned(stack.target)).contiguous(),
    )


class Sampler:
    """Crops by (seed, step, rank): nothing is remembered between steps but the list of shards, so a run that is
    resumed with that list goes on exactly as if it had never stopped. Networks that are specialists for some pupils
    are shown what is nearest to these."""

    def __init__(
        self,
        folder: Path,
        crop: int,
        seed: int,
        rank: int,
        augment_config: AugmentConfig,
        specialists_mm: tuple[float, ...] = (),
        focal_stacks: Sequence[NetworkConfig] = (),
        benches: BenchDraw | None = None,
    ) -> None:
        """Shards with other focuses than the networks `focal_stacks` take are refused. With `benches` each crop is
        shown on a bench of its own, drawn for its blur, in place of that which its scene was rendered for."""
        self.folder = folder
        self.crop = crop
        self.seed = seed
        self.rank = rank
        self.augment_config = augment_config
        self.specialists_mm = specialists_mm
        self.focal_stacks = focal_stacks
        self.benches = benches
        self.shards: list[Shard] = []

    @property
    def names(self) -> list[str]:
        return [shard.path.name for shard in self.shards]

    def use(self, names: list[str]) -> None:
        """Makes exactly these the shards. Raises ShardError for one that is missing, damaged or too small."""
        known = {shard.path.name: shard for shard in self.shards}
        self.shards = [known.get(name) or self._open(name) for name in names]
        if not self.shards:
            raise ShardError(f"{self.folder}: no scene_*.safetensors in it; write some with `holod-scenes generate`")

    def _open(self, name: str) -> Shard:
        shard = Shard(self.folder / name)
        if min(shard.height, shard.width) < self.crop:
            raise ShardError(f"{shard.path}: {shard.width}x{shard.height} pixels, smaller than the crop {self.crop}")
        for config in self.focal_stacks:
            check_focuses(shard, config)
        return shard

    def rescan(self) -> None:
        """Takes in shards that were written since; those already known stay."""
        self.use(sorted({*self.names, *shard_names(self.folder)}))

    def draw(self, step: int, count: int) -> list[Stack]:
        rng = np.random.default_rng((self.seed, self.rank, step))
        drawn = []
        for _ in range(count):
            shard = self.shards[rng.integers(len(self.shards))]
            pupil = self._pupil(shard, rng)
            if self.benches:
                shard = shard.on(self.benches.draw(shard.optics.volume_blur_px(shard.pupils_mm[pupil]), rng))
            top = int(rng.integers(shard.height - self.crop + 1))
            left = int(rng.integers(shard.width - self.crop + 1))
            drawn.append(augment(shard.read(pupil, top, left, self.crop), self.augment_config, rng))
        if self.augment_config.faulty_depth > 0:
            # A generator of its own: whether faults are drawn changes nothing else of a run.
            faults = np.random.default_rng((self.seed, self.rank, step, FAULTS_STREAM))
            drawn = [
                replace(stack, faulty_depth=faulty_depth(stack.depth, faults))
                if faults.random() < self.augment_config.faulty_depth
                else stack
                for stack in drawn
            ]
        return drawn

    def volume_blurs_px(self) -> tuple[float, float]:
        """The least and the most blur over the depth volume of the pupils that are drawn."""
        blurs = [
            shard.optics.volume_blur_px(shard.pupils_mm[pupil])
            for shard in self.shards
            for pupil in (
                map(shard.nearest_pupil, self.specialists_mm) if self.specialists_mm else range(len(shard.pupils_mm))
            )
        ]
        return min(blurs), max(blurs)

    def _pupil(self, shard: Shard, rng: np.random.Generator) -> int:
        """Any of the shard's pupils; for specialists the one nearest to a random one of theirs. In a shard without
        one near, that may be nearer to another specialist, who then learns from it."""
        if not self.specialists_mm:
            return int(rng.integers(len(shard.pupils_mm)))
        wanted = self.specialists_mm[rng.integers(len(self.specialists_mm))]
        return shard.nearest_pupil(wanted)
