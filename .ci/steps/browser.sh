# the scripts of the pages (types, lint, tests), the workflows of GitHub, and the pages in Chromium
source .ci/tools/step.sh
npm_packages() { cd .ci/javascript && npm ci --silent --no-fund --no-audit; }
script() { cd .ci/javascript && npm run --silent "$1"; }
check 'npm packages' npm_packages
check 'types of scripts' script types
check 'lint of scripts' script lint
check 'workflows of GitHub' script workflows
check 'tests of scripts' script test

need environment environment core "$PYTHON" '.[test,lint]'
need Chromium system chromedriver chromium chromium-driver
PATH="$CI_ENVIRONMENTS/core/bin:$PATH"
export DEEPACCIDENT_REQUIRE_BROWSER=1
check pages pytest -q -m "" -n auto -p no:cacheprovider tests/browser
