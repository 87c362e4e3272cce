"""Set the version of a release, check that all files agree on it, or print its notes.

    python .ci/tools/release.py set 1.1.0       write it and its date wherever a release states them
    python .ci/tools/release.py check v1.1.0    compare these places with the tag
    python .ci/tools/release.py notes           print the section of CHANGELOG.md

`deepaccident_devkit/support/version.py` is the source. The owner of the repository is read from
RELEASING.md.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path

VERSION = re.compile(r"\d+\.\d+\.\d+(a\d+|b\d+|rc\d+)?")
STABLE, BETA = "Development Status :: 5 - Production/Stable", "Development Status :: 4 - Beta"
PLACES = {
    "deepaccident_devkit/support/version.py": r'(?m)^__version__ = "(.*)"$',
    "CITATION.cff": r"(?m)^version: (.*)$",
    "CHANGELOG.md": r"(?m)^## \[(\d.*?)\]",
}
"""File that states the version → pattern that finds it; the first file is the source."""


def main(arguments: list[str], top: Path) -> int:
    """Do what the command line asks for; return its exit status."""
    commands: dict[str, tuple[Callable[..., int], tuple[int, ...]]] = {
        "set": (set_version, (1,)),
        "check": (check, (0, 1)),
        "notes": (print_notes, (0,)),
    }
    run, counts_of_values = commands.get(arguments[0] if arguments else "", (None, ()))
    if run is None or len(arguments) - 1 not in counts_of_values:
        print(__doc__, file=sys.stderr)
        return 2
    return run(top, *arguments[1:])


def set_version(top: Path, version: str) -> int:
    """Write a version, today's date, the classifier, and the addresses of the repository."""
    if not VERSION.fullmatch(version):
        print(f"{version} is no version such as 1.1.0 or 1.1.0rc1", file=sys.stderr)
        return 2
    today = datetime.now(timezone.utc).date().isoformat()
    replace(
        top / "deepaccident_devkit/support/version.py",
        PLACES["deepaccident_devkit/support/version.py"],
        version,
    )
    replace(top / "CITATION.cff", PLACES["CITATION.cff"], version)
    changelog = (top / "CHANGELOG.md").read_text(encoding="utf-8")
    if f"## [{version}]" not in changelog:
        heading = f"## [Unreleased]\n\n## [{version}] - {today}"
        (top / "CHANGELOG.md").write_text(
            changelog.replace("## [Unreleased]", heading, 1), encoding="utf-8"
        )
    replace(top / "pyproject.toml", r'"(Development Status :: .*)"', status_of(version))
    if owner := owner_of(top):
        write_addresses(top, f"https://github.com/{owner}/deepaccident_devkit")
    return check(top)


def check(top: Path, tag: str | None = None) -> int:
    """Print what disagrees with the version of the package or with the tag; return 1 if any."""
    faults = list(disagreements(top, tag))
    print("\n".join(faults) or f"all files state version {version_of(top)}")
    return 1 if faults else 0


def print_notes(top: Path) -> int:
    """Print the section of the changelog on this version."""
    print(notes_of(top))
    return 0


def disagreements(top: Path, tag: str | None) -> Iterator[str]:
    """Yield one line for each thing that a release would state wrongly."""
    version = version_of(top)
    for name, pattern in PLACES.items():
        match = re.search(pattern, (top / name).read_text(encoding="utf-8"))
        stated = match[1] if match else "no version"
        if stated != version:
            yield f"{name}: {stated}, but the package is {version}"
    if f'"{status_of(version)}"' not in (top / "pyproject.toml").read_text(encoding="utf-8"):
        yield f"pyproject.toml: the classifier of {version} is {status_of(version)!r}"
    if tag is not None and tag != f"v{version}":
        yield f"the tag is {tag}, but the package is {version}"
    if tag is not None and not owner_of(top):
        yield "RELEASING.md: the setting `owner` is empty"


def version_of(top: Path) -> str:
    """Return the version of the package."""
    name, pattern = next(iter(PLACES.items()))
    return re.findall(pattern, (top / name).read_text(encoding="utf-8"))[0]


def owner_of(top: Path) -> str:
    """Return the owner of the repository on GitHub; empty if none is set."""
    return re.findall(
        r"(?m)^    owner = *(\S*)$", (top / "RELEASING.md").read_text(encoding="utf-8")
    )[0]


def notes_of(top: Path) -> str:
    """Return the section of the changelog on this version, without its heading."""
    sections = re.split(
        r"(?m)^## \[(.*?)\].*\n", (top / "CHANGELOG.md").read_text(encoding="utf-8")
    )
    return dict(zip(sections[1::2], sections[2::2], strict=True))[version_of(top)].strip()


def status_of(version: str) -> str:
    """Return the PyPI classifier of a version."""
    return STABLE if version.replace(".", "").isdigit() else BETA


def write_addresses(top: Path, repository: str) -> None:
    """Write the GitHub addresses into the metadata, the citation and the chooser of issues."""
    issues, advisories = f"{repository}/issues", f"{repository}/security/advisories/new"
    urls = f'[project.urls]\nRepository = "{repository}"\nIssues = "{issues}"\n\n'
    links = (
        "blank_issues_enabled: false\ncontact_links:\n  - name: A security fault\n"
        f"    url: {advisories}\n    about: Reported in private, as SECURITY.md asks\n"
    )
    code = f"repository-code: {repository}\n"
    write_section(
        top / "pyproject.toml",
        r"(?s)\[project\.urls\]\n.*?\n\n",
        urls,
        before="[project.scripts]\n",
    )
    write_section(top / "CITATION.cff", r"(?m)^repository-code: .*\n", code, before="authors:\n")
    (top / ".github/ISSUE_TEMPLATE/config.yml").write_text(links, encoding="utf-8")


def replace(path: Path, pattern: str, value: str) -> None:
    """Replace the first group of the only match."""
    text = path.read_text(encoding="utf-8")
    [match] = re.finditer(pattern, text)
    path.write_text(text[: match.start(1)] + value + text[match.end(1) :], encoding="utf-8")


def write_section(path: Path, pattern: str, section: str, *, before: str) -> None:
    """Replace a section, or insert it above the line that reads `before`."""
    text, count = re.subn(pattern, section, path.read_text(encoding="utf-8"))
    if not count:
        text = text.replace(f"\n{before}", f"\n{section}{before}", 1)
    path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Path(__file__).resolve().parents[2]))
