"""The same networks on several benches beside a rival: one table, from a folder of scenes for each bench."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from holod_training.config import OpticsConfig
from holod_training.export import check_folder, load_weights, weights_sha256, write_beside
from holod_training.goals import bench_checks, right_pupil_margins_db
from holod_training.judging import (
    AFTER,
    OURS,
    Bench,
    Judged,
    check_alike,
    judge_scenes,
    network_method,
    open_alike,
    rivals,
)
from holod_training.metrics import SSIM_WINDOW_PX, Judgement
from holod_training.network import FieldNetwork
from holod_training.refocus import refocus_cards
from holod_training.report import prose
from holod_training.shards import Shard, ShardError, check_border, check_kind, open_held_out

RIVAL = "smooth phase"
CONTRASTS = {"dark on bright": "dark marks", "bright on dark": "bright marks"}
OUTSIDE_MARK = "†"


@torch.no_grad()
def across_benches(
    weights: list[Path],
    folders: list[Path],
    out: Path,
    border_px: int,
    limit: int | None,
    device: torch.device | str = "cpu",
    card_folders: Sequence[Path] = (),
) -> str:
    """Judges every weights file on every folder's bench, and on the refocus cards in the folder of `card_folders` that
    has the same name; writes benches.md and benches.json into `out`, and returns the Markdown. Raises ConfigError,
    ShardError, WeightsError, JudgementError."""
    check_folder(out)
    networks = {path.stem: load_weights(path).to(device) for path in weights}
    if len(networks) < len(weights):
        raise ShardError("weights: found two files of one name; give each a name of its own")
    if len({folder.name for folder in folders}) < len(folders):
        raise ShardError("--test: found two folders of one name, which is their bench's; give each a name of its own")
    # All folders are looked at before the long work.
    benches = [(folder.name, open_alike(folder, limit)) for folder in folders]
    for _, shards in benches:
        check_border(shards, border_px, "--border-px", SSIM_WINDOW_PX)
    cards = _open_cards(card_folders, {name: shards[0].optics for name, shards in benches}, border_px)
    judged = {name: _judge(networks, name, shards, cards.get(name, []), border_px, device) for name, shards in benches}
    result = {
        "border_px": border_px,
        "networks": [
            {
                "method": name,
                "weights_sha256": weights_sha256(network),
                "amplitude_constant": network.config.amplitude_constant,
            }
            for name, network in networks.items()
        ],
        "benches": [
            {
                **_bench(name, shards, judged[name]),
                "outside_training": _outside(networks, shards[0].optics),
                "pupils_outside_training_mm": _pupils_outside(networks, shards[0].optics, shards[0].pupils_mm),
            }
            for name, shards in benches
        ],
    }
    text = markdown(result)
    write_beside(out / "benches.json", (json.dumps(result, indent=1) + "\n").encode())
    write_beside(out / "benches.md", text.encode())
    return text


def _outside(networks: dict[str, FieldNetwork], optics: OpticsConfig) -> list[str]:
    """The networks that were trained for other benches: for less or more diffraction."""
    return [name for name, network in networks.items() if network.config.trained.outside(optics) > 1]


def _pupils_outside(
    networks: dict[str, FieldNetwork], optics: OpticsConfig, pupils_mm: Sequence[float]
) -> dict[str, list[float]]:
    """For each network that was trained for less or more blur than a judged pupil's: these pupils."""
    found = {
        name: [round(mm, 4) for mm in pupils_mm if network.config.trained.blurs_outside(optics.volume_blur_px(mm))]
        for name, network in networks.items()
    }
    return {name: pupils for name, pupils in found.items() if pupils}


def _open_cards(folders: Sequence[Path], benches: dict[str, OpticsConfig], border_px: int) -> dict[str, list[Shard]]:
    """By the name of the bench that they are for."""
    cards: dict[str, list[Shard]] = {}
    for folder in folders:
        if folder.name in cards or folder.name not in benches:
            raise ShardError(
                f"--cards: found a folder named {folder.name!r}, expected the name of one of --test's, each once: "
                f"{', '.join(benches)}"
            )
        shards = open_held_out(folder, benches[folder.name])
        for shard in shards:
            check_kind(shard, "cards")
        check_alike(shards, ("size",), "with one `--size`")
        check_border(shards, border_px, "--border-px")
        cards[folder.name] = shards
    return cards


