"""The official split procedure on hand-made scenarios, and split files of one's own."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from tiny import write_tiny_release
from written_out import written_out

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


def record(kind: str, name: str, pair=None, road=FOUR, side="left", *, meta: bool = True) -> dict:
    """What the procedure looks at of a scenario; `pair` collides, by meta's short names."""
    collision = pair and {"agents": [META_AGENTS[short] for short in pair]}
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


def twins(subtype: int, name: str, pair=DESIGNED, **where) -> list[dict]:
    return [
        record(f"subtype{subtype}_normal", name, **where),
        record(f"subtype{subtype}_accident", name, pair, **where),
    ]


def many_twins(count: int, prefix: str = "s", **options) -> list[dict]:
    return [one for index in range(count) for one in twins(1, f"{prefix}{index:03d}", **options)]


def singles(count: int, kind: str, prefix: str) -> list[dict]:
    return [record(kind, f"{prefix}{index:03d}") for index in range(count)]


def names(tokens, prefix: str) -> set[str]:
    return {token.split("/")[1] for token in tokens if token.split("/")[1].startswith(prefix)}


def test_shares_of_designed_twins_and_of_the_others() -> None:
    scenarios = (
        many_twins(10, "a")
        + many_twins(20, "b", pair=("ego", "none"))
        + singles(140, "subtype2_normal", "c")
    )
    made = split_records(scenarios)
    assert (
        len(scenarios) == 200
    )  # so 30 is the cap: 8 designed, 6 others, and what is left of 21 single ones
    for split in (made.val, made.test):
        assert ([len(names(split, prefix)) for prefix in "abc"], len(split)) == ([4, 3, 16], 30)
    assert [len(names(made.train, prefix)) for prefix in "abc"] == [2, 14, 108]


def test_the_released_loop_passes_over_the_twin_after_each_one_found() -> None:
    scenarios = many_twins(10) + singles(200, "subtype1_normal", "t")
    assert len(names(split_records(scenarios).val, "s")) == 4  # 0.4 of ten
    # five are found, 0.4 of them; the other five count as not designed, 0.15 of them rounded
    assert len(names(split_records(scenarios, released_skip=True).val, "s")) == 2 + 1
    # where every second one is not designed nothing is passed over but those
    mixed = [
        one for i in range(10) for one in twins(1, f"s{i:03d}", DESIGNED if i % 2 == 0 else None)
    ]
    mixed += singles(200, "subtype1_normal", "t")
    assert split_records(mixed, released_skip=True) == split_records(mixed)


def test_the_seed_decides_and_the_order_of_listing_does_not() -> None:
    scenarios = many_twins(12) + singles(60, "subtype1_accident", "t")
    made = split_records(scenarios)
    assert split_records(scenarios[::-1]) == split_records(scenarios[30:] + scenarios[:30]) == made
    assert split_records(scenarios, 17) == made
    assert split_records(scenarios, 18) != made


@st.composite
def scenario_sets(draw: st.DrawFn) -> list[dict]:
    shorts = st.sampled_from(list(META_AGENTS))
    found: list[dict] = []
    for index in range(draw(st.integers(0, 30))):
        subtype, which = (
            draw(st.sampled_from([1, 2])),
            draw(st.sampled_from(["both", "both", "normal", "accident"])),
        )
        options = {"road": draw(st.sampled_from([THREE, FOUR, None]))}
        options["side"] = draw(st.sampled_from(["left", "right", "opposite", None]))
        pair = draw(st.just(DESIGNED) | st.just(DESIGNED) | st.none() | st.tuples(shorts, shorts))
        both = twins(subtype, f"s{index:03d}", pair, **options)
        odd = draw(
            st.sampled_from(["no", "no", "no", "both collide", "no meta", "nobody is named"])
        )
        both[0]["collision"] = both[1]["collision"] if odd == "both collide" else None
        both[0]["weather"] = None if odd == "no meta" else "Clear"
        both[1]["collision"] = (
            pair and {"agents": None} if odd == "nobody is named" else both[1]["collision"]
        )
        found += (
            both
            if which == "both"
            else [one for one in both if one["scenario_type"].endswith(which)]
        )
    return draw(st.permutations(found))


