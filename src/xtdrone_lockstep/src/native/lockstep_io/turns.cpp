#include "turns.h"

#include <sys/socket.h>

#include <array>
#include <cerrno>

#include "ticks.h"
#include "waiting.h"

namespace nb = nanobind;

namespace xtdrone_lockstep::io {
namespace {

/// Return a socket's descriptor; -1 once it is closed.
int descriptorOf(const nb::object& sock) {
  const int descriptor = PyObject_AsFileDescriptor(sock.ptr());
  if (descriptor < 0) {
    PyErr_Clear();
  }
  return descriptor;
}

/// Holds a lock of Python's.
class Holding {
 public:
  Holding(const nb::object& acquire, const nb::object& release) : release_(release) { acquire(); }
  ~Holding() {
    PyObject* type;
    PyObject* value;
    PyObject* trace;
    PyErr_Fetch(&type, &value, &trace);
    Py_XDECREF(PyObject_CallNoArgs(release_.ptr()));
    PyErr_Restore(type, value, trace);
  }
  Holding(const Holding&) = delete;
  Holding& operator=(const Holding&) = delete;

 private:
  const nb::object& release_;
};

}  // namespace

Turns::Turns(int epoll, int descriptor, nb::object acquire, nb::object release, nb::object send_all, std::size_t topics,
             std::uint64_t tick, std::int64_t time_us)
    : epoll_(epoll),
      descriptor_(descriptor),
      acquire_(std::move(acquire)),
      release_(std::move(release)),
      send_all_(std::move(send_all)),
      received_(topics),
      tick_(tick),
      time_us_(time_us) {}

void Turns::addInput(std::size_t topic, std::uint32_t channel, nb::object sock, nb::object splitter,
                     std::uint64_t taken) {
  received_.at(topic).clear();
  auto* cutter = nb::cast<Splitter*>(splitter);
  inputs_.push_back({topic, channel, std::move(sock), std::move(splitter), cutter, cutter->returned(), taken});
}

void Turns::addOutput(std::uint32_t sequence, nb::object add_to_digest) {
  outputs_.push_back({sequence, std::move(add_to_digest), {}});
  published_.emplace_back();
}

void Turns::addConnection(std::size_t topic, std::uint32_t number, std::uint64_t count, nb::object sock) {
  outputs_.at(topic).connections.push_back({number, count, std::move(sock), {}});
}

nb::object Turns::run(nb::capsule program, std::int64_t until_us, double timeout) {
  auto* work = static_cast<TurnProgram*>(PyCapsule_GetPointer(program.ptr(), TurnProgram::CAPSULE));
  require(work != nullptr);
  until_us_ = until_us;
  static std::array<char, LONGEST_READ> data;  // guarded by Python's global lock until the turn is carried
  while (!stopped_) {
    Arrival arrival = awaitTick(epoll_, descriptor_, timeout, true, data.data());
    if (!arrival.tick) {
      return arrival.other;
    }
    if (!carry(*arrival.tick, *work)) {
      return toTuple(*arrival.tick);
    }
    require(PyErr_CheckSignals() == 0);
  }
  return nb::list();
}

/// Run one turn; return false, with nothing changed, if Python has to run it.
bool Turns::carry(const Barrier& tick, TurnProgram& program) {
  if (stopped_ || tick.ports != 0 || tick.time_us <= time_us_ || tick.time_us >= until_us_ || !fetch(tick)) {
    return false;
  }
  for (std::size_t i = 0; i < outputs_.size(); ++i) {
    published_[i].sequence = outputs_[i].sequence + 1;
    published_[i].packet.clear();
  }
  if (!program.turn(tick.time_us, received_, published_)) {
    return false;
  }
  for (Input& input : inputs_) {
    input.splitter->drop(input.due);
    input.taken += input.due;
  }
  const Barrier done{tick.tick, tick.time_us, 0, 0, nullptr};
  tick_ = done.tick;
  time_us_ = done.time_us;
  publish(done.time_us);
  finish(done);
  return true;
}

/// Read the messages that are due; return false if messages of other topics are due or some have not arrived.
bool Turns::fetch(const Barrier& tick) {
  for (Messages& messages : received_) {
    messages.clear();
  }
  for (Input& input : inputs_) {
    input.due = 0;
    if (input.splitter->returned() != input.returned) {  // another thread has closed the connection
      return false;
    }
  }
  for (std::size_t i = 0; i < tick.channels; ++i) {
    Input* found = nullptr;
    for (Input& input : inputs_) {
      found = input.channel == tick.id(i) ? &input : found;
    }
    if (found == nullptr || !fill(*found, tick.count(i))) {
      return false;
    }
  }
  return true;
}

bool Turns::fill(Input& input, std::uint64_t target) {
  if (target < input.taken) {
    return false;
  }
  const std::uint64_t due = target - input.taken;
  Messages& messages = received_[input.topic];
  for (;;) {
    input.splitter->view(due, messages);
    if (messages.size() == due) {
      input.due = due;
      return true;
    }
    const int descriptor = descriptorOf(input.sock);
    const std::size_t bytes = descriptor < 0 ? 0 : input.splitter->append(descriptor);
    if (bytes == 0) {
      return false;
    }
    input.bytes += bytes;
  }
}

void Turns::publish(std::int64_t time_us) {
  counts_.clear();
  for (std::size_t i = 0; i < outputs_.size(); ++i) {
    Output& output = outputs_[i];
    const std::string& packet = published_[i].packet;
    if (packet.empty()) {
      continue;
    }
    ++output.sequence;
    ++output.messages;
    output.bytes += packet.size();
    if (!output.add_to_digest.is_none()) {
      output.add_to_digest(time_us, nb::bytes(packet.data() + 4, packet.size() - 4));
    }
    for (Connection& connection : output.connections) {
      send(connection, packet);
    }
  }
}

/// Send without blocking; unless the packet is sent completely, Python runs the next turn.
void Turns::send(Connection& connection, const std::string& packet) {
  const int descriptor = descriptorOf(connection.sock);
  ssize_t sent = -1;
  if (descriptor < 0) {
    errno = EBADF;
  } else {
    sent = ::send(descriptor, packet.data(), packet.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
  }
  if (sent != static_cast<ssize_t>(packet.size())) {
    stopped_ = true;
    if (sent < 0 && errno != EAGAIN && errno != EINTR) {
      connection.failure = errno;
      return;
    }
    connection.rest = packet.substr(sent < 0 ? 0 : static_cast<std::size_t>(sent));
  }
  ++connection.count;
  counts_.emplace_back(connection.number, connection.count);
}

void Turns::finish(const Barrier& tick) {
  frame_.clear();
  packDone(frame_, tick.tick, tick.time_us, counts_);
  const Holding holding(acquire_, release_);
  const ssize_t sent = ::send(descriptor_, frame_.data(), frame_.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
  if (sent < 0 && errno != EAGAIN && errno != EINTR) {
    raiseErrno();
  }
  const std::size_t kept = sent < 0 ? 0 : static_cast<std::size_t>(sent);
  if (kept != frame_.size()) {
    send_all_(nb::bytes(frame_.data() + kept, frame_.size() - kept));
  }
}

nb::list Turns::inputs() const {
  nb::list rows;
  for (const Input& input : inputs_) {
    rows.append(nb::make_tuple(input.channel, input.taken, input.bytes));
  }
  return rows;
}

nb::list Turns::outputs() const {
  nb::list rows;
  for (const Output& output : outputs_) {
    rows.append(nb::make_tuple(output.messages, output.bytes));
  }
  return rows;
}

nb::list Turns::connections() const {
  nb::list rows;
  for (const Output& output : outputs_) {
    for (const Connection& connection : output.connections) {
      const nb::bytes rest(connection.rest.data(), connection.rest.size());
      rows.append(nb::make_tuple(connection.number, connection.count, rest, connection.failure));
    }
  }
  return rows;
}

}  // namespace xtdrone_lockstep::io
