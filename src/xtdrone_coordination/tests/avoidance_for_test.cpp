/// The C++ avoidance as test_avoidance_cpp.py calls it.

#include <xtdrone_coordination/avoidance.h>

/// @param positions   3 numbers a vehicle; a NaN: unknown.
/// @param velocities  Takes 3 numbers a vehicle.
extern "C" void avoidAll(const double* positions, std::size_t count, double radius, double gain, double* velocities) {
  xtdrone_coordination::Positions known(count);
  std::vector<std::size_t> ids;
  for (std::size_t i = 0; i < count; ++i) {
    ids.push_back(i);
    if (!std::isnan(positions[3 * i])) {
      known[i] = {positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]};
    }
  }
  for (const auto& velocity : xtdrone_coordination::avoid(ids, known, radius, gain)) {
    velocities = std::copy(velocity.begin(), velocity.end(), velocities);
  }
}
