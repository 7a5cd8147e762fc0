/// Pictures in memory and PNG files.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace xtdrone_rviz {

/// RGB, 8 bits per channel, rows from the top, without padding.
struct Picture {
  unsigned width = 0;
  unsigned height = 0;
  std::vector<std::uint8_t> data;

  Picture(unsigned width_, unsigned height_) : width(width_), height(height_), data(3UL * width_ * height_) {}

  /// Returns whether every pixel has the same colour, as in an empty view.
  bool plain() const;
};

/// Writes a PNG file atomically.
///
/// @throws std::runtime_error  The file cannot be written.
void writePng(const Picture& picture, const std::string& path);

}  // namespace xtdrone_rviz
