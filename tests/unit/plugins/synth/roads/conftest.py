"""Junctions of every kind, for the tests of the roads."""

import itertools

import pytest

from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec

SPECS = [
    RoadSpec(kind=kind, signalized=signalized, lanes=lanes)
    for kind, signalized, lanes in itertools.product(
        ["four-way", "three-way"], [True, False], [1, 2]
    )
]


@pytest.fixture(
    params=SPECS,
    ids=lambda spec: f"{spec.kind}-{'lights' if spec.signalized else 'yield'}-{spec.lanes}",
)
def junction(request) -> Junction:
    return Junction(request.param)
