"""The golden lead-time ledger (tests/data/golden/safety): leads of the 16 coalitions, Shapley values of four partners.

The numbers come from plain code: Shapley values as means over the 24 orders (tests/data/golden/safety/README.md).
All to 1e-9.
"""

import numpy as np
import pytest

from deepaccident_devkit.safety import COALITIONS, PARTNERS, coalition_leads, shapley_values
from deepaccident_devkit.taxonomy import AGENTS

PART = "safety/ledger_and_cost"


@pytest.mark.golden_cases(PART, "ledger")
def test_leads_of_all_coalitions_and_shapley_values(golden) -> None:
    entry = golden.entry
    observed = np.array([[entry["observed"][agent][which] for which in "AB"] for agent in AGENTS], dtype=bool)
    assert observed.shape == (5, 2, entry["frames"])
    leads = coalition_leads(observed)
    expected = entry["expected"]["lead_seconds"]
    assert {"+".join(members) for members in COALITIONS} == expected.keys()
    for members, lead in zip(COALITIONS, leads.tolist(), strict=True):
        assert lead == pytest.approx(expected["+".join(members)], rel=0, abs=1e-9), members
    shapley = dict(zip(PARTNERS, shapley_values(leads).tolist(), strict=True))
    assert shapley == pytest.approx(entry["expected"]["shapley_seconds"], rel=0, abs=1e-9)
