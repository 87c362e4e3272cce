"""`python -m benchmarks export`, on a release that is small enough for a test."""

import importlib
import pkgutil
from collections.abc import Iterator
from inspect import isabstract

import pytest
from scripts import of_checkout

import deepaccident_devkit.export
from deepaccident_devkit.export.bulk import Format
from deepaccident_devkit.plugins.synth import SynthConfig

benchmark = of_checkout("benchmarks.export")


def formats_of(kind: type[Format]) -> Iterator[type[Format]]:
    for each in kind.__subclasses__():
        if each.__module__.startswith("deepaccident_devkit.") and not isabstract(each):
            yield each
        yield from formats_of(each)


@pytest.mark.slow
def test_every_format_is_measured_with_links_and_with_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "RELEASE", SynthConfig(scenarios=1, frames=6, image_size=(64, 36), designed=True))
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


def test_no_format_is_forgotten() -> None:
    for module in pkgutil.walk_packages(deepaccident_devkit.export.__path__, "deepaccident_devkit.export."):
        if module.name.split(".")[2] not in ("mcap", "torch"):  # extras that need not be installed
            importlib.import_module(module.name)
    assert {type(form) for form in benchmark.FORMATS} == set(formats_of(Format))
