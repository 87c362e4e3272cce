"""The official split procedure on hand-made scenarios, and split files that users write."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.default_values import package_values
from support.expected_errors import assert_raises
from support.tiny_release import write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    MissingFileError,
    NotAvailableError,
    SplitFileError,
    TokenError,
)
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.selection.splits import (
    official_split,
    save_selection,
    split_records,
    split_report,
)
from deepaccident_devkit.taxonomy import META_AGENTS

DESIGNED = ("ego", "other_behind")
THREE, FOUR = "three-way junction", "four-way junction"


def make_record(
    kind: str, name: str, pair=None, road=FOUR, side="left", *, meta: bool = True
) -> dict:
    """Make the fields of a scenario that the procedure reads.

    Args:
        pair: The agents that collide, as the short names of meta.
    """
    collision = pair and {"agents": [META_AGENTS[short_name] for short_name in pair]}
    return {
        "token": f"type1_{kind}/{name}",
        "scenario_type": f"type1_{kind}",
        "name": name,
        "designed_accident": kind.endswith("_accident"),
        "weather": "Clear" if meta else None,
        "collision": collision,
        "road_type": road,
        "spawn_side": side,
    }


def make_twins(subtype: int, name: str, pair=DESIGNED, **options) -> list[dict]:
    return [
        make_record(f"subtype{subtype}_normal", name, **options),
        make_record(f"subtype{subtype}_accident", name, pair, **options),
    ]


def make_many_twins(count: int, prefix: str = "s", **options) -> list[dict]:
    scenarios = []
    for index in range(count):
        scenarios += make_twins(1, f"{prefix}{index:03d}", **options)
    return scenarios


def make_singles(count: int, kind: str, prefix: str) -> list[dict]:
    return [make_record(kind, f"{prefix}{index:03d}") for index in range(count)]


def select_names(tokens, prefix: str) -> set[str]:
    names = {token.split("/")[1] for token in tokens}
    return {name for name in names if name.startswith(prefix)}


def test_shares_of_designed_twins_and_of_the_others() -> None:
    scenarios = (
        make_many_twins(10, "a")
        + make_many_twins(20, "b", pair=("ego", "none"))
        + make_singles(140, "subtype2_normal", "c")
    )
    # the cap is 30: 8 designed ones, 6 others, and 16 of the 21 single ones
    assert len(scenarios) == 200

    splits = split_records(scenarios)
    for tokens in (splits.val, splits.test):
        assert len(tokens) == 30
        assert [len(select_names(tokens, prefix)) for prefix in "abc"] == [4, 3, 16]
    assert [len(select_names(splits.train, prefix)) for prefix in "abc"] == [2, 14, 108]


def test_the_released_loop_passes_over_the_twin_after_each_one_found() -> None:
    scenarios = make_many_twins(10) + make_singles(200, "subtype1_normal", "t")
    assert len(select_names(split_records(scenarios).val, "s")) == 4  # 0.4 of ten
    # five are found, 0.4 of them; the other five count as not designed, 0.15 of them rounded
    assert len(select_names(split_records(scenarios, released_skip=True).val, "s")) == 2 + 1
    # if every second pair is not designed, only these are passed over
    mixed = make_singles(200, "subtype1_normal", "t")
    for index in range(10):
        mixed += make_twins(1, f"s{index:03d}", DESIGNED if index % 2 == 0 else None)
    assert split_records(mixed, released_skip=True) == split_records(mixed)


def test_the_seed_decides_and_the_order_of_listing_does_not() -> None:
    scenarios = make_many_twins(12) + make_singles(60, "subtype1_accident", "t")
    splits = split_records(scenarios)
    assert split_records(scenarios[::-1]) == splits
    assert split_records(scenarios[30:] + scenarios[:30]) == splits
    assert split_records(scenarios, 17) == splits
    assert split_records(scenarios, 18) != splits


@st.composite
def scenario_sets(draw: st.DrawFn) -> list[dict]:
    short_names = st.sampled_from(list(META_AGENTS))
    scenarios: list[dict] = []
    for index in range(draw(st.integers(0, 30))):
        subtype = draw(st.sampled_from([1, 2]))
        kind = draw(st.sampled_from(["both", "both", "normal", "accident"]))
        road = draw(st.sampled_from([THREE, FOUR, None]))
        side = draw(st.sampled_from(["left", "right", "opposite", None]))
        pair = draw(
            st.just(DESIGNED) | st.just(DESIGNED) | st.none() | st.tuples(short_names, short_names)
        )
        fault = draw(
            st.sampled_from(["no", "no", "no", "both collide", "no meta", "nobody is named"])
        )

        normal, accident = make_twins(subtype, f"s{index:03d}", pair, road=road, side=side)
        if fault == "both collide":
            normal["collision"] = accident["collision"]
        elif fault == "no meta":
            normal["weather"] = None
        elif fault == "nobody is named":
            accident["collision"] = pair and {"agents": None}
        if kind != "accident":
            scenarios.append(normal)
        if kind != "normal":
            scenarios.append(accident)
    return draw(st.permutations(scenarios))


def group_into_strata(scenarios: list[dict], *, skip: bool) -> list[tuple[float, list[list[str]]]]:
    """Return each stratum's share (0 if it is not designed) and its units, lists of tokens."""
    scenarios_by_key = {
        (
            scenario["scenario_type"].rsplit("_", 1)[0],
            scenario["designed_accident"],
            scenario["name"],
        ): scenario
        for scenario in scenarios
    }
    pairs = []
    single_strata = {}
    for subtype, is_accident, name in sorted(scenarios_by_key):
        normal = scenarios_by_key.get((subtype, False, name))
        accident = scenarios_by_key.get((subtype, True, name))
        if normal and accident:
            if not is_accident:
                pairs.append((normal, accident))
        else:
            token = (normal or accident)["token"]
            single_strata.setdefault((subtype, is_accident), []).append([token])

    pair_strata = {(designed, road): [] for designed in (True, False) for road in range(3)}
    is_passed_over = False
    for normal, accident in pairs:
        agents = (accident["collision"] or {"agents": ()})["agents"] or ()
        sides = {name.split("_")[0] for name in agents if "vehicle" in str(name)}
        is_without_accident = not normal["collision"] and normal["weather"] is not None
        is_designed = len(sides) == 2 and is_without_accident and not is_passed_over
        is_passed_over = is_designed and skip
        if accident["road_type"] == THREE:
            road = 0
        else:
            road = 1 if accident["spawn_side"] == "opposite" else 2
        pair_strata[is_designed, road].append([normal["token"], accident["token"]])
    strata = [(0.4 * is_designed, units) for (is_designed, _), units in pair_strata.items()]
    return strata + [(0, units) for units in single_strata.values()]


