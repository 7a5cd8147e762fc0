// Records topics of a flight into an LZ4-compressed bag: recorder FILE TOPIC...
//
// The bag equals that of "rosbag record --lz4 -O FILE TOPIC..." and costs half of its CPU time. rosbag passes each
// message from roscpp's network thread to one of ten threads and from there to another one, which at thousands of
// messages a second costs more than all its other work. Here the network is read every few milliseconds, and one thread
// writes the received messages.
//
// Parameter ~buffer (MB, default 256, as in rosbag): size of the backlog of unwritten messages; messages beyond it are
// dropped and counted. The recorder is no participant of the lockstep, so that no flight waits for a disk.
//
// When it cannot record any more, it reports that at once on ~warning (std_msgs/String), because the log may be on the
// same full disk, and stays until the end of the flight.
//
// SIGINT and SIGTERM end it. Exit status: 0; 1 if the bag cannot be written; 2 for invalid arguments.

#include <ros/callback_queue_interface.h>
#include <ros/poll_manager.h>
#include <ros/ros.h>
#include <rosbag/bag.h>
#include <semaphore.h>
#include <std_msgs/String.h>
#include <topic_tools/shape_shifter.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <ctime>
#include <exception>
#include <filesystem>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

namespace {

using Message = topic_tools::ShapeShifter;
using Event = ros::MessageEvent<Message const>;
using Clock = std::chrono::steady_clock;

constexpr auto kPeriod = std::chrono::milliseconds(2);  // between reads of the network; the stamps' delay
constexpr time_t kShutdownPeriod = 1;                   // s between checks for a shutdown by another node
constexpr int kBuffer = 256;                            // MB
constexpr auto kDiskPeriod = std::chrono::seconds(1);
constexpr std::uintmax_t kMinSpace = 1 << 30;  // bytes of free disk space, as in rosbag; recording stops below

std::atomic<bool> stop_requested{false};
sem_t wake_up;  // posted when messages wait to be written, and when the recorder must end

void request_stop(int) {
  stop_requested = true;
  sem_post(&wake_up);
}

void wait_for_wake_up() {
  timespec limit;
  clock_gettime(CLOCK_MONOTONIC, &limit);
  limit.tv_sec += kShutdownPeriod;
  sem_clockwait(&wake_up, CLOCK_MONOTONIC, &limit);
}

// Runs roscpp's callbacks at once, in its network thread.
class DirectQueue : public ros::CallbackQueueInterface {
 public:
  void addCallback(const ros::CallbackInterfacePtr& callback, std::uint64_t) override { callback->call(); }
  void removeByID(std::uint64_t) override {}
};

struct Received {
  std::string topic;
  Event event;
};

// Messages that wait for the disk, up to a number of bytes.
class Backlog {
 public:
  explicit Backlog(std::uint64_t limit) : limit_(limit) {}

  void push(const std::string& topic, const Event& event) {
    const std::uint64_t size = event.getConstMessage()->size();
    const std::lock_guard<std::mutex> lock(mutex_);
    if (bytes_ > 0 && bytes_ + size > limit_) {
      if (dropped_++ == 0)
        ROS_WARN("recorder: the disk does not keep up, %.1f MB wait for it; messages are dropped until it does",
                 static_cast<double>(bytes_) / (1 << 20));
      return;
    }
    bytes_ += size;
    messages_.push_back({topic, event});
  }

  // Returns all messages; they count as waiting until they are released.
  std::vector<Received> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    return std::exchange(messages_, {});
  }

  void release(std::uint64_t size) {
    const std::lock_guard<std::mutex> lock(mutex_);
    bytes_ -= size;
  }

  bool empty() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return messages_.empty();
  }

  unsigned long dropped() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return dropped_;
  }

 private:
  const std::uint64_t limit_;
  mutable std::mutex mutex_;
  std::vector<Received> messages_;
  std::uint64_t bytes_ = 0;  // of messages_ and of those taken and not yet released
  unsigned long dropped_ = 0;
};

// A bag that is named FILE.active until it is complete.
class Recorder {
 public:
  // Creates the folder of the file if there is none. Throws rosbag::BagException or std::filesystem::filesystem_error
  // if the file cannot be written.
  Recorder(const std::string& file, const ros::Publisher& warnings)
      : file_(file), active_(file + ".active"), warnings_(warnings) {
    const std::filesystem::path folder = std::filesystem::path(file).parent_path();
    if (!folder.empty()) std::filesystem::create_directories(folder);
    bag_->setCompression(rosbag::compression::LZ4);
    bag_->open(active_, rosbag::bagmode::Write);
  }

