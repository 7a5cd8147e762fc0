/// Strict lockstep with the simulator for C++ nodes: what xtdrone_control.lockstep is for Python ones.
///
/// A node that takes part (a *participant*) has its time from the simulator, runs its callbacks in its own thread in a
/// fixed order (in start() and Rate::sleep()), and tells the simulator when its turn is done. Without a simulator the
/// same calls are ros::Rate and plain topics, with the callbacks in the same place. See docs/design.md.
///
///     #include <geometry_msgs/Twist.h>
///     #include <std_msgs/String.h>
///     #include "xtdrone_control/lockstep.h"
///
///     namespace lockstep = xtdrone_control::lockstep;
///
///     int main(int argc, char** argv) try {
///       lockstep::init(argc, argv, "hover", 30.0);  // ros::init, and decides whether the node takes part
///       std::string word;
///       auto commands = lockstep::advertise<geometry_msgs::Twist>("/xtdrone/iris_0/cmd_vel_enu", 10);
///       auto words = lockstep::subscribe<std_msgs::String>("/words", 10, [&](const auto& m) { word = m.data; });
///       lockstep::start();  // all topics are declared: joins, and waits for the first tick
///       lockstep::spin([&] { commands.publish(geometry_msgs::Twist()); });  // or a loop with lockstep::Rate
///       return lockstep::exitStatus();  // 1 if the simulator has failed or has dropped the node
///     } catch (const lockstep::InitError& error) {
///       std::cerr << error.what() << std::endl;
///       return 1;
///     }
///
///     # CMakeLists.txt
///     find_package(catkin REQUIRED COMPONENTS roscpp xtdrone_control)
///     add_executable(hover src/hover.cpp)
///     target_include_directories(hover PRIVATE ${catkin_INCLUDE_DIRS})
///     target_link_libraries(hover ${catkin_LIBRARIES})
///
/// All of it belongs to the node's main thread. In a participant never call ros::Duration::sleep, ros::Rate, ros::spin
/// or a ros::Timer: time stands still until the node says that its turn is done. ros::Time::now() is the tick's time.
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

namespace xtdrone_control::lockstep {

/// The node cannot start: no master, no answer from the simulator, or a refusal; the text says why and what to do.
class InitError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Initialises the ROS node, in ros::init's place, and decides whether it takes part in a simulator's lockstep.
///
/// It does if `/lockstep/uri` is set or `/lockstep/wait` is true, and the private parameter `~lockstep` is not false.
/// SIGINT and SIGTERM end the node in an orderly way, unless `options` has ros::init_options::NoSigintHandler.
///
/// @param argc, argv  The program's; remappings are taken out.
/// @param name        Node name.
/// @param rate        How often the node is due, in Hz of simulation time; above 0 and at most 250.
/// @param options     As for ros::init.
/// @throws InitError  No master answers, or another participant has this name.
/// @throws std::invalid_argument  The rate is outside its range.
void init(int& argc, char** argv, const std::string& name, double rate = 30.0, std::uint32_t options = 0);

/// Says whether this node takes part in a simulator's lockstep.
bool isActive();

/// Returns with what status the program should end: 1 if the simulator has dropped the node or failed, else 0.
int exitStatus();

/// Has a function called when simulation time has gone back, as after /gazebo/reset_simulation: in Rate::sleep(), with
/// the new time, before any callback of that turn. An exception in it is logged and does not end the node.
///
/// Without lockstep it is called too if time is /clock's (/use_sim_time) and that has gone back, but callbacks of what
/// was under way then follow.
void addResetHook(std::function<void()> hook);

/// Joins the simulator, when there is one, and waits for the first tick; all topics should be declared by now.
///
/// Callbacks of what came before that tick (latched messages, say) run before it returns. If the node is shut down
/// meanwhile it returns too: ros::ok() is false then.
///
/// @throws InitError  The simulator does not answer or refuses.
void start();

/// Ends the node's turn and waits for the next.
class Rate {
 public:
  /// The rate given to init(); a node has one.
  Rate();
  /// @throws std::invalid_argument  `hz` is another rate than that given to init().
  explicit Rate(double hz);

  /// Says that this turn is done, waits for the next and runs the callbacks of what has come.
  ///
  /// @return False if there is no next turn: the node is shut down, or the simulator is gone.
  bool sleep();

