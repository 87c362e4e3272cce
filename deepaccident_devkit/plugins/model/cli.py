"""`deepaccident train`: train the model on a release."""

from pathlib import Path
from typing import Any, get_args

import click

from deepaccident_devkit.cli.agents import cooperating_parameter, names_or_configuration
from deepaccident_devkit.cli.options import (
    PATH,
    figure_style_parameter,
    model_parameters,
    open_release,
    reader_parameters,
    refuse_unused,
    release_of,
    use_threads_sparingly,
)
from deepaccident_devkit.cli.verbs import WordChoice, advanced, verb
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.taxonomy import ModelFusion, ModelPreset

_CHOICE_OPTIONS = ("preset", "fusion", "horizon", "focal", "labels")
_TRAINING_OPTIONS = ("steps", "moments", "egos", "split", "validation", "samples", "seed", "bf16")
_EXAMPLES = """\b
Examples:
  deepaccident train DATAROOT --preset tiny --agents all --out runs/all
  deepaccident train DATAROOT --from runs/single --agents all --freeze img_backbone. --out runs/warm
  torchrun --nproc-per-node 4 -m deepaccident_devkit.cli train DATAROOT --preset released --bf16 \
--out runs/big"""


@verb(epilog=_EXAMPLES)
@reader_parameters
@click.option(
    "--preset",
    type=WordChoice(get_args(ModelPreset)),
    default="tiny",
    show_default=True,
    help="Model to train: the released one, or a small one that a laptop can train.",
)
@click.option(
    "--fusion",
    type=WordChoice(get_args(ModelFusion)),
    help="How to fuse the agents' maps.  [default: that of the preset]",
)
@click.option(
    "--horizon", type=float, help="How many seconds to predict, a multiple of 0.5.  [default: 2]"
)
@advanced(
    "--focal",
    type=float,
    help="Warp all images to a virtual camera with this focal length in pixels.  [default: no "
    "warp]",
)
@advanced(
    "--labels",
    type=WordChoice(["fiery"]),
    help="Use FIERY's motion labels, as in nuScenes evaluations.  [default: those of the preset]",
)
@cooperating_parameter("Agents that cooperate with each ego", "all")
@click.option(
    "--split",
    default="train",
    show_default=True,
    help="Split to train on: its name, or a split file (.txt).",
)
@click.option(
    "--validation",
    default="val",
    show_default=True,
    help="Split to choose the best weights on, or none.",
)
@click.option(
    "--samples",
    type=WordChoice(["train", "all", "every"]),
    default="all",
    show_default=True,
    help="Training samples per second. train: one, as released. all: two. every: ten.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    default=1500,
    show_default=True,
    help="Number of optimizer steps.",
)
@advanced(
    "--moments",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Number of moments per step, each with all agents.",
)
@advanced(
    "--egos",
    type=click.IntRange(min=1),
    help="Number of agents of a moment that become the ego in turn.  [default: all]",
)
@advanced(
    "--learning-rate",
    type=float,
    default=2e-3,
    show_default=True,
    help="Peak learning rate.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Seed of all random numbers.",
)
@click.option(
    "--from",
    "weights",
    type=PATH,
    help="Weights to start from: a run, a file of weights, `tiny`, `tiny_lidar`, or a checkpoint "
    "of the release, BEVerse or Swin.",
)
@click.option(
    "--also", type=PATH, metavar="DATAROOT", help="Also train on this release, or on nuScenes."
)
@click.option(
    "--mix",
    type=float,
    default=0.5,
    show_default=True,
    help="Share of the training moments from --also.",
)
@advanced(
    "--freeze",
    multiple=True,
    metavar="NAME",
    help="Do not train parameters with this prefix. You can repeat this option.",
)
@model_parameters
@advanced("--bf16", is_flag=True, help="Compute in bfloat16 on GPUs.")
@figure_style_parameter
@click.option(
    "--out",
    required=True,
    type=PATH,
    metavar="RUN",
    help="Folder to write weights, log and curves into.",
)
def train(weights: Path | None, also: Path | None, mix: float, **options: Any) -> None:
    """Train the model on the release in DATAROOT, or on nuScenes.

    If the command is interrupted or killed, run it again to continue from the last checkpoint.
    """
    if also is None:
        refuse_unused("without --also", "mix")
    use_threads_sparingly()
    from deepaccident_devkit.plugins.model import ModelChoice, SecondSource, TrainConfig
    from deepaccident_devkit.plugins.model import train as train_model

    training_options = {name: options[name] for name in _TRAINING_OPTIONS}
    if training_options["validation"] == "none":
        training_options["validation"] = None
    config = TrainConfig(
        agents=names_or_configuration(options["agents"]) or "all",
        learning_rate=options["learning_rate"],
        freeze=options["freeze"],
        **training_options,
    )
    choice = ModelChoice(**{name: options[name] for name in _CHOICE_OPTIONS})
    dataset = open_release(**release_of(options))
    sources: list[Dataset] = [dataset]
    second_source = None
    if also is not None:
        second_source = SecondSource(dataset=open_release(also, version="v1"), mix=mix)
        sources.append(second_source.dataset)
    for source in sources:
        if source.layout == "nuScenes":
            # The plug-in opened the source, so it is installed.
            from deepaccident_devkit.plugins.nuscenes.check import check_source

            check_source(source)
    weights_path = train_model(
        dataset,
        options["out"],
        choice,
        config,
        weights=weights,
        device=options["device"],
        workers=options["workers"] or 0,
        images_cache=options["images_cache"],
        also=second_source,
        say=click.echo,
    )
    click.echo(f"wrote {weights_path}")
    click.echo(
        f"next: deepaccident predict {options['out']} {options['dataroot']} --split val --out "
        "results\nnote: numbers on the validation split (--validation, by default val) are too "
        "good, as this split was used to choose the weights"
    )
