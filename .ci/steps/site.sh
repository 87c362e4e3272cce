# the documentation site with only the extra `docs`; warnings are errors
source .ci/tools/step.sh
need environment environment docs "$PYTHON" '.[docs]'
check site "$CI_ENVIRONMENTS/docs/bin/sphinx-build" -W --keep-going -q -c docs . "$CI_LOGS/site"
