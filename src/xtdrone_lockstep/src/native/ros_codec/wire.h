// Growing output and bounded input.

#pragma once

#include <Python.h>

#include <algorithm>
#include <cstddef>
#include <cstring>

namespace xtdrone::ros_codec {

/// A bytes object that grows; nothing else refers to it before it is finished.
class Writer {
 public:
  explicit Writer(std::size_t capacity)
      : object_(PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>(capacity))), capacity_(capacity) {
    start_ = object_ == nullptr ? nullptr : PyBytes_AS_STRING(object_);
  }
  ~Writer() { Py_XDECREF(object_); }
  Writer(const Writer&) = delete;
  Writer& operator=(const Writer&) = delete;

  bool valid() const { return object_ != nullptr; }
  std::size_t used() const { return used_; }
  char* start() { return start_; }

  /// Return the place of the next `size` bytes, null with MemoryError.
  char* extend(std::size_t size) {
    if (size > capacity_ - used_ && !grow(size)) {
      return nullptr;
    }
    char* place = start_ + used_;
    used_ += size;
    return place;
  }

  template <class T>
  bool put(T value) {
    char* place = extend(sizeof(T));
    if (place == nullptr) {
      return false;
    }
    std::memcpy(place, &value, sizeof(T));
    return true;
  }

  bool put(const char* data, std::size_t size) {
    char* place = extend(size);
    if (place == nullptr) {
      return false;
    }
    std::memcpy(place, data, size);
    return true;
  }

  /// Return the bytes object, null with MemoryError.
  PyObject* take() {
    if (used_ != capacity_) {
      _PyBytes_Resize(&object_, static_cast<Py_ssize_t>(used_));
    }
    PyObject* taken = object_;
    object_ = nullptr;
    return taken;
  }

 private:
  bool grow(std::size_t size) {
    if (object_ == nullptr) {
      return false;
    }
    const std::size_t capacity = std::max(2 * capacity_, used_ + size);
    if (_PyBytes_Resize(&object_, static_cast<Py_ssize_t>(capacity)) < 0) {
      return false;
    }
    capacity_ = capacity;
    start_ = PyBytes_AS_STRING(object_);
    return true;
  }

  PyObject* object_;
  char* start_;
  std::size_t capacity_;
  std::size_t used_ = 0;
};

/// The rest of a message's bytes; the caller keeps them in place.
class Reader {
 public:
  Reader(const char* data, std::size_t size, const char* type) : place_(data), left_(size), type_(type) {}

  std::size_t left() const { return left_; }
  /// Type of the whole message, for messages about it.
  const char* type() const { return type_; }

  /// Return the place of the next `size` bytes; the caller has made sure that they exist.
  const char* skip(std::size_t size) {
    const char* place = place_;
    place_ += size;
    left_ -= size;
    return place;
  }

  template <class T>
  T get() {
    T value;
    std::memcpy(&value, skip(sizeof(T)), sizeof(T));
    return value;
  }

 private:
  const char* place_;
  std::size_t left_;
  const char* type_;
};

}  // namespace xtdrone::ros_codec
