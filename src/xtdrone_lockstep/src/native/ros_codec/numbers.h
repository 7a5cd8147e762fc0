// Python's numbers to and from those of ROS, with the rules of Python's `struct`.

#pragma once

#include <Python.h>

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

#include "codec.h"

namespace xtdrone::ros_codec {

/// A bool of ROS: one byte.
struct Flag {
  std::uint8_t value;
};

/// Call `function` with a value of the C++ type that a kind of number has.
template <class Function>
auto with_number(Kind kind, Function function) {
  switch (kind) {
    case Kind::BOOL:
      return function(Flag{});
    case Kind::INT8:
      return function(std::int8_t{});
    case Kind::UINT8:
      return function(std::uint8_t{});
    case Kind::INT16:
      return function(std::int16_t{});
    case Kind::UINT16:
      return function(std::uint16_t{});
    case Kind::INT32:
      return function(std::int32_t{});
    case Kind::UINT32:
      return function(std::uint32_t{});
    case Kind::INT64:
      return function(std::int64_t{});
    case Kind::UINT64:
      return function(std::uint64_t{});
    case Kind::FLOAT32:
      return function(float{});
    default:
      return function(double{});
  }
}

inline bool float_of(PyObject* object, double& value) {
  if (PyFloat_Check(object)) {
    value = PyFloat_AS_DOUBLE(object);
    return true;
  }
  Py_INCREF(object);  // __float__ may drop the message's reference
  value = PyFloat_AsDouble(object);
  Py_DECREF(object);
  return value != -1.0 || PyErr_Occurred() == nullptr;
}

template <class T>
bool small_integer(PyObject* integer, T& value) {
  int overflow = 0;
  const long long wide = PyLong_AsLongLongAndOverflow(integer, &overflow);
  if (overflow != 0 || wide < static_cast<long long>(std::numeric_limits<T>::min()) ||
      wide > static_cast<long long>(std::numeric_limits<T>::max())) {
    return false;
  }
  value = static_cast<T>(wide);
  return true;
}

template <>
inline bool small_integer(PyObject* integer, std::uint64_t& value) {
  value = PyLong_AsUnsignedLongLong(integer);
  return value != static_cast<std::uint64_t>(-1) || PyErr_Occurred() == nullptr;
}

template <class T>
bool integer_of(PyObject* object, T& value) {
  if (PyLong_Check(object)) {
    return small_integer(object, value);
  }
  if (!PyIndex_Check(object)) {
    return false;
  }
  Py_INCREF(object);  // __index__ may drop the message's reference
  PyObject* integer = PyNumber_Index(object);
  Py_DECREF(object);
  if (integer == nullptr) {
    return false;
  }
  const bool fits = small_integer(integer, value);
  Py_DECREF(integer);
  return fits;
}

/// Convert a Python number; false, possibly with a Python error, if it is of another type or out of range.
template <class T>
bool number_of(PyObject* object, T& value) {
  if constexpr (std::is_same_v<T, Flag>) {
    return integer_of(object, value.value);
  } else if constexpr (std::is_same_v<T, double>) {
    return float_of(object, value);
  } else if constexpr (std::is_same_v<T, float>) {
    double wide = 0.0;
    if (!float_of(object, wide)) {
      return false;
    }
    value = static_cast<float>(wide);
    return !std::isinf(value) || std::isinf(wide);
  } else {
    return integer_of(object, value);
  }
}

/// Return a new Python number, null with a Python error.
template <class T>
PyObject* object_of(T value) {
  if constexpr (std::is_same_v<T, Flag>) {
    return PyBool_FromLong(value.value);
  } else if constexpr (std::is_floating_point_v<T>) {
    return PyFloat_FromDouble(static_cast<double>(value));
  } else if constexpr (std::is_same_v<T, std::uint64_t>) {
    return PyLong_FromUnsignedLongLong(value);
  } else {
    return PyLong_FromLongLong(static_cast<long long>(value));
  }
}

}  // namespace xtdrone::ros_codec