def _judge(
    networks: dict[str, FieldNetwork],
    name: str,
    shards: list[Shard],
    cards: list[Shard],
    border_px: int,
    device: torch.device | str,
) -> dict[str, tuple[Judged, list[dict[str, Any]]]]:
    """Each network, which is called `OURS` then, beside the rival; and their refocus ratios."""
    optics = shards[0].optics
    rival = [method for method in rivals(optics) if method.name == RIVAL]
    # By the amplitude constant with which it is shown.
    of_rival: dict[float, dict[tuple[str, str, float], dict[int, Judgement]]] = {}
    found: dict[str, tuple[Judged, list[dict[str, Any]]]] = {}
    for key, network in networks.items():
        print(f"{name}, {key}: {len(shards)} scenes", flush=True)
        constant = network.config.amplitude_constant
        bench = Bench(optics, constant, border_px, device)
        methods = [network_method(OURS, network.on(optics)), *([] if constant in of_rival else rival)]
        refocus = refocus_cards(cards, methods, bench, pupils_mm=shards[0].pupils_mm) if cards else []
        judged = judge_scenes(shards, methods, bench, after_alone=True)
        of_rival.setdefault(constant, {of: values for of, values in judged.values.items() if of[0] == RIVAL})
        judged.values.update(of_rival[constant])
        found[key] = judged, refocus
    return found


def _bench(name: str, shards: list[Shard], found: dict[str, tuple[Judged, list[dict[str, Any]]]]) -> dict[str, Any]:
    optics = shards[0].optics
    judged = {key: of for key, (of, _) in found.items()}
    first = next(iter(found))
    refocus = [
        {**row, "method": key if row["method"] == OURS else RIVAL}
        for key, (_, of) in found.items()
        for row in of
        if row["method"] == OURS or key == first
    ]
    rows = []
    for key, of in judged.items():
        rows += [
            {"method": key if row["method"] == OURS else RIVAL, **{k: v for k, v in row.items() if k != "method"}}
            for row in of.rows()
            if row["double_phase"] == AFTER and (row["method"] == OURS or key == first)
        ]
    matrix = {key: of.summary()["matrix_psnr_db"][AFTER] for key, of in judged.items()}
    return {
        "bench": name,
        "wavelengths_nm": optics.wavelengths_nm,
        "pixel_pitch_um": optics.pixel_pitch_um,
        "eyepiece_focal_length_mm": optics.eyepiece_focal_length_mm,
        "depth_dpt": [optics.depth_far_dpt, optics.depth_near_dpt],
        "volume_fresnel_px2": [round(fresnel, 2) for fresnel in optics.volume_fresnel_px2],
        "volume_blur_px": [round(optics.volume_blur_px(mm), 2) for mm in shards[0].pupils_mm],
        "pupils_mm": [round(mm, 4) for mm in shards[0].pupils_mm],
        "scenes": len(shards),
        "size": [shards[0].height, shards[0].width],
        "rows": rows,
        "gain_over_rival": {
            key: [
                {
                    "pupil_mm": row["pupil_mm"],
                    **{k: {"mean": v, "interval_95": row["interval_95"].get(k)} for k, v in row["difference"].items()},
                }
                for row in of.paired()
                if row["method"] == RIVAL
            ]
            for key, of in judged.items()
        },
        "matrix_psnr_db": matrix,
        "right_pupil_margin_db": {
            key: [round(margin, 3) for margin in right_pupil_margins_db(of)] for key, of in matrix.items()
        },
        **({"refocus": refocus} if refocus else {}),
    }


def markdown(result: dict[str, Any]) -> str:
    """A row for each bench and method; cells hold PSNR over all / in focus / slope at each pupil. Then the goals."""
    about = (
        "After double phase and rounding to 8-bit levels: PSNR dB / in focus dB / slope, means over scenes; in "
        f"brackets over {RIVAL}, dB over all / in focus, scene by scene. *Right pupil ahead*: by how many dB over all "
        "a hologram for the judged pupil is ahead of the best one for another pupil of the table, for each judged one. "
        "*Foam* in thousandths of white squared, less is better. *Refocus*: gradient energy of a card's fine marks in "
        "focus over out of focus, the lesser of a near and a far card. Both at each pupil, as in the columns before. A "
        f"border of {result['border_px']} px is left out."
    )
    lines = [prose(about), ""]
    for bench in result["benches"]:
        pupils = bench["pupils_mm"]
        contrasts = [contrast for contrast in CONTRASTS if _refocus(bench, None, contrast)]
        labels = [
            *("method", *(f"s = {mm:g} mm" for mm in pupils), "right pupil ahead, dB", "foam"),
            *(f"refocus, {CONTRASTS[contrast]}" for contrast in contrasts),
        ]
        lines += [prose(_about(bench)), "", f"| {' | '.join(labels)} |", "|---" * len(labels) + "|"]
        for method in dict.fromkeys(row["method"] for row in bench["rows"]):
            rows = [row for row in bench["rows"] if row["method"] == method]
            gains = bench["gain_over_rival"].get(method)
            outside = bench["pupils_outside_training_mm"].get(method, [])
            marks = [f" {OUTSIDE_MARK}" if pupil in outside else "" for pupil in pupils]
            cells = [
                method,
                *(f"{_cell(row, gains[index] if gains else None)}{marks[index]}" for index, row in enumerate(rows)),
                " / ".join(f"{margin:+.2f}" for margin in bench["right_pupil_margin_db"].get(method, [])),
                " / ".join(_number(1e3 * row["foam"] if "foam" in row else None, ".2f") for row in rows),
                *(" / ".join(f"{ratio:.2f}" for ratio in _refocus(bench, method, contrast)) for contrast in contrasts),
            ]
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join([*lines, *_goals(result)])


