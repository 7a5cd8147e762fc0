/// Programs started by this node, which end with it.
#pragma once

#include <sys/types.h>

#include <stdexcept>
#include <string>
#include <vector>

namespace xtdrone_rviz {

/// A program cannot be started or has failed; the text names it and the reason.
class ProcessError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A child process in a separate session, so that Ctrl-C reaches only this node, which then ends the child. The kernel
/// ends it when this process dies.
class ChildProcess {
 public:
  /// Use of a pipe between the two.
  enum class Pipe {
    NONE,
    TO_INPUT,         ///< this node writes, the child reads it as its standard input
    FROM_DESCRIPTOR,  ///< the child writes to descriptor CHILD_DESCRIPTOR, this node reads
  };
  static constexpr int CHILD_DESCRIPTOR = 3;

  /// Starts `command`, found on PATH. Its standard error goes to `log`; empty: discarded.
  ///
  /// @param dies_with_parent  send SIGTERM to the child when this process dies; otherwise the child must end by itself.
  /// @throws ProcessError  The program does not exist or cannot be started.
  ChildProcess(const std::vector<std::string>& command, Pipe pipe, bool dies_with_parent, const std::string& log = "");
  ~ChildProcess();
  ChildProcess(const ChildProcess&) = delete;
  ChildProcess& operator=(const ChildProcess&) = delete;

  /// Returns this node's end of the pipe.
  int descriptor() const { return descriptor_; }
  /// Closes this node's end of the pipe.
  void closePipe();
  /// Returns whether the child runs.
  bool alive();
  /// Waits for the child's end and returns its exit status, or 128 + the signal that ended it.
  int wait();
  /// Ends the child: SIGTERM, and SIGKILL after `patience` wall seconds.
  void stop(double patience = 5.0);

 private:
  bool reap(int options);

  pid_t pid_ = -1;
  int descriptor_ = -1;
  int status_ = 0;
};

}  // namespace xtdrone_rviz
