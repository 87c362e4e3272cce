"""The statistics' numbers, by hand on a tiny release and by plain Python on a synthetic one."""

import csv
import json
import math
import statistics as plain
from collections import Counter, defaultdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.expected_errors import assert_raises
from support.tiny_release import META_TEXT, SCENARIO_TYPE, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.statistics import ENDS, GROUPS, DatasetStatistics, dataset_statistics
from deepaccident_devkit.taxonomy import CATEGORIES

QUIET_META = "ClearNight -1 -1 -1 -1 -1 -1 -1 45\n"
NORMAL_TYPE = "type1_subtype2_normal"
EGO = ("ego_vehicle",)
PEDESTRIAN_META = (
    META_TEXT.replace("1212 car", "1400 pedestrian")
    .replace("ego other", "ego none")
    .replace("HardRainNoon", "WetNoon")
)
THIRD_VEHICLE_META = (
    META_TEXT.replace("1212 car", "1300 van")
    .replace("ego other", "ego none")
    .replace("four-way", "three-way")
)
UNDESIGNED_META = META_TEXT.replace("spawn_side: left", "spawn_side: opposite")


NAMES = [f"Town03_type001_subtype0001_scenario{number:05d}" for number in range(1, 7)]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """A release of six scenarios.

    They are design 1, a quiet one, a pedestrian that is hit, a third vehicle, an accident without
    a design, and one without meta and labels.
    """
    root = tmp_path_factory.mktemp("statistics")
    scenarios: list[dict[str, Any]] = [
        {},
        {"scenario_type": NORMAL_TYPE, "meta": QUIET_META, "agents": EGO, "frames": 35},
        {"meta": PEDESTRIAN_META, "agents": EGO, "frames": 2},
        {"meta": THIRD_VEHICLE_META, "agents": ("ego_vehicle", "infrastructure"), "frames": 2},
        {"meta": UNDESIGNED_META, "agents": EGO, "frames": 1},
        {"meta": None, "labelled": False, "agents": EGO, "frames": 30},
    ]
    for name, options in zip(NAMES, scenarios, strict=True):
        write_tiny_release(root, name=name, **options)
    train_lines = [f"{SCENARIO_TYPE} {name}" for name in (NAMES[0], NAMES[2], NAMES[4])]
    (root / "train.txt").write_text("\n".join(train_lines))
    (root / "val.txt").write_text(f"{NORMAL_TYPE} {NAMES[1]}\n")
    (root / "test.txt").write_text(f"{SCENARIO_TYPE} {NAMES[5]}\n")
    return DeepAccident(dataroot=root, verbose=False)


@pytest.fixture(scope="module")
def tiny_statistics(tiny: DeepAccident) -> DatasetStatistics:
    return dataset_statistics(tiny)


def test_scenarios_are_counted_by_split(tiny_statistics: DatasetStatistics) -> None:
    scenarios = {"total": 6, "train": 3, "val": 1, "test": 1, "unknown": 1}
    assert tiny_statistics.scenarios == scenarios
    frames = {"total": 74, "train": 7, "val": 35, "test": 30, "unknown": 2}
    assert tiny_statistics.frames == frames
    unlabelled = {"total": 1, "train": 0, "val": 0, "test": 1, "unknown": 0}
    assert tiny_statistics.unlabelled == unlabelled
    assert tiny_statistics.samples["total"] == 5 * 4 + 35 + 2 + 2 * 2 + 1 + 30


def test_how_scenarios_ended_and_in_which_weather(tiny_statistics: DatasetStatistics) -> None:
    def count_values(table: str) -> dict[str, int]:
        rows = tiny_statistics.counts[table].counts
        return {value: row["total"] for value, row in rows.items() if row["total"]}

    assert count_values("ends") == {
        "no accident": 1,
        "collide with pedestrians": 1,
        "collide with other vehicles": 1,
        "design 1": 1,
        "no design": 1,
        "unknown": 1,
    }
    assert count_values("collisions") == {"yes": 4, "no": 1, "unknown": 1}
    assert count_values("weathers") == {"Clear": 1, "HardRain": 3, "Wet": 1, "unknown": 1}
    assert tuple(tiny_statistics.counts["ends"].counts)[: len(ENDS)] == ENDS


@pytest.mark.parametrize(
    ("release", "end"),
    [
        ({"meta": UNDESIGNED_META, "agents": EGO}, "no design"),
        ({"meta": "\n".join([*META_TEXT.splitlines()[:1], ""])}, "unknown"),
        ({"meta": "\n".join([*META_TEXT.splitlines()[:3], ""])}, "unknown"),
        ({"meta": "\n".join([*META_TEXT.splitlines()[:1], ""]), "agents": EGO}, "unknown"),
    ],
)
def test_an_agent_that_was_not_downloaded_is_no_third_vehicle(
    tmp_path: Path, release: dict[str, Any], end: str
) -> None:
    root = write_tiny_release(tmp_path, frames=1, **release)
    counts = dataset_statistics(DeepAccident(dataroot=root, verbose=False)).counts["ends"].counts
    assert {name for name, row in counts.items() if row["total"]} == {end}


