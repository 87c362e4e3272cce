"""The facade's late-bound functions: fetched when they are asked for, and the same as in their packages."""

import inspect
import subprocess
import sys
from typing import Any

from deepaccident_devkit import DeepAccident, maps, motion, render, safety, validation
from deepaccident_devkit.deepaccident import _Later, _Package

LATE = {
    name: getattr(package, name)
    for package in (maps, motion, render, safety, validation)
    for name in package.__all__
    if hasattr(DeepAccident, name)
}


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout


def test_nothing_heavy_is_imported_before_it_is_used() -> None:
    names = ("motion", "render", "safety", "interactions", "maps", "validation", "evaluation", "synth")
    packages = [f"deepaccident_devkit.{name}" for name in names]
    heavy = [*packages, "cv2", "matplotlib", "scipy", "shapely"]
    code = "import sys; from deepaccident_devkit import DeepAccident; DeepAccident.find; DeepAccident.transform; "
    assert run(f"{code}print([name for name in {heavy} if name in sys.modules])") == "[]\n"


def test_what_is_asked_for_brings_its_own_package_alone() -> None:
    code = "import sys; from deepaccident_devkit import DeepAccident; DeepAccident.samples; "
    packages = [f"deepaccident_devkit.{name}" for name in ("motion", "render", "safety", "validation")]
    assert run(f"{code}print([name for name in {packages} if name in sys.modules])") == f"{packages[:1]}\n"


def test_help_has_every_signature() -> None:
    code = "import pydoc; from deepaccident_devkit import DeepAccident; print(pydoc.render_doc(DeepAccident, "
    shown = run(f"{code}renderer=pydoc.plaintext))")
    for name in ("motion_labels", "findings", "render_bev", "describe"):
        assert f" |  {name}(" in shown


def test_each_is_its_packages_own_and_in_place_after_its_first_use() -> None:
    assert {"motion_labels", "findings", "render_sample", "render_replay", "describe"} < LATE.keys()
    assert [name for name in LATE if getattr(DeepAccident, name) is not LATE[name]] == []
    assert [name for name in LATE if vars(DeepAccident)[name] is not LATE[name]] == []
    assert [name for name, value in vars(DeepAccident).items() if isinstance(value, _Later)] == []


def test_an_instance_binds_them() -> None:
    da = object.__new__(DeepAccident)
    for name, function in LATE.items():
        bound = getattr(da, name)
        assert bound.__self__ is da
        assert bound.__func__ is function
        whole, shown = inspect.signature(function), inspect.signature(bound)
        assert [*shown.parameters.values()] == [*whole.parameters.values()][1:]
        assert shown.return_annotation == whole.return_annotation


def test_a_subclass_keeps_what_it_has_instead() -> None:
    class Facade:
        samples = _Package("motion").samples

    class Mine(Facade):
        def samples(self) -> Any:
            return super().samples

    assert Mine().samples().__func__ is motion.samples
    assert Mine().samples().__func__ is motion.samples
    assert vars(Facade)["samples"] is motion.samples


def test_tools_that_look_at_any_object_find_nothing_special() -> None:
    assert not hasattr(_Package("motion"), "__wrapped__")
    assert inspect.unwrap(_Package("motion"))  # type: ignore[arg-type]
