/// C++ nodes for test_lockstep_cpp.py: `lockstep_test_node ROLE NAME ...`. They write to the file $TRANSCRIPT.

#include <geometry_msgs/PointStamped.h>
#include <ros/time.h>
#include <std_msgs/String.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <random>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "xtdrone_lockstep/lockstep.h"

namespace lockstep = xtdrone_lockstep;
using std_msgs::String;

namespace {

std::ofstream transcript;

std::int64_t now() { return static_cast<std::int64_t>(ros::Time::now().toNSec() / 1000); }

void require(bool condition, const std::string& what) {
  if (!condition) {
    throw std::runtime_error(what);
  }
}

String text(const std::string& data) {
  String message;
  message.data = data;
  return message;
}

/// Publish a checksum of all received messages on two topics, and record the messages with their times.
void participant(const std::string& name, unsigned seed, const std::vector<std::string>& peers) {
  std::minstd_rand lazy(seed);
  std::uint64_t hash = 14695981039346656037u;  // FNV-1a
  const auto take = [&hash](const std::string& source) {
    return [&hash, source](const String& message) {
      for (const char c : message.data) {
        hash = (hash ^ static_cast<std::uint8_t>(c)) * 1099511628211u;
      }
      transcript << now() << ' ' << source << ' ' << message.data << std::endl;
    };
  };
  const auto own = lockstep::advertise<String>("/from_" + name, 10);
  const auto shared = lockstep::advertise<String>("/shared", 10);
  for (const std::string& peer : peers) {
    lockstep::subscribe<String>("/from_" + peer, 10, take(peer));
  }
  lockstep::subscribe<String>("/shared", 10, take("shared"));
  lockstep::subscribe<String>("/foreign", 10, take("foreign"));
  lockstep::addResetHook([] { transcript << now() << " reset" << std::endl; });
  require(!lockstep::isActive() || now() == 0, "the time is not 0 before the start");
  lockstep::start();
  require(lockstep::isActive(), "is not in lockstep");
  lockstep::spin([&] {
    const std::int64_t began = now();
    if (seed != 0 && lazy() % 4 == 0) {
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    require(now() == began, "time has passed within a turn");
    char digits[17];
    std::snprintf(digits, sizeof digits, "%016llx", static_cast<unsigned long long>(hash));
    const auto message = text(std::to_string(now()) + " " + name + " " + digits);
    own.publish(message);
    shared.publish(message);
  });
}

/// Receive own messages, a latched one too, in the node's own thread without a simulator.
void alone() {
  const auto main = std::this_thread::get_id();
  const auto publisher = lockstep::advertise<String>("/loop", 10, true);
  bool heard = false;
  publisher.publish(text("hello"));
  lockstep::subscribe<String>("/loop", 10, [&](const String& message) {
    require(std::this_thread::get_id() == main && message.data == "hello", "another thread or message");
    heard = true;
  });
  lockstep::start();
  require(!lockstep::isActive() && ros::Time::now().toSec() > 1e9, "is in lockstep");
  require(!heard, "callbacks ran outside of sleep()");
  lockstep::Rate rate(50.0);
  while (!heard && rate.sleep()) {
  }
  std::cout << (heard ? "alone is well" : "heard nothing") << std::endl;
}

/// Latch a single message.
void latcher() {
  const auto publisher = lockstep::advertise<String>("/foreign", 10, true);
  publisher.publish(text("first"));
  publisher.publish(text("hello"));
  lockstep::start();
  lockstep::spin();
}

/// Publish messages larger than socket buffers, and record the lengths of those of another such node.
void heavy(const std::string& name) {
  const auto publisher = lockstep::advertise<String>("/from_" + name, 10);
  lockstep::subscribe<String>(name == "a" ? "/from_b" : "/from_a", 10, [](const String& message) {
    transcript << now() << ' ' << message.data.substr(0, 3) << ' ' << message.data.size() << std::endl;
  });
  lockstep::start();
  int turn = 0;
  lockstep::spin([&] {
    char digits[4];
    std::snprintf(digits, sizeof digits, "%03d", turn);
    for (int i = 0; i < 3; ++i) {
      publisher.publish(text(digits + std::string(2'000'000 + static_cast<std::size_t>(turn), 'x')));
    }
    ++turn;
  });
}

/// Publish messages larger than socket buffers; record the number of subscribers.
void flood() {
  const auto publisher = lockstep::advertise<String>("/flood", 5);
  lockstep::start();
  const auto message = text(std::string(500'000, 'x'));
  lockstep::spin([&] {
    std::ifstream status("/proc/self/statm");
    long pages = 0;
    status >> pages >> pages;
    transcript << publisher.getNumSubscribers() << ' ' << pages * 4 << std::endl;
    publisher.publish(message);
  });
}

/// Subscribe, unregister and subscribe again while another node publishes; do the same with a published topic.
void churner() {
  lockstep::Subscriber subscriber;
  lockstep::Publisher<String> publisher;
  lockstep::start();
  lockstep::Rate rate;
  for (int turn = 0; turn < 20; ++turn) {
    if (turn % 4 == 0) {
      subscriber = lockstep::subscribe<String>(
          "/from_a", 10, [turn](const String& message) { transcript << turn << ' ' << message.data << std::endl; });
      publisher = lockstep::advertise<String>("/from_churner", 10);
    } else if (turn % 4 == 3) {
      transcript << turn << " connections " << subscriber.getNumPublishers() << std::endl;
      subscriber.shutdown();
      publisher.shutdown();
    } else {
      publisher.publish(text(std::to_string(now()) + " churner -"));
    }
    rate.sleep();
  }
  lockstep::spin();
}

/// Publish messages with a header.
void stamper() {
  const auto publisher = lockstep::advertise<geometry_msgs::PointStamped>("/stamps", 10);
  lockstep::start();
  lockstep::spin([&] {
    geometry_msgs::PointStamped message;
    message.header.stamp = ros::Time::now();
    message.header.frame_id = "map";
    publisher.publish(message);
  });
}

/// Publish the time on a topic and on a latched one.
void sender(const std::string& name) {
  const auto passing = lockstep::advertise<String>("/passing", 10);
  const auto held = lockstep::advertise<String>("/held", 10, true);
  lockstep::start();
  lockstep::spin([&] {
    const auto message = text(std::to_string(now()) + " " + name);
    passing.publish(message);
    held.publish(message);
  });
}

/// Record messages and resets of time.
void reader() {
  for (const std::string source : {"passing", "held"}) {
    lockstep::subscribe<String>("/" + source, 10, [source](const String& message) {
      transcript << now() << ' ' << source << ' ' << message.data << std::endl;
    });
  }
  lockstep::addResetHook([] { transcript << now() << " reset" << std::endl; });
  lockstep::start();
  lockstep::spin();
}

/// Sleep ten seconds at a time, and record wake-ups and resets of time; the first reset hook fails.
void sleeper() {
  lockstep::addResetHook([] { throw std::runtime_error("as asked"); });
  lockstep::addResetHook([] { transcript << now() << " reset" << std::endl; });
  lockstep::start();
  while (lockstep::sleep(10.0)) {
    transcript << now() << " awake" << std::endl;
  }
}

void run(const std::string& role, const std::string& name, const std::vector<std::string>& rest) {
  if (role == "participant") {
    participant(name, static_cast<unsigned>(std::stoul(rest.at(1))), {rest.begin() + 2, rest.end()});
  } else if (role == "alone") {
    alone();
  } else if (role == "latcher") {
    latcher();
  } else if (role == "heavy") {
    heavy(name);
  } else if (role == "flood") {
    flood();
  } else if (role == "churner") {
    churner();
  } else if (role == "stamper") {
    stamper();
  } else if (role == "sender") {
    sender(name);
  } else if (role == "reader") {
    reader();
  } else if (role == "sleeper") {
    sleeper();
  } else {
    throw std::runtime_error("no role is called " + role);
  }
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  if (arguments.size() < 2) {
    std::cerr << "usage: lockstep_test_node ROLE NAME ..." << std::endl;
    return 2;
  }
  if (const char* path = std::getenv("TRANSCRIPT")) {
    transcript.open(path);
  }
  const std::vector<std::string> rest(arguments.begin() + 2, arguments.end());
  try {
    lockstep::init(argc, argv, arguments[1], rest.empty() ? 50.0 : std::stod(rest[0]));
    run(arguments[0], arguments[1], rest);
  } catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
  return lockstep::exitStatus();
}
