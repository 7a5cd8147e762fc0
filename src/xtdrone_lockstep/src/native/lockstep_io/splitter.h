/// The receiving end of a topic connection.
#pragma once

#include <nanobind/nanobind.h>

#include <cstddef>
#include <cstdint>
#include <string>

#include "xtdrone_lockstep/turn_program.h"

namespace xtdrone_lockstep::io {

/// Splits the bytes of one connection into messages, each after its u32 length.
class Splitter {
 public:
  /// Read once, without waiting and at most ``size`` bytes or the rest of the present message up to 1 MiB.
  ///
  /// Python's global lock is held, so that no other thread closes the socket meanwhile.
  /// @return  Messages and number of bytes read; None if no data is available.
  /// @throws nanobind::python_error  OSError or ValueError: The connection is closed.
  nanobind::object read(nanobind::handle sock, std::size_t size);
  /// Return the messages that ``data`` completes.
  nanobind::list cut(const char* data, std::size_t size);

  // For compiled code, which takes messages from the splitter without creating objects for them:

  /// Insert messages before all others.
  void putBack(const nanobind::list& messages);
  /// Read once, without waiting; return the number of bytes, 0 if there are none or the connection has ended.
  std::size_t append(int descriptor);
  /// Refer to the first messages, at most ``count``, until the splitter changes.
  void view(std::size_t count, Messages& into) const;
  /// Remove the first messages.
  void drop(std::size_t count);
  /// Return the number of messages that `read` and `cut` have returned.
  std::uint64_t returned() const { return returned_; }

 private:
  void cut(const char* data, std::size_t size, nanobind::list& messages);

  std::string rest_;
  std::uint64_t returned_ = 0;
  std::size_t needed_ = 0;  // bytes until the message in rest_ is complete, as far as known
};

}  // namespace xtdrone_lockstep::io
