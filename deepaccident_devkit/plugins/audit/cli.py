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
    """Find frames, recordings or twins in two parts of a split, or mini and full releases mixed.

    Each of FILES lists one part of the split: one scenario, sample or frame token, or release file,
    per line. You can pass dataroots instead; the command then reports recordings and twins that two
    of them share. It exits with 1 if anything was found, and with 2 if there was nothing to
    compare.
    """
    if len(sides) < 2:
        raise click.UsageError(f"expected at least two FILES, found only {' '.join(sides)}")
    _print_and_exit(audit_splits(sides), as_json)


@verb("scores")
@click.argument("dataroot")
@click.argument("file")
@version_parameter
@click.option("--split", help="Use only this split: train, val, test, …, or a split file (.txt).")
@index_dir_parameter
@on_error_parameter
@json_parameter
def check_scores(
    dataroot: str, file: str, split: str | None, as_json: bool, **release: Any
) -> None:
    """Find what accident scores depend on: clip length, folder, name, town, weather or actors.

    FILE contains results of the task accident, JSON of token and score, or CSV of token,score. The
    command exits with 1 if anything was found, and with 2 if there was nothing to compare.
    """
    scores = read_scores(file)
    try:
        report = audit_scores(DeepAccident(dataroot=dataroot, **release), scores, split)
    except (TokenError, ResultsError) as error:
        raise ResultsError(f"{file}: {error}") from error
    _print_and_exit(report, as_json)


@verb("reader")
@click.argument("target")
@click.option(
    "--write-release",
    is_flag=True,
    help="Write a release into the new folder TARGET, for readers in another language or "
    "environment.",
)
@json_parameter
def check_reader(target: str, write_release: bool, as_json: bool) -> None:
    """Find columns of the release's files that a reader confuses with others.

    TARGET is a Python function, module:function or file.py:function. The command calls it with a
    dataroot, and compares what it returns with the files. TARGET can also be a folder with JSON and
    pictures that your reader made from the release of --write-release. docs/validation.md explains
    the findings. The command exits with 1 if anything was found, and with 2 if there was nothing to
    compare.
    """
    if write_release:
        refuse_unused("with --write-release", "as_json")
        path = write_audit_release(path_of(target))
        click.echo(
            f"wrote {path}; read it with your reader, write the result as JSON, and pass that "
            "folder to `deepaccident check reader`"
        )
        return
    try:
        if Path(target).is_dir():
            report = audit_reader(target)
        else:
            report = audit_reader(_find_function(target))
    except (click.ClickException, DeepAccidentError):
        raise
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        raise ConfigError(
            f"{target}: failed with {type(error).__name__}, so nothing was compared"
        ) from error
    _print_and_exit(report, as_json)


def _print_and_exit(report: AuditReport, as_json: bool) -> None:
    """Print a report, and exit with its status."""
    if as_json:
        text = report.to_json()
    else:
        text = report.to_text()
    click.echo(text)
    sys.exit(report.exit_status)


def _find_function(target: str) -> Callable[[str], object]:
    """Import the function that `target` names; raise UsageError on failure."""
    module, _, name = target.rpartition(":")
    sys.path.insert(0, str(Path(module).parent))  # the current folder, for a module
    try:
        function = resolve_name(f"{Path(module).name.removesuffix('.py')}:{name}")
        return cast("Callable[[str], object]", function)
    except (ImportError, AttributeError, ValueError) as error:
        expected = "expected a folder, module:function or file.py:function"
        raise click.UsageError(f"TARGET: {expected}, found {target!r} ({error})") from error
