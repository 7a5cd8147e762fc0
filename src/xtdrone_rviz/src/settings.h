/// What the parameters of the off-screen rviz ask.
#pragma once

#include <stdexcept>
#include <string>

namespace xtdrone_rviz {

/// A parameter that is not allowed; the text names it, its value and what is allowed.
class SettingsError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

struct Settings {
  std::string config;        ///< ~config: the .rviz file
  unsigned width = 0;        ///< ~width: pixels
  unsigned height = 0;       ///< ~height: pixels
  bool antialiasing = true;  ///< ~antialiasing: whether edges are smoothed
  double rate = 0.0;         ///< ~rate: frames a simulated second, Hz
  std::string film;          ///< ~film: file that ends with .mp4; empty: none
  double fps = 0.0;          ///< ~fps: frames a second of the film when it is played; by default ~rate
  std::string frames;        ///< ~frames: folder for a PNG of each frame; empty: none
  std::string display;       ///< ~display: an X display that is there, as :0; empty: an Xvfb of this node's own

  /// Reads the parameters.
  ///
  /// @throws SettingsError  One that is not allowed.
  static Settings fromParameters();
};

}  // namespace xtdrone_rviz
