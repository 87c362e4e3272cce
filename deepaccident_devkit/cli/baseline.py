"""`deepaccident baseline predict`: results files of the baselines."""

from typing import Any, get_args

import click

from deepaccident_devkit.baselines import MOTION_MODELS, Baseline, predict_results
from deepaccident_devkit.baselines.predict_results import is_predicted
from deepaccident_devkit.cli.evaluate_options import purpose_parameter, scope_parameter
from deepaccident_devkit.cli.options import (
    LINK_OPTIONS,
    WordChoice,
    cooperating_parameter,
    engine_of,
    link_of,
    link_parameters,
    names_or_configuration,
    refuse_unused,
    release_parameters,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.results import RESULTS_NAMES, ResultsTask
from deepaccident_devkit.files import writable_folder
from deepaccident_devkit.motion.sample_lists import Scope, no_samples_text

_ALONE = "single"
_RELEASED_HORIZON = Baseline().horizon


@click.group()
def baseline() -> None:
    """Make predictions without a trained model: actors that some agents see keep their motion."""


@baseline.command()
@release_parameters
@click.option("--split", default="val", show_default=True, help="Name of a split, or a split file (.txt).")
@click.option(
    "--task",
    "tasks",
    multiple=True,
    type=WordChoice([*get_args(ResultsTask), "all"]),
    default=("all",),
    show_default=True,
    help="Task to write results for; you can repeat this option.",
)
@cooperating_parameter("Agents that share what they see", _ALONE)
@click.option(
    "--model",
    type=WordChoice(MOTION_MODELS),
    default="constant_velocity",
    show_default=True,
    help="How the baseline moves each actor into the future.",
)
@link_parameters
@click.option(
    "--horizon", default=_RELEASED_HORIZON, show_default=True, help="How many seconds to predict, in steps of 0.5."
)
@purpose_parameter
@scope_parameter
@click.option("--out", required=True, type=click.Path(), metavar="DIR", help="Folder to write the files into.")
def predict(split: str, tasks: tuple[str, ...], purpose: Any, scope: Scope, out: str, **options: Any) -> None:
    """Write results files of a baseline for one split of the release in DATAROOT.

    The files are motion/, accident.json and detection.json. If the command is interrupted, the same command continues.
    """
    link = link_of(options)
    options["agents"] = names_or_configuration(options["agents"]) or _ALONE
    if options["agents"] == _ALONE:
        refuse_unused("with --agents single, which has no partners", *LINK_OPTIONS)
    if link is None or not (link.pose_noise or link.packet_loss):
        refuse_unused("without --pose-noise or --packet-loss", "seed")
    if purpose == "all":
        refuse_unused("with --samples all, which are those of all scenarios", "scope")
    chosen = Baseline(link=link, **{name: options.pop(name) for name in ("agents", "model", "horizon")})
    folder = writable_folder(out)
    dataset = DeepAccident(**options)
    released = chosen.horizon == _RELEASED_HORIZON and scope == "accident"
    tokens = dataset.samples(split, purpose, "released" if released else "paper", horizon=chosen.horizon, scope=scope)
    if not tokens:
        raise NotAvailableError(f"{split}: has no samples to predict; {no_samples_text(dataset, split, scope)}")
    run = {**engine_of(options), "progress": True}
    wanted = [task for task in get_args(ResultsTask) if task in tasks or "all" in tasks]
    for task in wanted:
        path = folder / RESULTS_NAMES[task]
        kept = is_predicted(dataset, task, tokens, path, chosen)
        predict_results(dataset, task, tokens, path, chosen, **run)
        click.echo(f"{task}: {len(tokens):,} samples in {path}{', which were there already' if kept else ''}")
