"""Imports of the repository's scripts; the ones of docs/ and schema/ are in no package."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

TOP = Path(__file__).parents[2]


def load_script(path: str) -> ModuleType:
    """Run a script as a module, and return it; the path is relative to the top folder."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, TOP / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def import_from_checkout(name: str) -> ModuleType:
    """Import a module of the checkout that is not installed, such as `benchmarks.coverage`."""
    sys.path.append(str(TOP))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(TOP))
