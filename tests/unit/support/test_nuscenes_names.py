"""nuScenes' names that are not here: each error names a counterpart that is, and nothing else
changes.
"""

import copy
import inspect
import json
import pickle
import re
from collections.abc import Mapping

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident, DeepAccidentError, render
from deepaccident_devkit.errors import FieldError, KeywordError, MissingNameError, TableError
from deepaccident_devkit.geometry import Box, Boxes, LidarPointCloud
from deepaccident_devkit.support import nuscenes_names
from deepaccident_devkit.tables.records import table_specs

CLASSES: list[tuple[type, Mapping[str, str]]] = [
    (DeepAccident, nuscenes_names.DATASET),
    (Box, nuscenes_names.BOX),
    (LidarPointCloud, nuscenes_names.CLOUD),
]
NAMED = {"da": DeepAccident, "box": Box, "cloud": LidarPointCloud, "render": render}
"""What the first words of counterparts stand for."""


@pytest.fixture
def box() -> Box:
    return Box(Boxes.from_arrays([(1.0, 2.0, 3.0)], [(4.0, 2.0, 1.0)], [0.5]), "token", "instance")


@pytest.fixture
def cloud() -> LidarPointCloud:
    return LidarPointCloud(np.ones((2, 3)), np.ones(2, dtype=np.float32))


@pytest.mark.parametrize(("kind", "names"), CLASSES)
def test_none_of_the_names_is_here(kind: type, names: Mapping[str, str]) -> None:
    assert [name for name in names if hasattr(kind, name)] == []
    assert nuscenes_names.TABLES.keys().isdisjoint(table_specs())


@pytest.mark.parametrize(
    "names",
    [*(names for _, names in CLASSES), nuscenes_names.KEYWORDS, nuscenes_names.FIELD_HINTS],
    ids=["dataset", "box", "cloud", "keywords", "fields"],
)
def test_each_counterpart_is_here(names: Mapping[str, str]) -> None:
    found = re.findall(r"\b(da|box|cloud|render)\.(\w+)", "\n".join(names.values()))
    assert [(owner, name) for owner, name in found if not hasattr(NAMED[owner], name)] == []


OWNERS = {"DeepAccident": "da", "Box": "box", "LidarPointCloud": "cloud"}


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, names in CLASSES for name in names]
)
def test_a_name_of_nuscenes_names_the_counterpart(
    request: pytest.FixtureRequest, kind: type, name: str
) -> None:
    """Ours, and an attribute error; of a cloud's class too, from which one is read."""
    owner = request.getfixturevalue(OWNERS[kind.__name__])
    named = (
        f"{kind.__name__} has no '{name}': ",
        "use " if kind is not DeepAccident else "(see docs/reading.md)",
    )
    assert_refused((lambda: getattr(owner, name), MissingNameError, named))
    if kind is LidarPointCloud:
        assert_refused((lambda: getattr(kind, name), MissingNameError, named))
    assert (hasattr(owner, name), issubclass(MissingNameError, DeepAccidentError)) == (False, True)


def test_other_names_fail_as_ever(da: DeepAccident) -> None:
    assert_refused(
        (lambda: da.samplex, AttributeError, r"^'DeepAccident' object has no attribute 'samplex'$"),
        # the error of the property itself
        (
            lambda: object.__new__(DeepAccident).scenario,
            AttributeError,
            r"^'DeepAccident' .* attribute '_tables'$",
        ),
        (lambda: da.get("sampel", "x"), TableError, r"category; did you mean 'sample'\?$"),
    )
    assert copy.copy(da).sample[0] == da.sample[0]


@pytest.mark.parametrize("name", nuscenes_names.TABLES)
def test_an_unknown_table_of_nuscenes_names_the_counterpart(da: DeepAccident, name: str) -> None:
    named = (f"no table '{name}'; ", f"; of nuScenes' table '{name}': ", "reading.md")
    assert_refused((lambda: da.get(name, "x"), TableError, named))


@pytest.mark.parametrize(
    "name", ["get_sample_data", *(each for each in render.__all__ if each.startswith("render_"))]
)
def test_an_argument_of_nuscenes_names_the_counterpart(da: DeepAccident, name: str) -> None:
    method = getattr(da, name)
    own = inspect.signature(method).parameters
    for argument, counterpart in nuscenes_names.KEYWORDS.items():
        if argument in own:
            continue
        sentence = f"^{name} has no argument '{argument}': {re.escape(counterpart)} "
        with pytest.raises(KeywordError, match=sentence) as raised:
            method("x", **{argument: None})
        assert isinstance(raised.value, TypeError)


@pytest.mark.parametrize(
    ("call", "argument", "meant"),
    [
        (lambda _: DeepAccident(root="x"), "root", "did you mean 'dataroot'?"),
        (lambda _: DeepAccident(map_resolution=0.1), "map_resolution", "da.town_map"),
        (lambda da: da.get(table_name="sample"), "table_name", "first argument"),
        (lambda da: da.get_boxes(sample_data_token=None), "sample_data_token", "first argument"),
        (lambda da: da.render_bev(da.sample[0], axis=None), "axis", "did you mean 'ax'?"),
        (
            lambda da: da.get_boxes(da.sample[0])[0].corners(wlh_factor=2),
            "wlh_factor",
            "Box.from_wlh",
        ),
    ],
)
def test_a_misspelt_argument_is_named(da: DeepAccident, call, argument: str, meant: str) -> None:
    assert_refused((lambda: call(da), KeywordError, (f"has no argument '{argument}'", meant)))


@pytest.mark.parametrize("table", table_specs())
def test_a_field_of_nuscenes_names_the_counterpart(da: DeepAccident, table: str) -> None:
    record = getattr(da, table)[0]
    ours = {"agent": {"first_sample_token", "last_sample_token"}}.get(table, set())
    assert {field for field in nuscenes_names.FIELD_HINTS if field in record} <= ours
    no = "the record has no field '{}'"
    assert_refused(
        *(
            (
                lambda field=field: record[field],
                FieldError,
                (f"{no.format(field)}: {counterpart} ",),
            )
            for field, counterpart in nuscenes_names.FIELD_HINTS.items()
            if field not in record
        ),
        (
            lambda: record["tokn"],
            KeyError,
            (f"{no.format('tokn')}; it has token, ", "; did you mean 'token'?"),
        ),
    )
    assert record.get("data") is None


def test_records_are_dicts_and_their_copies_plain(da: DeepAccident) -> None:
    record = da.sample[0]
    assert (json.loads(json.dumps(record)), repr(record)) == (record, repr(dict(record)))
    for copied in (
        copy.copy(record),
        copy.deepcopy(record),
        pickle.loads(pickle.dumps(record)),
        record.copy(),
    ):
        assert (type(copied), copied) == (dict, record)
