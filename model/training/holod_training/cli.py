"""The command line: `python -m holod_training COMMAND`, where each command is a file of that name."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from holod_training.bench_engines import BenchError, Plan, bench_engines, markdown
from holod_training.benches import ANY_BENCH, BenchDraw
from holod_training.config import CONDITIONINGS, ConfigError, NetworkConfig, TrainedRange, require
from holod_training.evaluate_config import EvaluateConfig
from holod_training.export import WeightsError, read_metadata
from holod_training.goals import ReportError
from holod_training.judging import LAYERED_ASM, OURS
from holod_training.loss import LossWeights, option_of
from holod_training.metrics import JudgementError
from holod_training.optimizer import OPTIMIZERS
from holod_training.rgbd import RgbdError
from holod_training.sampling import AugmentConfig
from holod_training.shards import ShardError
from holod_training.solver import SolverConfig
from holod_training.train import PRECISIONS, TrainConfig, TrainingError, train
from holod_training.variants import DEFAULT_VARIANT, VARIANTS, variant

EX_DATAERR = 65
EX_INTERRUPTED = 128 + signal.SIGINT
FORCE_HELP = "overwrite what is there already"
SOLVER_STARTS = {"network": OURS, "layered-asm": LAYERED_ASM}


def choose_device(name: str) -> torch.device:
    """Raises ConfigError for a GPU that is not there."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    met = name != "cuda" or torch.cuda.is_available()
    require("--device", name, met, "cpu or auto: PyTorch finds no GPU that it can use")
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(name)
    return torch.device(name)


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    options.arguments = sys.argv[1:] if arguments is None else arguments
    try:
        require("--threads", options.threads, options.threads >= 0, "at least 0")
        if options.threads:
            torch.set_num_threads(options.threads)
        options.run(options)
    except (
        *(BenchError, ConfigError, JudgementError, ReportError),
        *(RgbdError, ShardError, TrainingError, WeightsError),
    ) as error:
        print(f"error: {error}", file=sys.stderr)
        return EX_DATAERR
    except OSError as error:
        named = f"{error.filename2 or error.filename}: " if error.filename else ""
        print(f"error: {named}{error.strerror or error}", file=sys.stderr)
        return EX_DATAERR
    except KeyboardInterrupt as interrupt:
        print(f"interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr)
        return EX_INTERRUPTED
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="holod_training", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, about: str, has_device: bool = True) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=about, description=about)
        if has_device:
            sub.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
        sub.add_argument("--threads", type=int, default=0, help="CPU threads; 0 leaves torch's own choice")
        return sub

    training = command("train", "Trains a network on shards; run under torchrun for several processes")
    _training_options(training)
    training.add_argument("--steps", type=int, required=True)
    training.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    training.add_argument(
        "--initial-weights",
        help="start from a weights file of the same variant, whose ranges and amplitude constant stay unless named",
    )
    training.add_argument("--stop-below-slope", type=float, default=TrainConfig("", "", 1).stop_below_slope)
    _network_options(training)
    training.set_defaults(run=_train)

    comparison = command("compare", "Trains several variants for the same time each and judges them in one table")
    _training_options(comparison)
    comparison.add_argument("--variants", required=True, help=f"commas between: {', '.join(VARIANTS)}")
    comparison.add_argument("--minutes", type=float, required=True, help="training time of each variant")
    comparison.set_defaults(run=_compare)

    evaluate = command("evaluate", "Judges a weights file on held-out scenes and cards, beside its rivals")
    judging = EvaluateConfig(Path(), Path(), Path())
    evaluate.add_argument("--weights", required=True)
    evaluate.add_argument(
        "--test", required=True, help="folder of held-out scenes of one size and with the same pupils"
    )
    evaluate.add_argument("--cards", help="folder of refocus cards")
    evaluate.add_argument("--marks", help="folder of bright marks on exact black")
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
    evaluate.add_argument(
        "--judge-between",
        action="store_true",
        help="the solver knows the images at every second focus, and everything is judged at those between",
    )
    _lpips_options(evaluate, "adds its column")
    evaluate.add_argument("--timing-calls", type=int, default=judging.timing_calls)
    evaluate.set_defaults(run=_evaluate)

    across = command("across-benches", "Judges weights files on several benches beside smooth phase, in one table")
    across.add_argument("--weights", action="append", required=True, help="repeatable")
    across.add_argument(
        "--test", action="append", required=True, help="folder of held-out scenes, rendered for one bench; repeatable"
    )
    across.add_argument(
        "--cards", action="append", default=[], help="folder of refocus cards, named as that of --test; repeatable"
    )
    across.add_argument("--out", required=True)
    across.add_argument("--border-px", type=int, default=judging.border_px, help="left out on every side")
    across.add_argument("--limit", type=int, help="only so many scenes")
    across.set_defaults(run=_across_benches)

    about = "Writes the pages of an evaluation and of a table across benches again from their figures"
    report = command("report", about, has_device=False)
    report.add_argument("--folder", required=True, help="with evaluation.json, benches.json or both")
    report.set_defaults(run=_report)

    eyebox = command("eyebox", "Shows where the light is in the pupil's plane, and how far an eye may move")
    eyebox.add_argument("--weights", required=True)
    eyebox.add_argument("--test", required=True, help="folder of held-out scenes")
    eyebox.add_argument("--out", required=True)
    eyebox.add_argument("--limit", type=int, help="only so many scenes")
    eyebox.set_defaults(run=_eyebox)

    export = command("export", "Writes a weights file from a checkpoint or another weights file", has_device=False)
    export.add_argument(
        "--source", required=True, help="checkpoint.pt of a run (its averaged weights) or a weights file"
    )
    export.add_argument("--out", required=True)
    export.add_argument("--force", action="store_true", help=FORCE_HELP)
    export.add_argument(
        "--amplitude-constant",
        type=float,
        help="double phase's K; the source's own where left out, whose figures another one leaves out",
    )
    export.add_argument("--evaluation", help="evaluation.json whose numbers the file is to carry")
    export.add_argument("--evaluation-method", default="holod", help="whose rows of it: another file named by --also")
    export.add_argument("--benches", help="benches.json of across-benches, whose numbers the file is to carry")
    export.add_argument("--benches-method", default="", help="whose rows of it; the name of --out where left out")
    export.set_defaults(run=_export)

    about = "Writes the weighted mean of weights files that went on from the same weights"
    mean = command("average", about, has_device=False)
    mean.add_argument(
        "--weights", nargs=2, action="append", required=True, metavar=("FILE", "SHARE"), help="more than once; sum 1"
    )
    mean.add_argument("--out", required=True)
    mean.add_argument("--force", action="store_true", help=FORCE_HELP)
    mean.set_defaults(run=_average)

    golden = command("golden", "Writes the golden vectors that the engines are tested against", has_device=False)
    golden.add_argument("--out", required=True, help="folder, model/golden")
    golden.add_argument("--force", action="store_true", help=FORCE_HELP)
    golden.add_argument("--weights", help="the shipped standard weights, for vectors of them too")
    golden.add_argument("--small-weights", help="the shipped small weights, likewise")
    golden.add_argument("--fast-weights", help="the shipped fast weights, likewise")
    golden.add_argument("--seed", type=int, default=20)
    golden.set_defaults(run=_golden)

    engines = command("bench-engines", "Times a weights file in holod and in PyTorch, in turn, to panel levels")
    engines.add_argument("--weights", required=True)
    engines.add_argument("--holod", required=True, help="the program, built with --release")
    engines.add_argument("--resolution", type=_resolution, default=(512, 512), metavar="WxH")
    engines.add_argument("--rounds", type=int, default=7, help="how often the engines take turns")
    engines.add_argument("--backend", default="auto", choices=("auto", "gpu", "gpu-half"), help="of holod, on a GPU")
    engines.add_argument("--calls", type=int, default=5, help="frames of each engine in each round")
    engines.add_argument("--json", action="store_true", help="print the figures as JSON")
    engines.set_defaults(run=_bench_engines)
    return parser