def plain_split(scenarios: list[dict], seed: int, *, skip: bool) -> list[set[str]]:
    """Train, val, test and the minis by steps 2 to 4 of `official_split`, written again."""

    def strata(those: list[dict]) -> list[tuple[float, list[list[str]]]]:
        place = {
            (one["scenario_type"].rsplit("_", 1)[0], one["designed_accident"], one["name"]): one
            for one in those
        }
        order, pairs, alone = sorted(place), [], {}
        for subtype, is_accident, name in order:
            normal, accident = place.get((subtype, False, name)), place.get((subtype, True, name))
            if normal and accident:
                pairs += [] if is_accident else [(normal, accident)]
            else:
                one = normal or accident
                alone.setdefault((subtype, is_accident), []).append([one["token"]])
        found, after = {(designed, at): [] for designed in (True, False) for at in range(3)}, False
        for normal, accident in pairs:
            agents = accident["collision"] and accident["collision"]["agents"]
            sides = agents and {name.split("_")[0] for name in agents if "vehicle" in str(name)}
            designed = (
                bool(sides)
                and len(sides) == 2
                and not (normal["collision"] or normal["weather"] is None)
            )
            after, designed = designed and not after and skip, designed and not after
            three, opposite = accident["road_type"] == THREE, accident["spawn_side"] == "opposite"
            found[designed, 0 if three else 1 if opposite else 2].append(
                [normal["token"], accident["token"]]
            )
        return [(0.4 * designed, units) for (designed, _), units in found.items()] + [
            (0, one) for one in alone.values()
        ]

    def deal(those: list[dict], most: int, other: float, parts: int) -> list[set[str]]:
        rng, dealt = Random(seed), [set() for _ in range(parts + 1)]  # noqa: S311
        for share, stratum in strata(those):
            units = stratum.copy()
            rng.shuffle(units)
            count = round((share or other) * len(units))
            for part in range(parts):
                taken = units[
                    : min(count, (most - len(dealt[part])) // len(units[0]) if units else 0)
                ]
                dealt[part].update(token for unit in taken for token in unit)
                units = units[len(taken) :]
            dealt[parts].update(token for unit in units for token in unit)
        return dealt

    val, test, train = deal(scenarios, round(0.15 * len(scenarios)), 0.15, 2)
    minis = [
        deal([one for one in scenarios if one["token"] in split], round(0.2 * len(split)), 0.2, 1)[
            0
        ]
        for split in (train, val)
    ]
    return [train, val, test, *minis]


@settings(max_examples=150)
@given(scenario_sets(), st.integers(0, 3), st.booleans())
def test_as_the_procedure_written_again_has_it(
    scenarios: list[dict], seed: int, skip: bool
) -> None:
    made = split_records(scenarios, seed, released_skip=skip)
    assert split_records(scenarios[::-1], seed, released_skip=skip) == made
    assert [list(tokens) == sorted(set(tokens)) for tokens in made.by_name().values()] == [True] * 5
    assert list(map(set, made.by_name().values())) == plain_split(scenarios, seed, skip=skip)


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
    made, tokens = official_split(da), [scenario["token"] for scenario in da.scenario]
    assert (made.train, made.left_out) == ((tokens[1],), (tokens[0], tokens[2], tokens[3]))
    report = split_report(da, made)
    assert "five labels or fewer: 3 scenarios" in report.to_text()
    assert (report.scenarios["train"], report.frames["train"]) == (1, 6)


def test_the_report_counts_every_attribute_of_every_split(da_b: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    assert (
        "2 ( 67 %)" in split_report(da_b, {"three": tokens[:3]}).to_text()
    )  # two of three collide
    report = split_report(da_b, {"one": tokens[:1], "rest": tokens[1:], "none": []})
    assert (report.scenarios, report.frames) == (
        {"one": 1, "rest": 5, "none": 0},
        {"one": 4, "rest": 20, "none": 0},
    )
    for counts in report.attributes.values():
        for name, total in report.scenarios.items():
            assert sum(row[name] for row in counts.values()) == total
    collided = Counter("yes" if scenario["collision"] else "no" for scenario in da_b.scenario)
    assert {
        value: row["one"] + row["rest"] for value, row in report.attributes["collision"].items()
    } == collided
    assert f"yes 1 (100 %) {collided['yes'] - 1} ( 40 %) 0 ( 0 %)" in " ".join(
        report.to_text().split()
    )
    assert_refused(
        (
            lambda: split_report(da_b, {"one": ["type1_subtype1_normal/nowhere"]}),
            TokenError,
            "nowhere",
        ),
    )


def test_saved_splits_are_read_back_and_never_overwritten_unasked(
    da_b: DeepAccident, tmp_path: Path
) -> None:
    long_ones = many_twins(12) + singles(30, "subtype1_normal", "t")
    made, folder = split_records(long_ones), tmp_path / "new" / "splits"
    paths = made.save(folder)
    assert {path.name for path in folder.iterdir()} == {path.name for path in paths}
    assert {path.stem: tuple(read_split_file(path)) for path in paths} == made.by_name()
    before = (folder / "train.txt").read_bytes()
    (folder / "test.txt").unlink()
    assert_refused(
        (
            lambda: split_records(long_ones, 3).save(folder),
            ConfigError,
            r"train\.txt: is there already",
        ),
    )
    assert (folder / "train.txt").read_bytes() == before
    assert not (folder / "test.txt").exists()
    split_records(long_ones, 3).save(str(folder), overwrite=True)
    assert (folder / "train.txt").read_bytes() != before
    (tmp_path / "file").touch()
    assert_refused(
        (lambda: made.save(tmp_path / "file"), ConfigError, "file: is a file; give a folder"),
    )


def test_a_selection_saved_is_a_split(da_b: DeepAccident, tmp_path: Path) -> None:
    chosen = da_b.find(collision=True)
    path = save_selection([*chosen[::-1], chosen[0]["token"]], tmp_path / "mine.txt")
    assert read_split_file(path) == [scenario["token"] for scenario in chosen[::-1]]
    assert (
        da_b.split_scenarios(path)
        == da_b.split_scenarios(str(path))
        == {one["token"] for one in chosen}
    )
    assert_refused(
        (lambda: save_selection(chosen, path), ConfigError, "is there already"),
    )
    save_selection([], path, overwrite=True)
    assert da_b.split_scenarios(path) == set()
    assert_refused(
        (lambda: save_selection(chosen, tmp_path / "mine"), ConfigError, r"name ends in \.txt"),
        (
            lambda: save_selection(["Town03"], tmp_path / "other.txt"),
            TokenError,
            "expected a scenario's token",
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
    assert_refused(
        (
            lambda: save_selection(["type1_subtype1_normal/Town03", token], tmp_path / "mine.txt"),
            TokenError,
            r"mine\.txt: scenario .* cannot stand in a split file.*; leave it out",
        ),
    )
    made = split_records(many_twins(3))
    assert_refused(
        (
            lambda: replace(made, val=(token,)).save(tmp_path / "splits"),
            TokenError,
            r"val\.txt: scenario .* cannot stand in a split file",
        ),
    )
    assert list(tmp_path.iterdir()) == []


@given(st.text(), st.text())
def test_what_is_saved_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, scenario_type: str, name: str
) -> None:
    path, token = tmp_path_factory.getbasetemp() / "any.txt", f"{scenario_type}/{name}"
    try:
        save_selection([token], path, overwrite=True)
    except TokenError:
        return
    assert read_split_file(path) == [token]


def test_split_files_of_ones_own(da_b: DeepAccident, tmp_path: Path) -> None:
    tokens, path = [scenario["token"] for scenario in da_b.scenario], tmp_path / "mine.txt"
    lines = [token.replace("/", " ") for token in tokens]
    path.write_bytes(f"\ufeff{lines[0]}  \r\n\r\n \t{lines[1]}\r\n".encode())
    assert da_b.split_scenarios(path) == set(tokens[:2])
    path.write_text(f"{lines[0]}\n\n{lines[1]}\n{lines[0]}\n")
    assert_refused(
        (
            lambda: da_b.split_scenarios(path),
            SplitFileError,
            rf"mine\.txt:4: '{lines[0]}' stands in line 1 already",
        ),
    )
    path.write_text(
        "\n".join([lines[2], *[f"type1_subtype1_normal TownX{number}" for number in range(4)]])
    )
    message = (
        r"mine\.txt: 4 of its 5 scenarios are not in .*: "
        r"type1_subtype1_normal/TownX0, .*TownX2, …; pass missing"
    )
    assert_refused(
        (lambda: da_b.split_scenarios(path), NotAvailableError, message),
    )
    assert da_b.split_scenarios(path, missing="skip") == {tokens[2]}
    assert_refused(
        (lambda: da_b.split_scenarios(tmp_path / "absent.txt"), MissingFileError, "no such file"),
        (
            lambda: da_b.split_scenarios("train", missing="ignore"),
            ChoiceError,
            "missing: expected one of raise, skip, found 'ignore'",
        ),
    )


def test_every_default_and_constant_written_out() -> None:
    assert written_out("deepaccident_devkit.selection.splits") == {
        "splits.OFFICIAL_SEED": "17",
        "splits.Splits": "left_out=()",
        "splits.Splits.save": "overwrite=False",
        "splits.official_split": "seed=17, released_skip=False",
        "splits.split_records": "seed=17, released_skip=False, left_out=()",
        "splits.save_selection": "overwrite=False",
    }
