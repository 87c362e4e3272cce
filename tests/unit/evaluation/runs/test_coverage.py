"""Results against the samples that are evaluated: what is missing, what was probably meant."""

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


@pytest.mark.parametrize(
    "meant",
    [
        SampleSelection(split="train", samples="all", scope="all"),
        SampleSelection(split="test", samples="all", scope="all", agents=("infrastructure",)),
        SampleSelection(split="val", samples="all", scope="accident", agents=("ego_vehicle", "infrastructure")),
    ],
)
def test_what_was_meant(da_b: DeepAccident, selection: SampleSelection, meant: SampleSelection) -> None:
    found = coverage(da_b, meant.tokens(da_b), selection)
    assert (found.guess, found.guess_share) == (meant, 1.0)
    assert (
        f"the results were probably made for {meant.text()} (they have just its samples); repeat with "
        in found.to_text()
    )


def test_the_options_that_choose_what_was_meant(da_motion: DeepAccident) -> None:
    """The text ends with them, for the command line and for Python; made with them, the selection is the meant one."""
    meant = SampleSelection(split="train", scope="all", agents=("infrastructure", "ego_vehicle"), horizon=3.0)
    text = coverage(da_motion, meant.tokens(da_motion), SampleSelection(split="train")).to_text()
    options, python = text.rsplit("; repeat with ", 1)[1].split(", in Python with ")
    assert options == "--split train --samples evaluate --scope all --agents ego_vehicle,infrastructure --horizon 3.0"
    assert eval(python, {"SampleSelection": SampleSelection}) == meant  # noqa: S307 - our own text
    usual = SampleSelection(split="train", samples="all", scope="all")
    assert usual.choices() == {"split": "train", "samples": "all", "scope": "all"}


def test_a_list_that_is_nearly_meant(da_b: DeepAccident, selection: SampleSelection) -> None:
    meant = SampleSelection(split="train", samples="all", scope="all")
    found = coverage(da_b, meant.tokens(da_b)[:-1], selection)
    assert (found.guess, found.guess_share) == (meant, 0.95)
    assert "(95% in common)" in found.to_text()


def test_the_other_horizon(da_motion: DeepAccident) -> None:
    meant = SampleSelection(split="train", horizon=3.0)
    found = coverage(da_motion, meant.tokens(da_motion), SampleSelection(split="train"))
    assert found.guess == meant
    assert len(found.extra) == 10


def test_no_guess_where_none_is_better(da_b: DeepAccident, selection: SampleSelection, expected: list[str]) -> None:
    for given in ([], ["mine"], expected[:-1]):
        found = coverage(da_b, given, selection)
        assert found.guess is None
        assert "probably" not in found.to_text()
