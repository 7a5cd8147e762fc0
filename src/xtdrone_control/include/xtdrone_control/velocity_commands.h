/// Velocity commands of one multirotor and the setpoint that follows from them.
///
/// The C++ form of a part of xtdrone_control.communication.commands: a vehicle whose setpoint changes by velocity
/// commands alone. Everything else is left to the Python class.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>

namespace xtdrone_control {

/// The vehicle's response to velocity commands, equal to MultirotorCore's.
struct VelocityCommands {
  /// Size of a serialised PositionTarget with an empty frame, preceded by its u32 length.
  static constexpr std::size_t PACKET = 103;
  static constexpr double LARGEST = 1e6;           // m/s, rad/s
  static constexpr double HOVER_YAW_RATE = 0.005;  // rad/s

  double hover_speed = 0.0;            // m/s
  double timeout = 0.0;                // s; 0 for never
  bool hovering = false;               // whether the setpoint is a captured pose
  double moving_since = std::nan("");  // s; NaN while the setpoint is not a velocity
  std::array<double, 4> last{};        // velocity, m/s ENU, and yaw rate, rad/s, of the last command that has moved it
  std::array<char, PACKET> packet{};   // the setpoint

  /// Handle a command: velocity, m/s ENU, and yaw rate, rad/s. Return false if the Python class has to.
  bool accept(const std::array<double, 4>& command, double now) {
    double sum = 0.0;
    bool dead = std::abs(command[3]) <= HOVER_YAW_RATE;
    for (std::size_t i = 0; i < 4; ++i) {
      sum += std::abs(command[i]);
      dead &= i == 3 || std::abs(command[i]) <= hover_speed;
    }
    if (!(sum <= LARGEST)) {
      return false;
    }
    if (dead) {
      return hovering;
    }
    hovering = false;
    moving_since = now;
    last = command;
    write(command);
    return true;
  }

  /// Return whether the last command is too old, so that the vehicle has to hover.
  bool timedOut(double now) const { return timeout > 0.0 && timeout < now - moving_since; }

  /// Return the setpoint with its header's sequence number and time.
  std::string stamped(std::uint32_t sequence, std::int64_t time_us) const {
    std::string result(packet.data(), packet.size());
    const auto seconds = static_cast<std::uint32_t>(time_us / 1'000'000);
    const auto nanoseconds = static_cast<std::uint32_t>(time_us % 1'000'000 * 1000);
    std::memcpy(result.data() + 4, &sequence, 4);
    std::memcpy(result.data() + 8, &seconds, 4);
    std::memcpy(result.data() + 12, &nanoseconds, 4);
    return result;
  }

 private:
  /// Make the setpoint one of velocity and yaw rate; the header stays.
  void write(const std::array<double, 4>& command) {
    constexpr std::uint8_t LOCAL_NED = 1;
    constexpr std::uint16_t IGNORE_ALL_BUT_VELOCITY_AND_YAW_RATE = 1 | 2 | 4 | 64 | 128 | 256 | 1024;
    constexpr std::size_t FRAME = 20, MASK = 21, VELOCITY = 47, YAW_RATE = 99;
    std::memset(packet.data() + FRAME, 0, PACKET - FRAME);
    std::memcpy(packet.data() + FRAME, &LOCAL_NED, 1);
    std::memcpy(packet.data() + MASK, &IGNORE_ALL_BUT_VELOCITY_AND_YAW_RATE, 2);
    std::memcpy(packet.data() + VELOCITY, command.data(), 24);
    const auto yaw_rate = static_cast<float>(command[3]);
    std::memcpy(packet.data() + YAW_RATE, &yaw_rate, 4);
  }
};

}  // namespace xtdrone_control
