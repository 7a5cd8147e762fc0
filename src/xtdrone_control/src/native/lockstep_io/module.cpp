// The inner loops of the lockstep: TICK and DONE frames, and the waits for them.

#include <nanobind/nanobind.h>
#include <sys/socket.h>

#include <array>
#include <string>

#include "exchange.h"
#include "frames.h"
#include "splitter.h"
#include "waiting.h"

namespace nb = nanobind;

namespace xtdrone_control::lockstep_io {

namespace {

nb::tuple toTuple(const Barrier& barrier) {
  const std::size_t all = std::size_t{barrier.channels} + barrier.ports;
  const nb::object channels = nb::steal(pairsOf(barrier, 0, barrier.channels));
  const nb::object ports = channels.is_valid() ? nb::steal(pairsOf(barrier, barrier.channels, all)) : nb::object();
  if (!ports.is_valid()) {
    throw nb::python_error();
  }
  return nb::make_tuple(barrier.tick, barrier.time_us, channels, ports);
}

/// Return the content of a payload, None if it is malformed.
nb::object unpack(nb::bytes payload) {
  const auto barrier = readPayload(payload.c_str(), payload.size());
  return barrier ? nb::object(toTuple(*barrier)) : nb::none();
}

Kind kindOf(int number) {
  if (number != static_cast<int>(Kind::TICK) && number != static_cast<int>(Kind::DONE)) {
    throw nb::value_error("the frame must be TICK or DONE");
  }
  return static_cast<Kind>(number);
}

nb::bytes packBarrier(int kind, std::uint64_t tick, std::int64_t time_us, nb::dict channels, nb::dict ports) {
  std::string frame;
  pack(frame, kindOf(kind), tick, time_us, channels.ptr(), ports.ptr());
  return nb::bytes(frame.data(), frame.size());
}

/// Send DONE without blocking; return the bytes that the kernel does not accept.
nb::bytes sendDone(int descriptor, std::uint64_t tick, std::int64_t time_us, nb::dict channels, nb::dict ports) {
  std::string frame;
  pack(frame, Kind::DONE, tick, time_us, channels.ptr(), ports.ptr());
  const ssize_t sent = send(descriptor, frame.data(), frame.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
  if (sent < 0 && errno != EAGAIN && errno != EINTR) {
    raiseErrno();
  }
  const std::size_t kept = sent < 0 ? 0 : static_cast<std::size_t>(sent);
  return nb::bytes(frame.data() + kept, frame.size() - kept);
}

/// Wait for the simulator's next data.
///
/// @param whole  Whether its next byte is the first of a frame.
/// @return  The content of one TICK that has arrived alone; other bytes, empty at the end of the connection; or a list
/// of
///          the descriptors that are ready if there are others than the simulator's.
nb::object receive(int epoll, int descriptor, double timeout, bool whole) {
  Events events;
  const int count = await(epoll, events, Limit(timeout));
  if (count != 1 || events[0].data.fd != descriptor) {
    nb::list others;
    for (int i = 0; i < count; ++i) {
      others.append(static_cast<int>(events[static_cast<std::size_t>(i)].data.fd));
    }
    return others;
  }
  std::array<char, LONGEST_READ> data;
  const ssize_t size = recv(descriptor, data.data(), data.size(), MSG_DONTWAIT);
  if (size < 0) {
    if (errno == EAGAIN || errno == EINTR) {
      return nb::list();
    }
    raiseErrno();
  }
  const auto tick = whole ? readWhole(data.data(), static_cast<std::size_t>(size), Kind::TICK) : std::nullopt;
  return tick ? nb::object(toTuple(*tick)) : nb::bytes(data.data(), static_cast<std::size_t>(size));
}

}  // namespace
}  // namespace xtdrone_control::lockstep_io

NB_MODULE(lockstep_io, module) {
  using namespace xtdrone_control::lockstep_io;
  module.def("unpack_barrier", &unpack, nb::arg("payload"));
  module.def("receive", &receive, nb::arg("epoll"), nb::arg("descriptor"), nb::arg("timeout"), nb::arg("whole"));
  module.def("pack_barrier", &packBarrier, nb::arg("kind"), nb::arg("tick"), nb::arg("time_us"), nb::arg("channels"),
             nb::arg("ports"));
  module.def("send_done", &sendDone, nb::arg("descriptor"), nb::arg("tick"), nb::arg("time_us"), nb::arg("channels"),
             nb::arg("ports"));
  nb::class_<Splitter>(module, "Splitter")
      .def(nb::init<>())
      .def("read", &Splitter::read, nb::arg("sock"), nb::arg("size"))
      .def(
          "cut", [](Splitter& splitter, nb::bytes data) { return splitter.cut(data.c_str(), data.size()); },
          nb::arg("data"));
  nb::class_<Exchange>(module, "Exchange")
      .def(nb::init<int>(), nb::arg("epoll"))
      .def("add", &Exchange::add, nb::arg("descriptor"), nb::arg("routes"), nb::arg("closing"))
      .def("remove", &Exchange::remove, nb::arg("descriptor"))
      .def("hold", &Exchange::hold, nb::arg("descriptor"), nb::arg("held"))
      .def("release", &Exchange::release, nb::arg("descriptor"))
      .def("expect", &Exchange::expect, nb::arg("descriptor"), nb::arg("tick"))
      .def("send", &Exchange::send, nb::arg("tick"), nb::arg("time_us"), nb::arg("rows"))
      .def("poll", &Exchange::poll, nb::arg("timeout"));
}
