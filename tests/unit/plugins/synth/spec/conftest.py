import pytest

SMALL = """\
name: small
actors:
  - {role: ego, from: west}
  - {role: other, from: north}
meet: {offset: 0.5}
"""


@pytest.fixture
def small() -> str:
    return SMALL


@pytest.fixture
def with_other():
    """A function that returns the small file with more entries for the other vehicle, on line 4."""
    return lambda entries: SMALL.replace("from: north}", f"from: north, {entries}}}")
