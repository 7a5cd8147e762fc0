#include "topics.h"

#include <ros/console.h>
#include <ros/node_handle.h>
#include <ros/this_node.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <system_error>

namespace xtdrone_lockstep {

Waker::Waker() : descriptor_(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)) {
  if (descriptor_ < 0) {
    throw std::system_error(errno, std::generic_category(), "eventfd");
  }
}

void Waker::wake() const noexcept {
  const int before = errno;  // must be preserved in signal handlers
  const std::uint64_t one = 1;
  // Fails only if the counter is at its maximum, i.e. with a wake-up pending.
  [[maybe_unused]] const ssize_t written = write(descriptor_, &one, sizeof one);
  errno = before;
}

void Waker::clear() const noexcept {
  std::uint64_t count;
  [[maybe_unused]] const ssize_t taken = read(descriptor_, &count, sizeof count);
}

namespace detail {
namespace {

/// Messages kept for a stalled subscriber that is not a participant, if the publisher sets no queue size.
constexpr std::size_t STALLED_QUEUE = 100;
/// Messages kept from a publisher that is not a participant, if the subscriber sets no queue size.
constexpr std::size_t FOREIGN_QUEUE = 1000;
/// Bytes of the length prefix of a serialised message.
constexpr std::uint32_t PREFIX = 4;

/// Runs roscpp's callbacks at once, in the thread that has read the message.
class DirectQueue : public ros::CallbackQueueInterface {
 public:
  void addCallback(const ros::CallbackInterfacePtr& callback, std::uint64_t) override { callback->call(); }
  void removeByID(std::uint64_t) override {}
};

DirectQueue& directQueue() {
  static auto* const queue = new DirectQueue;  // never destroyed, as roscpp's threads use it until the process ends
  return *queue;
}

void ignore(const ros::SingleSubscriberPublisher&) {}

std::string valueOf(const ros::M_string& header, const std::string& key) {
  const auto found = header.find(key);
  return found == header.end() ? "" : found->second;
}

}  // namespace

// ---- sending ----

Outlet::Outlet(const ros::AdvertiseOptions& options, const Waker& waker)
    : topic_(options.topic),
      type_(options.datatype),
      stalled_queue_(options.queue_size != 0 ? options.queue_size : STALLED_QUEUE),
      latch_(options.latch),
      has_header_(options.has_header),
      notifier_(waker) {}

void Outlet::openPlain(ros::AdvertiseOptions options) {
  ros::NodeHandle handle;
  options.queue_size = static_cast<std::uint32_t>(stalled_queue_);
  plain_ = handle.advertise(options);
}

void Outlet::openCounted(ros::AdvertiseOptions options) {
  if (ros::TopicManager::instance()->lookupPublication(topic_)) {
    throw std::invalid_argument(topic_ + " has a ros::Publisher in this process; use lockstep::advertise");
  }
  options.queue_size = 0;  // no limit: roscpp would drop messages to participants; send() limits the others
  callbacks_ = boost::make_shared<ros::SubscriberCallbacks>(ignore, ignore, ros::VoidConstPtr(), &notifier_);
  if (latch_) {
    // Marks the topic as latched in the connection's header. The message itself is sent in update(): here, in another
    // thread, the count could be wrong.
    callbacks_->push_latched_message_ = [](const ros::SubscriberLinkPtr&) {};
  }
  if (!ros::TopicManager::instance()->advertise(options, callbacks_)) {
    throw InitError(topic_ + ": cannot advertise; is the master running?");
  }
  publication_ = ros::TopicManager::instance()->lookupPublication(topic_);
}

void Outlet::close() {
  if (plain_) {
    plain_->shutdown();
  }
  if (publication_) {
    ros::TopicManager::instance()->unadvertise(topic_, callbacks_);
  }
}

void Outlet::publish(const ros::SerializedMessage& message, std::optional<std::int64_t> digested_us) {
  if (!publication_ || publication_->isDropped()) {
    return;
  }
  // From 1 as in rospy, so that a node's messages are the same in either language.
  const std::uint32_t sequence = publication_->incrementSequence() + 1;
  if (has_header_) {
    // The sequence number is the first field of the header, and the header the first field of the message.
    for (std::size_t i = 0; i < sizeof sequence; ++i) {
      message.buf[PREFIX + i] = static_cast<std::uint8_t>(sequence >> (8 * i));
    }
  }
  update();
  for (Link& link : links_) {
    send(link, message);
  }
  if (latch_) {
    last_ = message;
  }
  if (digested_us) {
    if (!digest_) {
      digest_.emplace();
    }
    digest_->add(*digested_us, message.buf.get() + PREFIX, static_cast<std::uint32_t>(message.num_bytes) - PREFIX);
  }
}

void Outlet::send(Link& link, const ros::SerializedMessage& message) const {
  const bool sent = sendNow(*link.link, message);
  ++link.count;
  if (!sent && !link.participant) {
    link.count -= boundOutbox(*link.link, stalled_queue_);
  }
}

std::uint32_t Outlet::countSubscribers() const {
  if (plain_) {
    return plain_->getNumSubscribers();
  }
  return publication_ ? publication_->getNumSubscribers() : 0;
}

void Outlet::update() {
  if (!publication_ || !notifier_.take()) {
    return;
  }
  const ros::V_SubscriberLink present = linksOf(*publication_);
  for (const ros::SubscriberLinkPtr& link : present) {
    if (std::any_of(links_.begin(), links_.end(), [&](const Link& known) { return known.link == link; })) {
      continue;
    }
    // Its count starts here: it receives the messages published from now on.
    Link added;
    added.link = link;
    if (latch_ && last_.buf) {
      send(added, last_);
    }
    links_.push_back(added);
  }
  const auto end = std::remove_if(links_.begin(), links_.end(), [&](const Link& known) {
    if (std::find(present.begin(), present.end(), known.link) != present.end()) {
      return false;
    }
    if (known.number != 0) {
      closed_links_.push_back(known.number);
    }
    return true;
  });
  links_.erase(end, links_.end());
}

// ---- receiving ----

std::uint64_t Inbox::lacking() const {
  if (!target || closed) {
    return 0;
  }
  const std::uint64_t there = given_up + received;
  return *target > there ? *target - there : 0;
}

std::uint64_t Inbox::pendingOfFirst(std::uint64_t count) const {
  const std::uint64_t gone = given_up + taken + dropped;
  return count > gone ? std::min<std::uint64_t>(messages.size(), count - gone) : 0;
}

Inlet::Inlet(std::string topic, const std::type_info& message, std::string type, const Waker& waker,
             const std::atomic<bool>& eager)
    : topic_(std::move(topic)),
      message_(message),
      type_(std::move(type)),
      waker_(waker),
      eager_(eager),
      most_foreign_(FOREIGN_QUEUE) {}

void Inlet::open(ros::SubscribeOptions& options) {
  options.callback_queue = &directQueue();
  options.transport_hints.tcpNoDelay();
  if (!ros::TopicManager::instance()->subscribe(options)) {
    throw InitError(topic_ + ": cannot subscribe; is the master running?");
  }
  helper_ = options.helper;
  auto subscription = findSubscription(topic_);
  const std::lock_guard<std::mutex> lock(mutex_);
  subscription_ = std::move(subscription);
  for (const auto& [header, message] : early_) {
    store(header, message);
  }
  early_.clear();
}

void Inlet::close() {
  ros::TopicManager::instance()->unsubscribe(topic_, helper_);
  const std::lock_guard<std::mutex> lock(mutex_);
  helper_.reset();
  subscription_.reset();
  inboxes_.clear();
  by_header_.clear();
}

void Inlet::setQueueSize(std::size_t size) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (size != 0) {
    most_foreign_ = size;
  }
}

