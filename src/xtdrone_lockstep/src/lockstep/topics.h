/// Both ends of a topic, with counted connections and with messages that are kept until their tick.
#pragma once

#include <ros/advertise_options.h>
#include <ros/callback_queue_interface.h>
#include <ros/publisher.h>
#include <ros/serialized_message.h>
#include <ros/subscribe_options.h>

#include <atomic>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "protocol.h"
#include "roscpp_links.h"
#include "xtdrone_lockstep/lockstep.h"

namespace xtdrone_lockstep {

/// Ends a wait of the main thread; usable in any thread and in signal handlers.
class Waker {
 public:
  Waker();
  int fileno() const { return descriptor_; }
  void wake() const noexcept;
  void clear() const noexcept;

 private:
  int descriptor_;
};

/// Records that the connections of roscpp have changed and wakes the main thread.
class Notifier : public ros::CallbackQueueInterface {
 public:
  explicit Notifier(const Waker& waker) : waker_(waker) {}

  void addCallback(const ros::CallbackInterfacePtr&, std::uint64_t) override {
    changed_ = true;
    waker_.wake();
  }
  void removeByID(std::uint64_t) override {}
  /// Return whether there was a change since the last call.
  bool take() { return changed_.exchange(false); }

 private:
  const Waker& waker_;
  std::atomic<bool> changed_{true};
};

namespace detail {

/// The sending end of one topic connection.
struct Link {
  ros::SubscriberLinkPtr link;
  /// Number of the channel in this process, from 1; 0 until it is announced.
  std::uint32_t number = 0;
  /// Messages sent or queued since the connection was made, and the count last reported to the server.
  std::uint64_t count = 0;
  std::uint64_t reported = 0;
  /// Whether the subscriber is a participant; its messages are never dropped.
  bool participant = false;
};

/// A topic's sending end; used in the main thread only.
class Outlet {
 public:
  Outlet(const ros::AdvertiseOptions& options, const Waker& waker);

  const std::string& topic() const { return topic_; }
  const std::string& type() const { return type_; }
  std::vector<Link>& links() { return links_; }
  const std::optional<Digest>& digest() const { return digest_; }
  const ros::Publisher* plain() const { return plain_ ? &*plain_ : nullptr; }

  /// Advertise with a plain publisher.
  void openPlain(ros::AdvertiseOptions options);
  /// Advertise with counted messages.
  void openCounted(ros::AdvertiseOptions options);
  void close();

  /// Send a message over all connections; `digested_us` is the simulation time if a digest is requested.
  void publish(const ros::SerializedMessage& message, std::optional<std::int64_t> digested_us);
  std::uint32_t countSubscribers() const;
  /// Update the list of connections if it has changed.
  void update();
  /// Remove and return the numbers of the closed connections.
  std::vector<std::uint32_t> takeClosed() { return std::exchange(closed_links_, {}); }

 private:
  /// Send a message; for a stalled subscriber that is not a participant, drop the oldest ones.
  void send(Link& link, const ros::SerializedMessage& message) const;

  std::string topic_;
  std::string type_;
  std::size_t stalled_queue_;
  bool latch_;
  bool has_header_;
  Notifier notifier_;
  ros::PublicationPtr publication_;
  ros::SubscriberCallbacksPtr callbacks_;
  std::optional<ros::Publisher> plain_;
  std::vector<Link> links_;
  std::vector<std::uint32_t> closed_links_;
  ros::SerializedMessage last_;
  std::optional<Digest> digest_;
};

/// The messages of one connection, in order of sending. Guarded by the inlet's mutex, except for `closed`.
struct Inbox {
  std::string publisher;
  std::deque<Message> messages;
  /// Numbers of messages since the connection was made: received, discarded because a foreign publisher's queue was
  /// full, and dispatched or discarded because of a reset.
  std::uint64_t received = 0;
  std::uint64_t dropped = 0;
  std::uint64_t taken = 0;
  /// Number of messages to be dispatched by now; nullopt if the publisher is not a participant ("foreign").
  std::optional<std::uint64_t> target;
  /// Number of messages counted by the publisher that did not arrive.
  std::uint64_t given_up = 0;
  /// Whether the connection is closed; set in any thread.
  std::atomic<bool> closed{false};
  /// Whether the server has reported the channel as closed.
  bool lost = false;
  bool latched = false;
  Message latch;
  /// Header of the connection; its address identifies the connection and stays valid while it is held here.
  boost::shared_ptr<ros::M_string> header;

