/// rviz without its main window: a configuration's displays and view, drawn on request.
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

/// An invalid configuration; the text names the file and the reason.
class ConfigError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// No picture can be drawn here; the text has the reason.
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

/// The displays of one .rviz file; at most one scene per process.
class Scene {
 public:
  /// Opens a window on the display that the environment variable DISPLAY names; ROS must be started.
  ///
  /// @param config        The .rviz file.
  /// @param antialiasing  Whether edges are smoothed.
  /// @throws ConfigError   The file is invalid.
  /// @throws DisplayError  OpenGL is not available.
  Scene(const std::string& config, unsigned width, unsigned height, bool antialiasing);
  ~Scene();
  Scene(const Scene&) = delete;
  Scene& operator=(const Scene&) = delete;

  /// Returns the topics that its displays show. The displays subscribe to relays within this node, so that they receive
  /// a message only after the lockstep has dispatched it; pass it on by show().
  std::set<std::string> topics() const;
  /// Creates the displays, which subscribe.
  ///
  /// @return One line for each omitted display: unknown to this rviz, or with a separate panel.
  /// @throws ConfigError  This rviz has no such view.
  std::vector<std::string> load();
  /// Passes a message on to the displays of its topic; draw() shows it.
  void show(const std::string& topic, const topic_tools::ShapeShifter& message);
  /// Adds transforms.
  void place(const tf2_msgs::TFMessage& message, bool fixed);
  const std::string& fixedFrame() const;
  /// Returns whether TF has the fixed frame; without it nothing can be drawn.
  bool ready() const;
  /// Clears the displays after a reset of time.
  void reset();
  /// Processes the received messages and draws a frame.
  void draw(Picture& picture);
  Camera camera() const;

 private:
  struct Parts;
  std::unique_ptr<Parts> parts_;
};

}  // namespace xtdrone_rviz
