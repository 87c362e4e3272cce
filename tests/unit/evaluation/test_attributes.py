"""What is known of samples and their scenarios."""

import math

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.breakdowns import (
    ATTRIBUTES,
    NO_IMPACT,
    sample_attributes,
    time_bin,
    tokens_by_value,
)
from deepaccident_devkit.motion import samples
from deepaccident_devkit.v2x import accident_visible


@pytest.mark.parametrize(
    ("frames", "second", "step"), [(0, "0 s", "0 s"), (1, "1 s", "0.5 s"), (5, "1 s", "0.5 s"), (6, "1 s", "1 s")]
)
def test_bins_of_time_have_their_upper_edge(frames: int, second: str, step: str) -> None:
    assert (time_bin(frames, 10), time_bin(frames, 5)) == (second, step)
    assert (time_bin(frames + 30, 10), time_bin(frames + 30, 5)) == tuple(
        f"{float(text.split()[0]) + 3:g} s" for text in (second, step)
    )


def test_attributes_of_a_releases_samples(da_motion: DeepAccident) -> None:
    tokens = samples(da_motion, "train", "evaluate")
    attributes = sample_attributes(da_motion, tokens)
    assert list(attributes) == tokens
    by_end = tokens_by_value(attributes, "time_to_end")
    assert sorted(value or "" for value in by_end) == ["0.5", "1.0", "1.5", "2.0"]
    assert {len(each) for each in by_end.values()} == {5}
    by_second = tokens_by_value(attributes, "time_to_impact")
    assert {value: len(each) for value, each in by_second.items()} == {"2 s": 10, "1 s": 10}
    words = {True: "visible", False: "invisible", None: None}
    assert all(
        each.accident_visibility == words[accident_visible(da_motion, token)] for token, each in attributes.items()
    )
    for name in ATTRIBUTES:
        assert sum(map(len, tokens_by_value(attributes, name).values())) == len(tokens)
    everywhere = sample_attributes(
        da_motion, [f"{record['token']}/infrastructure/005" for record in da_motion.scenario]
    )
    assert set(tokens_by_value(everywhere, "impact_step")) == {"3 s", NO_IMPACT}


def test_the_attributes_of_a_sample_are_those_of_its_record(da_motion: DeepAccident) -> None:
    for token, each in sample_attributes(da_motion, [sample["token"] for sample in da_motion.sample]).items():
        sample = da_motion.sample.get(token)
        tenths = round(10 * (sample["time_to_impact"] or 0))
        bins = f"{math.ceil(tenths / 10)} s", f"{math.ceil(tenths / 5) / 2:g} s"
        assert (each.time_to_impact, each.impact_step) == (
            (NO_IMPACT, NO_IMPACT) if sample["time_to_impact"] is None else bins
        )
        assert (each.value("agent"), each.value("all")) == (sample["agent"], "all")
