"""Weights files: safetensors F32 with everything a reader must know in the metadata."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import pickle
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from holod_training.config import ENGINE_ARCHITECTURES, WEIGHTS_FORMAT, ConfigError, NetworkConfig
from holod_training.network import FieldNetwork
from holod_training.old_format import OLD_FORMAT, from_old_format, is_old
from holod_training.variants import build_network

CHECKPOINT_KEYS = {"step", "seconds", "network", "average", "optimizer", "shards", "provenance", "config"}


class WeightsError(ValueError):
    """A weights file that cannot be used; the message names the file and what was found."""


def write_beside(path: Path, content: bytes) -> None:
    """Writes beside and renames, so that no reader ever meets half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            # Else a power cut can leave an empty file where a whole one was.
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        # A write that finds the disk full does not say what it wrote.
        error.filename = error.filename or str(path)
        raise


def check_folder(out: Path) -> None:
    """Raises ConfigError, before the long work, for an `--out` that is no folder and cannot become one."""
    there = next(path for path in (out, *out.parents) if os.path.lexists(path))
    if not there.is_dir():
        raise ConfigError(f"--out: found {there}, which is no folder, expected one to write into")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"--out: found {there}, which may not be written, expected a folder to write into")


def refuse_existing(paths: list[Path], force: bool) -> None:
    """Raises WeightsError where one of `paths` is there already, unless with `force`."""
    for path in paths:
        if not force and os.path.lexists(path):
            raise WeightsError(f"{path} exists already; name another place with --out, or overwrite it with --force")


def save_weights(path: Path, network: FieldNetwork, metrics: dict[str, Any], provenance: dict[str, Any]) -> None:
    tensors = {name: value.detach().float().cpu().contiguous() for name, value in network.state_dict().items()}
    metadata = {
        "format": WEIGHTS_FORMAT,
        "config": network.config.to_json(),
        "metrics": json.dumps(metrics),
        "provenance": json.dumps(provenance),
    }
    write_beside(path, save(tensors, metadata))


