"""A town's map: what it is made from, against the generator's roads, and how it is kept."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.maps import TownMap, TownMapConfig, kept_town_map, making, town_map
from deepaccident_devkit.plugins.synth.roads import ROAD_CODES, SIDEWALK
from deepaccident_devkit.support.arrays import BoolArray, FloatArray
from deepaccident_devkit.tables import clear_index
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA

pytestmark = pytest.mark.slow


def cell_centers(town_map: TownMap) -> FloatArray:
    """Return the centres of a map's cells, shape (H · W, 2)."""
    rows, columns = town_map.shape
    x = town_map.origin[0] + (np.arange(columns) + 0.5) * town_map.resolution
    y = town_map.origin[1] + (np.arange(rows) + 0.5) * town_map.resolution
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def intersection_over_union(first: BoolArray, second: BoolArray) -> float:
    return float((first & second).sum() / (first | second).sum())


def is_same_map(first: TownMap, second: TownMap) -> bool:
    fields = (
        "town",
        "resolution",
        "scenarios",
        "looks",
        "missing",
        "damaged",
        "origin",
        "counts",
        "agents",
        "hidden",
    )
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in fields)


def bev_files(da: DeepAccident, town: str, *agents: str) -> list[Path]:
    samples = product(da.field2token("scenario", "town", town), agents, (1, 6))
    return [
        da.get_sample_data_path(f"{token}/{agent}/{frame:03d}/{BEV_CAMERA}")
        for token, agent, frame in samples
    ]


def test_where_three_agents_looked_the_map_is_the_generators_ground(
    mapped_town: TownMap, true_codes: Callable[[FloatArray], FloatArray]
) -> None:
    """A cell at an edge may go either way; a map that is one cell off agrees less."""
    centers = cell_centers(mapped_town)
    codes = true_codes(centers).reshape(mapped_town.shape)
    shifted_codes = true_codes(centers + mapped_town.resolution).reshape(mapped_town.shape)
    is_seen = mapped_town.agents >= 3
    assert is_seen.sum() * mapped_town.resolution**2 > 10_000

    sidewalk = mapped_town.area("sidewalk") & is_seen
    assert intersection_over_union(sidewalk, (codes == SIDEWALK) & is_seen) > 0.95

    drivable = mapped_town.drivable() & is_seen
    iou = intersection_over_union(drivable, np.isin(codes, ROAD_CODES) & is_seen)
    shifted_iou = intersection_over_union(drivable, np.isin(shifted_codes, ROAD_CODES) & is_seen)
    assert iou > 0.99
    assert iou > shifted_iou + 0.01


def test_actors_leave_no_holes(
    bev_release: DeepAccident,
    town: str,
    mapped_town: TownMap,
    true_codes: Callable[[FloatArray], FloatArray],
) -> None:
    token = bev_release.field2token("scenario", "town", town)[0]
    pole = bev_release.world_from(f"{token}/infrastructure/001", "ego").translation[:2]
    centers = np.concatenate(
        [bev_release.boxes(f"{token}/{agent}/001").center[:, :2] for agent in AGENTS]
    )
    near_centers = centers[np.hypot(*(centers - pole).T) < 45]
    on_road = near_centers[np.isin(true_codes(near_centers), ROAD_CODES)]
    assert len(on_road) > 10
    assert set(mapped_town.classes_at(on_road).tolist()) <= {1, 2}
    assert (
        mapped_town.hidden == 1
    ).sum() * mapped_town.resolution**2 > 4  # at least one car is parked
    assert not mapped_town.counts[:, mapped_town.hidden > 0].any()
    (polygon,) = mapped_town.polygons().geoms
    assert not polygon.interiors


def test_each_picture_counts_once_and_each_agent_of_a_scenario_once(mapped_town: TownMap) -> None:
    num_recordings = 2 * len(AGENTS)
    num_pictures = 2 * num_recordings
    assert mapped_town.scenarios == 2
    assert mapped_town.looks == num_pictures
    assert mapped_town.missing == mapped_town.damaged == 0

    agents = mapped_town.agents
    looks = mapped_town.counts.sum(axis=0)
    assert looks.max() == num_pictures
    assert agents.max() == num_recordings
    np.testing.assert_array_equal(agents > 0, looks > 0)
    assert (looks <= 2 * agents.astype(int)).all()
    for edge in (agents[0], agents[-1], agents[:, 0], agents[:, -1]):
        assert edge.any()


