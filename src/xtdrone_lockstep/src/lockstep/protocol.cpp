#include "protocol.h"

#include <unistd.h>

#include <array>
#include <fstream>

namespace xtdrone_lockstep {
namespace {

constexpr std::size_t HEAD_SIZE = 5;
constexpr std::size_t BARRIER_SIZE = 24;
constexpr std::size_t PAIR_SIZE = 12;

/// Append an integer, little-endian.
template <class Integer>
void put(std::string& out, Integer value) {
  const auto bits = static_cast<std::make_unsigned_t<Integer>>(value);
  for (std::size_t i = 0; i < sizeof(Integer); ++i) {
    out.push_back(static_cast<char>(static_cast<std::uint8_t>(bits >> (8 * i))));
  }
}

/// Decode a little-endian integer.
template <class Integer>
Integer get(const std::string& in, std::size_t offset) {
  std::make_unsigned_t<Integer> bits = 0;
  for (std::size_t i = 0; i < sizeof(Integer); ++i) {
    bits |= static_cast<std::make_unsigned_t<Integer>>(static_cast<std::uint8_t>(in[offset + i])) << (8 * i);
  }
  return static_cast<Integer>(bits);
}

void putHead(std::string& out, Kind kind, std::size_t payload) {
  put(out, static_cast<std::uint32_t>(1 + payload));
  put(out, static_cast<std::uint8_t>(kind));
}

}  // namespace

std::string packBarrier(Kind kind, const Barrier& barrier) {
  std::string out;
  const std::size_t payload = BARRIER_SIZE + PAIR_SIZE * barrier.channels.size();
  out.reserve(HEAD_SIZE + payload);
  putHead(out, kind, payload);
  put(out, barrier.tick);
  put(out, barrier.time_us);
  put(out, static_cast<std::uint32_t>(barrier.channels.size()));
  put(out, std::uint32_t{0});
  for (const auto& [channel, count] : barrier.channels) {
    put(out, channel);
    put(out, count);
  }
  return out;
}

std::string packObject(Kind kind, const nlohmann::json& content) {
  const std::string payload = content.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
  std::string out;
  putHead(out, kind, payload.size());
  return out + payload;
}

std::string packEmpty(Kind kind) {
  std::string out;
  putHead(out, kind, 0);
  return out;
}

Barrier unpackBarrier(const std::string& payload) {
  if (payload.size() < BARRIER_SIZE) {
    throw ProtocolError("barrier frame of " + std::to_string(payload.size()) + " bytes");
  }
  Barrier barrier;
  barrier.tick = get<std::uint64_t>(payload, 0);
  barrier.time_us = get<std::int64_t>(payload, 8);
  const std::uint64_t channels = get<std::uint32_t>(payload, 16);
  const std::uint64_t pairs = channels + get<std::uint32_t>(payload, 20);
  if (payload.size() != BARRIER_SIZE + PAIR_SIZE * pairs) {
    throw ProtocolError("barrier frame of " + std::to_string(payload.size()) + " bytes for " + std::to_string(pairs) +
                        " pairs");
  }
  barrier.channels.reserve(channels);
  for (std::size_t i = 0; i < channels; ++i) {
    const std::size_t offset = BARRIER_SIZE + PAIR_SIZE * i;
    barrier.channels.emplace_back(get<std::uint32_t>(payload, offset), get<std::uint64_t>(payload, offset + 4));
  }
  return barrier;
}

nlohmann::json unpackObject(const std::string& payload) {
  auto content = nlohmann::json::parse(payload, nullptr, false);
  if (!content.is_object()) {
    throw ProtocolError("not a JSON object: " + printable(payload, 40));
  }
  return content;
}

std::string printable(const std::string& text, std::size_t most) {
  static const char digits[] = "0123456789abcdef";
  std::string line;
  for (const char letter : text.substr(0, most)) {
    const auto code = static_cast<unsigned char>(letter);
    if (code < 0x20 || code == 0x7f) {
      line += {'\\', 'x', digits[code >> 4], digits[code & 15]};
    } else {
      line += letter;
    }
  }
  return text.size() <= most && line.size() <= most ? line : line.substr(0, most - 3) + "...";
}

std::optional<Frame> FrameReader::next() {
  if (buffer_.size() - read_ >= HEAD_SIZE) {
    const auto length = get<std::uint32_t>(buffer_, read_);
    if (length == 0 || length > MAX_FRAME) {
      throw ProtocolError("frame of " + std::to_string(length) + " bytes, allowed are 1 to " +
                          std::to_string(MAX_FRAME));
    }
    if (buffer_.size() - read_ >= 4 + std::size_t{length}) {
      Frame frame{static_cast<Kind>(buffer_[read_ + 4]), buffer_.substr(read_ + HEAD_SIZE, length - 1)};
      read_ += 4 + std::size_t{length};
      return frame;
    }
  }
  buffer_.erase(0, read_);
  read_ = 0;
  return std::nullopt;
}

void Digest::add(std::int64_t time_us, const std::uint8_t* data, std::uint32_t size) {
  std::string head;
  put(head, time_us);
  put(head, size);
  crc_.process_bytes(head.data(), head.size());
  crc_.process_bytes(data, size);
  ++messages_;
  bytes_ += size;
}

std::string processNamespace() {
  std::ifstream file("/proc/sys/kernel/random/boot_id");
  std::string boot;
  std::array<char, 64> pids;
  const ssize_t size = readlink("/proc/self/ns/pid", pids.data(), pids.size());
  if (!std::getline(file, boot) || size <= 0) {
    return "";
  }
  return boot + " " + std::string(pids.data(), static_cast<std::size_t>(size));
}

}  // namespace xtdrone_lockstep
