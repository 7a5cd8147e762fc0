#!/usr/bin/env bash
# Style, types and tests; runs in the environment of env.bash. Arguments go to pytest; without them, all tests run, in
# parallel if possible. Ends with the worst status.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

readonly MOST_WORKERS=8 # each may hold 2 GB

# Tests read what programs print while these run; a pipe would hold it back in a buffer.
export PYTHONUNBUFFERED=1

worst=0

# Prints the name of a check, runs it and keeps the worst status.
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
# Sets the array "workers" to pytest's options for parallel workers. Each has a network of its own (conftest.py), which
# needs root's rights. Tests often wait for processes and clients: there is one worker more than cores.
choose_workers() {
  local count
  count=$(($(nproc) + 1))
  workers=()
  if unshare --net true 2>/dev/null; then
    workers=(-n "$((count < MOST_WORKERS ? count : MOST_WORKERS))")
  else
    echo "xtdrone: one test at a time: parallel ones need network namespaces, which root can make" >&2
  fi
}

readonly MOST_FILES_AGAIN=12 # more are not the machine's fault

# Runs the tests. Without arguments, files with failed tests run a second time, one by one, because the machine may have
# been suspended; whole files, because a test may build on those before it. Tests that pass then are listed: they are
# unstable and need a fix.
run_tests() {
  local status=0 names files workers=()
  (($# > 0)) || choose_workers
  # pybullet prints through C's buffer, which is flushed after pytest's last line unless it is line-buffered.
  stdbuf -oL python -m pytest "${workers[@]}" "$@" || status=$?
  (($# == 0 && status == 1)) || return "$status"
  names="$(python -m pytest --collect-only -q --last-failed 2>/dev/null | grep :: || true)"
  mapfile -t files < <(sed 's/::.*//' <<<"$names" | sort -u)
  ((${#files[@]} <= MOST_FILES_AGAIN)) || return "$status"
  echo "== pytest: second run of the files with failed tests"
  stdbuf -oL python -m pytest "${files[@]}" || return
  echo "== pytest: failed once and passed alone; unstable:"
  printf '%s\n' "$names"
}
check "pytest" run_tests "$@"
exit "$worst"
