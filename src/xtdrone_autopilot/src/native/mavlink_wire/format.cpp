#include "format.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <limits>

#include "checksum.h"

namespace mavlink_wire {
namespace {
std::size_t size_of(char kind) {
  switch (kind) {
    case 'b':
    case 'B':
      return 1;
    case 'h':
    case 'H':
      return 2;
    case 'i':
    case 'I':
    case 'f':
      return 4;
    case 'q':
    case 'Q':
    case 'd':
      return 8;
    default:
      throw nb::value_error("a format of MAVLink has the types b B h H i I q Q f d s");
  }
}

template <typename Number>
bool store(Number number, std::uint8_t* out) {
  std::memcpy(out, &number, sizeof(number));
  return true;
}

bool store_real(PyObject* value, bool is_double, std::uint8_t* out) {
  double number;
  if (PyFloat_Check(value)) {
    number = PyFloat_AS_DOUBLE(value);
  } else if (PyLong_CheckExact(value)) {
    number = PyLong_AsDouble(value);
    if (number == -1.0 && PyErr_Occurred()) return false;
  } else {
    return false;
  }
  if (is_double) return store(number, out);
  const auto narrow = static_cast<float>(number);
  return !(std::isinf(narrow) && !std::isinf(number)) && store(narrow, out);
}

template <typename Number>
bool store_integer(PyObject* value, std::uint8_t* out) {
  if (!PyLong_Check(value)) return false;
  int overflow = 0;
  const long long number = PyLong_AsLongLongAndOverflow(value, &overflow);
  if (overflow != 0 || number < static_cast<long long>(std::numeric_limits<Number>::min()) ||
      number > static_cast<long long>(std::numeric_limits<Number>::max())) {
    return false;
  }
  return store(static_cast<Number>(number), out);
}

bool store_unsigned_64(PyObject* value, std::uint8_t* out) {
  if (!PyLong_Check(value)) return false;
  const unsigned long long number = PyLong_AsUnsignedLongLong(value);
  if (number == static_cast<unsigned long long>(-1) && PyErr_Occurred()) return false;
  return store<std::uint64_t>(number, out);
}

bool store_text(PyObject* value, std::size_t size, std::uint8_t* out) {
  if (!PyBytes_Check(value)) return false;
  const auto length = std::min<std::size_t>(size, static_cast<std::size_t>(PyBytes_GET_SIZE(value)));
  std::memcpy(out, PyBytes_AS_STRING(value), length);
  return true;
}

bool store_value(const Field& field, PyObject* value, std::uint8_t* out) {
  switch (field.kind) {
    case 'b':
      return store_integer<std::int8_t>(value, out);
    case 'B':
      return store_integer<std::uint8_t>(value, out);
    case 'h':
      return store_integer<std::int16_t>(value, out);
    case 'H':
      return store_integer<std::uint16_t>(value, out);
    case 'i':
      return store_integer<std::int32_t>(value, out);
    case 'I':
      return store_integer<std::uint32_t>(value, out);
    case 'q':
      return store_integer<std::int64_t>(value, out);
    case 'Q':
      return store_unsigned_64(value, out);
    case 'f':
      return store_real(value, false, out);
    case 'd':
      return store_real(value, true, out);
    default:
      return store_text(value, field.size, out);
  }
}

template <typename Number>
Number load(const std::uint8_t* data) {
  Number number;
  std::memcpy(&number, data, sizeof(number));
  return number;
}
}  // namespace

Format::Format(std::uint32_t number, std::uint8_t crc_extra, const std::string& fields)
    : number_(number), crc_extra_(crc_extra) {
  std::size_t count = 0;
  bool counted = false;
  const auto add = [&](char kind, std::size_t size) {
    if (size_ + size > kLargestPayload) throw nb::value_error("a payload of MAVLink has at most 255 bytes");
    fields_.push_back({kind, static_cast<std::uint16_t>(size_), static_cast<std::uint16_t>(size)});
    size_ += size;
  };
  for (const char c : fields) {
    if (c == '<') continue;
    if (std::isdigit(static_cast<unsigned char>(c))) {
      count = std::min<std::size_t>(10 * count + static_cast<std::size_t>(c - '0'), kLargestPayload + 1);
      counted = true;
      continue;
    }
    const std::size_t repeated = counted ? count : 1;
    if (c == 's') {
      add(c, repeated);
    } else {
      for (std::size_t i = 0; i < repeated; ++i) add(c, size_of(c));
    }
    count = 0;
    counted = false;
  }
  if (fields_.empty()) throw nb::value_error("a payload of MAVLink has at least one field");
}

nb::object Format::payload(nb::handle values) const {
  PyObject* const* items;
  Py_ssize_t count;
  if (PyTuple_Check(values.ptr())) {
    items = &PyTuple_GET_ITEM(values.ptr(), 0);
    count = PyTuple_GET_SIZE(values.ptr());
  } else if (PyList_Check(values.ptr())) {
    items = PySequence_Fast_ITEMS(values.ptr());
    count = PyList_GET_SIZE(values.ptr());
  } else {
    return nb::none();
  }
  if (static_cast<std::size_t>(count) != fields_.size()) return nb::none();
  std::uint8_t data[kLargestPayload] = {};
  for (std::size_t i = 0; i < fields_.size(); ++i) {
    if (!store_value(fields_[i], items[i], data + fields_[i].offset)) {
      PyErr_Clear();
      return nb::none();
    }
  }
  return to_bytes(data, truncated(data, size_));
}

std::size_t Format::write(const std::uint8_t* payload, std::size_t size, std::uint8_t sequence, std::uint8_t system,
                          std::uint8_t component, std::uint8_t* frame) const {
  const std::uint8_t header[kHeader2] = {kMagic2,
                                         static_cast<std::uint8_t>(size),
                                         0,
                                         0,
                                         sequence,
                                         system,
                                         component,
                                         static_cast<std::uint8_t>(number_),
                                         static_cast<std::uint8_t>(number_ >> 8),
                                         static_cast<std::uint8_t>(number_ >> 16)};
  std::memcpy(frame, header, kHeader2);
  std::memcpy(frame + kHeader2, payload, size);
  const std::size_t end = kHeader2 + size;
  const std::uint16_t crc = checksum(&crc_extra_, 1, checksum(frame + 1, end - 1));
  frame[end] = static_cast<std::uint8_t>(crc);
  frame[end + 1] = static_cast<std::uint8_t>(crc >> 8);
  return end + kChecksumSize;
}

nb::bytes Format::frame(nb::bytes payload, std::uint8_t sequence, std::uint8_t system, std::uint8_t component) const {
  if (payload.size() > kLargestPayload) throw nb::value_error("a payload of MAVLink has at most 255 bytes");
  std::uint8_t data[kLargestFrame];
  const auto* bytes = static_cast<const std::uint8_t*>(payload.data());
  return to_bytes(data, write(bytes, payload.size(), sequence, system, component, data));
}

PyObject* Format::value(std::size_t index, const std::uint8_t* payload) const {
  const Field& field = fields_[index];
  const std::uint8_t* data = payload + field.offset;
  switch (field.kind) {
    case 'b':
      return PyLong_FromLong(load<std::int8_t>(data));
    case 'B':
      return PyLong_FromLong(*data);
    case 'h':
      return PyLong_FromLong(load<std::int16_t>(data));
    case 'H':
      return PyLong_FromLong(load<std::uint16_t>(data));
    case 'i':
      return PyLong_FromLong(load<std::int32_t>(data));
    case 'I':
      return PyLong_FromUnsignedLong(load<std::uint32_t>(data));
    case 'q':
      return PyLong_FromLongLong(load<std::int64_t>(data));
    case 'Q':
      return PyLong_FromUnsignedLongLong(load<std::uint64_t>(data));
    case 'f':
      return PyFloat_FromDouble(static_cast<double>(load<float>(data)));
    case 'd':
      return PyFloat_FromDouble(load<double>(data));
    default:
      return PyBytes_FromStringAndSize(reinterpret_cast<const char*>(data), field.size);
  }
}

namespace {
/// Decodes the frames of one message into named tuples.
class Decoder {
 public:
  Decoder(const Format& format, std::string name, nb::type_object record, const std::vector<std::size_t>& lengths,
          nb::object error)
      : format_(format),
        name_(std::move(name)),
        record_(std::move(record)),
        lengths_(lengths),
        error_(std::move(error)) {
    std::size_t values = 0;
    for (const std::size_t length : lengths_) values += length;
    if (values != format_.count() || !PyType_IsSubtype(type(), &PyTuple_Type)) {
      throw nb::value_error("the record must be a tuple with the fields of the format");
    }
  }

