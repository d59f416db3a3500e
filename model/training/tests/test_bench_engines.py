from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from holod_training.bench_engines import (
    EAGER,
    HOLOD,
    NETS,
    QUIET_SHARE,
    WHOLE,
    BenchError,
    HolodTimes,
    PanelLevels,
    Plan,
    Row,
    _CpuTime,
    _in_half_precision,
    _nets,
    busy_s,
    levels_agree,
    markdown,
    nets_agree,
    parse_holod,
    reason,
    run_holod,
)
from holod_training.cli import main
from holod_training.config import NetworkConfig
from holod_training.export import save_weights
from holod_training.optics import double_phase, through_levels, upsample_half_band
from holod_training.variants import build_network

CPU = torch.device("cpu")
TINY = NetworkConfig(
    architecture="expected-stack", layers=4, channels=4, adjustable_layers=(2,), correction_layers=4, depth_layers=3
)
REPORT: dict[str, Any] = {
    "renderer": "cpu, avx2, 1 threads",
    "ceilings": {"threads": 1, "gflop_per_s": 50.0, "gb_per_s": 9.0},
    "stages": [],
    "layers": {"name": "all layers", "median_ms": 6.0},
    "frame": {"name": "whole frame", "median_ms": 8.0},
}


def holod(folder: Path, report: dict[str, Any], exit_code: int = 0) -> Path:
    """A program that notes how it is called and prints a report as `holod bench --json` does."""
    (folder / "report.json").write_text(json.dumps(report))
    program = folder / "holod"
    program.write_text(
        f'#!/bin/sh\n[ "$1" = --version ] && echo holod 9.9 && exit\necho "$*" >>{folder}/calls\n'
        f"cat {folder}/report.json\necho no such panel >&2\nexit {exit_code}\n"
    )
    program.chmod(0o755)
    return program


def plan(program: Path, **changes: Any) -> Plan:
    values = {"weights": Path("tiny.safetensors"), "width": 16, "height": 12, "rounds": 2, "calls": 1, "device": CPU}
    return Plan(holod=program, **{**values, **changes})


def test_what_holod_prints_is_read() -> None:
    assert parse_holod(json.dumps(REPORT)) == HolodTimes("cpu, avx2, 1 threads", 8.0, 6.0, 1)
    on_gpu = {**REPORT, "renderer": "gpu, llvmpipe", "ceilings": None, "layers": None}
    assert parse_holod(json.dumps(on_gpu)) == HolodTimes("gpu, llvmpipe", 8.0, None, None)
    for broken in ({"frame_ms": 8.0}, {**REPORT, "frame": {}}, {**REPORT, "layers": {"median_ms": "much"}}, []):
        with pytest.raises(BenchError, match="not a report of `holod bench --json`"):
            parse_holod(json.dumps(broken))
    with pytest.raises(BenchError, match="not a report"):
        parse_holod("holod 0.1.0")


def test_holod_is_asked_for_the_same_frames_and_must_do_them_on_the_same_threads(tmp_path: Path) -> None:
    program = holod(tmp_path, REPORT)
    assert run_holod(plan(program), threads=1).frame_ms == 8.0
    assert (tmp_path / "calls").read_text() == (
        "bench --json --backend cpu --duration 0s --weights tiny.safetensors --resolution 16x12 --repeat 1\n"
    )
    with pytest.raises(BenchError, match="computes on 1 threads, expected 2"):
        run_holod(plan(program), threads=2)
    with pytest.raises(BenchError, match="exit code 64: no such panel"):
        run_holod(plan(holod(tmp_path, REPORT, exit_code=64)), threads=1)
    with pytest.raises(BenchError, match="absent: cannot be run"):
        run_holod(plan(tmp_path / "absent"), threads=1)


@pytest.mark.parametrize("changes", [{"width": 15}, {"height": 0}, {"rounds": 0}, {"calls": 0}])
def test_plans_that_cannot_be_timed_are_refused(changes: dict[str, int]) -> None:
    with pytest.raises(BenchError, match="expected"):
        plan(Path("holod"), **changes)


