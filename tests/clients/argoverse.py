"""Read an export with av2 0.3.6: `python tests/clients/argoverse.py FOLDER`, in an environment
without our devkit.

FOLDER is the output of `make_argoverse.py`.
"""

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from av2.datasets.motion_forecasting.data_schema import ArgoverseScenario, TrackCategory
from av2.datasets.motion_forecasting.scenario_serialization import load_argoverse_scenario_parquet


def main(folder: Path) -> None:
    expected = json.loads((folder / "expected.json").read_text())
    num_states = 0
    types: Counter[str] = Counter()
    for path, window in expected.items():
        scenario = load_argoverse_scenario_parquet(Path(path))
        num_states += check_scenario(scenario, window)
        types.update(track.object_type.value for track in scenario.tracks)

    assert {"vehicle", "pedestrian"} <= types.keys(), types
    assert len(expected) >= 8

    print(f"av2: {num_states} states of {len(expected)} scenarios equal the windows: good")


def check_scenario(scenario: ArgoverseScenario, window: dict[str, Any]) -> int:
    """Check that a scenario has the states of our window; return their number."""
    assert scenario.scenario_id == window["sample"]
    assert scenario.focal_track_id == window["focal"]
    assert len(scenario.timestamps_ns) == window["steps"] == 51
    assert scenario.city_name == window["sample"].split("/")[1].split("_")[0]

    present_ns = 1e8 * (int(window["sample"][-3:]) - 1)
    assert np.allclose(scenario.timestamps_ns, present_ns + 1e8 * np.arange(-20, 31), atol=10)

    num_states = 0
    for track in scenario.tracks:
        states = np.array(window["tracks"].pop(track.track_id))
        read_states = np.array(
            [
                [state.timestep, *state.position, state.heading, *state.velocity]
                for state in track.object_states
            ]
        )
        assert np.array_equal(read_states, states)

        observed = [state.observed for state in track.object_states]
        assert observed == [state.timestep <= 20 for state in track.object_states]

        is_focal = track.track_id == window["focal"]
        assert (track.category == TrackCategory.FOCAL_TRACK) == is_focal
        num_states += len(states)

    assert not window["tracks"]

    return num_states


if __name__ == "__main__":
    main(Path(sys.argv[1]))
