/// Avoidance of all vehicles in one process: `avoid_cpp iris 9 vel` (type, number of vehicles, vel or accel).
///
/// An example of a C++ node in lockstep, equal to nodes/avoid.py in Python; followers use its topics when their
/// parameter `~avoid` is `topic`.
///
/// Parameters:
///   ~ids (default `all`): vehicles to compute the avoidance of, as `3`, `0-4` or `1,3`.
///   ~avoid_radius (m, default 1.5).
///   /xtdrone/swarm_topic: a topic with the positions of all vehicles; empty: every vehicle's local_position/pose.

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/Vector3.h>
#include <ros/init.h>
#include <ros/master.h>
#include <ros/param.h>
#include <std_msgs/Float64MultiArray.h>
#include <xtdrone_coordination/avoidance.h>
#include <xtdrone_lockstep/lockstep.h>

#include <iostream>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>

namespace lockstep = xtdrone_lockstep;
using namespace xtdrone_coordination;

namespace {

constexpr double RATE = 30.0;            // Hz
constexpr std::size_t SWARM_FIELDS = 6;  // per vehicle in the swarm topic: x, y, z, vx, vy, vz; m, m/s, ENU

struct ArgumentError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// Returns the numbers in `text`, below `count`: `all`, or numbers and ranges separated by commas.
std::set<std::size_t> parseIds(const std::string& text, std::size_t count) {
  std::set<std::size_t> ids;
  std::istringstream parts(text == "all" ? "0-" + std::to_string(count - 1) : text);
  for (std::string part; std::getline(parts, part, ',');) {
    std::istringstream range(part);
    std::size_t low = 0, high = 0;
    char dash = '-';
    const bool valid = range >> low && ((high = low, range >> dash).eof() || (dash == '-' && range >> high));
    if (!valid || !(range >> std::ws).eof() || high < low || high >= count) {
      throw ArgumentError("~ids: '" + text + "' is not allowed, 0 to " + std::to_string(count - 1));
    }
    for (std::size_t id = low; id <= high; ++id) {
      ids.insert(id);
    }
  }
  return ids;
}

/// Returns a parameter as text, also if it is a number.
std::string textParameter(const std::string& name, const std::string& fallback) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return fallback;
  }
  std::ostringstream text;
  value.write(text);
  return value.getType() == XmlRpc::XmlRpcValue::TypeString ? static_cast<std::string>(value) : text.str();
}

class AvoidanceNode {
 public:
  AvoidanceNode(const std::string& kind, std::size_t count, const std::set<std::size_t>& ids, const std::string& mode,
                double radius)
      : radius_(radius), positions_(count) {
    for (const std::size_t id : ids) {
      const std::string topic = "/xtdrone/" + kind + "_" + std::to_string(id) + "/avoid_" + mode;
      publishers_[id] = lockstep::advertise<geometry_msgs::Vector3>(topic, 100);
    }
    lockstep::addResetHook([this] { positions_.assign(positions_.size(), std::nullopt); });
    const std::string swarm_topic = textParameter("/xtdrone/swarm_topic", "");
    if (!swarm_topic.empty()) {
      lockstep::subscribe<std_msgs::Float64MultiArray>(swarm_topic, 0, [this](const auto& message) {
        const std::size_t vehicles = message.data.size() < SWARM_FIELDS * positions_.size() ? 0 : positions_.size();
        for (std::size_t i = 0; i < vehicles; ++i) {
          const double* p = message.data.data() + SWARM_FIELDS * i;
          onPosition(i, {p[0], p[1], p[2]});
        }
      });
      return;
    }
    for (std::size_t i = 0; i < count; ++i) {
      const std::string topic = "/" + kind + "_" + std::to_string(i) + "/mavros/local_position/pose";
      lockstep::subscribe<geometry_msgs::PoseStamped>(topic, 0, [this, i](const auto& message) {
        const auto& p = message.pose.position;
        onPosition(i, {p.x, p.y, p.z});
      });
    }
  }

  /// Publishes the avoidance of each vehicle whose position is known.
  void step() const {
    for (const auto& [id, publisher] : publishers_) {
      if (positions_[id]) {
        geometry_msgs::Vector3 message;
        const Vector velocity = avoid(id, positions_, radius_);
        message.x = velocity[0];
        message.y = velocity[1];
        message.z = velocity[2];
        publisher.publish(message);
      }
    }
  }

 private:
  void onPosition(std::size_t index, const Vector& position) {
    if (std::isfinite(position[0] + position[1] + position[2])) {
      positions_[index] = position;
    }
  }

  double radius_;
  Positions positions_;
  std::map<std::size_t, lockstep::Publisher<geometry_msgs::Vector3>> publishers_;
};

void run(int argc, char** argv) {
  ros::V_string arguments;
  ros::removeROSArgs(argc, argv, arguments);
  ros::init(argc, argv, "avoid", ros::init_options::NoSigintHandler);  // registers nothing yet
  if (!ros::master::check()) {
    throw std::runtime_error("no ROS master at " + ros::master::getURI() + ": start roscore or a launch file first");
  }
  std::size_t count = 0;
  if (arguments.size() != 4 || !(std::istringstream(arguments[2]) >> count) || count < 2 || count > 250 ||
      (arguments[3] != "vel" && arguments[3] != "accel")) {
    throw ArgumentError("TYPE, NUM from 2 to 250, and vel or accel are needed");
  }
  double radius = AVOIDANCE_RADIUS;
  if (ros::param::has("~avoid_radius") &&
      (!ros::param::get("~avoid_radius", radius) || !std::isfinite(radius) || radius <= 0.0)) {
    throw ArgumentError("avoid_radius: a finite number above 0 is needed");
  }
  const auto ids = parseIds(textParameter("~ids", "all"), count);
  lockstep::init(argc, argv, "avoid", RATE);  // from here on this process is the node
  AvoidanceNode node(arguments[1], count, ids, arguments[3], radius);
  lockstep::start();
  lockstep::spin([&node] { node.step(); });
}

}  // namespace

int main(int argc, char** argv) {
  try {
    run(argc, argv);
    return lockstep::exitStatus();
  } catch (const ArgumentError& error) {
    std::cerr << error.what() << "\nusage: avoid_cpp TYPE NUM vel|accel" << std::endl;
    return 2;
  } catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
}
