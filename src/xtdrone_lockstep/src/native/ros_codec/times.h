// Seconds and nanoseconds of genpy's times and durations.

#pragma once

#include <Python.h>

namespace xtdrone::ros_codec {

/// Where the objects of a class keep their seconds and nanoseconds.
struct TimeSlots {
  PyTypeObject* type;
  Py_ssize_t secs;
  Py_ssize_t nsecs;
};

/// Find the slot of a class by name: its offset, or -1 (without a Python error) if the class has no such slot.
Py_ssize_t slot_offset(PyTypeObject* type, const char* name);

/// Return the slots of a class of times (genpy.Time, rospy.Time and their like), null if they are not plain slots.
const TimeSlots* time_slots(PyTypeObject* type);

inline PyObject*& slot(PyObject* object, Py_ssize_t offset) {
  return *reinterpret_cast<PyObject**>(reinterpret_cast<char*>(object) + offset);
}

/// Set a slot, whose reference passes to the object.
inline void set_slot(PyObject* object, Py_ssize_t offset, PyObject* value) {
  PyObject* old = slot(object, offset);
  slot(object, offset) = value;
  Py_XDECREF(old);
}

}  // namespace xtdrone::ros_codec