def _training_options(sub: argparse.ArgumentParser) -> None:
    defaults, loss = TrainConfig("", "", 1), LossWeights()
    sub.add_argument("--shards", required=True, help="folder of training scenes; may grow while training")
    sub.add_argument("--validation", help="folder of held-out scenes")
    sub.add_argument("--out", required=True, help="run folder")
    sub.add_argument(
        "--benches",
        choices=("scenes", "any"),
        default="scenes",
        help="those that the scenes were rendered for, or any: each crop on a random one; see benches.py",
    )
    sub.add_argument("--volume-blur-px", type=_list_of(float), metavar="LOW,HIGH", help="what the network is for")
    sub.add_argument("--volume-fresnel-px2", type=_list_of(float), metavar="LOW,HIGH", help="likewise")
    sub.add_argument("--crop", type=int, default=defaults.crop)
    sub.add_argument("--border-px", type=int, default=defaults.border_px, help="left out of the loss on every side")
    sub.add_argument("--validation-border-px", type=int, default=defaults.validation_border_px)
    sub.add_argument("--batch", type=int, default=defaults.batch, help="crops per process and step")
    sub.add_argument("--learning-rate", type=float, default=defaults.learning_rate)
    sub.add_argument("--optimizer", choices=OPTIMIZERS, default=defaults.optimizer)
    sub.add_argument("--warm-up-steps", type=int, default=defaults.warm_up_steps)
    sub.add_argument("--seed", type=int, default=defaults.seed)
    sub.add_argument("--precision", choices=PRECISIONS, default=defaults.precision, help="of convolutions in training")
    sub.add_argument(
        "--double-phase",
        type=float,
        metavar="K",
        help="the loss is of what a panel shows after double phase with this amplitude constant, not of the field; the "
        "weights keep it",
    )
    sub.add_argument("--teacher", help="weights file whose pictures the loss compares too")
    _lpips_options(sub, "adds LPIPS to the loss")
    sub.add_argument("--validate-every", type=int, default=defaults.validate_every)
    sub.add_argument("--validation-scenes", type=int, default=defaults.validation_scenes)
    sub.add_argument(
        "--faulty-depth", type=float, default=defaults.augment.faulty_depth, help="chance of a poor camera's depth"
    )
    for term in dataclasses.fields(LossWeights):
        sub.add_argument(option_of(term.name), dest=f"loss_{term.name}", type=float, default=getattr(loss, term.name))


