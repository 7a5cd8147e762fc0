// node_launcher SCRIPT ARGUMENT...: runs a Python node of a launch file as a fork of the launch's zygote.
// node_launcher --ahead MODULE,... PROGRAM ARGUMENT...: starts the zygote and becomes PROGRAM, which is roslaunch.
// It is the launch-prefix of a node. The zygote (xtdrone_common/programs/zygote.py) is a process that has imported the
// nodes' modules; there is one for each parent of launchers, that is for each roslaunch, started by the first of them.
// The launcher represents the node in roslaunch: it forwards signals to the node and ends as the node does. A program
// that the zygote cannot run (not a Python script, or an environment different from the first node's) replaces the
// launcher, as if there were none.
//
// With --ahead the zygote imports the nodes' modules while roslaunch reads its files and starts the master, on another
// core.

#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <string>
#include <vector>

extern char** environ;  // NOLINT

namespace {
constexpr int BACKLOG = 4096;         // launchers that wait while the zygote imports
constexpr time_t CONNECT_LIMIT = 20;  // s; the socket may belong to another user's process that accepts no connections
constexpr size_t TITLE_SIZE = 4096;   // bytes reserved in the zygote for its nodes' command lines
constexpr int FORWARDED[] = {SIGHUP, SIGINT, SIGQUIT, SIGUSR1, SIGUSR2, SIGTERM};

// The zygote's messages: PID after the fork, ENDED with the wait status, REFUSED if it cannot run the program.
enum class Kind : char { PID = 'P', ENDED = 'E', REFUSED = 'R' };

struct Reply {
  char kind;
  char unused[3];
  int32_t value;
};

// The launcher's command line in lists of processes: `node_launcher __name:=NODE PID`. A search for the node's script
// then finds the node alone, and xtdrone_interaction/monitoring/missing_nodes.py reads the node's process id.
class Title {
 public:
  explicit Title(char** words) : begin_(words[1]) {
    char* end = begin_;
    for (char** word = words + 1; *word != nullptr; ++word) {
      end = *word + strlen(*word);
      if (strncmp(*word, "__name:=", 8) == 0) name_ = *word;
    }
    size_ = static_cast<size_t>(end - begin_);  // the kernel stores the words contiguously
    show(name_);
  }

  void showNode(pid_t node) { show(name_ + '\0' + std::to_string(node)); }

 private:
  void show(const std::string& text) {
    memset(begin_, 0, size_);
    memcpy(begin_, text.data(), std::min(text.size(), size_));
  }

  char* begin_;
  size_t size_ = 0;
  std::string name_;
};

// Replaces the launcher by the program, as if there had been no launcher.
[[noreturn]] void runDirectly(char** command) {
  execvp(command[0], command);
  fprintf(stderr, "node_launcher: %s: %s\n", command[0], strerror(errno));
  _exit(errno == ENOENT ? 127 : 126);
}

// Returns the Python interpreter named in the first line of a script without options, or an empty string.
std::string interpreterOf(const char* script) {
  FILE* file = fopen(script, "re");
  if (file == nullptr) return {};
  char line[512] = {};
  const bool found = fgets(line, sizeof line, file) != nullptr && line[0] == '#' && line[1] == '!';
  fclose(file);
  if (!found || strchr(line, '\n') == nullptr) return {};
  std::vector<std::string> words;
  char* rest = nullptr;
  for (char* word = strtok_r(line + 2, " \t\r\n", &rest); word != nullptr; word = strtok_r(nullptr, " \t\r\n", &rest))
    words.emplace_back(word);
  if (words.size() == 2 && words[0] == "/usr/bin/env") words.erase(words.begin());
  const bool is_python = words.size() == 1 && words[0].substr(words[0].rfind('/') + 1).rfind("python", 0) == 0;
  return is_python ? words[0] : std::string();
}

// Returns the start time of a process from /proc, which together with its id is unique until the next boot.
std::string startTime(pid_t pid) {
  char path[64];
  snprintf(path, sizeof path, "/proc/%d/stat", static_cast<int>(pid));
  FILE* file = fopen(path, "re");
  if (file == nullptr) return {};
  char text[1024] = {};
  const size_t size = fread(text, 1, sizeof text - 1, file);
  fclose(file);
  text[size] = '\0';
  const char* field = strrchr(text, ')');  // field 2, the name, may contain spaces
  for (int number = 2; field != nullptr && number < 22; ++number) field = strchr(field + 1, ' ');
  if (field == nullptr) return {};
  return {field + 1, strcspn(field + 1, " ")};
}

// Returns the address of the zygote for the launchers of `parent`: a name without a file.
socklen_t makeAddress(pid_t parent, const std::string& interpreter, sockaddr_un& address) {
  char space[64] = {};
  if (readlink("/proc/self/ns/pid", space, sizeof space - 1) < 0) space[0] = '\0';
  const size_t hash = std::hash<std::string>{}(interpreter + space);
  const std::string name = "xtdrone-zygote-" + std::to_string(getuid()) + "-" + std::to_string(parent) + "-" +
                           startTime(parent) + "-" + std::to_string(hash);
  address = {};
  address.sun_family = AF_UNIX;
  const size_t length = std::min(name.size(), sizeof address.sun_path - 1);
  memcpy(address.sun_path + 1, name.data(), length);
  return static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + 1 + length);
}

