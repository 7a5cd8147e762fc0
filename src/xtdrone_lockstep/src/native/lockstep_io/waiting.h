/// Waits and reads without Python's global lock; signals reach Python's handlers.
#pragma once

#include <nanobind/nanobind.h>
#include <sys/epoll.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <climits>
#include <cmath>
#include <cstddef>

namespace xtdrone_lockstep::io {

/// Bytes per read of a connection to or from the server.
constexpr std::size_t LONGEST_READ = 1 << 16;

/// Check the result of a function of Python's C API.
inline void require(bool succeeded) {
  if (!succeeded) {
    throw nanobind::python_error();
  }
}

[[noreturn]] inline void raiseErrno() {
  PyErr_SetFromErrno(PyExc_OSError);
  throw nanobind::python_error();
}

/// The end of a wait.
class Limit {
 public:
  /// @param seconds  Wall seconds from now; negative for no limit.
  explicit Limit(double seconds)
      : endless_(!(seconds >= 0.0)),
        none_(seconds == 0.0),
        end_(endless_ || none_ ? Clock::time_point() : after(seconds)) {}

  /// Return the remaining time in milliseconds as epoll_wait expects it.
  int milliseconds() const {
    if (endless_ || none_) {
      return endless_ ? -1 : 0;
    }
    const double left = std::chrono::duration<double, std::milli>(end_ - Clock::now()).count();
    return left <= 0.0 ? 0 : static_cast<int>(std::ceil(std::min(left, MOST)));
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr double MOST = 1e9;

  static Clock::time_point after(double seconds) {
    const std::chrono::duration<double, std::milli> length(std::min(seconds * 1e3, MOST));
    return Clock::now() + std::chrono::duration_cast<Clock::duration>(length);
  }

  bool endless_;
  bool none_;
  Clock::time_point end_;
};

using Events = std::array<epoll_event, 512>;

/// Wait for events, and return their number.
///
/// @throws nanobind::python_error  OSError, or the exception of a signal handler.
inline int await(int epoll, Events& events, const Limit& limit) {
  for (;;) {
    const int timeout = limit.milliseconds();
    int count;
    int why;
    if (timeout == 0) {
      count = epoll_wait(epoll, events.data(), static_cast<int>(events.size()), 0);
      why = errno;
    } else {
      nanobind::gil_scoped_release released;
      count = epoll_wait(epoll, events.data(), static_cast<int>(events.size()), timeout);
      why = errno;
    }
    if (count >= 0) {
      return count;
    }
    errno = why;
    if (why != EINTR) {
      raiseErrno();
    }
    if (PyErr_CheckSignals() != 0) {
      throw nanobind::python_error();
    }
  }
}

}  // namespace xtdrone_lockstep::io
