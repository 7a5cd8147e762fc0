/// A picture in memory, and as a file.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace xtdrone_rviz {

/// RGB, 8 bits a channel, rows from the top, without gaps.
struct Picture {
  unsigned width = 0;
  unsigned height = 0;
  std::vector<std::uint8_t> data;

  Picture(unsigned width_, unsigned height_) : width(width_), height(height_), data(3UL * width_ * height_) {}

  /// Whether every pixel has the same colour: a view that shows nothing.
  bool plain() const;
};

/// Writes a PNG file; it is there whole or not at all.
///
/// @throws std::runtime_error  The file cannot be written.
void writePng(const Picture& picture, const std::string& path);

}  // namespace xtdrone_rviz