def read_metadata(path: Path) -> dict[str, Any]:
    """{config: NetworkConfig, metrics: ..., provenance: ...}. Raises WeightsError."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable weights file ({error})") from error
    if metadata.get("format") != WEIGHTS_FORMAT:
        cure = (
            "; convert it by `python -m holod_training export --source`" if metadata.get("format") == OLD_FORMAT else ""
        )
        raise WeightsError(f"{path}: metadata format is {metadata.get('format')!r}, expected {WEIGHTS_FORMAT!r}{cure}")
    try:
        return {
            "config": NetworkConfig.from_json(metadata.get("config", "")),
            "metrics": json.loads(metadata.get("metrics", "{}")),
            "provenance": json.loads(metadata.get("provenance", "{}")),
        }
    except (ConfigError, json.JSONDecodeError) as error:
        raise WeightsError(f"{path}: {error}") from error


def load_weights(path: Path) -> FieldNetwork:
    """The network in a weights file, on the CPU. Raises WeightsError for a missing, extra or ill-shaped tensor."""
    network = build_network(read_metadata(path)["config"])
    expected = network.state_dict()
    with safe_open(path, framework="pt") as file:
        found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    if expected.keys() != found.keys():
        raise WeightsError(
            f"{path}: missing tensors {sorted(expected.keys() - found.keys())}, "
            f"unknown tensors {sorted(found.keys() - expected.keys())}"
        )
    for name, value in found.items():
        if value.shape != expected[name].shape:
            raise WeightsError(f"{path}: {name} has shape {list(value.shape)}, expected {list(expected[name].shape)}")
    network.load_state_dict({name: value.to(torch.float32) for name, value in found.items()})
    return network.eval()


def weights_sha256(network: FieldNetwork) -> str:
    """What tells weights from others, whatever file they are in."""
    digest = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        digest.update(f"{name} {list(value.shape)}\n".encode())
        digest.update(value.detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def check_engines_run(config: NetworkConfig, source: Path) -> None:
    """Raises WeightsError for a network of a family that no engine runs."""
    if config.architecture not in ENGINE_ARCHITECTURES:
        *first, last = (f"`{name}`" for name in ENGINE_ARCHITECTURES)
        known = f"{', '.join(first)} and {last}"
        raise WeightsError(f"{source}: found a `{config.architecture}` network; the engines run {known} networks only")
    if config.architecture == "focal-stack" and not config.feedback:
        raise WeightsError(
            f"{source}: found a `focal-stack` network without feedback; the engines run those with it: train "
            "`--variant focal-stack-feedback`"
        )


def check_takes_pictures(config: NetworkConfig, source: Path) -> None:
    """Raises WeightsError for a network that no engine runs on a picture and its depth."""
    check_engines_run(config, source)
    if config.architecture == "focal-stack":
        raise WeightsError(f"{source}: found a `focal-stack` network; expected one that takes a picture and its depth")


def export(
    source: Path,
    out: Path,
    amplitude_constant: float | None,
    evaluation: Path | None,
    method: str = "holod",
    benches: Path | None = None,
    benches_method: str = "",
    force: bool = False,
) -> Path:
    """Writes `out`, for the engines, from a run's checkpoint or a weights file, with what an `evaluate` and an
    `across-benches` found of it; raises WeightsError, also for a network of a family that they do not run, and for a
    file that is there already without `force`."""
    refuse_existing([out], force)
    if source.suffix == ".pt":
        network, metrics, provenance = _from_checkpoint(source)
    elif is_old(source):
        network, metrics, provenance = from_old_format(source)
    else:
        metadata = read_metadata(source)
        network, metrics, provenance = load_weights(source), metadata["metrics"], metadata["provenance"]
    check_engines_run(network.config, source)
    if amplitude_constant is not None:
        if not 0 < amplitude_constant < math.inf:
            raise WeightsError(f"amplitude constant: found {amplitude_constant}, expected a number above 0")
        if not math.isclose(amplitude_constant, network.config.amplitude_constant):
            # Figures are of what a panel shows with the source's own constant.
            metrics = {}
        network.config = dataclasses.replace(network.config, amplitude_constant=amplitude_constant)
    if evaluation:
        metrics = _summary(evaluation, method, network)
    if benches:
        metrics = {**metrics, "benches": _of_benches(benches, benches_method or out.stem, network)}
    save_weights(out, network, metrics, provenance)
    return out


def read_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """What `Run.state` put there. Raises WeightsError for a file that is damaged, or of something else."""
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except (OSError, EOFError, LookupError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError) as error:
        # PyTorch's words on a pickle advise to load it unsafely.
        told = "" if isinstance(error, pickle.UnpicklingError) else str(error).partition("\n")[0]
        raise WeightsError(f"{path}: not a whole checkpoint ({told or 'its content cannot be read'})") from error
    found = state.keys() if isinstance(state, dict) else set()
    if missing := CHECKPOINT_KEYS - found:
        raise WeightsError(f"{path}: not a checkpoint of a run (without {', '.join(sorted(missing))})")
    return dict(state)


def _from_checkpoint(source: Path) -> tuple[FieldNetwork, dict[str, Any], dict[str, Any]]:
    state = read_checkpoint(source)
    try:
        run = json.loads(state["config"])
        network = build_network(NetworkConfig.from_json(json.dumps(run["network"])))
        network.load_state_dict(state["average"])
        provenance = state["provenance"]
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise WeightsError(f"{source}: not a checkpoint of a run ({error})") from error
    return network, {}, provenance


def _summary(evaluation: Path, method: str, network: FieldNetwork) -> dict[str, Any]:
    """The rows and refocus ratios of one method of an evaluation.json, and the matrix, which it has of `holod` only.
    Raises WeightsError where they are of another network or amplitude constant than `network`'s."""
    try:
        result = json.loads(evaluation.read_text())
        found = {
            "scenes": result["scenes"],
            "rows": [{**row, "method": "holod"} for row in result["rows"] if row["method"] == method],
            "refocus": [{**row, "method": "holod"} for row in result.get("refocus", []) if row["method"] == method],
        }
        if not found["rows"]:
            there = ", ".join(sorted({row["method"] for row in result["rows"]}))
            raise WeightsError(f"{evaluation}: no method {method!r}; found {there}")
        # Older evaluations judged all networks with the first one's constant.
        usual = {"amplitude_constant": result["amplitude_constant"]}
        _require_judged(evaluation, [{**usual, **row} for row in result["networks"]], method, network)
        return {**found, "matrix_psnr_db": result["matrix_psnr_db"]} if method == "holod" else found
    except (OSError, json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise WeightsError(f"{evaluation}: not an evaluation ({error})") from error


def _require_judged(file: Path, networks: list[dict[str, Any]], method: str, network: FieldNetwork) -> None:
    """Raises WeightsError for figures that are not `network`'s. Older evaluations tell weights by their count alone."""
    judged = {row["method"]: row for row in networks}
    if method not in judged:
        raise WeightsError(f"{file}: {method!r} is no network; expected one of {', '.join(judged)}")
    expected = {"parameters": sum(p.numel() for p in network.parameters()), "weights_sha256": weights_sha256(network)}
    for key, value in expected.items():
        if judged[method].get(key, value) != value:
            raise WeightsError(
                f"{file}: {key} of {method!r}: found {judged[method][key]}, expected {value}, that of --source: "
                "judge the weights that are exported"
            )
    found, constant = judged[method]["amplitude_constant"], network.config.amplitude_constant
    if not math.isclose(found, constant):
        raise WeightsError(
            f"{file}: amplitude_constant: found {found:g}, expected {constant:g}, that of the file to write: "
            "judge what `export --amplitude-constant` writes, and export that again with its figures"
        )


def _of_benches(benches: Path, method: str, network: FieldNetwork) -> list[dict[str, Any]]:
    """What `holod check` quotes: for each bench where it lies, and what the network reached there at each blur. Raises
    WeightsError where the figures are of another network or amplitude constant than `network`'s."""
    try:
        table = json.loads(benches.read_text())
        found = table["benches"]
        # Older tables tell weights by their file's name alone, which others may have.
        if "networks" not in table:
            raise WeightsError(
                f"{benches}: does not say of which weights its figures are; write it again with `across-benches`"
            )
        _require_judged(benches, table["networks"], method, network)
        result = []
        for bench in found:
            gains = bench["gain_over_rival"][method]
            rows = [row for row in bench["rows"] if row["method"] == method]
            result.append(
                {
                    "bench": bench["bench"],
                    "volume_fresnel_px2": bench["volume_fresnel_px2"],
                    "rows": [
                        {
                            "volume_blur_px": blur_px,
                            "psnr_db": round(row["psnr_db"], 2),
                            "psnr_in_focus_db": round(row["psnr_in_focus_db"], 2),
                            "slope": round(row["slope"], 3),
                            "over_smooth_phase_db": round(gain["psnr_db"]["mean"], 2),
                        }
                        for blur_px, row, gain in zip(bench["volume_blur_px"], rows, gains, strict=True)
                    ],
                }
            )
        return result
    except (OSError, json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise WeightsError(f"{benches}: not a table across benches ({error})") from error
