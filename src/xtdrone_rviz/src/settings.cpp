#include "settings.h"

#include <ros/names.h>
#include <ros/param.h>

#include <cmath>
#include <sstream>

namespace xtdrone_rviz {
namespace {

constexpr double LEAST_SIZE = 64.0;   // pixels
constexpr double MOST_SIZE = 4096.0;  // pixels
constexpr double LEAST_RATE = 0.1;    // Hz
constexpr double MOST_RATE = 50.0;    // Hz of simulated time
constexpr double MOST_FPS = 120.0;    // of the film

[[noreturn]] void refuse(const std::string& name, const XmlRpc::XmlRpcValue& value, const std::string& allowed) {
  std::ostringstream text;
  value.write(text);
  throw SettingsError(ros::names::resolve(name) + ": '" + text.str() + "' is not allowed, " + allowed);
}

double number(const std::string& name, double otherwise, double least, double most, bool whole = false) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return otherwise;
  }
  std::ostringstream allowed;
  allowed << (whole ? "a whole number from " : "a number from ") << least << " to " << most;
  const bool is_int = value.getType() == XmlRpc::XmlRpcValue::TypeInt;
  if (!is_int && (whole || value.getType() != XmlRpc::XmlRpcValue::TypeDouble)) {
    refuse(name, value, allowed.str());
  }
  const double found = is_int ? static_cast<int>(value) : static_cast<double>(value);
  if (!(found >= least && found <= most)) {
    refuse(name, value, allowed.str());
  }
  return found;
}

bool flag(const std::string& name, bool otherwise) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return otherwise;
  }
  if (value.getType() != XmlRpc::XmlRpcValue::TypeBoolean) {
    refuse(name, value, "true or false");
  }
  return static_cast<bool>(value);
}

std::string text(const std::string& name) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return "";
  }
  if (value.getType() != XmlRpc::XmlRpcValue::TypeString) {
    refuse(name, value, "text");
  }
  return static_cast<std::string>(value);
}

bool endsWith(const std::string& name, const std::string& end) {
  return name.size() > end.size() && name.compare(name.size() - end.size(), end.size(), end) == 0;
}

}  // namespace

Settings Settings::fromParameters() {
  Settings settings;
  settings.config = text("~config");
  if (settings.config.empty()) {
    throw SettingsError(ros::names::resolve("~config") + ": is not set; the .rviz file that is to be drawn");
  }
  settings.width = static_cast<unsigned>(number("~width", 1280.0, LEAST_SIZE, MOST_SIZE, true));
  settings.height = static_cast<unsigned>(number("~height", 720.0, LEAST_SIZE, MOST_SIZE, true));
  settings.antialiasing = flag("~antialiasing", true);
  settings.rate = number("~rate", 30.0, LEAST_RATE, MOST_RATE);
  settings.fps = number("~fps", settings.rate, LEAST_RATE, MOST_FPS);
  settings.film = text("~film");
  if (!settings.film.empty() && !endsWith(settings.film, ".mp4")) {
    throw SettingsError(ros::names::resolve("~film") + ": '" + settings.film + "' is not allowed, it ends with .mp4");
  }
  settings.frames = text("~frames");
  settings.display = text("~display");
  return settings;
}

}  // namespace xtdrone_rviz
