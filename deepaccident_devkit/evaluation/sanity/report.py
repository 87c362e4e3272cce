"""`SanityReport`: what perfect, empty and the given predictions score, and what looks wrong with the given ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.headlines import Unit, value_text
from deepaccident_devkit.evaluation.sanity.probes import Candidate
from deepaccident_devkit.text import columns_text


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """What a few samples say of predictions as a whole.

    Attributes:
        samples: how many were looked at.
        perfect: headline → value if the truth were predicted, in the form of the results: the most there is to reach.
        empty: headline → value if nothing were predicted.
        given: headline → value of the predictions, of these samples alone.
        units: headline → unit.
        candidates: all that was looked for, suspected or not.
        warnings: sentences; none if nothing looks wrong.
    """

    samples: int
    perfect: Mapping[str, float | None]
    empty: Mapping[str, float | None]
    given: Mapping[str, float | None]
    units: Mapping[str, Unit]
    candidates: tuple[Candidate, ...]
    warnings: tuple[str, ...]

    def to_text(self) -> str:
        """A table of the three, then the warnings."""
        rows = [["", "nothing predicted", "given", "perfect"]]
        for name, value in self.given.items():
            texts = [value_text(each, self.units[name]) for each in (self.empty[name], value, self.perfect[name])]
            rows.append([name, *texts])
        head = f"Sanity, of {self.samples} samples; what the protocol gives to nothing and to the truth itself:"
        looked = f"{len(self.candidates)} mistakes were looked for: mirrored, turned, shifted, scaled and others."
        found = [f"WARNING: {each}" for each in self.warnings] or ["Nothing looks wrong with the predictions."]
        return "\n".join([head, columns_text(rows), looked, *found])
