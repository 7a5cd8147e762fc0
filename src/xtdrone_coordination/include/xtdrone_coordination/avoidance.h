/// Collision avoidance between vehicles, Algorithm 1 of the paper.
///
/// The C++ form of xtdrone_coordination.laws.formation_avoidance, which explains the algorithm: the same operations in
/// the same order, so results are bit-identical without -ffast-math and without contraction to fused multiply-add
/// (-ffp-contract=off).
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <optional>
#include <vector>

#include "xtdrone_coordination/consensus.h"

namespace xtdrone_coordination {

/// Of all vehicles by number, m, ENU in one frame; empty where unknown. Known ones are finite.
using Positions = std::vector<std::optional<Vector>>;

constexpr double AVOIDANCE_RADIUS = 1.5;  // m, b
constexpr double AVOIDANCE_GAIN = 1.0;    // m/s, kp

/// Returns the contribution of one other vehicle to the avoidance velocity, m/s; zero beyond the radius.
///
/// @param r       From this vehicle to the other, m.
/// @param radius  b > 0, m.
/// @param gain    kp, m/s.
/// @param first   Whether this vehicle has the smaller number; only matters for coincident vehicles.
inline Vector contribution(const Vector& r, double radius, double gain, bool first) {
  constexpr double COINCIDENT = 1e-6;  // m
  auto [x, y, z] = r;
  const double distance = std::sqrt(x * x + y * y + z * z);
  if (!(distance < radius)) {
    return {0.0, 0.0, 0.0};
  }
  if (distance < COINCIDENT) {
    x = first ? 1.0 : -1.0;
    y = 0.0;
    z = 0.0;
  }
  const bool along_x = std::abs(x) < std::abs(y);
  const double ax = along_x ? 0.0 : -z;  // r x (1, 0, 0), or r x (0, 1, 0)
  const double ay = along_x ? z : 0.0;
  const double az = along_x ? -y : x;
  const double k = gain * (1.0 - distance / radius) / std::sqrt(ax * ax + ay * ay + az * az);
  return {k * ax, k * ay, k * az};
}

/// Returns the avoidance velocity of a vehicle, m/s ENU, zero where its own position is unknown.
///
/// @param index      Its number, below positions.size().
/// @param positions  Of all vehicles.
/// @param radius     b > 0, m.
/// @param gain       kp, m/s.
inline Vector avoid(std::size_t index, const Positions& positions, double radius = AVOIDANCE_RADIUS,
                    double gain = AVOIDANCE_GAIN) {
  Vector sum{0.0, 0.0, 0.0};
  const auto& own = positions[index];
  for (std::size_t j = 0; own && j < positions.size(); ++j) {
    if (j == index || !positions[j]) {
      continue;
    }
    const auto& [ox, oy, oz] = *positions[j];
    const double x = ox - (*own)[0], y = oy - (*own)[1], z = oz - (*own)[2];
    if (x * x + y * y + z * z < radius * radius) {
      const auto [dx, dy, dz] = contribution({x, y, z}, radius, gain, index < j);
      sum = {sum[0] + dx, sum[1] + dy, sum[2] + dz};
    }
  }
  return sum;
}

/// A near vehicle: its number, and its position relative to this vehicle, m.
struct Near {
  std::size_t id;
  Vector place;
};

/// Sets `near` to the vehicles within `radius`, m, of vehicle `index`; all positions are known.
inline void findNear(std::size_t index, const std::vector<Vector>& positions, double radius, std::vector<Near>& near) {
  const auto [px, py, pz] = positions[index];
  const double square = radius * radius;
  near.clear();
  for (std::size_t j = 0; j < positions.size(); ++j) {
    const double x = positions[j][0] - px, y = positions[j][1] - py, z = positions[j][2] - pz;
    if (j != index && x * x + y * y + z * z < square) {
      near.push_back({j, {x, y, z}});
    }
  }
}

/// Returns the avoidance velocity of vehicle `index`, m/s ENU, from the vehicles within `radius`.
inline Vector avoidNear(std::size_t index, const std::vector<Near>& near, double radius, double gain = AVOIDANCE_GAIN) {
  Vector sum{0.0, 0.0, 0.0};
  for (const auto& [id, place] : near) {
    const auto [dx, dy, dz] = contribution(place, radius, gain, index < id);
    sum = {sum[0] + dx, sum[1] + dy, sum[2] + dz};
  }
  return sum;
}

/// Returns a velocity, m/s, with its component towards one near vehicle reduced.
///
/// @param r          From this vehicle to the other, m; shorter than `radius`.
/// @param clearance  Below `radius`, m.
inline Vector yielding(const Vector& r, const Vector& velocity, double radius, double clearance) {
  constexpr double COINCIDENT_SQUARE = 1e-6 * 1e-6;  // m^2
  const auto [x, y, z] = r;
  const auto [vx, vy, vz] = velocity;
  const double square = x * x + y * y + z * z;
  const double towards = x * vx + y * vy + z * vz;
  if (towards <= 0.0 || square <= COINCIDENT_SQUARE) {
    return velocity;
  }
  double remains = (std::sqrt(square) - clearance) / (radius - clearance);
  if (!(remains > 0.0)) {
    remains = 0.0;
  }
  const double k = (1.0 - remains * remains) * towards / square;
  return {vx - k * x, vy - k * y, vz - k * z};
}

/// Returns a velocity, m/s ENU, reduced towards the near vehicles; clearance above 0.
inline Vector giveWayTo(const std::vector<Near>& near, Vector velocity, double radius, double clearance) {
  constexpr int ROUNDS = 2;
  for (int round = 0; round < ROUNDS; ++round) {
    for (const Near& other : near) {
      velocity = yielding(other.place, velocity, radius, clearance);
    }
  }
  return velocity;
}

}  // namespace xtdrone_coordination
