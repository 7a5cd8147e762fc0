/// A film written picture by picture.
#pragma once

#include <memory>
#include <string>

#include "child_process.h"
#include "picture.h"

namespace xtdrone_rviz {

/// An MP4 (H.264, 4:2:0) by ffmpeg, which reads raw pictures from a pipe. It is written to a hidden file and moved to
/// its path by finish(), so that a film at its path is complete. If this process dies, ffmpeg still finishes the film
/// so far.
class Film {
 public:
  /// @param path  Ends with .mp4.
  /// @param fps   Pictures per second.
  /// @throws ProcessError        ffmpeg is not installed.
  /// @throws std::runtime_error  The film cannot be written.
  Film(const std::string& path, unsigned width, unsigned height, double fps);
  /// Deletes an unfinished film.
  ~Film();

  /// @throws std::runtime_error  ffmpeg has ended, for example on a full disk; the text has its last output.
  void add(const Picture& picture);
  /// Moves the film to its path.
  ///
  /// @throws std::runtime_error  ffmpeg has failed.
  void finish();

 private:
  std::string lastWords() const;

  std::string path_;
  std::string part_;
  std::string log_;
  std::unique_ptr<ChildProcess> encoder_;
};

}  // namespace xtdrone_rviz
