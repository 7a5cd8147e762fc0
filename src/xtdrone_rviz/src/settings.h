/// Parameters of the off-screen rviz.
#pragma once

#include <stdexcept>
#include <string>

namespace xtdrone_rviz {

/// An invalid parameter; the text names it, its value and the allowed values.
class SettingsError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

struct Settings {
  std::string config;        ///< ~config: the .rviz file
  unsigned width = 0;        ///< ~width: pixels
  unsigned height = 0;       ///< ~height: pixels
  bool antialiasing = true;  ///< ~antialiasing: whether edges are smoothed
  double rate = 0.0;         ///< ~rate: frames per simulated second, Hz
  std::string film;          ///< ~film: file that ends with .mp4; empty: none
  double fps = 0.0;          ///< ~fps: frame rate of the film; by default ~rate
  std::string frames;        ///< ~frames: folder for a PNG of each frame; empty: none
  std::string display;       ///< ~display: an existing X display, such as :0; empty: a separate Xvfb

  /// Reads the parameters.
  ///
  /// @throws SettingsError  A parameter is invalid.
  static Settings fromParameters();
};

}  // namespace xtdrone_rviz
