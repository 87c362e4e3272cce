"""Evaluations of different data, or under different rules, side by side without differences."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from deepaccident_devkit.evaluation.runs.bundles import Bundle
from deepaccident_devkit.support.human_names import metric_name
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text


@dataclass(frozen=True, slots=True)
class SideBySide(Report):
    """Table of headlines with one column per evaluation.

    Attributes:
        rows: Rows of texts: what was evaluated and how, then one row for each headline that any
            evaluation has.
    """

    rows: tuple[tuple[str, ...], ...]

    def named_tables(self) -> dict[str, list[Row]]:
        """Return a single table that contains all rows."""
        return {"numbers": list(self.rows)}

    def to_text(self) -> str:
        """Format all rows, with a note that explains why differences are not shown."""
        rows = [(metric_name(name), *cells) for name, *cells in self.rows]
        return f"{columns_text(rows)}\n\nno differences, since they have no sample in common"


def side_by_side(bundles: Sequence[Bundle]) -> SideBySide:
    """Tabulate the headlines of evaluations, which need not have anything in common."""
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
    for name in dict.fromkeys(chain(*numbers)):
        rows[name] = [texts.get(name, "–") for texts in numbers]
    return SideBySide(rows=tuple((name, *cells) for name, cells in rows.items()))
