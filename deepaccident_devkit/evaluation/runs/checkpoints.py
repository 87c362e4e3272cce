"""The folder beside an evaluation in which counts are kept until it is written."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.files import path_of, remove_in
from deepaccident_devkit.parallel import Store, unfinished_folder
from deepaccident_devkit.release.fingerprints import digest_of

_COUNTS = "counts"


def evaluation_store(out: str | os.PathLike[str], command: str = "") -> Store:
    """The store beside `out`: who has its lock alone writes the evaluation, once all samples are counted.

    `command` says which evaluation that is.
    """
    return Store(unfinished_folder(path_of(out)), path_of(out), "evaluates for it", ResultsError, command)


def checkpoint_path(
    out: str | os.PathLike[str],
    setup: EvaluationSetup,
    tokens: Collection[str],
    fingerprints: Mapping[str, str],
) -> Path:
    """The folder beside `out` in which such a run keeps its counts.

    Its name is a digest of all that affects the counts: another setup, other samples, other predictions, other labels
    and another devkit have another folder, and so never go on with these counts.

    Args:
        out: the folder that the finished evaluation goes to.
        setup: task and rules.
        tokens: the samples.
        fingerprints: of the predictions and of the labels.
    """
    name = digest_of(
        {
            "devkit": __version__,
            "setup": setup.as_dict(),
            "tokens": sorted(tokens),
            "fingerprints": dict(fingerprints),
        }
    )
    return evaluation_store(out).folder / _COUNTS / name


def remove_checkpoints(out: str | os.PathLike[str]) -> None:
    """Remove all such folders beside `out`, once what they were for is written."""
    store = evaluation_store(out)
    remove_in(store.folder, _COUNTS)
    store.remove()
