"""`deepaccident check`: find faults of releases, indexes, results, evaluations and splits."""

import click

from deepaccident_devkit.cli.verbs import LazyVerbs
from deepaccident_devkit.support.plugins import LazyVerb, Plugin

_PREFIX = "check "


def _load_release_check() -> click.Command:
    from deepaccident_devkit.cli.validate import validate

    return validate


def _load_index_check() -> click.Command:
    from deepaccident_devkit.cli.index import check_index

    return check_index


def _load_results_check() -> click.Command:
    from deepaccident_devkit.cli.evaluate import check_results

    return check_results


def _load_bundle_check() -> click.Command:
    from deepaccident_devkit.cli.evaluate_bundles import verify

    return verify


def _read_check_verbs(plugin: Plugin) -> dict[str, LazyVerb]:
    """Return the subcommands that a plug-in offers under names such as `check splits`."""
    names = [name for name in plugin.verbs if name.startswith(_PREFIX)]
    return {name.removeprefix(_PREFIX): plugin.verbs[name] for name in names}


_VERBS = {
    "bundle": LazyVerb("Repeat an evaluation and list all differences.", _load_bundle_check),
    "index": LazyVerb(
        "Compare an index with the files of its release, and repair it.", _load_index_check
    ),
    "release": LazyVerb(
        "Report what is wrong, unusual or missing in a release (same as validate).",
        _load_release_check,
    ),
    "results": LazyVerb("Check every entry of a results file.", _load_results_check),
}


@click.group(cls=LazyVerbs, verbs=_VERBS, read_plugin=_read_check_verbs)
def check() -> None:
    """Check a release, its index, results, an evaluation, splits, scores or a file reader."""
