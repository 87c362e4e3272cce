"""Accidents in results files: {"positions", "time", "score", "ids"}, positions in the sample's present ego frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.results.columns import (
    ANY_NUMBER,
    FROM_ZERO,
    LARGEST,
    Entry,
    check_entries,
    numbers,
    whole_numbers,
    with_value,
)
from deepaccident_devkit.evaluation.results.entries import Columns, Entries

REQUIRED: Final = ("positions", "time", "score")
OPTIONAL: Final = ("ids",)


def accident_columns(entries: Sequence[Entry], owners: Sequence[str]) -> Columns:
    """The columns of N accidents; raises ContentError.

    Args:
        entries: as a file has them.
        owners: tokens of their samples, which accidents do not name.

    Returns:
        positions (N, 2, 2) metres, time (N,) seconds, score (N,), ids (N, 2), identified (N,) bool.
    """
    del owners
    check_entries(entries, REQUIRED, OPTIONAL)
    points = f"two points [[x, y], [x, y]] of finite numbers up to {LARGEST:,.0f}, metres"
    rows, named = with_value(entries, "ids")
    ids, identified = np.zeros((len(entries), 2), dtype=np.int64), np.zeros(len(entries), dtype=bool)
    ids[rows] = whole_numbers(named, "ids", (2,), "two whole numbers, or null where they are not known")
    identified[rows] = True
    return {
        "positions": numbers(entries, "positions", (2, 2), points),
        "time": numbers(entries, "time", (), f"a finite number of seconds from 0 to {LARGEST:,.0f}", FROM_ZERO),
        "score": numbers(entries, "score", (), "a finite number", ANY_NUMBER),
        "ids": ids,
        "identified": identified,
    }


def accidents_at(entries: Entries, token: str) -> list[Accident]:
    """The accidents of a sample; KeyError for one that is not here."""
    columns = entries.of(token)
    identified, ids = columns["identified"].tolist(), columns["ids"].tolist()
    return [
        Accident(
            positions=columns["positions"][row],
            time=float(columns["time"][row]),
            score=float(columns["score"][row]),
            ids=(ids[row][0], ids[row][1]) if identified[row] else None,
        )
        for row in range(len(ids))
    ]


def accident_entries(accidents: Iterable[Accident]) -> list[dict[str, Any]]:
    """Accidents as a file has them."""
    return [
        {
            "positions": each.positions.tolist(),
            "time": each.time,
            "score": each.score,
            "ids": None if each.ids is None else list(each.ids),
        }
        for each in accidents
    ]
