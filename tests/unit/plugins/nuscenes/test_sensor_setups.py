"""Rigs: the sensors of two sources' vehicles, and the synthetic rig that stands for another
dataset.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from support.figure_texts import STYLES, find_text_faults
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.plugins.nuscenes.check import look_at
from deepaccident_devkit.plugins.nuscenes.sensor_setup_figures import sensor_setups_figure
from deepaccident_devkit.plugins.nuscenes.sensor_setups import (
    CameraFacts,
    SensorSetupFacts,
    SensorSetupReport,
    sensor_setup_report,
)
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import style
from deepaccident_devkit.taxonomy import CATEGORIES
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

SHARES = {"car": 0.6, "motorcycle": 0.1, "pedestrian": 0.2, "ignored": 0.1}

SMALL_CONFIG = {
    "scenarios": 2,
    "frames": 3,
    "image_size": (64, 36),
    "seed": 3,
    "unplanned": 0,
    "designed": True,
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> tuple[DeepAccident, DeepAccident]:
    """Make the same scenarios with the rig of the release and with that of the road."""
    folder = tmp_path_factory.mktemp("sensor-setups")
    for rig in ("released", "road"):
        make_release(folder / rig, SynthConfig(rig=rig, **SMALL_CONFIG), workers=1)
    return (
        DeepAccident("v1", folder / "released", verbose=False),
        DeepAccident("v1", folder / "road", verbose=False),
    )


@pytest.fixture(scope="module")
def report(sources: tuple[DeepAccident, DeepAccident]) -> SensorSetupReport:
    return sensor_setup_report(*sources)


def test_a_rig_is_what_was_mounted(report: SensorSetupReport) -> None:
    released, road = report.sources
    assert [camera.field_of_view for camera in released.cameras] == [
        70.0,
        70.0,
        70.0,
        110.0,
        70.0,
        70.0,
    ]
    assert [camera.field_of_view for camera in road.cameras] == [64.6, 64.6, 64.6, 89.3, 64.6, 64.6]
    assert [camera.looks % 360 for camera in released.cameras] == [
        0.0,
        55.0,
        305.0,
        180.0,
        110.0,
        250.0,
    ]
    assert {camera.overlap for camera in released.cameras} == {15.0, 20.0}
    assert [released.lidar_above - camera.above for camera in released.cameras] == pytest.approx(
        [0.3] * 6, abs=0.011
    )
    assert [road.lidar_above - camera.above for camera in road.cameras] == pytest.approx(
        [0.4] * 6, abs=0.011
    )
    assert released.lidar_above - road.lidar_above == pytest.approx(0.3, abs=0.011)
    assert (released.lanes, road.lanes, released.labels_a_second) == (32, 32, 10.0)
    assert released.road == pytest.approx(0.0, abs=0.1)
    assert sum(released.shares.values()) == pytest.approx(1, abs=1e-3)


def test_only_odd_facts_are_reported(
    report: SensorSetupReport, sources: tuple[DeepAccident, DeepAccident]
) -> None:
    lines = "\n".join(report.odd)
    assert not missing_parts(
        lines,
        "Camera_Back: ",
        "1.4 times",
        "89 degrees, not 110",
        "Camera_Front: ",
        "LiDAR is 0.3 m lower",
    )
    assert "lanes" not in lines
    assert "89 degrees, not 110" in report.to_text()
    assert sensor_setup_report(sources[0], sources[0]).odd == ()
    assert (report.compared, report.exit_status, report.cannot_say) == (
        {"cameras": 6, "other facts": 8},
        0,
        (),
    )


def test_without_files_of_sensors_their_facts_are_unknown(da_b: DeepAccident) -> None:
    [facts] = sensor_setup_report(da_b).sources
    assert (facts.lanes, facts.points, facts.reach, facts.road) == (None, None, None, None)
    assert len(facts.cameras) == 6
    report = sensor_setup_report(da_b, da_b)
    assert (report.compared, report.exit_status) == ({"cameras": 6, "other facts": 4}, 0)
    assert report.cannot_say[0].startswith(
        "lanes of the LiDAR, points per cloud, reach of 99 % of the points (m), height of the "
        "road (m): "
    )


def test_tables_for_people_have_names_and_files_have_identifiers(tmp_path: Path) -> None:
    report = SensorSetupReport(sources=(make_facts("my_data"),), odd=(), compared={"cameras": 6})
    cameras, _, sources = report.to_text().partition("\nsources\n")
    assert cameras.splitlines()[:2] == [
        "cameras of my_data",
        (
            "camera             width (px)  height (px)  focal length / width  field of view (°)  "
            "yaw (°)  pitch (°)  above ground (m)  overlap to the left (°)"
        ),
    ]
    rows = dict(re.findall(r"^(\S.*\S)  +(\S+)$", sources, re.MULTILINE))
    assert rows["labels per second"] == "10.0"
    assert rows["cars, share of the boxes"] == "0.6"
    assert not re.search(r"[a-z]_[a-z]|share of car\b", sources.replace("my_data", ""))
    road_report = SensorSetupReport(sources=(make_facts("road"),), odd=(), compared={"cameras": 6})
    *_, sources = road_report.to_text().partition("\nsources\n")
    assert sources.split("\n", 1)[0].split() == ["road"]  # the name of a source, not of a fact
    table = report.to_csv(tmp_path)[-1].read_text()
    assert table.startswith(",my_data\nlidar_above,1.9\n")
    assert "\nshare of car,0.6\n" in table


def test_without_labels_nothing_is_compared(tmp_path: Path) -> None:
    root = write_small_release(tmp_path / "release", SmallRelease(splits=("test",), channels=()))
    with pytest.raises(NotAvailableError, match=r"release: ego_vehicle has no labels"):
        sensor_setup_report(DeepAccident(dataroot=root, verbose=False))


def test_the_picture_has_a_panel_for_each_and_the_classes(report: SensorSetupReport) -> None:
    figure = sensor_setups_figure(report)
    assert [ax.get_title() for ax in figure.axes] == ["released", "road", "Classes of the boxes"]
    assert any("89°" in text.get_text() for text in figure.axes[1].texts)


def make_facts(name: str) -> SensorSetupFacts:
    """Make the facts of a vehicle with six cameras."""
    directions = {"Front": 0, "FrontLeft": 55, "FrontRight": -55}
    directions |= {"Back": 180, "BackLeft": 110, "BackRight": -110}
    cameras = tuple(
        CameraFacts(
            camera=f"Camera_{place}",
            width=1600,
            height=900,
            focal=1142.5,
            field_of_view=70.0,
            looks=looks,
            pitch=0.0,
            above=1.6,
            overlap=15.0,
        )
        for place, looks in directions.items()
    )
    return SensorSetupFacts(
        name=name,
        cameras=cameras,
        lidar_above=1.9,
        lanes=32,
        points=30000.0,
        reach=80.0,
        road=0.0,
        labels_a_second=10.0,
        boxes=20.0,
        shares=dict.fromkeys((*CATEGORIES, "ignored"), 0.0) | SHARES,
    )


@pytest.mark.parametrize("names", [("DeepAccident_data",), ("DeepAccident_data", "v1.0-mini")])
@pytest.mark.parametrize("medium", STYLES)
def test_words_of_the_picture_are_apart(medium: Any, names: tuple[str, ...]) -> None:
    sources = tuple(map(make_facts, names))
    report = SensorSetupReport(sources=sources, odd=(), compared={})
    with style(medium):
        figure = sensor_setups_figure(report)
        assert find_text_faults(figure) == []
    plt.close(figure)


def test_the_road_has_the_same_drives_and_other_images(
    sources: tuple[DeepAccident, DeepAccident],
) -> None:
    released, road = sources
    for sample in released.sample[::7]:
        token = sample["token"]
        np.testing.assert_allclose(
            released.world_from(token, "ego").matrix,
            road.world_from(token, "ego").matrix,
            atol=1e-4,
        )
        released_image = released.load_image(token, "Camera_Front").astype(float)
        road_image = road.load_image(token, "Camera_Front").astype(float)
        assert np.abs(released_image - road_image).mean() > 3
        assert ratio_of_red_to_blue(road_image) > ratio_of_red_to_blue(released_image)
    assert list(look_at(road).faults()) == []


def ratio_of_red_to_blue(image: np.ndarray) -> float:
    red, _, blue = image.mean(axis=(0, 1))
    return red / blue


def test_an_unknown_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"rig"):
        make_release(tmp_path / "release", SynthConfig(rig="boat"))
