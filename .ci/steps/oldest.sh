# the tests of the core on the oldest Python with the oldest libraries that pyproject.toml allows
source .ci/tools/step.sh
export PIP_COMPILE=1 # old libraries warn when they are compiled, and a test makes warnings errors
python="$(python_of "$OLDEST")"
mapfile -t bounds < <("$PYTHON" .ci/tools/lower_bounds.py)
# the oldest matplotlib calls functions that newer versions of pyparsing deprecate
need environment environment oldest "$python" ".[test] ${bounds[*]} pyparsing==3.1.*"
check libraries "$CI_ENVIRONMENTS/oldest/bin/python" -c \
  'import cv2, numpy; assert numpy.__version__ < "1.27"; print("numpy", numpy.__version__, "OpenCV", cv2.__version__)'
# without the tests of plug-ins, pictures, whole releases, pages, words and this repository
check tests "$CI_ENVIRONMENTS/oldest/bin/pytest" -q -n auto -p no:cacheprovider --hypothesis-profile few tests \
  --ignore tests/test_tutorials.py --ignore tests/test_repository.py --ignore tests/test_checks.py \
  --ignore tests/test_campaign.py --ignore tests/test_mutation.py --ignore tests/test_citations.py \
  --ignore tests/test_docs.py --ignore tests/test_site.py --ignore tests/browser --ignore-glob 'tests/test_cli*' \
  --ignore tests/unit/render --ignore tests/unit/testing --ignore tests/fault_injection \
  --ignore tests/unit/plugins --ignore tests/test_words.py
check 'tests of files for others' "$CI_ENVIRONMENTS/oldest/bin/pytest" -q -n auto -m slow -p no:cacheprovider \
  tests/unit/export tests/unit/motion
