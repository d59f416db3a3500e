"""The same networks on several benches beside a rival: one table, from a folder of scenes for each bench."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import torch

from holod_training.config import OpticsConfig
from holod_training.export import check_folder, load_weights, weights_sha256, write_beside
from holod_training.judging import AFTER, OURS, Bench, Judged, judge_scenes, network_method, open_alike, rivals
from holod_training.metrics import SSIM_WINDOW_PX
from holod_training.network import FieldNetwork
from holod_training.shards import Shard, ShardError, check_border

RIVAL = "smooth phase"
LINE = 100


@torch.no_grad()
def across_benches(
    weights: list[Path],
    folders: list[Path],
    out: Path,
    border_px: int,
    limit: int | None,
    device: torch.device | str = "cpu",
) -> str:
    """Judges every weights file on every folder's bench; writes benches.md and benches.json into `out`, and returns the
    Markdown. Raises ConfigError, ShardError, WeightsError, JudgementError."""
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
    judged = {
        name: {key: _judge(key, network, shards, border_px, device) for key, network in networks.items()}
        for name, shards in benches
    }
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
            {**_bench(name, shards, judged[name]), "outside_training": _outside(networks, shards[0].optics)}
            for name, shards in benches
        ],
    }
    text = markdown(result)
    write_beside(out / "benches.json", (json.dumps(result, indent=1) + "\n").encode())
    write_beside(out / "benches.md", text.encode())
    return text


def _outside(networks: dict[str, FieldNetwork], optics: OpticsConfig) -> list[str]:
    """The networks that were trained for other benches."""
    return [name for name, network in networks.items() if network.config.trained.outside(optics) > 1]


def _judge(name: str, network: FieldNetwork, shards: list[Shard], border_px: int, device: torch.device | str) -> Judged:
    """One network, which is called `OURS`, and the rival."""
    optics = shards[0].optics
    bench = Bench(optics, network.config.amplitude_constant, border_px, device)
    methods = [network_method(OURS, network.on(optics)), *(one for one in rivals(optics) if one.name == RIVAL)]
    print(f"{name}, {len(shards)} scenes", flush=True)
    return judge_scenes(shards, methods, bench)


def _bench(name: str, shards: list[Shard], judged: dict[str, Judged]) -> dict[str, Any]:
    optics = shards[0].optics
    rows = []
    for key, of in judged.items():
        rows += [
            {"method": key if row["method"] == OURS else RIVAL, **{k: v for k, v in row.items() if k != "method"}}
            for row in of.rows()
            if row["double_phase"] == AFTER and (row["method"] == OURS or key == next(iter(judged)))
        ]
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
        "matrix_psnr_db": {key: of.summary()["matrix_psnr_db"][AFTER] for key, of in judged.items()},
    }


def markdown(result: dict[str, Any]) -> str:
    """A row for each bench and method; cells hold PSNR over all / in focus / slope at each pupil."""
    about = (
        "After double phase and rounding to 8-bit levels: PSNR dB / in focus dB / slope, means over scenes; in "
        f"brackets over {RIVAL}, dB over all / in focus, scene by scene. *Right pupil best*: of how many of the judged "
        f"pupils. A border of {result['border_px']} px is left out."
    )
    lines = [textwrap.fill(about, LINE), ""]
    for bench in result["benches"]:
        pupils = bench["pupils_mm"]
        lines += [
            textwrap.fill(_about(bench), LINE),
            "",
            "| method | " + " | ".join(f"s = {mm:g} mm" for mm in pupils) + " | right pupil best |",
            "|---|" + "---|" * (len(pupils) + 1),
        ]
        methods = list(dict.fromkeys(row["method"] for row in bench["rows"]))
        for method in methods:
            rows = [row for row in bench["rows"] if row["method"] == method]
            gains = bench["gain_over_rival"].get(method)
            cells = [_cell(row, gains[index] if gains else None) for index, row in enumerate(rows)]
            lines.append(
                f"| {method} | " + " | ".join([*cells, _right_pupil(bench["matrix_psnr_db"].get(method))]) + " |"
            )
        lines.append("")
    return "\n".join(lines)


def _about(bench: dict[str, Any]) -> str:
    red, green, blue = bench["wavelengths_nm"]
    far, near = bench["depth_dpt"]
    names = bench["outside_training"]
    outside = f"; outside what {', '.join(names)} {'was' if len(names) == 1 else 'were'} trained for" if names else ""
    least, most = min(bench["volume_fresnel_px2"]), max(bench["volume_fresnel_px2"])
    return (
        f"**{bench['bench']}**: {bench['pixel_pitch_um']:g} um, {bench['eyepiece_focal_length_mm']:g} mm, "
        f"{red:g}/{green:g}/{blue:g} nm, {far:g} to {near:.3g} dpt; diffraction {least:.0f} to {most:.0f} px2, "
        f"blur {', '.join(f'{blur:.0f}' for blur in bench['volume_blur_px'])} px; {bench['scenes']} scenes of "
        f"{bench['size'][1]}x{bench['size'][0]}{outside}"
    )


def _cell(row: dict[str, Any], gain: dict[str, Any] | None) -> str:
    def number(value: float | None, digits: str) -> str:
        return "-" if value is None else f"{value:{digits}}"

    cell = " / ".join(
        number(row.get(key), digits)
        for key, digits in (("psnr_db", ".1f"), ("psnr_in_focus_db", ".1f"), ("slope", ".2f"))
    )
    if gain is None:
        return cell
    over = " / ".join(number(gain.get(key, {}).get("mean"), "+.1f") for key in ("psnr_db", "psnr_in_focus_db"))
    return f"{cell} ({over})"


def _right_pupil(matrix: list[list[float]] | None) -> str:
    """Of how many judged pupils (columns) the same given one has the most."""
    if not matrix:
        return ""
    columns = list(zip(*matrix, strict=True))
    right = sum(column[index] >= max(column) for index, column in enumerate(columns))
    return f"{right} of {len(columns)}"
