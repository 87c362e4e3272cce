"""The golden numbers of forecasts (tests/data/golden/forecasting), which the package av2 made, to
1e-9.

By mode they are av2's own functions; by actor the rules of docs/protocols.md on them.
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
WORLDS = range(8)


@functools.cache
def _arrays(folder: Path) -> Mapping[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for name in ("inputs", "outputs"):
        with np.load(folder / f"{name}.npz") as archive:
            found |= dict(archive)
    return found


@pytest.fixture
def given(pytestconfig: pytest.Config) -> Mapping[str, np.ndarray]:
    folder = pytestconfig.getoption("golden") / "forecasting"
    if not (folder / "outputs.npz").is_file():
        pytest.fail(f"{folder}: no golden numbers; see pytest --golden DIR")
    return _arrays(folder)


def modes_of(given: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Paths and probabilities, NaN of modes that are not there; truth, NaN where it must not be
    read; validity.
    """
    there = np.arange(given["forecasts"].shape[1]) < given["n_modes"][:, None]
    paths = np.where(there[:, :, None, None], given["forecasts"], np.nan)
    valid = given["valid"].astype(bool)
    truth = np.where(valid[..., None], given["gt"], np.nan)
    return paths, np.where(there, given["probability"], np.nan), truth, valid


def by_mode(given: Mapping[str, np.ndarray]) -> dict[str, Any]:
    paths, chances, truth, valid = modes_of(given)
    ade, fde = displacement_errors(paths, truth, valid)
    halved = chances / 2
    return {
        "ade": ade,
        "fde": fde,
        "brier_ade": brier(ade, chances),
        "brier_fde": brier(fde, chances),
        "brier_fde_normalized": brier(fde, halved / np.nansum(halved, axis=1, keepdims=True)),
        "missed": misses(fde, 2.0),
        "missed_1m": misses(fde, 1.0),
    }


@pytest.mark.parametrize("name", BY_MODE)
def test_errors_by_mode_equal_av2s(given: Mapping[str, np.ndarray], name: str) -> None:
    assert_allclose(by_mode(given)[name], given[name].astype(float), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("most", [1, 6])
@pytest.mark.parametrize("name", BY_ACTOR)
def test_errors_by_actor_equal_the_rules_on_av2s(
    given: Mapping[str, np.ndarray], name: str, most: int
) -> None:
    paths, chances, truth, valid = modes_of(given)
    found = actor_errors(paths, truth, valid, chances, most)[name]
    assert_allclose(found, given[f"k{most}_{name}"].astype(float), rtol=0, atol=TOLERANCE)
    assert_allclose(np.nanmean(found), given[f"k{most}_mean_{name}"], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("world", WORLDS)
def test_worlds_equal_av2s(given: Mapping[str, np.ndarray], world: int) -> None:
    paths, truth, chances = (
        given[f"world_{name}_{world}"] for name in ("forecasts", "gt", "probability")
    )
    ade, fde, final_errors = world_errors(paths, truth)
    assert_allclose(ade, given[f"world_ade_{world}"], rtol=0, atol=TOLERANCE)
    assert_allclose(fde, given[f"world_fde_{world}"], rtol=0, atol=TOLERANCE)
    assert_allclose(brier(fde, chances), given[f"world_brier_fde_{world}"], rtol=0, atol=TOLERANCE)
    assert_array_equal(misses(final_errors), given[f"world_misses_{world}"])
    assert_array_equal(collisions(paths), given[f"world_collisions_{world}"])


def test_every_golden_array_is_compared(
    given: Mapping[str, np.ndarray], pytestconfig: pytest.Config
) -> None:
    inputs = {"forecasts", "gt", "valid", "probability", "n_modes"}
    inputs |= {
        f"world_{name}_{world}" for name in ("forecasts", "gt", "probability") for world in WORLDS
    }
    outputs = {
        *BY_MODE,
        *(
            f"k{most}_{kind}{name}"
            for most in (1, 6)
            for kind in ("", "mean_")
            for name in BY_ACTOR
        ),
    }
    worlds = ("ade", "fde", "brier_fde", "misses", "collisions")
    outputs |= {f"world_{name}_{world}" for name in worlds for world in WORLDS}
    assert set(given) == inputs | outputs
    cases = json.loads(
        (pytestconfig.getoption("golden") / "forecasting" / "cases.json").read_text(
            encoding="utf-8"
        )
    )
    assert len(cases["cases"]) == len(given["forecasts"])