def test_what_other_programs_take_of_the_cpus_is_found() -> None:
    """Two CPUs, of which the first alone is looked at; the sum of all comes first, as the kernel has it."""
    stat = "cpu  30 2 20 100 9 2 2 1 7 7\ncpu0 20 1 10 50 4 1 1 1 7 7\ncpu1 10 1 10 50 5 1 1 0 0 0\nintr 5 6\n"
    assert busy_s(stat, {0}, 100) == pytest.approx(0.34)
    assert busy_s(stat, {0, 1}, 100) == pytest.approx(0.57)
    before = _CpuTime(available=100.0, busy=40.0, own=10.0)
    for busy, own, share in ((60.0, 30.0, 0.0), (59.9, 30.0, 0.0), (60.0, 25.0, 0.25), (99.0, 10.0, 1.0)):
        assert _CpuTime(120.0, busy, own).taken_by_others_since(before) == pytest.approx(share)


def test_each_round_is_compared_with_itself() -> None:
    """The machine was twice as slow in the second round: the ratio does not tell."""
    ours, theirs = Row(WHOLE, HOLOD, (1.0, 2.0, 1.0)), Row(WHOLE, EAGER, (3.0, 6.0, 4.0))
    assert (theirs.median_ms, theirs.times_of(ours), ours.times_of(ours)) == (4.0, 3.0, 1.0)


def test_results_are_compared_round_the_circle_and_but_for_rounding() -> None:
    expected = torch.arange(3000).remainder(256).to(torch.uint8).view(1, 3, 10, 100)
    one_up = (expected.int() + 1).remainder(256).to(torch.uint8)
    assert levels_agree(expected, expected) and levels_agree(one_up, expected)
    for wrong in (0, 2, 4):
        spoiled = expected.clone()
        spoiled.view(-1)[:wrong] += 128
        assert levels_agree(spoiled, expected) == (wrong < 3)
    assert not levels_agree((one_up + 1).to(torch.uint8), expected)
    assert not levels_agree(expected[:, :2], expected)

    outputs = (torch.linspace(-1, 1, 50), torch.ones(3))
    assert nets_agree((outputs[0] + 1e-5, outputs[1]), outputs)
    assert not nets_agree(outputs[:1], outputs) and not nets_agree(outputs[::-1], outputs)
    spoiled = outputs[0].clone()
    for value in (0.1, math.nan):
        spoiled[7] = value
        assert not nets_agree((spoiled, outputs[1]), outputs)


def test_what_is_in_half_precision_is_compared_by_what_that_loses() -> None:
    torch.manual_seed(1)
    network = build_network(TINY)
    frame = (torch.rand(1, 3, 12, 16), torch.rand(1, 12, 16), torch.tensor([3.0]))
    single = PanelLevels(network).eval()
    half = _in_half_precision(single)
    with torch.no_grad():
        levels, half_levels = single(*frame), half(*frame)
        nets, seen = _nets(network, frame)
        inputs = (network.told(frame[2]), *seen)
        outputs, half_outputs = nets(*inputs), _in_half_precision(nets)(*inputs)
    assert levels_agree(half_levels, levels, half=True) and not levels_agree(levels.flip(-1), levels, half=True)
    assert nets_agree(half_outputs, outputs, half=True)
    assert any(not torch.equal(one, other) for one, other in zip(half_outputs, outputs, strict=True))
    spoiled = (outputs[0] + 0.1 * outputs[0].abs().max(), *outputs[1:])
    assert not nets_agree(spoiled, outputs, half=True)


def test_levels_are_those_of_the_trainers_double_phase() -> None:
    torch.manual_seed(1)
    network = build_network(TINY)
    frame = (torch.rand(1, 3, 12, 16), torch.rand(1, 12, 16), torch.tensor([3.0]))
    with torch.no_grad():
        found = PanelLevels(network)(*frame)
        phase, _ = double_phase(upsample_half_band(network(*frame)), TINY.amplitude_constant)
    expected = (through_levels(phase) * (256 / (2 * math.pi))).round().to(torch.uint8)
    assert found.shape == (1, 3, 12, 16) and found.float().std() > 10
    assert levels_agree(found, expected) and not levels_agree(found.flip(-1), expected)


