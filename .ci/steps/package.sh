# the README's first command and its Python, the wheel and the source archive
source .ci/tools/step.sh
"$PYTHON" -m venv "$CI_LOGS/venv"
demo() {
  PATH="$CI_LOGS/venv/bin:$PATH"
  eval "$(readme_command synth)"
  test -s deepaccident_demo/index.html
}
check "README's first command" demo
readme_python() { sed -n '/^```python$/,/^```$/{/^```/d;p}' README.md | "$CI_LOGS/venv/bin/python" -; }
check "README's Python" readme_python

need environment environment build "$PYTHON" 'build twine'
check build "$CI_ENVIRONMENTS/build/bin/python" -m build --outdir "$CI_LOGS/dist" .
check metadata "$CI_ENVIRONMENTS/build/bin/twine" check --strict "$CI_LOGS"/dist/*
"$PYTHON" -m venv "$CI_LOGS/installed"
installed() {
  "$CI_LOGS/installed/bin/pip" install --quiet "$@"
  cd "$CI_LOGS"
  "$CI_LOGS/installed/bin/deepaccident" --version --all
}
check 'the wheel installs' installed "$CI_LOGS"/dist/*.whl
check 'the source archive installs' installed --force-reinstall --no-deps "$CI_LOGS"/dist/*.tar.gz
