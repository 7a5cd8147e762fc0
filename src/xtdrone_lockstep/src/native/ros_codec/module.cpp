// ROS 1 messages to and from bytes, working directly on the slots of genpy's message objects.

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include "codec.h"

namespace nb = nanobind;

namespace {
using xtdrone::ros_codec::Codec;

nb::object stolen_or_raise(PyObject* object) {
  if (object == nullptr) {
    throw nb::python_error();
  }
  return nb::steal(object);
}

void add_field(Codec& codec, nb::str name, const std::string& kind, int count, nb::handle type, const Codec* nested) {
  if (!codec.add_field(name.ptr(), kind, count, type.ptr(), nested)) {
    throw nb::python_error();
  }
}

bool fill(const Codec& codec, nb::handle message, nb::handle data) {
  const int result = codec.fill(message.ptr(), data.ptr());
  if (result < 0) {
    throw nb::python_error();
  }
  return result != 0;
}

void construct_like(nb::handle_t<Codec> codec, nb::handle message) {
  if (!nb::cast<Codec&>(codec).construct_like(message.ptr())) {
    throw nb::python_error();
  }
  codec.inc_ref();  // the class, which lives on without this module, refers to it
}
}  // namespace

NB_MODULE(ros_codec, module) {
  // Codecs live as long as the message classes, which refer to them: until the interpreter ends.
  nb::set_leak_warnings(false);
  nb::class_<Codec>(module, "Codec")
      .def(
          "__init__",
          [](Codec* codec, nb::type_object type, const std::string& name, nb::handle error) {
            new (codec) Codec(type.ptr(), name, error.ptr());
          },
          nb::arg("type"), nb::arg("name"), nb::arg("error"),
          "Create the codec of a message class without fields.\n\n"
          "Args:\n"
          "    type: The class; its fields are slots.\n"
          "    name: The message's type, such as ``geometry_msgs/Pose``.\n"
          "    error: Exception raised for data that are not a message of this type.")
      .def("add_field", &add_field, nb::arg("name"), nb::arg("kind"), nb::arg("count"), nb::arg("type").none(),
           nb::arg("nested").none(), nb::keep_alive<1, 6>(),
           "Append a field, in the order of the message's definition.\n\n"
           "Args:\n"
           "    name: Its slot.\n"
           "    kind: A built-in type of ROS (without brackets), or ``message``.\n"
           "    count: Elements of an array; -1 for a variable number, -2 if the field is not an array.\n"
           "    type: Class of the values of a time or duration; else None.\n"
           "    nested: Codec of the values of a message; else None.\n\n"
           "Raises:\n"
           "    TypeError: A class lacks the slot.\n"
           "    ValueError: The kind is unknown.")
      .def("construct_like", &construct_like, nb::arg("message"),
           "Let calls of the class create objects without its constructor.\n\n"
           "Args:\n"
           "    message: A message as the constructor makes it; the nested classes must have been treated alike.")
      .def(
          "encode", [](const Codec& codec, nb::handle message) { return stolen_or_raise(codec.encode(message.ptr())); },
          nb::arg("message"), nb::sig("def encode(self, message: object) -> bytes | None"),
          "Return the bytes of a message; None if a value is of a type or range that only genpy's method handles.")
      .def(
          "packet",
          [](const Codec& codec, nb::handle message, nb::handle sequence) {
            return stolen_or_raise(codec.packet(message.ptr(), sequence.ptr()));
          },
          nb::arg("message"), nb::arg("sequence"),
          nb::sig("def packet(self, message: object, sequence: int) -> bytes | None"),
          "Return a message as sent over TCPROS: like ``encode``, after its length (uint32).\n\n"
          "As rospy does, the header of a message gets the sequence number, and the frame ``0`` instead of None.")
      .def(
          "decode", [](const Codec& codec, nb::handle data) { return stolen_or_raise(codec.decode(data.ptr())); },
          nb::arg("data"), nb::sig("def decode(self, data: Buffer) -> typing.Any"),
          "Return a new message with the values of its bytes; the given error if they are too short.")
      .def("fill", &fill, nb::arg("message"), nb::arg("data"),
           nb::sig("def fill(self, message: object, data: bytes) -> bool"),
           "Set the fields of a message from its bytes; the given error if they are too short.\n\n"
           "Returns:\n"
           "    False if the message or a nested object is of a type that only genpy's method handles.");
}
