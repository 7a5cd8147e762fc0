// Message objects without the generated constructor, which sets every field by Python code.

#include <unordered_map>

#include "codec.h"
#include "held.h"
#include "times.h"

namespace xtdrone::ros_codec {
namespace {

std::unordered_map<PyTypeObject*, const Codec*>& codecs() {
  static std::unordered_map<PyTypeObject*, const Codec*> known;
  return known;
}

/// Call the class as Python would without this file.
PyObject* call_type(PyObject* type, PyObject* const* values, Py_ssize_t count, PyObject* names) {
  const Held arguments(PyTuple_New(count));
  const Held keywords(names == nullptr ? nullptr : PyDict_New());
  if (arguments.get() == nullptr || (names != nullptr && keywords.get() == nullptr)) {
    return nullptr;
  }
  for (Py_ssize_t i = 0; i < count; ++i) {
    Py_INCREF(values[i]);
    PyTuple_SET_ITEM(arguments.get(), i, values[i]);
  }
  for (Py_ssize_t i = 0; names != nullptr && i < PyTuple_GET_SIZE(names); ++i) {
    if (PyDict_SetItem(keywords.get(), PyTuple_GET_ITEM(names, i), values[count + i]) < 0) {
      return nullptr;
    }
  }
  return PyType_Type.tp_call(type, arguments.get(), keywords.get());
}

/// Called by Python in place of the class.
PyObject* call_class(PyObject* type, PyObject* const* values, std::size_t flagged_count, PyObject* names) {
  const Py_ssize_t count = PyVectorcall_NARGS(flagged_count);
  const auto found = codecs().find(reinterpret_cast<PyTypeObject*>(type));
  if (found != codecs().end()) {
    PyObject* message = found->second->construct(values, count, names);
    if (message != nullptr || PyErr_Occurred() != nullptr) {
      return message;
    }
  }
  return call_type(type, values, count, names);
}

PyObject* initial_time(PyTypeObject* type) {
  Held time(type->tp_alloc(type, 0));
  if (time.get() == nullptr) {
    return nullptr;
  }
  const TimeSlots& slots = *time_slots(type);
  set_slot(time.get(), slots.secs, PyLong_FromLong(0));
  set_slot(time.get(), slots.nsecs, PyLong_FromLong(0));
  return time.release();
}

PyObject* initial_single(const Field& field) {
  if (field.kind == Kind::MESSAGE) {
    return field.nested->construct(nullptr, 0, nullptr);
  }
  if (is_time(field.kind)) {
    return initial_time(field.type);
  }
  Py_INCREF(field.initial);
  return field.initial;
}

PyObject* initial_value(const Field& field) {
  if (!PyList_CheckExact(field.initial)) {
    return initial_single(field);
  }
  const Py_ssize_t count = PyList_GET_SIZE(field.initial);
  if (field.kind != Kind::MESSAGE && !is_time(field.kind)) {
    return PyList_GetSlice(field.initial, 0, count);
  }
  Held list(PyList_New(count));
  for (Py_ssize_t i = 0; list.get() != nullptr && i < count; ++i) {
    PyObject* element = initial_single(field);
    if (element == nullptr) {
      return nullptr;
    }
    PyList_SET_ITEM(list.get(), i, element);
  }
  return list.release();
}

}  // namespace

bool Codec::construct_like(PyObject* message) {
  if (!Py_IS_TYPE(message, type_)) {
    PyErr_Format(PyExc_TypeError, "%s: a message of the codec's class is needed", name_.c_str());
    return false;
  }
  for (Field& field : fields_) {
    PyObject* value = slot(message, field.offset);
    if (value == nullptr) {
      PyErr_Format(PyExc_TypeError, "%s.%s has no initial value", name_.c_str(), field.name.c_str());
      return false;
    }
    Py_INCREF(value);
    field.initial = value;
  }
  codecs()[type_] = this;
  type_->tp_vectorcall = call_class;
  return true;
}

PyObject* Codec::construct(PyObject* const* values, Py_ssize_t count, PyObject* names) const {
  const Py_ssize_t named = names == nullptr ? 0 : PyTuple_GET_SIZE(names);
  if ((count != 0 && named != 0) || (count != 0 && count != static_cast<Py_ssize_t>(fields_.size()))) {
    return nullptr;
  }
  Held message(type_->tp_alloc(type_, 0));
  if (message.get() == nullptr) {
    return nullptr;
  }
  for (Py_ssize_t i = 0; i < named; ++i) {
    if (!place_value(message.get(), PyTuple_GET_ITEM(names, i), values[i])) {
      return nullptr;
    }
  }
  for (Py_ssize_t i = 0; i < count; ++i) {
    Py_INCREF(values[i]);
    set_slot(message.get(), fields_[static_cast<std::size_t>(i)].offset, values[i]);
  }
  for (const Field& field : fields_) {
    PyObject* present = slot(message.get(), field.offset);
    if (present != nullptr && present != Py_None) {
      continue;
    }
    PyObject* value = initial_value(field);
    if (value == nullptr) {
      return nullptr;
    }
    set_slot(message.get(), field.offset, value);
  }
  return message.release();
}

/// Set the field of a name; false if there is none.
bool Codec::place_value(PyObject* message, PyObject* name, PyObject* value) const {
  for (const Field& field : fields_) {
    if (field.key == name || PyUnicode_Compare(field.key, name) == 0) {
      Py_INCREF(value);
      set_slot(message, field.offset, value);
      return true;
    }
  }
  return false;
}

}  // namespace xtdrone::ros_codec
