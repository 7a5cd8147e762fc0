# Lets `rosrun mavros mavsys` and `$(find mavros)/launch/px4.launch` find ours. They come last on the path: a real MAVROS of
# any workspace hides them. XTDRONE_STAND_INS=off leaves them out.
@[if DEVELSPACE]@
_xtdrone_mavros="@(PROJECT_SOURCE_DIR)/mavros"
@[else]@
_xtdrone_mavros="$CATKIN_ENV_HOOK_WORKSPACE/share/@(PROJECT_NAME)/mavros"
@[end if]@
case "$XTDRONE_STAND_INS:$ROS_PACKAGE_PATH:" in
  off:* | *":$_xtdrone_mavros:"*) ;;
  *) export ROS_PACKAGE_PATH="$ROS_PACKAGE_PATH:$_xtdrone_mavros" ;;
esac
unset _xtdrone_mavros
