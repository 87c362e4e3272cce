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
    engine_options,
    model_parameters,
    open_release,
    refuse_unused,
    release_of,
    release_parameters,
    seed_parameter,
    split_words,
    use_threads_sparingly,
)
from deepaccident_devkit.cli.verbs import WordChoice, field_option, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.results import RESULTS_NAMES
from deepaccident_devkit.evaluation.runs.setups import agent_of
from deepaccident_devkit.plugins.baselines import MOTION_MODELS, Baseline, predict_results
from deepaccident_devkit.plugins.baselines.predict_results import PREDICTED_TASKS, is_predicted
from deepaccident_devkit.selection.samples import no_samples_text
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.parallel import keep_workers
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import SHIPPED_WEIGHTS, VEHICLE_AGENTS
from deepaccident_devkit.v2x import Link
from deepaccident_devkit.v2x.messages import Payload

_SINGLE_AGENT = "single"
# Names of the link's options as parameters of a subcommand.
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
    "--split",
    default="val",
    show_default=True,
    help="Split to predict: its name, or a split file (.txt).",
)
@cooperating_parameter("Agents that cooperate with each ego", "all; with a baseline: single")
@click.option(
    "--task",
    "tasks",
    multiple=True,
    metavar="NAME[,NAME…]",
    default=_DEFAULT_TASKS,
    help=f"With a baseline: tasks to write results for: {', '.join(PREDICTED_TASKS)}, or all.  "
    f"[default: {','.join(_DEFAULT_TASKS)}]",
)
@click.option(
    "--horizon",
    default=_RELEASED_HORIZON,
    show_default=True,
    help="With a baseline: how many seconds to predict, a multiple of 0.5; planning and "
    "forecasting predict at least 3.",
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
    help="Samples to predict. evaluate: samples within the horizon before the end of a scenario. "
    "all: two per second of each scenario.",
)
@click.option(
    "--scope",
    type=WordChoice(["accident", "all"]),
    default="accident",
    show_default=True,
    help="Predict only accident scenarios, or all scenarios.",
)
@model_parameters
@click.option("--out", required=True, type=PATH, metavar="DIR", help="Folder to write into.")
def predict(model: str, purpose: Any, **options: Any) -> None:
    """Predict a split of the release in DATAROOT.

    MODEL is the folder of a run of `deepaccident train`, a file of weights, or `tiny` or
    `tiny_lidar`, two trained models of the devkit. MODEL can also be a baseline, which needs no
    training: `constant_velocity`, `constant_turn_rate` or `standing`. A baseline assumes that each
    actor that the agents see continues to move in this way, and so does the ego in its plan. The
    command writes the files motion/, accident.json, …, for `deepaccident evaluate`.
    """
    if not Path(model).exists():  # so that a wrong name fails before PyTorch is imported
        names = (*MOTION_MODELS, *SHIPPED_WEIGHTS)
        model = choice("MODEL", model, names, also=", or an existing file or folder")
    if purpose == "all":
        refuse_unused("with --samples all, which always uses all scenarios", "scope")
    is_baseline = model in MOTION_MODELS
    seed = options["seed"]
    link = _pop_link(options, "boxes" if is_baseline else "bev")
    agents = names_or_configuration(options.pop("agents"))
    write_predictions = _predict_with_baseline if is_baseline else _predict_with_network
    write_predictions(model, purpose, agents=agents, link=link, seed=seed, **options)


@keep_workers()
def _predict_with_baseline(
    model: Any, purpose: Any, *, agents: Any, link: Link | None, out: Path, **options: Any
) -> None:
    """Write the results of a baseline for each task."""
    refuse_unused("with a baseline", "device", "images_cache")
    agents = agents or _SINGLE_AGENT
    if agents == _SINGLE_AGENT:
        refuse_unused("with --agents single, which has no partners", *_LINK_OPTIONS)
    if link is None or not (link.pose_noise or link.packet_loss):
        refuse_unused("without --pose-noise or --packet-loss", "seed")
    words = [
        choice("--task", word, (*PREDICTED_TASKS, "all")) for word in split_words(options["tasks"])
    ]
    tasks = [task for task in PREDICTED_TASKS if task in words or "all" in words]
    baseline = Baseline(agents=agents, model=model, link=link, horizon=options["horizon"])
    folder = writable_folder(out)
    is_released = baseline.horizon == _RELEASED_HORIZON and options["scope"] == "accident"
    rules = "released" if is_released else "paper"
    engine = engine_options(options)
    dataset = open_release(**release_of(options), **engine)
    tokens = _samples(dataset, purpose, rules, baseline.horizon, options)
    for task in tasks:
        path = folder / RESULTS_NAMES[task]
        task_tokens = tokens
        if task == "planning":
            task_tokens = [token for token in tokens if agent_of(token) in VEHICLE_AGENTS]
        was_predicted = is_predicted(dataset, task, task_tokens, path, baseline)
        predict_results(dataset, task, task_tokens, path, baseline, **engine, progress=True)
        action = "kept" if was_predicted else "wrote"
        click.echo(f"{action} {path} ({task}, {counted(len(task_tokens), 'sample')})")


def _predict_with_network(
    model: str, purpose: Any, *, agents: Any, link: Link | None, seed: int, **options: Any
) -> None:
    """Write the results of a trained model for all tasks."""
    refuse_unused(
        "with a trained model, which always predicts its own tasks and horizon",
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
        click.echo(f"wrote {path} ({task}, {counted(len(tokens), 'sample')})")
    if dataset.layout == "nuScenes":
        # the plug-in opened the release, so it is installed
        from deepaccident_devkit.plugins.nuscenes.results import write_detections

        nuscenes_path = write_detections(dataset, paths["detection"])
        click.echo(f"wrote {nuscenes_path} (detection, for nuScenes' own evaluation)")
    if model in SHIPPED_WEIGHTS and "scored" in network.notes:
        click.echo(scores_text(network, dataset, tokens, paths["motion"]))


def _samples(
    dataset: DeepAccident, purpose: Any, rules: Any, horizon: float, options: NamedValues
) -> list[str]:
    """Return the samples to predict; raise NotAvailableError if there are none."""
    split = options["split"]
    scope = options["scope"]
    tokens = dataset.samples(split, purpose, rules, horizon=horizon, scope=scope)
    if not tokens:
        raise NotAvailableError(
            f"{split}: has no samples to predict; {no_samples_text(dataset, split, scope)}"
        )
    return tokens


def _pop_link(options: NamedValues, payload: Payload) -> Link | None:
    """Remove the link's options from a subcommand's options, and return the link.

    Return None if nothing happens to the partners' data.

    Args:
        options: Options of the subcommand.
        payload: What partners send.
    """
    values = {name: options.pop(name) for name in _LINK_OPTIONS}
    noise = values.pop("pose_noise") or None  # noise with a mean of 0 m would still have a spread
    if not (values["latency"] or noise or values["packet_loss"] or values["budget"]):
        return None
    link_payload = None
    if values["budget"]:
        link_payload = payload
    return Link(pose_noise=noise, payload=link_payload, **values)
