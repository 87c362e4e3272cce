"""What the verbs of `deepaccident export` on many scenarios share: options, the size, the counts that they print."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args

import click

from deepaccident_devkit.cli.options import (
    WordChoice,
    agent_names,
    agents_parameter,
    engine_of,
    release_parameters,
    where_parameter,
)
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ExportError
from deepaccident_devkit.export.bulk import Exported, Format, Link, Tally, export_release
from deepaccident_devkit.text import size_text

Verb = TypeVar("Verb", bound=Callable[..., Any])
_OPTIONS = (
    click.option(
        "--out", required=True, type=click.Path(path_type=Path), metavar="FOLDER", help="Folder to write into."
    ),
    click.option("--split", help="Only this split: train, val, test, …, or a split file (.txt).  [default: all]"),
    where_parameter,
)
_DRY_RUN = click.option("--dry-run", is_flag=True, help="Only say how much would be written.")
_LINK = click.option(
    "--link",
    type=WordChoice(get_args(Link)),
    default="hard",
    show_default=True,
    help="How images are put there: hard links, else symbolic ones, else copies.",
)


def bulk_parameters(verb: Verb, agents: Callable[[Verb], Verb] = agents_parameter) -> Verb:
    """Give a verb the arguments of a release, --out, --split, --where, --agents and --dry-run.

    `agents` gives the verb --agents, if it means something of its own.
    """
    for option in reversed((*_OPTIONS, agents, _DRY_RUN)):
        verb = option(verb)
    return release_parameters(verb)


def export_parameters(verb: Verb) -> Verb:
    """Give a verb what `bulk_parameters` gives, and --link."""
    return bulk_parameters(_LINK(verb))


def run_export(
    kind: Callable[..., Format],
    own: dict[str, Any],
    *,
    out: Path,
    split: str | None,
    where: tuple[str, ...],
    agents: tuple[str, ...],
    link: Link = "hard",
    dry_run: bool,
    **options: Any,
) -> Exported:
    """Export in a format with its `own` settings; says how much it will be, then what was written and left out."""
    form = kind(split=split, where=where, agents=agent_names(agents), link=link, **own)  # before the release is indexed
    release = DeepAccident(**options)
    left = export_release(release, out, form, dry_run=True)
    if left.written:
        free = shutil.disk_usage(next(each for each in (left.folder, *left.folder.parents) if each.exists())).free
        linked = sum(left.tally.linked.values())  # a temporary folder may take other links than this one
        told = f"{_counts(left.tally, 'to write')}{f', {linked:,} files to link' if linked else ''}"
        click.echo(f"about {left.tally.samples:,} samples: {told}; {size_text(free)} free")
        if left.tally.bytes > free:
            raise ExportError(f"{out}: there is too little room; choose another disk, or fewer scenarios or agents")
    if dry_run:
        return left
    done = export_release(release, out, form, **engine_of(options), progress=True)
    tally = done.tally
    linked_text = "".join(f", {count:,} files as {_WAYS[way]}" for way, count in sorted(tally.linked.items()))
    click.echo(
        f"{done.folder}: {_counts(tally, 'written')}{linked_text}; {done.written} written now, {done.kept} were there "
        "already"
    )
    for what, count in sorted(tally.left_out.items()):
        click.echo(f"left out: {count:,} {what}")
    return done


_WAYS = {"hard": "hard links", "symbolic": "symbolic links", "copy": "copies"}


def _counts(tally: Tally, done: str) -> str:
    return f"{f'{tally.files:,}' if tally.files else 'a few'} files {done} ({size_text(tally.bytes)})"
