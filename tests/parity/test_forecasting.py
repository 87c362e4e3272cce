"""The golden numbers of forecasts (tests/data/golden/forecasting), which the package av2 made, to
1e-9.

The numbers by mode come from av2's own functions, the numbers by actor from the rules of
docs/protocols.md on top of them.
"""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.forecasting.metrics import (
    actor_errors,
    brier,
    collisions,
    displacement_errors,
    misses,
    world_errors,
)

TOLERANCE = 1e-9
BY_MODE = ("ade", "fde", "brier_ade", "brier_fde", "brier_fde_normalized", "missed", "missed_1m")
BY_ACTOR = ("min_fde", "miss", "brier_min_fde", "min_ade", "min_ade_any", "cut_ade")
NUMS_OF_MODES = (1, 6)
WORLDS = range(8)


@functools.cache
def _arrays(folder: Path) -> Mapping[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    for name in ("inputs", "outputs"):
        with np.load(folder / f"{name}.npz") as archive:
            arrays |= dict(archive)
    return arrays


@pytest.fixture
def golden_arrays(pytestconfig: pytest.Config) -> Mapping[str, np.ndarray]:
    folder = pytestconfig.getoption("golden") / "forecasting"
    if not (folder / "outputs.npz").is_file():
        pytest.fail(f"{folder}: no golden numbers; see pytest --golden DIR")
    return _arrays(folder)


def read_modes(golden_arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return paths, probabilities, truth and its validity.

    Missing modes and truth that must not be read are NaN.
    """
    has_mode = np.arange(golden_arrays["forecasts"].shape[1]) < golden_arrays["n_modes"][:, None]
    paths = np.where(has_mode[:, :, None, None], golden_arrays["forecasts"], np.nan)
    chances = np.where(has_mode, golden_arrays["probability"], np.nan)

    valid = golden_arrays["valid"].astype(bool)
    truth = np.where(valid[..., None], golden_arrays["gt"], np.nan)
    return paths, chances, truth, valid


def measure_modes(golden_arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    paths, chances, truth, valid = read_modes(golden_arrays)
    ade, fde = displacement_errors(paths, truth, valid)
    halved = chances / 2
    normalized = halved / np.nansum(halved, axis=1, keepdims=True)
    return {
        "ade": ade,
        "fde": fde,
        "brier_ade": brier(ade, chances),
        "brier_fde": brier(fde, chances),
        "brier_fde_normalized": brier(fde, normalized),
        "missed": misses(fde, 2.0),
        "missed_1m": misses(fde, 1.0),
    }


@pytest.mark.parametrize("name", BY_MODE)
def test_errors_by_mode_equal_av2s(golden_arrays: Mapping[str, np.ndarray], name: str) -> None:
    errors = measure_modes(golden_arrays)[name]
    assert_allclose(errors, golden_arrays[name].astype(float), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("num_modes", NUMS_OF_MODES)
@pytest.mark.parametrize("name", BY_ACTOR)
def test_errors_by_actor_equal_the_rules_on_av2s(
    golden_arrays: Mapping[str, np.ndarray], name: str, num_modes: int
) -> None:
    paths, chances, truth, valid = read_modes(golden_arrays)
    expected = golden_arrays[f"k{num_modes}_{name}"].astype(float)
    expected_mean = golden_arrays[f"k{num_modes}_mean_{name}"]

    errors = actor_errors(paths, truth, valid, chances, num_modes)[name]

    assert_allclose(errors, expected, rtol=0, atol=TOLERANCE)
    assert_allclose(np.nanmean(errors), expected_mean, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("world", WORLDS)
def test_worlds_equal_av2s(golden_arrays: Mapping[str, np.ndarray], world: int) -> None:
    paths = golden_arrays[f"world_forecasts_{world}"]
    truth = golden_arrays[f"world_gt_{world}"]
    chances = golden_arrays[f"world_probability_{world}"]

    ade, fde, final_errors = world_errors(paths, truth)

    assert_allclose(ade, golden_arrays[f"world_ade_{world}"], rtol=0, atol=TOLERANCE)
    assert_allclose(fde, golden_arrays[f"world_fde_{world}"], rtol=0, atol=TOLERANCE)
    assert_allclose(
        brier(fde, chances), golden_arrays[f"world_brier_fde_{world}"], rtol=0, atol=TOLERANCE
    )
    assert_array_equal(misses(final_errors), golden_arrays[f"world_misses_{world}"])
    assert_array_equal(collisions(paths), golden_arrays[f"world_collisions_{world}"])


def test_every_golden_array_is_compared(
    golden_arrays: Mapping[str, np.ndarray], pytestconfig: pytest.Config
) -> None:
    names = {"forecasts", "gt", "valid", "probability", "n_modes", *BY_MODE}
    for num_modes in NUMS_OF_MODES:
        names |= {f"k{num_modes}_{name}" for name in BY_ACTOR}
        names |= {f"k{num_modes}_mean_{name}" for name in BY_ACTOR}
    world_inputs = ("forecasts", "gt", "probability")
    world_outputs = ("ade", "fde", "brier_fde", "misses", "collisions")
    for world in WORLDS:
        names |= {f"world_{name}_{world}" for name in (*world_inputs, *world_outputs)}
    assert set(golden_arrays) == names

    path = pytestconfig.getoption("golden") / "forecasting" / "cases.json"
    cases = json.loads(path.read_text(encoding="utf-8"))["cases"]
    assert len(cases) == len(golden_arrays["forecasts"])
