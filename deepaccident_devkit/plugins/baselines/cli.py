"""`deepaccident predict`: results files of a trained model, or of a baseline that needs none."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.agents import (
    cooperating_parameter,
    link_parameters,
    names_or_configuration,
)
from deepaccident_devkit.cli.options import (
    PATH,
    engine_of,
    model_parameters,
    open_release,
    refuse_unused,
    release_of,
    release_parameters,
    seed_parameter,
    use_threads_sparingly,
    words_of,
)
from deepaccident_devkit.cli.verbs import WordChoice, field_option, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.results import RESULTS_NAMES
from deepaccident_devkit.evaluation.runs.setups import agent_of
from deepaccident_devkit.plugins.baselines import MOTION_MODELS, Baseline, predict_results
from deepaccident_devkit.plugins.baselines.predict_results import is_predicted
from deepaccident_devkit.selection.samples import no_samples_text
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.parallel import workers_kept
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.taxonomy import SHIPPED_WEIGHTS, VEHICLE_AGENTS
from deepaccident_devkit.v2x import Link
from deepaccident_devkit.v2x.messages import Payload

_SINGLE_AGENT = "single"
# Names of the link's options as parameters of a verb.
_LINK_OPTIONS = ("latency", "pose_noise", "packet_loss", "seed", "budget")
_RELEASED_HORIZON = Baseline().horizon
# Default tasks, which are the tasks of trained models.
_DEFAULT_TASKS = ("motion", "accident", "detection")
_EXAMPLES = """\b
Examples:
  deepaccident predict constant_velocity DATAROOT --agents all --out baseline
  deepaccident predict standing DATAROOT --task planning,forecasting --samples all --out paths
  deepaccident predict runs/all DATAROOT --split val --out results
  deepaccident predict runs/all DATAROOT --agents single --out results_single
  deepaccident evaluate motion DATAROOT --results results/motion --switch labels=clean"""


@verb(epilog=_EXAMPLES)
@click.argument("model")
@release_parameters
@click.option(
    "--split", default="val", show_default=True, help="Name of a split, or a split file (.txt)."
)
@cooperating_parameter("Agents that cooperate with each ego", "all; of a baseline: single")
@click.option(
    "--task",
    "tasks",
    multiple=True,
    metavar="NAME[,NAME…]",
    default=_DEFAULT_TASKS,
    help=f"Of a baseline: tasks to write results for: {', '.join(RESULTS_NAMES)}, or all.  "
    f"[default: {','.join(_DEFAULT_TASKS)}]",
)
@click.option(
    "--horizon",
    default=_RELEASED_HORIZON,
    show_default=True,
    help="Of a baseline: how many seconds to predict, in steps of 0.5; planning and forecasting "
    "predict at least 3.",
)
@link_parameters()
@field_option(Link, "packet_loss")
@field_option(Link, "budget", type=click.IntRange(1), metavar="BYTES")
@seed_parameter
@click.option(
    "--samples",
    "purpose",
    type=WordChoice(["evaluate", "all"]),
    default="evaluate",
    show_default=True,
    help="evaluate: samples within the horizon before the end. all: two samples per second of each "
    "scenario.",
)
@click.option(
    "--scope",
    type=WordChoice(["accident", "all"]),
    default="accident",
    show_default=True,
    help="Accident scenarios only, or all scenarios.",
)
@model_parameters
@click.option("--out", required=True, type=PATH, metavar="DIR", help="Folder to write into.")
def predict(model: str, purpose: Any, **options: Any) -> None:
    """Predict a split of the release in DATAROOT.

    MODEL is the folder of a run of `deepaccident train`, a file of weights, or `tiny` or
    `tiny_lidar`, which the devkit ships. Or a baseline, which needs no training:
    `constant_velocity`, `constant_turn_rate` or `standing` say how actors go on that some agents
    see. The files motion/, accident.json, … are what `deepaccident evaluate` takes. The path that a
    baseline plans for a vehicle is its own, if it goes on so.
    """
    if not Path(model).exists():  # a wrong name fails before PyTorch is imported
        names = (*MOTION_MODELS, *SHIPPED_WEIGHTS)
        model = choice("MODEL, which is no file and no folder", model, names)
    if purpose == "all":
        refuse_unused("with --samples all, which are those of all scenarios", "scope")
    is_baseline = model in MOTION_MODELS
    seed = options["seed"]
    link = _pop_link(options, "boxes" if is_baseline else "bev")
    agents = names_or_configuration(options.pop("agents"))
    write_predictions = _predict_with_baseline if is_baseline else _predict_with_network
    write_predictions(model, purpose, agents=agents, link=link, seed=seed, **options)


@workers_kept()
def _predict_with_baseline(
    model: Any, purpose: Any, *, agents: Any, link: Link | None, out: Path, **options: Any
) -> None:
    """Write a baseline's results of each task."""
    refuse_unused("with a baseline", "device", "images_cache")
    agents = agents or _SINGLE_AGENT
    if agents == _SINGLE_AGENT:
        refuse_unused("with --agents single, which has no partners", *_LINK_OPTIONS)
    if link is None or not (link.pose_noise or link.packet_loss):
        refuse_unused("without --pose-noise or --packet-loss", "seed")
    words = [choice("--task", word, (*RESULTS_NAMES, "all")) for word in words_of(options["tasks"])]
    tasks = [task for task in RESULTS_NAMES if task in words or "all" in words]
    baseline = Baseline(agents=agents, model=model, link=link, horizon=options["horizon"])
    folder = writable_folder(out)
    is_released = baseline.horizon == _RELEASED_HORIZON and options["scope"] == "accident"
    rules = "released" if is_released else "paper"
    engine = engine_of(options)
    dataset = open_release(**release_of(options), **engine)
    tokens = _samples(dataset, purpose, rules, baseline.horizon, options)
    for task in tasks:
        path, task_tokens = folder / RESULTS_NAMES[task], tokens
        if task == "planning":
            task_tokens = [token for token in tokens if agent_of(token) in VEHICLE_AGENTS]
        was_predicted = is_predicted(dataset, task, task_tokens, path, baseline)
        predict_results(dataset, task, task_tokens, path, baseline, **engine, progress=True)
        note = ", which were there already" if was_predicted else ""
        click.echo(f"{task}: {counted(len(task_tokens), 'sample')} in {path}{note}")


