#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>
#include <string>
#include <vector>

#include "format.h"

namespace mavlink_wire {
constexpr std::size_t kSentAtOnce = 64;
constexpr int kInterrupted = -1;

/// Frames waiting to be sent to one client, each in a datagram.
class Outbox {
 public:
  Outbox(const std::string& host, std::uint16_t port, std::uint8_t system, std::uint8_t component)
      : system_(system), component_(component) {
    peer_.sin_family = AF_INET;
    peer_.sin_port = htons(port);
    valid_ = inet_pton(AF_INET, host.c_str(), &peer_.sin_addr) == 1;
  }

  std::size_t size() const { return ends_.size() - next_; }

  void put(const Format& format, nb::bytes payload) {
    if (payload.size() > kLargestPayload) throw nb::value_error("a payload of MAVLink has at most 255 bytes");
    std::uint8_t frame[kLargestFrame];
    const auto* data = static_cast<const std::uint8_t*>(payload.data());
    append(frame, format.write(data, payload.size(), sequence, system_, component_, frame));
  }

  void put_frame(nb::bytes frame) {
    if (frame.size() > kLargestFrame) throw nb::value_error("a frame of MAVLink has at most 280 bytes");
    append(static_cast<const std::uint8_t*>(frame.data()), frame.size());
  }

  /// Send the frames; return the number of accepted ones and the error of the next, 0 if all were accepted.
  nb::tuple send(int descriptor) {
    if (!valid_) return nb::make_tuple(0, size() > 0 ? EINVAL : 0);
    std::size_t accepted = 0;
    int error = 0;
    while (size() > 0 && error == 0) {
      const std::size_t wanted = std::min(size(), kSentAtOnce);
      const int count = send_some(descriptor, wanted);
      error = count < 0 ? errno : static_cast<std::size_t>(count) < wanted ? kInterrupted : 0;
      if (count > 0) {
        next_ += static_cast<std::size_t>(count);
        accepted += static_cast<std::size_t>(count);
      }
    }
    if (size() == 0) clear();
    return nb::make_tuple(accepted, error);
  }

  /// Discard the next frame.
  void drop() {
    if (size() > 0) ++next_;
    if (size() == 0) clear();
  }

  void clear() {
    data_.clear();
    ends_.clear();
    next_ = 0;
  }

  std::uint8_t sequence = 0;
  std::uint64_t queued = 0;
  std::uint64_t queued_bytes = 0;

 private:
  void append(const std::uint8_t* frame, std::size_t size) {
    data_.insert(data_.end(), frame, frame + size);
    ends_.push_back(data_.size());
    ++sequence;
    ++queued;
    queued_bytes += size;
  }

  int send_some(int descriptor, std::size_t wanted) {
    mmsghdr headers[kSentAtOnce] = {};
    iovec parts[kSentAtOnce];
    std::size_t start = next_ == 0 ? 0 : ends_[next_ - 1];
    for (std::size_t i = 0; i < wanted; ++i) {
      const std::size_t end = ends_[next_ + i];
      parts[i] = {data_.data() + start, end - start};
      headers[i].msg_hdr.msg_name = &peer_;
      headers[i].msg_hdr.msg_namelen = sizeof(peer_);
      headers[i].msg_hdr.msg_iov = &parts[i];
      headers[i].msg_hdr.msg_iovlen = 1;
      start = end;
    }
    int count;
    do {
      count = sendmmsg(descriptor, headers, static_cast<unsigned>(wanted), MSG_DONTWAIT | MSG_NOSIGNAL);
    } while (count < 0 && errno == EINTR);
    return count;
  }

  sockaddr_in peer_{};
  bool valid_;
  std::uint8_t system_;
  std::uint8_t component_;
  std::vector<std::uint8_t> data_;
  std::vector<std::size_t> ends_;  // of each frame in data_
  std::size_t next_ = 0;           // index of the next frame
};
}  // namespace mavlink_wire
