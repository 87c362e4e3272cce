"""Evaluations of different sources, each by its own rules, side by side and without differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from deepaccident_devkit.evaluation.runs.bundles import Bundle
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text


@dataclass(frozen=True, slots=True)
class SideBySide(Report):
    """Headlines of evaluations, a column for each evaluation.

    Attributes:
        rows: Rows of texts: what was evaluated and how, then a row for each headline of any
            evaluation.
    """

    rows: tuple[tuple[str, ...], ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a single table with all rows."""
        return {"numbers": list(self.rows)}

    def to_text(self) -> str:
        """Return all rows, and why there is no difference."""
        return f"{columns_text(self.rows)}\n\nno differences: they have no sample in common"


def side_by_side(bundles: Sequence[Bundle]) -> SideBySide:
    """Return the headlines of evaluations that need not have anything in common."""
    rows: dict[str, list[str]] = {"evaluation": [], "release": [], "rules": [], "samples": []}
    numbers = []
    for bundle in bundles:
        summary = bundle.summary
        release = summary["release"]
        rules = (summary["task"], summary["protocol"], *summary["switches"].values())
        rows["evaluation"].append(bundle.folder.name)
        rows["release"].append(f"{release['dataroot']}, {release['version']}")
        rows["rules"].append(", ".join(map(str, rules)))
        rows["samples"].append(f"{summary['counts']['samples']:,}")
        numbers.append({headline["name"]: headline["text"] for headline in summary["headlines"]})
    names = dict.fromkeys(name for texts in numbers for name in texts)
    for name in names:
        rows[name] = [texts.get(name, "–") for texts in numbers]
    return SideBySide(rows=tuple((name, *cells) for name, cells in rows.items()))
