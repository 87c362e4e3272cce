"""`python -m benchmarks loader`, on a release that is small enough for a test."""

import pytest
from scripts import of_checkout

from deepaccident_devkit.synth import SynthConfig


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_every_way_to_load_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    benchmark = of_checkout("benchmarks.loader")
    monkeypatch.setattr(benchmark, "RELEASE", SynthConfig(scenarios=1, frames=2, image_size=(64, 36), designed=True))
    monkeypatch.setattr(benchmark, "TEAMS", {"one": benchmark.TEAMS["one"]})
    for name in ("SCENARIOS", "REPEATS"):
        monkeypatch.setattr(benchmark, name, 1)
    found = {figure.name: figure.value for figure in benchmark.measure()}
    normalised = [f"{way}_normalised" for way in ("full", "scaled", "pillow", "cv2")]
    for way in ("full", "scaled", "cached_raw", "cached_jpeg", *benchmark.rivals(), *normalised):
        for ending in ("ms", "items_per_s_0_workers", "items_per_s_1_workers", "items_per_s_2_workers"):
            assert found[f"loader_{way}_one_{ending}"] > 0
