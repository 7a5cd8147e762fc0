#include "splitter.h"

#include <sys/socket.h>

#include <algorithm>
#include <cerrno>
#include <cstdint>

#include "frames.h"
#include "waiting.h"

namespace nb = nanobind;

namespace xtdrone_lockstep::io {
namespace {

/// Maximum bytes per read while the rest of a message exceeds the subscriber's buffer size.
constexpr std::size_t LONGEST_RECEIVE = 1 << 20;
/// Bytes before a message: its u32 length.
constexpr std::size_t LENGTH = 4;

/// Return the buffer of all connections.
///
/// Python's global lock guards it as long as no object is created that Python's garbage collector tracks: a collection
/// may run finalizers, and these let other threads run.
std::string& buffer(std::size_t size) {
  static std::string data;
  if (data.size() < size) {
    data.resize(size);
  }
  return data;
}

}  // namespace

nb::object Splitter::read(nb::handle sock, std::size_t size) {
  const int descriptor = PyObject_AsFileDescriptor(sock.ptr());
  require(descriptor >= 0);
  size = std::max({size, std::min(needed_, LONGEST_RECEIVE), std::size_t{1}});
  nb::list messages;
  std::string& data = buffer(size);
  const ssize_t received = recv(descriptor, data.data(), size, MSG_DONTWAIT);
  if (received < 0 && (errno == EAGAIN || errno == EINTR)) {
    return nb::none();
  }
  if (received <= 0) {
    errno = received == 0 ? ECONNRESET : errno;
    raiseErrno();
  }
  cut(data.data(), static_cast<std::size_t>(received), messages);
  return nb::make_tuple(messages, received);
}

nb::list Splitter::cut(const char* data, std::size_t size) {
  nb::list messages;
  cut(data, size, messages);
  return messages;
}

void Splitter::cut(const char* data, std::size_t size, nb::list& messages) {
  const bool is_whole = rest_.empty();
  if (!is_whole) {
    rest_.append(data, size);
    data = rest_.data();
    size = rest_.size();
  }
  std::size_t start = 0;
  needed_ = 0;
  while (size - start >= LENGTH) {
    const std::size_t end = start + LENGTH + load<std::uint32_t>(data + start);
    if (end > size) {
      needed_ = end - size;
      break;
    }
    messages.append(nb::bytes(data + start + LENGTH, end - start - LENGTH));
    ++returned_;
    start = end;
  }
  if (is_whole) {
    rest_.assign(data + start, size - start);
  } else {
    rest_.erase(0, start);
  }
}

void Splitter::putBack(const nb::list& messages) {
  std::string data;
  for (nb::handle message : messages) {
    const auto bytes = nb::cast<nb::bytes>(message);
    const auto length = static_cast<std::uint32_t>(bytes.size());
    data.append(reinterpret_cast<const char*>(&length), sizeof length);
    data.append(bytes.c_str(), bytes.size());
  }
  rest_.insert(0, data);
}

std::size_t Splitter::append(int descriptor) {
  const std::size_t size = std::max(LONGEST_READ, std::min(needed_, LONGEST_RECEIVE));
  std::string& data = buffer(size);
  const ssize_t received = recv(descriptor, data.data(), size, MSG_DONTWAIT);
  if (received <= 0) {
    return 0;
  }
  rest_.append(data.data(), static_cast<std::size_t>(received));
  return static_cast<std::size_t>(received);
}

void Splitter::view(std::size_t count, Messages& into) const {
  into.clear();
  for (std::size_t start = 0; into.size() < count && rest_.size() - start >= LENGTH;) {
    const std::size_t length = load<std::uint32_t>(rest_.data() + start);
    if (rest_.size() - start - LENGTH < length) {
      return;
    }
    into.emplace_back(rest_.data() + start + LENGTH, length);
    start += LENGTH + length;
  }
}

void Splitter::drop(std::size_t count) {
  std::size_t start = 0;
  for (; count > 0; --count) {
    start += LENGTH + load<std::uint32_t>(rest_.data() + start);
  }
  rest_.erase(0, start);
}

}  // namespace xtdrone_lockstep::io
