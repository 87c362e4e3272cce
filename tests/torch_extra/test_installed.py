import importlib.util

import pytest


def test_torch_is_installed() -> None:
    if importlib.util.find_spec("torch") is None:
        pytest.skip("torch is not installed, its tests are left out: pip install '.[torch]'")
