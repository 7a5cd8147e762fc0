#include "times.h"

#include <structmember.h>

#include <deque>

namespace xtdrone::ros_codec {

Py_ssize_t slot_offset(PyTypeObject* type, const char* name) {
  PyObject* found = PyObject_GetAttrString(reinterpret_cast<PyObject*>(type), name);
  if (found == nullptr) {
    PyErr_Clear();
    return -1;
  }
  Py_ssize_t offset = -1;
  if (Py_IS_TYPE(found, &PyMemberDescr_Type)) {
    const auto* descriptor = reinterpret_cast<PyMemberDescrObject*>(found);
    if (descriptor->d_member->type == T_OBJECT_EX && PyType_IsSubtype(type, PyDescr_TYPE(descriptor))) {
      offset = descriptor->d_member->offset;
    }
  }
  Py_DECREF(found);
  return offset;
}

const TimeSlots* time_slots(PyTypeObject* type) {
  // A program has a handful of classes of times: genpy's and rospy's. A deque keeps its elements in place.
  static std::deque<TimeSlots> known;
  for (const TimeSlots& slots : known) {
    if (slots.type == type) {
      return slots.secs < 0 ? nullptr : &slots;
    }
  }
  constexpr std::size_t most = 32;
  if (known.size() >= most || type->tp_getattro != PyObject_GenericGetAttr) {
    return nullptr;
  }
  TimeSlots slots{type, slot_offset(type, "secs"), slot_offset(type, "nsecs")};
  if (slots.nsecs < 0) {
    slots.secs = -1;
  }
  Py_INCREF(reinterpret_cast<PyObject*>(type));
  known.push_back(slots);
  return slots.secs < 0 ? nullptr : &known.back();
}

}  // namespace xtdrone::ros_codec
