#include "client.h"

#include <arpa/inet.h>
#include <netdb.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <pthread.h>
#include <ros/console.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstring>
#include <set>
#include <system_error>
#include <utility>

namespace xtdrone_lockstep {
namespace {

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

/// Wall seconds to wait for a counted message while its publisher's connection is open.
constexpr double WAIT_LIMIT = 60.0;
/// Wall seconds after which such a wait is logged.
constexpr double WAIT_REPORT = 5.0;
/// Wall seconds for the simulator to answer.
constexpr int CONNECT_LIMIT = 10;
constexpr std::chrono::seconds ALIVE_PERIOD{1};
/// Milliseconds without an answer from the other machine's kernel after which the connection breaks.
constexpr int UNANSWERED_MS = 15'000;
/// Seconds of silence before the first keep-alive probe to that kernel, seconds between probes, and their number.
constexpr int KEEP_IDLE = 3;
constexpr int KEEP_INTERVAL = 3;
constexpr int KEEP_COUNT = 4;
/// Longest single wait in wall seconds, as roscpp sends no notification when another node shuts it down.
constexpr double SLICE = 0.2;

std::system_error systemError(const std::string& what) { return {errno, std::generic_category(), what}; }

void setTimeouts(int socket, int seconds) {
  const timeval limit{seconds, 0};
  setsockopt(socket, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
  setsockopt(socket, SOL_SOCKET, SO_SNDTIMEO, &limit, sizeof limit);  // also limits connect()
}

/// Set the TCP options, as `tune` in protocol.py does: send without delay and detect an unreachable machine.
void tune(int socket) {
  const int on = 1;
  setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
  setsockopt(socket, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof on);
  setsockopt(socket, IPPROTO_TCP, TCP_KEEPIDLE, &KEEP_IDLE, sizeof KEEP_IDLE);
  setsockopt(socket, IPPROTO_TCP, TCP_KEEPINTVL, &KEEP_INTERVAL, sizeof KEEP_INTERVAL);
  setsockopt(socket, IPPROTO_TCP, TCP_KEEPCNT, &KEEP_COUNT, sizeof KEEP_COUNT);
  setsockopt(socket, IPPROTO_TCP, TCP_USER_TIMEOUT, &UNANSWERED_MS, sizeof UNANSWERED_MS);
}

/// Split tcp://host:port, where the host may be an IPv6 address in brackets.
std::pair<std::string, std::string> splitUri(const std::string& uri) {
  static const std::string scheme = "tcp://";
  const std::size_t colon = uri.rfind(':');
  if (uri.compare(0, scheme.size(), scheme) == 0 && colon > scheme.size()) {
    std::string host = uri.substr(scheme.size(), colon - scheme.size());
    const std::string port = uri.substr(colon + 1, uri.find('/', colon) - colon - 1);
    if (host.size() > 2 && host.front() == '[' && host.back() == ']') {
      host = host.substr(1, host.size() - 2);
    }
    if (!port.empty() && port.find_first_not_of("0123456789") == std::string::npos) {
      return {host, port};
    }
  }
  throw ProtocolError("/lockstep/uri is '" + uri + "', it must be tcp://host:port");
}

int connectTo(const std::string& host, const std::string& port) {
  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* found = nullptr;
  if (const int code = getaddrinfo(host.c_str(), port.c_str(), &hints, &found); code != 0) {
    throw std::system_error(EHOSTUNREACH, std::generic_category(), host + ": " + gai_strerror(code));
  }
  const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> addresses(found, freeaddrinfo);
  for (const addrinfo* address = found; address != nullptr; address = address->ai_next) {
    const int descriptor = socket(address->ai_family, address->ai_socktype | SOCK_CLOEXEC, address->ai_protocol);
    if (descriptor < 0) {
      continue;
    }
    setTimeouts(descriptor, CONNECT_LIMIT);
    if (connect(descriptor, address->ai_addr, address->ai_addrlen) == 0) {
      return descriptor;
    }
    const int why = errno;
    ::close(descriptor);
    errno = why;
  }
  throw systemError("connect");
}

/// Return whether the IPv4 address belongs to this machine.
bool isOwn(const sockaddr_in& address) {
  const int probe = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  sockaddr_in own{};
  socklen_t size = sizeof own;
  // Connecting a datagram socket sends nothing.
  const bool has_way = connect(probe, reinterpret_cast<const sockaddr*>(&address), sizeof address) == 0 &&
                       getsockname(probe, reinterpret_cast<sockaddr*>(&own), &size) == 0;
  ::close(probe);
  const auto isLoopback = [](const sockaddr_in& one) { return ntohl(one.sin_addr.s_addr) >> 24 == 127; };
  return has_way && (own.sin_addr.s_addr == address.sin_addr.s_addr || (isLoopback(own) && isLoopback(address)));
}

/// Return whether the process at the other end of a Unix domain socket belongs to the user of this process.
bool hasSameOwner(int socket) {
  ucred owner{};
  socklen_t size = sizeof owner;
  return getsockopt(socket, SOL_SOCKET, SO_PEERCRED, &owner, &size) == 0 && owner.uid == geteuid();
}

/// Connect to an abstract Unix domain socket of a process of the same user; return -1 if there is none.
int connectToAbstract(const std::string& name) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (name.size() + 1 > sizeof address.sun_path) {
    return -1;
  }
  std::copy(name.begin(), name.end(), address.sun_path + 1);
  const int descriptor = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (descriptor < 0) {
    return -1;
  }
  setTimeouts(descriptor, CONNECT_LIMIT);
  const auto size = static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + 1 + name.size());
  if (connect(descriptor, reinterpret_cast<const sockaddr*>(&address), size) == 0 && hasSameOwner(descriptor)) {
    return descriptor;
  }
  ::close(descriptor);
  return -1;
}

/// Connect to the socket beside the TCP port of a simulator on this machine, see unix_sockets.py; return -1 if there is
/// none.
int connectLocally(const std::string& host, const std::string& port) {
  addrinfo hints{};
  hints.ai_family = AF_INET;
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* found = nullptr;
  if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0) {
    return -1;
  }
  const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> addresses(found, freeaddrinfo);
  for (const addrinfo* entry = found; entry != nullptr; entry = entry->ai_next) {
    sockaddr_in address{};
    std::memcpy(&address, entry->ai_addr, std::min<std::size_t>(entry->ai_addrlen, sizeof address));
    if (!isOwn(address)) {
      continue;
    }
    std::array<char, INET_ADDRSTRLEN> text{};
    inet_ntop(AF_INET, &address.sin_addr, text.data(), text.size());
    for (const std::string& listening : {std::string(text.data()), std::string("0.0.0.0")}) {
      const int descriptor = connectToAbstract("xtdrone-server/" + listening + ":" + port);
      if (descriptor >= 0) {
        return descriptor;
      }
    }
  }
  return -1;
}

