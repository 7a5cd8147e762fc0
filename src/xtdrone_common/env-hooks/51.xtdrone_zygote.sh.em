# Launch files start Python nodes through it, see xtdrone_common/programs/zygote.py; empty: each by an interpreter of its own.
@[if DEVELSPACE]@
export XTDRONE_NODE_LAUNCHER="@(CATKIN_DEVEL_PREFIX)/lib/@(PROJECT_NAME)/node_launcher"
@[else]@
export XTDRONE_NODE_LAUNCHER="$CATKIN_ENV_HOOK_WORKSPACE/lib/@(PROJECT_NAME)/node_launcher"
@[end if]@
