#!/usr/bin/env bash
# The wheel and the sdist, each installed away from the checkout on every Python of pyproject.toml, with the oldest
# libraries that it allows and with the newest: the demo, README.md's Python, and the version. `.ci/run` does some
# of these (its steps `package`, `oldest` and `newest`). Some 25 minutes on two cores:
#
#     .ci/tools/wheels.sh            # all
#     .ci/tools/wheels.sh 3.12       # one Python
#
# Where an oldest library has no wheel for a Python, its next release that has one is taken (`newer` below).
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

# The first releases with wheels for a Python, of libraries whose lower bound has none for it.
declare -A newer=(
  [3.12]='numpy==1.26.* scipy==1.11.* shapely==2.0.* pillow==10.1.* pyyaml==6.0.1'
  [3.13]='numpy==2.1.* opencv-python-headless==4.10.* scipy==1.14.* shapely==2.0.* pillow==11.0.* pyyaml==6.0.2 matplotlib==3.9.* pyarrow==18.*'
)

"$PYTHON" -m venv "$work/build"
"$work/build/bin/pip" install --quiet build tomli
"$work/build/bin/python" -m build --outdir "$work/dist" "$top" >/dev/null
mapfile -t bounds < <("$work/build/bin/python" "$top/.ci/tools/lower_bounds.py" synth)

# The lower bounds, less the libraries that `newer` names.
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
      rm -rf tried
      "$python" -m venv "$work/tried/venv"
      wanted=()
      if [ "$libraries" = oldest ]; then mapfile -t wanted < <(oldest_on "$version"); fi
      "$work/tried/venv/bin/pip" install --quiet "$distribution[synth]" "${wanted[@]}"
      cd tried
      venv/bin/deepaccident --version --all
      venv/bin/deepaccident demo >demo.log
      test -s deepaccident_demo/index.html
      sed -n '/^```python$/,/^```$/{/^```/d;p}' "$top/README.md" | venv/bin/python -
    done
  done
done
printf '\nall of it works\n'