/// Leave signals to the main thread, so that they end its waits.
void blockSignals() {
  sigset_t all;
  sigfillset(&all);
  pthread_sigmask(SIG_BLOCK, &all, nullptr);
}

nlohmann::json introduction(const std::string& name) {
  return {{"version", VERSION}, {"name", name}, {"pid", getpid()}, {"host", processNamespace()}};
}

}  // namespace

nlohmann::json Topics::declaration() const {
  auto publications = nlohmann::json::array();
  for (const auto& outlet : outlets) {
    publications.push_back({outlet->topic(), outlet->type()});
  }
  auto subscriptions = nlohmann::json::array();
  for (const auto& inlet : inlets) {
    subscriptions.push_back({inlet->topic(), inlet->type()});
  }
  return {{"publications", publications}, {"subscriptions", subscriptions}};
}

std::shared_ptr<detail::Inlet> Topics::inlet(const std::string& topic) const {
  const auto found = std::find_if(inlets.begin(), inlets.end(), [&](const auto& one) { return one->topic() == topic; });
  return found == inlets.end() ? nullptr : *found;
}

// ---- joining and leaving ----

Client::Client(std::string uri, Topics& topics, std::function<bool()> ending)
    : uri_(std::move(uri)), topics_(topics), ending_(std::move(ending)) {}

Client::~Client() {
  close();
  if (asking_.joinable()) {
    asking_.join();
  }
}

void Client::connect() {
  const auto [host, port] = splitUri(uri_);
  socket_ = connectLocally(host, port);
  if (socket_ < 0) {
    socket_ = connectTo(host, port);
    tune(socket_);
  }
}

