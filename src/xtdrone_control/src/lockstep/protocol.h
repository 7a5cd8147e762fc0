/// Frames between a participant and the simulator; described in xtdrone_control/lockstep/protocol.py.
#pragma once

#include <boost/crc.hpp>
#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace xtdrone_control::lockstep {

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

/// The peer does not speak this protocol.
class ProtocolError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Content of a TICK or a DONE; a participant in C++ exchanges no datagrams with the simulator.
struct Barrier {
  std::uint64_t tick = 0;
  std::int64_t time_us = 0;
  /// Channel id and cumulative number of messages, those that changed.
  std::vector<std::pair<std::uint32_t, std::uint64_t>> channels;
};

struct Frame {
  Kind kind;
  std::string payload;
};

std::string packBarrier(Kind kind, const Barrier& barrier);
/// A text in it that is no UTF-8, as a foreign node may give, is mended.
std::string packObject(Kind kind, const nlohmann::json& content);
std::string packEmpty(Kind kind);

/// @throws ProtocolError  The length does not fit the number of pairs.
Barrier unpackBarrier(const std::string& payload);
/// @throws ProtocolError  It is no JSON object.
nlohmann::json unpackObject(const std::string& payload);

/// Returns a peer's text as one line for a log: control characters are escaped, what is longer than `most` is cut off.
std::string printable(const std::string& text, std::size_t most = 500);

/// Cuts a stream of bytes into frames.
class FrameReader {
 public:
  void feed(const char* data, std::size_t size) { buffer_.append(data, size); }

  /// Returns and removes the next complete frame.
  ///
  /// @throws ProtocolError  A length is 0 or above MAX_FRAME.
  std::optional<Frame> next();

 private:
  std::string buffer_;
  std::size_t read_ = 0;
};

/// What has been published on one topic, condensed.
class Digest {
 public:
  /// Adds one serialised message, without its length prefix, published at a simulation time.
  void add(std::int64_t time_us, const std::uint8_t* data, std::uint32_t size);

  std::uint64_t messages() const { return messages_; }
  std::uint64_t bytes() const { return bytes_; }
  std::uint32_t crc() const { return crc_.checksum(); }

 private:
  std::uint64_t messages_ = 0;
  std::uint64_t bytes_ = 0;
  boost::crc_32_type crc_;
};

/// A text that is the same in two processes exactly if a pid of one names the same process in the other.
std::string processNamespace();

}  // namespace xtdrone_control::lockstep
