#include "exchange.h"

#include <sys/socket.h>

#include <utility>

namespace nb = nanobind;

namespace xtdrone_lockstep::io {
void Exchange::add(int descriptor, nb::dict routes, nb::list closing) {
  remove(descriptor);
  seats_.emplace(descriptor, Seat{std::move(routes), std::move(closing)});
}

void Exchange::remove(int descriptor) {
  release(descriptor);
  if (seats_.erase(descriptor) != 0 && completed_.size() != 0) {
    forget(descriptor);
  }
}

/// Discard the completed turns of a connection that are left from a poll ended by a signal.
void Exchange::forget(int descriptor) {
  nb::list others;
  for (nb::handle turn : completed_) {
    if (nb::cast<int>(turn[0]) != descriptor) {
      others.append(turn);
    }
  }
  completed_ = std::move(others);
}

void Exchange::hold(int descriptor, bool held) {
  if (const auto found = seats_.find(descriptor); found != seats_.end()) {
    found->second.held = held;
  }
}

void Exchange::release(int descriptor) {
  if (const auto found = seats_.find(descriptor); found != seats_.end()) {
    stopAwaiting(found->second);
  }
}

void Exchange::stopAwaiting(Seat& seat) {
  if (seat.awaited != 0) {
    seat.awaited = 0;
    --awaited_;
  }
}

void Exchange::expect(int descriptor, std::uint64_t tick) {
  if (const auto found = seats_.find(descriptor); found != seats_.end()) {
    awaited_ += found->second.awaited == 0 && tick != 0;
    found->second.awaited = tick;
  }
}

nb::list Exchange::send(std::uint64_t tick, std::int64_t time_us, const nb::list& rows) {
  nb::list unsent;
  for (nb::handle row : rows) {
    const auto descriptor = nb::cast<int>(row[0]);
    const auto counts = nb::cast<nb::dict>(row[1]);
    frame_.clear();
    pack(frame_, Kind::TICK, tick, time_us, counts.ptr(), nullptr);
    PyDict_Clear(counts.ptr());
    expect(descriptor, tick);
    const ssize_t sent = ::send(descriptor, frame_.data(), frame_.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
    if (sent == static_cast<ssize_t>(frame_.size())) {
      continue;
    }
    const bool full = sent >= 0 || errno == EAGAIN || errno == EINTR;
    const std::size_t kept = sent < 0 ? 0 : static_cast<std::size_t>(sent);
    const int why = full ? 0 : errno;
    unsent.append(nb::make_tuple(descriptor, nb::bytes(frame_.data() + kept, frame_.size() - kept), why));
  }
  return unsent;
}

nb::tuple Exchange::poll(double timeout) {
  const Limit limit(timeout);
  Events events;
  nb::list others;
  do {
    const int count = await(epoll_, events, limit);
    for (int i = 0; i < count; ++i) {
      handle(events[static_cast<std::size_t>(i)], others);
    }
    if (count == 0) {
      break;
    }
  } while (awaited_ > 0 && others.size() == 0);
  return nb::make_tuple(std::exchange(completed_, nb::list()), others);
}

void Exchange::handle(const epoll_event& event, nb::list& others) {
  const int descriptor = event.data.fd;
  const auto found = seats_.find(descriptor);
  if (found == seats_.end() || found->second.held || found->second.awaited == 0 || event.events != EPOLLIN) {
    others.append(nb::make_tuple(descriptor, event.events, nb::none(), 0));
    return;
  }
  const ssize_t size = recv(descriptor, data_.data(), data_.size(), MSG_DONTWAIT);
  if (size < 0) {
    if (errno != EAGAIN && errno != EINTR) {
      others.append(nb::make_tuple(descriptor, event.events, nb::none(), errno));
    }
    return;
  }
  if (!accept(descriptor, found->second, data_.data(), static_cast<std::size_t>(size))) {
    const nb::bytes data(data_.data(), static_cast<std::size_t>(size));
    others.append(nb::make_tuple(descriptor, event.events, data, 0));
  }
}

/// Handle the DONE that is awaited; return false for all other data.
bool Exchange::accept(int descriptor, Seat& seat, const char* data, std::size_t size) {
  const auto done = readWhole(data, size, Kind::DONE);
  if (!done || done->tick != seat.awaited || seat.closing.size() != 0) {
    return false;
  }
  for (std::size_t i = 0; i < done->channels; ++i) {
    const nb::object number = nb::steal(PyLong_FromUnsignedLong(done->id(i)));
    require(number.is_valid());
    PyObject* route = PyDict_GetItemWithError(seat.routes.ptr(), number.ptr());
    if (route != nullptr) {  // else it has been closed
      require(PyTuple_Check(route) && PyTuple_GET_SIZE(route) == 2);
      require(setNumber(PyTuple_GET_ITEM(route, 0), PyTuple_GET_ITEM(route, 1), done->count(i)));
    } else {
      require(PyErr_Occurred() == nullptr);
    }
  }
  nb::object ports = nb::none();
  if (done->ports != 0) {
    ports = nb::steal(pairsOf(*done, done->channels, std::size_t{done->channels} + done->ports));
    require(ports.is_valid());
  }
  stopAwaiting(seat);
  completed_.append(nb::make_tuple(descriptor, ports));
  return true;
}

}  // namespace xtdrone_lockstep::io
