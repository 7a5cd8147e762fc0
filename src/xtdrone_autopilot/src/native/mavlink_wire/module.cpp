// MAVLink frames: checksums, packing, splitting, decoding; datagrams; telemetry from the autopilot's records.

#include <nanobind/stl/string.h>

#include "checksum.h"
#include "format.h"

namespace nb = nanobind;

NB_MODULE(mavlink_wire, module) {
  nb::set_leak_warnings(false);  // decoders live as long as the program
  module.def(
      "checksum",
      [](nb::bytes data, std::uint16_t value) {
        return mavlink_wire::checksum(static_cast<const std::uint8_t*>(data.data()), data.size(), value);
      },
      nb::arg("data"), nb::arg("value") = 0xFFFF,
      "Return the checksum of MAVLink (X.25) over ``data``, continued from ``value``.");
  mavlink_wire::bind_format(module);
  mavlink_wire::bind_datagrams(module);
  mavlink_wire::bind_streams(module);
  mavlink_wire::bind_telemetry(module);
}