def _predict_with_network(
    model: str, purpose: Any, *, agents: Any, link: Link | None, seed: int, **options: Any
) -> None:
    """Write a trained model's results of all tasks."""
    refuse_unused(
        "with a trained model, which predicts all tasks as far as it was trained",
        "tasks",
        "horizon",
    )
    refuse_unused("with a trained model, which runs on this machine", "scheduler")
    if agents == _SINGLE_AGENT:
        link_options = [name for name in _LINK_OPTIONS if name != "seed"]
        refuse_unused("with --agents single, which has no partners", *link_options)
    need_plugin("model", "a trained model")
    use_threads_sparingly()
    from deepaccident_devkit.plugins.model import (
        PredictConfig,
        checked_device,
        load_model,
        predict_results,
        scores_text,
    )

    device = checked_device(options["device"])
    network = load_model(Path(model)).to(device)
    dataset = open_release(**release_of(options))
    tokens = _samples(dataset, purpose, "paper", network.config.horizon, options)
    config = PredictConfig(
        agents=agents or "all",
        link=link,
        seed=seed,
        device=device,
        workers=options["workers"] or 0,
        images_cache=options["images_cache"],
    )
    paths = predict_results(network, dataset, tokens, options["out"], config, progress=True)
    for task, path in paths.items():
        click.echo(f"{task}: {counted(len(tokens), 'sample')} in {path}")
    if dataset.layout == "nuScenes":
        # The plug-in opened the release, so it is installed.
        from deepaccident_devkit.plugins.nuscenes.results import write_detections

        nuscenes_path = write_detections(dataset, paths["detection"])
        click.echo(f"detection, for nuScenes' own evaluation: {nuscenes_path}")
    if model in SHIPPED_WEIGHTS and "scored" in network.notes:
        click.echo(scores_text(network, dataset, tokens, paths["motion"]))


def _samples(
    dataset: DeepAccident, purpose: Any, rules: Any, horizon: float, options: dict[str, Any]
) -> list[str]:
    """Return the samples to predict; raises NotAvailableError if there are none."""
    split, scope = options["split"], options["scope"]
    tokens = dataset.samples(split, purpose, rules, horizon=horizon, scope=scope)
    if not tokens:
        raise NotAvailableError(
            f"{split}: has no samples to predict; {no_samples_text(dataset, split, scope)}"
        )
    return tokens


def _pop_link(options: dict[str, Any], payload: Payload) -> Link | None:
    """Remove the link's options from a verb's options and return the link.

    Return None if nothing happens to the partners' data, which are `payload`.
    """
    values = {name: options.pop(name) for name in _LINK_OPTIONS}
    noise = values.pop("pose_noise") or None  # noise with a mean of 0 m would still have a spread
    if not (values["latency"] or noise or values["packet_loss"] or values["budget"]):
        return None
    return Link(pose_noise=noise, payload=payload if values["budget"] else None, **values)
