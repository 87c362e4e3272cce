"""What is deprecated: one warning that says since when, until when, and what to write."""

import warnings


def warn_deprecated(what: str, instead: str, *, since: str, gone_in: str) -> None:
    """Warn the caller of the function that calls this one: a DeprecationWarning with both versions.

    Args:
        what: the deprecated call, as its callers write it.
        instead: what to write.
        since: the version that deprecates it, such as 0.1.
        gone_in: the version that no longer has it; a test fails as soon as the devkit has this version.
    """
    message = f"{what} is deprecated since {since} and gone in {gone_in}; use {instead}"
    warnings.warn(message, DeprecationWarning, stacklevel=3)
