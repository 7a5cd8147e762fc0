// Datagrams: splitting into frames, receiving, and the frames waiting for a client. Sockets are non-blocking, so the
// calls keep Python's lock: releasing it costs more than the calls.

#include <arpa/inet.h>
#include <nanobind/stl/string.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>

#include "checksum.h"
#include "format.h"
#include "outbox.h"

namespace mavlink_wire {
namespace {
constexpr std::size_t kLargestDatagram = 65535;
constexpr unsigned kReadAtOnce = 16;

/// Beginning of a frame.
struct Head {
  std::size_t size;  // of the whole frame
  std::uint32_t number;
  std::uint8_t system;
  std::uint8_t component;
};

/// Read the beginning of a frame from `size` bytes; false if no complete frame with known flags begins there.
bool read_head(const std::uint8_t* data, std::size_t size, Head& head) {
  if (data[0] == kMagic2 && size >= kHeader2) {
    const std::uint8_t flags = data[2];
    if ((flags & ~kSigned) != 0) return false;
    head.size = kHeader2 + data[1] + kChecksumSize + ((flags & kSigned) != 0 ? kSignatureSize : 0);
    head.number = static_cast<std::uint32_t>(data[7] | data[8] << 8 | data[9] << 16);
    head.system = data[5];
    head.component = data[6];
  } else if (data[0] == kMagic1 && size >= kHeader1) {
    head.size = kHeader1 + data[1] + kChecksumSize;
    head.number = data[5];
    head.system = data[3];
    head.component = data[4];
  } else {
    return false;
  }
  return head.size <= size;
}

nb::tuple split(nb::bytes datagram) {
  const auto* data = static_cast<const std::uint8_t*>(datagram.data());
  const std::size_t size = datagram.size();
  nb::list frames;
  std::size_t start = 0;
  Head head{};
  while (start < size && read_head(data + start, size - start, head)) {
    nb::object frame = head.size == size ? nb::object(datagram) : nb::object(to_bytes(data + start, head.size));
    frames.append(nb::make_tuple(head.number, head.system, head.component, std::move(frame)));
    start += head.size;
  }
  return nb::make_tuple(std::move(frames), start);
}

[[noreturn]] void raise_errno() {
  PyErr_SetFromErrno(PyExc_OSError);
  throw nb::python_error();
}

nb::tuple to_address(const sockaddr_in& address) {
  char host[INET_ADDRSTRLEN] = "";
  inet_ntop(AF_INET, &address.sin_addr, host, sizeof(host));
  return nb::make_tuple(static_cast<const char*>(host), ntohs(address.sin_port));
}

bool same(const sockaddr_in& a, const sockaddr_in& b) {
  return a.sin_addr.s_addr == b.sin_addr.s_addr && a.sin_port == b.sin_port;
}

/// Room for the datagrams of one call of recvmmsg.
///
/// Python's lock guards it as long as no object is created that Python's garbage collector tracks: a collection may run
/// finalizers, and these let other threads run.
struct Arrivals {
  Arrivals() {
    for (unsigned i = 0; i < kReadAtOnce; ++i) {
      parts[i].iov_base = data[i];
      headers[i].msg_hdr.msg_iov = &parts[i];
      headers[i].msg_hdr.msg_iovlen = 1;
      headers[i].msg_hdr.msg_name = &senders[i];
    }
  }

  int read(int descriptor, std::size_t largest) {
    for (unsigned i = 0; i < kReadAtOnce; ++i) {
      parts[i].iov_len = largest;
      headers[i].msg_hdr.msg_namelen = sizeof(sockaddr_in);
    }
    int count;
    do {
      count = recvmmsg(descriptor, headers, kReadAtOnce, MSG_DONTWAIT, nullptr);
    } while (count < 0 && errno == EINTR);
    return count;
  }

  mmsghdr headers[kReadAtOnce] = {};
  iovec parts[kReadAtOnce] = {};
  sockaddr_in senders[kReadAtOnce] = {};
  std::uint8_t data[kReadAtOnce][kLargestDatagram];
};

Arrivals& arrivals() {
  static auto* room = new Arrivals;
  return *room;
}

/// Return up to `kReadAtOnce` datagrams with their senders, and whether more may wait.
nb::tuple receive(int descriptor, std::size_t largest) {
  Arrivals& room = arrivals();
  const int count = room.read(descriptor, std::min(largest, kLargestDatagram));
  if (count < 0 && errno != EAGAIN && errno != EWOULDBLOCK) raise_errno();
  nb::object contents[kReadAtOnce];
  sockaddr_in senders[kReadAtOnce];
  for (int i = 0; i < count; ++i) {
    contents[i] = to_bytes(room.data[i], room.headers[i].msg_len);
    senders[i] = room.senders[i];
  }
  nb::list datagrams;
  nb::object sender;
  for (int i = 0; i < count; ++i) {
    if (i == 0 || !same(senders[i], senders[i - 1])) sender = to_address(senders[i]);
    datagrams.append(nb::make_tuple(contents[i], sender));
  }
  return nb::make_tuple(std::move(datagrams), count == static_cast<int>(kReadAtOnce));
}
}  // namespace

void bind_datagrams(nb::module_& module) {
  module.attr("INTERRUPTED") = kInterrupted;
  module.def("split", &split, nb::arg("datagram"));
  module.def("receive", &receive, nb::arg("descriptor"), nb::arg("largest"));
  nb::class_<Outbox>(module, "Outbox", "Frames waiting to be sent to one client, each in a datagram.")
      .def(nb::init<const std::string&, std::uint16_t, std::uint8_t, std::uint8_t>(), nb::arg("host"), nb::arg("port"),
           nb::arg("system"), nb::arg("component"))
      .def("__len__", &Outbox::size)
      .def("put", &Outbox::put, nb::arg("message"), nb::arg("payload"))
      .def("put_frame", &Outbox::put_frame, nb::arg("frame"))
      .def("send", &Outbox::send, nb::arg("descriptor"))
      .def("drop", &Outbox::drop)
      .def("clear", &Outbox::clear)
      .def_ro("sequence", &Outbox::sequence)
      .def_ro("queued", &Outbox::queued)
      .def_ro("queued_bytes", &Outbox::queued_bytes);
}
}  // namespace mavlink_wire
