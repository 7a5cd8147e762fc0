// The inner loops of the lockstep: TICK and DONE frames, and the waits for them.

#include <nanobind/nanobind.h>
#include <sys/socket.h>

#include <array>
#include <string>

#include "exchange.h"
#include "frames.h"
#include "splitter.h"
#include "ticks.h"
#include "turns.h"
#include "waiting.h"

namespace nb = nanobind;

namespace xtdrone_lockstep::io {

namespace {

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

/// Wait for the simulator's next data, see `awaitTick`; return a TICK as a tuple.
nb::object receive(int epoll, int descriptor, double timeout, bool whole) {
  std::array<char, LONGEST_READ> data;
  const Arrival arrival = awaitTick(epoll, descriptor, timeout, whole, data.data());
  return arrival.tick ? nb::object(toTuple(*arrival.tick)) : arrival.other;
}

}  // namespace
}  // namespace xtdrone_lockstep::io

NB_MODULE(lockstep_io, module) {
  using namespace xtdrone_lockstep::io;
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
          nb::arg("data"))
      .def("put_back", &Splitter::putBack, nb::arg("messages"));
  nb::class_<Turns>(module, "Turns")
      .def(nb::init<int, int, nb::object, nb::object, nb::object, std::size_t, std::uint64_t, std::int64_t>(),
           nb::arg("epoll"), nb::arg("descriptor"), nb::arg("acquire"), nb::arg("release"), nb::arg("send_all"),
           nb::arg("topics"), nb::arg("tick"), nb::arg("time_us"))
      .def("add_input", &Turns::addInput, nb::arg("topic"), nb::arg("channel"), nb::arg("sock"), nb::arg("splitter"),
           nb::arg("taken"))
      .def("add_output", &Turns::addOutput, nb::arg("sequence"), nb::arg("add_to_digest").none())
      .def("add_connection", &Turns::addConnection, nb::arg("topic"), nb::arg("number"), nb::arg("count"),
           nb::arg("sock"))
      .def("run", &Turns::run, nb::arg("program"), nb::arg("until_us"), nb::arg("timeout"))
      .def("stop", &Turns::stop)
      .def_prop_ro("tick", &Turns::tick)
      .def_prop_ro("time_us", &Turns::timeUs)
      .def_prop_ro("inputs", &Turns::inputs)
      .def_prop_ro("outputs", &Turns::outputs)
      .def_prop_ro("connections", &Turns::connections);
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
