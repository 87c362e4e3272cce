"""What a check of a scenario file says."""

import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.scenario import checked_text

TEXT = """\
actors:
  - {role: ego, from: west}
  - {role: other, from: east}
background: {vehicles: 0, two_wheelers: 0, parked: 0, walking: 0, crossing: 0}
"""


def test_without_a_file_there_is_nothing_to_check():
    with pytest.raises(ConfigError, match="spec: nothing to check; give a scenario file"):
        checked_text(SynthConfig())


def test_a_file_in_which_nobody_meets_has_one_scenario(tmp_path):
    path = tmp_path / "quiet.yaml"
    path.write_text(TEXT, encoding="utf-8")
    text = checked_text(SynthConfig(spec=path, frames=None))
    assert "accident" not in text
    assert text.count("  normal: nobody collides\n") == 1
    assert "4 road users that move, 0 parked" in text


@pytest.mark.slow
def test_the_two_are_named_by_their_roles(tmp_path):
    path = tmp_path / "pedestrian.yaml"
    walker = "  - {role: pedestrian, from: west, start_distance: 25}\nmeet: {actors: [ego, pedestrian]}\nbackground:"
    path.write_text(TEXT.replace("background:", walker), encoding="utf-8")
    text = checked_text(SynthConfig(spec=path, frames=None))
    assert "  accident: ego (car, " in text
    assert ") and pedestrian (pedestrian, " in text