def test_lengths_have_the_references_seven_bins(tiny_statistics: DatasetStatistics) -> None:
    lengths = tiny_statistics.histograms["lengths"]
    assert lengths.counts["total"] == (2, 0, 0, 0, 0, 0, 0)
    assert lengths.counts["val"] == (1, 0, 0, 0, 0, 0, 0)
    assert lengths.outside == {"total": 4, "train": 3, "val": 0, "test": 0, "unknown": 1}
    assert lengths.edges == tuple(range(30, 101, 10))
    assert lengths.bin_labels()[0] == "30–39"
    assert lengths.bin_labels()[-1] == "90–100"


def test_ego_drives_at_ten_metres_a_second_and_has_the_size_of_its_row(
    tiny_statistics: DatasetStatistics,
) -> None:
    speeds = tiny_statistics.histograms["ego_speeds"]
    assert speeds.counts["total"][10] == 4 + 35 + 2 + 2 + 1
    assert speeds.total() == 44
    assert speeds.left_out.counts["test"] == 30

    sizes = tiny_statistics.quantiles["ego_sizes"]
    for field, size_m in (("length", 4.5), ("width", 1.9), ("height", 1.5)):
        assert sizes.median(field, "ego_vehicle") == size_m
    assert sizes.row("length", "ego_vehicle").number == 5
    assert sizes.median("length", "ego_vehicle", "test") is None
    assert sizes.left_out.counts["total"] == 1
    assert_raises((lambda: sizes.row("depth", "ego_vehicle"), KeyError, "depth"))


def test_the_pair_as_ego_sees_it(tiny_statistics: DatasetStatistics) -> None:
    """Ego at (5, −4.1) looks along −y, the other at (−19.9, 0) along x."""
    first, third = tiny_statistics.collisions
    assert (first.actor, first.other, first.end, first.split) == (
        "ego_vehicle",
        "other_vehicle",
        "design 1",
        "train",
    )
    assert (first.angle, first.x, first.y) == pytest.approx((90.0, -4.1, -24.9))
    assert (third.actor, third.other, third.other_category) == ("ego_vehicle", None, "van")

    bearings = tiny_statistics.histograms["collision_bearings"]
    assert bearings.counts["train"] == (0,) * 9 + (1, 0, 0)  # 260.6° is near 270°
    angles = tiny_statistics.histograms["collision_angles"]
    assert angles.counts["train"] == (0,) * 3 + (1,) + (0,) * 8
    assert angles.left_out is not None
    assert angles.left_out.counts == {"total": 2, "train": 2, "val": 0, "test": 0, "unknown": 0}


