/// Avoidance of all vehicles in one process: `avoid_cpp iris 9 vel` (type, number of vehicles, vel or accel).
///
/// The same as nodes/avoid.py in Python, for large swarms, and an example of a C++ node in the simulator's lockstep.
/// Followers take its topics when their parameter `~avoid` is `topic`.
///
/// Parameters:
///   ~ids (default `all`): whose avoidance to compute, as `3`, `0-4` or `1,3`.
///   ~avoid_radius (m, default 1.5).
///   /xtdrone/swarm_topic: a topic with the positions of all vehicles; empty: every vehicle's local_position/pose.

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/Vector3.h>
#include <ros/console.h>
#include <ros/init.h>
#include <ros/master.h>
#include <ros/param.h>
#include <std_msgs/Float64MultiArray.h>
#include <xtdrone_control/lockstep.h>
#include <xtdrone_coordination/avoidance.h>

#include <iostream>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "arguments.h"

namespace lockstep = xtdrone_control::lockstep;

namespace xtdrone_coordination {
namespace {

constexpr double RATE = 30.0;            // Hz
constexpr std::size_t SWARM_FIELDS = 6;  // numbers a vehicle in the swarm topic: x, y, z, vx, vy, vz; m, m/s, ENU

struct Settings {
  std::string kind;
  std::size_t count = 0;
  std::string mode;
  std::vector<std::size_t> ids;
  double radius = AVOIDANCE_RADIUS;
  std::string swarm_topic;
};

/// Returns a parameter as text, whatever its type.
std::optional<std::string> textParameter(const std::string& name) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return std::nullopt;
  }
  if (value.getType() == XmlRpc::XmlRpcValue::TypeString) {
    return static_cast<std::string>(value);
  }
  std::ostringstream text;
  value.write(text);
  return text.str();
}

double radiusParameter() {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get("~avoid_radius", value)) {
    return AVOIDANCE_RADIUS;
  }
  const bool whole = value.getType() == XmlRpc::XmlRpcValue::TypeInt;
  if (!whole && value.getType() != XmlRpc::XmlRpcValue::TypeDouble) {
    throw ArgumentError("avoid_radius: '" + *textParameter("~avoid_radius") + "' is not a finite number");
  }
  const double radius = whole ? static_cast<int>(value) : static_cast<double>(value);
  if (!std::isfinite(radius)) {
    throw ArgumentError("avoid_radius: " + std::to_string(radius) + " is not a finite number");
  }
  if (radius <= 0.0) {
    throw ArgumentError("avoid_radius: " + *textParameter("~avoid_radius") + " is not allowed, above 0");
  }
  return radius;
}

/// @param arguments  The program's own, without its name.
Settings readSettings(const ros::V_string& arguments) {
  if (arguments.size() != 3) {
    throw ArgumentError("3 arguments are needed, " + std::to_string(arguments.size()) + " were given");
  }
  Settings settings;
  settings.kind = arguments[0];
  settings.count = parseCount(arguments[1], settings.kind, textParameter("/xtdrone/fleet"));
  settings.mode = arguments[2];
  if (settings.mode != "vel" && settings.mode != "accel") {
    throw ArgumentError("mode: '" + settings.mode + "' is not allowed, one of vel, accel");
  }
  settings.ids = parseIds(textParameter("~ids").value_or("all"), settings.count - 1, "~ids");
  settings.radius = radiusParameter();
  settings.swarm_topic = textParameter("/xtdrone/swarm_topic").value_or("");
  return settings;
}

class AvoidanceNode {
 public:
  explicit AvoidanceNode(const Settings& settings) : settings_(settings), positions_(settings.count) {
    for (const std::size_t id : settings.ids) {
      const std::string topic = "/xtdrone/" + vehicle(id) + "/avoid_" + settings.mode;
      publishers_.push_back(lockstep::advertise<geometry_msgs::Vector3>(topic, 100));
    }
    lockstep::addResetHook([this] { positions_.assign(settings_.count, std::nullopt); });
    if (!settings.swarm_topic.empty()) {
      lockstep::subscribe<std_msgs::Float64MultiArray>(settings.swarm_topic, 0,
                                                       [this](const auto& message) { onSwarm(message.data); });
      return;
    }
    for (std::size_t i = 0; i < settings.count; ++i) {
      const std::string topic = "/" + vehicle(i) + "/mavros/local_position/pose";
      lockstep::subscribe<geometry_msgs::PoseStamped>(topic, 0, [this, i](const auto& message) {
        const auto& p = message.pose.position;
        onPosition(i, {p.x, p.y, p.z});
      });
    }
  }

  /// Publishes the avoidance of each vehicle whose position is known.
  void step() const {
    const auto velocities = avoid(settings_.ids, positions_, settings_.radius);
    for (std::size_t k = 0; k < publishers_.size(); ++k) {
      if (!positions_[settings_.ids[k]]) {
        continue;
      }
      geometry_msgs::Vector3 message;
      message.x = velocities[k][0];
      message.y = velocities[k][1];
      message.z = velocities[k][2];
      publishers_[k].publish(message);
    }
  }

 private:
  std::string vehicle(std::size_t id) const { return settings_.kind + "_" + std::to_string(id); }

  void onPosition(std::size_t index, const Vector& position) {
    if (std::isfinite(position[0] + position[1] + position[2])) {
      positions_[index] = position;
    }
  }

  void onSwarm(const std::vector<double>& data) {
    if (data.size() < SWARM_FIELDS * settings_.count) {
      ROS_WARN_THROTTLE(10.0, "%s: %zu numbers are too few for %zu vehicles", settings_.swarm_topic.c_str(),
                        data.size(), settings_.count);
      return;
    }
    for (std::size_t i = 0; i < settings_.count; ++i) {
      const double* values = data.data() + SWARM_FIELDS * i;
      onPosition(i, {values[0], values[1], values[2]});
    }
  }

  const Settings settings_;
  Positions positions_;
  std::vector<lockstep::Publisher<geometry_msgs::Vector3>> publishers_;
};

int run(int argc, char** argv) {
  ros::V_string arguments;
  ros::removeROSArgs(argc, argv, arguments);
  // This alone registers nothing: a wrong command line must not end the node that has this name now.
  ros::init(argc, argv, "avoid", ros::init_options::NoSigintHandler);
  if (!ros::master::check()) {
    std::cerr << "no ROS master at " << ros::master::getURI() << ": start roscore or a launch file first" << std::endl;
    return 1;
  }
  const Settings settings = readSettings({arguments.begin() + 1, arguments.end()});
  lockstep::init(argc, argv, "avoid", RATE);
  AvoidanceNode node(settings);
  lockstep::start();
  lockstep::spin([&node] { node.step(); });
  return lockstep::exitStatus();
}

}  // namespace
}  // namespace xtdrone_coordination

int main(int argc, char** argv) {
  try {
    return xtdrone_coordination::run(argc, argv);
  } catch (const xtdrone_coordination::ArgumentError& error) {
    std::cerr << error.what() << "\nusage: avoid_cpp TYPE NUM vel|accel" << std::endl;
    return 2;
  } catch (const std::exception& error) {  // a refusal, or a name that is none
    std::cerr << error.what() << std::endl;
    return 1;
  }
}
