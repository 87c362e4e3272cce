"""Names of nuScenes that do not exist here: each error names a counterpart that does, and nothing
else changes.
"""

import copy
import inspect
import json
import pickle
import re
from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest
from support.expected_errors import assert_raises

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
OWNERS_BY_WORD = {"da": DeepAccident, "box": Box, "cloud": LidarPointCloud, "render": render}
"""Owners by the first word of a counterpart."""


@pytest.fixture
def box() -> Box:
    boxes = Boxes.from_arrays([(1.0, 2.0, 3.0)], [(4.0, 2.0, 1.0)], [0.5])
    return Box(boxes, "token", "instance")


@pytest.fixture
def cloud() -> LidarPointCloud:
    return LidarPointCloud(np.ones((2, 3)), np.ones(2, dtype=np.float32))


@pytest.mark.parametrize(("kind", "names"), CLASSES)
def test_no_name_of_nuscenes_exists_here(kind: type, names: Mapping[str, str]) -> None:
    assert [name for name in names if hasattr(kind, name)] == []
    assert nuscenes_names.TABLES.keys().isdisjoint(table_specs())


@pytest.mark.parametrize(
    "names",
    [*(names for _, names in CLASSES), nuscenes_names.KEYWORDS, nuscenes_names.FIELD_HINTS],
    ids=["dataset", "box", "cloud", "keywords", "fields"],
)
def test_each_counterpart_exists_here(names: Mapping[str, str]) -> None:
    counterparts = re.findall(r"\b(da|box|cloud|render)\.(\w+)", "\n".join(names.values()))
    for word, name in counterparts:
        assert hasattr(OWNERS_BY_WORD[word], name), (word, name)


FIXTURE_NAMES = {"DeepAccident": "da", "Box": "box", "LidarPointCloud": "cloud"}


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, names in CLASSES for name in names]
)
def test_a_name_of_nuscenes_names_the_counterpart(
    request: pytest.FixtureRequest, kind: type, name: str
) -> None:
    """The error is ours and an AttributeError; the class of a cloud raises it as well, since
    nuScenes reads clouds by it.
    """
    owner = request.getfixturevalue(FIXTURE_NAMES[kind.__name__])
    hint = "(see docs/nuscenes_names.md)" if kind is DeepAccident else "use "
    message = (f"{kind.__name__} has no '{name}': ", hint)

    assert_raises((lambda: getattr(owner, name), MissingNameError, message))
    if kind is LidarPointCloud:
        assert_raises((lambda: getattr(kind, name), MissingNameError, message))
    assert not hasattr(owner, name)
    assert issubclass(MissingNameError, DeepAccidentError)


def test_other_names_fail_as_usual(da: DeepAccident) -> None:
    assert_raises(
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
    message = (f"no table '{name}'; ", f"; for nuScenes' table '{name}': ", "nuscenes_names.md")
    assert_raises((lambda: da.get(name, "x"), TableError, message))


@pytest.mark.parametrize(
    "name", ["get_sample_data", *(name for name in render.__all__ if name.startswith("render_"))]
)
def test_an_argument_of_nuscenes_names_the_counterpart(da: DeepAccident, name: str) -> None:
    method = getattr(da, name)
    parameters = inspect.signature(method).parameters
    for argument, counterpart in nuscenes_names.KEYWORDS.items():
        if argument in parameters:
            continue
        message = f"^{name} has no argument '{argument}': {re.escape(counterpart)} "
        with pytest.raises(KeywordError, match=message) as raised:
            method("x", **{argument: None})
        assert isinstance(raised.value, TypeError)


@pytest.mark.parametrize(
    ("call", "argument", "suggestion"),
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
def test_a_misspelt_argument_is_named(
    da: DeepAccident, call, argument: str, suggestion: str
) -> None:
    assert_raises((lambda: call(da), KeywordError, (f"has no argument '{argument}'", suggestion)))


@pytest.mark.parametrize("table", table_specs())
def test_a_field_of_nuscenes_names_the_counterpart(da: DeepAccident, table: str) -> None:
    record = getattr(da, table)[0]
    shared_fields = {"agent": {"first_sample_token", "last_sample_token"}}.get(table, set())
    hints = nuscenes_names.FIELD_HINTS

    assert {field for field in hints if field in record} <= shared_fields
    assert_raises(
        *(
            (
                partial(record.__getitem__, field),
                FieldError,
                (f"the record has no field '{field}': {counterpart} ",),
            )
            for field, counterpart in hints.items()
            if field not in record
        ),
        (
            lambda: record["tokn"],
            KeyError,
            ("the record has no field 'tokn'; it has token, ", "; did you mean 'token'?"),
        ),
    )
    assert record.get("data") is None


def test_records_are_dicts_and_their_copies_plain(da: DeepAccident) -> None:
    record = da.sample[0]
    assert json.loads(json.dumps(record)) == record
    assert repr(record) == repr(dict(record))
    unpickled = pickle.loads(pickle.dumps(record))
    for copied in (copy.copy(record), copy.deepcopy(record), unpickled, record.copy()):
        assert type(copied) is dict
        assert copied == record
