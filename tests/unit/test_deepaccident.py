"""The facade's late-bound functions: fetched when they are asked for, and the same as in their
packages.
"""

import inspect
import subprocess
import sys

import pytest

from deepaccident_devkit import (
    DeepAccident,
    descriptions,
    interactions,
    maps,
    motion,
    render,
    selection,
    validation,
)

LATE = {
    name: getattr(package, name)
    for package in (descriptions, interactions, maps, motion, render, selection, validation)
    for name in package.__all__
    if hasattr(DeepAccident, name)
}


def run(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True
    ).stdout


PARTS = (
    "motion",
    "render",
    "descriptions",
    "interactions",
    "maps",
    "validation",
    "evaluation",
    "plugins",
)
HEAVY = [
    *(f"deepaccident_devkit.{name}" for name in PARTS),
    "cv2",
    "matplotlib",
    "scipy",
    "shapely",
]


@pytest.mark.parametrize(
    ("used", "imported"),
    [("find", set()), ("transform", set()), ("motion_labels", {"deepaccident_devkit.motion"})],
)
def test_what_is_asked_for_brings_its_own_package_alone(used: str, imported: set[str]) -> None:
    code = (
        f"import sys; from deepaccident_devkit import DeepAccident; "
        f"DeepAccident.{used}; print(*sys.modules)"
    )
    light = ("cv2", "scipy", "shapely") if imported else ()  # what that package itself may need
    assert {*run(code).split()} & {*HEAVY} - {*light} == imported


def test_each_is_its_packages_own_and_in_place_after_its_first_use() -> None:
    assert {"motion_labels", "findings", "render_sample", "render_replay", "describe"} < LATE.keys()
    assert {name: getattr(DeepAccident, name) for name in LATE} == LATE
    assert {name: vars(DeepAccident)[name] for name in LATE} == LATE


@pytest.mark.parametrize("name", LATE)
def test_an_instance_binds_them(name: str) -> None:
    da = object.__new__(DeepAccident)
    bound = getattr(da, name)
    assert (bound.__self__, bound.__func__) == (da, LATE[name])
    whole, shown = inspect.signature(LATE[name]), inspect.signature(bound)
    assert [*shown.parameters.values()] == [*whole.parameters.values()][1:]
    assert shown.return_annotation == whole.return_annotation
