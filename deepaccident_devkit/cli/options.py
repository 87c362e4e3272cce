"""The arguments that every verb on a release takes, in one grammar."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from deepaccident_devkit.taxonomy import VERSIONS

Verb = TypeVar("Verb", bound=Callable[..., Any])

_PARAMETERS = (
    click.argument("dataroot", type=click.Path(path_type=Path)),
    click.option("--version", type=click.Choice(VERSIONS), default="v1", show_default=True, help="Which release."),
    click.option("--index-dir", type=click.Path(path_type=Path), help="Where the index lies or goes."),
    click.option("--workers", type=click.IntRange(min=1), help="Processes to index with."),
    click.option(
        "--on-error",
        type=click.Choice(["raise", "skip"]),
        default="raise",
        show_default=True,
        help="List broken scenarios and stop, or leave them out.",
    ),
)


def release_parameters(verb: Verb) -> Verb:
    """Give a verb DATAROOT, --version, --index-dir, --workers and --on-error."""
    for parameter in reversed(_PARAMETERS):
        verb = parameter(verb)
    return verb


def where_parameter(verb: Verb) -> Verb:
    """Give a verb `where`, the texts of repeated --where (`deepaccident_devkit.selection` says what they may be)."""
    option = click.option(
        "--where",
        multiple=True,
        metavar="FILTER",
        help="Only scenarios such as town=Town03,Town05, weather!=Clear, length=40..60 or collision=true; all of "
        "several --where must hold.",
    )
    return option(verb)