  /// Return the number of messages due by now that have not arrived.
  std::uint64_t lacking() const;
  /// Return how many of the pending messages are among the first `count` of the connection.
  std::uint64_t pendingOfFirst(std::uint64_t count) const;
};

/// A topic's receiving end. Messages arrive in roscpp's thread; everything else runs in the main thread.
class Inlet {
 public:
  /// @param waker  Woken by each message while `eager` is set, and whenever a connection closes.
  Inlet(std::string topic, const std::type_info& message, std::string type, const Waker& waker,
        const std::atomic<bool>& eager);

  const std::string& topic() const { return topic_; }
  const std::string& type() const { return type_; }
  const std::type_info& message() const { return message_; }
  bool isOpen() const { return helper_ != nullptr; }

  void open(ros::SubscribeOptions& options);
  void close();
  void setQueueSize(std::size_t size);
  std::uint32_t countPublishers() const;

  /// Store a message; called in any thread.
  void receive(const boost::shared_ptr<ros::M_string>& header, const Message& message);
  /// Treat a publisher as a participant from now on; return the inbox of its connection, which may not be made yet.
  std::shared_ptr<Inbox> count(const std::string& publisher, int port);
  /// Set the number of messages due on a channel before the turn begins; return whether they have arrived.
  bool expect(Inbox& inbox, std::uint64_t target);
  /// Return the number of messages due by now that have not arrived, 0 if the connection is closed.
  std::uint64_t lacking(const Inbox& inbox);
  /// Stop waiting for lacking messages; return their number.
  std::uint64_t giveUp(Inbox& inbox);
  /// Discard the pending ones of the first `count` messages, unless they are latched and thus remain valid.
  void discard(Inbox& inbox, std::uint64_t count);
  void setLost(Inbox& inbox);
  /// Find the connections of inboxes that have none yet; close the inboxes for which there is none.
  void closeUnconnected();

  /// Remove and return the messages to dispatch now, by publisher's name, then in order of sending.
  std::vector<Message> take();
  /// Return the latched messages dispatched so far, for another subscriber.
  std::vector<Message> latches();

 private:
  using Key = std::pair<std::string, int>;

  std::shared_ptr<Inbox> inboxOf(const Key& key);
  std::shared_ptr<Inbox> bind(const boost::shared_ptr<ros::M_string>& header);
  void store(const boost::shared_ptr<ros::M_string>& header, const Message& message);
  void connect(const std::shared_ptr<Inbox>& inbox, const boost::shared_ptr<ros::M_string>& header,
               const ros::ConnectionPtr& connection);
  void findConnections();
  void takeFrom(Inbox& inbox, std::vector<Message>& taken) const;

  const std::string topic_;
  const std::type_info& message_;
  const std::string type_;
  const Waker& waker_;
  const std::atomic<bool>& eager_;
  ros::SubscriptionCallbackHelperPtr helper_;
  std::size_t most_foreign_;

  mutable std::mutex mutex_;
  ros::SubscriptionPtr subscription_;
  std::map<Key, std::shared_ptr<Inbox>> inboxes_;
  std::unordered_map<const ros::M_string*, std::shared_ptr<Inbox>> by_header_;
  /// Messages received before `subscription_` was set.
  std::vector<std::pair<boost::shared_ptr<ros::M_string>, Message>> early_;
};

/// One subscriber.
class Entry {
 public:
  Entry(std::shared_ptr<Inlet> inlet, std::function<void(const void*)> callback);

  const std::shared_ptr<Inlet>& inlet() const { return inlet_; }
  /// Run the callback with each message.
  void dispatch(const std::vector<Message>& messages);
  void end() { callback_ = nullptr; }

 private:
  void invoke(const Message& message);

  std::shared_ptr<Inlet> inlet_;
  std::function<void(const void*)> callback_;
  std::vector<Message> pending_;
};

}  // namespace detail
}  // namespace xtdrone_lockstep
