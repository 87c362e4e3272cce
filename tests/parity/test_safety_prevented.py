"""The golden cost of false alarms (tests/data/golden/safety/ledger_and_cost.json), to 1e-9."""

import numpy as np
import pytest

from deepaccident_devkit.evaluation.metrics.warning import false_alarm_cost

NAMES = {
    "episodes": "episodes",
    "alarm_seconds": "alarm_seconds",
    "time_share": "time_share",
    "episodes_per_min": "episodes_per_minute",
    "braking_seconds": "braking_seconds",
    "braking_seconds_per_min": "braking_seconds_per_minute",
}


@pytest.mark.golden_cases("safety/ledger_and_cost", "false_alarm_cost")
def test_false_alarm_cost(golden) -> None:
    entry = golden.entry
    assert entry["expected"].keys() == NAMES.keys()
    found = false_alarm_cost(np.array([entry["alarm"]]) > 0, entry["reaction"], fps=entry["fps"])
    for name, value in entry["expected"].items():
        assert getattr(found, NAMES[name]) == pytest.approx(value, rel=1e-9, abs=1e-9), name
