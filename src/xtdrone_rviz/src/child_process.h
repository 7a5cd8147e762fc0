/// Programs that this node starts and that do not outlive it.
#pragma once

#include <sys/types.h>

#include <stdexcept>
#include <string>
#include <vector>

namespace xtdrone_rviz {

/// A program that cannot be started, or has failed; the text says which and why.
class ProcessError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A child process in a session of its own, so that Ctrl-C is for this node, which then ends it in its own time. The
/// kernel ends it when this process dies by whatever cause.
class ChildProcess {
 public:
  /// How a pipe between the two is used.
  enum class Pipe {
    NONE,
    TO_INPUT,         ///< this node writes, the child reads it as its standard input
    FROM_DESCRIPTOR,  ///< the child writes to descriptor CHILD_DESCRIPTOR, this node reads
  };
  static constexpr int CHILD_DESCRIPTOR = 3;

  /// Starts `command`, found on PATH. Its standard error goes to `log`, or nowhere.
  ///
  /// @param dies_with_parent  SIGTERM for the child when this process dies; else it must end by itself.
  /// @throws ProcessError  It is not there or cannot be started.
  ChildProcess(const std::vector<std::string>& command, Pipe pipe, bool dies_with_parent, const std::string& log = "");
  ~ChildProcess();
  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  /// This node's end of the pipe.
  int descriptor() const { return descriptor_; }
  /// Closes this node's end of the pipe.
  void closePipe();
  /// Whether it runs.
  bool alive();
  /// Waits for its end and returns its status: the exit status, or 128 + the signal that ended it.
  int wait();
  /// Ends it: SIGTERM, and SIGKILL after `patience` wall seconds.
  void stop(double patience = 5.0);

 private:
  bool reap(int options);

  pid_t pid_ = -1;
  int descriptor_ = -1;
  int status_ = 0;
};

}  // namespace xtdrone_rviz