 private:
  std::optional<ros::Rate> free_;
};

/// Lets simulation time pass, turn by turn, at least so many seconds of it; callbacks run meanwhile. When time goes
/// back it returns at once, after the reset hooks and the callbacks of that turn.
///
/// @return False if the node is to end.
bool sleep(double seconds);

/// Calls `step` once a turn until the node is shut down; without one the node works in callbacks only.
void spin(const std::function<void()>& step = nullptr);

namespace detail {

class Inlet;
class Outlet;
class Entry;
using Message = boost::shared_ptr<void const>;

std::shared_ptr<Outlet> declareOutlet(const ros::AdvertiseOptions& options);
/// The publisher to use as it is when there is no lockstep, else nullptr.
const ros::Publisher* plainPublisher(const Outlet& outlet);
void publish(Outlet& outlet, const ros::SerializedMessage& message);
std::uint32_t countSubscribers(const Outlet& outlet);
void closeOutlet(const std::shared_ptr<Outlet>& outlet);

/// The receiving end of a topic; there is one for all of a node's subscribers to it.
std::shared_ptr<Inlet> findInlet(const std::string& topic, const std::type_info& type, const std::string& datatype);
void openInlet(const std::shared_ptr<Inlet>& inlet, ros::SubscribeOptions& options);
bool isOpen(const Inlet& inlet);
void receive(Inlet& inlet, const boost::shared_ptr<ros::M_string>& header, const Message& message);
std::shared_ptr<Entry> attach(const std::shared_ptr<Inlet>& inlet, std::uint32_t queue_size,
                              std::function<void(const void*)> callback);
std::uint32_t countPublishers(const Entry& entry);
void closeEntry(const std::shared_ptr<Entry>& entry);

}  // namespace detail

/// A publisher whose messages are counted. It is a handle: copies publish on the same topic.
template <class M>
class Publisher {
 public:
  /// Publishes on no topic; assign what advertise() returns.
  Publisher() = default;
  explicit Publisher(std::shared_ptr<detail::Outlet> outlet) : outlet_(std::move(outlet)) {}

  /// Publishes a message; the next turn of each participant that subscribes will have it.
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

  /// How many listen. Where the simulator keeps checksums these count as one, so that they do not depend on who else
  /// listens.
  std::uint32_t getNumSubscribers() const { return outlet_ ? detail::countSubscribers(*outlet_) : 0; }

  /// Takes the topic back, for all handles of it.
  void shutdown() {
    if (outlet_) {
      detail::closeOutlet(outlet_);
      outlet_.reset();
    }
  }

 private:
  std::shared_ptr<detail::Outlet> outlet_;
};

/// A subscription's handle. The subscription ends with shutdown(), not with the handle.
class Subscriber {
 public:
  Subscriber() = default;
  explicit Subscriber(std::shared_ptr<detail::Entry> entry) : entry_(std::move(entry)) {}

  /// How many publishers are connected.
  std::uint32_t getNumPublishers() const { return entry_ ? detail::countPublishers(*entry_) : 0; }

  /// Ends the subscription.
  void shutdown() {
    if (entry_) {
      detail::closeEntry(entry_);
      entry_.reset();
    }
  }

 private:
  std::shared_ptr<detail::Entry> entry_;
};

/// Advertises a topic; a second time in one process it returns a handle of the first.
///
/// @param topic       Topic name, resolved as usual.
/// @param queue_size  Messages kept for a stalled subscriber that is no participant; what participants are sent is
///                    never dropped. 0 for 100.
/// @param latch       Whether every new subscriber gets the last message.
/// @throws std::invalid_argument  The topic is advertised in this process with another type or by a ros::Publisher.
template <class M>
Publisher<M> advertise(const std::string& topic, std::uint32_t queue_size, bool latch = false) {
  ros::AdvertiseOptions options;
  options.init<M>(ros::names::resolve(topic), queue_size);
  options.latch = latch;
  return Publisher<M>(detail::declareOutlet(options));
}

/// Subscribes to a topic.
///
/// @param topic       Topic name, resolved as usual.
/// @param queue_size  Of messages from publishers that are no participants, at most so many (the newest) are dispatched
///                    at a time; what participants send is never dropped. 0 for 1000.
/// @param callback    Called with each message in start() and Rate::sleep(), in the thread that calls these. An
///                    exception in it is logged and does not end the node.
/// @throws std::invalid_argument  The topic is subscribed to in this process with another type.
template <class M>
Subscriber subscribe(const std::string& topic, std::uint32_t queue_size, std::function<void(const M&)> callback) {
  const std::string resolved = ros::names::resolve(topic);
  const auto inlet = detail::findInlet(resolved, typeid(M), ros::message_traits::datatype<M>());
  if (!detail::isOpen(*inlet)) {
    ros::SubscribeOptions options;
    // The inlet outlives its subscription: it is closed before it is let go.
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

}  // namespace xtdrone_control::lockstep
