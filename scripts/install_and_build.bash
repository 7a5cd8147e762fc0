# Sourced by ../xtdrone: installs and builds missing parts. `root` is the repository's folder.

# shellcheck disable=SC2154
readonly state_dir="$root/.setup"
readonly venv="$root/.venv"

# ---- stamps: files that state from what a part was made

# is_written FILE TEXT
is_written() {
  [[ -f $1 && $(<"$1") == "$2" ]]
}

# write_stamp FILE TEXT: whole or not at all.
write_stamp() {
  printf '%s' "$2" >"$1.part"
  mv "$1.part" "$1"
}

# ---- messages and logs

say() {
  echo "xtdrone: $*"
}

fail() {
  echo "xtdrone: $*" >&2
  hand_over "$state_dir" "$venv" "$root/build" "$root/devel"
  exit 1
}

# Prints the last line of a log periodically until it is killed: in place on a terminal, rarely otherwise.
watch_log() {
  local log="$1" began=$SECONDS line quiet
  # A pipe without a writer: waiting on it starts no process that would outlive this one.
  exec {quiet}<> <(:)
  while :; do
    if [[ -t 1 ]]; then
      read -r -t 0.5 -u "$quiet" || true
      line="$(tail -n 1 "$log" | tr -dc '[:print:]')"
      printf '\r\033[K  %4d s  %.*s' $((SECONDS - began)) $((${COLUMNS:-80} - 12)) "$line"
    else
      read -r -t 20 -u "$quiet" || true
      line="$(tail -n 1 "$log" | tr -dc '[:print:]')"
      printf '  %4d s  %.100s\n' $((SECONDS - began)) "$line"
    fi
  done
}

# logged NAME COMMAND...: runs the command with its output in a log; on failure shows the log's end.
logged() {
  local log="$state_dir/logs/$1.log" status=0 watcher
  shift
  : >"$log"
  watch_log "$log" 9>&- &
  watcher=$!
  # shellcheck disable=SC2064
  trap "kill $watcher 2>/dev/null || true" EXIT
  "$@" >"$log" 2>&1 </dev/null 9>&- || status=$?
  kill "$watcher" 2>/dev/null || true
  wait "$watcher" 2>/dev/null || true
  trap - EXIT
  [[ ! -t 1 ]] || printf '\r\033[K'
  ((status == 0)) && return
  {
    echo "xtdrone: failed with status $status: $*"
    echo "xtdrone: the last lines of $log:"
    tail -n 20 "$log" | sed 's/^/  | /'
  } >&2
  return "$status"
}

# After a set-up by root, gives files in a tree of another user to that user; missing paths are skipped.
hand_over() {
  [[ $EUID -eq 0 && $(stat -c %u "$root") -ne 0 ]] || return 0
  local path
  for path in "$@"; do
    [[ ! -e $path ]] || chown -R --reference="$root" "$path"
  done
}

# The build's tools (catkin, roslaunch) end a path at a blank, and interpret other characters.
check_place() {
  local strange="${root//[^][:space:]\"\'\`\\$&;:()<>|*?{\}!#%[]/}"
  [[ -z $strange ]] ||
    fail "the folder '$root' has '${strange:0:1}' in its path, which ROS's build does not support; move or clone it to another"
  [[ -w $root ]] || fail "the folder $root cannot be written to by $(id -un); clone the repository to a folder of your own"
}

# ---- Debian packages

