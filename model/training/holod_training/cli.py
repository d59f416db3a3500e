"""The command line: python -m holod_training {train,evaluate,eyebox,export,golden}."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from holod_training.config import ConfigError, NetworkConfig
from holod_training.evaluate_config import EvaluateConfig
from holod_training.export import WeightsError
from holod_training.goals import ReportError
from holod_training.judging import LAYERED_ASM, OURS
from holod_training.loss import LossWeights
from holod_training.rgbd import RgbdError
from holod_training.shards import ShardError
from holod_training.solver import SolverConfig
from holod_training.train import TrainConfig, TrainingError

EX_DATAERR = 65
SOLVER_STARTS = {"network": OURS, "layered-asm": LAYERED_ASM}


def choose_device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(name)
    return torch.device(name)


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    if options.threads:
        torch.set_num_threads(options.threads)
    try:
        options.run(options)
    except (ConfigError, ReportError, RgbdError, ShardError, TrainingError, WeightsError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EX_DATAERR
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="holod_training", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, about: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=about, description=about)
        sub.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
        sub.add_argument("--threads", type=int, default=0, help="CPU threads; 0 leaves torch's own choice")
        return sub

    train = command("train", "Trains a network on shards; run under torchrun for several processes")
    train.add_argument("--shards", required=True, help="folder of training scenes; may grow while training")
    train.add_argument("--validation", help="folder of held-out scenes")
    train.add_argument("--out", required=True, help="run folder")
    train.add_argument("--steps", type=int, required=True)
    train.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    train.add_argument("--initial-weights", help="start from a weights file instead of random numbers")
    defaults, loss = TrainConfig("", "", 0), LossWeights()
    train.add_argument("--crop", type=int, default=defaults.crop)
    train.add_argument("--border-px", type=int, default=defaults.border_px, help="left out of the loss on every side")
    train.add_argument("--batch", type=int, default=defaults.batch, help="crops per process and step")
    train.add_argument("--learning-rate", type=float, default=defaults.learning_rate)
    train.add_argument("--warm-up-steps", type=int, default=defaults.warm_up_steps)
    train.add_argument("--seed", type=int, default=defaults.seed)
    train.add_argument("--layers", type=int, default=14)
    train.add_argument("--channels", type=int, default=32)
    train.add_argument("--grid", choices=("half-band", "full"), default="half-band")
    train.add_argument("--absolute-weight", type=float, default=loss.absolute)
    train.add_argument("--gradient-weight", type=float, default=loss.gradient)
    train.add_argument("--squared-weight", type=float, default=loss.squared)
    train.add_argument("--focus-weight", type=float, default=loss.focus)
    train.add_argument("--in-focus-weight", type=float, default=loss.in_focus)
    train.add_argument("--coc-floor-px", type=float, default=loss.coc_floor_px)
    train.add_argument("--validate-every", type=int, default=defaults.validate_every)
    train.add_argument("--stop-below-slope", type=float, default=defaults.stop_below_slope)
    train.set_defaults(run=_train)
    evaluate = command("evaluate", "Judges a weights file on held-out scenes and cards, beside its rivals")
    judging = EvaluateConfig(Path(), Path(), Path())
    evaluate.add_argument("--weights", required=True)
    evaluate.add_argument(
        "--test", required=True, help="folder of held-out scenes of one size and with the same pupils"
    )
    evaluate.add_argument("--cards", help="folder of refocus cards")
    evaluate.add_argument("--out", required=True)
    evaluate.add_argument("--limit", type=int, help="only so many scenes")
    evaluate.add_argument("--also", action="append", default=[], help="another weights file to judge too; repeatable")
    evaluate.add_argument("--rgbd", help="folder with rgb/NAME.jpg and depth/NAME.png (millimetres): adds a sheet")
    evaluate.add_argument("--border-px", type=int, default=judging.border_px, help="left out on every side")
    evaluate.add_argument(
        "--solver-scenes", type=int, default=judging.solver_scenes, help="scenes for direct optimisation; 0: none"
    )
    evaluate.add_argument("--solver-start", choices=tuple(SOLVER_STARTS), default="network")
    evaluate.add_argument("--solver-iterations", type=int, default=judging.solver.iterations)
    evaluate.add_argument("--solver-frames", type=_list_of(int), default=judging.solver_frames, help="such as 1,2,3")
    evaluate.add_argument("--solver-focus-weight", type=float, default=judging.solver.loss.focus)
    evaluate.add_argument("--solver-in-focus-weight", type=float, default=judging.solver.loss.in_focus)
    evaluate.add_argument(
        "--focus-curve-weights",
        type=_list_of(float),
        default=judging.focus_curve_weights,
        help="in-focus weights, such as 0,30,100,300: adds the curve between sharp in focus and soft out of it",
    )
    evaluate.add_argument("--timing-calls", type=int, default=judging.timing_calls)
    evaluate.set_defaults(run=_evaluate)

    eyebox = command("eyebox", "Shows where the light is in the pupil's plane, and how far an eye may move")
    eyebox.add_argument("--weights", required=True)
    eyebox.add_argument("--test", required=True, help="folder of held-out scenes")
    eyebox.add_argument("--out", required=True)
    eyebox.add_argument("--limit", type=int, help="only so many scenes")
    eyebox.set_defaults(run=_eyebox)

    export = command("export", "Writes a weights file from a checkpoint or another weights file")
    export.add_argument(
        "--source", required=True, help="checkpoint.pt of a run (its averaged weights) or a weights file"
    )
    export.add_argument("--out", required=True)
    export.add_argument("--amplitude-constant", type=float, help="double phase's K; the source's own where left out")
    export.add_argument("--evaluation", help="evaluation.json whose numbers the file is to carry")
    export.set_defaults(run=_export)

    golden = command("golden", "Writes the golden vectors that the engines are tested against")
    golden.add_argument("--out", required=True, help="folder, model/golden")
    golden.add_argument("--weights", help="the shipped weights file, for vectors of it too")
    golden.add_argument("--seed", type=int, default=20)
    golden.set_defaults(run=_golden)
    return parser


def _list_of(kind: type[int] | type[float]) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        return tuple(kind(part) for part in text.split(","))

    parse.__name__ = f"comma-separated {kind.__name__}"
    return parse


def _evaluate(options: argparse.Namespace) -> None:
    from holod_training.evaluate import evaluate
    from holod_training.report import markdown

    loss = LossWeights(focus=options.solver_focus_weight, in_focus=options.solver_in_focus_weight)
    config = EvaluateConfig(
        weights=Path(options.weights),
        test=Path(options.test),
        out=Path(options.out),
        cards=Path(options.cards) if options.cards else None,
        rgbd=Path(options.rgbd) if options.rgbd else None,
        also=tuple(Path(path) for path in options.also),
        limit=options.limit,
        border_px=options.border_px,
        solver=SolverConfig(iterations=options.solver_iterations, loss=loss),
        solver_start=SOLVER_STARTS[options.solver_start],
        solver_scenes=options.solver_scenes,
        solver_frames=options.solver_frames,
        focus_curve_weights=options.focus_curve_weights,
        timing_calls=options.timing_calls,
    )
    print(markdown(evaluate(config, choose_device(options.device))), end="")


def _eyebox(options: argparse.Namespace) -> None:
    from holod_training.eyebox import write_eyebox

    print(write_eyebox(Path(options.weights), Path(options.test), Path(options.out), options.limit), end="")


def _export(options: argparse.Namespace) -> None:
    from holod_training.export import export

    evaluation = Path(options.evaluation) if options.evaluation else None
    print(export(Path(options.source), Path(options.out), options.amplitude_constant, evaluation))


def _golden(options: argparse.Namespace) -> None:
    from holod_training.golden import write_golden

    shipped = Path(options.weights) if options.weights else None
    for path in write_golden(Path(options.out), shipped, options.seed):
        print(path)


def _train(options: argparse.Namespace) -> None:
    from holod_training.train import train

    config = TrainConfig(
        shards=options.shards,
        out=options.out,
        steps=options.steps,
        validation=options.validation,
        network=NetworkConfig(
            grid=options.grid,
            layers=options.layers,
            channels=options.channels,
            adjustable_layers=(options.layers // 2,),
        ),
        loss=LossWeights(
            absolute=options.absolute_weight,
            gradient=options.gradient_weight,
            squared=options.squared_weight,
            focus=options.focus_weight,
            coc_floor_px=options.coc_floor_px,
            in_focus=options.in_focus_weight,
        ),
        crop=options.crop,
        border_px=options.border_px,
        batch=options.batch,
        learning_rate=options.learning_rate,
        warm_up_steps=options.warm_up_steps,
        seed=options.seed,
        validate_every=options.validate_every,
        stop_below_slope=options.stop_below_slope,
        initial_weights=options.initial_weights,
    )
    print(train(config, choose_device(options.device), options.resume))