def plain_split(scenarios: list[dict], seed: int, *, skip: bool) -> list[set[str]]:
    """Split as steps 2 to 4 of `official_split` say: train, val, test and the two minis."""

    def deal(scenarios: list[dict], other_share: float, num_parts: int) -> list[set[str]]:
        max_scenarios = round(other_share * len(scenarios))
        rng = Random(seed)  # noqa: S311
        parts = [set() for _ in range(num_parts)]
        remainder = set()
        for share, stratum in group_into_strata(scenarios, skip=skip):
            units = stratum.copy()
            rng.shuffle(units)
            count = round((share or other_share) * len(units))
            for part in parts:
                room = (max_scenarios - len(part)) // len(units[0]) if units else 0
                taken_units = units[: min(count, room)]
                part.update(*taken_units)
                units = units[len(taken_units) :]
            remainder.update(*units)
        return [*parts, remainder]

    val, test, train = deal(scenarios, 0.15, 2)
    minis = []
    for tokens in (train, val):
        split_scenarios = [scenario for scenario in scenarios if scenario["token"] in tokens]
        minis.append(deal(split_scenarios, 0.2, 1)[0])
    return [train, val, test, *minis]


@settings(max_examples=150)
@given(scenario_sets(), st.integers(0, 3), st.booleans())
def test_as_the_procedure_written_again_has_it(
    scenarios: list[dict], seed: int, skip: bool
) -> None:
    splits = split_records(scenarios, seed, released_skip=skip)
    assert split_records(scenarios[::-1], seed, released_skip=skip) == splits
    split_tokens = list(splits.by_name().values())
    for tokens in split_tokens:
        assert list(tokens) == sorted(set(tokens))
    assert list(map(set, split_tokens)) == plain_split(scenarios, seed, skip=skip)