def test_reasons_are_what_errors_go_back_to() -> None:
    error = RuntimeError("export failed\nsee the log")
    error.__cause__ = ValueError("\x1b[96mno FFT\x1b[0m in this opset\n" + "x" * 300)
    assert reason(error) == "ValueError: no FFT in this opset"
    assert reason(KeyboardInterrupt()) == "KeyboardInterrupt"
    assert len(reason(ValueError("x" * 300))) == 160


def test_engines_are_timed_in_turn_and_put_into_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_compiler(*_: object, **__: object) -> None:
        raise RuntimeError("no C++ compiler")

    monkeypatch.setattr(torch, "compile", no_compiler)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    torch.manual_seed(1)
    weights = tmp_path / "tiny.safetensors"
    save_weights(weights, build_network(TINY), {}, {})
    program = holod(tmp_path, REPORT)
    cpus = os.sched_getaffinity(0)
    command = ["bench-engines", "--weights", str(weights), "--holod", str(program), "--resolution", "16x12"]
    command += ["--rounds", "3", "--calls", "2", "--device", "cpu", "--threads", "1"]

    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert os.sched_getaffinity(0) == cpus
    assert (result["threads"], result["resolution"], result["renderer"]) == (1, "16x12", "cpu, avx2, 1 threads")
    assert result["versions"][0] == "holod 9.9" and result["command"].endswith("--threads 1 --json")
    rows = {(row["part"], row["engine"]): row for row in result["engines"]}
    assert len(rows) == len(result["engines"]) == 11
    assert rows[WHOLE, HOLOD]["rounds_ms"] == [8.0] * 3 and rows[NETS, HOLOD]["median_ms"] == 6.0
    for part, holods_ms in ((WHOLE, 8.0), (NETS, 6.0)):
        for engine in (EAGER, "PyTorch, channels-last"):
            row = rows[part, engine]
            assert len(row["rounds_ms"]) == 3 and row["median_ms"] > 0
            assert row["times_holod"] == pytest.approx(row["median_ms"] / holods_ms)
        assert rows[part, "PyTorch, torch.compile"]["skipped"] == "RuntimeError: no C++ compiler"
        assert "onnxruntime" in rows[part, "ONNX Runtime"]["skipped"]

    assert 0.0 <= result["cpu_share_of_other_programs"] <= 1.0
    quiet, busy = ({**result, "cpu_share_of_other_programs": QUIET_SHARE + extra} for extra in (0.0, 0.2))
    assert "took 5% of the CPUs' time:" in markdown(quiet) and "cannot be relied on" not in markdown(quiet)
    assert "took 25% of the CPUs' time. **That is no quiet machine" in markdown(busy)
    table = markdown(result)
    assert "16x12, `tiny.safetensors`, " in table and ", 1 threads, " in table
    assert f"\n{result['command']}\n" in table
    assert f"\n| {WHOLE} | {HOLOD} | 8.0 | 8.0 to 8.0 | 1.00 |\n" in table
    eager = rows[NETS, EAGER]
    assert f"\n| {NETS} | {EAGER} | {eager['median_ms']:.1f} | " in table
    assert f"\n- {WHOLE}, PyTorch, torch.compile: RuntimeError: no C++ compiler\n" in table
    assert main(command) == 0
    assert capsys.readouterr().out.startswith("16x12, `tiny.safetensors`, ")

    holod(tmp_path, {**REPORT, "ceilings": None, "layers": None})
    assert main([*command, "--json"]) == 0
    rows = {(row["part"], row["engine"]): row for row in json.loads(capsys.readouterr().out)["engines"]}
    assert "does not tell" in rows[NETS, HOLOD]["skipped"] and rows[NETS, EAGER]["times_holod"] is None
    try:
        assert main([*command[:-1], str(len(cpus) + 1)]) == 65
    finally:
        torch.set_num_threads(1)
    assert "expected at most the" in capsys.readouterr().err


def test_a_network_that_no_engine_runs_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "layered.safetensors"
    config = NetworkConfig(architecture="layered", layers=4, channels=4, adjustable_layers=(2,), correction_layers=4)
    save_weights(weights, build_network(config), {}, {})
    command = ["bench-engines", "--weights", str(weights), "--holod", str(holod(tmp_path, REPORT)), "--threads", "1"]
    assert main(command) == 65
    assert "found a `layered` network" in capsys.readouterr().err