def test_equal_to_plain_python_over_records(both_layouts: DeepAccident) -> None:
    da = both_layouts
    statistics = dataset_statistics(da)
    splits = {scenario["token"]: scenario["split"] or "unknown" for scenario in da.scenario}
    scenario_tokens = {sample["token"]: sample["scenario_token"] for sample in da.sample}
    annotation_counts = Counter[tuple[str, str]]()
    distance_counts = Counter[int]()
    lengths = defaultdict(list)
    distances = defaultdict(list)
    for annotation in da.annotation:
        split = splits[scenario_tokens[annotation["sample_token"]]]
        distance = math.hypot(*annotation["translation"][:2])
        is_other = annotation["actor_id"] != -100  # not the agent's own row
        distance_counts[int(distance // 5)] += is_other
        for group in ("total", split):
            key = (annotation["category"], group)
            annotation_counts[key] += 1
            lengths[key].append(annotation["size"][0])
            if is_other:
                distances[key].append(distance)

    for key in product(CATEGORIES, GROUPS):
        category, group = key
        count = statistics.counts["annotations"].counts[category][group]
        assert count == annotation_counts[key]
        for table, field, values in (
            ("box_sizes", "length", lengths),
            ("distance_quantiles", "distance", distances),
        ):
            median = statistics.quantiles[table].median(field, category, group)
            expected = pytest.approx(plain.median(values[key])) if key in values else None
            assert median == expected
    expected_counts = tuple(distance_counts[index] for index in range(20))
    assert statistics.histograms["distances"].counts["total"] == expected_counts

    parked = {record["token"] for record in da.instance if record["actor_id"] >= 20000}
    speeds = defaultdict(list)
    for track in da.track:
        if track["instance_token"] not in parked and not math.isnan(track["velocity"][0]):
            speeds[track["category"]].append(math.hypot(*track["velocity"][:2]))
    for category in CATEGORIES:
        row = statistics.quantiles["speed_quantiles"].row("speed", category)
        assert row.number == len(speeds[category])
        max_speed = row.values[-1] if row.values else 0
        assert max_speed == pytest.approx(max(speeds[category], default=0))
    assert statistics.counts["instances"].total() == len(da.instance)
    ends = statistics.counts["ends"].counts.values()
    assert sum(row["total"] for row in ends) == len(da.scenario)


def test_a_selection_counts_only_its_scenarios(
    tiny: DeepAccident, tiny_statistics: DatasetStatistics
) -> None:
    train = dataset_statistics(tiny, tiny.find(split="train"))
    other_tokens = [record["token"] for record in tiny.scenario if record["split"] != "train"]
    remainder = dataset_statistics(tiny, other_tokens)
    assert train.selected
    for name, table in tiny_statistics.counts.items():
        for group in GROUPS:
            total = train.counts[name].total(group) + remainder.counts[name].total(group)
            assert total == table.total(group)
    for name, histogram in tiny_statistics.histograms.items():
        assert train.histograms[name].counts["train"] == histogram.counts["train"]
        total = train.histograms[name].total() + remainder.histograms[name].total()
        assert total == histogram.total()
    train_row = tiny_statistics.quantiles["box_sizes"].row("length", "van", "train")
    assert train.quantiles["box_sizes"].row("length", "van").values == train_row.values

    empty = dataset_statistics(tiny, [])
    assert empty.scenarios["total"] == empty.counts["annotations"].total() == 0
    assert empty.collisions == ()
    assert_raises((lambda: dataset_statistics(tiny, ["nowhere/at all"]), TokenError, "nowhere"))


def test_json_and_csv_say_the_same(tiny_statistics: DatasetStatistics, tmp_path: Path) -> None:
    content = json.loads(tiny_statistics.to_json(), parse_constant=pytest.fail)
    assert content["counts"]["ends"]["counts"]["design 1"]["train"] == 1
    assert content["histograms"]["lengths"]["edges"][-1] == 100

    folder = tmp_path / "new" / "folder"
    paths = tiny_statistics.to_csv(folder)
    assert sorted(folder.iterdir()) == sorted(paths)
    tables = {path.stem: list(csv.reader(path.read_text().splitlines())) for path in paths}
    assert len(tables) == len(tiny_statistics.tables) + 1
    assert tables["ends"][4] == ["design 1", "1", "1", "0", "0", "0"]
    header, first_row, *_, last_row = tables["lengths"]
    assert header == ["length from (frames)", "to (frames)", *GROUPS]
    assert first_row == ["30", "40", "2", "0", "1", "1", "0"]
    assert last_row == ["outside", "", "4", "3", "0", "0", "1"]
    assert len(tables["collision_pairs"]) == 1 + len(tiny_statistics.collisions)


TTC_EDGES_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)


def count_in_bins(min_ttcs: np.ndarray) -> tuple[int, ...]:
    counts, _ = np.histogram(min_ttcs[min_ttcs <= 10], TTC_EDGES_S)
    return tuple(counts)


def test_pairs_and_scenarios_are_in_their_bins(da_b: DeepAccident) -> None:
    plain_statistics = dataset_statistics(da_b)
    assert not {"pair_min_ttcs", "scenario_min_ttcs"} & plain_statistics.histograms.keys()
    assert "below 1.5 s" not in plain_statistics.to_text()

    statistics = dataset_statistics(da_b, interactions=True)
    assert "below 1.5 s" in statistics.to_text()
    for name, histogram in plain_statistics.histograms.items():
        assert statistics.histograms[name] == histogram

    scenario_pairs = [da_b.interactions(scenario).pairs for scenario in da_b.scenario]
    min_ttcs_by_scenario = [pairs.min_ttc[pairs.moving] for pairs in scenario_pairs]
    min_ttcs = np.concatenate(min_ttcs_by_scenario)
    pair_histogram = statistics.histograms["pair_min_ttcs"]
    assert pair_histogram.counts["total"] == count_in_bins(min_ttcs)
    num_outside = ((min_ttcs > 10) & np.isfinite(min_ttcs)).sum()
    assert pair_histogram.outside["total"] == num_outside
    assert pair_histogram.left_out.counts["total"] == np.isinf(min_ttcs).sum()

    scenario_histogram = statistics.histograms["scenario_min_ttcs"]
    scenario_min_ttcs = np.array([ttcs.min() for ttcs in min_ttcs_by_scenario])
    assert scenario_histogram.counts["total"] == count_in_bins(scenario_min_ttcs)
    num_scenarios = scenario_histogram.total() + scenario_histogram.left_out.counts["total"]
    assert num_scenarios == len(da_b.scenario)


def test_the_verb_counts_interactions(da_b: DeepAccident) -> None:
    arguments = ["info", str(da_b.dataroot), "--statistics", "--interactions"]
    result = CliRunner().invoke(deepaccident, arguments, catch_exceptions=False)
    expected = dataset_statistics(da_b, interactions=True).to_text()
    assert result.output.rstrip("\n") == expected