# on releases


def test_only_scenarios_with_more_than_five_labels_of_ego_count(tmp_path: Path) -> None:
    base = "Town03_type001_subtype0001_scenario000"
    for number, frames in ((1, 5), (2, 6)):
        write_tiny_release(
            tmp_path, frames=frames, name=f"{base}{number:02d}", agents=("ego_vehicle",)
        )
    write_tiny_release(
        tmp_path, frames=7, name=f"{base}03", agents=("ego_vehicle",), labelled=False
    )
    write_tiny_release(tmp_path, frames=7, name=f"{base}04", agents=("other_vehicle",))
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    splits = official_split(da)
    tokens = [scenario["token"] for scenario in da.scenario]
    assert splits.train == (tokens[1],)
    assert splits.left_out == (tokens[0], tokens[2], tokens[3])

    report = split_report(da, splits)
    assert "excluded: 3 scenarios, as ego_vehicle has five labels or fewer" in report.to_text()
    assert report.scenarios["train"] == 1
    assert report.frames["train"] == 6


def test_the_report_counts_every_attribute_of_every_split(da_b: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    three_report = split_report(da_b, {"three": tokens[:3]})
    assert "2 ( 67 %)" in three_report.to_text()  # two of three collide

    report = split_report(da_b, {"one": tokens[:1], "rest": tokens[1:], "none": []})
    assert report.scenarios == {"one": 1, "rest": 5, "none": 0}
    assert report.frames == {"one": 4, "rest": 20, "none": 0}
    for counts in report.attributes.values():
        for name, total in report.scenarios.items():
            assert sum(row[name] for row in counts.values()) == total

    outcomes = ["yes" if scenario["collision"] else "no" for scenario in da_b.scenario]
    collision_counts = Counter(outcomes)
    rows = report.attributes["collision"]
    assert {value: row["one"] + row["rest"] for value, row in rows.items()} == collision_counts
    text = " ".join(report.to_text().split())
    assert f"yes 1 (100 %) {collision_counts['yes'] - 1} ( 40 %) 0 ( 0 %)" in text
    assert_raises(
        (
            lambda: split_report(da_b, {"one": ["type1_subtype1_normal/nowhere"]}),
            TokenError,
            "nowhere",
        ),
    )


def test_saved_splits_are_read_back_and_never_overwritten_unasked(
    da_b: DeepAccident, tmp_path: Path
) -> None:
    scenarios = make_many_twins(12) + make_singles(30, "subtype1_normal", "t")
    splits = split_records(scenarios)
    folder = tmp_path / "new" / "splits"
    paths = splits.save(folder)
    assert {path.name for path in folder.iterdir()} == {path.name for path in paths}
    assert {path.stem: tuple(read_split_file(path)) for path in paths} == splits.by_name()

    before = (folder / "train.txt").read_bytes()
    (folder / "test.txt").unlink()
    assert_raises(
        (
            lambda: split_records(scenarios, 3).save(folder),
            ConfigError,
            r"train\.txt: already exists",
        ),
    )
    assert (folder / "train.txt").read_bytes() == before
    assert not (folder / "test.txt").exists()
    split_records(scenarios, 3).save(str(folder), overwrite=True)
    assert (folder / "train.txt").read_bytes() != before
    (tmp_path / "file").touch()
    assert_raises(
        (lambda: splits.save(tmp_path / "file"), ConfigError, "file: is a file; give a folder"),
    )


def test_a_selection_saved_is_a_split(da_b: DeepAccident, tmp_path: Path) -> None:
    scenarios = da_b.find(collision=True)
    path = save_selection([*scenarios[::-1], scenarios[0]["token"]], tmp_path / "mine.txt")
    assert read_split_file(path) == [scenario["token"] for scenario in scenarios[::-1]]
    tokens = {scenario["token"] for scenario in scenarios}
    assert da_b.split_scenarios(path) == tokens
    assert da_b.split_scenarios(str(path)) == tokens
    assert_raises(
        (lambda: save_selection(scenarios, path), ConfigError, "already exists"),
    )
    save_selection([], path, overwrite=True)
    assert da_b.split_scenarios(path) == set()
    assert_raises(
        (lambda: save_selection(scenarios, tmp_path / "mine"), ConfigError, r"name ends in \.txt"),
        (
            lambda: save_selection(["Town03"], tmp_path / "other.txt"),
            TokenError,
            "expected the token or the record of a scenario",
        ),
    )


@pytest.mark.parametrize(
    "token",
    [
        "a b/c",
        "a/b c",
        "a/b\n",
        "a/b\u2028c",
        "a/\xa0b",
        "a/",
        "/b",
        " a/b",
        "\ufeffa/b",
        "a/\udcff",
        "a/b\0",
    ],
)
def test_a_name_that_would_not_be_read_back_is_refused(tmp_path: Path, token: str) -> None:
    assert_raises(
        (
            lambda: save_selection(["type1_subtype1_normal/Town03", token], tmp_path / "mine.txt"),
            TokenError,
            r"mine\.txt: scenario .* cannot be in a split file.*; exclude it",
        ),
    )
    splits = split_records(make_many_twins(3))
    assert_raises(
        (
            lambda: replace(splits, val=(token,)).save(tmp_path / "splits"),
            TokenError,
            r"val\.txt: scenario .* cannot be in a split file",
        ),
    )
    assert list(tmp_path.iterdir()) == []


@given(st.text(), st.text())
def test_what_is_saved_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, scenario_type: str, name: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.txt"
    token = f"{scenario_type}/{name}"
    try:
        save_selection([token], path, overwrite=True)
    except TokenError:
        return
    assert read_split_file(path) == [token]


def test_split_files_of_ones_own(da_b: DeepAccident, tmp_path: Path) -> None:
    path = tmp_path / "mine.txt"
    tokens = [scenario["token"] for scenario in da_b.scenario]
    lines = [token.replace("/", " ") for token in tokens]
    path.write_bytes(f"\ufeff{lines[0]}  \r\n\r\n \t{lines[1]}\r\n".encode())
    assert da_b.split_scenarios(path) == set(tokens[:2])
    path.write_text(f"{lines[0]}\n\n{lines[1]}\n{lines[0]}\n")
    assert_raises(
        (
            lambda: da_b.split_scenarios(path),
            SplitFileError,
            rf"mine\.txt:4: '{lines[0]}' is already in line 1",
        ),
    )

    unknown_lines = [f"type1_subtype1_normal TownX{number}" for number in range(4)]
    path.write_text("\n".join([lines[2], *unknown_lines]))
    message = (
        r"mine\.txt: 4 of its 5 scenarios are not in .*: "
        r"type1_subtype1_normal/TownX0, .*TownX2, …; pass missing"
    )
    assert_raises(
        (lambda: da_b.split_scenarios(path), NotAvailableError, message),
    )
    assert da_b.split_scenarios(path, missing="skip") == {tokens[2]}
    assert_raises(
        (lambda: da_b.split_scenarios(tmp_path / "absent.txt"), MissingFileError, "no such file"),
        (
            lambda: da_b.split_scenarios("train", missing="ignore"),
            ChoiceError,
            "missing: expected one of raise, skip, found 'ignore'",
        ),
    )


def test_every_default_and_constant_written_out() -> None:
    assert package_values("deepaccident_devkit.selection.splits") == {
        "splits.OFFICIAL_SEED": "17",
        "splits.Splits": "left_out=()",
        "splits.Splits.save": "overwrite=False",
        "splits.official_split": "seed=17, released_skip=False",
        "splits.split_records": "seed=17, released_skip=False, left_out=()",
        "splits.save_selection": "overwrite=False",
    }
