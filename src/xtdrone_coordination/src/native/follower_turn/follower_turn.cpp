#include "follower_turn.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#include "serialised.h"

namespace xtdrone_coordination::follower_turn {
namespace {

using xtdrone_control::VelocityCommands;
using xtdrone_lockstep::Messages;
using xtdrone_lockstep::Publication;

enum Received { PATTERN, TOPOLOGY, STATES, STATE, POSE, COMMAND, RECEIVED };
constexpr std::size_t STATE_FIELDS = 6;
constexpr double LARGEST = 1e6;  // of a pose's numbers

/// Return time in seconds as rospy.Time.to_sec.
double secondsOf(std::int64_t time_us) {
  return static_cast<double>(time_us / 1'000'000) + static_cast<double>(time_us % 1'000'000 * 1000) / 1e9;
}

bool isFinite(const Vector& vector) {
  return std::isfinite(vector[0]) && std::isfinite(vector[1]) && std::isfinite(vector[2]);
}

/// Return whether all messages repeat the known data.
bool repeats(const Messages& messages, const std::string& known, std::size_t width) {
  return std::all_of(messages.begin(), messages.end(), [&](std::string_view message) {
    const auto numbers = numbersOf(message, width);
    return !known.empty() && numbers && *numbers == known;
  });
}

/// Fill a packet: u32 length, then numbers, then `zeros` zeros.
void write(std::string& packet, const Vector& vector, std::size_t zeros) {
  const auto size = static_cast<std::uint32_t>(sizeof vector + zeros * sizeof(double));
  packet.assign(sizeof size + size, '\0');
  std::memcpy(packet.data(), &size, sizeof size);
  std::memcpy(packet.data() + sizeof size, vector.data(), sizeof vector);
}

}  // namespace

FollowerTurn::FollowerTurn(std::size_t id, const Settings& settings, std::vector<Vector> offsets,
                           std::vector<Neighbour> neighbours)
    : id_(id),
      settings_(settings),
      offsets_(std::move(offsets)),
      neighbours_(std::move(neighbours)),
      heard_states_(STATE_FIELDS * offsets_.size()),
      positions_(offsets_.size()) {}

void FollowerTurn::ignore(std::string pattern, std::string topology) {
  pattern_ = std::move(pattern);
  topology_ = std::move(topology);
}

void FollowerTurn::carryOut(const VelocityCommands& commands, std::optional<State> state) {
  commands_ = commands;
  state_ = std::move(state);
}

bool FollowerTurn::turn(std::int64_t time_us, const std::vector<Messages>& received,
                        std::vector<Publication>& published) {
  const double now = secondsOf(time_us);
  if (received.size() != RECEIVED || !hear(received) || (commands_ && !hearCommands(received[COMMAND], now)) ||
      !compute()) {
    return false;
  }
  ++turns;
  std::swap(states, heard_states_);
  heard_states_.resize(states.size());
  if (!received[POSE].empty()) {
    pose = heard_pose_;
  }
  avoidance = next_avoidance_;
  auto publication = published.begin();
  if (commands_) {
    if (next_commands_.moving_since == now) {
      command.assign(next_commands_.last.begin(), next_commands_.last.end());
      command.push_back(now);
    }
    commands_ = next_commands_;
    publication->packet = commands_->stamped(publication->sequence, time_us);
    ++publication;
  }
  write(publication->packet, velocity_, 3);
  if (++publication != published.end()) {
    write(publication->packet, avoidance, 0);
  }
  return true;
}

bool FollowerTurn::hear(const std::vector<Messages>& received) {
  const auto all = [](const Messages& messages, auto accept) {
    return std::all_of(messages.begin(), messages.end(), accept);
  };
  return !received[STATES].empty() && repeats(received[PATTERN], pattern_, sizeof(float)) &&
         repeats(received[TOPOLOGY], topology_, sizeof(std::int32_t)) &&
         all(received[STATES], [this](std::string_view message) { return hearStates(message); }) &&
         all(received[STATE], [this](std::string_view message) { return hearState(message); }) &&
         all(received[POSE], [this](std::string_view message) { return hearPose(message); });
}

/// Store positions and velocities of all vehicles; return false unless all are finite.
bool FollowerTurn::hearStates(std::string_view message) {
  const auto numbers = numbersOf(message, sizeof(double));
  const std::size_t size = heard_states_.size() * sizeof(double);
  if (!numbers || numbers->size() < size) {
    return false;
  }
  std::memcpy(heard_states_.data(), numbers->data(), size);
  double sum = 0.0;
  for (const double number : heard_states_) {
    sum += number;
  }
  for (std::size_t i = 0; i < positions_.size(); ++i) {
    std::copy_n(heard_states_.begin() + static_cast<std::ptrdiff_t>(STATE_FIELDS * i), 3, positions_[i].begin());
  }
  return std::isfinite(sum);
}

/// Return whether mavros/state repeats the known state.
bool FollowerTurn::hearState(std::string_view message) const {
  Fields fields(message);
  fields.skipHeader();
  fields.take<std::uint8_t>();  // connected
  const bool armed = fields.take<std::uint8_t>() != 0;
  fields.take(2);  // guided, manual_input
  const std::string_view mode = fields.takeText();
  fields.take<std::uint8_t>();  // system_status
  return fields.complete() && state_ && state_->armed == armed && state_->mode == mode;
}

bool FollowerTurn::hearPose(std::string_view message) {
  Fields fields(message);
  fields.skipHeader();
  heard_pose_.resize(7);
  double sum = 0.0;
  for (double& number : heard_pose_) {
    number = fields.take<double>();
    sum += std::abs(number);
  }
  return fields.complete() && sum <= LARGEST;
}

/// Apply the velocity commands of this turn; return false if anything else follows than a setpoint of velocity or the
/// present one.
bool FollowerTurn::hearCommands(const Messages& messages, double now) {
  next_commands_ = *commands_;
  for (const std::string_view message : messages) {
    std::array<double, 6> twist;
    if (message.size() != sizeof twist) {
      return false;
    }
    std::memcpy(twist.data(), message.data(), sizeof twist);
    if (!next_commands_.accept({twist[0], twist[1], twist[2], twist[5]}, now)) {
      return false;
    }
  }
  return !next_commands_.timedOut(now);
}

/// Compute avoidance and velocity command; return false unless both are finite.
bool FollowerTurn::compute() {
  const Settings& s = settings_;
  next_avoidance_ = {0.0, 0.0, 0.0};
  near_.clear();
  if (s.avoids) {
    findNear(id_, positions_, s.radius, near_);
    next_avoidance_ = avoidNear(id_, near_, s.radius);
  }
  const Vector law = velocityLaw(id_, positions_, offsets_, neighbours_, s.gain, s.normalise);
  if (!isFinite(next_avoidance_) || !isFinite(law)) {
    return false;
  }
  const auto [x, y, z] = clip(law, s.limit);
  const auto [ax, ay, az] = next_avoidance_;
  const double k = s.avoidance_gain;
  velocity_ = clip({x + k * ax, y + k * ay, z + k * az}, s.limit);
  if (s.avoids && s.clearance > 0.0) {
    velocity_ = giveWayTo(near_, velocity_, s.radius, s.clearance);
  }
  return true;
}

}  // namespace xtdrone_coordination::follower_turn
