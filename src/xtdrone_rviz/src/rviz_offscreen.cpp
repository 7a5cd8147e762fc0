/// rviz without a screen: draws an .rviz configuration frame by frame in simulated time, as a participant of the
/// lockstep, to an image topic, PNG files and a film.
///
/// Parameters:
///   ~config: the .rviz file.
///   ~rate (Hz of simulated time, 0.1 to 50, default 30): frames per simulated second.
///   ~width, ~height (pixels, 64 to 4096, default 1280 and 720).
///   ~antialiasing (default true): smooth edges, about half of the drawing time.
///   ~film: file that ends with .mp4; empty: none.
///   ~fps (0.1 to 120, default ~rate): frame rate of the film.
///   ~frames: existing folder for a PNG of each frame, 000000.png and so on; empty: none.
///   ~display: an existing X display, such as :0; empty: a separate Xvfb, which ends with the node.
///
/// Topics (out):
///   ~image (sensor_msgs/Image, rgb8): a frame, stamped with the newest /tf that it shows.
///   ~camera_info (sensor_msgs/CameraInfo), ~camera_pose (geometry_msgs/PoseStamped): the view's camera, and the
///   pose of its optical frame in the fixed frame. All three only while ~image has subscribers.
///
/// The first frame is drawn once TF has the configuration's fixed frame. Exit status: 0, 1 after a failure,
/// 2 for a parameter or a configuration that is not allowed.

#include <X11/Xlib.h>
#include <geometry_msgs/PoseStamped.h>
#include <poll.h>
#include <ros/console.h>
#include <ros/init.h>
#include <ros/master.h>
#include <ros/param.h>
#include <sensor_msgs/CameraInfo.h>
#include <sensor_msgs/Image.h>
#include <sys/stat.h>
#include <tf2_msgs/TFMessage.h>
#include <topic_tools/shape_shifter.h>
#include <unistd.h>
#include <xtdrone_lockstep/lockstep.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <memory>

#include "child_process.h"
#include "film.h"
#include "picture.h"
#include "scene.h"
#include "settings.h"

namespace lockstep = xtdrone_lockstep;

namespace xtdrone_rviz {
namespace {

const char* const NAME = "rviz_offscreen";
constexpr double DISPLAY_LIMIT = 30.0;  // wall s for Xvfb to start
constexpr double FRAME_LIMIT = 5.0;     // simulated s without the fixed frame before a warning

/// Starts an X server that draws into memory, and makes it this process's display.
///
/// @throws DisplayError  Xvfb is not installed, or does not start.
std::unique_ptr<ChildProcess> startDisplay(unsigned width, unsigned height) {
  const std::string screen = std::to_string(width) + "x" + std::to_string(height) + "x24";
  std::unique_ptr<ChildProcess> server;
  try {
    server = std::make_unique<ChildProcess>(
        std::vector<std::string>{"Xvfb", "-displayfd", std::to_string(ChildProcess::CHILD_DESCRIPTOR), "-screen", "0",
                                 screen, "+extension", "GLX", "-nolisten", "tcp", "-noreset"},
        ChildProcess::Pipe::FROM_DESCRIPTOR, true);
  } catch (const ProcessError& error) {
    throw DisplayError(std::string(error.what()) +
                       "; install it (Debian: apt-get install xvfb), or name a display by ~display");
  }
  // Xvfb writes its display number when it is ready.
  std::string number;
  for (char next = 0; next != '\n';) {
    pollfd watched{server->descriptor(), POLLIN, 0};
    if (poll(&watched, 1, static_cast<int>(DISPLAY_LIMIT * 1000.0)) <= 0 || read(server->descriptor(), &next, 1) != 1) {
      throw DisplayError("Xvfb: does not start; try it by hand: Xvfb -displayfd 1 -screen 0 " + screen);
    }
    number += next == '\n' ? "" : std::string(1, next);
  }
  server->closePipe();
  setenv("DISPLAY", (":" + number).c_str(), 1);
  setenv("LIBGL_ALWAYS_SOFTWARE", "1", 1);
  return server;
}

/// Makes a running X server this process's display.
///
/// @throws DisplayError  The server does not respond. (Qt would abort.)
void useDisplay(const std::string& name) {
  Display* const connection = XOpenDisplay(name.c_str());
  if (connection == nullptr) {
    throw DisplayError("~display: no X server answers at '" + name + "'; leave it out for an Xvfb of this node's own");
  }
  XCloseDisplay(connection);
  setenv("DISPLAY", name.c_str(), 1);
}

/// Writes frames to the topics, the folder and the film.
class Recorder {
 public:
  explicit Recorder(const Settings& settings) : settings_(settings) {
    if (!settings.film.empty()) {
      film_ = std::make_unique<Film>(settings.film, settings.width, settings.height, settings.fps);
    }
    struct stat status;
    if (!settings.frames.empty() && (stat(settings.frames.c_str(), &status) != 0 || !S_ISDIR(status.st_mode))) {
      throw SettingsError("~frames: " + settings.frames + " is no folder");
    }
    at_exit = this;
    std::atexit([] {
      if (at_exit != nullptr) {
        at_exit->tryToFinish();
      }
    });
  }

