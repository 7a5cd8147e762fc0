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

namespace xtdrone_lockstep {

/// The server refuses this node.
class RefusedError : public std::runtime_error {
 public:
  RefusedError(std::string code, const std::string& reason) : std::runtime_error(reason), code_(std::move(code)) {}
  const std::string& code() const { return code_; }

 private:
  std::string code_;
};

/// The declared topics and the state shared between threads.
struct Topics {
  Waker waker;
  /// Whether each message wakes the main thread.
  std::atomic<bool> eager{false};
  std::vector<std::shared_ptr<detail::Outlet>> outlets;
  std::vector<std::shared_ptr<detail::Inlet>> inlets;

  /// Return the topics as in JOIN and DECLARE.
  nlohmann::json declaration() const;
  std::shared_ptr<detail::Inlet> inlet(const std::string& topic) const;
};

/// The node's participation in a simulator's lockstep; used in the main thread, except for the keep-alive and questions
/// to the master.
class Client {
 public:
  /// @param ending  Returns whether the node is shutting down; the waker is woken when that changes.
  Client(std::string uri, Topics& topics, std::function<bool()> ending);
  ~Client();
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  const std::string& uri() const { return uri_; }
  std::int64_t time() const { return now_.time_us; }
  bool digests() const { return digests_; }
  /// Return the simulator's failure as a predicate ("is gone: why"), empty if there was none.
  const std::string& failure() const { return failure_; }
  /// Return the simulator's reason for a normal end, empty if it has not ended.
  const std::string& farewell() const { return farewell_; }

  /// Connect and reserve the name for the node that is to join over this connection.
  ///
  /// @throws std::system_error, ProtocolError, RefusedError
  void reserve(const std::string& name);
  /// Join, connecting first if necessary.
  ///
  /// @throws std::system_error, ProtocolError, RefusedError
  void join(const std::string& name, double rate);
  /// Send the topics declared by now.
  void declare();
  /// Report that a topic's connections are about to close.
  void withdraw(detail::Outlet& outlet);

  /// Wait for the next tick; return whether time was reset since the last one, or nullopt if the node is shutting down
  /// or the simulator is gone.
  std::optional<bool> awaitTick();
  /// Wait for the messages due in this turn; return false if the node is shutting down or the simulator is gone.
  bool awaitMessages();
  /// End the turn.
  void done();
  /// Send LEAVE and close the connection.
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
  void endByFrame(const Frame& frame);
  /// Return a REFUSED or LEAVE among the frames that have not been handled.
  std::optional<Frame> findFarewell();
  /// Wait for data and handle it; return false if the node is shutting down or the simulator is gone.
  bool wait(double seconds);
  std::size_t receive();
  bool send(const std::string& data);
  void keepAlive();

  void announce();
  void updatePeers(const nlohmann::json& content);
  /// Ask the master again for publishers of topics, in a thread: turns do not wait for its answer. A question that is
  /// under way is not repeated.
  void askMaster(std::vector<std::string> topics);
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
  bool was_reset_ = false;
  std::uint32_t last_number_ = 0;
  std::map<std::uint32_t, Channel> channels_;
  std::vector<std::uint32_t> awaited_;
  std::vector<std::uint32_t> lost_;
  /// Channels with the number of messages sent before the last reset of time.
  std::vector<std::pair<std::uint32_t, std::uint64_t>> void_;
  std::int64_t digest_period_ = -1;

  std::mutex send_mutex_;
  std::condition_variable ended_;
  bool has_ended_ = false;
  std::thread keep_alive_;

  std::atomic<bool> is_asking_{false};
  std::thread asking_;
};

}  // namespace xtdrone_lockstep
