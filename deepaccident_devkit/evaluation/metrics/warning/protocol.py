"""`WarningRules`: what counts as an alarm and as a right one, for all warning protocols."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal, get_args

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.metrics.alarms.raised import Naming
from deepaccident_devkit.evaluation.metrics.alarms.reading import AccidentReading
from deepaccident_devkit.text import settle_choices

CorrectBy = Literal["either", "pair", "place"]
_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {"naming": get_args(Naming), "correct_by": get_args(CorrectBy)}


@dataclass(frozen=True, slots=True, kw_only=True)
class WarningRules:
    """Which alarms are right, against the labels' boxes and the pair and the moment of the meta file.

    An alarm for later than the horizon does not count. Unlike an accident that counts for APA, the impact may be later
    than the model looks ahead: an early alarm with the right pair or the right place is a warning.

    Attributes:
        reading: how an accident is read off maps, as `BoxAccidents` has it. Their cells are coarse, so that they raise
            more false alarms than explicit accidents.
        min_score: alarms with a lower score do not count.
        match_distance: metres: gate of the matches that decide which actors an alarm without actor ids names.
        naming: whom an explicit accident without `ids` names, as `BoxAccidents` has it.
        correct_by: what makes an alarm right: that it names the `pair` that collides, in either order; the `place`,
            as its positions differ from where the two meet by less than `distance`; or `either` of these.
        distance: metres: the largest sum of the differences of the two positions, in the order that fits better; by
            default the distance of the errors of the accident protocol `paper`.
        time_tolerance: seconds: the largest time error of a right alarm; None for any.
    """

    reading: AccidentReading = field(default_factory=AccidentReading)
    min_score: float = 0.0
    match_distance: float = 4.0
    naming: Naming = "nearest"
    correct_by: CorrectBy = "either"
    distance: float = 10.0
    time_tolerance: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError or ConfigError."""
        settle_choices(self, _CHOICES)
        if not math.isfinite(self.min_score):
            raise ConfigError(f"min_score: expected a number, found {self.min_score!r}")
        for name in ("match_distance", "distance"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name}: expected metres above 0, found {getattr(self, name)!r}")
        if self.time_tolerance is not None and not self.time_tolerance >= 0:
            raise ConfigError(f"time_tolerance: expected seconds from 0, or None, found {self.time_tolerance!r}")

    def settings(self) -> dict[str, Any]:
        """All choices, as JSON can hold them."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
