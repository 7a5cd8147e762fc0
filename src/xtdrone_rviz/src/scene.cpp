#include "scene.h"

#include <OgreCamera.h>
#include <OgreException.h>
#include <OgrePixelFormat.h>
#include <OgreRenderWindow.h>
#include <ros/callback_queue.h>
#include <ros/console.h>
#include <ros/names.h>
#include <ros/node_handle.h>
#include <ros/publisher.h>
#include <ros/subscriber.h>
#include <rviz/config.h>
#include <rviz/display_group.h>
#include <rviz/failed_display.h>
#include <rviz/failed_view_controller.h>
#include <rviz/ogre_helpers/render_system.h>
#include <rviz/render_panel.h>
#include <rviz/view_manager.h>
#include <rviz/visualization_manager.h>
#include <rviz/yaml_config_reader.h>
#include <sys/stat.h>
#include <tf2_ros/buffer.h>
#include <tf2_ros/transform_listener.h>

#include <QApplication>
#include <algorithm>
#include <cmath>
#include <map>

namespace xtdrone_rviz {
namespace {

const char* const MANAGER = "Visualization Manager";
constexpr double RELAY_LIMIT = 10.0;  // wall s for a message to pass through the process
constexpr double RELAY_SLICE = 0.1;   // wall s
constexpr int SIZE_ROUNDS = 3;
constexpr int MOST_ROUNDS = 20;  // of callbacks that queue callbacks, as filters do

std::string text(const QString& words) { return words.toStdString(); }

std::string stringOf(const rviz::Config& config, const char* key) {
  QString value;
  return config.mapGetString(key, &value) ? text(value) : "";
}

bool endsWith(const std::string& word, const std::string& end) {
  return word.size() >= end.size() && word.compare(word.size() - end.size(), end.size(), end) == 0;
}

/// Calls `visit` with each display of a configuration, including those in groups.
template <class Visit>
void forEachDisplay(const rviz::Config& parent, const Visit& visit) {
  const rviz::Config displays = parent.mapGetChild("Displays");
  for (int i = 0; i < displays.listLength(); ++i) {
    const rviz::Config display = displays.listChildAt(i);
    visit(display);
    forEachDisplay(display, visit);
  }
}

void checkClass(const std::string& path, const std::string& name) {
  for (const std::string package : {"rviz_default_plugins/", "rviz_common/"}) {
    if (name.compare(0, package.size(), package) == 0) {
      throw ConfigError("configuration " + path + ": is of ROS 2's rviz (it has a " + name +
                        "); one of ROS 1's is needed, whose classes are called rviz/...");
    }
  }
}

rviz::Config readConfig(const std::string& path) {
  struct stat status;
  if (stat(path.c_str(), &status) != 0 || !S_ISREG(status.st_mode)) {
    throw ConfigError("configuration " + path + ": there is no such file");
  }
  rviz::YamlConfigReader reader;
  rviz::Config config;
  reader.readFile(config, QString::fromStdString(path));
  if (reader.error()) {
    throw ConfigError("configuration " + path + ": cannot be read: " + text(reader.errorMessage()));
  }
  const rviz::Config manager = config.mapGetChild(MANAGER);
  if (config.getType() != rviz::Config::Map || manager.getType() != rviz::Config::Map) {
    throw ConfigError("configuration " + path + ": is no .rviz file of rviz 1.x: it has no '" + MANAGER + "'");
  }
  if (manager.mapGetChild("Displays").getType() != rviz::Config::List) {
    throw ConfigError("configuration " + path + ": has no list 'Displays' under '" + MANAGER + "'");
  }
  forEachDisplay(manager, [&](const rviz::Config& display) { checkClass(path, stringOf(display, "Class")); });
  return manager;
}

/// Returns whether a display draws into a separate panel.
bool hasOwnPanel(const std::string& name) { return name == "rviz/Image" || name == "rviz/Camera"; }

/// Returns whether a display derives the names of its subscriptions from its topics.
bool readsImages(const std::string& name) { return name == "rviz/DepthCloud"; }

bool isEnabled(const rviz::Config& display) {
  bool enabled = false;
  display.mapGetBool("Enabled", &enabled);
  return enabled;
}

std::string relayOf(const std::string& topic) { return ros::names::resolve("~shown" + topic); }

/// Makes a display subscribe to relays of its topics, and adds these to the list.
void relayTopics(rviz::Config display, std::set<std::string>& topics) {
  if (!isEnabled(display) || readsImages(stringOf(display, "Class"))) {
    return;
  }
  std::vector<std::string> keys;
  for (rviz::Config::MapIterator it = display.mapIterator(); it.isValid(); it.advance()) {
    keys.push_back(text(it.currentKey()));
  }
  for (const std::string& key : keys) {
    const std::string value = stringOf(display, key.c_str());
    std::string why;
    if (endsWith(key, "Topic") && !value.empty() && ros::names::validate(value, why)) {
      const std::string topic = ros::names::resolve(value);
      topics.insert(topic);
      display.mapSetValue(QString::fromStdString(key), QString::fromStdString(relayOf(topic)));
    }
  }
}

/// A topic within this process that mirrors another one, with messages passed to it explicitly.
struct Relay {
  ros::Publisher publisher;
  ros::Subscriber counter;
  unsigned long sent = 0;
  unsigned long heard = 0;
};

void findFailed(const rviz::DisplayGroup& group, std::vector<std::string>& found) {
  for (int i = 0; i < group.numDisplays(); ++i) {
    rviz::Display* display = group.getDisplayAt(i);
    if (dynamic_cast<rviz::FailedDisplay*>(display) != nullptr) {
      found.push_back("display '" + text(display->getName()) + "' of class " + text(display->getClassId()) +
                      " is not known to this rviz; it is left out");
    } else if (const auto* inner = dynamic_cast<rviz::DisplayGroup*>(display)) {
      findFailed(*inner, found);
    }
  }
}

}  // namespace

struct Scene::Parts {
  std::string path;
  rviz::Config config;
  std::set<std::string> topics;
  std::vector<std::string> left_out;  // one line per display
  std::map<std::string, Relay> relays;
  ros::CallbackQueue heard;   // of the relays' counters
  ros::CallbackQueue unused;  // of the TF listener that rviz requires
  std::string fixed_frame;
  int argc = 1;
  char name[16] = "rviz_offscreen";
  char* argv[2] = {name, nullptr};
  std::unique_ptr<QApplication> application;
  std::unique_ptr<rviz::RenderPanel> panel;
  std::shared_ptr<tf2_ros::Buffer> buffer;
  std::shared_ptr<tf2_ros::TransformListener> listener;
  std::unique_ptr<rviz::VisualizationManager> manager;

