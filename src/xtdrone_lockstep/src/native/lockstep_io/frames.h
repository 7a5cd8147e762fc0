/// TICK and DONE frames, as described in xtdrone_lockstep/protocol.py.
#pragma once

#include <Python.h>

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace xtdrone_lockstep::io {

/// Frame types with packed content.
enum class Kind : std::uint8_t { TICK = 7, DONE = 8 };

/// Bytes before the payload: u32 length, u8 type.
constexpr std::size_t HEAD = 5;
/// Bytes of a payload without pairs: u64 tick, i64 time_us, u32 n, u32 m.
constexpr std::size_t BARRIER = 24;
/// Bytes of a pair: u32 id, u64 count.
constexpr std::size_t PAIR = 12;

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers are copied as they are on the wire");

template <typename Number>
Number load(const char* from) {
  Number value;
  std::memcpy(&value, from, sizeof value);
  return value;
}

template <typename Number>
void store(char*& to, Number value) {
  std::memcpy(to, &value, sizeof value);
  to += sizeof value;
}

/// The payload of a TICK or DONE; refers to the bytes that it was read from.
struct Barrier {
  std::uint64_t tick;
  std::int64_t time_us;
  std::uint32_t channels;
  std::uint32_t ports;
  const char* pairs;

  std::uint32_t id(std::size_t index) const { return load<std::uint32_t>(pairs + index * PAIR); }
  std::uint64_t count(std::size_t index) const { return load<std::uint64_t>(pairs + index * PAIR + 4); }
};

/// Read a payload; return nullopt if its length does not match the number of pairs.
inline std::optional<Barrier> readPayload(const char* data, std::size_t size) {
  if (size < BARRIER) {
    return std::nullopt;
  }
  const Barrier barrier{load<std::uint64_t>(data), load<std::int64_t>(data + 8), load<std::uint32_t>(data + 16),
                        load<std::uint32_t>(data + 20), data + BARRIER};
  const std::uint64_t pairs = std::uint64_t{barrier.channels} + barrier.ports;
  return size == BARRIER + PAIR * pairs ? std::optional(barrier) : std::nullopt;
}

/// Read bytes that are exactly one frame of a type; return nullopt for all others.
inline std::optional<Barrier> readWhole(const char* data, std::size_t size, Kind kind) {
  const bool whole = size >= HEAD && load<std::uint32_t>(data) == size - 4 && data[4] == static_cast<char>(kind);
  return whole ? readPayload(data + HEAD, size - HEAD) : std::nullopt;
}

/// Return the pairs from ``begin`` to before ``end`` as a new dictionary {id: count}; null with an exception set.
PyObject* pairsOf(const Barrier& barrier, std::size_t begin, std::size_t end);

/// Append a complete frame. The dictionaries are {id: count}; a number out of range raises Python's OverflowError.
void pack(std::string& frames, Kind kind, std::uint64_t tick, std::int64_t time_us, PyObject* channels,
          PyObject* ports);

/// Append a complete DONE with counts of channels alone.
void packDone(std::string& frames, std::uint64_t tick, std::int64_t time_us,
              const std::vector<std::pair<std::uint32_t, std::uint64_t>>& channels);

/// Set ``dict[key] = value``; return false with an exception set.
bool setNumber(PyObject* dict, PyObject* key, std::uint64_t value);

}  // namespace xtdrone_lockstep::io
