"""`deepaccident audit`: what is wrong with splits, scores, or a reader of the files."""

import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final, cast

import click

from deepaccident_devkit.audit.reader import audit_reader, write_audit_release
from deepaccident_devkit.audit.scores import audit_scores, read_scores
from deepaccident_devkit.audit.splits import audit_splits
from deepaccident_devkit.cli.options import (
    index_dir_parameter,
    json_parameter,
    on_error_parameter,
    refuse_unused,
    version_parameter,
)
from deepaccident_devkit.cli.verbs import WordChoice, verb
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, DeepAccidentError, ResultsError, TokenError
from deepaccident_devkit.support.text import path_of

_TOPICS: Final = {"splits": (2, None), "scores": (2, 2), "reader": (1, 1), "release": (1, 1)}
"""Topic → how many things it is about, at least and at most."""


@verb()
@click.argument("topic", metavar="TOPIC", type=WordChoice(_TOPICS))
@click.argument("targets", nargs=-1, required=True)
@version_parameter
@click.option("--split", help="Of scores: only this split: train, val, test, …, or a split file (.txt).")
@index_dir_parameter
@on_error_parameter
@json_parameter
def audit(topic: str, targets: tuple[str, ...], split: str | None, as_json: bool, **release: Any) -> None:
    """Find splits that leak, scores that go by something else, and columns that were misread.

    \b
    splits FILES…        What stands on two sides, each file a side: frames, recordings, twins, mini beside full.
                         In place of files, dataroots: recordings or twins that two share.
    scores DATAROOT FILE What scores of accidents go by: length of the clip, folder, name, town, weather, actors.
    reader TARGET        What a reader takes for something else. TARGET is a Python function, module:function or
                         file.py:function, that is given a dataroot and returns what it read, and is run; or a folder
                         with the JSON and pictures that your reader wrote of the release that `audit release` writes.
    release OUT          Write that release into the new folder OUT.

    FILE has results of the task accident, JSON of token and score, or CSV of token,score. A line of FILES names a
    scenario, a sample or frame by its token, or any file of a release. docs/validation.md explains what is found.
    Exit status 1: something was found. 2: nothing was compared.
    """  # noqa: D301 - \b is click's mark of lines that are not wrapped
    least, most = _TOPICS[topic]
    if not least <= len(targets) <= (most or len(targets)):
        number = f"{least}{'' if most else ' or more'}"
        raise click.UsageError(f"{topic} is about {number}, found {len(targets)}: {' '.join(targets)}")
    if topic != "scores":
        refuse_unused(f"with {topic}", "version", "split", "index_dir", "on_error")
    if topic == "release":
        refuse_unused(f"with {topic}", "as_json")
        path = write_audit_release(path_of(targets[0]))
        click.echo(f"written: {path}; let your reader write JSON of it, and give that folder to `audit reader`")
        return
    if topic == "splits":
        report = audit_splits(targets)
    elif topic == "scores":
        scores = read_scores(targets[1])
        try:
            report = audit_scores(DeepAccident(dataroot=targets[0], **release), scores, split)
        except (TokenError, ResultsError) as error:
            raise ResultsError(f"{targets[1]}: {error}") from error
    else:
        try:
            report = audit_reader(targets[0] if Path(targets[0]).is_dir() else _function(targets[0]))
        except (click.ClickException, DeepAccidentError):
            raise
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            raise ConfigError(f"{targets[0]}: ended with {type(error).__name__}, so nothing was compared") from error
    click.echo(report.to_json() if as_json else report.to_text())
    sys.exit(report.exit_status)


def _function(target: str) -> Callable[[str], object]:
    """The function that a text names."""
    place, _, name = target.rpartition(":")
    sys.path.insert(0, str(Path(place).parent))  # of a module: here
    try:
        return cast("Callable[[str], object]", resolve_name(f"{Path(place).name.removesuffix('.py')}:{name}"))
    except (ImportError, AttributeError, ValueError) as error:
        expected = "expected a folder, module:function or file.py:function"
        raise click.UsageError(f"TARGET: {expected}, found {target!r} ({error})") from error
