"""`python -m benchmarks export` on a release that is small enough for a test."""

import pytest
from support.repository_scripts import import_from_checkout

from deepaccident_devkit.plugins.synth import SynthConfig

benchmark = import_from_checkout("benchmarks.export")


@pytest.mark.slow
def test_every_format_is_measured_with_links_and_with_copies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        benchmark, "RELEASE", SynthConfig(scenarios=1, frames=6, image_size=(64, 36), designed=True)
    )
    for name in ("SCENARIOS", "REPEATS"):
        monkeypatch.setattr(benchmark, name, 1)

    figures = {figure.name: figure for figure in benchmark.measure()}
    for name in [*(form.name for form in benchmark.FORMATS), "opencood_copies"]:
        speed = figures[f"export_{name}_samples_per_s"]
        size = figures[f"export_{name}_kb_per_sample"]
        assert min(speed.value, speed.bound or 0, size.value) > 0
    linked_size = figures["export_opencood_kb_per_sample"].value

    assert linked_size < figures["export_opencood_copies_kb_per_sample"].value
    assert "export_parquet_copies_samples_per_s" not in figures  # it links nothing