list_packages() {
  sed -E 's/#.*//; /^[[:space:]]*$/d' "$root"/scripts/packages/*.txt
}

missing_packages() {
  local wanted
  mapfile -t wanted < <(list_packages)
  # dpkg-query prints an error for unknown packages: they are missing, too.
  comm -23 <(printf '%s\n' "${wanted[@]}" | sort -u) \
    <(dpkg-query -W -f '${db:Status-Status} ${Package}\n' "${wanted[@]}" 2>/dev/null | sed -n 's/^installed //p' | sort -u)
}

as_root() {
  if [[ $EUID -eq 0 ]]; then
    env "$@"
  else
    sudo -n env "$@"
  fi
}

# Obtains root's rights, or fails with the command to run as root.
need_root() {
  [[ $EUID -ne 0 ]] || return 0
  local way="have root run: apt-get update && apt-get install -y --no-install-recommends $*"
  command -v sudo >/dev/null || fail "Debian packages are missing, you are not root and there is no sudo; $way"
  # Ask for the password here, on the terminal: the output of the following steps goes to a log.
  sudo -n true 2>/dev/null || { [[ -t 0 ]] && sudo -v; } || fail "Debian packages are missing and sudo refuses; $way"
}

apt() {
  as_root DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=600 -o Dpkg::Use-Pty=0 \
    -o Dpkg::Options::=--force-confdef -o Dpkg::Options::=--force-confold "$@"
}

install_packages() {
  command -v dpkg-query >/dev/null ||
    fail "this set-up is for Debian 12; with a ROS Noetic of your own, build with catkin_make (see CONTRIBUTING.md)"
  local missing
  mapfile -t missing < <(missing_packages)
  need_root "${missing[@]}"
  say "Debian packages: reading the package lists"
  logged apt-update apt update || fail "the package lists could not be read; is there a network?"
  # After an interrupted installation, unpacked packages must be configured first.
  logged dpkg-configure as_root DEBIAN_FRONTEND=noninteractive dpkg --configure -a || fail "dpkg could not be repaired"
  say "Debian packages: installing ${#missing[@]}: ${missing[*]}"
  logged apt-install apt install -y --no-install-recommends "${missing[@]}" ||
    fail "Debian packages could not be installed; this needs Debian 12 and a network"
}

# ---- Python packages

# The file that exists while pip changes the virtual environment.
readonly pip_at_work="$venv/.pip-at-work"

# has_python NAME: whether the requirements of the list NAME.txt are installed in the virtual environment.
has_python() {
  is_written "$venv/.$1.installed" "$(cat "$root/$1.txt")"
}

# install_python NAME: installs the requirements of the list NAME.txt into the virtual environment.
install_python() {
  say "Python packages: installing what is missing of $1.txt into .venv"
  : >"$pip_at_work"
  logged "pip-$1" "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --progress-bar off -r "$root/$1.txt" || {
    # Ctrl-C ends pip like an error. Only a pip that has not begun to install has left the environment as it was.
    grep -q '^Installing collected packages' "$state_dir/logs/pip-$1.log" || rm "$pip_at_work"
    fail "Python packages could not be installed; is there a network?"
  }
  write_stamp "$venv/.$1.installed" "$(cat "$root/$1.txt")"
  rm "$pip_at_work"
  hand_over "$venv"
}

# A virtual environment has its folder's path in many files, so after a move it is created again. So it is after an
# interrupted pip, which may have left packages that it believes to be complete.
has_venv() {
  is_written "$venv/.made-for" "$venv" && [[ -x $venv/bin/python && ! -e $pip_at_work ]]
}

make_venv() {
  [[ ! -e $pip_at_work ]] || say "Python packages: an installation was interrupted; it is repeated from the start"
  say "Python packages: creating the virtual environment .venv"
  rm -rf "$venv"
  logged venv /usr/bin/python3 -m venv --system-site-packages "$venv" || fail "the virtual environment could not be created"
  write_stamp "$venv/.made-for" "$venv"
}

# ---- the build

# digest NAME-PATTERN...: one hash over the names and contents of the matching files under src/.
digest() {
  local tests=() pattern
  for pattern in "$@"; do
    tests+=(-o -name "$pattern")
  done
  (
    cd "$root" || exit
    find CMakeLists.txt src -type f \( -false "${tests[@]}" \) -print0 | LC_ALL=C sort -z | xargs -0 sha256sum | sha256sum
    # The build depends on a node's name only; its content is read at its start.
    find src -type f \( -path '*/nodes/*' -o -path '*/examples/*.py' \) ! -name '*.pyc' | LC_ALL=C sort | sha256sum
  )
}

configure_and_make() {
  # The user's other ROS or Python installations must not get into catkin's files.
  local clean=(env -u PYTHONPATH -u PYTHONHOME -u ROS_PACKAGE_PATH -u CMAKE_PREFIX_PATH -u LD_LIBRARY_PATH
    PATH="$venv/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin")
  "${clean[@]}" cmake -S "$root" -B "$root/build" &&
    "${clean[@]}" make --no-print-directory -C "$root/build" -j2
}

built_from() {
  echo "$root $(digest CMakeLists.txt package.xml setup.py '*.msg' '*.srv' '*.action' '*.cpp' '*.h')"
}

is_built() {
  [[ -f $root/devel/setup.bash ]] && is_written "$state_dir/built" "$(built_from)"
}

# The file that exists during a build, with the time of its start.
readonly make_at_work="$state_dir/make-at-work"

# Removes what a killed build has written: make believes its last files to be complete.
remove_unfinished() {
  [[ -e $make_at_work && -d $root/build && -d $root/devel ]] || return 0
  find "$root/build" -newer "$make_at_work" -type f -name '*.[ao]' -delete
  find "$root/devel" -newer "$make_at_work" -type f -delete
}

build_workspace() {
  say "workspace: building"
  remove_unfinished
  # CMake rejects a build folder that was created elsewhere.
  if [[ -f $root/build/CMakeCache.txt ]] && ! grep -qxF "CMAKE_HOME_DIRECTORY:INTERNAL=$root" "$root/build/CMakeCache.txt"; then
    rm -rf "$root/build" "$root/devel"
  fi
  local sources; sources=$(built_from)  # of now: what changes during the build is built the next time
  rm -f "$state_dir/built"
  : >"$make_at_work"
  logged build configure_and_make || {
    # After an error of the compiler all other files are good; after a signal the last ones may not be.
    grep -qE ' (Interrupt|Terminated|Killed|Hangup)$' "$state_dir/logs/build.log" || rm "$make_at_work"
    fail "the workspace could not be built"
  }
  write_stamp "$state_dir/built" "$sources"
  rm "$make_at_work"
  hand_over "$root/build" "$root/devel"
}

# ---- kernels

are_kernels_prepared() {
  is_written "$state_dir/prepared" "$(digest '*.py')"
}

# Compiles the Python modules and the numba kernels in advance, so that the first flight does not wait for them; where
# PYTHONDONTWRITEBYTECODE is set, every start would compile the modules.
prepare_kernels() {
  say "kernels: compiling those that changed"
  "$venv/bin/python" -m compileall -q "$root/src" "$root/devel/lib/python3" || true  # a module with an error says so itself
  # shellcheck disable=SC2016
  if logged kernels bash -c 'source "$1/scripts/env.bash" || exit
    python -m xtdrone_planning.compile_kernels & planning=$!
    trap "kill $planning 2>/dev/null" EXIT
    python -m xtdrone_swarm.compile_kernels && wait "$planning"' _ "$root"; then
    write_stamp "$state_dir/prepared" "$(digest '*.py')"
    hand_over "$root/src"
  else
    say "kernels: not compiled ahead; they are compiled when first used" >&2
  fi
}

# ---- completion

completed_from() {
  (cd "$root" && find src benchmarks validation scripts/commands.txt -name '*.py' -o -name commands.txt |
    LC_ALL=C sort | xargs -d '\n' sha256sum | sha256sum)
}

has_completion() {
  is_written "$state_dir/completed" "$(completed_from)"
}

# Writes the bash completion that the shell of './xtdrone shell' reads.
write_completion() {
  # shellcheck disable=SC2016
  if bash -c 'source "$1/scripts/env.bash" && exec python -m xtdrone_interaction completion bash' _ "$root" \
    >"$state_dir/completion.bash.part" 2>"$state_dir/logs/completion.log"; then
    mv "$state_dir/completion.bash.part" "$state_dir/completion.bash"
    write_stamp "$state_dir/completed" "$(completed_from)"
  fi
}

# ---- entry point

# is_set_up COMMAND: whether all parts that the command needs are there. Another set-up may be at work: it adds parts.
is_set_up() {
  [[ -z $(missing_packages) ]] && has_venv && has_python requirements || return 1
  [[ $1 != test ]] || has_python requirements-dev || return 1
  is_built && are_kernels_prepared || return 1
  [[ $1 != shell ]] || has_completion
}

# set_up COMMAND: installs and builds the parts that the command needs.
set_up() {
  check_place
  ! is_set_up "$1" || return 0
  mkdir -p "$state_dir/logs"
  exec 9>"$state_dir/lock"
  if ! flock -n 9; then
    say "another set-up is running in this folder; waiting for it"
    flock 9
  fi
  [[ -z $(missing_packages) ]] || install_packages
  has_venv || make_venv
  has_python requirements || install_python requirements
  [[ $1 != test ]] || has_python requirements-dev || install_python requirements-dev
  is_built || build_workspace
  are_kernels_prepared || prepare_kernels
  [[ $1 != shell ]] || has_completion || write_completion
  hand_over "$state_dir"
  exec 9>&-
}