std::uint32_t Inlet::countPublishers() const { return subscription_ ? subscription_->getNumPublishers() : 0; }

void Inlet::receive(const boost::shared_ptr<ros::M_string>& header, const Message& message) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!subscription_) {
      early_.emplace_back(header, message);
      return;
    }
    store(header, message);
  }
  if (eager_) {
    waker_.wake();
  }
}

void Inlet::store(const boost::shared_ptr<ros::M_string>& header, const Message& message) {
  const auto known = by_header_.find(header.get());
  const std::shared_ptr<Inbox> inbox = known == by_header_.end() ? bind(header) : known->second;
  inbox->messages.push_back(message);
  ++inbox->received;
  if (!inbox->target) {
    for (const std::size_t most = std::max(most_foreign_, FOREIGN_QUEUE); inbox->messages.size() > most;) {
      inbox->messages.pop_front();
      ++inbox->dropped;
    }
  }
}

std::shared_ptr<Inbox> Inlet::inboxOf(const Key& key) {
  std::shared_ptr<Inbox>& inbox = inboxes_[key];
  if (!inbox) {
    inbox = std::make_shared<Inbox>();
    inbox->publisher = key.first;
  }
  return inbox;
}

std::shared_ptr<Inbox> Inlet::bind(const boost::shared_ptr<ros::M_string>& header) {
  const std::string publisher = valueOf(*header, "callerid");
  if (publisher == ros::this_node::getName()) {
    // A connection of a node to itself stays in the process and has no port. The links must not be inspected here:
    // roscpp holds their mutex while it makes such a connection and sends the latched message over it.
    const auto inbox = inboxOf({publisher, 0});
    connect(inbox, header, nullptr);
    return inbox;
  }
  findConnections();
  const auto found = by_header_.find(header.get());
  if (found != by_header_.end()) {
    return found->second;
  }
  // The connection was closed while this message was read.
  const auto inbox = inboxOf({publisher, -1});
  connect(inbox, header, nullptr);
  inbox->closed = true;
  return inbox;
}