  /// Keeps the film so far when the node ends for any reason.
  ~Recorder() {
    at_exit = nullptr;
    tryToFinish();
  }
  Recorder(const Recorder&) = delete;
  Recorder& operator=(const Recorder&) = delete;

  void add(const Picture& picture) {
    if (film_) {
      try {
        film_->add(picture);
      } catch (const std::exception&) {
        film_.reset();
        throw;
      }
    }
    if (!settings_.frames.empty()) {
      char name[16];
      std::snprintf(name, sizeof name, "/%06lu.png", count_);
      writePng(picture, settings_.frames + name);
    }
    ++count_;
  }

  /// Moves the film to its final path, once.
  void finish() {
    const auto film = std::move(film_);
    if (film && count_ > 0) {
      film->finish();
    }
  }

  unsigned long count() const { return count_; }

 private:
  void tryToFinish() {
    try {
      finish();
    } catch (const std::exception& error) {
      std::cerr << error.what() << std::endl;
    }
  }

  /// The recorder whose film is finished at exit(), which Xlib calls when the X server dies.
  static Recorder* at_exit;

  const Settings settings_;
  std::unique_ptr<Film> film_;
  unsigned long count_ = 0;
};

Recorder* Recorder::at_exit = nullptr;

class OffscreenNode {
 public:
  OffscreenNode(const Settings& settings, Scene& scene, Recorder& recorder)
      : scene_(scene), recorder_(recorder), picture_(settings.width, settings.height) {
    image_ = lockstep::advertise<sensor_msgs::Image>("~image", 2);
    info_ = lockstep::advertise<sensor_msgs::CameraInfo>("~camera_info", 2);
    pose_ = lockstep::advertise<geometry_msgs::PoseStamped>("~camera_pose", 2);
    lockstep::subscribe<tf2_msgs::TFMessage>("/tf", 0, [this](const auto& message) {
      scene_.place(message, false);
      for (const auto& transform : message.transforms) {
        newest_ = std::max(newest_, transform.header.stamp);
      }
    });
    lockstep::subscribe<tf2_msgs::TFMessage>("/tf_static", 0,
                                             [this](const auto& message) { scene_.place(message, true); });
    for (const std::string& topic : scene.topics()) {
      lockstep::subscribe<topic_tools::ShapeShifter>(
          topic, 0, [this, topic](const auto& message) { scene_.show(topic, message); });
    }
    for (const std::string& words : scene.load()) {
      ROS_WARN("%s", words.c_str());
    }
    lockstep::addResetHook([this] {
      scene_.reset();
      newest_ = began_ = ros::Time();
      after_reset_ = true;
    });
  }

  void step() {
    scene_.draw(picture_);
    if (!scene_.ready()) {
      complain();
      return;
    }
    if (after_reset_) {  // rviz detects the reset, too, and drops the messages of this turn
      after_reset_ = false;
      return;
    }
    if (picture_.plain()) {
      ROS_WARN_THROTTLE(10.0, "the view shows nothing: every pixel has the same colour");
    }
    recorder_.add(picture_);
    publish();
  }

