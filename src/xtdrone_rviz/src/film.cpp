#include "film.h"

#include <unistd.h>

#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <sstream>
#include <stdexcept>

namespace xtdrone_rviz {
namespace {

std::string number(double value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

/// Returns the path with a dot before the file's name, which hides it.
std::string hidden(const std::string& path, const std::string& ending) {
  const auto slash = path.rfind('/');
  const auto name = slash == std::string::npos ? 0 : slash + 1;
  return path.substr(0, name) + "." + path.substr(name) + "." + std::to_string(getpid()) + ending;
}

}  // namespace

Film::Film(const std::string& path, unsigned width, unsigned height, double fps)
    : path_(path), part_(hidden(path, ".part.mp4")), log_(hidden(path, ".log")) {
  if (!std::ofstream(part_)) {
    throw std::runtime_error("film " + path_ + ": cannot be written: " + std::strerror(errno));
  }
  std::signal(SIGPIPE, SIG_IGN);  // write reports ffmpeg's end
  const std::string size = std::to_string(width) + "x" + std::to_string(height);
  try {
    encoder_ = std::make_unique<ChildProcess>(std::vector<std::string>{"ffmpeg",
                                                                       "-hide_banner",
                                                                       "-loglevel",
                                                                       "error",
                                                                       "-nostdin",
                                                                       "-y",
                                                                       "-f",
                                                                       "rawvideo",
                                                                       "-pix_fmt",
                                                                       "rgb24",
                                                                       "-s",
                                                                       size,
                                                                       "-r",
                                                                       number(fps),
                                                                       "-i",
                                                                       "pipe:0",
                                                                       "-an",
                                                                       "-vf",
                                                                       "pad=ceil(iw/2)*2:ceil(ih/2)*2",
                                                                       "-c:v",
                                                                       "libx264",
                                                                       "-pix_fmt",
                                                                       "yuv420p",
                                                                       "-preset",
                                                                       "veryfast",
                                                                       "-crf",
                                                                       "19",
                                                                       "-movflags",
                                                                       "+faststart",
                                                                       "-f",
                                                                       "mp4",
                                                                       part_},
                                              ChildProcess::Pipe::TO_INPUT, false, log_);
  } catch (const ProcessError&) {
    std::remove(part_.c_str());
    std::remove(log_.c_str());
    throw;
  }
}

Film::~Film() {
  if (encoder_) {
    encoder_.reset();  // closes its pipe first: ffmpeg ignores signals while it waits for a picture
    std::remove(part_.c_str());
  }
  std::remove(log_.c_str());
}

void Film::add(const Picture& picture) {
  const std::uint8_t* at = picture.data.data();
  std::size_t left = picture.data.size();
  while (left > 0) {
    const ssize_t written = write(encoder_->descriptor(), at, left);
    if (written < 0 && errno == EINTR) {
      continue;
    }
    if (written < 0) {
      encoder_->wait();
      throw std::runtime_error("film " + path_ + ": ffmpeg has ended: " + lastWords());
    }
    at += written;
    left -= static_cast<std::size_t>(written);
  }
}

void Film::finish() {
  encoder_->closePipe();
  const int status = encoder_->wait();
  if (status != 0) {
    throw std::runtime_error("film " + path_ + ": ffmpeg has failed: " + lastWords());
  }
  if (std::rename(part_.c_str(), path_.c_str()) != 0) {
    throw std::runtime_error("film " + path_ + ": cannot be put in its place: " + std::strerror(errno));
  }
  encoder_.reset();
}

std::string Film::lastWords() const {
  std::ifstream log(log_);
  std::string line;
  std::string last = "it said nothing";
  while (std::getline(log, line)) {
    if (!line.empty()) {
      last = line;
    }
  }
  return last;
}

}  // namespace xtdrone_rviz
