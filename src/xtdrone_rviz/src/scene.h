/// rviz without its window's frame: a configuration's displays and view, drawn when asked to.
#pragma once

#include <tf2_msgs/TFMessage.h>
#include <topic_tools/shape_shifter.h>

#include <array>
#include <memory>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "picture.h"

namespace xtdrone_rviz {

/// A configuration that cannot be used; the text names the file and says why.
class ConfigError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// No picture can be drawn here; the text says why.
class DisplayError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The view's camera.
struct Camera {
  std::array<double, 3> position;     ///< in the fixed frame, m
  std::array<double, 4> orientation;  ///< (x, y, z, w) of the optical frame: z ahead, x right, y down
  double focal_length;                ///< pixels
};

/// The displays of one .rviz file. There can be one scene in a process.
class Scene {
 public:
  /// Opens a window on the display that the environment variable DISPLAY names; ROS must be started.
  ///
  /// @param config        The .rviz file.
  /// @param antialiasing  Whether edges are smoothed.
  /// @throws ConfigError   The file cannot be used.
  /// @throws DisplayError  OpenGL cannot be had there.
  Scene(const std::string& config, unsigned width, unsigned height, bool antialiasing);
  ~Scene();
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;

  /// The topics that its displays show. The displays themselves subscribe to others of this node's own, so that they
  /// get what the lockstep has dispatched and nothing sooner; give it to them by show().
  std::set<std::string> topics() const;
  /// Makes the displays, which subscribe.
  ///
  /// @return What is left out: a line for each display that this rviz does not know, or that has a panel of its own.
  /// @throws ConfigError  This rviz does not know the view.
  std::vector<std::string> load();
  /// Passes a message on to the displays of its topic; draw() shows it.
  void show(const std::string& topic, const topic_tools::ShapeShifter& message);
  /// Takes transforms in.
  void place(const tf2_msgs::TFMessage& message, bool fixed);
  const std::string& fixedFrame() const;
  /// Whether TF knows the fixed frame: before, nothing has a place.
  bool ready() const;
  /// Forgets what was shown, for time has gone back.
  void reset();
  /// Takes in what has come and draws it.
  void draw(Picture& picture);
  Camera camera() const;

 private:
  struct Parts;
  std::unique_ptr<Parts> parts_;
};

}  // namespace xtdrone_rviz
