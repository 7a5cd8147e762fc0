/// Access to the topic connections that roscpp keeps private.
///
/// A participant needs the TCP port of each connection, the messages sent over it and the time at which it is closed;
/// and its messages must be in the kernel when its turn ends. roscpp offers no functions for this. In C++ an explicit
/// template instantiation may name private members, so that these can be accessed without changing roscpp; with an
/// incompatible version of roscpp this does not compile.
#pragma once

#include <ros/connection.h>
#include <ros/master.h>
#include <ros/publication.h>
#include <ros/publisher_link.h>
#include <ros/subscriber_link.h>
#include <ros/subscription.h>
#include <ros/this_node.h>
#include <ros/topic_manager.h>
#include <ros/transport/transport.h>
#include <ros/transport_publisher_link.h>
#include <ros/transport_subscriber_link.h>
#include <ros/xmlrpc_manager.h>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

namespace xtdrone_lockstep {
namespace exposed {

template <auto MEMBER, class Tag>
struct Expose {
  friend constexpr auto member(Tag) { return MEMBER; }
};

#define XTDRONE_EXPOSE(tag, pointer)   \
  struct tag {                         \
    friend constexpr auto member(tag); \
  };                                   \
  template struct Expose<pointer, tag>

XTDRONE_EXPOSE(Subscriptions, &ros::TopicManager::subscriptions_);
XTDRONE_EXPOSE(SubscriptionsMutex, &ros::TopicManager::subs_mutex_);
XTDRONE_EXPOSE(PublisherLinks, &ros::Subscription::publisher_links_);
XTDRONE_EXPOSE(PublisherLinksMutex, &ros::Subscription::publisher_links_mutex_);
XTDRONE_EXPOSE(SubscriberLinks, &ros::Publication::subscriber_links_);
XTDRONE_EXPOSE(SubscriberLinksMutex, &ros::Publication::subscriber_links_mutex_);
XTDRONE_EXPOSE(Outbox, &ros::TransportSubscriberLink::outbox_);
XTDRONE_EXPOSE(OutboxMutex, &ros::TransportSubscriberLink::outbox_mutex_);
XTDRONE_EXPOSE(HeaderWritten, &ros::TransportSubscriberLink::header_written_);
XTDRONE_EXPOSE(Writing, &ros::TransportSubscriberLink::writing_message_);

#undef XTDRONE_EXPOSE

}  // namespace exposed

/// Return roscpp's subscription to a topic, nullptr if there is none.
inline ros::SubscriptionPtr findSubscription(const std::string& topic) {
  ros::TopicManager& manager = *ros::TopicManager::instance();
  boost::mutex::scoped_lock lock(manager.*member(exposed::SubscriptionsMutex()));
  for (const ros::SubscriptionPtr& subscription : manager.*member(exposed::Subscriptions())) {
    if (!subscription->isDropped() && subscription->getName() == topic) {
      return subscription;
    }
  }
  return nullptr;
}

/// Return the connections to a topic's publishers in other processes.
inline std::vector<ros::TransportPublisherLinkPtr> linksOf(ros::Subscription& subscription) {
  std::vector<ros::TransportPublisherLinkPtr> links;
  boost::mutex::scoped_lock lock(subscription.*member(exposed::PublisherLinksMutex()));
  for (const ros::PublisherLinkPtr& link : subscription.*member(exposed::PublisherLinks())) {
    if (auto transport = boost::dynamic_pointer_cast<ros::TransportPublisherLink>(link)) {
      links.push_back(transport);
    }
  }
  return links;
}

/// Ask the master again for the publishers of a topic that is subscribed to, and connect to those that have no
/// connection: the notification of one may have been lost, and roscpp does not repeat a request that a publisher has
/// not answered.
///
/// The master may take its time, and meanwhile another thread may unsubscribe from the topic, before the master
/// registers it again here: it is unregistered then, and registered once more if it has been subscribed to in between.
inline void askMasterAgain(const std::string& topic) {
  XmlRpc::XmlRpcValue request;
  request[0] = ros::this_node::getName();
  request[1] = topic;
  while (const ros::SubscriptionPtr asked = findSubscription(topic)) {
    request[2] = asked->datatype();
    request[3] = ros::XMLRPCManager::instance()->getServerURI();
    XmlRpc::XmlRpcValue response;
    XmlRpc::XmlRpcValue publishers;
    if (!ros::master::execute("registerSubscriber", request, response, publishers, false)) {
      return;
    }
    if (const ros::SubscriptionPtr kept = findSubscription(topic)) {
      std::vector<std::string> uris;
      for (int i = 0; i < publishers.size(); ++i) {
        uris.push_back(publishers[i]);
      }
      // The answer may be older than the last notification, and roscpp closes connections to all publishers not named
      // here.
      for (const ros::TransportPublisherLinkPtr& link : linksOf(*kept)) {
        uris.push_back(link->getPublisherXMLRPCURI());
      }
      kept->pubUpdate(uris);
      return;
    }
    XmlRpc::XmlRpcValue end;
    end[0] = request[0];
    end[1] = request[1];
    end[2] = request[3];
    ros::master::execute("unregisterSubscriber", end, response, publishers, false);
  }
}

/// Return the connections to a topic's subscribers.
inline ros::V_SubscriberLink linksOf(ros::Publication& publication) {
  boost::mutex::scoped_lock lock(publication.*member(exposed::SubscriberLinksMutex()));
  return publication.*member(exposed::SubscriberLinks());
}

/// Send a message over a connection in the calling thread, without blocking; bytes that the kernel does not accept are
/// sent by roscpp's own thread.
///
/// @return False if messages are waiting to be sent.
inline bool sendNow(ros::SubscriberLink& link, const ros::SerializedMessage& message) {
  auto* transport = dynamic_cast<ros::TransportSubscriberLink*>(&link);
  if (transport == nullptr) {
    link.enqueueMessage(message, true, false);
    return true;
  }
  bool idle;
  {
    boost::mutex::scoped_lock lock(transport->*member(exposed::OutboxMutex()));
    idle = transport->*member(exposed::HeaderWritten()) && !(transport->*member(exposed::Writing())) &&
           (transport->*member(exposed::Outbox())).empty();
  }
  std::size_t sent = 0;
  if (idle) {
    // There is no other writer now: the outbox is empty, and only this thread fills it.
    const ros::ConnectionPtr connection = transport->getConnection();
    const auto taken =
        connection->getTransport()->write(message.buf.get(), static_cast<std::uint32_t>(message.num_bytes));
    if (taken < 0 || static_cast<std::size_t>(taken) == message.num_bytes) {
      return true;  // closed, or completely sent
    }
    sent = static_cast<std::size_t>(taken);
  }
  ros::SerializedMessage rest = message;
  if (sent != 0) {
    rest.num_bytes = message.num_bytes - sent;
    rest.buf.reset(new std::uint8_t[rest.num_bytes]);
    std::memcpy(rest.buf.get(), message.buf.get() + sent, rest.num_bytes);
  }
  link.enqueueMessage(rest, true, false);
  return false;
}

/// Discard the oldest messages waiting to be sent beyond `most`, and return their number. The rest of a partially sent
/// message is not among them.
inline std::size_t boundOutbox(ros::SubscriberLink& link, std::size_t most) {
  auto* transport = dynamic_cast<ros::TransportSubscriberLink*>(&link);
  if (transport == nullptr) {
    return 0;
  }
  boost::mutex::scoped_lock lock(transport->*member(exposed::OutboxMutex()));
  auto& outbox = transport->*member(exposed::Outbox());
  std::size_t dropped = 0;
  for (; outbox.size() > most; ++dropped) {
    outbox.pop();
  }
  return dropped;
}

/// Return the local TCP port of a connection, -1 if there is none.
///
/// @param info  The transport's description: "TCPROS connection on port 45678 to [10.0.0.2:37001 on socket 9]".
inline int localPort(const std::string& info) {
  static const std::string phrase = "on port ";
  const std::size_t at = info.find(phrase);
  return at == std::string::npos ? -1 : std::atoi(info.c_str() + at + phrase.size());
}

/// Return the remote TCP port of a connection, -1 if there is none.
inline int remotePort(const std::string& info) {
  // The address may be an IPv6 address, which contains colons.
  const std::size_t end = info.rfind(" on socket ");
  const std::size_t colon = end == std::string::npos ? end : info.rfind(':', end);
  return colon == std::string::npos ? -1 : std::atoi(info.c_str() + colon + 1);
}

}  // namespace xtdrone_lockstep
