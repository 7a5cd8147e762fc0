/// A participant's wait for TICK.
#pragma once

#include <nanobind/nanobind.h>
#include <sys/socket.h>

#include <optional>

#include "frames.h"
#include "waiting.h"

namespace xtdrone_lockstep::io {

/// Return the content of a TICK or DONE for Python: tick, time_us, {channel: count}, {port: count}.
inline nanobind::tuple toTuple(const Barrier& barrier) {
  const std::size_t all = std::size_t{barrier.channels} + barrier.ports;
  const auto channels = nanobind::steal(pairsOf(barrier, 0, barrier.channels));
  const auto ports =
      channels.is_valid() ? nanobind::steal(pairsOf(barrier, barrier.channels, all)) : nanobind::object();
  if (!ports.is_valid()) {
    throw nanobind::python_error();
  }
  return nanobind::make_tuple(barrier.tick, barrier.time_us, channels, ports);
}

/// Result of a wait.
struct Arrival {
  /// Content of a single complete TICK.
  std::optional<Barrier> tick;
  /// Otherwise: other bytes from the simulator, empty at the end of the connection; or, if descriptors other than the
  /// simulator's are ready, a list of all that are.
  nanobind::object other;
};

/// Wait for the simulator's next data.
///
/// @param whole  Whether its next byte is the first of a frame.
/// @param data  LONGEST_READ bytes, to which the tick refers.
inline Arrival awaitTick(int epoll, int descriptor, double timeout, bool whole, char* data) {
  Events events;
  const int count = await(epoll, events, Limit(timeout));
  if (count != 1 || events[0].data.fd != descriptor) {
    nanobind::list others;
    for (int i = 0; i < count; ++i) {
      others.append(static_cast<int>(events[static_cast<std::size_t>(i)].data.fd));
    }
    return {std::nullopt, others};
  }
  const ssize_t size = recv(descriptor, data, LONGEST_READ, MSG_DONTWAIT);
  if (size < 0) {
    if (errno == EAGAIN || errno == EINTR) {
      return {std::nullopt, nanobind::list()};
    }
    raiseErrno();
  }
  const auto tick = whole ? readWhole(data, static_cast<std::size_t>(size), Kind::TICK) : std::nullopt;
  if (tick) {
    return {tick, {}};
  }
  return {std::nullopt, nanobind::bytes(data, static_cast<std::size_t>(size))};
}

}  // namespace xtdrone_lockstep::io
