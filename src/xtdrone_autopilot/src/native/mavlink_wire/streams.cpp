// Schedule of the telemetry messages of one link.

#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "format.h"
#include "outbox.h"

namespace mavlink_wire {
namespace {
constexpr std::int64_t kNever = std::int64_t{1} << 62;

/// Return the text of the current Python error and clear it; an error that does not concern a value is thrown again.
nb::str take_error() {
  if (!PyErr_ExceptionMatches(PyExc_ValueError) && !PyErr_ExceptionMatches(PyExc_ArithmeticError)) {
    throw nb::python_error();
  }
  nb::python_error error;
  return nb::str(error.value());
}

/// One message: its format, and the function that returns its content.
class Stream {
 public:
  /// @param source returns the values in wire order, a list of such, a payload, or None
  /// @param pack general function from values to the payload, for those that `Format::payload` does not accept
  /// @param number message id, under which clients share payloads; -1 if the content is specific to the link
  Stream(std::string name, const Format& format, nb::object source, nb::object pack, long number)
      : format(format), name_(std::move(name)), source_(std::move(source)), pack_(std::move(pack)) {
    if (number >= 0) key_ = nb::int_(number);
  }

  /// Return the payload, a list of payloads, or None; errors of values are reported.
  nb::object payloads(nb::dict shared, nb::handle report) const {
    if (!key_.is_valid()) return packed(report);
    PyObject* found = PyDict_GetItemWithError(shared.ptr(), key_.ptr());
    if (found != nullptr) return nb::borrow(found);
    if (PyErr_Occurred()) throw nb::python_error();
    nb::object made = packed(report);
    shared[key_] = made;
    return made;
  }

  /// For Python's garbage collector: a source may be a method of the owner of the stream.
  int traverse(visitproc visit, void* arg) const {
    Py_VISIT(source_.ptr());
    Py_VISIT(pack_.ptr());
    return 0;
  }

  void release() {
    source_.reset();
    pack_.reset();
  }

  const Format format;

 private:
  nb::object packed(nb::handle report) const {
    if (!source_.is_valid()) return nb::none();
    nb::object content = nb::steal(PyObject_CallNoArgs(source_.ptr()));
    if (!content.is_valid()) {
      report(nb::str("not sent: {}: {}").format(name_, take_error()));
      return nb::none();
    }
    if (content.is_none() || PyBytes_Check(content.ptr())) return content;
    if (!PyList_Check(content.ptr())) return packed_values(content, report);
    nb::list made;
    for (nb::handle values : nb::list(content)) {
      nb::object payload = packed_values(values, report);
      if (payload.is_none()) return payload;
      made.append(std::move(payload));
    }
    return made;
  }

  nb::object packed_values(nb::handle values, nb::handle report) const {
    nb::object payload = format.payload(values);
    if (!payload.is_none()) return payload;
    payload = nb::steal(PyObject_CallOneArg(pack_.ptr(), values.ptr()));
    if (payload.is_valid()) return payload;
    report(nb::str("not sent: {}").format(take_error()));
    return nb::none();
  }

  std::string name_;
  nb::object source_;
  nb::object pack_;
  nb::object key_;
};

/// Messages with the same interval, due together.
struct Group {
  std::int64_t interval_us;
  std::int64_t due_us;
  std::vector<nb::object> objects;  // owners of the streams
  std::vector<const Stream*> streams;
};

/// Streams of one link in groups of equal intervals.
class Schedule {
 public:
  void clear() {
    require_idle();
    groups_.clear();
  }

  void add(std::int64_t interval_us, std::int64_t due_us, nb::list streams) {
    require_idle();
    if (interval_us < 1) throw nb::value_error("an interval is at least 1 us");
    Group group{interval_us, due_us, {}, {}};
    for (nb::handle stream : streams) {
      group.streams.push_back(&nb::cast<const Stream&>(stream));
      group.objects.push_back(nb::borrow(stream));
    }
    groups_.push_back(std::move(group));
  }

  std::int64_t next_due_us() const {
    std::int64_t next = kNever;
    for (const Group& group : groups_) next = std::min(next, group.due_us);
    return next;
  }

