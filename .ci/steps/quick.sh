# linters, types, layers, and the quick tests of what all else stands on; the step "newest" runs all of them
source .ci/tools/step.sh
need environment environment core "$PYTHON" '.[test,lint]'
PATH="$CI_ENVIRONMENTS/core/bin:$PATH"
check types mypy --strict deepaccident_devkit &
check lint ruff check .
check format ruff format --check .
check layers lint-imports
# where the step "newest" runs as well, it runs these tests
if [[ " $CI_STEPS " != *' newest '* ]]; then
  check tests pytest -q -n auto -p no:cacheprovider tests/property tests/unit/geometry tests/unit/release \
    tests/unit/tables tests/unit/v2x tests/test_api.py
fi
wait
