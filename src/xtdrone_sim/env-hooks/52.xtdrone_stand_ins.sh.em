# Lets `$(find px4)` and the like in XTDrone's launch files find our stand-ins. They come last on the path: a real package
# of any workspace hides them. XTDRONE_STAND_INS=off leaves them out.
@[if DEVELSPACE]@
_xtdrone_stand_ins="@(PROJECT_SOURCE_DIR)/stand_ins"
@[else]@
_xtdrone_stand_ins="$CATKIN_ENV_HOOK_WORKSPACE/share/@(PROJECT_NAME)/stand_ins"
@[end if]@
for _xtdrone_stand_in in px4 gazebo_ros mavlink_sitl_gazebo media_export; do
  case "$XTDRONE_STAND_INS:$ROS_PACKAGE_PATH:" in
    off:* | *":$_xtdrone_stand_ins/$_xtdrone_stand_in:"*) ;;
    *) export ROS_PACKAGE_PATH="$ROS_PACKAGE_PATH:$_xtdrone_stand_ins/$_xtdrone_stand_in" ;;
  esac
done
unset _xtdrone_stand_ins _xtdrone_stand_in
