/// Frames between a participant and the simulator; described in xtdrone_lockstep/protocol.py.
#pragma once

#include <boost/crc.hpp>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace xtdrone_lockstep {

constexpr int VERSION = 2;
constexpr std::int64_t BASE_STEP_US = 4000;
constexpr std::int64_t DIGEST_PERIOD_US = 1'000'000;
constexpr std::uint32_t MAX_FRAME = 1u << 24;

enum class Kind : std::uint8_t {
  JOIN = 1,
  WELCOME = 2,
  REFUSED = 3,
  PEER = 4,
  DECLARE = 5,
  LEAVE = 6,
  TICK = 7,
  DONE = 8,
  ALIVE = 9,
  RESERVE = 10,
  DIGEST = 11,
};

/// The peer violates the protocol.
class ProtocolError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Content of a TICK or DONE; C++ participants exchange no datagrams with the simulator.
struct Barrier {
  std::uint64_t tick = 0;
  std::int64_t time_us = 0;
  /// Channel ids with cumulative numbers of messages; only channels whose count changed.
  std::vector<std::pair<std::uint32_t, std::uint64_t>> channels;
};

struct Frame {
  Kind kind;
  std::string payload;
};

std::string packBarrier(Kind kind, const Barrier& barrier);
/// Invalid UTF-8, as foreign nodes may supply in names, is replaced.
std::string packObject(Kind kind, const nlohmann::json& content);
std::string packEmpty(Kind kind);

/// @throws ProtocolError  The length does not match the number of pairs.
Barrier unpackBarrier(const std::string& payload);
/// @throws ProtocolError  The payload is not a JSON object.
nlohmann::json unpackObject(const std::string& payload);

/// Return a peer's text as one line for a log: control characters are escaped, text beyond `most` is truncated.
std::string printable(const std::string& text, std::size_t most = 500);

/// Splits a byte stream into frames.
class FrameReader {
 public:
  void feed(const char* data, std::size_t size) { buffer_.append(data, size); }

  /// Remove and return the next complete frame.
  ///
  /// @throws ProtocolError  A length is 0 or above MAX_FRAME.
  std::optional<Frame> next();

 private:
  std::string buffer_;
  std::size_t read_ = 0;
};

/// Running checksum of the messages published on one topic.
class Digest {
 public:
  /// Add one serialised message, without its length prefix, published at a simulation time.
  void add(std::int64_t time_us, const std::uint8_t* data, std::uint32_t size);

  std::uint64_t messages() const { return messages_; }
  std::uint64_t bytes() const { return bytes_; }
  std::uint32_t crc() const { return crc_.checksum(); }

 private:
  std::uint64_t messages_ = 0;
  std::uint64_t bytes_ = 0;
  boost::crc_32_type crc_;
};

/// Return an identifier shared by all processes that see the same process ids.
std::string processNamespace();

}  // namespace xtdrone_lockstep
