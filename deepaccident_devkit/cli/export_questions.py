"""`deepaccident export questions`: questions for language models on what some agents observed."""

from functools import partial
from typing import Any, Literal, get_args

import click

from deepaccident_devkit.cli.export_bulk import Verb, bulk_parameters, run_export
from deepaccident_devkit.cli.options import (
    WordChoice,
    agent_names,
    cooperating_parameter,
    names_or_configuration,
    refuse_unused,
)
from deepaccident_devkit.export.questions import Questions, WindowRules
from deepaccident_devkit.export.questions.observed import Seen
from deepaccident_devkit.taxonomy import CAMERAS
from deepaccident_devkit.text import choice

_ALONE = "single"
_EGO = "ego_vehicle"
_FRONT = CAMERAS[:1]
_DEFAULT = WindowRules()
_Images = Literal["none", "link", "copy"]
_WINDOW = (
    click.option(
        "--observe", default=_DEFAULT.observe, show_default=True, help="How many seconds before the present are shown."
    ),
    click.option("--rate", default=_DEFAULT.rate, show_default=True, help="How many moments a second: 1, 2, 5 or 10."),
    click.option(
        "--ahead",
        type=click.IntRange(min=1),
        default=_DEFAULT.ahead,
        show_default=True,
        help="How many seconds after the present are asked about.",
    ),
    click.option(
        "--stride",
        default=_DEFAULT.stride,
        show_default=True,
        help="Seconds from one window of a recording to the next, in steps of 0.5.",
    ),
    click.option(
        "--partial-past",
        is_flag=True,
        help="Also ask where the window begins before the recording; see docs/exports.md.",
    ),
    click.option(
        "--most",
        type=click.IntRange(min=1),
        metavar="N",
        help="At most N windows of a recording, drawn by --seed.  [default: all]",
    ),
)
_CONTENT = (
    click.option(
        "--seen",
        type=WordChoice(get_args(Seen)),
        default=Questions.seen,
        show_default=True,
        help="What an agent sees. released: by camera and LiDAR, as the released code says. camera: by its cameras. "
        "annotated: all in its label.",
    ),
    click.option(
        "--images",
        type=WordChoice(get_args(_Images)),
        default="none",
        show_default=True,
        help="Whether pictures go with the questions, under neutral names. link: as hard links, else copies.",
    ),
    click.option(
        "--cameras",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"With --images: whose pictures, or all.  [default: {_FRONT[0]}]",
    ),
    click.option(
        "--seed",
        default=Questions.seed,
        show_default=True,
        metavar="TEXT",
        help="Text from which ids and order are drawn; keep one of your own secret.",
    ),
)


def _observing(verb: Verb) -> Verb:
    """Give a verb --agents for those that observe, and --ego."""
    ego = click.option(
        "--ego",
        multiple=True,
        metavar="NAME[,NAME…]",
        help=f"Agents that ask, each with questions of its own, or all.  [default: {_EGO}]",
    )
    return cooperating_parameter("Agents that observe together with each ego", _ALONE)(ego(verb))


def _own_parameters(verb: Verb) -> Verb:
    """Give a verb the options that only questions have."""
    for option in reversed((*_WINDOW, *_CONTENT)):
        verb = option(verb)
    return verb


@click.command(short_help="Write questions on what happens next, for language models.")
@partial(bulk_parameters, agents=_observing)
@_own_parameters
def questions(
    agents: tuple[str, ...], ego: tuple[str, ...], images: _Images, cameras: tuple[str, ...], **options: Any
) -> None:
    """Write questions about the release in DATAROOT: what some agents observed, and whether an accident follows.

    FOLDER/questions holds all that a model may see, FOLDER/truth.jsonl the answers. `deepaccident results from
    questions` makes a results file of what a model answers. If a run is interrupted, the same command continues it.
    """
    if images == "none":
        refuse_unused("without --images", "cameras")
    window = WindowRules(**{name: options.pop(name) for name in WindowRules.__slots__})
    own = {
        "observers": names_or_configuration(agents) or _ALONE,
        "window": window,
        "cameras": () if images == "none" else _camera_names(cameras),
        **{name: options.pop(name) for name in ("seen", "seed")},
    }
    run_export(
        Questions, own, agents=agent_names(ego or (_EGO,)), link="copy" if images == "copy" else "hard", **options
    )


def _camera_names(given: tuple[str, ...]) -> tuple[str, ...]:
    names = [choice("--cameras", name, (*CAMERAS, "all")) for text in given for name in text.split(",")]
    return CAMERAS if "all" in names else tuple(names) or _FRONT
