"""`python -m benchmarks engine`, with settings that are small enough for a test."""

import pytest
from scripts import of_checkout

benchmark = of_checkout("benchmarks.engine")


def test_the_serial_share_is_of_one_core_and_bounds_all_cores() -> None:
    seen = {"samples": 100, "handed": 20, "item_s": 0.5, "batch_s": 0.5, "growth_mb": 1.0}
    here = benchmark.Seen(**seen, export_s=10.0, outside_s=0.9, batch_busy_s=0.0)
    engine = benchmark.Seen(**seen, export_s=6.0, outside_s=0.3, batch_busy_s=0.01)
    assert benchmark.serial_share(here, engine) == pytest.approx((0.3 + 20 * 0.01) / 10)
    assert (benchmark.amdahl(0.0, 64), benchmark.amdahl(1.0, 64)) == (64, 1)
    assert benchmark.amdahl(0.05, 512) == pytest.approx(512 / (1 + 511 * 0.05))
    found = {
        figure.name: figure for figure in benchmark.of_engine("engine_dask", here, here, engine)
    }
    assert found["engine_dask_efficiency_2_workers"].value == pytest.approx(10 / 6 / 2)
    whole = found["engine_dask_whole_release_by_amdahl_64"]
    assert whole.value == pytest.approx(
        benchmark.WHOLE_SAMPLES / 100 * 10 / 60 / benchmark.amdahl(0.05, 64)
    )
    assert "computed" in whole.unit
