"""The pictures of a question, linked or copied to names that tell nothing."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.export.sensor_files import sensor_files

if TYPE_CHECKING:
    from deepaccident_devkit.export.bulk import Output
    from deepaccident_devkit.export.questions.observed import Observations
    from deepaccident_devkit.export.questions.question import Names
    from deepaccident_devkit.export.questions.windows import Window
    from deepaccident_devkit.release.store import ReleasePath

FOLDER: Final = "questions"
"""Of what may be handed out, in the export's folder."""
_MISSING: Final = "pictures that are not in this release"


class Pictures:
    """The pictures of some cameras of a recording's observers.

    A picture has a name in each question that shows it, so that questions cannot be told to be of one recording by it.
    """

    def __init__(self, observations: Observations, cameras: Sequence[str]) -> None:
        """Look at nothing yet."""
        self._observations, self._cameras = observations, cameras

    @cached_property
    def _files(self) -> dict[tuple[str, str], dict[int, tuple[ReleasePath, int]]]:
        """Agent and camera → frame → path and bytes of what is there."""
        given = self._observations
        return {
            (agent, camera): dict(sensor_files(given.dataset, given.scenario, agent, camera))
            for agent, camera in product(given.agents, self._cameras)
        }

    def put(self, window: Window, names: Names, question: str, output: Output) -> list[dict[str, Any]]:
        """Put the pictures of a window there, and list them by time, observer and camera.

        Args:
            window: the moments.
            names: of the observers.
            question: its id.
            output: where they go; counts those that are missing.
        """
        listed = []
        moments = enumerate(zip(window.frames, window.times, strict=True))
        for (number, (frame, time)), name, camera in product(moments, names.observers, self._cameras):
            found = self._files[names.observers[name], camera].get(frame)
            if found is None:
                output.leave_out(_MISSING)
                continue
            path = f"images/{question}/{number:02d}_{name}_{camera}.jpg"
            output.link(found[0], f"{FOLDER}/{path}", symbolic=False)
            listed.append({"time": time, "observer": name, "camera": camera, "path": path})
        return listed
