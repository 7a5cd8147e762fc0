# Lets `rosrun mavros mavsys` find our programs. They come last on the path: a real MAVROS of any workspace hides them.
@[if DEVELSPACE]@
_xtdrone_mavros="@(PROJECT_SOURCE_DIR)/mavros"
@[else]@
_xtdrone_mavros="$CATKIN_ENV_HOOK_WORKSPACE/share/@(PROJECT_NAME)/mavros"
@[end if]@
case ":$ROS_PACKAGE_PATH:" in
  *":$_xtdrone_mavros:"*) ;;
  *) export ROS_PACKAGE_PATH="$ROS_PACKAGE_PATH:$_xtdrone_mavros" ;;
esac
unset _xtdrone_mavros
