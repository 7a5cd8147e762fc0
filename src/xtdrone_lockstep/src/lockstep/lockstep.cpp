#include "xtdrone_lockstep/lockstep.h"

#include <poll.h>
#include <ros/console.h>
#include <ros/master.h>
#include <ros/param.h>
#include <ros/this_node.h>
#include <ros/time.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <exception>
#include <map>
#include <sstream>

#include "client.h"

namespace xtdrone_lockstep {
namespace {

using Clock = std::chrono::steady_clock;
using Seconds = std::chrono::duration<double>;

/// Wall seconds for the simulator to answer.
constexpr double CONNECT_LIMIT = 10.0;
/// Wall seconds for a participant with the node's name to end.
constexpr double NAME_LIMIT = 3.0;
/// Wall seconds between checks of state for which master and simulator send no notification.
constexpr double ASK_PERIOD = 0.2;

const std::string URI_PARAM = "/lockstep/uri";
const std::string WAIT_PARAM = "/lockstep/wait";
const std::string PRIVATE_PARAM = "~lockstep";

/// The state of this process's node.
struct Node {
  double rate = 0.0;
  bool initialised = false;
  bool taking_part = false;
  bool started = false;
  Topics topics;
  std::vector<std::shared_ptr<detail::Entry>> entries;
  std::vector<std::function<void()>> reset_hooks;
  /// Number of resets of simulation time.
  unsigned resets = 0;
  /// Time of the last turn without lockstep.
  ros::Time last;
  std::unique_ptr<Client> reservation;
  std::unique_ptr<Client> client;
  int exit_status = 0;
};

/// Never destroyed, as roscpp's threads may use it until the process ends.
Node& node() {
  static auto* const the_node = new Node;
  return *the_node;
}

volatile std::sig_atomic_t signalled = 0;
const Waker* signal_waker = nullptr;

/// In a participant the main thread first sends LEAVE to the simulator and then shuts roscpp down.
void onSignal(int) {
  signalled = 1;
  if (signal_waker != nullptr) {
    signal_waker->wake();
  } else {
    ros::requestShutdown();
  }
}

bool ending() { return signalled != 0 || !ros::ok(); }

/// End the participant: send LEAVE, then shut roscpp down, which closes the topics.
void end() {
  if (const auto client = std::move(node().client)) {
    if (!client->failure().empty()) {
      node().exit_status = 1;
      ROS_ERROR("the simulator at %s %s", client->uri().c_str(), client->failure().c_str());
    } else if (!client->farewell().empty()) {
      ROS_INFO("%s", client->farewell().c_str());
    }
    client->leave();
  }
  ros::shutdown();
}

std::string number(double value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

/// Return whether a parameter is true by the rules of Python.
bool truth(const std::string& name, bool otherwise) {
  XmlRpc::XmlRpcValue value;
  if (!ros::param::get(name, value)) {
    return otherwise;
  }
  switch (value.getType()) {
    case XmlRpc::XmlRpcValue::TypeBoolean:
      return static_cast<bool>(value);
    case XmlRpc::XmlRpcValue::TypeInt:
      return static_cast<int>(value) != 0;
    case XmlRpc::XmlRpcValue::TypeDouble:
      return static_cast<double>(value) != 0.0;
    case XmlRpc::XmlRpcValue::TypeString:
      return !static_cast<std::string>(value).empty();
    default:
      return true;
  }
}

std::string uriParameter() {
  std::string uri;
  ros::param::get(URI_PARAM, uri);
  return uri;
}

/// Wait for `seconds` of wall time, or until a signal.
void pause(double seconds) {
  const Waker& waker = node().topics.waker;
  const auto until = Clock::now() + Seconds(seconds);
  for (double left = seconds; left > 0.0 && !signalled; left = Seconds(until - Clock::now()).count()) {
    pollfd watched{waker.fileno(), POLLIN, 0};
    if (poll(&watched, 1, static_cast<int>(std::ceil(left * 1000.0))) > 0) {
      waker.clear();
    }
  }
}

/// Reserve the node's name with a running simulator. This must happen before the node registers with the master, which
/// would shut down another node of that name.
std::unique_ptr<Client> reserveName() {
  const std::string uri = uriParameter();
  if (uri.empty() || !truth(PRIVATE_PARAM, true)) {
    return nullptr;
  }
  const auto began = Clock::now();
  for (;;) {
    auto client = std::make_unique<Client>(uri, node().topics, ending);
    try {
      client->reserve(ros::this_node::getName());
      return client;
    } catch (const RefusedError& error) {
      // The participant that has the name may be about to end.
      if (error.code() != "taken" || Seconds(Clock::now() - began).count() > NAME_LIMIT) {
        throw InitError("cannot join the simulator at " + uri + " (" + URI_PARAM + "): " + error.what());
      }
    } catch (const std::exception&) {
      return nullptr;  // start() retries, and reports the error if it persists
    }
    pause(ASK_PERIOD);
  }
}

/// Start roscpp without its subscription to /clock, which would deliver the time late and in another thread.
void startWithoutClock() {
  // roscpp reads this parameter once, here, and has no other switch; the map behind the reference is not const.
  auto& remappings = const_cast<ros::M_string&>(ros::names::getRemappings());
  const ros::M_string before = remappings;
  remappings["/use_sim_time"] = "/lockstep/no_such_parameter";
  ros::start();
  remappings = before;
  ros::Time::setNow(ros::Time(0, 0));
}

/// Join, waiting for a simulator that is starting and for a participant of the same name that is ending; return nullptr
/// if the node is shutting down.
std::unique_ptr<Client> joinSimulator() {
  const std::string name = ros::this_node::getName();
  if (auto client = std::move(node().reservation)) {
    try {
      client->join(name, node().rate);
      return client;
    } catch (const std::exception& error) {
      ROS_DEBUG("the simulator at %s reserved the name but refused the node: %s", client->uri().c_str(), error.what());
    }
  }
  auto asked = Clock::now();
  auto answered = asked;
  while (!ending()) {
    const std::string uri = uriParameter();
    const auto now = Clock::now();
    if (uri.empty()) {
      if (Seconds(now - asked).count() > CONNECT_LIMIT) {
        ROS_INFO("waiting for a simulator (%s is not set yet)", URI_PARAM.c_str());
        asked = now;
      }
      answered = now;
    } else {
      auto client = std::make_unique<Client>(uri, node().topics, ending);
      std::string why;
      bool patient = true;
      try {
        client->join(name, node().rate);
        return client;
      } catch (const RefusedError& error) {
        patient = error.code() == "taken";
        why = error.what();
      } catch (const std::exception& error) {
        why = error.what();
      }
      if (!patient || Seconds(Clock::now() - answered).count() > CONNECT_LIMIT) {
        throw InitError("cannot join the simulator at " + uri + " (" + URI_PARAM + "): " + why +
                        ". If there is no simulator, delete that parameter or set " + PRIVATE_PARAM + " to false.");
      }
    }
    pause(ASK_PERIOD);
  }
  return nullptr;
}

/// Run the callbacks: subscribers in order of declaration, each by publisher's name, then in order of sending.
void dispatch() {
  std::map<const detail::Inlet*, std::vector<detail::Message>> ready;
  const auto entries = node().entries;
  for (const auto& entry : entries) {
    const auto [found, first] = ready.try_emplace(entry->inlet().get());
    if (first) {
      found->second = entry->inlet()->take();
    }
    entry->dispatch(found->second);
  }
}

/// Run the reset hooks.
void reset() {
  ++node().resets;
  const auto hooks = node().reset_hooks;  // a copy, as a hook may add another
  for (const auto& hook : hooks) {
    try {
      hook();
    } catch (const std::exception& error) {
      ROS_ERROR("bad reset hook: %s", error.what());
    }
  }
}

/// Begin a turn without lockstep.
void enterFreeTurn() {
  const ros::Time now = ros::Time::now();
  // A corrected wall clock is not a reset.
  if (ros::Time::isSimTime() && now < node().last) {
    reset();
  }
  node().last = now;
  dispatch();
}

/// Wait for the next turn and begin it; return false if there is none.
bool enterTurn() {
  Client& client = *node().client;
  const auto gone_back = client.awaitTick();
  if (!gone_back) {
    end();
    return false;
  }
  const auto micros = static_cast<std::uint64_t>(client.time());
  ros::Time::setNow(
      ros::Time(static_cast<std::uint32_t>(micros / 1'000'000), static_cast<std::uint32_t>(micros % 1'000'000 * 1000)));
  if (*gone_back) {
    reset();
  }
  if (!client.awaitMessages()) {
    end();
    return false;
  }
  dispatch();
  return true;
}

void topicsChanged() {
  if (node().client) {
    node().client->declare();
  }
}

void requireInit(const char* what) {
  if (!node().initialised) {
    throw std::logic_error(std::string(what) + " needs lockstep::init() first");
  }
}

}  // namespace

void init(int& argc, char** argv, const std::string& name, double rate, std::uint32_t options) {
  const double fastest = 1e6 / static_cast<double>(BASE_STEP_US);
  if (!(std::isfinite(rate) && rate > 0.0 && rate <= fastest)) {
    throw std::invalid_argument("rate " + number(rate) + ": must be above 0 and at most " + number(fastest) + " Hz");
  }
  ros::init(argc, argv, name, options | ros::init_options::NoSigintHandler);
  if (!ros::master::check()) {
    throw InitError("no ROS master answers at " + ros::master::getURI() +
                    "; start one (roscore, roslaunch) or set ROS_MASTER_URI");
  }
  Node& self = node();
  self.rate = rate;
  self.taking_part = truth(PRIVATE_PARAM, true) && (!uriParameter().empty() || truth(WAIT_PARAM, false));
  signal_waker = self.taking_part ? &self.topics.waker : nullptr;
  if ((options & ros::init_options::NoSigintHandler) == 0) {
    std::signal(SIGINT, onSignal);
    std::signal(SIGTERM, onSignal);
  }
  if (self.taking_part) {
    self.reservation = reserveName();
    startWithoutClock();
    std::atexit(end);  // for a main function that returns without a shutdown
  } else {
    ros::start();
  }
  self.initialised = true;
}

bool isActive() { return node().taking_part; }

int exitStatus() { return node().exit_status; }

void addResetHook(std::function<void()> hook) { node().reset_hooks.push_back(std::move(hook)); }

void start() {
  Node& self = node();
  requireInit("lockstep::start()");
  if (self.started) {
    throw std::logic_error("lockstep::start() was called a second time");
  }
  self.started = true;
  if (!self.taking_part) {
    return;
  }
  self.client = joinSimulator();
  if (!self.client) {
    end();
    return;
  }
  ROS_INFO("in lockstep with the simulator at %s, %g Hz", self.client->uri().c_str(), self.rate);
  enterTurn();
}

Rate::Rate() {
  requireInit("lockstep::Rate");
  if (!isActive()) {
    free_.emplace(node().rate);
  }
}

Rate::Rate(double hz) : Rate() {
  if (hz != node().rate) {
    throw std::invalid_argument("lockstep::Rate(" + number(hz) + "): the node was initialised with rate " +
                                number(node().rate));
  }
}

bool Rate::sleep() {
  if (free_) {
    free_->sleep();
    if (!ros::ok()) {
      return false;
    }
    enterFreeTurn();
    return true;
  }
  if (!node().client) {
    if (!ros::ok()) {
      return false;
    }
    throw std::logic_error("call lockstep::start() before lockstep::Rate::sleep()");
  }
  if (ending()) {
    end();
    return false;
  }
  node().client->done();
  return enterTurn();
}

bool sleep(double seconds) {
  Rate rate;
  const ros::Time until = ros::Time::now() + ros::Duration(seconds);
  const unsigned resets = node().resets;
  while (ros::Time::now() < until && node().resets == resets) {
    if (!rate.sleep()) {
      return false;
    }
  }
  return true;
}

void spin(const std::function<void()>& step) {
  Rate rate;
  while (ros::ok()) {
    if (step) {
      step();
    }
    rate.sleep();
  }
}

namespace detail {

std::shared_ptr<Outlet> declareOutlet(const ros::AdvertiseOptions& options) {
  requireInit("lockstep::advertise()");
  auto& outlets = node().topics.outlets;
  for (const auto& outlet : outlets) {
    if (outlet->topic() == options.topic) {
      if (outlet->type() != options.datatype) {
        throw std::invalid_argument(options.topic + " is advertised in this process as " + outlet->type() + ", not " +
                                    options.datatype);
      }
      return outlet;
    }
  }
  const auto outlet = std::make_shared<Outlet>(options, node().topics.waker);
  if (isActive()) {
    outlet->openCounted(options);
  } else {
    outlet->openPlain(options);
  }
  outlets.push_back(outlet);
  topicsChanged();
  return outlet;
}

const ros::Publisher* plainPublisher(const Outlet& outlet) { return outlet.plain(); }

void publish(Outlet& outlet, const ros::SerializedMessage& message) {
  const Client* client = node().client.get();
  const bool digested = client != nullptr && client->digests();
  outlet.publish(message, digested ? std::optional(client->time()) : std::nullopt);
}

std::uint32_t countSubscribers(const Outlet& outlet) {
  return outlet.countSubscribers() + (node().client && node().client->digests() ? 1 : 0);
}

void closeOutlet(const std::shared_ptr<Outlet>& outlet) {
  auto& outlets = node().topics.outlets;
  const auto found = std::find(outlets.begin(), outlets.end(), outlet);
  if (found == outlets.end()) {
    return;
  }
  outlets.erase(found);
  if (node().client) {
    node().client->withdraw(*outlet);
  }
  outlet->close();
  topicsChanged();
}

std::shared_ptr<Inlet> findInlet(const std::string& topic, const std::type_info& type, const std::string& datatype) {
  requireInit("lockstep::subscribe()");
  Topics& topics = node().topics;
  if (const auto inlet = topics.inlet(topic)) {
    if (inlet->message() != type) {
      throw std::invalid_argument(topic + " is subscribed to in this process as " + inlet->type() + ", not " +
                                  datatype);
    }
    return inlet;
  }
  return std::make_shared<Inlet>(topic, type, datatype, topics.waker, topics.eager);
}

bool isOpen(const Inlet& inlet) { return inlet.isOpen(); }

void openInlet(const std::shared_ptr<Inlet>& inlet, ros::SubscribeOptions& options) {
  inlet->open(options);
  node().topics.inlets.push_back(inlet);
  topicsChanged();
}

void receive(Inlet& inlet, const boost::shared_ptr<ros::M_string>& header, const Message& message) {
  inlet.receive(header, message);
}

std::shared_ptr<Entry> attach(const std::shared_ptr<Inlet>& inlet, std::uint32_t queue_size,
                              std::function<void(const void*)> callback) {
  inlet->setQueueSize(queue_size);
  const auto entry = std::make_shared<Entry>(inlet, std::move(callback));
  node().entries.push_back(entry);
  return entry;
}

std::uint32_t countPublishers(const Entry& entry) { return entry.inlet()->countPublishers(); }

void closeEntry(const std::shared_ptr<Entry>& entry) {
  auto& entries = node().entries;
  const auto found = std::find(entries.begin(), entries.end(), entry);
  if (found == entries.end()) {
    return;
  }
  entries.erase(found);
  entry->end();
  const auto& inlet = entry->inlet();
  if (std::any_of(entries.begin(), entries.end(), [&](const auto& other) { return other->inlet() == inlet; })) {
    return;
  }
  auto& inlets = node().topics.inlets;
  inlets.erase(std::remove(inlets.begin(), inlets.end(), inlet), inlets.end());
  inlet->close();
  topicsChanged();
}

}  // namespace detail
}  // namespace xtdrone_lockstep
