#!/usr/bin/env bash
# Style, types and tests in stages; runs in the environment of env.bash. Arguments go to pytest. Without them, all tests
# run, in parallel if possible: those of packages ("unit"), then those of the running system ("system"). With --fast, only
# style, types and the quick tests without a ROS master run; with --store-seconds, all run and tests/seconds.txt, by which
# --fast chooses, is written (conftest.py). Each stage prints its name and time; the last line lists the failed ones. Ends
# with the worst status.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

readonly MOST_WORKERS=8 # each may hold 2 GB

# Tests read what programs print while these run; a pipe would hold it back in a buffer.
export PYTHONUNBUFFERED=1

worst=0
failed=()

# Prints the name of a stage, runs it, prints its time, and keeps the worst status.
stage() {
  local title="$1" status=0 begin=$SECONDS
  shift
  echo "== $title"
  "$@" || status=$?
  echo "== $title: $((SECONDS - begin)) s$( ((status == 0)) || echo ", failed (status $status)")"
  ((status == 0)) || failed+=("$title")
  ((status <= worst)) || worst=$status
}

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

# Prints the path of each folder with tests of a package.
unit_folders() {
  local folder
  for folder in src/*/tests src/msgs/*/tests benchmarks/tests validation/tests; do
    [[ ! -d $folder ]] || echo "$folder"
  done
}

# Runs tests in parallel. Files with failed tests run a second time, one by one, because the machine may have been
# suspended; whole files, because a test may build on those before it. Tests that pass then are listed: they are unstable
# and need a fix.
run_all() {
  local status=0 names files workers=()
  choose_workers
  # pybullet prints through C's buffer, which is flushed after pytest's last line unless it is line-buffered.
  stdbuf -oL python -m pytest "${workers[@]}" "$@" || status=$?
  ((status == 1)) || return "$status"
  names="$(python -m pytest --collect-only -q --last-failed "$@" 2>/dev/null | grep :: || true)"
  mapfile -t files < <(sed 's/::.*//' <<<"$names" | sort -u)
  ((${#files[@]} <= MOST_FILES_AGAIN)) || return "$status"
  echo "== pytest: second run of the files with failed tests"
  stdbuf -oL python -m pytest "${files[@]}" || return
  echo "== pytest: failed once and passed alone; unstable:"
  printf '%s\n' "$names"
}

mapfile -t cpp < <(git ls-files --cached --others --exclude-standard -- '*.cpp' '*.h' '*.hpp')

stage "style: ruff check" ruff check .
stage "style: ruff format" ruff format --check .
((${#cpp[@]} == 0)) || stage "style: clang-format" clang-format --dry-run --Werror "${cpp[@]}"
stage "types: mypy" mypy
((worst == 0)) || echo "== a check above failed (status $worst); the tests run all the same"

if (($# == 0)) || [[ $* == --store-seconds ]]; then
  mapfile -t folders < <(unit_folders)
  stage "unit tests" run_all "$@" "${folders[@]}"
  stage "system tests" run_all "$@" tests
elif [[ $* == --fast ]]; then
  stage "fast tests" run_all --fast
else
  stage "tests" stdbuf -oL python -m pytest "$@"
fi
if ((${#failed[@]} > 0)); then
  echo "== failed: $(printf '%s; ' "${failed[@]}")"
else
  echo "== all stages passed"
fi
exit "$worst"
