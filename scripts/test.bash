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
# pybullet prints through C's own buffer, which empties after pytest's closing line unless it is kept by the line.
check "pytest" stdbuf -oL python -m pytest "$@"
exit "$worst"
