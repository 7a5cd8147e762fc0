/// A node's turns in compiled code, without Python.
///
/// `xtdrone_native.lockstep_io.Turns` runs the turns of a Python node in lockstep: it waits for TICK, reads the
/// messages that are due, calls the node's program, sends the messages that this publishes, and sends DONE. Python runs
/// the turns in which anything else happens (see `xtdrone_lockstep.client.compiled_turns`).
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace xtdrone_lockstep {

/// The serialised messages of one topic that are due in a turn, in the order of sending, without their length prefixes.
using Messages = std::vector<std::string_view>;

/// The message that a program publishes on one topic in a turn.
struct Publication {
  std::uint32_t sequence = 0;  ///< of the message, as rospy writes it to its header
  std::string packet;          ///< serialised, preceded by its u32 length; empty if nothing is published
};

/// The work of a node's turn.
class TurnProgram {
 public:
  static constexpr const char* CAPSULE = "xtdrone_lockstep.TurnProgram";

  virtual ~TurnProgram() = default;

  /// Do the work of one turn, or leave the whole turn to Python.
  ///
  /// @param time_us    Simulation time, us.
  /// @param received   By topic.
  /// @param published  By topic; packets are empty.
  /// @return  Whether it is done; if not, nothing has changed.
  virtual bool turn(std::int64_t time_us, const std::vector<Messages>& received,
                    std::vector<Publication>& published) = 0;
};

}  // namespace xtdrone_lockstep