void Inlet::connect(const std::shared_ptr<Inbox>& inbox, const boost::shared_ptr<ros::M_string>& header,
                    const ros::ConnectionPtr& connection) {
  inbox->header = header;
  inbox->latched = valueOf(*header, "latching") == "1";
  by_header_[header.get()] = inbox;
  if (!connection) {
    return;
  }
  connection->addDropListener([inbox, &waker = waker_](const ros::ConnectionPtr&, ros::Connection::DropReason) {
    inbox->closed = true;
    waker.wake();
  });
  if (connection->isDropped()) {
    inbox->closed = true;
  }
}

void Inlet::findConnections() {
  for (const ros::TransportPublisherLinkPtr& link : linksOf(*subscription_)) {
    const ros::ConnectionPtr connection = link->getConnection();
    const std::string publisher = link->getCallerID();
    if (!connection || publisher.empty()) {
      continue;  // its header has not arrived yet
    }
    const boost::shared_ptr<ros::M_string> header = connection->getHeader().getValues();
    if (by_header_.count(header.get()) == 0) {
      connect(inboxOf({publisher, localPort(link->getTransportInfo())}), header, connection);
    }
  }
}

std::shared_ptr<Inbox> Inlet::count(const std::string& publisher, int port) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto inbox = inboxOf({publisher, port});
  if (!inbox->target) {
    inbox->target = 0;
  }
  if (!inbox->header && subscription_) {
    findConnections();
  }
  return inbox;
}

bool Inlet::expect(Inbox& inbox, std::uint64_t target) {
  const std::lock_guard<std::mutex> lock(mutex_);
  inbox.target = target;
  return inbox.lacking() == 0;
}

std::uint64_t Inlet::lacking(const Inbox& inbox) {
  const std::lock_guard<std::mutex> lock(mutex_);
  return inbox.lacking();
}

std::uint64_t Inlet::giveUp(Inbox& inbox) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const std::uint64_t lacking = inbox.lacking();
  inbox.given_up += lacking;
  return lacking;
}

void Inlet::discard(Inbox& inbox, std::uint64_t count) {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (inbox.latched) {
    return;
  }
  const auto void_messages = static_cast<std::ptrdiff_t>(inbox.pendingOfFirst(count));
  inbox.messages.erase(inbox.messages.begin(), inbox.messages.begin() + void_messages);
  inbox.taken += static_cast<std::uint64_t>(void_messages);
}

void Inlet::setLost(Inbox& inbox) {
  const std::lock_guard<std::mutex> lock(mutex_);
  inbox.lost = true;
}

void Inlet::closeUnconnected() {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (subscription_) {
    findConnections();
  }
  for (const auto& [key, inbox] : inboxes_) {
    if (!inbox->header && key.first != ros::this_node::getName()) {
      inbox->closed = true;
    }
  }
}

std::vector<Message> Inlet::take() {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::vector<Message> taken;
  for (auto it = inboxes_.begin(); it != inboxes_.end();) {
    Inbox& inbox = *it->second;
    takeFrom(inbox, taken);
    if (inbox.lost || (inbox.closed && !inbox.target && inbox.messages.empty())) {
      by_header_.erase(inbox.header.get());
      it = inboxes_.erase(it);
    } else {
      ++it;
    }
  }
  return taken;
}

void Inlet::takeFrom(Inbox& inbox, std::vector<Message>& taken) const {
  std::uint64_t ready = inbox.messages.size();
  std::uint64_t surplus = 0;
  if (inbox.target) {
    ready = inbox.pendingOfFirst(*inbox.target);
  } else if (ready > most_foreign_) {
    surplus = ready - most_foreign_;
  }
  for (std::uint64_t i = 0; i < ready; ++i) {
    Message message = std::move(inbox.messages.front());
    inbox.messages.pop_front();
    ++inbox.taken;
    if (i < surplus) {
      continue;
    }
    if (inbox.latched) {
      inbox.latch = message;
    }
    taken.push_back(std::move(message));
  }
}

std::vector<Message> Inlet::latches() {
  const std::lock_guard<std::mutex> lock(mutex_);
  std::vector<Message> found;
  for (const auto& [key, inbox] : inboxes_) {
    if (inbox->latch) {
      found.push_back(inbox->latch);
    }
  }
  return found;
}

Entry::Entry(std::shared_ptr<Inlet> inlet, std::function<void(const void*)> callback)
    : inlet_(std::move(inlet)), callback_(std::move(callback)), pending_(inlet_->latches()) {}

void Entry::dispatch(const std::vector<Message>& messages) {
  for (const Message& message : std::exchange(pending_, {})) {
    invoke(message);
  }
  for (const Message& message : messages) {
    invoke(message);
  }
}

void Entry::invoke(const Message& message) {
  const auto callback = callback_;  // a copy, as the callback may end its own subscription
  if (!callback) {
    return;
  }
  try {
    callback(message.get());
  } catch (const std::exception& error) {
    ROS_ERROR("bad callback for %s: %s", inlet_->topic().c_str(), error.what());
  }
}

}  // namespace detail
}  // namespace xtdrone_lockstep