def _goals(result: dict[str, Any]) -> list[str]:
    about = (
        "The least of each bench's pupils, of refocus ratios also of its cards and marks, and what was wanted of it; "
        "**bold** where that was not reached."
    )
    if any(bench["pupils_outside_training_mm"] for bench in result["benches"]):
        about += f" {OUTSIDE_MARK}: of pupils with a blur, too, that the network was not trained for."
    checks = [(bench["bench"], of, bench_checks(bench, of)) for bench in result["benches"] for of in _networks(bench)]
    judged = dict.fromkeys(what for _, _, found in checks for what, _, _, _ in found)
    labels = ["bench", "network", *judged]
    lines = ["## Goals", "", prose(about), "", f"| {' | '.join(labels)} |", "|---" * len(labels) + "|"]
    outside = {
        (bench["bench"], method) for bench in result["benches"] for method in bench["pupils_outside_training_mm"]
    }
    for name, method, found in checks:
        cells = {what: f"{value if met else f'**{value}**'} ({wanted})" for what, value, wanted, met in found}
        marked = f"{method} {OUTSIDE_MARK}" if (name, method) in outside else method
        lines.append(f"| {' | '.join([name, marked, *(cells.get(what, '-') for what in judged)])} |")
    return [*lines, ""]


def _networks(bench: dict[str, Any]) -> list[str]:
    return list(bench["gain_over_rival"])


def _refocus(bench: dict[str, Any], method: str | None, contrast: str) -> list[float]:
    """The lesser of the near and the far card's ratio, at each pupil; of any method where none is named."""
    return [
        min(row["near_card"], row["far_card"])
        for row in bench.get("refocus", [])
        if row["contrast"] == contrast and method in (None, row["method"])
    ]


def _about(bench: dict[str, Any]) -> str:
    red, green, blue = bench["wavelengths_nm"]
    far, near = bench["depth_dpt"]
    names = bench["outside_training"]
    outside = f"; outside what {', '.join(names)} {'was' if len(names) == 1 else 'were'} trained for" if names else ""
    if bench["pupils_outside_training_mm"]:
        outside += f"; {OUTSIDE_MARK} a blur that the network was not trained for"
    least, most = min(bench["volume_fresnel_px2"]), max(bench["volume_fresnel_px2"])
    return (
        f"**{bench['bench']}**: {bench['pixel_pitch_um']:g} um, {bench['eyepiece_focal_length_mm']:g} mm, "
        f"{red:g}/{green:g}/{blue:g} nm, {far:g} to {near:.3g} dpt; diffraction {least:.0f} to {most:.0f} px2, "
        f"blur {', '.join(f'{blur:.0f}' for blur in bench['volume_blur_px'])} px; {bench['scenes']} scenes of "
        f"{bench['size'][1]}x{bench['size'][0]}{outside}"
    )


def _number(value: float | None, digits: str) -> str:
    return "-" if value is None else f"{value:{digits}}"


def _cell(row: dict[str, Any], gain: dict[str, Any] | None) -> str:
    cell = " / ".join(
        _number(row.get(key), digits)
        for key, digits in (("psnr_db", ".1f"), ("psnr_in_focus_db", ".1f"), ("slope", ".2f"))
    )
    if gain is None:
        return cell
    over = " / ".join(_number(gain.get(key, {}).get("mean"), "+.1f") for key in ("psnr_db", "psnr_in_focus_db"))
    return f"{cell} ({over})"
