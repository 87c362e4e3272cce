"""Every public name and argument of the installed nuScenes devkit exists here too, or its error
names the replacement.
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
    """Collect methods, properties, and the attributes that methods set on `self`."""
    names = set(dir(kind))
    for base in kind.__mro__[:-2]:
        tree = ast.parse(textwrap.dedent(inspect.getsource(base)))
        for node in ast.walk(tree):
            if not isinstance(node, ast.Attribute):
                continue
            if isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
                names.add(node.attr)
    return {name for name in names if not name.startswith("_")}


def own_names(kind: type) -> set[str]:
    candidates = {*dir(kind), *getattr(kind, "__slots__", ())}
    return {name for name in candidates if hasattr(kind, name)}


@pytest.mark.parametrize(
    ("theirs", "ours", "hints"), PAIRS, ids=lambda value: getattr(value, "__name__", "")
)
def test_each_name_is_here_or_hinted(theirs: type, ours: type, hints: dict[str, str]) -> None:
    set_on_the_object = {"token", "velocity", "dataroot", "version"}
    unknown = public_names(theirs) - own_names(ours) - set_on_the_object
    assert unknown - hints.keys() == set()


def shared_methods() -> Iterator[tuple[type, type, str]]:
    for theirs, ours, _ in PAIRS:
        for name in sorted(public_names(theirs) & own_names(ours)):
            if inspect.isfunction(getattr(theirs, name, None)) and callable(getattr(ours, name)):
                yield theirs, ours, name
    yield NuScenes, DeepAccident, "__init__"


@pytest.mark.parametrize(("theirs", "ours", "name"), [*shared_methods()])
def test_each_argument_is_here_or_hinted(theirs: type, ours: type, name: str) -> None:
    method = getattr(ours, name)
    their_arguments = inspect.signature(getattr(theirs, name)).parameters.keys() - {"self"}
    missing = their_arguments - inspect.signature(method).parameters.keys()
    assert missing <= nuscenes_names.KEYWORDS.keys()
    for argument in missing:
        with pytest.raises(TypeError, match=f"has no argument '{argument}': .*nuscenes_names.md"):
            method(None, **{argument: None})