nlohmann::json Client::ask(Kind kind, const nlohmann::json& content) {
  if (socket_ < 0) {
    connect();
  }
  if (!send(packObject(kind, content))) {
    throw systemError("send");
  }
  for (;;) {
    if (const auto answer = reader_.next()) {
      const auto answered = answer->kind == Kind::WELCOME || answer->kind == Kind::REFUSED;
      if (!answered) {
        throw ProtocolError("the answer was a frame of type " + std::to_string(static_cast<int>(answer->kind)));
      }
      auto object = unpackObject(answer->payload);
      if (answer->kind == Kind::REFUSED) {
        throw RefusedError(object.value("code", ""), printable(object.value("reason", "")));
      }
      return object;
    }
    if (receive() == 0) {
      throw std::system_error(ECONNRESET, std::generic_category(), "it has closed the connection");
    }
  }
}

void Client::reserve(const std::string& name) { ask(Kind::RESERVE, introduction(name)); }

void Client::join(const std::string& name, double rate) {
  auto content = introduction(name);
  content["rate"] = rate;
  content["udp_ports"] = nlohmann::json::array();
  content.update(topics_.declaration());
  digests_ = ask(Kind::JOIN, content).value("digest", false);
  setTimeouts(socket_, 0);
  joined_ = true;
  announce();
  keep_alive_ = std::thread(&Client::keepAlive, this);
}

void Client::declare() {
  if (joined_) {
    send(packObject(Kind::DECLARE, topics_.declaration()));
  }
}

void Client::withdraw(detail::Outlet& outlet) {
  auto lost = nlohmann::json::array();
  for (const std::uint32_t gone : outlet.takeClosed()) {
    lost.push_back(gone);
  }
  for (const detail::Link& link : outlet.links()) {
    if (link.number != 0) {
      lost.push_back(link.number);
    }
  }
  send(packObject(Kind::PEER, {{"made", nlohmann::json::array()}, {"lost", lost}}));
}

void Client::leave() {
  if (!joined_) {
    return;
  }
  joined_ = false;
  send(digestFrame() + doneFrame() + packObject(Kind::LEAVE, {{"reason", "shut down"}}));
  close();
}

void Client::close() {
  joined_ = false;
  {
    const std::lock_guard<std::mutex> lock(send_mutex_);
    has_ended_ = true;
  }
  ended_.notify_all();
  if (keep_alive_.joinable()) {
    keep_alive_.join();
  }
  if (socket_ >= 0) {
    ::close(socket_);
    socket_ = -1;
  }
}

void Client::fail(const std::string& why) {
  // A frame with the reason may have arrived before the connection broke.
  if (const auto word = findFarewell()) {
    endByFrame(*word);
    return;
  }
  failure_ = "is gone: " + (why.empty() ? "unknown reason" : why);
  close();
}

void Client::endByFrame(const Frame& frame) {
  std::string reason;
  bool failed = false;
  try {
    const auto content = unpackObject(frame.payload);
    failed = content.value("failed", false);
    reason = printable(content.value("reason", ""));
  } catch (const std::exception& error) {  // of the protocol or of the JSON library
    reason = error.what();
  }
  if (frame.kind != Kind::LEAVE) {
    failure_ = "has dropped this node: " + reason;
  } else if (failed) {
    failure_ = "has ended with an error: " + reason;
  } else {
    farewell_ = reason;
  }
  close();
}

std::optional<Frame> Client::findFarewell() {
  try {
    std::array<char, 1 << 16> data;
    for (ssize_t size; socket_ >= 0 && (size = recv(socket_, data.data(), data.size(), MSG_DONTWAIT)) > 0;) {
      reader_.feed(data.data(), static_cast<std::size_t>(size));
    }
    while (auto frame = reader_.next()) {
      if (frame->kind == Kind::REFUSED || frame->kind == Kind::LEAVE) {
        return frame;
      }
    }
  } catch (const ProtocolError&) {  // the rest is not a valid frame
  }
  return std::nullopt;
}

void Client::keepAlive() {
  blockSignals();
  const std::string frame = packEmpty(Kind::ALIVE);
  std::unique_lock<std::mutex> lock(send_mutex_);
  while (!ended_.wait_for(lock, ALIVE_PERIOD, [this] { return has_ended_; })) {
    lock.unlock();
    // The main thread detects that the simulator is gone.
    send(frame);
    lock.lock();
  }
}

// ---- turns ----

