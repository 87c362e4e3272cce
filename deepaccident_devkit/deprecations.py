"""What is deprecated: one warning that says since when, until when, and what to write."""

import inspect
import warnings

DEPRECATED = r"(.+) is deprecated since ([\d.]+) and gone in ([\d.]+); use "
"""A pattern that the warnings of `warn_deprecated` begin with."""
_PACKAGE = __name__.partition(".")[0]


def warn_deprecated(what: str, instead: str, *, since: str, gone_in: str) -> None:
    """Warn the caller of the devkit, not a function of its own: a DeprecationWarning with both versions.

    Args:
        what: the deprecated call or name, as its users write it.
        instead: what to write.
        since: the version that deprecates it, such as 0.1.
        gone_in: the version that no longer has it; a test fails as soon as the devkit has this version.
    """
    level, frame = 0, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        level, frame = level + 1, frame.f_back
    message = f"{what} is deprecated since {since} and gone in {gone_in}; use {instead}"
    warnings.warn(message, DeprecationWarning, stacklevel=level + 1)