  nb::object decode(nb::bytes frame) const {
    const auto* data = static_cast<const std::uint8_t*>(frame.data());
    const std::size_t size = frame.size();
    const std::size_t start = size > 0 && data[0] == kMagic2 ? kHeader2 : kHeader1;
    const std::size_t end = size > 1 ? start + data[1] : size;
    if (end + kChecksumSize > size) fail("frame is truncated");
    const std::uint8_t extra = format_.crc_extra();
    const std::uint16_t crc = checksum(&extra, 1, checksum(data + 1, end - 1));
    if (crc != (data[end] | data[end + 1] << 8)) fail("CRC is wrong");
    // MAVLink 2 truncates trailing zeros, MAVLink 1 has no extension fields, a newer dialect more of them
    if (end - start >= format_.size()) return record(data + start);
    std::uint8_t payload[kLargestPayload] = {};
    std::memcpy(payload, data + start, end - start);
    return record(payload);
  }

 private:
  PyTypeObject* type() const { return reinterpret_cast<PyTypeObject*>(record_.ptr()); }

  [[noreturn]] void fail(const char* reason) const {
    PyErr_Format(error_.ptr(), "%s: %s", name_.c_str(), reason);
    throw nb::python_error();
  }

  nb::object record(const std::uint8_t* payload) const {
    const auto count = static_cast<Py_ssize_t>(lengths_.size());
    nb::object made = nb::steal(type()->tp_alloc(type(), count));
    if (!made.is_valid()) throw nb::python_error();
    std::size_t next = 0;
    for (Py_ssize_t i = 0; i < count; ++i) {
      const std::size_t length = lengths_[static_cast<std::size_t>(i)];
      PyObject* value = length == 1 ? format_.value(next, payload) : array(next, length, payload);
      if (value == nullptr) throw nb::python_error();
      PyTuple_SET_ITEM(made.ptr(), i, value);
      next += length;
    }
    return made;
  }

