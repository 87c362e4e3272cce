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
    """The text of a small scenario file."""
    return SMALL


@pytest.fixture
def with_other():
    """The text of a small scenario file whose other vehicle has further entries, on line 4."""
    return lambda entries: SMALL.replace("from: north}", f"from: north, {entries}}}")
