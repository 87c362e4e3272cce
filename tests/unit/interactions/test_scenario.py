"""The interactions of a release's scenarios: computed once, kept, made again where the file is no
good.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from refusals import assert_refused

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
def own(own_release: Path) -> DeepAccident:
    return DeepAccident("v1", own_release, verbose=False)


def assert_same(one: Interactions, other: Interactions) -> None:
    assert (repr(one), one.config) == (repr(other), other.config)
    for found, expected in ((one, other), (one.pairs, other.pairs)):
        for name in type(found).__slots__:
            value = getattr(expected, name)
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
                assert getattr(found, name).dtype == value.dtype, name
                assert not getattr(found, name).flags.writeable, name


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The scenarios that are computed while a test runs."""
    tokens: list[str] = []
    compute = scenario.computed_interactions

    def noted(dataset: DeepAccident, token: str, config: InteractionConfig) -> Interactions:
        tokens.append(token)
        return compute(dataset, token, config)

    monkeypatch.setattr(scenario, "computed_interactions", noted)
    return tokens


def test_it_is_computed_once_and_kept(own: DeepAccident, computed: list[str]) -> None:
    record = own.scenario[0]
    first = own.interactions(record)
    assert_same(own.interactions(record["token"]), first)
    assert computed == [record["token"]]
    assert first.labelled
    assert len(first) >= len(first.pairs) > 0
    own.interactions(record, InteractionConfig(max_ttc=3))
    own.interactions(record, InteractionConfig(max_ttc=3))
    assert len(computed) == 3  # another config is not kept
    assert_same(own.interactions(record), first)


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
    own: DeepAccident, computed: list[str], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = own.scenario[0]["token"]
    path = scenario.interactions_path(own, token)
    with monkeypatch.context() as patch:
        patch.setattr(scenario, "VERSION", "0" if fault == "older" else scenario.VERSION)
        first = own.interactions(token)
    FAULTS[fault](path, path.read_bytes())
    assert_same(own.interactions(token), first)
    assert_same(own.interactions(token), first)
    assert len(computed) == 2 + (fault == "folder")


def test_it_goes_with_the_tables_and_with_the_index(own_release: Path, own: DeepAccident) -> None:
    token = own.scenario[0]["token"]
    own.interactions(token)
    kept, meta = scenario.interactions_path(own, token), next(own_release.glob("*/*/meta/*.txt"))
    meta.write_text(meta.read_text().replace("four-way", "three-way"))
    again = DeepAccident("v1", own_release, verbose=False)
    assert again.tables_folder != own.tables_folder
    assert not kept.exists()
    assert_same(own.interactions(token), again.interactions(token))  # the old tables are still open
    assert not own.tables_folder.exists()
    assert len(clear_index(own_release)) == 1
    assert not (own_release / ".deepaccident").exists()


def test_many_at_once_are_as_one_by_one(own: DeepAccident, computed: list[str]) -> None:
    tokens = [each["token"] for each in own.scenario]
    assert_refused(
        (
            lambda: next(iter(interactions_of(own, workers=0))),
            ChoiceError,
            "workers: expected a number of at least 1",
        ),
        (lambda: interactions_of(own, ["x/y"]), TokenError, "has no token 'x/y'"),
    )
    assert [each.scenario for each in list(interactions_of(own))] == tokens == computed
    shutil.rmtree(own.tables_folder / scenario.FOLDER)
    assert [
        each.config.max_ttc
        for each in list(interactions_of(own, tokens[:2], InteractionConfig(max_ttc=1)))
    ] == [
        1,
        1,
    ]
    assert not (own.tables_folder / scenario.FOLDER).exists()


def test_tables_are_as_their_schema_says(da_motion: DeepAccident) -> None:
    found = da_motion.interactions(da_motion.find(collision=True)[0])
    for name, table in (
        ("interaction", found.to_arrow()),
        ("interaction_pair", found.pairs.to_arrow()),
    ):
        schema = json.loads((SCHEMA / f"{name}.json").read_text(encoding="utf-8"))
        jsonschema.Draft202012Validator.check_schema(schema)
        validator, records = jsonschema.Draft202012Validator(schema), table.to_pylist()
        assert len(records) > 5
        for record in records[:: max(1, len(records) // 20)]:
            validator.validate(record)
            assert (
                list(record)
                == list(schema["properties"])
                == [each.field for each in interaction_specs()[name].columns]
            )
    ids = [
        da_motion.get("instance", token)["actor_id"]
        for token in found.pairs.to_arrow()["first_token"].to_pylist()
    ]
    assert ids == found.pairs.actor_ids[:, 0].tolist()


def test_the_colliding_pair_is_the_most_critical(da_motion: DeepAccident) -> None:
    accident = da_motion.find(collision=True)[0]
    found = da_motion.interactions(accident)
    first, second = accident["collision"]["ids"]
    row = found.pairs.position(second, first)
    assert row is not None
    assert (found.pairs.position(first, first), row) == (None, found.pairs.min_ttc.argmin())
    assert found.pairs.min_ttc_frame[row] == accident["num_frames"]
    rows = found.of_pair(first, second)
    assert found.ttc[rows].min() == found.pairs.min_ttc[row]
    assert found.gap[rows[-1]] == pytest.approx(da_motion.collision(accident).gap, abs=1e-6)


def test_a_scenario_without_labels_has_none(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    for label in root.glob("type1_subtype1_accident/*/label"):
        shutil.rmtree(label)
    da = DeepAccident("v1", root, verbose=False)
    bare = da.find(scenario_type="type1_subtype1_accident")[0]
    found = da.interactions(bare)
    assert (found.labelled, len(found), len(found.pairs)) == (False, 0, 0)
    assert found.to_arrow().num_rows == found.pairs.to_arrow().num_rows == 0