  PyObject* array(std::size_t first, std::size_t length, const std::uint8_t* payload) const {
    PyObject* values = PyTuple_New(static_cast<Py_ssize_t>(length));
    if (values == nullptr) return nullptr;
    for (std::size_t i = 0; i < length; ++i) {
      PyObject* value = format_.value(first + i, payload);
      if (value == nullptr) {
        Py_DECREF(values);
        return nullptr;
      }
      PyTuple_SET_ITEM(values, static_cast<Py_ssize_t>(i), value);
    }
    return values;
  }

  Format format_;
  std::string name_;
  nb::type_object record_;
  std::vector<std::size_t> lengths_;
  nb::object error_;
};
}  // namespace

void bind_format(nb::module_& module) {
  nb::class_<Format>(module, "Format", "Wire format of one message.")
      .def(nb::init<std::uint32_t, std::uint8_t, const std::string&>(), nb::arg("number"), nb::arg("crc_extra"),
           nb::arg("fields"))
      .def("payload", &Format::payload, nb::arg("values"))
      .def("frame", &Format::frame, nb::arg("payload"), nb::arg("sequence"), nb::arg("system"), nb::arg("component"));
  nb::class_<Decoder>(module, "Decoder", "Decodes the frames of one message into named tuples.")
      .def(nb::init<const Format&, std::string, nb::type_object, const std::vector<std::size_t>&, nb::object>(),
           nb::arg("format"), nb::arg("name"), nb::arg("record"), nb::arg("lengths"), nb::arg("error"))
      .def("decode", &Decoder::decode, nb::arg("frame"));
}
}  // namespace mavlink_wire
