"""Which recordings results are of: the mini release has others than the whole one, under the same names."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results.reader import Results


def release_note(dataset: Dataset, scenarios: Iterable[str]) -> dict[str, Any]:
    """What results note of their release, in `meta` under `release`.

    Args:
        dataset: the release that was predicted.
        scenarios: tokens of the scenarios that have a prediction.
    """
    recordings = dataset.recordings(scenarios)
    return {"version": dataset.version, "index": dataset.tables_folder.name, "recordings": recordings}


def check_recordings(results: Results, dataset: Dataset) -> None:
    """Raise ResultsError if results are of other recordings than the release has under these names.

    Results without such a note, and scenarios that one of the two does not know, are not compared.
    """
    note = results.meta.get("release")
    stated = note.get("recordings") if isinstance(note, dict) else None
    if not isinstance(stated, dict):
        return
    here = dataset.recordings(stated)
    others = [token for token, hashed in here.items() if hashed != stated[token]]
    if others:
        raise ResultsError(
            f"{results.path}: are of other recordings than {dataset.dataroot} has ({dataset.version}; results of "
            f"{note.get('version')}) for {len(others)} of {len(here)} scenarios, such as {others[0]}, although "
            "they have the same names; evaluate with the release that was predicted, or predict this one"
        )
