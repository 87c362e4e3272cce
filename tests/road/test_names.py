"""Each public name and argument of the installed nuScenes devkit is here, or an error says what to
use.
"""

import ast
import inspect
import textwrap
from collections.abc import Iterator

import pytest
from nuscenes import NuScenes, NuScenesExplorer
from nuscenes.utils.data_classes import Box as TheirBox
from nuscenes.utils.data_classes import LidarPointCloud as TheirCloud

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import Box, LidarPointCloud
from deepaccident_devkit.support import nuscenes_names

PAIRS = [
    (NuScenes, DeepAccident, nuscenes_names.DATASET),
    (NuScenesExplorer, DeepAccident, nuscenes_names.DATASET),
    (TheirBox, Box, nuscenes_names.BOX),
    (TheirCloud, LidarPointCloud, nuscenes_names.CLOUD),
]


def public_names(kind: type) -> set[str]:
    """Methods and properties, and what the methods set on `self`."""
    names = {name for name in dir(kind) if not name.startswith("_")}
    for base in kind.__mro__[:-2]:
        tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        names |= {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and ast.unparse(node.value) == "self"
        }
    return {name for name in names if not name.startswith("_")}


def own_names(kind: type) -> set[str]:
    return {name for name in {*dir(kind), *getattr(kind, "__slots__", ())} if hasattr(kind, name)}


@pytest.mark.parametrize(
    ("theirs", "ours", "hints"), PAIRS, ids=lambda each: getattr(each, "__name__", "")
)
def test_each_name_is_here_or_hinted(theirs: type, ours: type, hints: dict[str, str]) -> None:
    known = own_names(ours) | {"token", "velocity", "dataroot", "version"}  # set on the object
    assert public_names(theirs) - known - hints.keys() == set()


def shared_methods() -> Iterator[tuple[type, type, str]]:
    for theirs, ours, _ in PAIRS:
        for name in sorted(public_names(theirs) & own_names(ours)):
            if inspect.isfunction(getattr(theirs, name, None)) and callable(getattr(ours, name)):
                yield theirs, ours, name
    yield NuScenes, DeepAccident, "__init__"


@pytest.mark.parametrize(("theirs", "ours", "name"), [*shared_methods()])
def test_each_argument_is_here_or_hinted(theirs: type, ours: type, name: str) -> None:
    method = getattr(ours, name)
    wanted = inspect.signature(getattr(theirs, name)).parameters.keys() - {"self"}
    lacking = wanted - inspect.signature(method).parameters.keys()
    assert lacking <= nuscenes_names.KEYWORDS.keys()
    for argument in lacking:
        with pytest.raises(TypeError, match=f"has no argument '{argument}': .*reading.md"):
            method(None, **{argument: None})
