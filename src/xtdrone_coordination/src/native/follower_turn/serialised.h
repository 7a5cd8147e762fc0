/// Fields of serialised ROS messages.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <string_view>

namespace xtdrone_coordination::follower_turn {

/// Takes fields from a message; after the first that is incomplete, `valid` is false and all values are zero.
class Fields {
 public:
  explicit Fields(std::string_view message) : left_(message) {}

  template <typename Number>
  Number take() {
    Number value{};
    const std::string_view bytes = take(sizeof value);
    if (valid_) {
      std::memcpy(&value, bytes.data(), sizeof value);
    }
    return value;
  }

  std::string_view take(std::size_t size) {
    valid_ = valid_ && size <= left_.size();
    if (!valid_) {
      return {};
    }
    const std::string_view taken = left_.substr(0, size);
    left_.remove_prefix(size);
    return taken;
  }

  /// Take a string, or an array of bytes: u32 length, then these.
  std::string_view takeText() { return take(take<std::uint32_t>()); }
  void skipHeader() {
    take(12);
    takeText();
  }
  /// Return whether all fields were present and no byte is left.
  bool complete() const { return valid_ && left_.empty(); }
  bool valid() const { return valid_; }

 private:
  std::string_view left_;
  bool valid_ = true;
};

/// Return the bytes of the numbers of a std_msgs/...MultiArray; nullopt if it is malformed.
///
/// @param width  Bytes of a number.
inline std::optional<std::string_view> numbersOf(std::string_view message, std::size_t width) {
  Fields fields(message);
  for (auto dimensions = fields.take<std::uint32_t>(); dimensions > 0 && fields.valid(); --dimensions) {
    fields.takeText();
    fields.take(8);
  }
  fields.take<std::uint32_t>();
  const std::size_t count = fields.take<std::uint32_t>();
  const std::string_view numbers = fields.take(count * width);
  return fields.complete() ? std::optional(numbers) : std::nullopt;
}

}  // namespace xtdrone_coordination::follower_turn
