// MAVLink frames: checksums, packing, splitting.

#include <nanobind/nanobind.h>

#include <cstdint>

namespace nb = nanobind;

namespace {
/// Checksum of MAVLink (X.25), see https://mavlink.io/en/guide/serialization.html
std::uint16_t checksum(nb::bytes data, std::uint16_t value) {
  const auto* bytes = static_cast<const std::uint8_t*>(data.data());
  for (std::size_t i = 0; i < data.size(); ++i) {
    std::uint8_t mixed = bytes[i] ^ static_cast<std::uint8_t>(value);
    mixed ^= static_cast<std::uint8_t>(mixed << 4);
    value = static_cast<std::uint16_t>((value >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4));
  }
  return value;
}
}  // namespace

NB_MODULE(mavlink_wire, module) {
  module.def("checksum", &checksum, nb::arg("data"), nb::arg("value") = 0xFFFF,
             "Return the checksum of MAVLink (X.25) over ``data``, continued from ``value``.");
}
