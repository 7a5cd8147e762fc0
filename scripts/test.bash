#!/usr/bin/env bash
# Style, types and tests; runs in the environment of env.bash. Arguments go to pytest. Ends with the worst status.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

worst=0

# Runs one check after saying its name, and remembers how it ended.
check() {
  local title="$1" status=0
  shift
  echo "== $title"
  "$@" || status=$?
  ((status <= worst)) || worst=$status
}

mapfile -t cpp < <(git ls-files --cached --others --exclude-standard -- '*.cpp' '*.h' '*.hpp')

check "ruff check" ruff check .
check "ruff format" ruff format --check .
check "mypy" mypy
((${#cpp[@]} == 0)) || check "clang-format" clang-format --dry-run --Werror "${cpp[@]}"
lint=$worst
((lint == 0)) || echo "== a check above failed (status $lint); the tests run all the same"
# Tests that fail are run once more, by themselves: a machine that stood still for a while is no fault of theirs. What
# passes then is named, for it is unsteady and is to be mended.
run_tests() {
  local status=0 names
  # pybullet prints through C's own buffer, which empties after pytest's closing line unless it is kept by the line.
  stdbuf -oL python -m pytest "$@" || status=$?
  ((status == 1)) || return "$status"
  names="$(python -m pytest --collect-only -q --last-failed "$@" 2>/dev/null | grep :: | head -n 20 || true)"
  echo "== pytest: once more what failed"
  stdbuf -oL python -m pytest --last-failed "$@" || return
  echo "== pytest: failed once and passed alone, to be mended:"
  printf '%s\n' "$names"
}
check "pytest" run_tests "$@"
exit "$worst"
