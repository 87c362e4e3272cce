# Functions of all steps. .ci/tools/run_steps.py sets CI_*, starts each step in a copy of the tree, and reports its
# checks.
set -euo pipefail
export PIP_DISABLE_PIP_VERSION_CHECK=1 MPLBACKEND=Agg PYTEST_XDIST_AUTO_NUM_WORKERS="$CI_WORKERS"
# Python compiles the modules that a step imports; pip would compile all of them, which takes longer than to unpack them.
export PIP_COMPILE=0
# A CPU build; plain `torch` would download gigabytes of CUDA. Where PyPI offers only that:
# TORCH='torch --index-url https://download.pytorch.org/whl/cpu' .ci/run
TORCH="${TORCH:-torch==2.13.0}"
# versions of Python
OLDEST="${OLDEST:-3.10}" NEWEST="${NEWEST:-3.13}"
source .ci/tools/python_of.sh

# check NAME COMMAND...: runs a command. If it fails, this is reported and the step goes on. A step with checks in the
# background ends with `wait`.
check() {
  local name="$1" began=$SECONDS log status
  shift
  log="$CI_LOGS/${name//[^a-zA-Z0-9.]/_}.log"
  set +e
  (
    set -e
    "$@"
  ) >"$log" 2>&1 </dev/null
  status=$?
  set -e
  if [ $status = 0 ]; then result=passed; else result=failed; fi
  printf '%s\t%s\t%s\t%s\n' "$name" $result $((SECONDS - began)) "$log" >>"$CI_LOGS/checks.tsv"
}

# need NAME COMMAND...: like check, but the step ends if the command fails.
need() {
  check "$@"
  if [ $result = failed ]; then exit 1; fi
}

# environment NAME PYTHON REQUIREMENTS...: makes a virtual environment at $CI_ENVIRONMENTS/NAME, which several steps may
# use. One call of pip installs each argument, in this order. An environment with the same requirements is reused, and
# gets the package of this tree.
environment() {
  local home="$CI_ENVIRONMENTS/$1" python="$2" requirements words made_for
  shift 2
  made_for="$("$python" --version) $(printf '%s\n' "$@" | cat - pyproject.toml | sha256sum)"
  exec 9>"$home.lock"
  flock 9
  if [ "$(cat "$home/made_for" 2>/dev/null)" != "$made_for" ]; then
    rm -rf "$home"
    "$python" -m venv "$home"
    for requirements in "$@"; do
      read -ra words <<<"$requirements"
      "$home/bin/pip" install --quiet "${words[@]}"
    done
  elif [[ " $*" == *' .'* && "$(cat "$home/holds")" != "$CI_SOURCE_HASH" ]]; then
    "$home/bin/pip" install --quiet --no-deps --force-reinstall .
  fi
  printf '%s' "$made_for" >"$home/made_for"
  printf '%s' "$CI_SOURCE_HASH" >"$home/holds"
  exec 9>&-
}

# system COMMAND PACKAGE...: installs packages of Debian if the command that they contain is missing.
system() {
  command -v "$1" >/dev/null && return
  shift
  (
    flock 9
    apt-get -qq update && apt-get -qq install -y "$@"
  ) 9>"$CI_ENVIRONMENTS/system.lock"
}

# readme_command EXTRA: prints the command of README.md that installs this extra and then runs something.
readme_command() {
  local command_line
  command_line="$(sed -n "s/^    \(pip install '\.\[$1\]'.*\)$/\1/p" README.md)"
  [ -n "$command_line" ] || { echo "README.md has no command line with .[$1]" >&2; return 1; }
  printf '%s\n' "$command_line"
}

# client NAME: makes a folder for another reader, which opens it in its own environment without this package.
client() {
  mkdir "$CI_LOGS/$1"
  "$CI_ENVIRONMENTS/core/bin/python" -m "tests.clients.make_$1" "$CI_LOGS/$1"
  "$CI_ENVIRONMENTS/$1/bin/python" "tests/clients/$1.py" "$CI_LOGS/$1"
}

# The real scenario that tests/real reads, if it lies beside the checkout.
if [ -d "$CI_TOP/../shared/real" ]; then
  DEEPACCIDENT_REAL="$(realpath "$CI_TOP/../shared/real")"
  export DEEPACCIDENT_REAL
fi
