"""Results against the samples that are evaluated: what is missing, and what predictions are of."""

from dataclasses import replace

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import SampleSelection, coverage


@pytest.fixture(scope="module")
def expected(da_b: DeepAccident, selection: SampleSelection) -> list[str]:
    return selection.tokens(da_b)


def test_all_there_in_any_order(da_b: DeepAccident, selection: SampleSelection, expected: list[str]) -> None:
    found = coverage(da_b, expected[::-1], selection)
    assert found.is_complete
    assert found.to_text() == "all 6 samples have a prediction, and nothing else has"


def test_missing_extra_and_unknown_three_of_each(
    da_b: DeepAccident, selection: SampleSelection, expected: list[str]
) -> None:
    extra = replace(selection, agents=("ego_vehicle_behind",)).tokens(da_b)
    found = coverage(da_b, [*expected[4:], *extra, "mine/1", "mine/2", "mine/3", "mine/4"], selection)
    assert (found.expected, found.missing, found.extra) == (6, tuple(expected[:4]), tuple(sorted(extra)))
    assert found.unknown == ("mine/1", "mine/2", "mine/3", "mine/4")
    assert found.to_text().startswith(
        f"4 of 6 samples have no prediction ({', '.join(expected[:3])}, …); "
        f"2 predictions are of samples that are not evaluated ({', '.join(sorted(extra))}); "
        "4 predictions are of no sample of this release (mine/1, mine/2, mine/3, …)"
    )


def test_what_the_predictions_are_of(da_b: DeepAccident, selection: SampleSelection) -> None:
    others = SampleSelection(split="train", samples="all", scope="all", agents=("infrastructure", "ego_vehicle"))
    found = coverage(da_b, [*others.tokens(da_b), "mine"], selection)
    assert (found.splits, found.agents) == (("train",), ("ego_vehicle", "infrastructure"))
    assert found.to_text().endswith(
        "; the predictions are of the splits train and the agents ego_vehicle, infrastructure"
    )
    assert "the predictions are of" not in coverage(da_b, ["mine"], selection).to_text()
