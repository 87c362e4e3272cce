"""The interactions of a scenario are computed once and stored; a damaged file is made again."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, TokenError
from deepaccident_devkit.interactions import (
    InteractionConfig,
    Interactions,
    interactions_of,
    scenario,
)
from deepaccident_devkit.interactions.table import interaction_specs
from deepaccident_devkit.tables import clear_index
from deepaccident_devkit.testing import SmallRelease, write_small_release

SCHEMA = Path(__file__).parents[3] / "schema"


@pytest.fixture
def da(own_release: Path) -> DeepAccident:
    return DeepAccident("v1", own_release, verbose=False)


def assert_same_interactions(actual: Interactions, expected: Interactions) -> None:
    assert repr(actual) == repr(expected)
    assert actual.config == expected.config
    for table, expected_table in ((actual, expected), (actual.pairs, expected.pairs)):
        for name in type(table).__slots__:
            expected_value = getattr(expected_table, name)
            if isinstance(expected_value, np.ndarray):
                value = getattr(table, name)
                np.testing.assert_array_equal(value, expected_value, err_msg=name)
                assert value.dtype == expected_value.dtype, name
                assert not value.flags.writeable, name


@pytest.fixture
def computed_tokens(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The tokens of the scenarios that are computed while a test runs."""
    tokens: list[str] = []
    compute = scenario.computed_interactions

    def record_and_compute(
        dataset: DeepAccident, token: str, config: InteractionConfig
    ) -> Interactions:
        tokens.append(token)
        return compute(dataset, token, config)

    monkeypatch.setattr(scenario, "computed_interactions", record_and_compute)
    return tokens


def test_it_is_computed_once_and_kept(da: DeepAccident, computed_tokens: list[str]) -> None:
    record = da.scenario[0]
    first = da.interactions(record)
    assert_same_interactions(da.interactions(record["token"]), first)
    assert computed_tokens == [record["token"]]
    assert first.labelled
    assert len(first) >= len(first.pairs) > 0
    da.interactions(record, InteractionConfig(max_ttc=3))
    da.interactions(record, InteractionConfig(max_ttc=3))
    assert len(computed_tokens) == 3  # another config is not kept
    assert_same_interactions(da.interactions(record), first)


FAULTS: dict[str, Callable[[Path, bytes], object]] = {
    "cut": lambda path, content: path.write_bytes(content[:-20]),
    "changed": lambda path, content: path.write_bytes(
        content[:400] + bytes([content[400] ^ 1]) + content[401:]
    ),
    "empty": lambda path, _: path.write_bytes(b""),
    "foreign": lambda path, _: shutil.copyfile(next(path.parents[4].glob("kept/*/*")), path),
    "older": lambda path, content: path.write_bytes(content),
    "folder": lambda path, _: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_is_no_good_is_made_again(
    da: DeepAccident, computed_tokens: list[str], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = da.scenario[0]["token"]
    path = scenario.interactions_path(da, token)
    with monkeypatch.context() as patch:
        patch.setattr(scenario, "VERSION", "0" if fault == "older" else scenario.VERSION)
        first = da.interactions(token)
    FAULTS[fault](path, path.read_bytes())
    assert_same_interactions(da.interactions(token), first)
    assert_same_interactions(da.interactions(token), first)
    assert len(computed_tokens) == 2 + (fault == "folder")


def test_it_goes_with_the_tables_and_with_the_index(own_release: Path, da: DeepAccident) -> None:
    token = da.scenario[0]["token"]
    da.interactions(token)
    stored_path = scenario.interactions_path(da, token)
    meta = next(own_release.glob("*/*/meta/*.txt"))
    meta.write_text(meta.read_text().replace("four-way", "three-way"))

    reopened = DeepAccident("v1", own_release, verbose=False)
    assert reopened.tables_folder != da.tables_folder
    assert not stored_path.exists()
    # the old tables are still open
    assert_same_interactions(da.interactions(token), reopened.interactions(token))
    assert not da.tables_folder.exists()
    assert len(clear_index(own_release)) == 1
    assert not (own_release / ".deepaccident").exists()


def test_many_at_once_are_as_one_by_one(da: DeepAccident, computed_tokens: list[str]) -> None:
    tokens = [record["token"] for record in da.scenario]
    assert_raises(
        (
            lambda: next(iter(interactions_of(da, workers=0))),
            ChoiceError,
            "workers: expected a number of at least 1",
        ),
        (lambda: interactions_of(da, ["x/y"]), TokenError, "has no token 'x/y'"),
    )
    results = list(interactions_of(da))
    assert [interactions.scenario for interactions in results] == tokens == computed_tokens

    shutil.rmtree(da.tables_folder / scenario.FOLDER)
    results = list(interactions_of(da, tokens[:2], InteractionConfig(max_ttc=1)))
    assert [interactions.config.max_ttc for interactions in results] == [1, 1]
    assert not (da.tables_folder / scenario.FOLDER).exists()


def test_tables_are_as_their_schema_says(da_motion: DeepAccident) -> None:
    interactions = da_motion.interactions(da_motion.find(collision=True)[0])
    for name, table in (
        ("interaction", interactions.to_arrow()),
        ("interaction_pair", interactions.pairs.to_arrow()),
    ):
        schema = json.loads((SCHEMA / f"{name}.json").read_text(encoding="utf-8"))
        jsonschema.Draft202012Validator.check_schema(schema)
        validator = jsonschema.Draft202012Validator(schema)
        fields = [column.field for column in interaction_specs()[name].columns]
        records = table.to_pylist()
        assert len(records) > 5
        for record in records[:: max(1, len(records) // 20)]:
            validator.validate(record)
            assert list(record) == list(schema["properties"]) == fields

    first_tokens = interactions.pairs.to_arrow()["first_token"].to_pylist()
    first_ids = [da_motion.get("instance", token)["actor_id"] for token in first_tokens]
    assert first_ids == interactions.pairs.actor_ids[:, 0].tolist()


def test_the_colliding_pair_is_the_most_critical(da_motion: DeepAccident) -> None:
    accident = da_motion.find(collision=True)[0]
    interactions = da_motion.interactions(accident)
    first, second = accident["collision"]["ids"]
    row = interactions.pairs.position(second, first)
    assert row is not None
    assert interactions.pairs.position(first, first) is None
    assert row == interactions.pairs.min_ttc.argmin()
    assert interactions.pairs.min_ttc_frame[row] == accident["num_frames"]
    rows = interactions.of_pair(first, second)
    assert interactions.ttc[rows].min() == interactions.pairs.min_ttc[row]
    assert interactions.gap[rows[-1]] == pytest.approx(da_motion.collision(accident).gap, abs=1e-6)


def test_a_scenario_without_labels_has_none(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    for label in root.glob("type1_subtype1_accident/*/label"):
        shutil.rmtree(label)
    da = DeepAccident("v1", root, verbose=False)
    unlabelled_scenario = da.find(scenario_type="type1_subtype1_accident")[0]
    interactions = da.interactions(unlabelled_scenario)
    assert interactions.labelled is False
    assert len(interactions) == len(interactions.pairs) == 0
    assert interactions.to_arrow().num_rows == interactions.pairs.to_arrow().num_rows == 0
