# the README's command for the tests, on the newest Python with the newest libraries
source .ci/tools/step.sh
python="$(python_of "$NEWEST")"
"$python" -m venv "$CI_LOGS/venv"
PATH="$CI_LOGS/venv/bin:$PATH"
check tests bash -c "$(readme_command test)"
