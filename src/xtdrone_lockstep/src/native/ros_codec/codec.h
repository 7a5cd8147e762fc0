// The codec of one class of ROS 1 messages.

#pragma once

#include <Python.h>

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace xtdrone::ros_codec {

/// Type of a field, or of the elements of an array.
enum class Kind {
  BOOL,
  INT8,
  UINT8,
  INT16,
  UINT16,
  INT32,
  UINT32,
  INT64,
  UINT64,
  FLOAT32,
  FLOAT64,
  STRING,
  TIME,
  DURATION,
  MESSAGE
};

inline bool is_number(Kind kind) { return kind <= Kind::FLOAT64; }
inline bool is_time(Kind kind) { return kind == Kind::TIME || kind == Kind::DURATION; }

class Codec;

struct Field {
  static constexpr int SINGLE = -2;
  static constexpr int VARIABLE = -1;

  std::string name;
  PyObject* key;  ///< the name, interned
  Kind kind;
  int count;            ///< elements of a fixed array, SINGLE or VARIABLE
  Py_ssize_t offset;    ///< of the slot in the message object
  PyTypeObject* type;   ///< of a time or duration to be created
  const Codec* nested;  ///< of a message
  std::size_t size;     ///< smallest number of bytes of one value
  PyObject* initial;    ///< value after construction, or its example
};

/// Bytes of a message under construction, in a bytes object.
class Writer;
/// Bytes of a message not yet read.
class Reader;

/// Encodes and decodes the objects of one message class; the caller holds the GIL.
///
/// Only exact types are handled: an object of another class (or a number of the wrong kind) is left to genpy's method,
/// which accepts or rejects it by its own rules.
class Codec {
 public:
  /// Both objects are kept forever.
  Codec(PyObject* type, std::string name, PyObject* error);
  Codec(const Codec&) = delete;
  Codec& operator=(const Codec&) = delete;

  /// Append a field; false with a Python error if it is not possible.
  bool add_field(PyObject* name, const std::string& kind, int count, PyObject* type, const Codec* nested);

  /// Create objects in place of the class's constructor, with the values of a message made by that constructor.
  ///
  /// Returns false, with a Python error, if it is not such a message.
  bool construct_like(PyObject* message);
  /// Return a new message, as its constructor does. The values are given by position, or by the names of a tuple; a
  /// missing value or None gives the initial one. Null without a Python error: left to the constructor.
  PyObject* construct(PyObject* const* values, Py_ssize_t count, PyObject* names) const;

  /// Return bytes, None if only genpy's method handles a value, null with a Python error. New references.
  PyObject* encode(PyObject* message) const;
  PyObject* packet(PyObject* message, PyObject* sequence) const;

  /// Return a new message, or null with a Python error.
  PyObject* decode(PyObject* data) const;
  /// Fill a message: 1 done, 0 only genpy's method handles it, -1 with a Python error.
  int fill(PyObject* message, PyObject* data) const;

  std::size_t size() const { return size_; }

 private:
  bool write(Writer& out, PyObject* message) const;
  bool write_single(Writer& out, const Field& field, PyObject* value) const;
  bool write_array(Writer& out, const Field& field, PyObject* value) const;
  bool stamp(PyObject* message, PyObject* sequence) const;
  PyObject* finish(Writer& out, bool complete) const;

  bool read(Reader& in, PyObject* message, bool fresh) const;
  bool read_field(Reader& in, const Field& field, PyObject* message, bool fresh) const;
  PyObject* read_array(Reader& in, const Field& field) const;
  PyObject* read_element(Reader& in, const Field& field) const;
  PyObject* create(Reader& in) const;
  bool place_value(PyObject* message, PyObject* name, PyObject* value) const;
  bool canonical(PyObject* message) const;

  PyTypeObject* type_;
  std::string name_;
  PyObject* error_;
  std::vector<Field> fields_;  ///< keep their objects forever
  std::size_t size_ = 0;       ///< smallest number of bytes of a message
  bool has_header_ = false;
  mutable std::size_t usual_size_ = 64;
};

}  // namespace xtdrone::ros_codec
