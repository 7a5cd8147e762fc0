/// Command lines and parameters, with the checks and messages of xtdrone_control.program.
#pragma once

#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace xtdrone_coordination {

/// A command line that cannot be run.
class ArgumentError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Returns a number of vehicles of a formation.
///
/// @param text   The argument.
/// @param kind   Vehicle type, as iris.
/// @param fleet  What the parameter /xtdrone/fleet says, if it is set: as iris:9 or iris:3,typhoon_h480:2.
/// @throws ArgumentError  Less than 2, more than allowed or than the fleet has, or an unknown type.
std::size_t parseCount(const std::string& text, const std::string& kind, const std::optional<std::string>& fleet);

/// Returns the vehicles' numbers, ascending, that a text names: a number, a range 0-8, a comma-separated list of these,
/// or all.
///
/// @param last  Greatest number allowed.
/// @param name  What to call the argument in messages.
/// @throws ArgumentError  Malformed, out of range, or empty.
std::vector<std::size_t> parseIds(const std::string& text, std::size_t last, const std::string& name);

}  // namespace xtdrone_coordination
