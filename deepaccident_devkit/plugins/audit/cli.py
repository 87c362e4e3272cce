"""`deepaccident check splits`, `check scores` and `check reader`."""

import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import click

from deepaccident_devkit.cli.options import (
    index_dir_parameter,
    json_parameter,
    on_error_parameter,
    refuse_unused,
    version_parameter,
)
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, DeepAccidentError, ResultsError, TokenError
from deepaccident_devkit.plugins.audit.reader import audit_reader, write_audit_release
from deepaccident_devkit.plugins.audit.report import AuditReport
from deepaccident_devkit.plugins.audit.scores import audit_scores, read_scores
from deepaccident_devkit.plugins.audit.splits import audit_splits
from deepaccident_devkit.support.text import path_of


@verb("splits")
@click.argument("sides", nargs=-1, required=True, metavar="FILES...")
@json_parameter
def check_splits(sides: tuple[str, ...], as_json: bool) -> None:
    """Find frames, recordings or twins on two sides of a split, or mini beside the full release.

    Each of FILES is a side. A line names a scenario, a sample or a frame by its token, or any file
    of a release. Instead of files you can give dataroots; then recordings or twins that two of them
    share are found.
    Exit status 1: something was found. 2: nothing was compared.
    """
    if len(sides) < 2:
        raise click.UsageError(f"expected two sides or more, found {len(sides)}: {' '.join(sides)}")
    _finish(audit_splits(sides), as_json)


@verb("scores")
@click.argument("dataroot")
@click.argument("file")
@version_parameter
@click.option("--split", help="Only this split: train, val, test, …, or a split file (.txt).")
@index_dir_parameter
@on_error_parameter
@json_parameter
def check_scores(
    dataroot: str, file: str, split: str | None, as_json: bool, **release: Any
) -> None:
    """Find what scores of accidents depend on: clip length, folder, name, town, weather or actors.

    FILE has results of the task accident, JSON of token and score, or CSV of token,score.
    Exit status 1: something was found. 2: nothing was compared.
    """
    scores = read_scores(file)
    try:
        report = audit_scores(DeepAccident(dataroot=dataroot, **release), scores, split)
    except (TokenError, ResultsError) as error:
        raise ResultsError(f"{file}: {error}") from error
    _finish(report, as_json)


@verb("reader")
@click.argument("target")
@click.option(
    "--write-release",
    is_flag=True,
    help="Write the release that a reader in another language, or in another environment, reads "
    "into the new folder TARGET.",
)
@json_parameter
def check_reader(target: str, write_release: bool, as_json: bool) -> None:
    """Find columns of the release's files that a reader mistakes for others.

    TARGET is a Python function, module:function or file.py:function. The command calls it with a
    dataroot, and compares what it returns with the files. TARGET can also be a folder with JSON and
    pictures that your reader made of the release that --write-release writes. docs/validation.md
    explains what is found.
    Exit status 1: something was found. 2: nothing was compared.
    """
    if write_release:
        refuse_unused("with --write-release", "as_json")
        path = write_audit_release(path_of(target))
        click.echo(
            f"written: {path}; let your reader write JSON of it, and give that folder to "
            "`check reader`"
        )
        return
    try:
        report = audit_reader(target if Path(target).is_dir() else _function(target))
    except (click.ClickException, DeepAccidentError):
        raise
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        raise ConfigError(
            f"{target}: ended with {type(error).__name__}, so nothing was compared"
        ) from error
    _finish(report, as_json)


def _finish(report: AuditReport, as_json: bool) -> None:
    """Print a report, and exit with its status."""
    click.echo(report.to_json() if as_json else report.to_text())
    sys.exit(report.exit_status)


def _function(target: str) -> Callable[[str], object]:
    """Return the function that a text names; raises UsageError."""
    module, _, name = target.rpartition(":")
    sys.path.insert(0, str(Path(module).parent))  # the current folder, for a module
    try:
        function = resolve_name(f"{Path(module).name.removesuffix('.py')}:{name}")
        return cast("Callable[[str], object]", function)
    except (ImportError, AttributeError, ValueError) as error:
        expected = "expected a folder, module:function or file.py:function"
        raise click.UsageError(f"TARGET: {expected}, found {target!r} ({error})") from error
