"""Rigs: what two sources' vehicles carry; and the rig that stands for another dataset."""

from pathlib import Path

import numpy as np
import pytest
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.plugins.nuscenes.check import look_at
from deepaccident_devkit.plugins.nuscenes.sensor_setup_figures import sensor_setups_figure
from deepaccident_devkit.plugins.nuscenes.sensor_setups import (
    SensorSetupReport,
    sensor_setup_report,
)
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

SMALL = {
    "scenarios": 2,
    "frames": 3,
    "image_size": (64, 36),
    "seed": 3,
    "unplanned": 0,
    "designed": True,
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, DeepAccident]:
    """The same scenarios with the rig of the release, and with that of the road."""
    folder = tmp_path_factory.mktemp("sensor-setups")
    made = [
        make_release(folder / name, SynthConfig(rig=name, **SMALL), workers=1)
        for name in ("released", "road")
    ]
    return DeepAccident("v1", made[0], verbose=False), DeepAccident("v1", made[1], verbose=False)


@pytest.fixture(scope="module")
def report(sources: tuple[DeepAccident, DeepAccident]) -> SensorSetupReport:
    return sensor_setup_report(*sources)


def test_a_rig_is_what_was_mounted(report: SensorSetupReport) -> None:
    ours, road = report.sources
    assert [camera.field_of_view for camera in ours.cameras] == [
        70.0,
        70.0,
        70.0,
        110.0,
        70.0,
        70.0,
    ]
    assert [camera.field_of_view for camera in road.cameras] == [64.6, 64.6, 64.6, 89.3, 64.6, 64.6]
    assert [camera.looks % 360 for camera in ours.cameras] == [
        0.0,
        55.0,
        305.0,
        180.0,
        110.0,
        250.0,
    ]
    assert {camera.overlap for camera in ours.cameras} == {15.0, 20.0}
    assert [ours.lidar_above - camera.above for camera in ours.cameras] == pytest.approx(
        [0.3] * 6, abs=0.011
    )
    assert [road.lidar_above - camera.above for camera in road.cameras] == pytest.approx(
        [0.4] * 6, abs=0.011
    )
    assert ours.lidar_above - road.lidar_above == pytest.approx(0.3, abs=0.011)
    assert (ours.lanes, road.lanes, ours.labels_a_second) == (32, 32, 10.0)
    assert ours.road == pytest.approx(0.0, abs=0.1)
    assert sum(ours.shares.values()) == pytest.approx(1, abs=1e-3)


def test_what_is_odd_is_said_and_nothing_else(
    report: SensorSetupReport, sources: tuple[DeepAccident, DeepAccident]
) -> None:
    odd = "\n".join(report.odd)
    assert not lacking(
        odd,
        "Camera_Back: ",
        "1.4 times",
        "89 degrees, not 110",
        "Camera_Front: ",
        "LiDAR is 0.3 m lower",
    )
    assert "lanes" not in odd
    assert "89 degrees, not 110" in report.to_text()
    assert sensor_setup_report(sources[0], sources[0]).odd == ()
    assert (report.compared, report.exit_status, report.cannot_say) == (
        {"cameras": 6, "other facts": 8},
        0,
        (),
    )


def test_without_files_of_sensors_their_facts_are_unknown(da_b: DeepAccident) -> None:
    [facts] = sensor_setup_report(da_b).sources
    assert (facts.lanes, facts.points, facts.reach, facts.road) == (None,) * 4
    assert len(facts.cameras) == 6
    report = sensor_setup_report(da_b, da_b)
    assert (report.compared, report.exit_status) == ({"cameras": 6, "other facts": 4}, 0)
    assert report.cannot_say[0].startswith("lanes, points, reach, road: ")


def test_without_labels_nothing_is_compared(tmp_path: Path) -> None:
    root = write_small_release(tmp_path / "release", SmallRelease(splits=("test",), channels=()))
    with pytest.raises(NotAvailableError, match=r"release: ego_vehicle has no labels"):
        sensor_setup_report(DeepAccident(dataroot=root, verbose=False))


def test_the_picture_has_a_panel_for_each_and_the_classes(report: SensorSetupReport) -> None:
    figure = sensor_setups_figure(report)
    assert [ax.get_title() for ax in figure.axes] == ["released", "road", "classes"]
    assert any("89°" in text.get_text() for text in figure.axes[1].texts)


def test_the_road_has_the_same_drives_and_other_images(
    sources: tuple[DeepAccident, DeepAccident],
) -> None:
    ours, road = sources
    for record in ours.sample[::7]:
        token = record["token"]
        np.testing.assert_allclose(
            ours.world_from(token, "ego").matrix, road.world_from(token, "ego").matrix, atol=1e-4
        )
        mine, theirs = (each.load_image(token, "Camera_Front").astype(float) for each in sources)
        assert np.abs(mine - theirs).mean() > 3
        assert (
            theirs[..., 0].mean() / theirs[..., 2].mean()
            > mine[..., 0].mean() / mine[..., 2].mean()
        )  # warmer
    assert list(look_at(road).faults()) == []


def test_an_unknown_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"rig"):
        make_release(tmp_path / "release", SynthConfig(rig="boat"))
