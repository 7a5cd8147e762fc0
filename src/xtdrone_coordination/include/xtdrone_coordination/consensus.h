/// The consensus law in the velocity form, equation 2 of the paper.
///
/// The C++ form of xtdrone_coordination.laws.consensus: the same operations in the same order, so results are
/// bit-identical without -ffast-math and without contraction to fused multiply-add (-ffp-contract=off).
#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace xtdrone_coordination {

/// x, y, z; m or m/s, ENU.
using Vector = std::array<double, 3>;

/// A neighbour: its number, and its weight w_ij > 0.
struct Neighbour {
  std::size_t id;
  double weight;
};

/// Returns the sum of all neighbours' terms times k_i, m/s; zero without neighbours.
///
/// @param index      This vehicle's number.
/// @param positions  Of all vehicles, m ENU.
/// @param offsets    Slots of all vehicles relative to the leader, m ENU.
/// @param gain       Kp, 1/s.
/// @param normalise  Whether to divide by the in-degree.
inline Vector velocityLaw(std::size_t index, const std::vector<Vector>& positions, const std::vector<Vector>& offsets,
                          const std::vector<Neighbour>& neighbours, double gain, bool normalise) {
  const auto [px, py, pz] = positions[index];
  const auto [dx, dy, dz] = offsets[index];
  double x = 0.0, y = 0.0, z = 0.0, degree = 0.0;
  for (const auto& [id, weight] : neighbours) {
    const auto [qx, qy, qz] = positions[id];
    const auto [ex, ey, ez] = offsets[id];
    x = x + weight * ((qx - ex) - (px - dx));
    y = y + weight * ((qy - ey) - (py - dy));
    z = z + weight * ((qz - ez) - (pz - dz));
    degree += weight;
  }
  if (degree == 0.0) {
    return {0.0, 0.0, 0.0};
  }
  const double k = normalise ? gain / degree : gain;
  return {k * x, k * y, k * z};
}

/// Returns a vector shortened to the length `limit` if it is longer; its direction stays.
inline Vector clip(const Vector& vector, double limit) {
  const auto [x, y, z] = vector;
  const double length = std::sqrt(x * x + y * y + z * z);
  if (length <= limit) {
    return vector;
  }
  const double k = limit / length;
  return {x * k, y * k, z * k};
}

}  // namespace xtdrone_coordination
