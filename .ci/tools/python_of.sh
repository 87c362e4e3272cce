# A Python of this version: on the path, where pyenv's may stand and not run, or pyenv's own; $PYTHON if there is none.
python_of() {
  local candidate
  for candidate in "python$1" "$HOME"/.pyenv/versions/"$1".*/bin/python3; do
    if "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  echo "no Python $1 at hand: $PYTHON ($("$PYTHON" --version)) takes its place" >&2
  printf '%s\n' "$PYTHON"
}
