"""Junctions of every kind, for the tests of the roads."""

import itertools

import pytest

from deepaccident_devkit.synth.roads import Junction, RoadSpec

SPECS = [
    RoadSpec(kind=kind, signalized=signalized, lanes=lanes, parking=parking, kerb_radius=radius)
    for kind, signalized, lanes, (parking, radius) in itertools.product(
        ["four-way", "three-way"], [True, False], [1, 2], [(True, 5.0), (False, 6.0)]
    )
]


@pytest.fixture(
    params=SPECS,
    ids=lambda spec: "-".join(
        [
            spec.kind,
            "lights" if spec.signalized else "yield",
            f"{spec.lanes}",
            "parking" if spec.parking else "kerb",
        ]
    ),
)
def junction(request) -> Junction:
    return Junction(request.param)
