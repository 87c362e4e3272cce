"""Whether a bundle was made with the labels of this release."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from deepaccident_devkit.evaluation.runs import Bundle, scenario_hashes
from deepaccident_devkit.explore.background import Job

if TYPE_CHECKING:
    from deepaccident_devkit.explore.explorer import Explorer


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthCheck:
    """A bundle's truth beside the release's.

    Attributes:
        checked: how many scenarios both have.
        differing: those of them whose label, meta or calib files are not the same.
    """

    checked: int
    differing: tuple[str, ...]


def truth_job(explorer: Explorer, name: str, bundle: Bundle) -> Job:
    """The work that gives the `TruthCheck` of a model's bundle: it reads the files of all its scenarios."""

    def work() -> TruthCheck:
        stated = bundle.scenarios()
        found = scenario_hashes(explorer.dataset, stated, workers=explorer.workers)
        differing = tuple(token for token, each in found.items() if each.as_dict() != stated[token])
        return TruthCheck(checked=len(found), differing=differing)

    return explorer.jobs.ask(f"truth {name}", f"whether the labels are those that {name} was evaluated with", work)
