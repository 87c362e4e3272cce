#!/usr/bin/env bash
# Installs the wheel and the sdist outside of the checkout, on every Python of pyproject.toml, with the oldest allowed
# libraries and with the newest. Runs the demo, README.md's Python, and the version each time. `.ci/run` does some of
# this (its steps `package`, `oldest` and `newest`). It takes about 25 minutes on two cores:
#
#     .ci/tools/wheels.sh            # every Python
#     .ci/tools/wheels.sh 3.12       # one Python
#
# If an oldest library has no wheel for a Python, its next release with one is used (`newer` below).
set -euo pipefail

top="$(git -C "$(dirname "${BASH_SOURCE[0]}")" rev-parse --show-toplevel)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
unset PYTHONPATH
export PIP_DISABLE_PIP_VERSION_CHECK=1 MPLBACKEND=Agg
PYTHON="$(command -v "${PYTHON:-python3}")"
source "$top/.ci/tools/python_of.sh"
pythons=("$@")
[ ${#pythons[@]} -gt 0 ] || pythons=(3.10 3.11 3.12 3.13)

# The first releases with wheels for a Python, for libraries without such a wheel at their lower bound.
declare -A newer=(
  [3.12]='numpy==1.26.* scipy==1.11.* shapely==2.0.* pillow==10.1.* pyyaml==6.0.1'
  [3.13]='numpy==2.1.* opencv-python-headless==4.10.* scipy==1.14.* shapely==2.0.* pillow==11.0.* pyyaml==6.0.2 matplotlib==3.9.* pyarrow==18.*'
)

"$PYTHON" -m venv "$work/build"
"$work/build/bin/pip" install --quiet build tomli
"$work/build/bin/python" -m build --outdir "$work/dist" "$top" >/dev/null
mapfile -t bounds < <("$work/build/bin/python" "$top/.ci/tools/lower_bounds.py" synth)

# Prints the lower bounds, but for the libraries in `newer` the releases that it names.
oldest_on() {
  local bound name
  for bound in "${bounds[@]}"; do
    name="${bound%%==*}"
    case " ${newer[$1]:-} " in *" $name"[\>=]*) ;; *) printf '%s\n' "$bound" ;; esac
  done
  [ -z "${newer[$1]:-}" ] || tr ' ' '\n' <<<"${newer[$1]}"
}

for version in "${pythons[@]}"; do
  python="$(python_of "$version")"
  for distribution in "$work"/dist/*; do
    for libraries in oldest newest; do
      printf '\n== %s on Python %s, %s libraries (%s s)\n' "$(basename "$distribution")" "$version" "$libraries" "$SECONDS"
      cd "$work"
      rm -rf installed
      "$python" -m venv "$work/installed/venv"
      requirements=()
      if [ "$libraries" = oldest ]; then mapfile -t requirements < <(oldest_on "$version"); fi
      "$work/installed/venv/bin/pip" install --quiet "$distribution[synth]" "${requirements[@]}"
      cd installed
      venv/bin/deepaccident --version --all
      venv/bin/deepaccident demo >demo.log
      test -s deepaccident_demo/index.html
      sed -n '/^```python$/,/^```$/{/^```/d;p}' "$top/README.md" | venv/bin/python -
    done
  done
done
printf '\neverything works\n'
