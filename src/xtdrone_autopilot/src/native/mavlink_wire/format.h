#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

namespace mavlink_wire {
namespace nb = nanobind;

constexpr std::size_t kLargestPayload = 255;
constexpr std::size_t kLargestFrame = 280;
constexpr std::size_t kHeader1 = 6;
constexpr std::size_t kHeader2 = 10;
constexpr std::size_t kChecksumSize = 2;
constexpr std::size_t kSignatureSize = 13;
constexpr std::uint8_t kMagic1 = 0xFE;
constexpr std::uint8_t kMagic2 = 0xFD;
constexpr std::uint8_t kSigned = 0x01;

/// Size of a payload without its trailing zeros, which MAVLink 2 omits; at least 1.
inline std::size_t truncated(const std::uint8_t* payload, std::size_t size) {
  while (size > 1 && payload[size - 1] == 0) --size;
  return size;
}

inline nb::bytes to_bytes(const std::uint8_t* data, std::size_t size) { return nb::bytes(data, size); }

/// One number or text of a payload.
struct Field {
  char kind;  // as in Python's module struct
  std::uint16_t offset;
  std::uint16_t size;  // bytes
};

/// Wire format of one message.
class Format {
 public:
  /// @param fields format of Python's module struct, little-endian
  Format(std::uint32_t number, std::uint8_t crc_extra, const std::string& fields);

  std::uint8_t crc_extra() const { return crc_extra_; }
  std::size_t size() const { return size_; }
  std::size_t count() const { return fields_.size(); }

  /// Return the MAVLink 2 payload, or None if a value has another type than expected or is out of range.
  nb::object payload(nb::handle values) const;
  nb::bytes frame(nb::bytes payload, std::uint8_t sequence, std::uint8_t system, std::uint8_t component) const;
  /// Write the MAVLink 2 frame of a payload of at most 255 bytes and return its size.
  std::size_t write(const std::uint8_t* payload, std::size_t size, std::uint8_t sequence, std::uint8_t system,
                    std::uint8_t component, std::uint8_t* frame) const;
  /// Return a new reference to field `index` of a payload of `size()` bytes; nullptr after a Python error.
  PyObject* value(std::size_t index, const std::uint8_t* payload) const;

 private:
  std::uint32_t number_;
  std::uint8_t crc_extra_;
  std::size_t size_ = 0;
  std::vector<Field> fields_;
};

void bind_format(nb::module_& module);
void bind_datagrams(nb::module_& module);
void bind_streams(nb::module_& module);
void bind_telemetry(nb::module_& module);
}  // namespace mavlink_wire
