/// A participant's turns without Python.
#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "frames.h"
#include "splitter.h"
#include "xtdrone_lockstep/turn_program.h"

namespace xtdrone_lockstep::io {

/// Runs turns of a node's program until one needs Python, whose objects are then updated from this object.
///
/// Inputs and outputs are added before `run`. Sockets stay Python's, which may close them in other threads.
class Turns {
 public:
  /// @param epoll  The set in which the node waits for everything.
  /// @param descriptor  Of the simulator's connection.
  /// @param acquire, release  Python's methods of the lock that is held while sending to the simulator.
  /// @param send_all  Python's method that sends all bytes to the simulator.
  /// @param topics  Number of topics that the program receives.
  /// @param tick, time_us  Number and time of the last turn.
  Turns(int epoll, int descriptor, nanobind::object acquire, nanobind::object release, nanobind::object send_all,
        std::size_t topics, std::uint64_t tick, std::int64_t time_us);

  /// Read a topic from a participant; a topic has one such connection at most.
  ///
  /// @param topic  The program's number of the topic.
  /// @param taken  Messages of this connection that the node has handled.
  void addInput(std::size_t topic, std::uint32_t channel, nanobind::object sock, nanobind::object splitter,
                std::uint64_t taken);
  /// Add the program's next topic to publish.
  ///
  /// @param sequence  Number of messages published so far.
  /// @param add_to_digest  Called with the time in us and each serialised message; None for no digests.
  void addOutput(std::uint32_t sequence, nanobind::object add_to_digest);
  /// Add a connection to a subscriber of the topic.
  ///
  /// @param count  Messages sent over it so far.
  void addConnection(std::size_t topic, std::uint32_t number, std::uint64_t count, nanobind::object sock);

  /// Run turns.
  ///
  /// @param program  Capsule of a TurnProgram.
  /// @param until_us  Python runs the turns from this time on.
  /// @param timeout  Longest wait in wall seconds.
  /// @return  As `lockstep_io.receive`: the event that Python has to handle, such as the TICK of its turn.
  /// @throws nanobind::python_error  OSError: The connection to the simulator is broken. The exception of a signal
  ///     handler.
  nanobind::object run(nanobind::capsule program, std::int64_t until_us, double timeout);
  /// Leave the next turn to Python; may be called in any thread.
  void stop() { stopped_ = true; }

  /// Number and time of the last turn.
  std::uint64_t tick() const { return tick_; }
  std::int64_t timeUs() const { return time_us_; }
  /// Return of each input: its channel, messages handled so far, bytes read.
  nanobind::list inputs() const;
  /// Return of each output: messages published here, and their bytes.
  nanobind::list outputs() const;
  /// Return of each connection: its number, messages sent so far, bytes that the kernel has not accepted, errno of a
  /// failure or 0.
  nanobind::list connections() const;

 private:
  struct Input {
    std::size_t topic;
    std::uint32_t channel;
    nanobind::object sock;
    nanobind::object owner;  // of the splitter
    Splitter* splitter;
    std::uint64_t returned;  // by the splitter to Python before this object was made
    std::uint64_t taken;
    std::uint64_t due = 0;  // messages in this turn
    std::size_t bytes = 0;
  };
  struct Connection {
    std::uint32_t number;
    std::uint64_t count;
    nanobind::object sock;
    std::string rest;
    int failure = 0;
  };
  struct Output {
    std::uint32_t sequence;
    nanobind::object add_to_digest;
    std::vector<Connection> connections;
    std::size_t messages = 0;
    std::size_t bytes = 0;
  };

  bool carry(const Barrier& tick, TurnProgram& program);
  bool fetch(const Barrier& tick);
  bool fill(Input& input, std::uint64_t target);
  void publish(std::int64_t time_us);
  void send(Connection& connection, const std::string& packet);
  void finish(const Barrier& tick);

  int epoll_;
  int descriptor_;
  nanobind::object acquire_;
  nanobind::object release_;
  nanobind::object send_all_;
  std::vector<Input> inputs_;
  std::vector<Output> outputs_;
  std::vector<Messages> received_;  // by topic
  std::vector<Publication> published_;
  std::vector<std::pair<std::uint32_t, std::uint64_t>> counts_;  // sent in this turn
  std::string frame_;
  std::uint64_t tick_;
  std::int64_t time_us_;
  std::int64_t until_us_ = 0;
  bool stopped_ = false;
};

}  // namespace xtdrone_lockstep::io
