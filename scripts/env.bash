# To be sourced: the environment in which the workspace runs. Another ROS or Python of the user's stays out of it.

xtdrone_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"

unset PYTHONPATH PYTHONHOME ROS_PACKAGE_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH PKG_CONFIG_PATH ROSLISP_PACKAGE_DIRECTORIES

# catkin's set-up scripts read variables that may not be set.
xtdrone_nounset="$(shopt -po nounset || true)"
set +u
# In a function, so that catkin's script does not take this script's arguments for its own.
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

# Neither ROS nor MAVLink asks who calls (docs/multi-machine.md), so master and nodes listen on this machine alone unless
# an address is named. A master on another machine has to call back, at an address that only the user knows.
if [[ -z ${ROS_IP:-}${ROS_HOSTNAME:-} ]]; then
  if [[ ${ROS_MASTER_URI:-http://localhost} =~ ^https?://(localhost|127\.[0-9.]+|\[::1\])(:|/|$) ]]; then
    export ROS_IP=127.0.0.1
  else
    echo "xtdrone: ROS_MASTER_URI is $ROS_MASTER_URI: for a master on another machine, export ROS_IP=ADDRESS, this" \
      "machine's as the other one reaches it (docs/multi-machine.md)" >&2
  fi
fi
