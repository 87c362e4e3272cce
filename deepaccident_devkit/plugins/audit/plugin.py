"""What the plug-in `audit` adds to the devkit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from deepaccident_devkit.support.plugins import PROTOCOL_VERSION, LazyVerb, Plugin

if TYPE_CHECKING:
    import click


def _check_reader() -> click.Command:
    from deepaccident_devkit.plugins.audit.cli import check_reader

    return check_reader


def _check_scores() -> click.Command:
    from deepaccident_devkit.plugins.audit.cli import check_scores

    return check_scores


def _check_splits() -> click.Command:
    from deepaccident_devkit.plugins.audit.cli import check_splits

    return check_splits


PLUGIN = Plugin(
    name="audit",
    protocol_version=PROTOCOL_VERSION,
    verbs={
        "check reader": LazyVerb(
            "Find columns that a reader of the files confuses with others.", _check_reader
        ),
        "check scores": LazyVerb("Find what accident scores depend on.", _check_scores),
        "check splits": LazyVerb("Find data that occurs in two parts of a split.", _check_splits),
    },
)
