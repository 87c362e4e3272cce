"""The official split procedure on hand-made scenarios, and split files of one's own."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused
from tiny import write_tiny_release

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
from deepaccident_devkit.splits import official_split, save_selection, split_records, split_report
from deepaccident_devkit.taxonomy import META_AGENTS, SCENARIO_ATTRIBUTES

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
    scenarios = many_twins(10, "a") + many_twins(20, "b", pair=("ego", "none")) + singles(140, "subtype2_normal", "c")
    made = split_records(scenarios)
    assert len(scenarios) == 200  # so 30 is the cap: 8 designed, 6 others, and what is left of 21 single ones
    for split in (made.val, made.test):
        assert ([len(names(split, prefix)) for prefix in "abc"], len(split)) == ([4, 3, 16], 30)
    assert [len(names(made.train, prefix)) for prefix in "abc"] == [2, 14, 108]


def test_shares_are_rounded_to_the_nearest_count() -> None:
    made = split_records(singles(12, "subtype1_normal", "t"))  # 0.15 of 12 are 1.8, a fifth of 8 are 1.6, of 2 are 0.4
    assert [len(tokens) for tokens in (made.train, made.val, made.test)] == [8, 2, 2]
    assert [len(tokens) for tokens in (made.train_mini, made.val_mini)] == [2, 0]


@pytest.mark.parametrize(
    ("pair", "designed"),
    [
        (("ego", "other"), True),
        (("other_behind", "ego_behind"), True),
        (("ego", "ego_behind"), False),
        (("other", "other_behind"), False),
        (("ego", "none"), False),
        (None, False),
    ],
)
def test_which_pairs_are_designed(pair, designed: bool) -> None:
    made = split_records(many_twins(10, pair=pair) + singles(100, "subtype1_normal", "t"))
    assert len(names(made.val, "s")) == (4 if designed else 2)  # 0.4 of ten, else 0.15


def test_a_normal_twin_with_a_collision_or_without_meta_is_not_designed() -> None:
    filling = singles(100, "subtype1_normal", "t")
    for odd in ({"pair": DESIGNED}, {"meta": False}):
        scenarios = [
            one
            for index in range(10)
            for one in (
                record("subtype1_normal", f"s{index}", **odd),
                record("subtype1_accident", f"s{index}", DESIGNED),
            )
        ]
        assert len(names(split_records(scenarios + filling).val, "s")) == 2


def test_meta_that_does_not_say_who_collided_is_not_designed() -> None:
    scenarios = many_twins(10) + singles(100, "subtype1_normal", "t")
    for one in scenarios:
        if one["collision"]:
            one["collision"]["agents"] = None
    assert len(names(split_records(scenarios).val, "s")) == 2


def test_a_pair_takes_two_places_and_is_cut_off_where_val_or_test_is_full() -> None:
    made = split_records(many_twins(10))  # 0.4 of ten were four pairs, but three places hold one
    assert [len(tokens) for tokens in (made.val, made.test, made.train)] == [2, 2, 16]
    assert [len(names(tokens, "s")) for tokens in (made.val, made.test, made.train)] == [1, 1, 8]


def test_every_stratum_gives_its_own_share() -> None:
    scenarios = (
        many_twins(5, "three", road=THREE, side="opposite")
        + many_twins(5, "opposite", side="opposite")
        + many_twins(5, "left", side="left")
        + many_twins(5, "unsaid", road=None, side=None)  # with the left and right ones
        + singles(200, "subtype1_normal", "t")
    )
    for seed in range(5):
        made = split_records(scenarios, seed)
        for split in (made.val, made.test):
            assert len(names(split, "three")) == len(names(split, "opposite")) == 2
            assert len(names(split, "left")) + len(names(split, "unsaid")) == 4


def test_strata_of_twins_span_subtypes() -> None:
    scenarios = [one for index in range(8) for one in twins(1 + index % 2, f"s{index}")]
    made = split_records(scenarios + singles(100, "subtype1_normal", "t"))
    assert len(names(made.val, "s")) == 3  # round(0.4 · 8); for each subtype alone it were 2 · round(0.4 · 4) = 4


def test_single_scenarios_are_dealt_by_subtype_normal_and_accident_apart() -> None:
    kinds = ("subtype1_normal", "subtype1_accident", "subtype2_normal", "subtype2_accident")
    made = split_records([one for kind in kinds for one in singles(20, kind, kind)])
    for split in (made.val, made.test):
        assert Counter(token.split("/")[0] for token in split) == {f"type1_{kind}": 3 for kind in kinds}


def test_same_names_in_two_subtypes_are_no_twins() -> None:
    scenarios = [record("subtype1_normal", "s"), record("subtype2_accident", "s", DESIGNED)]
    scenarios += singles(20, "subtype1_normal", "t")
    apart = {
        sum(one["token"] in split_records(scenarios, seed).val for one in scenarios[:2]) == 1 for seed in range(30)
    }
    assert True in apart  # in some split they part, which twins never do


def test_the_released_loop_passes_over_the_twin_after_each_one_found() -> None:
    scenarios = many_twins(10) + singles(200, "subtype1_normal", "t")
    assert len(names(split_records(scenarios).val, "s")) == 4  # 0.4 of ten
    # five are found, 0.4 of them; the other five count as not designed, 0.15 of them rounded
    assert len(names(split_records(scenarios, released_skip=True).val, "s")) == 2 + 1
    # where every second one is not designed nothing is passed over but those
    mixed = [one for i in range(10) for one in twins(1, f"s{i:03d}", DESIGNED if i % 2 == 0 else None)]
    mixed += singles(200, "subtype1_normal", "t")
    assert split_records(mixed, released_skip=True) == split_records(mixed)


def test_minis_are_a_fifth_at_most_and_prefer_designed_twins() -> None:
    made = split_records(many_twins(20) + singles(160, "subtype1_normal", "t"))
    for mini, whole in ((made.train_mini, made.train), (made.val_mini, made.val)):
        assert set(mini) < set(whole)
        assert 0 < len(mini) <= round(0.2 * len(whole))
    assert len(made.val) == 30
    assert [len(names(made.val_mini, prefix)) for prefix in "st"] == [3, 0]  # 0.4 of eight designed twins fill it
    assert len(names(made.train, "s")) == 4
    assert [len(names(made.train_mini, prefix)) for prefix in "st"] == [2, 28 - 4]  # 28 is a fifth of train


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
        subtype, which = draw(st.sampled_from([1, 2])), draw(st.sampled_from(["both", "both", "normal", "accident"]))
        options = {"road": draw(st.sampled_from([THREE, FOUR, None]))}
        options["side"] = draw(st.sampled_from(["left", "right", "opposite", None]))
        pair = draw(st.just(DESIGNED) | st.just(DESIGNED) | st.none() | st.tuples(shorts, shorts))
        both = twins(subtype, f"s{index:03d}", pair, **options)
        found += both if which == "both" else [one for one in both if one["scenario_type"].endswith(which)]
    return draw(st.permutations(found))


@given(scenario_sets(), st.integers(0, 3), st.booleans())
def test_twins_together_disjoint_nothing_lost_caps_kept(scenarios: list[dict], seed: int, skip: bool) -> None:
    made = split_records(scenarios, seed, released_skip=skip)
    everything = [*made.train, *made.val, *made.test]
    assert sorted(everything) == sorted(one["token"] for one in scenarios)
    assert max(len(made.val), len(made.test)) <= round(0.15 * len(scenarios))
    family = {token: (token.split("_")[1], token.split("/")[1]) for token in everything}
    for tokens in made.by_name().values():
        assert list(tokens) == sorted(set(tokens))
    for first, second in ((made.train, made.val), (made.train, made.test), (made.val, made.test)):
        assert not {family[token] for token in first} & {family[token] for token in second}
    for mini, whole in ((made.train_mini, made.train), (made.val_mini, made.val)):
        assert set(mini) <= set(whole)
        assert len(mini) <= round(0.2 * len(whole))
        assert not {family[token] for token in mini} & {family[token] for token in (set(whole) - set(mini))}
    assert split_records(scenarios[::-1], seed, released_skip=skip) == made


# on releases


def test_only_scenarios_with_more_than_five_labels_of_ego_count(tmp_path: Path) -> None:
    base = "Town03_type001_subtype0001_scenario000"
    for number, frames in ((1, 5), (2, 6)):
        write_tiny_release(tmp_path, frames=frames, name=f"{base}{number:02d}", agents=("ego_vehicle",))
    write_tiny_release(tmp_path, frames=7, name=f"{base}03", agents=("ego_vehicle",), labelled=False)
    write_tiny_release(tmp_path, frames=7, name=f"{base}04", agents=("other_vehicle",))
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    made = official_split(da)
    tokens = [scenario["token"] for scenario in da.scenario]
    assert (made.train, made.left_out) == ((tokens[1],), (tokens[0], tokens[2], tokens[3]))
    report = split_report(da, made)
    assert "five labels or fewer: 3 scenarios" in report.to_text()
    assert (report.scenarios["train"], report.frames["train"]) == (1, 6)


def test_the_report_has_numbers_by_size_and_what_is_unknown_last() -> None:
    unknown = dict.fromkeys((*SCENARIO_ATTRIBUTES, "collision"))
    scenarios = {str(number): {**unknown, "num_frames": 1, "accident_type": number} for number in (12, None, 9)}
    report = split_report(SimpleNamespace(scenario=scenarios, dataroot=".", version="v1"), {"all": scenarios})
    assert list(report.attributes["accident_type"]) == ["9", "12", "none"]


def test_the_report_counts_every_attribute_of_every_split(da_b: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    assert "2 ( 67 %)" in split_report(da_b, {"three": tokens[:3]}).to_text()  # two of three collide
    report = split_report(da_b, {"one": tokens[:1], "rest": tokens[1:], "none": []})
    assert (report.scenarios, report.frames) == ({"one": 1, "rest": 5, "none": 0}, {"one": 4, "rest": 20, "none": 0})
    for counts in report.attributes.values():
        for name, total in report.scenarios.items():
            assert sum(row[name] for row in counts.values()) == total
    collided = Counter("yes" if scenario["collision"] else "no" for scenario in da_b.scenario)
    assert {value: row["one"] + row["rest"] for value, row in report.attributes["collision"].items()} == collided
    squeezed = " ".join(report.to_text().split())
    assert "split one rest none scenarios 1 5 0 frames 4 20 0" in squeezed
    assert f"yes 1 (100 %) {collided['yes'] - 1} ( 40 %) 0 ( 0 %)" in squeezed
    assert_refused(
        (lambda: split_report(da_b, {"one": ["type1_subtype1_normal/nowhere"]}), TokenError, "nowhere"),
    )


def test_saved_splits_are_read_back_and_never_overwritten_unasked(da_b: DeepAccident, tmp_path: Path) -> None:
    long_ones = many_twins(12) + singles(30, "subtype1_normal", "t")
    made, folder = split_records(long_ones), tmp_path / "new" / "splits"
    paths = made.save(folder)
    assert {path.name for path in folder.iterdir()} == {path.name for path in paths}
    assert {path.stem: tuple(read_split_file(path)) for path in paths} == made.by_name()
    before = (folder / "train.txt").read_bytes()
    (folder / "test.txt").unlink()
    assert_refused(
        (lambda: split_records(long_ones, 3).save(folder), ConfigError, r"train\.txt: is there already"),
    )
    assert (folder / "train.txt").read_bytes() == before
    assert not (folder / "test.txt").exists()
    split_records(long_ones, 3).save(str(folder), overwrite=True)
    assert (folder / "train.txt").read_bytes() != before
    (tmp_path / "file").touch()
    assert_refused(
        (lambda: made.save(tmp_path / "file"), ConfigError, "file: is a file; give a folder"),
    )


def test_splits_that_cannot_be_written_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(path: Path, tokens) -> None:
        if "test.txt" in path.name:
            raise OSError("disk full")
        path.write_text("half")

    monkeypatch.setattr("deepaccident_devkit.splits.write_split_file", failing)
    assert_refused(
        (lambda: split_records(many_twins(3)).save(tmp_path), OSError, "disk full"),
    )
    assert list(tmp_path.iterdir()) == []


def test_a_selection_saved_is_a_split(da_b: DeepAccident, tmp_path: Path) -> None:
    chosen = da_b.find(collision=True)
    path = save_selection([*chosen[::-1], chosen[0]["token"]], tmp_path / "mine.txt")
    assert read_split_file(path) == [scenario["token"] for scenario in chosen[::-1]]
    assert da_b.split_scenarios(path) == da_b.split_scenarios(str(path)) == {one["token"] for one in chosen}
    assert_refused(
        (lambda: save_selection(chosen, path), ConfigError, "is there already"),
    )
    save_selection([], path, overwrite=True)
    assert da_b.split_scenarios(path) == set()
    assert_refused(
        (lambda: save_selection(chosen, tmp_path / "mine"), ConfigError, r"name ends in \.txt"),
        (lambda: save_selection(["Town03"], tmp_path / "other.txt"), TokenError, "expected a scenario's token"),
    )


@pytest.mark.parametrize(
    "token", ["a b/c", "a/b c", "a/b\n", "a/b\u2028c", "a/\xa0b", "a/", "/b", " a/b", "\ufeffa/b", "a/\udcff", "a/b\0"]
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
def test_what_is_saved_is_read_back(tmp_path_factory: pytest.TempPathFactory, scenario_type: str, name: str) -> None:
    path, token = tmp_path_factory.getbasetemp() / "any.txt", f"{scenario_type}/{name}"
    try:
        save_selection([token], path, overwrite=True)
    except TokenError:
        return
    assert read_split_file(path) == [token]


def test_split_files_of_ones_own(da_b: DeepAccident, tmp_path: Path) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    path = tmp_path / "mine.txt"
    lines = [token.replace("/", " ") for token in tokens]
    path.write_bytes(f"\ufeff{lines[0]}  \r\n\r\n \t{lines[1]}\r\n".encode())
    assert da_b.split_scenarios(path) == set(tokens[:2])
    path.write_text(f"{lines[0]}\n\n{lines[1]}\n{lines[0]}\n")
    assert_refused(
        (lambda: da_b.split_scenarios(path), SplitFileError, rf"mine\.txt:4: '{lines[0]}' stands in line 1 already"),
    )
    path.write_text("\n".join([lines[2], *[f"type1_subtype1_normal TownX{number}" for number in range(4)]]))
    message = r"mine\.txt: 4 of its 5 scenarios are not in .*: type1_subtype1_normal/TownX0, .*TownX2, …; pass missing"
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
    assert da_b.split_scenarios("train") == da_b.split_scenarios(da_b.dataroot / "train.txt")
