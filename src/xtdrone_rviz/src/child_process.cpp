#include "child_process.h"

#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

namespace xtdrone_rviz {
namespace {

[[noreturn]] void fail(const std::string& program, int number) {
  throw ProcessError(program + ": cannot be started: " + std::strerror(number));
}

/// Runs in the child between fork and exec, with async-signal-safe calls only. Returns only on failure.
void become(char* const* arguments, int input, int output, int log, bool dies_with_parent, pid_t parent) {
  setsid();
  if (dies_with_parent) {
    prctl(PR_SET_PDEATHSIG, SIGTERM);
    if (getppid() != parent) {
      _exit(1);  // the parent died before the signal was set
    }
  }
  dup2(input, STDIN_FILENO);
  dup2(log, STDOUT_FILENO);
  dup2(log, STDERR_FILENO);
  if (output >= 0) {
    if (output == ChildProcess::CHILD_DESCRIPTOR) {
      fcntl(output, F_SETFD, 0);
    } else {
      dup2(output, ChildProcess::CHILD_DESCRIPTOR);
    }
  }
  sigset_t none;
  sigemptyset(&none);
  sigprocmask(SIG_SETMASK, &none, nullptr);
  execvp(arguments[0], arguments);
}

}  // namespace

ChildProcess::ChildProcess(const std::vector<std::string>& command, Pipe pipe, bool dies_with_parent,
                           const std::string& log) {
  std::vector<char*> arguments;
  for (const std::string& word : command) {
    arguments.push_back(const_cast<char*>(word.c_str()));
  }
  arguments.push_back(nullptr);

  int ends[2] = {-1, -1};
  int report[2];  // carries the error of exec; closes when exec succeeds
  if ((pipe != Pipe::NONE && pipe2(ends, O_CLOEXEC) != 0) || pipe2(report, O_CLOEXEC) != 0) {
    fail(command[0], errno);
  }
  const int nothing = open("/dev/null", O_RDWR | O_CLOEXEC);
  const int errors = log.empty() ? nothing : open(log.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
  const pid_t parent = getpid();
  pid_ = fork();
  if (pid_ == 0) {
    become(arguments.data(), pipe == Pipe::TO_INPUT ? ends[0] : nothing, pipe == Pipe::FROM_DESCRIPTOR ? ends[1] : -1,
           errors >= 0 ? errors : nothing, dies_with_parent, parent);
    const int number = errno;
    (void)!write(report[1], &number, sizeof number);
    _exit(127);
  }
  close(report[1]);
  close(nothing);
  if (errors != nothing && errors >= 0) {
    close(errors);
  }
  if (pipe == Pipe::TO_INPUT) {
    close(ends[0]);
    descriptor_ = ends[1];
  } else if (pipe == Pipe::FROM_DESCRIPTOR) {
    close(ends[1]);
    descriptor_ = ends[0];
  }
  int number = 0;
  const bool failed = pid_ > 0 && read(report[0], &number, sizeof number) == sizeof number;
  close(report[0]);
  if (failed || pid_ < 0) {
    const int why = failed ? number : EAGAIN;
    if (failed) {
      wait();
    }
    closePipe();
    fail(command[0], why);
  }
}

ChildProcess::~ChildProcess() {
  closePipe();
  if (alive()) {
    stop();
  }
}

void ChildProcess::closePipe() {
  if (descriptor_ >= 0) {
    close(descriptor_);
    descriptor_ = -1;
  }
}

bool ChildProcess::reap(int options) {
  int status = 0;
  pid_t ended;
  do {
    ended = waitpid(pid_, &status, options);
  } while (ended < 0 && errno == EINTR);
  if (ended == 0) {
    return false;
  }
  pid_ = -1;
  status_ = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  return true;
}

bool ChildProcess::alive() { return pid_ > 0 && !reap(WNOHANG); }

int ChildProcess::wait() {
  if (pid_ > 0) {
    reap(0);
  }
  return status_;
}

void ChildProcess::stop(double patience) {
  if (!alive()) {
    return;
  }
  kill(pid_, SIGTERM);
  // A pidfd becomes readable when the child ends.
  const int descriptor = static_cast<int>(syscall(SYS_pidfd_open, pid_, 0));
  if (descriptor >= 0) {
    pollfd watched{descriptor, POLLIN, 0};
    poll(&watched, 1, static_cast<int>(patience * 1000.0));
    close(descriptor);
  }
  if (alive()) {
    kill(pid_, SIGKILL);
    wait();
  }
}

}  // namespace xtdrone_rviz
