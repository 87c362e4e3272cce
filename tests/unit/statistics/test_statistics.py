"""The statistics' numbers: by hand on a tiny release, and by plain Python over records on a
synthetic one.
"""

import csv
import json
import math
import statistics as plain
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from refusals import assert_refused
from tiny import META, TYPE, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.statistics import ENDS, GROUPS, DatasetStatistics, dataset_statistics
from deepaccident_devkit.taxonomy import CATEGORIES

QUIET = "ClearNight -1 -1 -1 -1 -1 -1 -1 45\n"
NORMAL = "type1_subtype2_normal"
EGO = ("ego_vehicle",)
WALKER = (
    META.replace("1212 car", "1400 pedestrian")
    .replace("ego other", "ego none")
    .replace("HardRainNoon", "WetNoon")
)
THIRD = (
    META.replace("1212 car", "1300 van")
    .replace("ego other", "ego none")
    .replace("four-way", "three-way")
)
ODD = META.replace("spawn_side: left", "spawn_side: opposite")


def named(number: int) -> str:
    return f"Town03_type001_subtype0001_scenario{number:05d}"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Six scenarios: design 1, a quiet one, a pedestrian hit, a third vehicle, no design; one
    without anything.
    """
    root = tmp_path_factory.mktemp("statistics")
    write_tiny_release(root, name=named(1))
    write_tiny_release(root, name=named(2), scenario_type=NORMAL, meta=QUIET, agents=EGO, frames=35)
    write_tiny_release(root, name=named(3), meta=WALKER, agents=EGO, frames=2)
    write_tiny_release(
        root, name=named(4), meta=THIRD, agents=("ego_vehicle", "infrastructure"), frames=2
    )
    write_tiny_release(root, name=named(5), meta=ODD, agents=EGO, frames=1)
    write_tiny_release(root, name=named(6), meta=None, labelled=False, agents=EGO, frames=30)
    (root / "train.txt").write_text(f"{TYPE} {named(1)}\n{TYPE} {named(3)}\n{TYPE} {named(5)}\n")
    (root / "val.txt").write_text(f"{NORMAL} {named(2)}\n")
    (root / "test.txt").write_text(f"{TYPE} {named(6)}\n")
    return DeepAccident(dataroot=root, verbose=False)


@pytest.fixture(scope="module")
def of_tiny(tiny: DeepAccident) -> DatasetStatistics:
    return dataset_statistics(tiny)


def test_scenarios_are_counted_by_split(of_tiny: DatasetStatistics) -> None:
    assert (of_tiny.scenarios, of_tiny.frames, of_tiny.unlabelled) == (
        {"total": 6, "train": 3, "val": 1, "test": 1, "unknown": 1},
        {"total": 74, "train": 7, "val": 35, "test": 30, "unknown": 2},
        {"total": 1, "train": 0, "val": 0, "test": 1, "unknown": 0},
    )
    assert of_tiny.samples["total"] == 5 * 4 + 35 + 2 + 2 * 2 + 1 + 30


def test_how_scenarios_ended_and_in_which_weather(of_tiny: DatasetStatistics) -> None:
    found = {
        name: {
            end: row["total"] for end, row in of_tiny.counts[name].counts.items() if row["total"]
        }
        for name in ("ends", "collisions", "weathers")
    }
    once = (
        "no accident",
        "collide with pedestrians",
        "collide with other vehicles",
        "design 1",
        "no design",
        "unknown",
    )
    assert found == {
        "ends": dict.fromkeys(once, 1),
        "collisions": {"yes": 4, "no": 1, "unknown": 1},
        "weathers": {"Clear": 1, "HardRain": 3, "Wet": 1, "unknown": 1},
    }
    assert tuple(of_tiny.counts["ends"].counts)[: len(ENDS)] == ENDS


@pytest.mark.parametrize(
    ("release", "end"),
    [
        ({"meta": ODD, "agents": EGO}, "no design"),
        ({"meta": "\n".join([*META.splitlines()[:1], ""])}, "unknown"),
        ({"meta": "\n".join([*META.splitlines()[:3], ""])}, "unknown"),
        ({"meta": "\n".join([*META.splitlines()[:1], ""]), "agents": EGO}, "unknown"),
    ],
)
def test_an_agent_that_was_not_downloaded_is_no_third_vehicle(
    tmp_path: Path, release: dict[str, Any], end: str
) -> None:
    root = write_tiny_release(tmp_path, frames=1, **release)
    counts = dataset_statistics(DeepAccident(dataroot=root, verbose=False)).counts["ends"].counts
    assert {name for name, row in counts.items() if row["total"]} == {end}


def test_lengths_have_the_references_seven_bins(of_tiny: DatasetStatistics) -> None:
    lengths = of_tiny.histograms["lengths"]
    assert [lengths.counts[group] for group in ("total", "val")] == [(2, *[0] * 6), (1, *[0] * 6)]
    assert lengths.outside == {"total": 4, "train": 3, "val": 0, "test": 0, "unknown": 1}
    assert (lengths.edges, lengths.bin_labels()[0], lengths.bin_labels()[-1]) == (
        (*range(30, 101, 10),),
        "30–39",
        "90–100",
    )


def test_ego_drives_at_ten_metres_a_second_and_has_the_size_of_its_row(
    of_tiny: DatasetStatistics,
) -> None:
    speeds, sizes = of_tiny.histograms["ego_speeds"], of_tiny.quantiles["ego_sizes"]
    assert (speeds.counts["total"][10], speeds.total(), speeds.left_out.counts["test"]) == (
        4 + 35 + 2 + 2 + 1,
        44,
        30,
    )
    assert [sizes.median(field, "ego_vehicle") for field in ("length", "width", "height")] == [
        4.5,
        1.9,
        1.5,
    ]
    known = (
        sizes.row("length", "ego_vehicle").number,
        sizes.median("length", "ego_vehicle", "test"),
    )
    assert (*known, sizes.left_out.counts["total"]) == (5, None, 1)
    assert_refused((lambda: sizes.row("depth", "ego_vehicle"), KeyError, "depth"))


def test_the_pair_as_ego_sees_it(of_tiny: DatasetStatistics) -> None:
    """Ego at (5, −4.1) looks along −y, the other at (−19.9, 0) along x."""
    first, third = of_tiny.collisions
    assert (first.actor, first.other, first.end, first.split) == (
        "ego_vehicle",
        "other_vehicle",
        "design 1",
        "train",
    )
    assert (first.angle, first.x, first.y) == pytest.approx((90.0, -4.1, -24.9))
    assert (third.actor, third.other, third.other_category) == ("ego_vehicle", None, "van")
    angles, bearings = (
        of_tiny.histograms["collision_angles"],
        of_tiny.histograms["collision_bearings"],
    )
    assert angles.counts["train"] == tuple(int(index == 3) for index in range(12))
    assert bearings.counts["train"] == tuple(
        int(index == 9) for index in range(12)
    )  # 260.6° is near 270°
    assert angles.left_out is not None
    assert angles.left_out.counts == {"total": 2, "train": 2, "val": 0, "test": 0, "unknown": 0}


def test_equal_to_plain_python_over_records(both_layouts: DeepAccident) -> None:
    da = both_layouts
    made = dataset_statistics(da)
    split_of = {scenario["token"]: scenario["split"] or "unknown" for scenario in da.scenario}
    scenario_of_sample = {sample["token"]: sample["scenario_token"] for sample in da.sample}
    annotations, numbers, lengths, far = Counter[tuple[str, str]](), Counter[int](), {}, {}
    for box in da.annotation:
        group = split_of[scenario_of_sample[box["sample_token"]]]
        for key in ((box["category"], "total"), (box["category"], group)):
            annotations[key] += 1
            lengths.setdefault(key, []).append(box["size"][0])
            if box["actor_id"] != -100:
                far.setdefault(key, []).append(math.hypot(*box["translation"][:2]))
        numbers[int(math.hypot(*box["translation"][:2]) // 5)] += box["actor_id"] != -100
    for category in CATEGORIES:
        for group in GROUPS:
            key = (category, group)
            assert made.counts["annotations"].counts[category][group] == annotations[key]
            for table, field, values in (
                ("box_sizes", "length", lengths),
                ("distance_quantiles", "distance", far),
            ):
                median = made.quantiles[table].median(field, category, group)
                assert median == (
                    pytest.approx(plain.median(values[key])) if key in values else None
                )
    assert made.histograms["distances"].counts["total"] == tuple(
        numbers[index] for index in range(20)
    )
    parked = {record["token"] for record in da.instance if record["actor_id"] >= 20000}
    speeds = [
        (track["category"], math.hypot(*track["velocity"][:2]))
        for track in da.track
        if track["instance_token"] not in parked and not math.isnan(track["velocity"][0])
    ]
    for category in CATEGORIES:
        row = made.quantiles["speed_quantiles"].row("speed", category)
        values = [speed for name, speed in speeds if name == category]
        assert (row.number, row.values[-1] if row.values else 0) == (
            len(values),
            pytest.approx(max(values, default=0)),
        )
    ended = (row["total"] for row in made.counts["ends"].counts.values())
    assert (made.counts["instances"].total(), sum(ended)) == (len(da.instance), len(da.scenario))


def test_a_selection_counts_alone(tiny: DeepAccident, of_tiny: DatasetStatistics) -> None:
    train = dataset_statistics(tiny, tiny.find(split="train"))
    rest = dataset_statistics(
        tiny, [record["token"] for record in tiny.scenario if record["split"] != "train"]
    )
    assert train.selected
    for name, table in of_tiny.counts.items():
        for group in GROUPS:
            assert train.counts[name].total(group) + rest.counts[name].total(group) == table.total(
                group
            )
    for name, histogram in of_tiny.histograms.items():
        assert train.histograms[name].counts["train"] == histogram.counts["train"]
        assert train.histograms[name].total() + rest.histograms[name].total() == histogram.total()
    sizes, of_all = (each.quantiles["box_sizes"] for each in (train, of_tiny))
    assert sizes.row("length", "van").values == of_all.row("length", "van", "train").values
    nothing = dataset_statistics(tiny, [])
    assert (
        nothing.scenarios["total"],
        nothing.collisions,
        nothing.counts["annotations"].total(),
    ) == (0, (), 0)
    assert_refused((lambda: dataset_statistics(tiny, ["nowhere/at all"]), TokenError, "nowhere"))


def test_json_and_csv_say_the_same(of_tiny: DatasetStatistics, tmp_path: Path) -> None:
    content = json.loads(of_tiny.to_json(), parse_constant=pytest.fail)
    ends, lengths = content["counts"]["ends"]["counts"], content["histograms"]["lengths"]
    assert (ends["design 1"]["train"], lengths["edges"][-1]) == (1, 100)
    written = of_tiny.to_csv(tmp_path / "new" / "folder")
    assert sorted((tmp_path / "new" / "folder").iterdir()) == sorted(written)
    tables = {path.stem: list(csv.reader(path.read_text().splitlines())) for path in written}
    assert (len(tables), tables["ends"][4]) == (
        len(of_tiny.tables) + 1,
        ["design 1", "1", "1", "0", "0", "0"],
    )
    head, first, *_, last = tables["lengths"]
    assert (head, first, last) == (
        ["length from (frames)", "to (frames)", *GROUPS],
        ["30", "40", "2", "0", "1", "1", "0"],
        ["outside", "", "4", "3", "0", "0", "1"],
    )
    assert len(tables["collision_pairs"]) == 1 + len(of_tiny.collisions)


EDGES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)


def test_pairs_and_scenarios_are_in_their_bins(da_b: DeepAccident) -> None:
    plain = dataset_statistics(da_b)
    assert not {"pair_min_ttcs", "scenario_min_ttcs"} & plain.histograms.keys()
    made = dataset_statistics(da_b, interactions=True)
    assert {
        name: each for name, each in made.histograms.items() if name in plain.histograms
    } == plain.histograms
    times = [
        found.pairs.min_ttc[found.pairs.moving] for found in map(da_b.interactions, da_b.scenario)
    ]
    pairs, scenarios = made.histograms["pair_min_ttcs"], made.histograms["scenario_min_ttcs"]
    together = np.concatenate(times)
    assert (pairs.counts["total"], pairs.outside["total"], pairs.left_out.counts["total"]) == (
        tuple(np.histogram(together[together <= 10], EDGES)[0]),
        ((together > 10) & np.isfinite(together)).sum(),
        np.isinf(together).sum(),
    )
    least = np.array([each.min() for each in times])
    assert scenarios.counts["total"] == tuple(np.histogram(least[least <= 10], EDGES)[0])
    assert scenarios.total() + scenarios.left_out.counts["total"] == len(da_b.scenario)
    assert ("below 1.5 s" in plain.to_text(), "below 1.5 s" in made.to_text()) == (False, True)


def test_the_verb_counts_interactions(da_b: DeepAccident) -> None:
    output = (
        CliRunner()
        .invoke(
            deepaccident,
            ["info", str(da_b.dataroot), "--statistics", "--interactions"],
            catch_exceptions=False,
        )
        .output
    )
    assert output.rstrip("\n") == dataset_statistics(da_b, interactions=True).to_text()
