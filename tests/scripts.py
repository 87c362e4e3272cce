"""The repository's scripts as modules: those of docs/ and schema/ lie in no package."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

TOP = Path(__file__).parents[1]


def loaded_script(path: str) -> ModuleType:
    """A script by its path below the top, run as a module of its own."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, TOP / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def of_checkout(name: str) -> ModuleType:
    """A module of the checkout that is not installed, such as `benchmarks.coverage`."""
    sys.path.append(str(TOP))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(TOP))
