"""The weighted mean of networks that went on from the same weights: a point between the ends of their trade.

Runs that start from one file and differ in their loss alone stay so near each other that figures of the mean lie
between theirs, after Wortsman and others 2022 (https://arxiv.org/abs/2203.05482). Of networks from different starts the
mean is no network at all, which nothing here can tell: judge what is written.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from holod_training.export import WeightsError, load_weights, read_metadata, refuse_existing, save_weights

SUM_TOLERANCE = 1e-6


def average(parts: list[tuple[Path, float]], out: Path, force: bool = False) -> Path:
    """Writes Σ share · weights of `parts`, files and their shares, which sum to 1. Raises WeightsError where they do
    not, where a file is unreadable or holds another network than the first, and where `out` is there already without
    `force`."""
    refuse_existing([out], force)
    if len(parts) < 2:
        raise WeightsError(f"found {len(parts)} file(s) to take the mean of, expected at least two")
    total = sum(share for _, share in parts)
    if not all(share > 0 for _, share in parts) or abs(total - 1) > SUM_TOLERANCE:
        found_shares = ", ".join(f"{share:g}" for _, share in parts)
        raise WeightsError(f"found shares of {found_shares}, expected numbers above 0 that sum to 1")
    first = parts[0][0]
    mean = load_weights(first)
    networks = [load_weights(path) for path, _ in parts]
    for (path, _), network in zip(parts, networks, strict=True):
        found, expected = dataclasses.asdict(network.config), dataclasses.asdict(mean.config)
        if differing := [f"{key} {found[key]}" for key in expected if found[key] != expected[key]]:
            raise WeightsError(f"{path}: found {', '.join(differing)}; expected the network of {first}")
    states = [network.state_dict() for network in networks]
    shares = [share for _, share in parts]
    mean.load_state_dict(
        {
            name: torch.stack([share * state[name] for share, state in zip(shares, states, strict=True)]).sum(dim=0)
            for name in states[0]
        }
    )
    provenance = {
        "script": "python -m holod_training average",
        "parts": [{"share": share, "of": read_metadata(path)["provenance"]} for path, share in parts],
    }
    save_weights(out, mean, {}, provenance)
    return out