  void write(const std::string& topic, const Event& event) {
    if (error_ || !has_space()) return;
    // Before the first /clock message the time is 0, which a bag rejects.
    const ros::Time time = std::max(event.getReceiptTime(), ros::TIME_MIN);
    try {
      bag_->write(topic, time, *event.getConstMessage(), event.getConnectionHeaderPtr());
    } catch (const std::exception& error) {
      error_ = std::current_exception();
      warn(error.what());
    }
  }

  // Writes the index and renames the file. Throws the error of an earlier message, as the constructor does, and
  // std::filesystem::filesystem_error; FILE.active then holds the messages before it, and "rosbag reindex" restores it.
  void close() {
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
  void warn(const std::string& why) const {
    std_msgs::String warning;
    warning.data = file_ + ": " + why + "; the rest of the flight is not recorded";
    ROS_ERROR("recorder: %s", warning.data.c_str());
    warnings_.publish(warning);
  }

  bool has_space() {
    if (Clock::now() < next_look_) return has_space_;
    next_look_ = Clock::now() + kDiskPeriod;
    std::error_code unknown;
    const auto space = std::filesystem::space(active_, unknown);
    const bool enough = unknown || space.available >= kMinSpace;
    if (!enough && has_space_) warn(std::to_string(space.available >> 20) + " MB of disk are free, fewer than 1024");
    return has_space_ = enough;
  }

  const std::string file_;
  const std::string active_;
  const ros::Publisher warnings_;
  std::unique_ptr<rosbag::Bag> bag_ = std::make_unique<rosbag::Bag>();
  std::exception_ptr error_;
  Clock::time_point next_look_ = Clock::now();
  bool has_space_ = true;
};

// Returns the limit of the backlog, bytes. Throws std::invalid_argument for a parameter that is not allowed.
std::uint64_t buffer_size() {
  int megabytes = kBuffer;
  const bool is_number = !ros::param::has("~buffer") || ros::param::get("~buffer", megabytes);
  if (!is_number || megabytes < 1) throw std::invalid_argument("~buffer must be a whole number of MB, at least 1");
  return static_cast<std::uint64_t>(megabytes) << 20;
}

ros::Subscriber subscribe(ros::NodeHandle& node, const std::string& topic, Backlog& backlog) {
  const std::string name = ros::names::resolve(topic);
  boost::function<void(const Event&)> push = [&backlog, name](const Event& event) { backlog.push(name, event); };
  return node.subscribe<Message>(name, 0, push);
}

void write_all(Recorder& recorder, Backlog& backlog) {
  for (Received& message : backlog.take()) {
    const std::uint64_t size = message.event.getConstMessage()->size();
    recorder.write(message.topic, message.event);
    message.event = Event();  // frees its memory
    backlog.release(size);
  }
}

void record(const std::string& file, const std::vector<std::string>& topics) {
  // Never destroyed, as roscpp's network thread uses them until the process ends.
  auto& queue = *new DirectQueue;
  auto& backlog = *new Backlog(buffer_size());
  ros::NodeHandle node;
  Recorder recorder(file, ros::NodeHandle("~").advertise<std_msgs::String>("warning", 1, true));
  node.setCallbackQueue(&queue);
  // Messages that arrive meanwhile wait in their sockets; they are then read without a thread switch for each.
  ros::PollManager::instance()->addPollThreadListener([&backlog] {
    if (!backlog.empty()) sem_post(&wake_up);
    std::this_thread::sleep_for(kPeriod);
  });
  std::vector<ros::Subscriber> subscribers;
  for (const std::string& topic : topics) subscribers.push_back(subscribe(node, topic, backlog));
  while (ros::ok() && !stop_requested) {
    wait_for_wake_up();
    write_all(recorder, backlog);
  }
  std::this_thread::sleep_for(2 * kPeriod);  // for messages already sent
  subscribers.clear();
  write_all(recorder, backlog);
  if (backlog.dropped() > 0) std::fprintf(stderr, "[ERROR] recorder: %lu messages were dropped\n", backlog.dropped());
  recorder.close();
}

}  // namespace

int main(int argc, char** argv) {
  sem_init(&wake_up, 0, 0);
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
    // Not ROS_FATAL, since roscpp no longer logs.
    std::fprintf(stderr, "[FATAL] recorder: %s cannot be recorded: %s\n", argv[1], error.what());
    return 1;
  }
  return 0;
}