  ~Parts() {
    if (manager) {
      manager->removeAllDisplays();
    }
    // The manager notifies the panel when its scene is deleted, so the panel is deleted later; both need the
    // application.
    manager.reset();
    panel.reset();
    listener.reset();
    buffer.reset();
    application.reset();
  }
};

Scene::Scene(const std::string& config, unsigned width, unsigned height, bool antialiasing)
    : parts_(std::make_unique<Parts>()) {
  Parts& parts = *parts_;
  parts.path = config;
  parts.config = readConfig(config);
  forEachDisplay(parts.config, [&](rviz::Config display) {
    if (hasOwnPanel(stringOf(display, "Class")) && isEnabled(display)) {
      parts.left_out.push_back("display '" + stringOf(display, "Name") + "' of class " + stringOf(display, "Class") +
                               " has a panel of its own, beside the view; it is left out");
      display.mapSetValue("Enabled", false);
    }
    relayTopics(display, parts.topics);
  });
  parts.fixed_frame = stringOf(parts.config.mapGetChild("Global Options"), "Fixed Frame");
  if (parts.fixed_frame.empty()) {
    parts.fixed_frame = "map";
  }
  if (!antialiasing) {
    rviz::RenderSystem::disableAntiAliasing();
  }
  try {
    parts.application = std::make_unique<QApplication>(parts.argc, parts.argv);
    parts.panel = std::make_unique<rviz::RenderPanel>();
    parts.panel->setWindowFlags(Qt::FramelessWindowHint);
    parts.panel->setGeometry(0, 0, static_cast<int>(width), static_cast<int>(height));
    parts.buffer = std::make_shared<tf2_ros::Buffer>();
    // rviz requires a TF listener. This one receives nothing: place() fills the buffer.
    ros::NodeHandle handle(
        "", {{"/tf", ros::names::resolve("~unused/tf")}, {"/tf_static", ros::names::resolve("~unused/tf_static")}});
    handle.setCallbackQueue(&parts.unused);
    parts.listener = std::make_shared<tf2_ros::TransformListener>(*parts.buffer, handle, false);
    parts.manager =
        std::make_unique<rviz::VisualizationManager>(parts.panel.get(), nullptr, parts.buffer, parts.listener);
    parts.panel->initialize(parts.manager->getSceneManager(), parts.manager.get());
    parts.panel->show();
    QCoreApplication::processEvents();
    parts.manager->initialize();
    parts.panel->getRenderWindow()->setAutoUpdated(false);
    // Until all libraries know the window's size: Mesa reads it when the buffers are swapped.
    for (int round = 0; round < SIZE_ROUNDS; ++round) {
      QCoreApplication::processEvents();
      parts.panel->getRenderWindow()->update(true);
    }
  } catch (const Ogre::Exception& error) {
    throw DisplayError(std::string("OpenGL cannot be had on this display: ") + error.what());
  }
}

Scene::~Scene() = default;

std::set<std::string> Scene::topics() const { return parts_->topics; }

const std::string& Scene::fixedFrame() const { return parts_->fixed_frame; }

std::vector<std::string> Scene::load() {
  rviz::VisualizationManager& manager = *parts_->manager;
  manager.load(parts_->config);
  std::vector<std::string> left_out = parts_->left_out;
  findFailed(*manager.getRootDisplayGroup(), left_out);
  rviz::ViewController* view = manager.getViewManager()->getCurrent();
  if (dynamic_cast<rviz::FailedViewController*>(view) != nullptr) {
    throw ConfigError("configuration " + parts_->path + ": its view is of class " + text(view->getClassId()) +
                      ", which is not known to this rviz");
  }
  ros::NodeHandle handle;
  handle.setCallbackQueue(&parts_->heard);
  for (const std::string& topic : parts_->topics) {
    Relay& relay = parts_->relays[topic];
    // After the displays' subscriptions: a message received here is already in the displays' queue.
    relay.counter = handle.subscribe<topic_tools::ShapeShifter>(
        relayOf(topic), 0,
        boost::function<void(const topic_tools::ShapeShifter::ConstPtr&)>([&relay](const auto&) { ++relay.heard; }));
  }
  QCoreApplication::processEvents();
  return left_out;
}

void Scene::show(const std::string& topic, const topic_tools::ShapeShifter& message) {
  const auto found = parts_->relays.find(topic);
  if (found == parts_->relays.end()) {
    return;
  }
  Relay& relay = found->second;
  if (!relay.publisher) {
    ros::NodeHandle handle;
    relay.publisher = message.advertise(handle, relayOf(topic), 0);
  }
  relay.publisher.publish(message);
  ++relay.sent;
}

void Scene::place(const tf2_msgs::TFMessage& message, bool fixed) {
  for (const auto& transform : message.transforms) {
    try {
      parts_->buffer->setTransform(transform, "lockstep", fixed);
    } catch (const tf2::TransformException& error) {
      ROS_WARN_THROTTLE(10.0, "bad transform of %s: %s", transform.child_frame_id.c_str(), error.what());
    }
  }
}

bool Scene::ready() const { return parts_->buffer->_frameExists(parts_->fixed_frame); }

void Scene::reset() { parts_->manager->resetTime(); }

void Scene::draw(Picture& picture) {
  const auto missing = [](const auto& entry) { return entry.second.heard < entry.second.sent; };
  const ros::SteadyTime limit = ros::SteadyTime::now() + ros::WallDuration(RELAY_LIMIT);
  while (std::any_of(parts_->relays.begin(), parts_->relays.end(), missing) && ros::SteadyTime::now() < limit) {
    parts_->heard.callAvailable(ros::WallDuration(RELAY_SLICE));
  }
  ros::CallbackQueue& queue = *ros::getGlobalCallbackQueue();
  for (int round = 0; round < MOST_ROUNDS && !queue.isEmpty(); ++round) {
    queue.callAvailable();
  }
  QCoreApplication::processEvents();
  rviz::VisualizationManager& manager = *parts_->manager;
  manager.queueRender();
  // As rviz's own timer does: the displays process the received messages.
  QMetaObject::invokeMethod(&manager, "onUpdate", Qt::DirectConnection);
  // Not by OGRE's own frame loop, which swaps the buffers: the X server may then show an old picture, and no screen
  // shows it.
  Ogre::RenderWindow& window = *parts_->panel->getRenderWindow();
  window.update(false);
  const Ogre::PixelBox pixels(picture.width, picture.height, 1, Ogre::PF_BYTE_RGB, picture.data.data());
  window.copyContentsToMemory(Ogre::Box(0, 0, picture.width, picture.height), pixels, Ogre::RenderTarget::FB_BACK);
}

Camera Scene::camera() const {
  const Ogre::Camera& camera = *parts_->manager->getViewManager()->getCurrent()->getCamera();
  const Ogre::Vector3 place = camera.getDerivedPosition();
  // OGRE's cameras look along -z with y up: rotate by half a turn about x.
  const Ogre::Quaternion turn = camera.getDerivedOrientation() * Ogre::Quaternion(0.0F, 1.0F, 0.0F, 0.0F);
  const double height = parts_->panel->getRenderWindow()->getHeight();
  return {{place.x, place.y, place.z},
          {turn.x, turn.y, turn.z, turn.w},
          0.5 * height / std::tan(0.5 * camera.getFOVy().valueRadians())};
}

}  // namespace xtdrone_rviz
