#include "frames.h"

#include <nanobind/nanobind.h>

#include "waiting.h"

namespace nb = nanobind;

namespace xtdrone_lockstep::io {
namespace {

std::size_t sizeOf(PyObject* dict) { return dict == nullptr ? 0 : static_cast<std::size_t>(PyDict_GET_SIZE(dict)); }

/// Append a frame up to its pairs, and return the place for these.
char* packHead(std::string& frames, Kind kind, std::uint64_t tick, std::int64_t time_us, std::size_t channels,
               std::size_t ports) {
  const std::size_t start = frames.size();
  const std::size_t size = HEAD + BARRIER + PAIR * (channels + ports);
  frames.resize(start + size);
  char* to = frames.data() + start;
  store(to, static_cast<std::uint32_t>(size - 4));
  store(to, kind);
  store(to, tick);
  store(to, time_us);
  store(to, static_cast<std::uint32_t>(channels));
  store(to, static_cast<std::uint32_t>(ports));
  return to;
}

void packPairs(char*& to, PyObject* dict) {
  PyObject* key;
  PyObject* value;
  for (Py_ssize_t at = 0; dict != nullptr && PyDict_Next(dict, &at, &key, &value) != 0;) {
    const unsigned long id = PyLong_AsUnsignedLong(key);
    const unsigned long long count = PyLong_AsUnsignedLongLong(value);
    require(PyErr_Occurred() == nullptr);
    if (id > UINT32_MAX) {
      PyErr_SetString(PyExc_OverflowError, "the id of a pair exceeds 32 bits");
      throw nb::python_error();
    }
    store(to, static_cast<std::uint32_t>(id));
    store(to, std::uint64_t{count});
  }
}

}  // namespace

bool setNumber(PyObject* dict, PyObject* key, std::uint64_t value) {
  const nb::object number = nb::steal(PyLong_FromUnsignedLongLong(value));
  return number.is_valid() && PyDict_SetItem(dict, key, number.ptr()) == 0;
}

PyObject* pairsOf(const Barrier& barrier, std::size_t begin, std::size_t end) {
  nb::object pairs = nb::steal(PyDict_New());
  for (std::size_t i = begin; pairs.is_valid() && i < end; ++i) {
    const nb::object id = nb::steal(PyLong_FromUnsignedLong(barrier.id(i)));
    if (!id.is_valid() || !setNumber(pairs.ptr(), id.ptr(), barrier.count(i))) {
      return nullptr;
    }
  }
  return pairs.release().ptr();
}

void pack(std::string& frames, Kind kind, std::uint64_t tick, std::int64_t time_us, PyObject* channels,
          PyObject* ports) {
  char* to = packHead(frames, kind, tick, time_us, sizeOf(channels), sizeOf(ports));
  packPairs(to, channels);
  packPairs(to, ports);
}

void packDone(std::string& frames, std::uint64_t tick, std::int64_t time_us,
              const std::vector<std::pair<std::uint32_t, std::uint64_t>>& channels) {
  char* to = packHead(frames, Kind::DONE, tick, time_us, channels.size(), 0);
  for (const auto& [id, count] : channels) {
    store(to, id);
    store(to, count);
  }
}

}  // namespace xtdrone_lockstep::io
