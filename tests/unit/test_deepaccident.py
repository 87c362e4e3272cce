"""The facade's functions are imported on first use, and are the same as in their packages."""

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

LATE_FUNCTIONS = {
    name: getattr(package, name)
    for package in (descriptions, interactions, maps, motion, render, selection, validation)
    for name in package.__all__
    if hasattr(DeepAccident, name)
}


def run_code(code: str) -> str:
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return process.stdout


PACKAGES = (
    "motion",
    "render",
    "descriptions",
    "interactions",
    "maps",
    "validation",
    "evaluation",
    "plugins",
)
HEAVY_MODULES = [
    *(f"deepaccident_devkit.{name}" for name in PACKAGES),
    "cv2",
    "matplotlib",
    "scipy",
    "shapely",
]


@pytest.mark.parametrize(
    ("used", "imported"),
    [("find", set()), ("transform", set()), ("motion_labels", {"deepaccident_devkit.motion"})],
)
def test_a_function_imports_only_its_own_package(used: str, imported: set[str]) -> None:
    code = (
        f"import sys; from deepaccident_devkit import DeepAccident; "
        f"DeepAccident.{used}; print(*sys.modules)"
    )
    # the package itself may need these
    dependencies = {"cv2", "scipy", "shapely"} if imported else set()
    modules = set(run_code(code).split())
    assert modules & set(HEAVY_MODULES) - dependencies == imported


def test_each_is_its_packages_own_and_in_place_after_its_first_use() -> None:
    assert {
        "motion_labels",
        "findings",
        "render_sample",
        "render_replay",
        "describe",
    } < LATE_FUNCTIONS.keys()
    assert {name: getattr(DeepAccident, name) for name in LATE_FUNCTIONS} == LATE_FUNCTIONS
    assert {name: vars(DeepAccident)[name] for name in LATE_FUNCTIONS} == LATE_FUNCTIONS


@pytest.mark.parametrize("name", LATE_FUNCTIONS)
def test_an_instance_binds_them(name: str) -> None:
    da = object.__new__(DeepAccident)
    method = getattr(da, name)
    assert method.__self__ is da
    assert method.__func__ == LATE_FUNCTIONS[name]
    function_signature = inspect.signature(LATE_FUNCTIONS[name])
    method_signature = inspect.signature(method)
    parameters = list(function_signature.parameters.values())
    assert list(method_signature.parameters.values()) == parameters[1:]
    assert method_signature.return_annotation == function_signature.return_annotation