std::optional<bool> Client::awaitTick() {
  for (;;) {
    try {
      while (const auto frame = reader_.next()) {
        if (frame->kind == Kind::TICK) {
          const std::int64_t before = now_.time_us;
          now_ = unpackBarrier(frame->payload);
          return std::exchange(was_reset_, false) || now_.time_us < before;
        }
        if (frame->kind == Kind::PEER) {
          updatePeers(unpackObject(frame->payload));
        } else if (frame->kind == Kind::REFUSED || frame->kind == Kind::LEAVE) {
          endByFrame(*frame);
          return std::nullopt;
        }
      }
    } catch (const std::exception& error) {  // of the protocol or of the JSON library
      fail(error.what());
      return std::nullopt;
    }
    if (!wait(SLICE)) {
      return std::nullopt;
    }
  }
}

bool Client::awaitMessages() {
  awaited_.clear();
  for (const auto& [id, count] : now_.channels) {
    const auto found = channels_.find(id);
    if (found != channels_.end() && !found->second.inlet->expect(*found->second.inbox, count)) {
      awaited_.push_back(id);
    }
  }
  topics_.eager = true;
  const auto began = Clock::now();
  bool reported = false;
  std::vector<Channel> missing;
  while (!(missing = lacking()).empty()) {
    const double waited = Seconds(Clock::now() - began).count();
    if (waited >= WAIT_LIMIT) {
      break;
    }
    if (waited >= WAIT_REPORT && !reported) {
      reported = true;
      std::set<std::string> names;
      for (const Channel& channel : missing) {
        names.insert(channel.inlet->topic() + " from " + channel.inbox->publisher);
        channel.inlet->closeUnconnected();
      }
      std::string text;
      for (const std::string& name : names) {
        text += (text.empty() ? "" : ", ") + name;
      }
      ROS_WARN("waiting for messages that have been sent: %s", text.c_str());
    }
    if (!wait(std::min(SLICE, WAIT_LIMIT - waited))) {
      return false;
    }
  }
  topics_.eager = false;
  for (const Channel& channel : missing) {
    const auto short_of = channel.inlet->giveUp(*channel.inbox);
    ROS_WARN("%llu messages on %s from %s did not arrive within %g s; continuing without them",
             static_cast<unsigned long long>(short_of), channel.inlet->topic().c_str(),
             channel.inbox->publisher.c_str(), WAIT_LIMIT);
  }
  discardVoid();
  forgetLost();
  return true;
}

std::vector<Client::Channel> Client::lacking() {
  std::vector<Channel> missing;
  for (const std::uint32_t id : awaited_) {
    const Channel& channel = channels_.at(id);
    if (channel.inlet->lacking(*channel.inbox) != 0) {
      missing.push_back(channel);
    }
  }
  return missing;
}

void Client::discardVoid() {
  for (const auto& [id, count] : std::exchange(void_, {})) {
    const auto found = channels_.find(id);
    if (found != channels_.end()) {
      found->second.inlet->discard(*found->second.inbox, count);
    }
  }
}

void Client::forgetLost() {
  for (const std::uint32_t id : lost_) {
    const auto found = channels_.find(id);
    if (found != channels_.end()) {
      found->second.inlet->setLost(*found->second.inbox);
      channels_.erase(found);
    }
  }
  lost_.clear();
}

void Client::done() {
  if (!joined_) {
    return;
  }
  announce();
  std::string frames;
  if (const std::int64_t period = now_.time_us / DIGEST_PERIOD_US; period != digest_period_) {
    digest_period_ = period;
    frames = digestFrame();
  }
  errno = 0;
  if (!send(frames + doneFrame())) {
    fail(systemError("send").what());
  }
}

std::string Client::doneFrame() {
  Barrier done{now_.tick, now_.time_us, {}};
  for (const auto& outlet : topics_.outlets) {
    for (detail::Link& link : outlet->links()) {
      if (link.number != 0 && link.count != link.reported) {
        link.reported = link.count;
        done.channels.emplace_back(link.number, link.count);
      }
    }
  }
  return packBarrier(Kind::DONE, done);
}

std::string Client::digestFrame() const {
  if (!digests_) {
    return "";
  }
  auto topics = nlohmann::json::object();
  for (const auto& outlet : topics_.outlets) {
    if (const auto& digest = outlet->digest()) {
      topics[outlet->topic()] = {digest->messages(), digest->bytes(), digest->crc()};
    }
  }
  return packObject(Kind::DIGEST, {{"time_us", now_.time_us}, {"topics", topics}});
}

// ---- connections between nodes ----