 private:
  void complain() {
    const ros::Time now = ros::Time::now();
    if (began_.isZero() || now < began_) {
      began_ = now;
    } else if ((now - began_).toSec() > FRAME_LIMIT) {
      ROS_WARN_THROTTLE(10.0, "no frame is drawn: TF does not know the fixed frame '%s'; is robot_tf.py running?",
                        scene_.fixedFrame().c_str());
    }
  }

  void publish() {
    if (image_.getNumSubscribers() == 0) {
      return;
    }
    sensor_msgs::Image image;
    image.header.stamp = newest_.isZero() ? ros::Time::now() : newest_;
    image.header.frame_id = scene_.fixedFrame();
    image.width = picture_.width;
    image.height = picture_.height;
    image.encoding = "rgb8";
    image.step = 3 * picture_.width;
    image.data = picture_.data;
    const Camera camera = scene_.camera();
    sensor_msgs::CameraInfo info;
    info.header = image.header;
    info.width = picture_.width;
    info.height = picture_.height;
    info.distortion_model = "plumb_bob";
    info.D.assign(5, 0.0);
    const double f = camera.focal_length;
    const double cx = 0.5 * picture_.width;
    const double cy = 0.5 * picture_.height;
    info.K = {f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0};
    info.R = {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0};
    info.P = {f, 0.0, cx, 0.0, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0};
    geometry_msgs::PoseStamped pose;
    pose.header = image.header;
    pose.pose.position.x = camera.position[0];
    pose.pose.position.y = camera.position[1];
    pose.pose.position.z = camera.position[2];
    pose.pose.orientation.x = camera.orientation[0];
    pose.pose.orientation.y = camera.orientation[1];
    pose.pose.orientation.z = camera.orientation[2];
    pose.pose.orientation.w = camera.orientation[3];
    pose_.publish(pose);
    info_.publish(info);
    image_.publish(image);
  }

  Scene& scene_;
  Recorder& recorder_;
  Picture picture_;
  lockstep::Publisher<sensor_msgs::Image> image_;
  lockstep::Publisher<sensor_msgs::CameraInfo> info_;
  lockstep::Publisher<geometry_msgs::PoseStamped> pose_;
  ros::Time newest_;
  ros::Time began_;
  bool after_reset_ = false;
};

int run(int argc, char** argv) {
  // This registers nothing yet: an invalid parameter must not shut down the node that has this name.
  ros::init(argc, argv, NAME, ros::init_options::NoSigintHandler);
  if (!ros::master::check()) {
    std::cerr << "no ROS master at " << ros::master::getURI() << ": start roscore or a launch file first" << std::endl;
    return 1;
  }
  const Settings settings = Settings::fromParameters();
  std::unique_ptr<ChildProcess> server;
  if (settings.display.empty()) {
    server = startDisplay(settings.width, settings.height);
  } else {
    useDisplay(settings.display);
  }
  Recorder recorder(settings);
  lockstep::init(argc, argv, NAME, settings.rate);
  {
    Scene scene(settings.config, settings.width, settings.height, settings.antialiasing);
    OffscreenNode node(settings, scene, recorder);
    lockstep::start();
    lockstep::spin([&node] { node.step(); });
    if (!scene.ready()) {
      std::cerr << "TF does not know the fixed frame '" << scene.fixedFrame() << "'" << std::endl;
    }
  }
  recorder.finish();
  std::cout << NAME << ": " << recorder.count() << " frames drawn" << std::endl;
  return lockstep::exitStatus();
}

}  // namespace
}  // namespace xtdrone_rviz

int main(int argc, char** argv) {
  try {
    return xtdrone_rviz::run(argc, argv);
  } catch (const xtdrone_rviz::SettingsError& error) {
    std::cerr << error.what() << std::endl;
    return 2;
  } catch (const xtdrone_rviz::ConfigError& error) {
    std::cerr << error.what() << std::endl;
    return 2;
  } catch (const std::exception& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
}
