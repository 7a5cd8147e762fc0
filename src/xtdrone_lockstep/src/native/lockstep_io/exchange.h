/// The server's exchange of TICK and DONE with the participants.
#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>
#include <string>
#include <unordered_map>
#include <vector>

#include "frames.h"
#include "waiting.h"

namespace xtdrone_lockstep::io {

/// Sends TICK and accepts DONE; everything else that clients send is left to the caller.
///
/// The tables of counts stay Python's: DONE is routed to them as `Channels.count` does.
class Exchange {
 public:
  /// @param epoll  Descriptor of the epoll set with all connections.
  explicit Exchange(int epoll) : epoll_(epoll), data_(LONGEST_READ, '\0') {}

  /// Accept DONE from a connection.
  ///
  /// @param routes  By the participant's own number, where its counts go: (dictionary, key).
  /// @param closing  Numbers of closed connections; while there are any, DONE is left to the caller.
  void add(int descriptor, nanobind::dict routes, nanobind::list closing);
  void remove(int descriptor);
  /// Set whether all data of a connection is left to the caller.
  void hold(int descriptor, bool held);
  /// Stop awaiting DONE from a connection.
  void release(int descriptor);

  /// Send TICK on each connection, with the counts of its dictionary, which is cleared.
  ///
  /// @param rows  Descriptor and dictionary {channel: count}.
  /// @return  For each frame that was not sent completely: descriptor, the rest, errno (0 if the kernel accepts no
  /// more).
  nanobind::list send(std::uint64_t tick, std::int64_t time_us, const nanobind::list& rows);
  /// Await DONE of a tick from a connection whose TICK the caller has sent.
  void expect(int descriptor, std::uint64_t tick);

  /// Wait until no DONE is awaited any more, or until there is something else to do.
  ///
  /// @return  Completed turns (descriptor, {port: count} or None); other events (descriptor, epoll's mask, data read
  ///          or None, errno of the read).
  nanobind::tuple poll(double timeout);

 private:
  struct Seat {
    nanobind::dict routes;
    nanobind::list closing;
    std::uint64_t awaited = 0;  // tick
    bool held = false;
  };
  using Seats = std::unordered_map<int, Seat>;

  void handle(const epoll_event& event, nanobind::list& others);
  bool accept(int descriptor, Seat& seat, const char* data, std::size_t size);
  void stopAwaiting(Seat& seat);
  void forget(int descriptor);

  int epoll_;
  Seats seats_;
  std::size_t awaited_ = 0;
  nanobind::list completed_;  // turns since the last poll that returned
  std::string data_;
  std::string frame_;
};

}  // namespace xtdrone_lockstep::io
