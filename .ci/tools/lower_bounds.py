"""The lower bounds of what a user or the tests install, for pip: `name==1.2.*` of each `name>=1.2`
in pyproject.toml.

    pip install '.[test]' $(python .ci/tools/lower_bounds.py)
    pip install '.[synth]' $(python .ci/tools/lower_bounds.py synth)

The extra is `test` without a word. Of several bounds of a name the largest counts.
"""

import re
import sys
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, to which pytest brings it
    import tomli as tomllib

with (Path(__file__).parents[2] / "pyproject.toml").open("rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]
extra = extras[sys.argv[1] if len(sys.argv) > 1 else "test"]
others = [
    name
    for each in extra
    if each.startswith("deepaccident_devkit[")
    for name in re.findall(r"\w+", each)[1:]
]
bounds: dict[str, tuple[int, ...]] = {}
for requirement in [
    *project["dependencies"],
    *extra,
    *(each for name in others for each in extras[name]),
]:
    found = re.match(r"([\w-]+)>=([\d.]+)", requirement)
    if found:
        bound = tuple(map(int, found[2].split(".")))
        bounds[found[1]] = max(bounds.get(found[1], ()), bound if len(bound) > 1 else (*bound, 0))
for name, bound in bounds.items():
    print(f"{name}=={'.'.join(map(str, bound))}.*")
