"""`deepaccident check`: find faults of releases, indexes, results, evaluations and splits."""

from typing import Final

import click

from deepaccident_devkit.cli.verbs import LazyVerbs
from deepaccident_devkit.support.plugins import LazyVerb, Plugin

_PREFIX: Final = "check "


def _release() -> click.Command:
    from deepaccident_devkit.cli.validate import validate

    return validate


def _index() -> click.Command:
    from deepaccident_devkit.cli.index import check_index

    return check_index


def _results() -> click.Command:
    from deepaccident_devkit.cli.evaluate import check_results

    return check_results


def _bundle() -> click.Command:
    from deepaccident_devkit.cli.evaluate_bundles import verify

    return verify


def _check_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the verbs that a plug-in offers under names such as `check splits`."""
    return {
        name.removeprefix(_PREFIX): verb
        for name, verb in plugin.verbs.items()
        if name.startswith(_PREFIX)
    }


_VERBS: Final = {
    "bundle": LazyVerb("Repeat an evaluation and list all differences.", _bundle),
    "index": LazyVerb("Compare an index with the files of its release, and mend it.", _index),
    "release": LazyVerb(
        "Print what is wrong, unusual or missing in a release; the same as validate.", _release
    ),
    "results": LazyVerb("Check every entry of a results file.", _results),
}


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_check_verbs)
def check() -> None:
    """Check a release, its index, results, an evaluation, splits, scores or a file reader."""