@pytest.mark.parametrize("workers", [pytest.param(2, marks=pytest.mark.slow), None])
def test_neither_the_order_of_scenarios_nor_the_executor_changes_anything(
    bev_release: DeepAccident, town: str, mapped_town: TownMap, workers: int | None
) -> None:
    (path,) = bev_release.tables_folder.glob("town_maps/kept/*")
    content = path.read_bytes()
    path.unlink()
    tokens = bev_release.field2token("scenario", "town", town)[::-1]
    with ThreadPoolExecutor(2) as pool:
        engine = {"workers": workers} if workers else {"executor": pool}
        assert is_same_map(town_map(bev_release, town, scenarios=tokens, **engine), mapped_town)
    (new_path,) = bev_release.tables_folder.glob("town_maps/kept/*")
    assert new_path == path
    assert path.read_bytes() == content


def test_the_second_call_reads_what_the_first_kept(
    own_bev_release: DeepAccident, town: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert kept_town_map(own_bev_release, town) is None
    new_map = town_map(own_bev_release, town, workers=1)
    monkeypatch.setattr(making, "count_scenario", None)
    for kept_map in (town_map(own_bev_release, town), kept_town_map(own_bev_release, town)):
        assert is_same_map(kept_map, new_map)
        with pytest.raises(ValueError, match="read-only"):
            kept_map.counts[0, 0, 0] = 1
    with pytest.raises(TypeError):
        town_map(own_bev_release, town, config=TownMapConfig(resolution=0.5), workers=1)
    (cleared,) = clear_index(own_bev_release.dataroot)
    assert not cleared.exists()


def test_missing_pictures_are_counted_and_the_map_is_made_again_when_they_are_there(
    own_bev_release: DeepAccident, town: str, mapped_town: TownMap, tmp_path: Path
) -> None:
    paths = bev_files(own_bev_release, town, "infrastructure")
    moved_paths = [path.rename(tmp_path / f"{number}.npz") for number, path in enumerate(paths)]
    partial_map = town_map(own_bev_release, town, workers=1)
    assert partial_map.looks == 16
    assert partial_map.missing == 4
    assert partial_map.agents.max() == 8
    assert kept_town_map(own_bev_release, town) is town_map(own_bev_release, town)

    for path, moved_path in zip(paths, moved_paths, strict=True):
        moved_path.rename(path)
    assert is_same_map(town_map(own_bev_release, town, workers=1), mapped_town)


def test_without_any_picture_there_is_no_map(own_bev_release: DeepAccident, town: str) -> None:
    for path in bev_files(own_bev_release, town, *AGENTS):
        path.unlink()
    message = (town, "none of its 2 scenarios", f"unpack {BEV_CAMERA}")
    assert_raises((lambda: town_map(own_bev_release, town, workers=1), NotAvailableError, message))
    assert kept_town_map(own_bev_release, town) is None


def test_towns_and_scenarios_that_are_none(bev_release: DeepAccident, town: str) -> None:
    other_scenario = next(scenario for scenario in bev_release.scenario if scenario["town"] != town)

    def map_scenarios(scenarios: Any) -> Callable[[], object]:
        return lambda: town_map(bev_release, town, scenarios=scenarios)

    assert_raises(
        (
            lambda: town_map(bev_release, "Town99"),
            ChoiceError,
            ("town: expected one of", town, "'Town99'"),
        ),
        (map_scenarios(["x"]), TokenError, ("'x'",)),
        (map_scenarios("x"), TokenError, ("'x'",)),  # a single one counts as a list
        (
            map_scenarios([other_scenario]),
            NotAvailableError,
            ("none of the given scenarios (1)", town),
        ),
    )


def test_a_damaged_kept_map_is_made_again(
    own_bev_release: DeepAccident, town: str, mapped_town: TownMap
) -> None:
    town_map(own_bev_release, town, workers=1)
    (path,) = own_bev_release.tables_folder.glob("town_maps/kept/*")
    for damage in (b"", b"PK", path.read_bytes()[:-1]):
        path.write_bytes(damage)
        assert kept_town_map(own_bev_release, town) is None
        assert is_same_map(town_map(own_bev_release, town, workers=1), mapped_town)


def test_damaged_pictures_are_counted_and_named(
    own_bev_release: DeepAccident, town: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = bev_files(own_bev_release, town, "ego_vehicle")[0]
    path.unlink()
    path.write_bytes(b"nonsense")
    new_map = town_map(own_bev_release, town, workers=1)
    assert (new_map.looks, new_map.missing, new_map.damaged) == (19, 0, 1)
    assert f"excluded from the map: {path}: not a readable npz archive" in caplog.text
