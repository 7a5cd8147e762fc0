/// A film that grows picture by picture.
#pragma once

#include <memory>
#include <string>

#include "child_process.h"
#include "picture.h"

namespace xtdrone_rviz {

/// An MP4 (H.264, 4:2:0) by ffmpeg, which reads raw pictures from a pipe. It is written beside its place and put there
/// by finish(), so that a film which is there can be read. If this process dies, ffmpeg still finishes what it has.
class Film {
 public:
  /// @param path  Ends with .mp4.
  /// @param fps   Pictures a second when it is played.
  /// @throws ProcessError        No ffmpeg.
  /// @throws std::runtime_error  The film cannot be written there.
  Film(const std::string& path, unsigned width, unsigned height, double fps);
  /// Drops a film that was not finished.
  ~Film();

  /// @throws std::runtime_error  ffmpeg has ended, as on a full disk; the text has its last words.
  void add(const Picture& picture);
  /// Puts the film into its place.
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