// Starts the zygote, which owns the listening socket; with CLONE_PARENT it becomes a sibling of this process.
// It imports `modules`, separated by commas, while no launcher waits.
void startZygote(const std::string& interpreter, pid_t parent, int listener, int flags, const char* modules) {
  const long pid = syscall(SYS_clone, flags | SIGCHLD, nullptr, nullptr, nullptr, nullptr);
  if (pid != 0) return;  // after an error no process listens, and the program runs directly
  setsid();
  const int null = open("/dev/null", O_RDONLY | O_CLOEXEC);
  dup2(null, STDIN_FILENO);
  dup2(STDERR_FILENO, STDOUT_FILENO);
  fcntl(listener, F_SETFD, 0);
  const std::string title(TITLE_SIZE, ' ');
  execlp(interpreter.c_str(), interpreter.c_str(), "-P", "-m", "xtdrone_common.programs.zygote",
         std::to_string(listener).c_str(), std::to_string(parent).c_str(), modules, title.c_str(), nullptr);
  _exit(127);
}

// Starts the zygote of this process, which is to become roslaunch. The nodes' interpreter is that of the scripts beside
// this program; without one the first node starts the zygote.
void startAhead(const char* modules) {
  std::string path(PATH_MAX, '\0');
  const ssize_t length = readlink("/proc/self/exe", path.data(), path.size());
  if (length <= 0) return;
  path.resize(static_cast<size_t>(length));
  const std::string interpreter = interpreterOf((path.substr(0, path.rfind('/') + 1) + "fleet_text.py").c_str());
  const int listener = interpreter.empty() ? -1 : socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (listener < 0) return;
  sockaddr_un address;
  const socklen_t size = makeAddress(getpid(), interpreter, address);
  if (bind(listener, reinterpret_cast<const sockaddr*>(&address), size) == 0 && listen(listener, BACKLOG) == 0)
    startZygote(interpreter, getpid(), listener, 0, modules);
  close(listener);
}