  /// Due time of the group added first.
  std::int64_t first_due_us() const { return groups_.empty() ? kNever : groups_.front().due_us; }

  /// Intervals and due times of the groups, in the order of `add`.
  std::vector<std::pair<std::int64_t, std::int64_t>> due_times() const {
    std::vector<std::pair<std::int64_t, std::int64_t>> times;
    for (const Group& group : groups_) times.emplace_back(group.interval_us, group.due_us);
    return times;
  }

  /// Queue the messages due by `now_us` and schedule the next ones.
  /// @param convert function that queues a message given by format and payload instead of `outbox`; None for none
  void send_due(std::int64_t now_us, nb::dict shared, Outbox& outbox, nb::handle convert, nb::handle report) {
    require_idle();
    const Sending sending(sending_);
    for (Group& group : groups_) {
      if (group.due_us > now_us) continue;
      group.due_us = (now_us / group.interval_us + 1) * group.interval_us;
      for (std::size_t i = 0; i < group.streams.size(); ++i) {
        const nb::object payloads = group.streams[i]->payloads(shared, report);
        send(group.streams[i]->format, payloads, outbox, convert);
      }
    }
  }

  int traverse(visitproc visit, void* arg) const {
    for (const Group& group : groups_) {
      for (const nb::object& stream : group.objects) Py_VISIT(stream.ptr());
    }
    return 0;
  }

 private:
  /// Marks the groups as in use.
  struct Sending {
    explicit Sending(bool& flag) : flag(flag) { flag = true; }
    ~Sending() { flag = false; }
    bool& flag;
  };

  void require_idle() const {
    if (sending_) throw std::runtime_error("the schedule is in use: a source of content must not change it");
  }

  static void send(const Format& format, nb::handle payloads, Outbox& outbox, nb::handle convert) {
    if (payloads.is_none()) return;
    if (PyList_Check(payloads.ptr())) {
      for (nb::handle payload : nb::list(nb::borrow(payloads))) send(format, payload, outbox, convert);
    } else if (convert.is_none()) {
      outbox.put(format, nb::cast<nb::bytes>(payloads));
    } else {
      convert(format, payloads);
    }
  }

  std::vector<Group> groups_;
  bool sending_ = false;
};

template <typename Class>
int traverse(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  return nb::inst_ready(self) ? nb::inst_ptr<Class>(self)->traverse(visit, arg) : 0;
}

int clear_stream(PyObject* self) {
  nb::inst_ptr<Stream>(self)->release();
  return 0;
}

PyType_Slot stream_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(traverse<Stream>)},
                              {Py_tp_clear, reinterpret_cast<void*>(clear_stream)},
                              {0, nullptr}};
PyType_Slot schedule_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(traverse<Schedule>)}, {0, nullptr}};
}  // namespace

void bind_streams(nb::module_& module) {
  nb::class_<Stream>(module, "Stream", nb::type_slots(stream_slots),
                     "One message: its format, and the function that returns its content.")
      .def(nb::init<std::string, const Format&, nb::object, nb::object, long>(), nb::arg("name"), nb::arg("format"),
           nb::arg("source"), nb::arg("pack"), nb::arg("number"))
      .def("payloads", &Stream::payloads, nb::arg("shared"), nb::arg("report"));
  nb::class_<Schedule>(module, "Schedule", nb::type_slots(schedule_slots),
                       "Streams of one link in groups of equal intervals.")
      .def(nb::init<>())
      .def("clear", &Schedule::clear)
      .def("add", &Schedule::add, nb::arg("interval_us"), nb::arg("due_us"), nb::arg("streams"))
      .def_prop_ro("next_due_us", &Schedule::next_due_us)
      .def_prop_ro("first_due_us", &Schedule::first_due_us)
      .def_prop_ro("due_times", &Schedule::due_times)
      .def("send_due", &Schedule::send_due, nb::arg("now_us"), nb::arg("shared"), nb::arg("outbox"),
           nb::arg("convert").none(), nb::arg("report"));
}
}  // namespace mavlink_wire
