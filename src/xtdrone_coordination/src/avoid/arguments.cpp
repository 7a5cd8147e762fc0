#include "arguments.h"

#include <algorithm>
#include <set>

namespace xtdrone_coordination {
namespace {

constexpr std::size_t MAX_VEHICLES = 250;
/// Stands for every number above the limits.
constexpr std::size_t TOO_MANY = 1'000'000'000;

const std::vector<std::string> MULTIROTORS{"iris", "solo", "typhoon_h480"};
const std::vector<std::string> OTHER_VEHICLES{"plane", "rover", "standard_vtol", "tiltrotor", "tailsitter"};

bool contains(const std::vector<std::string>& list, const std::string& item) {
  return std::find(list.begin(), list.end(), item) != list.end();
}

std::string join(const std::vector<std::string>& list) {
  std::string text;
  for (const std::string& item : list) {
    text += (text.empty() ? "" : ", ") + item;
  }
  return text;
}

std::string strip(const std::string& text) {
  static const char* const blank = " \t\n\r\f\v";
  const std::size_t begin = text.find_first_not_of(blank);
  return begin == std::string::npos ? "" : text.substr(begin, text.find_last_not_of(blank) - begin + 1);
}

std::vector<std::string> split(const std::string& text, char separator) {
  std::vector<std::string> parts;
  std::size_t begin = 0;
  for (std::size_t end; (end = text.find(separator, begin)) != std::string::npos; begin = end + 1) {
    parts.push_back(text.substr(begin, end - begin));
  }
  parts.push_back(text.substr(begin));
  return parts;
}

/// Returns a number written in digits alone, nothing if it is something else.
std::optional<std::size_t> digits(const std::string& text) {
  if (text.empty() || text.find_first_not_of("0123456789") != std::string::npos) {
    return std::nullopt;
  }
  return text.size() > 9 ? TOO_MANY : std::stoul(text);
}

bool isType(const std::string& text) {
  static const std::string letters = "abcdefghijklmnopqrstuvwxyz";
  return !text.empty() && letters.find(text[0]) != std::string::npos &&
         text.find_first_not_of(letters + "0123456789_") == std::string::npos;
}

/// Returns how many vehicles of each type there are, in the order of the text.
std::vector<std::pair<std::string, std::size_t>> parseFleet(const std::string& text) {
  std::vector<std::pair<std::string, std::size_t>> fleet;
  std::set<std::string> seen;
  std::size_t all = 0;
  for (const std::string& entry : split(text, ',')) {
    const auto parts = split(entry, ':');
    const std::string kind = strip(parts[0]);
    const auto count = parts.size() == 1 ? std::optional<std::size_t>(1) : digits(strip(parts[1]));
    if (parts.size() > 2 || !isType(kind) || !count) {
      throw ArgumentError("/xtdrone/fleet: vehicles: '" + entry + "' is not of the form type:count, as iris:9");
    }
    if (!seen.insert(kind).second) {
      throw ArgumentError("/xtdrone/fleet: vehicles: type '" + kind + "' is named twice in '" + text + "'");
    }
    all += *count;
    if (*count < 1 || all > MAX_VEHICLES) {
      throw ArgumentError("/xtdrone/fleet: vehicles: " + std::to_string(*count) + " of type '" + kind + "': 1 to " +
                          std::to_string(MAX_VEHICLES) + " vehicles in all are allowed");
    }
    fleet.emplace_back(kind, *count);
  }
  return fleet;
}

void checkFleet(std::size_t count, const std::string& kind, const std::string& text) {
  std::vector<std::string> types;
  for (const auto& [type, there] : parseFleet(text)) {
    if (type != kind) {
      types.push_back(type);
    } else if (count > there) {
      throw ArgumentError("number of vehicles: " + std::to_string(count) + ", but the fleet (/xtdrone/fleet) has " +
                          std::to_string(there) + " of type " + kind);
    } else {
      return;
    }
  }
  std::sort(types.begin(), types.end());
  throw ArgumentError("type: '" + kind + "' is not in the fleet (/xtdrone/fleet); it has " + join(types));
}

}  // namespace

std::size_t parseCount(const std::string& text, const std::string& kind, const std::optional<std::string>& fleet) {
  const auto count = digits(text);
  if (!count || *count < 1 || *count > MAX_VEHICLES) {
    throw ArgumentError("number of vehicles: '" + text + "' is not allowed, 1 to " + std::to_string(MAX_VEHICLES));
  }
  if (*count < 2) {
    throw ArgumentError("number of vehicles: 1 is not allowed, a formation has at least 2");
  }
  if (contains(OTHER_VEHICLES, kind)) {
    throw ArgumentError("type: '" + kind + "' is no multirotor; allowed are " + join(MULTIROTORS));
  }
  if (fleet) {
    checkFleet(*count, kind, *fleet);
  } else if (!contains(MULTIROTORS, kind)) {
    throw ArgumentError("type: unknown vehicle '" + kind + "'; allowed are " + join(MULTIROTORS));
  }
  return *count;
}

std::vector<std::size_t> parseIds(const std::string& text, std::size_t last, const std::string& name) {
  const std::string wanted = text == "all" ? "0-" + std::to_string(last) : text;
  std::set<std::size_t> ids;
  for (const std::string& part : split(wanted, ',')) {
    const auto ends = split(strip(part), '-');
    const auto low = digits(ends.front());
    const auto high = digits(ends.back());
    if (ends.size() > 2 || !low || !high || *high < *low) {
      throw ArgumentError(name + ": '" + text + "' is none of a number, a range as 0-8, a list as 1,3,5 and 'all'");
    }
    if (*high > last) {
      throw ArgumentError(name + ": " + std::to_string(*low > last ? *low : *high) + " is out of range, 0 to " +
                          std::to_string(last) + " are allowed");
    }
    for (std::size_t id = *low; id <= *high; ++id) {
      ids.insert(id);
    }
  }
  return {ids.begin(), ids.end()};
}

}  // namespace xtdrone_coordination
