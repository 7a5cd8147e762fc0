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

# Nodes tell each other the host's name. Where that leads nowhere, as in bare containers, a machine would not even find
# itself.
if [[ -z ${ROS_IP:-}${ROS_HOSTNAME:-} ]] && ! timeout 5 getent hosts "$HOSTNAME" >/dev/null; then
  export ROS_IP=127.0.0.1
fi
