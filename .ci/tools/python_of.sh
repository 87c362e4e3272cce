# Prints a Python of this version that runs, from the path (where pyenv's shims may fail) or from pyenv; otherwise
# prints $PYTHON.
python_of() {
  local candidate
  for candidate in "python$1" "$HOME"/.pyenv/versions/"$1".*/bin/python3; do
    if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  echo "no Python $1 at hand: $PYTHON ($("$PYTHON" --version)) is used instead" >&2
  printf '%s\n' "$PYTHON"
}
