/// Both ends of a topic, with what the lockstep needs: counted connections, and messages that wait for their tick.
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
#include "xtdrone_control/lockstep.h"

namespace xtdrone_control::lockstep {

/// Ends a wait of the main thread from any other thread, or from a signal handler.
class Waker {
 public:
  Waker();
  int fileno() const { return descriptor_; }
  void wake() const noexcept;
  void clear() const noexcept;

 private:
  int descriptor_;
};

/// Something of roscpp's has changed; the main thread has a look.
class Notifier : public ros::CallbackQueueInterface {
 public:
  explicit Notifier(const Waker& waker) : waker_(waker) {}

  void addCallback(const ros::CallbackInterfacePtr&, std::uint64_t) override {
    changed_ = true;
    waker_.wake();
  }
  void removeByID(std::uint64_t) override {}
  /// Says whether something has changed since the last call.
  bool take() { return changed_.exchange(false); }

 private:
  const Waker& waker_;
  std::atomic<bool> changed_{true};
};

namespace detail {

/// The sending end of one topic connection.
struct Link {
  ros::SubscriberLinkPtr link;
  /// The channel's number in this process, from 1; 0 until it was announced.
  std::uint32_t number = 0;
  /// Messages handed over since the connection was made, and what the server knows of it.
  std::uint64_t count = 0;
  std::uint64_t told = 0;
  /// Whether the subscriber is a participant, of whose messages none is dropped.
  bool participant = false;
};

/// A topic's sending end; all of it in the main thread.
class Outlet {
 public:
  Outlet(const ros::AdvertiseOptions& options, const Waker& waker);

  const std::string& topic() const { return topic_; }
  const std::string& type() const { return type_; }
  std::vector<Link>& links() { return links_; }
  const std::optional<Digest>& digest() const { return digest_; }
  const ros::Publisher* plain() const { return plain_ ? &*plain_ : nullptr; }

  /// Advertises as an ordinary publisher.
  void openPlain(ros::AdvertiseOptions options);
  /// Advertises as one whose messages are counted.
  void openCounted(ros::AdvertiseOptions options);
  void close();

  /// Hands a message to every connection; `digested_us` is the simulation time if there is to be a checksum.
  void publish(const ros::SerializedMessage& message, std::optional<std::int64_t> digested_us);
  std::uint32_t countSubscribers() const;
  /// Looks at what connections there are now, if something has changed.
  void update();
  /// Returns the numbers of the connections that are gone, once.
  std::vector<std::uint32_t> takeGone() { return std::exchange(gone_, {}); }

 private:
  /// Drops what a stalled subscriber that is no participant does not take.
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
  std::vector<std::uint32_t> gone_;
  ros::SerializedMessage last_;
  std::optional<Digest> digest_;
};

/// The messages of one connection, in the order of sending. Guarded by the inlets' mutex, but for `closed`.
struct Inbox {
  std::string publisher;
  std::deque<Message> messages;
  /// Since the connection was made: received; of these discarded as a foreign publisher's queue was full; and
  /// dispatched, or discarded as time went back.
  std::uint64_t received = 0;
  std::uint64_t dropped = 0;
  std::uint64_t taken = 0;
  /// How many may be dispatched by now; none if the publisher is no participant.
  std::optional<std::uint64_t> target;
  /// Messages that were counted by the publisher and never came.
  std::uint64_t given_up = 0;
  /// No more will come; set in any thread.
  std::atomic<bool> closed{false};
  /// The server has said that the channel is no more.
  bool lost = false;
  bool latched = false;
  Message latch;
  /// Tells the connection; its address identifies it as long as it is kept.
  boost::shared_ptr<ros::M_string> header;

  /// How many messages that must be here have not come yet.
  std::uint64_t lacking() const;
  /// How many messages that are here are among the first `count` of the connection.
  std::uint64_t hereOfFirst(std::uint64_t count) const;
};

/// A topic's receiving end. Messages come in in roscpp's thread, everything else is the main thread's.
class Inlet {
 public:
  /// `waker` is woken by each message while `eager` is set, and always when a connection ends.
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

  /// Takes a message in; called in any thread.
  void receive(const boost::shared_ptr<ros::M_string>& header, const Message& message);
  /// Takes a publisher for a participant from now on; returns the inbox of its connection, which may have to come yet.
  std::shared_ptr<Inbox> count(const std::string& publisher, int port);
  /// Says how many messages over a channel must be here before the turn begins; returns whether they are.
  bool expect(Inbox& inbox, std::uint64_t target);
  /// How many messages that must be here have not come yet over a connection that is open.
  std::uint64_t lacking(const Inbox& inbox);
  /// No longer waits for what is lacking; returns how much that was.
  std::uint64_t giveUp(Inbox& inbox);
  /// Drops what is not dispatched yet of the first `count` messages, unless they are latched: those hold on.
  void discard(Inbox& inbox, std::uint64_t count);
  void setLost(Inbox& inbox);
  /// Finds the connections of inboxes that have none yet; where there is none, nothing will come.
  void closeUnconnected();

  /// Removes and returns the messages whose tick it is: by publisher's name, then in the order of sending.
  std::vector<Message> take();
  /// The latched messages dispatched so far, for a subscriber that comes later.
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
  /// What came before `subscription_` was known.
  std::vector<std::pair<boost::shared_ptr<ros::M_string>, Message>> early_;
};

/// One subscriber.
class Entry {
 public:
  Entry(std::shared_ptr<Inlet> inlet, std::function<void(const void*)> callback);

  const std::shared_ptr<Inlet>& inlet() const { return inlet_; }
  /// Runs the callback with each message.
  void dispatch(const std::vector<Message>& messages);
  void end() { callback_ = nullptr; }

 private:
  void invoke(const Message& message);

  std::shared_ptr<Inlet> inlet_;
  std::function<void(const void*)> callback_;
  std::vector<Message> pending_;
};

}  // namespace detail
}  // namespace xtdrone_control::lockstep
