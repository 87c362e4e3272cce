"""`deepaccident predict`: results files of a trained model."""

from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.cli.evaluate_options import purpose_parameter, scope_parameter
from deepaccident_devkit.cli.options import (
    LINK_OPTIONS,
    cooperating_parameter,
    link_of,
    link_parameters,
    model_parameters,
    names_or_configuration,
    reader_parameters,
    refuse_unused,
    use_threads_sparingly,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.motion.sample_lists import Scope, no_samples_text

_ALL = "all"
_EXAMPLES = """\b
Examples:
  deepaccident predict runs/all DATAROOT --split val --out results
  deepaccident predict runs/all DATAROOT --agents single --out results_single
  deepaccident evaluate motion DATAROOT --results results/motion --switch labels=clean"""


@click.command(epilog=_EXAMPLES)
@click.argument("run", type=click.Path(path_type=Path))
@reader_parameters
@click.option("--split", default="val", show_default=True, help="Name of a split, or a split file (.txt).")
@cooperating_parameter("Agents that cooperate with each ego", _ALL)
@link_parameters
@purpose_parameter
@scope_parameter
@model_parameters
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="DIR", help="Folder to write into.")
def predict(run: Path, split: str, purpose: Any, scope: Scope, out: Path, **options: Any) -> None:
    """Predict a split of the release in DATAROOT with the model that was trained in RUN.

    RUN is a run's folder, a file of weights, or `tiny` for those that the devkit ships. It writes motion/,
    accident.json and detection.json, which `deepaccident evaluate` takes.
    """
    use_threads_sparingly()
    from deepaccident_devkit.model import PredictConfig, checked_device, load_model, predict_results

    seed, link = options["seed"], link_of(options)
    agents = names_or_configuration(options["agents"]) or _ALL
    if agents == "single":
        refuse_unused("with --agents single, which has no partners", *(name for name in LINK_OPTIONS if name != "seed"))
    if purpose == "all":
        refuse_unused("with --samples all, which are those of all scenarios", "scope")
    device = checked_device(options["device"])
    model = load_model(run).to(device)
    dataset = DeepAccident(**{name: options[name] for name in ("dataroot", "version", "index_dir", "on_error")})
    horizon = model.config.horizon
    tokens = dataset.samples(split, purpose, "paper", horizon=horizon, scope=scope)
    if not tokens:
        raise NotAvailableError(f"{split}: has no samples to predict; {no_samples_text(dataset, split, scope)}")
    config = PredictConfig(
        agents=agents,
        link=link,
        seed=seed,
        device=device,
        workers=options["workers"] or 0,
        images_cache=options["images_cache"],
    )
    for task, path in predict_results(model, dataset, tokens, out, config, progress=True).items():
        click.echo(f"{task}: {len(tokens):,} samples in {path}")
