"""`python -m benchmarks loader`, on a release that is small enough for a test."""

import pytest
from scripts import of_checkout

from deepaccident_devkit.plugins.synth import SynthConfig


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_every_way_to_load_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    benchmark = of_checkout("benchmarks.loader")
    monkeypatch.setattr(benchmark, "RELEASE", SynthConfig(scenarios=1, frames=2, image_size=(64, 36), designed=True))
    monkeypatch.setattr(benchmark, "TEAMS", {"one": benchmark.TEAMS["one"]})
    for name in ("SCENARIOS", "REPEATS"):
        monkeypatch.setattr(benchmark, name, 1)
    found = {figure.name: figure.value for figure in benchmark.measure()}
    both = ("full", "scaled", *benchmark.rivals())
    for way in ("cached_raw", "cached_jpeg", *both, *(f"{way}_normalised" for way in both)):
        for ending in ("ms", "items_per_s_0_workers", "items_per_s_1_workers", "items_per_s_2_workers"):
            assert found.pop(f"loader_{way}_one_{ending}") > 0
    assert len(found) == 6
