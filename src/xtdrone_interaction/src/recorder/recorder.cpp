// Records topics of a flight into a bag, packed by LZ4: recorder FILE TOPIC...
//
// Writes what "rosbag record --lz4 -O FILE TOPIC..." does, for half of its CPU time. rosbag hands each message from
// roscpp's network thread to one of ten threads and from there to another one; thousands of times a second, that costs
// more than all else that it does. Here the network is read every few milliseconds and one thread writes what has come.
//
// SIGINT and SIGTERM end it. Exit status: 0, 1 if the bag could not be written, 2 for bad arguments.

#include <ros/callback_queue.h>
#include <ros/poll_manager.h>
#include <ros/ros.h>
#include <rosbag/bag.h>
#include <topic_tools/shape_shifter.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <memory>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

namespace {

using Message = topic_tools::ShapeShifter;
using Clock = std::chrono::steady_clock;

constexpr auto kPeriod = std::chrono::milliseconds(2);  // between two looks at the network: delay of the time stamps
constexpr auto kDiskPeriod = std::chrono::seconds(10);
constexpr std::uintmax_t kMinSpace = 1 << 30;  // bytes, as rosbag's; below, nothing is written any more

std::atomic<bool> stop_requested{false};

void request_stop(int) { stop_requested = true; }

// A bag that is called FILE.active until it is complete.
class Recorder {
 public:
  // Throws rosbag::BagException if the file cannot be written.
  explicit Recorder(const std::string& file) : file_(file), active_(file + ".active") {
    bag_->setCompression(rosbag::compression::LZ4);
    bag_->open(active_, rosbag::bagmode::Write);
  }

  void subscribe(ros::NodeHandle& node, const std::string& topic) {
    const std::string name = ros::names::resolve(topic);
    boost::function<void(const ros::MessageEvent<Message const>&)> write =
        [this, name](const ros::MessageEvent<Message const>& event) { this->write(name, event); };
    subscribers_.push_back(node.subscribe<Message>(name, 0, write));
  }

  // Writes the index and gives the file its name. Throws the error of an earlier message, as the constructor does, and
  // std::filesystem::filesystem_error; FILE.active then has the messages before it, and "rosbag reindex" restores it.
  void close() {
    subscribers_.clear();
    try {
      if (error_) std::rethrow_exception(error_);
      bag_->close();
    } catch (...) {
      static_cast<void>(bag_.release());  // its destructor would write and throw again, which ends the program
      throw;
    }
    std::filesystem::rename(active_, file_);
  }

 private:
  void write(const std::string& topic, const ros::MessageEvent<Message const>& event) {
    if (error_ || !has_space()) return;
    // Before the first /clock message the time is 0, which a bag does not take.
    const ros::Time time = std::max(event.getReceiptTime(), ros::TIME_MIN);
    try {
      bag_->write(topic, time, *event.getConstMessage(), event.getConnectionHeaderPtr());
    } catch (const std::exception&) {  // which roscpp's queue does not expect
      error_ = std::current_exception();
      stop_requested = true;
    }
  }

  bool has_space() {
    if (Clock::now() < next_look_) return has_space_;
    next_look_ = Clock::now() + kDiskPeriod;
    std::error_code unknown;
    const auto space = std::filesystem::space(active_, unknown);
    const bool enough = unknown || space.available >= kMinSpace;
    if (!enough && has_space_)
      ROS_ERROR("recorder: less than 1024 MB of disk are free; the rest of the flight is not recorded");
    return has_space_ = enough;
  }

  const std::string file_;
  const std::string active_;
  std::unique_ptr<rosbag::Bag> bag_ = std::make_unique<rosbag::Bag>();
  std::exception_ptr error_;
  std::vector<ros::Subscriber> subscribers_;
  Clock::time_point next_look_ = Clock::now();
  bool has_space_ = true;
};

void record(const std::string& file, const std::vector<std::string>& topics) {
  ros::CallbackQueue queue;  // outlives the subscribers
  Recorder recorder(file);
  ros::NodeHandle node;
  node.setCallbackQueue(&queue);
  // Messages that arrive meanwhile wait in their sockets, and are read without a change of threads for each.
  ros::PollManager::instance()->addPollThreadListener([] { std::this_thread::sleep_for(kPeriod); });
  for (const std::string& topic : topics) recorder.subscribe(node, topic);
  while (ros::ok() && !stop_requested) {
    std::this_thread::sleep_for(kPeriod);
    queue.callAvailable();
  }
  std::this_thread::sleep_for(2 * kPeriod);  // for what had been sent before
  queue.callAvailable();
  recorder.close();
}

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "recorder", ros::init_options::NoSigintHandler);
  std::signal(SIGINT, request_stop);
  std::signal(SIGTERM, request_stop);
  if (argc < 3) {
    std::fprintf(stderr, "Usage: recorder FILE TOPIC...\n");
    return 2;
  }
  try {
    record(argv[1], {argv + 2, argv + argc});
  } catch (const std::exception& error) {
    // Not ROS_FATAL: roscpp logs nothing any more.
    std::fprintf(stderr, "[FATAL] recorder: %s cannot be recorded: %s\n", argv[1], error.what());
    return 1;
  }
  return 0;
}
