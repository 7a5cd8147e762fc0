/// Collision avoidance between vehicles, Algorithm 1 of the paper, for many vehicles at once.
///
/// The same as xtdrone_coordination.avoidance in Python, where the algorithm is explained: the same operations in the
/// same order, so that the results are equal to the last bit. This holds without -ffast-math and without contraction
/// to fused multiply-add (-ffp-contract=off). A grid of cells finds the vehicles that are near, so N vehicles cost
/// about N times their neighbours and not N times N.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <unordered_map>
#include <vector>

namespace xtdrone_coordination {

/// x, y, z; m or m/s, ENU.
using Vector = std::array<double, 3>;
/// Of all vehicles by number, m, ENU in one frame; nothing where unknown. Known ones are finite.
using Positions = std::vector<std::optional<Vector>>;

constexpr double AVOIDANCE_RADIUS = 1.5;  // m, b
constexpr double AVOIDANCE_GAIN = 1.0;    // m/s, kp

/// Returns one vehicle's contribution against another, m/s; zero beyond the radius.
///
/// @param r       From this vehicle to the other, m.
/// @param radius  b > 0, m.
/// @param gain    kp, m/s.
/// @param first   Whether this vehicle has the smaller number; only matters when both are at the same place.
inline Vector avoidOne(const Vector& r, double radius, double gain, bool first) {
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

/// Finds the vehicles that may be within a radius.
class Neighbourhood {
 public:
  /// @param positions  Must outlive this.
  /// @param radius     m, above 0.
  Neighbourhood(const Positions& positions, double radius) : positions_(positions), size_(radius * MARGIN) {
    gridded_ = positions.size() > FEW;
    for (std::size_t i = 0; gridded_ && i < positions.size(); ++i) {
      if (!positions[i]) {
        continue;
      }
      const std::optional<Cell> cell = cellOf(*positions[i]);
      if (cell) {
        cells_[key(*cell)].push_back(i);
      } else {
        gridded_ = false;  // too far away for exact cells: look at every pair
      }
    }
  }

  /// Puts into `found`, ascending, the numbers of known vehicles: at least those within the radius of a known one.
  void near(std::size_t index, std::vector<std::size_t>& found) const {
    found.clear();
    if (!gridded_) {
      for (std::size_t j = 0; j < positions_.size(); ++j) {
        if (positions_[j]) {
          found.push_back(j);
        }
      }
      return;
    }
    const Cell here = *cellOf(*positions_[index]);
    for (std::int64_t i = 0; i < 27; ++i) {
      const auto there = cells_.find(key({here[0] + i / 9 - 1, here[1] + i / 3 % 3 - 1, here[2] + i % 3 - 1}));
      if (there != cells_.end()) {
        found.insert(found.end(), there->second.begin(), there->second.end());
      }
    }
    std::sort(found.begin(), found.end());
  }

 private:
  using Cell = std::array<std::int64_t, 3>;

  /// A cell is wider than the radius by more than rounding can do, up to MOST cells away.
  static constexpr double MARGIN = 1.0 + 1e-6;
  static constexpr std::int64_t MOST = 1 << 20;
  /// Up to so many, looking at every pair is as fast.
  static constexpr std::size_t FEW = 24;

  std::optional<Cell> cellOf(const Vector& position) const {
    Cell cell;
    for (std::size_t i = 0; i < 3; ++i) {
      const double number = std::floor(position[i] / size_);
      if (!(std::abs(number) < MOST)) {
        return std::nullopt;
      }
      cell[i] = static_cast<std::int64_t>(number);
    }
    return cell;
  }

  static std::uint64_t key(const Cell& cell) {
    std::uint64_t packed = 0;
    for (const std::int64_t number : cell) {
      packed = packed << 21 | static_cast<std::uint64_t>(number + MOST);
    }
    return packed;
  }

  const Positions& positions_;
  double size_;
  bool gridded_ = false;
  std::unordered_map<std::uint64_t, std::vector<std::size_t>> cells_;
};

/// Returns the avoidance velocities of some vehicles, m/s ENU, zero where a vehicle's own position is unknown.
///
/// @param ids        Whose, each below positions.size().
/// @param positions  Of all vehicles.
/// @param radius     b > 0, m.
/// @param gain       kp, m/s.
inline std::vector<Vector> avoid(const std::vector<std::size_t>& ids, const Positions& positions,
                                 double radius = AVOIDANCE_RADIUS, double gain = AVOIDANCE_GAIN) {
  const Neighbourhood neighbourhood(positions, radius);
  const double square = radius * radius;
  std::vector<std::size_t> near;
  std::vector<Vector> velocities;
  velocities.reserve(ids.size());
  for (const std::size_t index : ids) {
    Vector sum{0.0, 0.0, 0.0};
    if (const auto& own = positions[index]) {
      neighbourhood.near(index, near);
      for (const std::size_t j : near) {
        const Vector& other = *positions[j];
        const double x = other[0] - (*own)[0], y = other[1] - (*own)[1], z = other[2] - (*own)[2];
        if (j == index || !(x * x + y * y + z * z < square)) {
          continue;
        }
        const auto [dx, dy, dz] = avoidOne({x, y, z}, radius, gain, index < j);
        sum = {sum[0] + dx, sum[1] + dy, sum[2] + dz};
      }
    }
    velocities.push_back(sum);
  }
  return velocities;
}

}  // namespace xtdrone_coordination
