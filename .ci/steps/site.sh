# the documentation site, warnings as errors, with the extra docs alone
source .ci/tools/step.sh
need environment environment docs "$PYTHON" '.[docs]'
check site "$CI_ENVIRONMENTS/docs/bin/sphinx-build" -W --keep-going -q -c docs . "$CI_LOGS/site"