def _lpips_options(sub: argparse.ArgumentParser, effect: str) -> None:
    sub.add_argument("--lpips-backbone", help=f"torchvision's AlexNet state dict; with the linear layers {effect}")
    sub.add_argument("--lpips-linear", help="LPIPS's authors' linear layers, lin0.model.1.weight and so on")


def _network_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--variant", choices=VARIANTS, default=DEFAULT_VARIANT, help="what the options below change")
    sub.add_argument("--layers", type=int, help="the adjustable layer moves to the middle unless it is named too")
    sub.add_argument("--channels", type=int)
    sub.add_argument("--grid", choices=("half-band", "full"))
    sub.add_argument("--adjustable-layers", type=_list_of(int), metavar="I,I,..")
    sub.add_argument("--dilations", type=_list_of(int), metavar="D,D,..", help="one for each layer")
    sub.add_argument("--conditioning", choices=CONDITIONINGS)
    sub.add_argument("--pupil-inputs", action=argparse.BooleanOptionalAction)
    sub.add_argument("--blur-input", action=argparse.BooleanOptionalAction)
    sub.add_argument("--frames", type=int)
    sub.add_argument("--specialists-mm", type=_list_of(float), metavar="MM,MM,..")
    sub.add_argument("--depth-layers", type=int)
    sub.add_argument("--correction-layers", type=int)
    sub.add_argument("--correction-dilations", type=_list_of(int), metavar="D,D,..")
    sub.add_argument("--transport-prior", action=argparse.BooleanOptionalAction)
    sub.add_argument("--refined-stack", action=argparse.BooleanOptionalAction)
    sub.add_argument("--planes", type=int)
    sub.add_argument("--feedback", action=argparse.BooleanOptionalAction)


