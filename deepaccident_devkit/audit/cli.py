"""`deepaccident audit`: what is wrong with splits, scores, or a reader of the files."""

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import click

from deepaccident_devkit.audit.reader import audit_reader, write_audit_release
from deepaccident_devkit.audit.report import AuditReport
from deepaccident_devkit.audit.scores import audit_scores, read_scores
from deepaccident_devkit.audit.splits import audit_splits
from deepaccident_devkit.cli.options import PATH, json_parameter, reader_parameters, refuse_unused
from deepaccident_devkit.cli.verbs import Verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.support.text import path_of


@click.group()
def audit() -> None:
    """Find splits that leak, scores that go by something else, and columns that were misread."""


@audit.command(cls=Verb, short_help="Find what stands on two sides of a split.")
@click.argument("files", nargs=-1, required=True, type=PATH)
@json_parameter
def splits(files: tuple[Path, ...], as_json: bool) -> None:
    """Find frames, recordings or twins on two sides of a split, and the mini release beside the full one.

    Each of the FILES is a side. A line names a scenario, a sample or frame by its token, or any file of a release.
    Exit status 1: something was found.
    """
    _tell(audit_splits(files), as_json=as_json)


@audit.command(cls=Verb, short_help="Find what scores of accidents go by.")
@reader_parameters
@click.option("--results", required=True, type=PATH, help="Accidents, JSON of token and score, or CSV of token,score.")
@click.option("--split", help="Only this split: train, val, test, …, or a split file (.txt).  [default: all]")
@json_parameter
def scores(results: Path, split: str | None, as_json: bool, **release: Any) -> None:
    """Compare scores of accidents with how long a clip is, its folder, name, town, weather, actors and frames.

    The score of a sample or of a scenario is the higher, the surer an accident. Exit status 1: the scores are those of
    a detector of something else, such as short clips.
    """
    _tell(audit_scores(DeepAccident(**release), read_scores(results), split), as_json=as_json)


@audit.command(cls=Verb, short_help="Find columns that a reader takes for something else.")
@click.argument("target")
@click.option("--make", is_flag=True, help="Write the release that is to be read into a new folder TARGET.")
@json_parameter
def reader(target: str, make: bool, as_json: bool) -> None:
    """Say which column of the files each key of a reader's output holds, and which were read as something else.

    TARGET is a Python function, module:function or file.py:function, that is given a dataroot and returns what it read;
    or a folder with the JSON and pictures that your reader wrote of the release that --make writes. A function is run.
    Exit status 1: something was misread.
    """
    if make:
        refuse_unused("with --make", "as_json")
        path = write_audit_release(path_of(target))
        click.echo(f"written: {path}; let your reader write JSON of it, and give that folder in its place")
    else:
        _tell(audit_reader(target if Path(target).is_dir() else _function(target)), as_json=as_json)


def _tell(report: AuditReport, *, as_json: bool) -> None:
    click.echo(report.to_json() if as_json else report.to_text())
    sys.exit(1 if report.findings else 0)


def _function(target: str) -> Callable[[str], object]:
    """The function that a text names."""
    place, _, name = target.rpartition(":")
    sys.path.insert(0, str(Path(place).parent))  # of a module: here
    try:
        return cast("Callable[[str], object]", getattr(import_module(Path(place).name.removesuffix(".py")), name))
    except (ImportError, AttributeError, ValueError) as error:
        expected = "expected a folder, module:function or file.py:function"
        raise click.UsageError(f"TARGET: {expected}, found {target!r} ({error})") from error
