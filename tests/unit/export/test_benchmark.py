"""`python -m benchmarks export`, on a release that is small enough for a test."""

import pytest
from scripts import of_checkout

from deepaccident_devkit.plugins.synth import SynthConfig

benchmark = of_checkout("benchmarks.export")


@pytest.mark.slow
def test_every_format_is_measured_with_links_and_with_copies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        benchmark, "RELEASE", SynthConfig(scenarios=1, frames=6, image_size=(64, 36), designed=True)
    )
    for name in ("SCENARIOS", "REPEATS"):
        monkeypatch.setattr(benchmark, name, 1)
    found = {figure.name: figure for figure in benchmark.measure()}
    names = [form.name for form in benchmark.FORMATS]
    for name in [*names, "opencood_copies"]:
        speed, size = found[f"export_{name}_samples_per_s"], found[f"export_{name}_kb_per_sample"]
        assert min(speed.value, speed.bound or 0, size.value) > 0
    sizes = [found[f"export_opencood{way}_kb_per_sample"].value for way in ("", "_copies")]
    assert sizes[0] < sizes[1]
    assert "export_parquet_copies_samples_per_s" not in found  # it links nothing
