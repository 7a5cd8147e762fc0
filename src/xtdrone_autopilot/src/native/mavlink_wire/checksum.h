#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace mavlink_wire {
constexpr std::array<std::uint16_t, 256> make_checksum_table() {
  std::array<std::uint16_t, 256> table{};
  for (unsigned byte = 0; byte < 256; ++byte) {
    unsigned mixed = byte ^ (byte << 4 & 0xFF);
    table[byte] = static_cast<std::uint16_t>((mixed << 8) ^ (mixed << 3) ^ (mixed >> 4));
  }
  return table;
}

inline constexpr std::array<std::uint16_t, 256> kChecksumTable = make_checksum_table();

/// Checksum of MAVLink (X.25), see https://mavlink.io/en/guide/serialization.html
inline std::uint16_t checksum(const std::uint8_t* data, std::size_t size, std::uint16_t value = 0xFFFF) {
  for (std::size_t i = 0; i < size; ++i) {
    value = static_cast<std::uint16_t>(value >> 8 ^ kChecksumTable[(value ^ data[i]) & 0xFF]);
  }
  return value;
}
}  // namespace mavlink_wire
