#include "codec.h"

#include <algorithm>
#include <limits>
#include <map>
#include <utility>

#include "held.h"
#include "numbers.h"
#include "times.h"
#include "wire.h"

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "messages of ROS are little-endian");

namespace xtdrone::ros_codec {
namespace {

/// Most elements that take no bytes (an array of std_msgs/Empty), so that a count alone cannot fill the memory.
constexpr std::size_t MOST_EMPTY_ELEMENTS = 1 << 16;

const std::map<std::string, Kind> KINDS{
    {"bool", Kind::BOOL},       {"int8", Kind::INT8},     {"byte", Kind::INT8},     {"uint8", Kind::UINT8},
    {"char", Kind::UINT8},      {"int16", Kind::INT16},   {"uint16", Kind::UINT16}, {"int32", Kind::INT32},
    {"uint32", Kind::UINT32},   {"int64", Kind::INT64},   {"uint64", Kind::UINT64}, {"float32", Kind::FLOAT32},
    {"float64", Kind::FLOAT64}, {"string", Kind::STRING}, {"time", Kind::TIME},     {"duration", Kind::DURATION},
    {"message", Kind::MESSAGE},
};

bool is_bytes(const Field& field) { return field.kind == Kind::UINT8 && field.count != Field::SINGLE; }

std::size_t size_of_value(Kind kind, const Codec* nested) {
  if (is_number(kind)) {
    return with_number(kind, [](auto number) { return sizeof(number); });
  }
  switch (kind) {
    case Kind::STRING:
      return sizeof(std::uint32_t);
    case Kind::TIME:
    case Kind::DURATION:
      return 2 * sizeof(std::uint32_t);
    default:
      return nested->size();
  }
}

std::size_t size_of_field(const Field& field) {
  switch (field.count) {
    case Field::SINGLE:
      return field.size;
    case Field::VARIABLE:
      return sizeof(std::uint32_t);
    default:
      return field.size * static_cast<std::size_t>(field.count);
  }
}

bool put_length(Writer& out, Py_ssize_t length) {
  return length <= std::numeric_limits<std::uint32_t>::max() && out.put(static_cast<std::uint32_t>(length));
}

bool write_string(Writer& out, PyObject* value) {
  if (!PyUnicode_Check(value)) {
    return false;
  }
  Py_ssize_t length = 0;
  const char* text = PyUnicode_AsUTF8AndSize(value, &length);
  return text != nullptr && put_length(out, length) && out.put(text, static_cast<std::size_t>(length));
}

bool write_time(Writer& out, Kind kind, PyObject* value) {
  const TimeSlots* slots = time_slots(Py_TYPE(value));
  if (slots == nullptr) {
    return false;
  }
  const Held held = Held::borrowed(value);
  for (const Py_ssize_t offset : {slots->secs, slots->nsecs}) {
    PyObject* part = slot(value, offset);
    std::uint32_t bits = 0;
    if (part == nullptr) {
      return false;
    }
    if (kind == Kind::TIME) {
      if (!number_of(part, bits)) {
        return false;
      }
    } else {
      std::int32_t number = 0;
      if (!number_of(part, number)) {
        return false;
      }
      bits = static_cast<std::uint32_t>(number);
    }
    if (!out.put(bits)) {
      return false;
    }
  }
  return true;
}

/// Write numbers of a list or tuple; converting one may run Python code that changes the list.
template <class T>
bool write_numbers(Writer& out, PyObject* sequence, Py_ssize_t count) {
  char* place = out.extend(sizeof(T) * static_cast<std::size_t>(count));
  if (place == nullptr) {
    return false;
  }
  for (Py_ssize_t i = 0; i < count; ++i, place += sizeof(T)) {
    T number{};
    if (PySequence_Fast_GET_SIZE(sequence) != count || !number_of(PySequence_Fast_GET_ITEM(sequence, i), number)) {
      return false;
    }
    std::memcpy(place, &number, sizeof(T));
  }
  return true;
}

/// Write an array of uint8 given as bytes; as `struct` does, a fixed one is cut or filled up with zeros.
bool write_bytes(Writer& out, const Field& field, const char* data, Py_ssize_t size) {
  if (field.count == Field::VARIABLE) {
    return put_length(out, size) && out.put(data, static_cast<std::size_t>(size));
  }
  char* place = out.extend(static_cast<std::size_t>(field.count));
  if (place == nullptr) {
    return false;
  }
  const auto copied = static_cast<std::size_t>(std::min<Py_ssize_t>(size, field.count));
  std::memcpy(place, data, copied);
  std::memset(place + copied, 0, static_cast<std::size_t>(field.count) - copied);
  return true;
}

/// Pass the message's type to genpy's handler of invalid UTF-8, which names it in its warning.
bool announce(const char* type) {
  const Held handler(PyCodec_LookupError("rosmsg"));
  if (handler.get() == nullptr) {
    return false;
  }
  const Held text(PyUnicode_FromString(type));
  return text.get() != nullptr && PyObject_SetAttrString(handler.get(), "msg_type", text.get()) == 0;
}

PyObject* text_of(const char* data, std::size_t size, const char* type) {
  PyObject* text = PyUnicode_DecodeUTF8(data, static_cast<Py_ssize_t>(size), nullptr);
  if (text != nullptr || PyErr_ExceptionMatches(PyExc_UnicodeDecodeError) == 0) {
    return text;
  }
  PyErr_Clear();
  return announce(type) ? PyUnicode_DecodeUTF8(data, static_cast<Py_ssize_t>(size), "rosmsg") : nullptr;
}

/// Set the seconds and nanoseconds of a time from the next 8 bytes.
bool read_parts(Reader& in, Kind kind, PyObject* time, const TimeSlots& slots) {
  for (const Py_ssize_t offset : {slots.secs, slots.nsecs}) {
    PyObject* part = kind == Kind::TIME ? object_of(in.get<std::uint32_t>()) : object_of(in.get<std::int32_t>());
    if (part == nullptr) {
      return false;
    }
    set_slot(time, offset, part);
  }
  return true;
}

PyObject* read_time(Reader& in, const Field& field) {
  Held time(field.type->tp_alloc(field.type, 0));
  if (time.get() == nullptr || !read_parts(in, field.kind, time.get(), *time_slots(field.type))) {
    return nullptr;
  }
  return time.release();
}

template <class T>
PyObject* read_numbers(Reader& in, Py_ssize_t count) {
  // As genpy returns them: a list of bools, and a tuple of any other numbers.
  constexpr bool in_list = std::is_same_v<T, Flag>;
  Held array(in_list ? PyList_New(count) : PyTuple_New(count));
  if (array.get() == nullptr) {
    return nullptr;
  }
  for (Py_ssize_t i = 0; i < count; ++i) {
    PyObject* number = object_of(in.get<T>());
    if (number == nullptr) {
      return nullptr;
    }
    if constexpr (in_list) {
      PyList_SET_ITEM(array.get(), i, number);
    } else {
      PyTuple_SET_ITEM(array.get(), i, number);
    }
  }
  return array.release();
}

/// Clear the error of a value that is left to genpy's method; false if the value did not cause the error (Ctrl-C).
bool left_to_genpy() {
  if (PyErr_Occurred() == nullptr) {
    return true;
  }
  if (PyErr_ExceptionMatches(PyExc_Exception) == 0) {
    return false;
  }
  PyErr_Clear();
  return true;
}

}  // namespace

Codec::Codec(PyObject* type, std::string name, PyObject* error)
    : type_(reinterpret_cast<PyTypeObject*>(type)), name_(std::move(name)), error_(error) {
  Py_INCREF(type);
  Py_INCREF(error);
}

bool Codec::add_field(PyObject* name, const std::string& kind, int count, PyObject* type, const Codec* nested) {
  const auto found = KINDS.find(kind);
  if (found == KINDS.end() || (found->second == Kind::MESSAGE) != (nested != nullptr) || count < Field::SINGLE) {
    PyErr_Format(PyExc_ValueError, "%s.%U: %s is not a field type", name_.c_str(), name, kind.c_str());
    return false;
  }
  const char* text = PyUnicode_AsUTF8(name);
  if (text == nullptr) {
    return false;
  }
  const Py_ssize_t offset = slot_offset(type_, text);
  auto* value_type = is_time(found->second) ? reinterpret_cast<PyTypeObject*>(type) : nullptr;
  if (offset < 0 || (value_type != nullptr && (!PyType_Check(type) || time_slots(value_type) == nullptr))) {
    PyErr_Format(PyExc_TypeError, "%s.%U is not kept in slots", name_.c_str(), name);
    return false;
  }
  Py_XINCREF(reinterpret_cast<PyObject*>(value_type));
  Py_INCREF(name);
  PyUnicode_InternInPlace(&name);
  has_header_ |= std::string(text) == "header" && nested != nullptr && nested->name_ == "std_msgs/Header";
  fields_.push_back(
      {text, name, found->second, count, offset, value_type, nested, size_of_value(found->second, nested), nullptr});
  size_ += size_of_field(fields_.back());
  return true;
}

PyObject* Codec::encode(PyObject* message) const {
  Writer out(usual_size_);
  return finish(out, out.valid() && write(out, message));
}

PyObject* Codec::packet(PyObject* message, PyObject* sequence) const {
  Writer out(usual_size_);
  if (!out.valid() || !stamp(message, sequence) || !out.put(std::uint32_t{0}) || !write(out, message)) {
    return finish(out, false);
  }
  const std::size_t size = out.used() - sizeof(std::uint32_t);
  if (size > std::numeric_limits<std::uint32_t>::max()) {
    return finish(out, false);
  }
  const auto length = static_cast<std::uint32_t>(size);
  std::memcpy(out.start(), &length, sizeof(length));
  return finish(out, true);
}

PyObject* Codec::finish(Writer& out, bool complete) const {
  if (complete) {
    usual_size_ = std::max<std::size_t>(out.used(), 16);
    return out.take();
  }
  if (!left_to_genpy()) {
    return nullptr;
  }
  Py_RETURN_NONE;
}

/// Set the header as rospy does when a message is sent; false if that is left to rospy.
bool Codec::stamp(PyObject* message, PyObject* sequence) const {
  if (!has_header_ || !Py_IS_TYPE(message, type_)) {
    return true;
  }
  const auto field = std::find_if(fields_.begin(), fields_.end(), [](const Field& f) { return f.name == "header"; });
  PyObject* header = slot(message, field->offset);
  const Codec& codec = *field->nested;
  if (header == nullptr || !Py_IS_TYPE(header, codec.type_)) {
    return false;
  }
  const Held held = Held::borrowed(header);
  Py_INCREF(sequence);
  set_slot(header, codec.fields_[0].offset, sequence);
  if (slot(header, codec.fields_[2].offset) == Py_None) {
    PyObject* frame = PyUnicode_FromString("0");
    if (frame == nullptr) {
      return false;
    }
    set_slot(header, codec.fields_[2].offset, frame);
  }
  return true;
}

bool Codec::write(Writer& out, PyObject* message) const {
  if (!Py_IS_TYPE(message, type_)) {
    return false;
  }
  for (const Field& field : fields_) {
    PyObject* value = slot(message, field.offset);
    if (value == nullptr ||
        !(field.count == Field::SINGLE ? write_single(out, field, value) : write_array(out, field, value))) {
      return false;
    }
  }
  return true;
}

bool Codec::write_single(Writer& out, const Field& field, PyObject* value) const {
  switch (field.kind) {
    case Kind::STRING:
      return write_string(out, value);
    case Kind::TIME:
    case Kind::DURATION:
      return write_time(out, field.kind, value);
    case Kind::MESSAGE: {
      const Held held = Held::borrowed(value);
      return field.nested->write(out, value);
    }
    case Kind::FLOAT64: {
      double number = 0.0;
      return number_of(value, number) && out.put(number);
    }
    default:
      return with_number(field.kind, [&](auto number) { return number_of(value, number) && out.put(number); });
  }
}

bool Codec::write_array(Writer& out, const Field& field, PyObject* value) const {
  const bool in_sequence = PyList_CheckExact(value) || PyTuple_CheckExact(value);
  if (is_bytes(field) && !in_sequence) {
    if (PyBytes_Check(value)) {
      return write_bytes(out, field, PyBytes_AS_STRING(value), PyBytes_GET_SIZE(value));
    }
    return PyByteArray_Check(value) &&
           write_bytes(out, field, PyByteArray_AS_STRING(value), PyByteArray_GET_SIZE(value));
  }
  const Held held = Held::borrowed(value);  // __len__ may drop the message's reference
  const Py_ssize_t count = PyObject_Size(value);
  if (count < 0 || (field.count == Field::VARIABLE ? !put_length(out, count) : count != field.count)) {
    return false;
  }
  const Held sequence = in_sequence ? Held::borrowed(value) : Held(PySequence_List(value));
  if (sequence.get() == nullptr || PySequence_Fast_GET_SIZE(sequence.get()) != count) {
    return false;
  }
  if (is_number(field.kind)) {
    return with_number(field.kind,
                       [&](auto number) { return write_numbers<decltype(number)>(out, sequence.get(), count); });
  }
  for (Py_ssize_t i = 0; i < count; ++i) {
    if (PySequence_Fast_GET_SIZE(sequence.get()) != count ||
        !write_single(out, field, PySequence_Fast_GET_ITEM(sequence.get(), i))) {
      return false;
    }
  }
  return true;
}

PyObject* Codec::decode(PyObject* data) const {
  Py_buffer buffer;
  if (PyObject_GetBuffer(data, &buffer, PyBUF_SIMPLE) < 0) {
    return nullptr;
  }
  Reader in(static_cast<const char*>(buffer.buf), static_cast<std::size_t>(buffer.len), name_.c_str());
  Held message(create(in));
  PyBuffer_Release(&buffer);
  if (message.get() == nullptr || !canonical(message.get())) {
    return nullptr;
  }
  return message.release();
}

int Codec::fill(PyObject* message, PyObject* data) const {
  if (!Py_IS_TYPE(message, type_) || !PyBytes_CheckExact(data)) {
    return 0;
  }
  Reader in(PyBytes_AS_STRING(data), static_cast<std::size_t>(PyBytes_GET_SIZE(data)), name_.c_str());
  if (!read(in, message, false) || !canonical(message)) {
    return PyErr_Occurred() == nullptr ? 0 : -1;
  }
  return 1;
}

/// Return a new message without calling its constructor, whose values would all be replaced.
PyObject* Codec::create(Reader& in) const {
  Held message(type_->tp_alloc(type_, 0));
  if (message.get() == nullptr || !read(in, message.get(), true)) {
    return nullptr;
  }
  return message.release();
}

/// Read all fields; false with a Python error, or without one if an object to be filled is of an unknown type.
bool Codec::read(Reader& in, PyObject* message, bool fresh) const {
  for (const Field& field : fields_) {
    if (in.left() < size_of_field(field)) {
      PyErr_Format(error_, "%s: %s.%s takes at least %zu bytes, %zu are left", in.type(), name_.c_str(),
                   field.name.c_str(), size_of_field(field), in.left());
      return false;
    }
    if (!read_field(in, field, message, fresh)) {
      return false;
    }
  }
  return true;
}

bool Codec::read_field(Reader& in, const Field& field, PyObject* message, bool fresh) const {
  if (!fresh && field.count == Field::SINGLE && (is_time(field.kind) || field.kind == Kind::MESSAGE)) {
    PyObject* present = slot(message, field.offset);
    if (present != nullptr && present != Py_None) {
      const Held held = Held::borrowed(present);
      if (field.kind == Kind::MESSAGE) {
        return Py_IS_TYPE(present, field.nested->type_) && field.nested->read(in, present, false);
      }
      const TimeSlots* slots = time_slots(Py_TYPE(present));
      return slots != nullptr && read_parts(in, field.kind, present, *slots);
    }
  }
  PyObject* value = field.count == Field::SINGLE ? read_element(in, field) : read_array(in, field);
  if (value == nullptr) {
    return false;
  }
  set_slot(message, field.offset, value);
  return true;
}

PyObject* Codec::read_element(Reader& in, const Field& field) const {
  switch (field.kind) {
    case Kind::FLOAT64:
      return object_of(in.get<double>());
    case Kind::STRING: {
      const std::size_t length = in.get<std::uint32_t>();
      if (length > in.left()) {
        PyErr_Format(error_, "%s: %s.%s has %zu bytes, %zu are left", in.type(), name_.c_str(), field.name.c_str(),
                     length, in.left());
        return nullptr;
      }
      return text_of(in.skip(length), length, in.type());
    }
    case Kind::TIME:
    case Kind::DURATION:
      return read_time(in, field);
    case Kind::MESSAGE:
      return field.nested->create(in);
    default:
      return with_number(field.kind, [&](auto number) { return object_of(in.get<decltype(number)>()); });
  }
}

PyObject* Codec::read_array(Reader& in, const Field& field) const {
  std::size_t count = static_cast<std::size_t>(field.count);
  if (field.count == Field::VARIABLE) {
    count = in.get<std::uint32_t>();
    const std::size_t most = field.size == 0 ? MOST_EMPTY_ELEMENTS : in.left() / field.size;
    if (count > most) {
      PyErr_Format(error_, "%s: %s.%s has %zu elements, %zu bytes are left", in.type(), name_.c_str(),
                   field.name.c_str(), count, in.left());
      return nullptr;
    }
  }
  const auto length = static_cast<Py_ssize_t>(count);
  if (is_bytes(field)) {
    return PyBytes_FromStringAndSize(in.skip(count), length);
  }
  if (is_number(field.kind)) {
    return with_number(field.kind, [&](auto number) { return read_numbers<decltype(number)>(in, length); });
  }
  Held list(PyList_New(length));
  if (list.get() == nullptr) {
    return nullptr;
  }
  for (Py_ssize_t i = 0; i < length; ++i) {
    if (in.left() < field.size) {
      PyErr_Format(error_, "%s: %s.%s[%zd] takes at least %zu bytes, %zu are left", in.type(), name_.c_str(),
                   field.name.c_str(), i, field.size, in.left());
      return nullptr;
    }
    PyObject* element = read_element(in, field);
    if (element == nullptr) {
      return nullptr;
    }
    PyList_SET_ITEM(list.get(), i, element);
  }
  return list.release();
}

/// Carry nanoseconds beyond a second into the seconds, as genpy does in the outermost message's own times alone.
bool Codec::canonical(PyObject* message) const {
  for (const Field& field : fields_) {
    if (!is_time(field.kind) || field.count != Field::SINGLE) {
      continue;
    }
    PyObject* time = slot(message, field.offset);
    const TimeSlots* slots = time == nullptr ? nullptr : time_slots(Py_TYPE(time));
    PyObject* part = slots == nullptr ? nullptr : slot(time, slots->nsecs);
    if (part == nullptr) {
      continue;  // removed concurrently
    }
    std::int64_t nanoseconds = -1;
    if (PyLong_Check(part) && number_of(part, nanoseconds) && nanoseconds >= 0 && nanoseconds < 1'000'000'000) {
      continue;
    }
    const Held held = Held::borrowed(time);
    const Held result(PyObject_CallMethod(time, "canon", nullptr));
    if (result.get() == nullptr) {
      return false;
    }
  }
  return true;
}

}  // namespace xtdrone::ros_codec
