"""`SanityReport`: the findings of a few samples on predictions as a whole, and their texts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.headlines import Headline, Unit, value_text
from deepaccident_devkit.evaluation.runs.sanity.probes import Candidate, percent
from deepaccident_devkit.text import columns_text

NEAR_NOTHING: Final = 0.05
"""A score below this share of the way from the empty prediction's to the truth's is near nothing."""
NOTHING_WRONG: Final = "Nothing looks wrong with the predictions."


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """The findings of a few samples on predictions as a whole.

    Attributes:
        samples: how many were looked at.
        perfect: headline → value if the truth were predicted, in the form of the results: the most there is to reach.
        empty: headline → value if nothing were predicted.
        given: headline → value of the predictions, of these samples alone.
        units: headline → unit.
        candidates: all that was looked for, suspected or not.
        warnings: sentences; none if nothing looks wrong.
        unchecked: sentences: what such results do not hold, and could not be checked.
        verdict: what there is to say beside the warnings, a sentence: that nothing looks wrong, or that the score is
            near nothing and no check explains it; empty if a warning does.
    """

    samples: int
    perfect: Mapping[str, float | None]
    empty: Mapping[str, float | None]
    given: Mapping[str, float | None]
    units: Mapping[str, Unit]
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]
    unchecked: tuple[str, ...]
    verdict: str

    def to_text(self) -> str:
        """A table of the three, what was looked for, then the warnings and the verdict."""
        rows = [["", "nothing predicted", "given", "perfect"]]
        for name, value in self.given.items():
            texts = [value_text(each, self.units[name]) for each in (self.empty[name], value, self.perfect[name])]
            rows.append([name, *texts])
        head = f"Sanity check of {self.samples} samples. Scores of an empty prediction, of yours, of the truth itself:"
        suspected = sum(each.suspected for each in self.candidates)
        count = f"{suspected} suspected" if suspected else "none found"
        looked = f"{len(self.candidates)} mistakes looked for (mirrored, turned, shifted, scaled and others): {count}."
        unchecked = [f"Not looked at: {each}" for each in self.unchecked]
        lines = [head, columns_text(rows), looked, *unchecked, self.warnings_text(), self.verdict]
        return "\n".join(line for line in lines if line)

    def warnings_text(self) -> str:
        """The warnings alone, a line each; empty if there is none."""
        return "\n".join(f"WARNING: {each}" for each in self.warnings)


def verdict_of(
    given: Iterable[Headline],
    empty: Mapping[str, float | None],
    perfect: Mapping[str, float | None],
    *,
    explained: bool,
    warned: bool,
    checks: int,
) -> str:
    """The sentence beside the warnings.

    The score is the first headline of which more is better and in which the truth beats nothing.

    Args:
        given: headlines of the predictions, the most important first.
        empty: headline → value if nothing were predicted.
        perfect: headline → value if the truth were predicted.
        explained: whether a warning says why a score may be near nothing.
        warned: whether there is any warning.
        checks: how many mistakes were looked for.
    """
    if explained:
        return ""
    for each in given:
        low, high = empty[each.name] or 0.0, perfect[each.name]
        if not each.higher_is_better or high is None or high <= low:
            continue
        share = ((each.value or 0.0) - low) / (high - low)
        if share < NEAR_NOTHING:
            return (
                f"Near nothing: {each.name} is {percent(max(share, 0.0))} of the way from an empty prediction to the "
                f"truth; none of the {checks} checks explains it."
            )
        break
    return "" if warned else NOTHING_WRONG
