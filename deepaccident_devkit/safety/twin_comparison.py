"""`twin_diff`: reads an accident and its twin, and puts their actors in step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.safety.accidents import accident_of
from deepaccident_devkit.safety.twin_diff import Parting, TwinDiff
from deepaccident_devkit.safety.twin_matching import MatchedBy, Recording, matched_rows, recording_of, shift_of, shifted
from deepaccident_devkit.safety.twins import twin_of
from deepaccident_devkit.taxonomy import CATEGORIES, UNTRACKED_ID


def twin_diff(dataset: Dataset, scenario: RowArgument, parting: Parting | None = None) -> TwinDiff:
    """Compare an accident with its twin, frame by frame.

    `safety.twin_matching` says which moments (`shift_of`) and actors (`matched_rows`) are taken for the same.

    Args:
        dataset: the release.
        scenario: token or record of the accident or of its twin.
        parting: from which difference on an actor acts differently; None for `Parting()`.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the release has no twin of it, neither of the two ends in an accident, one has no labels, or
            as of `accident_of`.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    other = twin_of(dataset, record)
    if other is None:
        raise NotAvailableError(f"{record['token']}: this release has no twin of it, with the same name and subtype")
    if record["collision"] is None and other["collision"] is not None:
        record, other = other, record
    accident = accident_of(dataset, record)
    if accident is None:
        raise NotAvailableError(f"{record['token']}: neither it nor its twin ends in an accident")
    mine, theirs = (recording_of(dataset, each["token"]) for each in (record, other))
    shift = shift_of(mine, theirs)
    recordings = mine, shifted(theirs, shift)
    matched = matched_rows(*recordings)
    rows = _rows_of_both(recordings, matched)
    ids = np.column_stack([_taken(each.actor_id, rows[:, at], UNTRACKED_ID) for at, each in enumerate(recordings)])
    codes = [_taken(each.category, rows[:, at], -1) for at, each in enumerate(recordings)]
    names = [{actor: name for name, actor in each.agents.items()} for each in recordings]
    first, second = (int(np.flatnonzero(ids[:, 0] == actor)[0]) for actor in accident.actor_ids)
    return TwinDiff(
        accident=record["token"],
        twin=other["token"],
        parting=parting or Parting(),
        actor_ids=ids,
        categories=tuple(CATEGORIES[code] for code in np.where(codes[0] < 0, codes[1], codes[0]).tolist()),
        agents=tuple(names[0].get(one) or names[1].get(two) for one, two in ids.tolist()),
        matched_by=tuple(matched[row][1] if row in matched else None for row in rows[:, 0].tolist()),
        num_frames=(record["num_frames"], other["num_frames"]),
        shift=shift,
        poses=_stacked(recordings, "poses", rows),
        speeds=_stacked(recordings, "speeds", rows),
        sizes=np.stack([_taken(each.size, rows[:, at]) for at, each in enumerate(recordings)]),
        pair=(first, second),
    )


def _rows_of_both(recordings: tuple[Recording, Recording], matched: Mapping[int, tuple[int, MatchedBy]]) -> IntArray:
    """(N, 2) rows of each actor in the two recordings, −1 for none: those of both first."""
    both = np.array([(row, matched[row][0]) for row in sorted(matched)], dtype=np.int64).reshape(-1, 2)
    alone, alone_there = (
        np.setdiff1d(np.arange(len(each.actor_id)), both[:, at]) for at, each in enumerate(recordings)
    )
    return np.concatenate(
        [
            both,
            np.column_stack([alone, np.full(len(alone), -1)]),
            np.column_stack([np.full(len(alone_there), -1), alone_there]),
        ]
    )


def _stacked(recordings: tuple[Recording, Recording], name: str, rows: IntArray) -> FloatArray:
    """(2, N, F, …) a field of both recordings, as long as the longer one."""
    parts = [_taken(getattr(each, name), rows[:, at]) for at, each in enumerate(recordings)]
    result = np.full((2, len(rows), max(part.shape[1] for part in parts), *parts[0].shape[2:]), np.nan)
    for at, part in enumerate(parts):
        result[at, :, : part.shape[1]] = part
    return result


def _taken(values: Any, rows: IntArray, missing: float = np.nan) -> Any:
    """Rows of an array; where a row is −1, the missing value."""
    result = values[rows].copy()
    result[rows < 0] = missing
    return result
