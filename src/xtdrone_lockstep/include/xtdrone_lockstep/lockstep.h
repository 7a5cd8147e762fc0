/// Strict lockstep with the simulator for C++ nodes, the counterpart of xtdrone_lockstep for Python nodes.
///
/// A node in lockstep (a *participant*) takes its time from the simulator, runs its callbacks in its own thread in a
/// fixed order (in start() and Rate::sleep()), and reports the end of each turn. Without a simulator the same calls
/// behave like ros::Rate with plain topics, and callbacks run in the same place. See docs/design.md.
///
///     #include <geometry_msgs/Twist.h>
///     #include <std_msgs/String.h>
///     #include "xtdrone_lockstep/lockstep.h"
///
///     namespace lockstep = xtdrone_lockstep;
///
///     int main(int argc, char** argv) try {
///       lockstep::init(argc, argv, "hover", 30.0);  // ros::init; joins the lockstep if there is one
///       std::string word;
///       auto commands = lockstep::advertise<geometry_msgs::Twist>("/xtdrone/iris_0/cmd_vel_enu", 10);
///       auto words = lockstep::subscribe<std_msgs::String>("/words", 10, [&](const auto& m) { word = m.data; });
///       lockstep::start();  // after declaring all topics: join, wait for the first tick
///       lockstep::spin([&] { commands.publish(geometry_msgs::Twist()); });  // or a loop with lockstep::Rate
///       return lockstep::exitStatus();  // 1 if the simulator has failed or has dropped the node
///     } catch (const lockstep::InitError& error) {
///       std::cerr << error.what() << std::endl;
///       return 1;
///     }
///
///     # CMakeLists.txt
///     find_package(catkin REQUIRED COMPONENTS roscpp xtdrone_lockstep)
///     add_executable(hover src/hover.cpp)
///     target_include_directories(hover PRIVATE ${catkin_INCLUDE_DIRS})
///     target_link_libraries(hover ${catkin_LIBRARIES})
///
/// Call everything from the node's main thread. In a participant never use ros::Duration::sleep, ros::Rate, ros::spin
/// or ros::Timer: time stands still until the node has ended its turn. ros::Time::now() is the time of the tick.
#pragma once

#include <ros/advertise_options.h>
#include <ros/init.h>
#include <ros/message_event.h>
#include <ros/names.h>
#include <ros/publisher.h>
#include <ros/rate.h>
#include <ros/serialization.h>
#include <ros/subscribe_options.h>

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <typeinfo>

namespace xtdrone_lockstep {

/// The node cannot start: no master, no answer from the simulator, or a refusal; the text gives the reason.
class InitError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Initialise the ROS node, in place of ros::init, and determine whether it takes part in a simulator's lockstep.
///
/// It does if `/lockstep/uri` is set or `/lockstep/wait` is true, unless the private parameter `~lockstep` is false.
/// SIGINT and SIGTERM shut the node down cleanly, unless `options` contains ros::init_options::NoSigintHandler.
///
/// @param argc, argv  The program's arguments; remappings are removed.
/// @param name        Node name.
/// @param rate        Turns per second of simulation time in Hz, above 0 and at most 250.
/// @param options     As for ros::init.
/// @throws InitError  No master answers, or another participant has this name.
/// @throws std::invalid_argument  The rate is out of range.
void init(int& argc, char** argv, const std::string& name, double rate = 30.0, std::uint32_t options = 0);

/// Return whether this node takes part in a simulator's lockstep.
bool isActive();

/// Return the exit status for the program: 1 if the simulator has failed or has dropped the node, else 0.
int exitStatus();

/// Register a function to be called after simulation time was reset, as by /gazebo/reset_simulation: in Rate::sleep(),
/// with the new time set, before all callbacks of the turn. An exception in it is logged and does not end the node.
///
/// Without lockstep it is also called when /clock (/use_sim_time) has jumped back; callbacks of messages sent before
/// the reset may then follow.
void addResetHook(std::function<void()> hook);

/// Join the simulator, if there is one, and wait for the first tick; all topics should be declared before.
///
/// Callbacks of messages that arrived before that tick (latched ones, say) run before this returns. It also returns
/// when the node is shut down meanwhile; ros::ok() is then false.
///
/// @throws InitError  The simulator does not answer or refuses the node.
void start();

/// Ends the node's turns; callbacks run in sleep().
class Rate {
 public:
  /// Use the rate given to init(); a node has one rate.
  Rate();
  /// @throws std::invalid_argument  `hz` differs from the rate given to init().
  explicit Rate(double hz);

  /// End this turn, wait for the next and run the callbacks of received messages.
  ///
  /// @return False if there is no next turn because the node is shut down or the simulator is gone.
  bool sleep();

