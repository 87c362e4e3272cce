"""The keyframes that formats annotate."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.export.frames import KEY_STEP, keyframes, next_keyframe


@given(last=st.integers(1, 400), number=st.integers(1, 400))
def test_keyframes_lead_to_the_last_frame(last: int, number: int) -> None:
    keys = keyframes(last)
    assert keys[-1] == last
    assert 1 <= keys[0] <= KEY_STEP
    assert set(np.diff(keys)) <= {KEY_STEP}
    if number <= last:
        assert next_keyframe(number, last) == min(key for key in keys if key >= number)


@given(last=st.integers(1, 100), step=st.integers(1, 120))
def test_keyframes_are_a_step_apart(last: int, step: int) -> None:
    numbers = list(range(last, 0, -step))
    assert list(keyframes(last, step)) == numbers[::-1]
