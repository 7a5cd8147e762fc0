/// The turn of a stock follower, and of its vehicle's velocity commands, without Python.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "xtdrone_control/velocity_commands.h"
#include "xtdrone_coordination/avoidance.h"
#include "xtdrone_coordination/consensus.h"
#include "xtdrone_lockstep/turn_program.h"

namespace xtdrone_coordination::follower_turn {

/// Settings of a follower in vel mode, see `xtdrone_coordination.follower.FollowerOptions`.
struct Settings {
  double gain;
  bool normalise;
  double limit;           // m/s
  bool avoids;            // or avoidance is off
  double avoidance_gain;  //
  double radius;          // m
  double clearance;       // m
};

/// Content of mavros/state.
struct State {
  std::string mode;
  bool armed;
};

/// Computes what `FollowerNode.step` and `MultirotorCommunication.step` do in a turn in which nothing changes but
/// positions and velocity commands; every other turn is left to them.
///
/// Topics, in this order. Received: pattern, topology, states of all vehicles, mavros/state, own pose, velocity
/// command. Published: setpoint, if the vehicle's commands are carried out here; velocity command; avoidance, if it is
/// on.
class FollowerTurn : public xtdrone_lockstep::TurnProgram {
 public:
  FollowerTurn(std::size_t id, const Settings& settings, std::vector<Vector> offsets,
               std::vector<Neighbour> neighbours);

  /// Repetitions of these data, as bytes of the numbers, are ignored.
  void ignore(std::string pattern, std::string topology);
  /// Carry out the velocity commands of the vehicle.
  ///
  /// @param state  Other states of mavros/state are left to Python; nullopt: all.
  void carryOut(const xtdrone_control::VelocityCommands& commands, std::optional<State> state);

  bool turn(std::int64_t time_us, const std::vector<xtdrone_lockstep::Messages>& received,
            std::vector<xtdrone_lockstep::Publication>& published) override;

  /// Number of turns run.
  std::uint64_t turns = 0;
  /// x, y, z, vx, vy, vz of each vehicle in the last turn, m and m/s ENU.
  std::vector<double> states;
  /// The last pose: position, m ENU, and quaternion (x, y, z, w); empty without one.
  std::vector<double> pose;
  /// The last velocity command that has moved the vehicle: m/s ENU, rad/s, and its time, s; empty without one.
  std::vector<double> command;
  Vector avoidance{};

 private:
  bool hear(const std::vector<xtdrone_lockstep::Messages>& received);
  bool hearStates(std::string_view message);
  bool hearState(std::string_view message) const;
  bool hearPose(std::string_view message);
  bool hearCommands(const xtdrone_lockstep::Messages& messages, double now);
  bool compute();

  std::size_t id_;
  Settings settings_;
  std::vector<Vector> offsets_;
  std::vector<Neighbour> neighbours_;
  std::string pattern_;
  std::string topology_;
  std::optional<xtdrone_control::VelocityCommands> commands_;
  std::optional<State> state_;

  // of the present turn, until it is certain that it is not left to Python
  std::vector<double> heard_states_;
  std::vector<double> heard_pose_;
  xtdrone_control::VelocityCommands next_commands_;
  std::vector<Vector> positions_;
  std::vector<Near> near_;
  Vector next_avoidance_{};
  Vector velocity_{};
};

}  // namespace xtdrone_coordination::follower_turn
