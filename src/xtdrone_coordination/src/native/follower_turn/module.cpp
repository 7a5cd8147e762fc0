// The turn of a follower in compiled code; see xtdrone_coordination/compiled_follower.py.

#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "follower_turn.h"

namespace nb = nanobind;

namespace xtdrone_coordination::follower_turn {
namespace {

using xtdrone_control::VelocityCommands;
using xtdrone_lockstep::TurnProgram;

std::string toString(const nb::bytes& bytes) { return std::string(bytes.c_str(), bytes.size()); }

void carryOut(FollowerTurn& turn, double hover_speed, double timeout, bool hovering, double moving_since,
              const nb::bytes& packet, const nb::object& mode, bool armed) {
  VelocityCommands commands;
  if (packet.size() != commands.packet.size()) {
    throw nb::value_error("the setpoint's header must have an empty frame");
  }
  commands.hover_speed = hover_speed;
  commands.timeout = timeout;
  commands.hovering = hovering;
  commands.moving_since = moving_since;
  std::memcpy(commands.packet.data(), packet.c_str(), packet.size());
  std::optional<State> state;
  if (!mode.is_none()) {
    state = State{nb::cast<nb::str>(mode).c_str(), armed};
  }
  turn.carryOut(commands, std::move(state));
}

/// Run a turn with the messages of each topic; return the packet of each published topic, None if Python has to run it.
nb::object take(FollowerTurn& turn, std::int64_t time_us, const std::vector<std::vector<nb::bytes>>& received,
                const std::vector<std::uint32_t>& sequences) {
  std::vector<xtdrone_lockstep::Messages> messages(received.size());
  for (std::size_t i = 0; i < received.size(); ++i) {
    for (const nb::bytes& message : received[i]) {
      messages[i].emplace_back(message.c_str(), message.size());
    }
  }
  std::vector<xtdrone_lockstep::Publication> published(sequences.size());
  for (std::size_t i = 0; i < sequences.size(); ++i) {
    published[i].sequence = sequences[i];
  }
  if (!turn.turn(time_us, messages, published)) {
    return nb::none();
  }
  nb::list packets;
  for (const auto& [sequence, packet] : published) {
    packets.append(nb::bytes(packet.data(), packet.size()));
  }
  return packets;
}

/// Return a capsule of the program, which keeps its object alive.
nb::object program(nb::handle self) {
  auto* work = static_cast<TurnProgram*>(nb::cast<FollowerTurn*>(self));
  const auto release = [](PyObject* capsule) { Py_XDECREF(static_cast<PyObject*>(PyCapsule_GetContext(capsule))); };
  nb::object capsule = nb::steal(PyCapsule_New(work, TurnProgram::CAPSULE, release));
  if (!capsule.is_valid() || PyCapsule_SetContext(capsule.ptr(), self.ptr()) != 0) {
    throw nb::python_error();
  }
  self.inc_ref();
  return capsule;
}

}  // namespace
}  // namespace xtdrone_coordination::follower_turn

NB_MODULE(follower_turn, module) {
  using namespace xtdrone_coordination::follower_turn;
  using xtdrone_coordination::Neighbour;
  using xtdrone_coordination::Vector;
  nb::class_<Settings>(module, "Settings")
      .def(nb::init<double, bool, double, bool, double, double, double>(), nb::arg("gain"), nb::arg("normalise"),
           nb::arg("limit"), nb::arg("avoids"), nb::arg("avoidance_gain"), nb::arg("radius"), nb::arg("clearance"));
  nb::class_<FollowerTurn>(module, "FollowerTurn")
      .def(
          "__init__",
          [](FollowerTurn* turn, std::size_t id, const Settings& settings, std::vector<Vector> offsets,
             const std::vector<std::pair<std::size_t, double>>& weights) {
            std::vector<Neighbour> neighbours;
            for (const auto& [other, weight] : weights) {
              if (other >= offsets.size()) {
                throw nb::value_error("a neighbour has no slot");
              }
              neighbours.push_back({other, weight});
            }
            if (id >= offsets.size()) {
              throw nb::value_error("the follower has no slot");
            }
            new (turn) FollowerTurn(id, settings, std::move(offsets), std::move(neighbours));
          },
          nb::arg("id"), nb::arg("settings"), nb::arg("offsets"), nb::arg("weights"))
      .def(
          "ignore",
          [](FollowerTurn& turn, const nb::bytes& pattern, const nb::bytes& topology) {
            turn.ignore(toString(pattern), toString(topology));
          },
          nb::arg("pattern"), nb::arg("topology"))
      .def("carry_out", &carryOut, nb::arg("hover_speed"), nb::arg("timeout"), nb::arg("hovering"),
           nb::arg("moving_since"), nb::arg("packet"), nb::arg("mode").none(), nb::arg("armed"))
      .def("program", &program)
      .def("take", &take, nb::arg("time_us"), nb::arg("received"), nb::arg("sequences"))
      .def_ro("turns", &FollowerTurn::turns)
      .def_ro("states", &FollowerTurn::states)
      .def_ro("pose", &FollowerTurn::pose)
      .def_ro("command", &FollowerTurn::command)
      .def_ro("avoidance", &FollowerTurn::avoidance);
}
