# Source this file: it sets the environment of the workspace, without the user's other ROS or Python installations.

xtdrone_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"

unset PYTHONPATH PYTHONHOME ROS_PACKAGE_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH PKG_CONFIG_PATH ROSLISP_PACKAGE_DIRECTORIES

# catkin's set-up scripts write a file there.
if [[ -n ${TMPDIR:-} && ! (-d $TMPDIR && -w $TMPDIR) ]]; then
  echo "xtdrone: TMPDIR is $TMPDIR, which is not there or cannot be written to; temporary files go to /tmp" >&2
  unset TMPDIR
fi
if [[ ! -w ${TMPDIR:-/tmp} ]]; then
  echo "xtdrone: /tmp cannot be written to by $(id -un); set TMPDIR to a folder that can" >&2
  return 1
fi

# catkin's set-up scripts read variables that may not be set.
xtdrone_nounset="$(shopt -po nounset || true)"
set +u
# In a function, so that catkin's script does not read this script's arguments.
xtdrone_source() {
  # shellcheck disable=SC1091
  source "$xtdrone_root/devel/setup.bash"
}
xtdrone_source
unset -f xtdrone_source
eval "$xtdrone_nounset"
unset xtdrone_nounset

export VIRTUAL_ENV="$xtdrone_root/.venv"
export PATH="$VIRTUAL_ENV/bin:$PATH"
# The packages beside src/, benchmarks and validation, are not built.
export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}$xtdrone_root"

# Compiled kernels are kept in the user's cache; without it, every start would take minutes.
xtdrone_cache="${XDG_CACHE_HOME:-${HOME:-$(echo ~)}/.cache}"
if ! mkdir -p "$xtdrone_cache/xtdrone" 2>/dev/null || [[ ! -w $xtdrone_cache/xtdrone ]]; then
  export XDG_CACHE_HOME="$xtdrone_root/.setup/cache"
  echo "xtdrone: $xtdrone_cache cannot be written to; compiled kernels are kept in $XDG_CACHE_HOME" >&2
fi
unset xtdrone_cache

# ROS and MAVLink do not authenticate clients (docs/simulation.md), so master and nodes listen on this machine only,
# unless an address is given. A master on another machine connects back to an address that only the user knows.
if [[ -z ${ROS_IP:-}${ROS_HOSTNAME:-} ]]; then
  if [[ ${ROS_MASTER_URI:-http://localhost} =~ ^https?://(localhost|127\.[0-9.]+|\[::1\])(:|/|$) ]]; then
    export ROS_IP=127.0.0.1
  else
    echo "xtdrone: ROS_MASTER_URI is $ROS_MASTER_URI: for a master on another machine, export ROS_IP=ADDRESS, this" \
      "machine's as the other one reaches it (docs/simulation.md)" >&2
  fi
fi
