// Ownership of Python objects.

#pragma once

#include <Python.h>

#include <utility>

namespace xtdrone::ros_codec {

/// A reference that is released at the end of a block.
class Held {
 public:
  explicit Held(PyObject* owned) : object_(owned) {}
  ~Held() { Py_XDECREF(object_); }
  Held(const Held&) = delete;
  Held& operator=(const Held&) = delete;

  static Held borrowed(PyObject* object) {
    Py_INCREF(object);
    return Held(object);
  }
  PyObject* get() const { return object_; }
  PyObject* release() { return std::exchange(object_, nullptr); }

 private:
  PyObject* object_;
};

}  // namespace xtdrone::ros_codec
