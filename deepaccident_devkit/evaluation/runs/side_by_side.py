"""Evaluations of different sources, each by its own rules: their headlines beside each other, and no differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from deepaccident_devkit.evaluation.runs.bundles import Bundle
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text


@dataclass(frozen=True, slots=True)
class SideBySide(Report):
    """A column for each evaluation.

    Attributes:
        rows: of texts: what was evaluated and how, then a row for each headline that one of them has.
    """

    rows: tuple[tuple[str, ...], ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """All rows."""
        return {"numbers": list(self.rows)}

    def to_text(self) -> str:
        """All rows, and why there is no difference."""
        return f"{columns_text(self.rows)}\n\nno differences: they have no sample in common"


def side_by_side(bundles: Sequence[Bundle]) -> SideBySide:
    """The headlines of evaluations that need have nothing in common."""
    told = [bundle.summary for bundle in bundles]
    numbers = [{each["name"]: each["text"] for each in summary["headlines"]} for summary in told]
    rows = {
        "evaluation": [bundle.folder.name for bundle in bundles],
        "release": [
            f"{summary['release']['dataroot']}, {summary['release']['version']}" for summary in told
        ],
        "rules": [
            ", ".join(map(str, (each["task"], each["protocol"], *each["switches"].values())))
            for each in told
        ],
        "samples": [f"{summary['counts']['samples']:,}" for summary in told],
        **{name: [own.get(name, "–") for own in numbers] for own in numbers for name in own},
    }
    return SideBySide(rows=tuple((name, *cells) for name, cells in rows.items()))