 private:
  std::optional<ros::Rate> free_;
};

/// Sleep for at least `seconds` of simulation time, turn by turn; callbacks run meanwhile. A reset of the time ends the
/// sleep, after the reset hooks and callbacks of that turn.
///
/// @return False if the node is shutting down.
bool sleep(double seconds);

/// Call `step` once per turn until the node is shut down; without it the node works in callbacks only.
void spin(const std::function<void()>& step = nullptr);

namespace detail {

class Inlet;
class Outlet;
class Entry;
using Message = boost::shared_ptr<void const>;

std::shared_ptr<Outlet> declareOutlet(const ros::AdvertiseOptions& options);
/// Return the plain publisher to use without lockstep, else nullptr.
const ros::Publisher* plainPublisher(const Outlet& outlet);
void publish(Outlet& outlet, const ros::SerializedMessage& message);
std::uint32_t countSubscribers(const Outlet& outlet);
void closeOutlet(const std::shared_ptr<Outlet>& outlet);

/// Return the receiving end of a topic, shared by all of the node's subscribers to it.
std::shared_ptr<Inlet> findInlet(const std::string& topic, const std::type_info& type, const std::string& datatype);
void openInlet(const std::shared_ptr<Inlet>& inlet, ros::SubscribeOptions& options);
bool isOpen(const Inlet& inlet);
void receive(Inlet& inlet, const boost::shared_ptr<ros::M_string>& header, const Message& message);
std::shared_ptr<Entry> attach(const std::shared_ptr<Inlet>& inlet, std::uint32_t queue_size,
                              std::function<void(const void*)> callback);
std::uint32_t countPublishers(const Entry& entry);
void closeEntry(const std::shared_ptr<Entry>& entry);

}  // namespace detail

/// Handle of a publisher whose messages are counted; copies publish on the same topic.
template <class M>
class Publisher {
 public:
  /// Create an empty handle; assign the result of advertise() to it.
  Publisher() = default;
  explicit Publisher(std::shared_ptr<detail::Outlet> outlet) : outlet_(std::move(outlet)) {}

  /// Publish a message; each subscribed participant receives it in its next turn.
  void publish(const M& message) const {
    if (!outlet_) {
      throw std::logic_error("publish() on a lockstep::Publisher that was never advertised");
    }
    if (const ros::Publisher* plain = detail::plainPublisher(*outlet_)) {
      plain->publish(message);
    } else {
      detail::publish(*outlet_, ros::serialization::serializeMessage(message));
    }
  }

  /// Return the number of subscribers; digests, if the simulator requests them, count as one. Messages are then
  /// published in any case, so that a flight does not depend on other subscribers.
  std::uint32_t getNumSubscribers() const { return outlet_ ? detail::countSubscribers(*outlet_) : 0; }

  /// Stop publishing the topic, for all handles.
  void shutdown() {
    if (outlet_) {
      detail::closeOutlet(outlet_);
      outlet_.reset();
    }
  }

 private:
  std::shared_ptr<detail::Outlet> outlet_;
};

/// Handle of a subscription, which ends with shutdown() rather than with the handle.
class Subscriber {
 public:
  Subscriber() = default;
  explicit Subscriber(std::shared_ptr<detail::Entry> entry) : entry_(std::move(entry)) {}

  /// Return the number of connected publishers.
  std::uint32_t getNumPublishers() const { return entry_ ? detail::countPublishers(*entry_) : 0; }

  /// End the subscription.
  void shutdown() {
    if (entry_) {
      detail::closeEntry(entry_);
      entry_.reset();
    }
  }

 private:
  std::shared_ptr<detail::Entry> entry_;
};

/// Advertise a topic; later calls in the same process return further handles of it.
///
/// @param topic       Topic name, resolved as usual.
/// @param queue_size  Messages kept for a stalled subscriber that is not a participant; messages to participants are
///                    never dropped. 0 for 100.
/// @param latch       Whether to send the last message to every new subscriber.
/// @throws std::invalid_argument  The topic is advertised in this process with another type or by a ros::Publisher.
template <class M>
Publisher<M> advertise(const std::string& topic, std::uint32_t queue_size, bool latch = false) {
  ros::AdvertiseOptions options;
  options.init<M>(ros::names::resolve(topic), queue_size);
  options.latch = latch;
  return Publisher<M>(detail::declareOutlet(options));
}

/// Subscribe to a topic.
///
/// @param topic       Topic name, resolved as usual.
/// @param queue_size  Maximum number of messages (the newest) dispatched at a time from a publisher that is not a
///                    participant; messages of participants are never dropped. 0 for 1000.
/// @param callback    Called with each message in start() and Rate::sleep(), in the calling thread. An exception in it
///                    is logged and does not end the node.
/// @throws std::invalid_argument  The topic is subscribed to in this process with another type.
template <class M>
Subscriber subscribe(const std::string& topic, std::uint32_t queue_size, std::function<void(const M&)> callback) {
  const std::string resolved = ros::names::resolve(topic);
  const auto inlet = detail::findInlet(resolved, typeid(M), ros::message_traits::datatype<M>());
  if (!detail::isOpen(*inlet)) {
    ros::SubscribeOptions options;
    // The raw pointer stays valid, as the inlet is closed before it is released.
    options.initByFullCallbackType<const ros::MessageEvent<M const>&>(
        resolved, 0, [end = inlet.get()](const ros::MessageEvent<M const>& event) {
          detail::receive(*end, event.getConnectionHeaderPtr(), event.getConstMessage());
        });
    detail::openInlet(inlet, options);
  }
  return Subscriber(detail::attach(inlet, queue_size, [callback = std::move(callback)](const void* message) {
    callback(*static_cast<const M*>(message));
  }));
}

}  // namespace xtdrone_lockstep
