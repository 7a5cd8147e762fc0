/// The receiving end of a topic connection.
#pragma once

#include <nanobind/nanobind.h>

#include <cstddef>
#include <string>

namespace xtdrone_control::lockstep_io {

/// Splits the bytes of one connection into messages, each after its u32 length.
class Splitter {
 public:
  /// Read once, without waiting and at most ``size`` bytes or the rest of the present message up to 1 MiB.
  ///
  /// Python's global lock is held, so that no other thread closes the socket meanwhile.
  /// @return  Messages and number of bytes read; None if no data is at hand.
  /// @throws nanobind::python_error  OSError or ValueError: The connection is closed.
  nanobind::object read(nanobind::handle sock, std::size_t size);
  /// Return the messages that ``data`` completes.
  nanobind::list cut(const char* data, std::size_t size);

 private:
  void cut(const char* data, std::size_t size, nanobind::list& messages);

  std::string rest_;
  std::size_t needed_ = 0;  // bytes until the message in rest_ is complete, as far as known
};

}  // namespace xtdrone_control::lockstep_io