def _network(options: argparse.Namespace) -> NetworkConfig:
    base = variant(options.variant)
    named = {f.name: getattr(options, f.name, None) for f in dataclasses.fields(NetworkConfig)}
    changes = {key: value for key, value in named.items() if value is not None}
    if "layers" in changes and base.adjustable_layers:
        changes.setdefault("adjustable_layers", (options.layers // 2,))
    return dataclasses.replace(base, **changes)


def _train_config(options: argparse.Namespace, **changes: Any) -> TrainConfig:
    values = {f.name: getattr(options, f.name) for f in dataclasses.fields(TrainConfig) if hasattr(options, f.name)}
    loss = LossWeights(**{f.name: getattr(options, f"loss_{f.name}") for f in dataclasses.fields(LossWeights)})
    augment = AugmentConfig(faulty_depth=options.faulty_depth)
    config = TrainConfig(**{**values, "loss": loss, "augment": augment, **changes})
    ranges = {f.name: getattr(options, f.name) for f in dataclasses.fields(TrainedRange)}
    # What weights are for, and with which constant, stays with those that go on from them.
    start = read_metadata(Path(config.initial_weights))["config"] if config.initial_weights else config.network
    trained = dataclasses.replace(
        ANY_BENCH if options.benches == "any" else start.trained,
        **{key: value for key, value in ranges.items() if value is not None},
    )
    benches = BenchDraw(trained) if options.benches == "any" else None
    constant = config.double_phase or start.amplitude_constant
    network = dataclasses.replace(config.network, trained=trained, amplitude_constant=constant)
    return dataclasses.replace(config, benches=benches, network=network)


def _compare(options: argparse.Namespace) -> None:
    from holod_training.compare import compare

    names = [name for name in options.variants.split(",") if name]
    # Steps come of the minutes.
    print(compare(_train_config(options, steps=1), names, 60 * options.minutes, choose_device(options.device)), end="")


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
        marks=Path(options.marks) if options.marks else None,
        rgbd=Path(options.rgbd) if options.rgbd else None,
        also=tuple(Path(path) for path in options.also),
        limit=options.limit,
        border_px=options.border_px,
        solver=SolverConfig(iterations=options.solver_iterations, loss=loss),
        solver_start=SOLVER_STARTS[options.solver_start],
        solver_scenes=options.solver_scenes,
        solver_frames=options.solver_frames,
        focus_curve_weights=options.focus_curve_weights,
        judge_between=options.judge_between,
        timing_calls=options.timing_calls,
        lpips_backbone=Path(options.lpips_backbone) if options.lpips_backbone else None,
        lpips_linear=Path(options.lpips_linear) if options.lpips_linear else None,
    )
    print(markdown(evaluate(config, choose_device(options.device))), end="")


def _report(options: argparse.Namespace) -> None:
    from holod_training import across_benches, report

    pages: dict[str, Callable[[dict[str, Any]], str]] = {
        "evaluation": report.markdown,
        "benches": across_benches.markdown,
    }
    for path in report.rewrite(Path(options.folder), pages):
        print(path)


def _eyebox(options: argparse.Namespace) -> None:
    from holod_training.eyebox import write_eyebox

    weights, test, out = Path(options.weights), Path(options.test), Path(options.out)
    print(write_eyebox(weights, test, out, options.limit, choose_device(options.device)), end="")


def _export(options: argparse.Namespace) -> None:
    from holod_training.export import export

    evaluation, benches = (Path(path) if path else None for path in (options.evaluation, options.benches))
    print(
        export(
            Path(options.source),
            Path(options.out),
            options.amplitude_constant,
            evaluation,
            options.evaluation_method,
            benches,
            options.benches_method,
            options.force,
        )
    )


def _average(options: argparse.Namespace) -> None:
    from holod_training.average import average

    print(average([(Path(path), _share(share)) for path, share in options.weights], Path(options.out), options.force))


def _share(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise WeightsError(f"found a share of {text!r}, expected a number") from None


def _golden(options: argparse.Namespace) -> None:
    from holod_training.golden import write_golden

    named = (options.weights, options.small_weights, options.fast_weights)
    standard, small, fast = (Path(path) if path else None for path in named)
    for path in write_golden(Path(options.out), standard, small, fast, options.seed, options.force):
        print(path)


def _resolution(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)


_resolution.__name__ = "WxH"


def _across_benches(options: argparse.Namespace) -> None:
    from holod_training.across_benches import across_benches

    weights, folders, cards = ([Path(path) for path in of] for of in (options.weights, options.test, options.cards))
    device = choose_device(options.device)
    print(across_benches(weights, folders, Path(options.out), options.border_px, options.limit, device, cards))


def _bench_engines(options: argparse.Namespace) -> None:
    width, height = options.resolution
    plan = Plan(
        weights=Path(options.weights),
        holod=Path(options.holod),
        width=width,
        height=height,
        rounds=options.rounds,
        calls=options.calls,
        device=choose_device(options.device),
        backend=options.backend,
    )
    result = bench_engines(plan, ["python", "-m", "holod_training", *options.arguments])
    print(json.dumps(result, indent=1) if options.json else markdown(result), end="\n" if options.json else "")


def _train(options: argparse.Namespace) -> None:
    print(train(_train_config(options, network=_network(options)), choose_device(options.device), options.resume))
