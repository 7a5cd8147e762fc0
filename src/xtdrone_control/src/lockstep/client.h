/// A participant's connection to the simulator.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "protocol.h"
#include "topics.h"

namespace xtdrone_control::lockstep {

/// The server does not take this node.
class RefusedError : public std::runtime_error {
 public:
  RefusedError(std::string code, const std::string& reason) : std::runtime_error(reason), code_(std::move(code)) {}
  const std::string& code() const { return code_; }

 private:
  std::string code_;
};

/// What the node has declared, and what its threads share.
struct Topics {
  Waker waker;
  /// Whether the main thread wants to be woken by each message.
  std::atomic<bool> eager{false};
  std::vector<std::shared_ptr<detail::Outlet>> outlets;
  std::vector<std::shared_ptr<detail::Inlet>> inlets;

  /// The topics as JOIN and DECLARE carry them.
  nlohmann::json declaration() const;
  std::shared_ptr<detail::Inlet> inlet(const std::string& topic) const;
};

/// All of it in the main thread, but for the keep-alive.
class Client {
 public:
  /// @param ending  Says whether the node is to end; the waker is woken when that changes.
  Client(std::string uri, Topics& topics, std::function<bool()> ending);
  ~Client();
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  const std::string& uri() const { return uri_; }
  std::int64_t time() const { return now_.time_us; }
  bool digests() const { return digests_; }
  /// What the simulator did, as "is gone: why", when it has ended the connection or failed; else empty.
  const std::string& failure() const { return failure_; }
  /// What the simulator said when it ended in an orderly way; empty otherwise.
  const std::string& farewell() const { return farewell_; }

  /// Connects and reserves the name for the node that is to join over this connection.
  ///
  /// @throws std::system_error, ProtocolError, RefusedError
  void reserve(const std::string& name);
  /// Joins, over a new connection if there is none.
  ///
  /// @throws std::system_error, ProtocolError, RefusedError
  void join(const std::string& name, double rate);
  /// Tells the server of the topics that there are now.
  void declare();
  /// Tells the server that a topic's connections are about to end.
  void withdraw(detail::Outlet& outlet);

  /// Waits for the next tick; returns whether time was set back since the last one, or nothing if the node is to end or
  /// the simulator is gone.
  std::optional<bool> awaitTick();
  /// Waits for the messages that the tick promises; returns false if the node is to end or the simulator is gone.
  bool awaitMessages();
  /// Ends the turn.
  void done();
  /// Takes leave and closes the connection.
  void leave();

 private:
  struct Channel {
    std::shared_ptr<detail::Inlet> inlet;
    std::shared_ptr<detail::Inbox> inbox;
  };

  nlohmann::json ask(Kind kind, const nlohmann::json& content);
  void connect();
  void close();
  void fail(const std::string& why);
  void takeLastWord(const Frame& frame);
  /// Returns the REFUSED or LEAVE that lies behind what has been handled so far.
  std::optional<Frame> findLastWord();
  /// Waits until something comes, handles it, and returns false if the node is to end or the simulator is gone.
  bool wait(double seconds);
  std::size_t receive();
  bool send(const std::string& data);
  void keepAlive();

  void announce();
  void takePeers(const nlohmann::json& content);
  void setParticipant(std::uint32_t number, bool value);
  std::vector<Channel> lacking();
  void discardVoid();
  void forgetLost();
  std::string digestFrame() const;
  std::string doneFrame();

  const std::string uri_;
  Topics& topics_;
  const std::function<bool()> ending_;
  int socket_ = -1;
  bool joined_ = false;
  bool digests_ = false;
  std::string failure_;
  std::string farewell_;
  FrameReader reader_;
  Barrier now_;
  bool set_back_ = false;
  std::uint32_t numbers_ = 0;
  std::map<std::uint32_t, Channel> channels_;
  std::vector<std::uint32_t> awaited_;
  std::vector<std::uint32_t> lost_;
  /// Up to which message of a channel all that is not dispatched yet is of before time went back.
  std::vector<std::pair<std::uint32_t, std::uint64_t>> void_;
  std::int64_t digested_ = -1;

  std::mutex send_mutex_;
  std::condition_variable ended_;
  bool has_ended_ = false;
  std::thread keep_alive_;
};

}  // namespace xtdrone_control::lockstep