// Returns a connection to the zygote of the launch, which is started if there is none, or -1.
int connectToZygote(const std::string& interpreter) {
  const pid_t parent = getppid();
  sockaddr_un address;
  const socklen_t length = makeAddress(parent, interpreter, address);
  const auto* there = reinterpret_cast<const sockaddr*>(&address);
  const int listener = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (listener < 0) return -1;
  if (bind(listener, there, length) == 0 && listen(listener, BACKLOG) == 0)
    startZygote(interpreter, parent, listener, CLONE_PARENT, "");
  const int connection = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  const timeval limit = {CONNECT_LIMIT, 0};
  setsockopt(connection, SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit);  // of connect and of the request
  int done = connection < 0 ? -1 : connect(connection, there, length);
  for (int tries = 0; done != 0 && connection >= 0 && errno == ECONNREFUSED && tries < 100; ++tries) {
    usleep(1000);  // another launcher has bound the address and is about to listen
    done = connect(connection, there, length);
  }
  close(listener);
  ucred peer = {};
  socklen_t size = sizeof peer;
  if (done == 0 && getsockopt(connection, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0 && peer.uid == getuid())
    return connection;
  close(connection);
  return -1;
}

void append(std::string& text, char** words) {
  for (; *words != nullptr; ++words) text.append(*words).push_back('\0');
}

// Sends command line, environment, working directory and standard descriptors; returns whether that was possible.
bool sendRequest(int connection, char** command) {
  std::string words;
  append(words, command);
  const uint32_t arguments = static_cast<uint32_t>(words.size());
  append(words, environ);
  const uint32_t sizes[] = {arguments, static_cast<uint32_t>(words.size()) - arguments};
  std::string text(reinterpret_cast<const char*>(sizes), sizeof sizes);
  text += words;

  const int folder = open(".", O_PATH | O_DIRECTORY | O_CLOEXEC);
  const int descriptors[] = {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO, folder};
  alignas(cmsghdr) char control[CMSG_SPACE(sizeof descriptors)] = {};
  iovec part = {text.data(), text.size()};
  msghdr message = {};
  message.msg_iov = &part;
  message.msg_iovlen = 1;
  message.msg_control = control;
  message.msg_controllen = sizeof control;
  cmsghdr* header = CMSG_FIRSTHDR(&message);
  header->cmsg_level = SOL_SOCKET;
  header->cmsg_type = SCM_RIGHTS;
  header->cmsg_len = CMSG_LEN(sizeof descriptors);
  memcpy(CMSG_DATA(header), descriptors, sizeof descriptors);
  ssize_t sent = folder < 0 ? -1 : sendmsg(connection, &message, MSG_NOSIGNAL);
  close(folder);
  size_t done = 0;
  while (sent >= 0 && (done += static_cast<size_t>(sent)) < text.size())
    sent = send(connection, text.data() + done, text.size() - done, MSG_NOSIGNAL);
  return sent >= 0;
}

// Ends as the node did.
[[noreturn]] void endLike(int status) {
  if (WIFEXITED(status)) _exit(WEXITSTATUS(status));
  const int number = WTERMSIG(status);
  const rlimit no_core = {0, 0};
  setrlimit(RLIMIT_CORE, &no_core);  // the node has written its own
  signal(number, SIG_DFL);
  sigset_t signals;
  sigfillset(&signals);
  sigprocmask(SIG_UNBLOCK, &signals, nullptr);
  raise(number);
  _exit(128 + number);
}

// Sends a signal to the node and its children; the node's process id stays valid until the launcher has ended.
void forward(int number, pid_t node) {
  if (kill(-node, number) != 0) kill(node, number);  // it has no group of its own yet
}

// Waits for the end of the node. Without the zygote the node was never started, or it was killed.
[[noreturn]] void stand(int connection, int signals, Title& title, char** command, const sigset_t& previous) {
  pid_t node = 0;
  while (true) {
    pollfd ready[] = {{connection, POLLIN, 0}, {signals, POLLIN, 0}};
    if (poll(ready, 2, -1) < 0) continue;
    if (ready[0].revents != 0) {
      Reply reply = {};
      const bool received = recv(connection, &reply, sizeof reply, MSG_WAITALL) == sizeof reply;
      const auto kind = static_cast<Kind>(reply.kind);
      if (received && kind == Kind::PID) {
        node = reply.value;
        title.showNode(node);
      } else if (received && kind == Kind::ENDED)
        endLike(reply.value);
      else if (node != 0)
        endLike(SIGKILL);  // the kernel kills the nodes of a zygote that ends
      else {
        close(connection);
        sigprocmask(SIG_SETMASK, &previous, nullptr);
        runDirectly(command);
      }
    }
    signalfd_siginfo signal;
    if (ready[1].revents == 0 || read(signals, &signal, sizeof signal) != sizeof signal) continue;
    if (node == 0) endLike(static_cast<int>(signal.ssi_signo));  // the zygote kills a node without a launcher
    forward(static_cast<int>(signal.ssi_signo), node);
  }
}
}  // namespace

int main(int count, char** words) {
  const bool ahead = count > 1 && strcmp(words[1], "--ahead") == 0;
  if (count < (ahead ? 4 : 2)) {
    fprintf(stderr, "usage: node_launcher [--ahead MODULE,...] PROGRAM ARGUMENT...\n");
    return 2;
  }
  if (ahead) {
    startAhead(words[2]);
    runDirectly(words + 3);
  }
  std::vector<std::string> copies(words + 1, words + count);
  std::vector<char*> command_words;
  for (std::string& word : copies) command_words.push_back(word.data());
  command_words.push_back(nullptr);
  char** command = command_words.data();
  const std::string interpreter = interpreterOf(command[0]);
  const int connection = interpreter.empty() ? -1 : connectToZygote(interpreter);
  if (connection < 0) runDirectly(command);
  sigset_t signals;
  sigset_t previous;
  sigemptyset(&signals);
  for (const int number : FORWARDED) sigaddset(&signals, number);
  sigprocmask(SIG_BLOCK, &signals, &previous);
  const int heard = signalfd(-1, &signals, SFD_CLOEXEC);
  if (heard < 0 || !sendRequest(connection, command)) {
    close(connection);
    sigprocmask(SIG_SETMASK, &previous, nullptr);
    runDirectly(command);
  }
  Title title(words);
  stand(connection, heard, title, command, previous);
}
