"""The figures of `python -m benchmarks engine`, from small made-up measurements."""

import pytest
from support.repository_scripts import import_from_checkout

benchmark = import_from_checkout("benchmarks.engine")


def test_the_serial_share_is_of_one_core_and_bounds_all_cores() -> None:
    values = {"samples": 100, "handed": 20, "item_s": 0.5, "batch_s": 0.5, "growth_mb": 1.0}
    serial = benchmark.Measurement(**values, export_s=10.0, outside_s=0.9, batch_busy_s=0.0)
    engine = benchmark.Measurement(**values, export_s=6.0, outside_s=0.3, batch_busy_s=0.01)
    assert benchmark.serial_share(serial, engine) == pytest.approx((0.3 + 20 * 0.01) / 10)
    assert benchmark.amdahl(0.0, 64) == 64
    assert benchmark.amdahl(1.0, 64) == 1
    assert benchmark.amdahl(0.05, 512) == pytest.approx(512 / (1 + 511 * 0.05))

    results = benchmark.of_engine("engine_dask", serial, serial, engine)
    figures = {figure.name: figure for figure in results}
    assert figures["engine_dask_efficiency_2_workers"].value == pytest.approx(10 / 6 / 2)
    whole_release = figures["engine_dask_whole_release_by_amdahl_64"]
    serial_minutes = benchmark.WHOLE_SAMPLES / 100 * 10 / 60
    assert whole_release.value == pytest.approx(serial_minutes / benchmark.amdahl(0.05, 64))
    assert "computed" in whole_release.unit
