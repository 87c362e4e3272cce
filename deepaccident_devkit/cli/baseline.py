"""`deepaccident baseline`: results of the baselines, and the study of V2X with them."""

from typing import Any, get_args

import click

from deepaccident_devkit.baselines import MOTION_MODELS, Baseline, StudyConfig, predict_results, v2x_study
from deepaccident_devkit.baselines.figures import save_study
from deepaccident_devkit.cli.evaluate_options import resamples_parameter
from deepaccident_devkit.cli.options import release_parameters
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS
from deepaccident_devkit.evaluation.results import ResultsTask
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.motion.sample_lists import Scope
from deepaccident_devkit.statistics import writable_folder
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import AGENT_CONFIGS, Link

_RELEASED_HORIZON = Baseline().horizon
_FILES: dict[str, str] = {"motion": "motion", "accident": "accident.json", "detection": "detection.json"}
_SPLIT = click.option("--split", default="val", show_default=True, help="val, …, or a split file (….txt).")
_OUT = click.option("--out", required=True, type=click.Path(), metavar="DIR", help="Where the files go.")
_MODEL = click.option("--model", type=click.Choice(list(MOTION_MODELS)), default="constant_velocity", show_default=True)
_SEED = click.option("--seed", default=0, show_default=True, help="Of the pose noise.")


@click.group()
def baseline() -> None:
    """Predict without a model: what some agents see by the labels goes on as it moves."""


@baseline.command()
@release_parameters
@_SPLIT
@click.option(
    "--task",
    "tasks",
    multiple=True,
    type=click.Choice([*get_args(ResultsTask), "all"]),
    default=("all",),
    show_default=True,
    help="May be repeated.",
)
@click.option("--agents", type=click.Choice(list(AGENT_CONFIGS)), default="single", show_default=True)
@_MODEL
@click.option("--latency", default=0.0, show_default=True, help="Of the partners' data, seconds, steps of 0.1.")
@click.option("--pose-noise", default=0.0, show_default=True, help="Of the partners' poses, metres.")
@_SEED
@click.option("--horizon", default=_RELEASED_HORIZON, show_default=True, help="Seconds ahead, steps of 0.5.")
@click.option(
    "--samples",
    "purpose",
    type=click.Choice(["evaluate", "all"]),
    default="evaluate",
    show_default=True,
    help="Those that are evaluated, within the horizon before the end; or two a second of every scenario.",
)
@click.option("--scope", type=click.Choice(get_args(Scope)), default="accident", show_default=True)
@_OUT
def predict(split: str, tasks: tuple[str, ...], purpose: Any, scope: Scope, out: str, **options: Any) -> None:
    """Write a baseline's results for a split of the release under DATAROOT: motion/, accident.json, detection.json."""
    noise, latency, seed = options.pop("pose_noise"), options.pop("latency"), options.pop("seed")
    link = Link(latency=latency, pose_noise=noise or None, seed=seed) if noise or latency else None
    chosen = Baseline(link=link, **{name: options.pop(name) for name in ("agents", "model", "horizon")})
    folder = writable_folder(out)
    dataset = DeepAccident(**options)
    released = chosen.horizon == _RELEASED_HORIZON and scope == "accident"
    tokens = dataset.samples(split, purpose, "released" if released else "paper", horizon=chosen.horizon, scope=scope)
    for task in get_args(ResultsTask):
        if task in tasks or "all" in tasks:
            path = folder / _FILES[task]
            predict_results(dataset, task, tokens, path, chosen, workers=options["workers"], progress=True)
            click.echo(f"{task}: {len(tokens):,} samples in {path}")


@baseline.command()
@release_parameters
@_SPLIT
@_MODEL
@click.option(
    "--ego", "egos", multiple=True, type=click.Choice(AGENTS), help="May be repeated.  [default: ego_vehicle]"
)
@click.option("--scope", type=click.Choice(get_args(Scope)), default="accident", show_default=True)
@click.option(
    "--protocol",
    type=click.Choice(list(PROTOCOLS)),
    default="paper",
    show_default=True,
    help="Of the accidents in maps; those named explicitly are always evaluated by boxes.",
)
@click.option(
    "--seed", "seeds", multiple=True, type=int, help="Of the pose noise; may be repeated.  [default: 0, 1, 2]"
)
@resamples_parameter
@click.option("--quick", is_flag=True, help="Fewer horizons and steps of noise and latency.")
@_OUT
def v2x(split: str, egos: tuple[str, ...], seeds: tuple[int, ...], resamples: int, out: str, **options: Any) -> None:
    """Print what seven sets of agents foresee of the release under DATAROOT; write a CSV and a picture a table."""
    how = {name: options.pop(name) for name in ("model", "scope", "protocol", "quick")}
    usual = StudyConfig()
    how |= {"egos": egos or usual.egos, "seeds": seeds or usual.seeds, "resampling": Resampling(resamples=resamples)}
    config = StudyConfig(**how)
    folder = writable_folder(out)
    study = v2x_study(DeepAccident(**options), split, config, workers=options["workers"], progress=True)
    click.echo(study.to_text())
    written = [*study.to_csv(folder), *save_study(study, folder), folder / "v2x_study.json"]
    write_bytes(written[-1], study.to_json().encode())
    click.echo(f"written: {len(written)} files in {folder}")
