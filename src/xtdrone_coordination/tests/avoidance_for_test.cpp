/// Entry point for test_avoidance_cpp.py.

#include <xtdrone_coordination/avoidance.h>

#include <algorithm>

/// @param positions   3 numbers per vehicle; NaN if unknown.
/// @param velocities  Receives 3 numbers per vehicle.
extern "C" void avoidAll(const double* positions, std::size_t count, double radius, double gain, double* velocities) {
  xtdrone_coordination::Positions known(count);
  for (std::size_t i = 0; i < count; ++i) {
    if (!std::isnan(positions[3 * i])) {
      known[i] = {positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]};
    }
  }
  for (std::size_t i = 0; i < count; ++i) {
    const auto velocity = xtdrone_coordination::avoid(i, known, radius, gain);
    velocities = std::copy(velocity.begin(), velocity.end(), velocities);
  }
}
