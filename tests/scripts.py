"""The repository's scripts as modules: those of docs/ and schema/ lie in no package."""

import importlib.util
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