void Client::announce() {
  auto made = nlohmann::json::array();
  auto lost = nlohmann::json::array();
  for (const auto& outlet : topics_.outlets) {
    outlet->update();
    for (const std::uint32_t number : outlet->takeClosed()) {
      lost.push_back(number);
    }
    for (detail::Link& link : outlet->links()) {
      if (link.number == 0) {
        link.number = ++last_number_;
        link.reported = link.count;
        const int port = link.link->isIntraprocess() ? 0 : remotePort(link.link->getTransportInfo());
        made.push_back({link.number, outlet->topic(), link.link->getDestinationCallerID(), port, link.count});
      }
    }
  }
  if (!made.empty() || !lost.empty()) {
    // The wait for the next tick detects that the simulator is gone.
    send(packObject(Kind::PEER, {{"made", made}, {"lost", lost}}));
  }
}

void Client::updatePeers(const nlohmann::json& content) {
  for (const auto& peer : content.at("made")) {
    const auto id = peer.at(0).get<std::uint32_t>();
    const auto publisher = peer.at(2).get<std::string>();
    if (const auto inlet = topics_.inlet(peer.at(1).get<std::string>())) {
      channels_[id] = {inlet, inlet->count(publisher, peer.at(3).get<int>())};
    }
  }
  for (const auto& number : content.at("counted")) {
    setParticipant(number.get<std::uint32_t>(), true);
  }
  for (const auto& number : content.at("uncounted")) {
    setParticipant(number.get<std::uint32_t>(), false);
  }
  for (const auto& id : content.at("lost")) {
    lost_.push_back(id.get<std::uint32_t>());
  }
  if (const auto found = content.find("void"); found != content.end()) {
    for (const auto& pair : *found) {
      void_.emplace_back(pair.at(0).get<std::uint32_t>(), pair.at(1).get<std::uint64_t>());
    }
  }
  if (const auto found = content.find("missing"); found != content.end()) {
    askMaster(found->get<std::vector<std::string>>());
  }
  // Remembered, as the next tick may have the same time as the last, or a later one.
  was_reset_ = was_reset_ || content.value("reset", false);
}

void Client::askMaster(std::vector<std::string> topics) {
  if (topics.empty() || is_asking_.exchange(true)) {
    return;
  }
  if (asking_.joinable()) {
    asking_.join();  // it has ended
  }
  asking_ = std::thread([this, topics = std::move(topics)] {
    blockSignals();
    std::for_each(topics.begin(), topics.end(), askMasterAgain);
    is_asking_ = false;
  });
}

void Client::setParticipant(std::uint32_t number, bool value) {
  for (const auto& outlet : topics_.outlets) {
    for (detail::Link& link : outlet->links()) {
      if (link.number == number) {
        link.participant = value;
        return;
      }
    }
  }
}

// ---- socket ----

bool Client::wait(double seconds) {
  if (socket_ < 0 || ending_()) {
    return false;
  }
  std::array<pollfd, 2> watched{{{socket_, POLLIN, 0}, {topics_.waker.fileno(), POLLIN, 0}}};
  const int ready = poll(watched.data(), watched.size(), static_cast<int>(std::ceil(seconds * 1000.0)));
  if (ready > 0 && watched[1].revents != 0) {
    topics_.waker.clear();
    announce();
  }
  if (ready > 0 && watched[0].revents != 0) {
    try {
      if (receive() == 0) {
        fail("it has closed the connection");
      }
    } catch (const std::system_error& error) {
      fail(error.what());
    }
  }
  return socket_ >= 0 && !ending_();
}

std::size_t Client::receive() {
  std::array<char, 1 << 16> data;
  ssize_t size;
  do {
    size = recv(socket_, data.data(), data.size(), 0);
  } while (size < 0 && errno == EINTR);
  if (size < 0) {
    throw systemError("receive");
  }
  reader_.feed(data.data(), static_cast<std::size_t>(size));
  return static_cast<std::size_t>(size);
}

bool Client::send(const std::string& data) {
  const std::lock_guard<std::mutex> lock(send_mutex_);
  std::size_t sent = 0;
  while (sent < data.size()) {
    const ssize_t size = ::send(socket_, data.data() + sent, data.size() - sent, MSG_NOSIGNAL);
    if (size < 0 && errno != EINTR) {
      return false;
    }
    sent += size < 0 ? 0 : static_cast<std::size_t>(size);
  }
  return true;
}

}  // namespace xtdrone_lockstep
