// Payloads of the telemetry messages with high rates, built from the autopilot's records.
//
// Results equal those of Python's float arithmetic and of module math to the last bit: a flight is the same whichever
// of them builds the payload. math.hypot, whose result differs from the C library's, is called in Python.

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cmath>
#include <limits>
#include <optional>

#include "format.h"

namespace mavlink_wire {
namespace {
constexpr double kPi = 3.141592653589793;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInt16 = 32767.0;
constexpr double kMillimetres = 1 << 30;  // limit of altitudes
constexpr std::uint16_t kImuFields = 0x3F;
constexpr std::uint16_t kMagFields = 0x1C0;
constexpr std::uint16_t kBaroFields = 0x1E00;
constexpr std::uint8_t kFrameLocalNed = 1;
constexpr std::uint8_t kEstimatorAutopilot = 8;
constexpr std::uint16_t kDisarmedPulse = 900;
constexpr std::uint16_t kLeastPulse = 1000;
constexpr std::size_t kServos = 8;
constexpr std::size_t kMatrix = 21;  // upper triangle of a 6 x 6 matrix, row by row
constexpr std::size_t kDiagonal[] = {0, 6, 11, 15, 18, 20};

[[noreturn]] void reject(const char* reason) { throw nb::value_error(reason); }

/// Round half to even, as Python does.
double rounded(double value) {
  if (std::isnan(value)) reject("cannot convert float NaN to integer");
  if (std::isinf(value)) reject("cannot convert float infinity to integer");
  return std::nearbyint(value);
}

/// Round and clamp to -limit..limit; 0 for NaN.
double clamped(double value, double limit) {
  if (-limit < value && value < limit) return std::nearbyint(value);
  return std::isnan(value) ? 0.0 : std::copysign(limit, value);
}

double unsigned_clamped(double value, double limit) { return std::max(clamped(value, limit), 0.0); }

double degrees(double radians) { return radians * (180.0 / kPi); }

double radians(double degrees) { return degrees * (kPi / 180.0); }

double sine(double angle) {
  if (std::isinf(angle)) reject("math domain error");
  return std::sin(angle);
}

double cosine(double angle) {
  if (std::isinf(angle)) reject("math domain error");
  return std::cos(angle);
}

/// As math.atan2, whose NaN is positive.
double arctangent(double y, double x) { return std::isnan(y) || std::isnan(x) ? kNan : std::atan2(y, x); }

/// Limit to -1..1 as Python's max(-1.0, min(1.0, value)) does: NaN becomes 1.
double unit(double value) {
  const double least = value < 1.0 ? value : 1.0;
  return least > -1.0 ? least : -1.0;
}

/// Angle in 0..360 degrees, as Python's `%` returns it.
double full_turn(double angle) {
  const double rest = std::fmod(angle, 360.0);
  if (rest == 0.0) return 0.0;
  return rest < 0.0 ? rest + 360.0 : rest;
}

double python_hypot(double x, double y) {
  static PyObject* const hypot = nb::object(nb::module_::import_("math").attr("hypot")).release().ptr();
  return nb::cast<double>(nb::handle(hypot)(x, y));
}

/// A payload being written.
class Payload {
 public:
  template <typename Number>
  Payload& add(Number number) {
    std::memcpy(data_ + size_, &number, sizeof(number));
    size_ += sizeof(number);
    return *this;
  }

  Payload& real(double value) {
    const auto narrow = static_cast<float>(value);
    if (std::isinf(narrow) && !std::isinf(value)) reject("float too large to pack with f format");
    return add(narrow);
  }

  Payload& reals(const double* values, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) real(values[i]);
    return *this;
  }

  Payload& milliseconds(std::uint64_t value) {
    if (value > std::numeric_limits<std::uint32_t>::max()) reject("'I' format requires 0 <= number <= 4294967295");
    return add(static_cast<std::uint32_t>(value));
  }

  Payload& whole(double value) {
    if (!(value >= -2147483648.0 && value <= 2147483647.0)) {
      reject("'i' format requires -2147483648 <= number <= 2147483647");
    }
    return add(static_cast<std::int32_t>(value));
  }

  Payload& small(double value) { return add(static_cast<std::int16_t>(value)); }

  Payload& diagonal(const double* first, const double* second, std::size_t step) {
    double values[kMatrix] = {};
    for (std::size_t i = 0; i < 3; ++i) {
      values[kDiagonal[i]] = first[i * step];
      values[kDiagonal[i + 3]] = second[i * step];
    }
    return reals(values, kMatrix);
  }

  nb::bytes finish() const { return to_bytes(data_, truncated(data_, size_)); }

 private:
  std::uint8_t data_[kLargestPayload] = {};
  std::size_t size_ = 0;
};

/// Numbers of a record, shared with a NumPy array.
template <typename Number>
class View {
 public:
  View(nb::dict fields, const char* name, std::size_t count) {
    static_assert(std::is_same_v<Number, double> || std::is_same_v<Number, std::int32_t>);
    const nb::object array = nb::borrow(fields[name]);
    if (PyObject_GetBuffer(array.ptr(), &buffer_, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) != 0) throw nb::python_error();
    const bool right = std::string(buffer_.format) == (std::is_same_v<Number, double> ? "d" : "i");
    if (!right || static_cast<std::size_t>(buffer_.len) != count * sizeof(Number)) {
      PyBuffer_Release(&buffer_);
      throw nb::value_error((std::string("field ") + name + " has another type or size").c_str());
    }
  }
  View(const View&) = delete;
  View& operator=(const View&) = delete;
  ~View() { PyBuffer_Release(&buffer_); }

  const Number* data() const { return static_cast<const Number*>(buffer_.buf); }
  Number operator[](std::size_t index) const { return data()[index]; }
  Number operator*() const { return *data(); }

 private:
  Py_buffer buffer_{};
};

using Reals = View<double>;
using Integers = View<std::int32_t>;

/// Samples in the last HIGHRES_IMU on a link.
struct Samples {
  bool sent = false;
  double mag[3] = {};
  double baro = 0.0;
};

/// Telemetry of one vehicle.
class Telemetry {
 public:
  Telemetry(nb::dict fields, std::size_t states, double earth_radius)
      : q_(fields, "q", 4),
        position_(fields, "position", 3),
        velocity_(fields, "velocity", 3),
        rates_(fields, "rates", 3),
        covariance_(fields, "P", states * states),
        origin_(fields, "origin_lat", 1),
        origin_lon_(fields, "origin_lon", 1),
        origin_alt_(fields, "origin_alt", 1),
        terrain_(fields, "terrain", 1),
        accel_(fields, "accel", 3),
        gyro_(fields, "gyro", 3),
        mag_(fields, "mag", 3),
        baro_pressure_(fields, "baro_pressure", 1),
        baro_alt_(fields, "baro_alt", 1),
        baro_temperature_(fields, "baro_temperature", 1),
        sp_q_(fields, "sp_q", 4),
        sp_rates_(fields, "sp_rates", 3),
        sp_thrust_(fields, "sp_thrust", 1),
        sp_position_(fields, "sp_position", 3),
        sp_velocity_(fields, "sp_velocity", 3),
        sp_acceleration_(fields, "sp_acceleration", 3),
        sp_yaw_(fields, "sp_yaw", 1),
        sp_yaw_rate_(fields, "sp_yaw_rate", 1),
        actuators_(fields, "actuators", kServos),
        initialised_(fields, "initialised", 1),
        altitude_valid_(fields, "altitude_valid", 1),
        origin_set_(fields, "origin_set", 1),
        terrain_valid_(fields, "terrain_valid", 1),
        reset_counter_(fields, "reset_counter", 1),
        step_(states + 1),
        earth_radius_(earth_radius) {
    if (states < 12) throw nb::value_error("the covariance has too few states");
  }

  void refresh(std::uint64_t now_us) {
    time_us = now_us;
    aligned = aligned || *initialised_ != 0;
    located = located || *altitude_valid_ != 0;
  }

  std::optional<nb::bytes> attitude() const {
    if (!aligned) return std::nullopt;
    const double w = q_[0], x = q_[1], y = q_[2], z = q_[3];
    const double roll = arctangent(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y));
    const double pitch = std::asin(unit(2.0 * (w * y - z * x)));
    return begin_ms().real(roll).real(pitch).real(yaw()).reals(rates_.data(), 3).finish();
  }

  std::optional<nb::bytes> attitude_quaternion() const {
    if (!aligned) return std::nullopt;
    const double offset[4] = {};
    return begin_ms().reals(q_.data(), 4).reals(rates_.data(), 3).reals(offset, 4).finish();
  }

  std::optional<nb::bytes> local_position_ned() const {
    if (!located) return std::nullopt;
    return begin_ms().reals(position_.data(), 3).reals(velocity_.data(), 3).finish();
  }

  /// @param home_z down coordinate of home, if it is set
  nb::bytes global_position_int(std::optional<double> home_z) const {
    double latitude = *origin_, longitude = *origin_lon_;
    reproject(latitude, longitude);
    Payload payload = begin_ms();
    payload.whole(rounded(latitude * 1e7)).whole(rounded(longitude * 1e7));
    payload.whole(clamped(above_sea() * 1e3, kMillimetres)).whole(clamped(over_home(home_z) * 1e3, kMillimetres));
    for (std::size_t i = 0; i < 3; ++i) payload.small(clamped(velocity_[i] * 100.0, kInt16));
    return payload.add(static_cast<std::uint16_t>(finite(heading() * 100.0))).finish();
  }

  nb::bytes altitude(std::optional<double> home_z) const {
    const double sea = *origin_set_ != 0 ? above_sea() : kNan;
    double ground = kNan, clearance = kNan;
    if (*terrain_valid_ != 0) {
      clearance = *terrain_ - position_[2];
      ground = sea - clearance;
    }
    Payload payload = begin_us();
    payload.real(sea).real(sea).real(-position_[2]).real(over_home(home_z)).real(ground).real(clearance);
    return payload.finish();
  }

  nb::bytes vfr_hud(bool armed) const {
    const double throttle = armed ? unsigned_clamped(100.0 * *sp_thrust_, 100.0) : 0.0;
    const double speed = python_hypot(velocity_[0], velocity_[1]);
    Payload payload;
    payload.real(0.0).real(speed).real(above_sea()).real(-velocity_[2]);
    return payload.small(finite(heading())).add(static_cast<std::uint16_t>(throttle)).finish();
  }

  std::optional<nb::bytes> odometry() const {
    if (!located) return std::nullopt;
    const double* p = covariance_.data();
    Payload payload = begin_us();
    payload.reals(position_.data(), 3).reals(q_.data(), 4).reals(velocity_.data(), 3).reals(rates_.data(), 3);
    payload.diagonal(p + 6 * step_, p, step_).diagonal(p + 3 * step_, p + 9 * step_, step_);
    payload.add(kFrameLocalNed).add(kFrameLocalNed).add(static_cast<std::uint8_t>(*reset_counter_));
    return payload.add(kEstimatorAutopilot).finish();
  }

  nb::bytes highres_imu(Samples& last) const {
    const bool new_mag = !last.sent || std::memcmp(last.mag, mag_.data(), sizeof(last.mag)) != 0;
    const bool new_baro = !last.sent || last.baro != *baro_pressure_;
    last.sent = true;
    std::memcpy(last.mag, mag_.data(), sizeof(last.mag));
    last.baro = *baro_pressure_;
    const int updated = kImuFields | (new_mag ? kMagFields : 0) | (new_baro ? kBaroFields : 0);
    Payload payload = begin_us();
    payload.reals(accel_.data(), 3).reals(gyro_.data(), 3).reals(mag_.data(), 3);
    payload.real(*baro_pressure_ * 0.01).real(0.0).real(*baro_alt_).real(*baro_temperature_);
    return payload.add(static_cast<std::uint16_t>(updated)).finish();
  }

  nb::bytes attitude_target() const {
    return begin_ms().reals(sp_q_.data(), 4).reals(sp_rates_.data(), 3).real(*sp_thrust_).finish();
  }

  nb::bytes position_target_local_ned() const {
    Payload payload = begin_ms();
    int mask = 0, bit = 0;
    for (const Reals* vector : {&sp_position_, &sp_velocity_, &sp_acceleration_}) {
      payload.reals(vector->data(), 3);
      for (std::size_t i = 0; i < 3; ++i, ++bit) mask |= std::isnan((*vector)[i]) ? 1 << bit : 0;
    }
    mask |= (std::isnan(*sp_yaw_) ? 1 << 10 : 0) | (std::isnan(*sp_yaw_rate_) ? 1 << 11 : 0);
    payload.real(*sp_yaw_).real(*sp_yaw_rate_);
    return payload.add(static_cast<std::uint16_t>(mask)).add(kFrameLocalNed).finish();
  }

  nb::bytes servo_output_raw(bool armed) const {
    Payload payload;
    payload.add(static_cast<std::uint32_t>(time_us));
    for (std::size_t i = 0; i < kServos; ++i) {
      const double command = actuators_[i];
      const auto pulse = static_cast<std::uint16_t>(unsigned_clamped(1000.0 * command, 1000.0));
      payload.add(static_cast<std::uint16_t>(armed || command > 0.0 ? kLeastPulse + pulse : kDisarmedPulse));
    }
    return payload.finish();
  }

  std::uint64_t time_us = 0;
  bool aligned = false;
  bool located = false;

 private:
  Payload begin_ms() const { return Payload().milliseconds(time_us / 1000); }
  Payload begin_us() const { return Payload().add(time_us); }

  double yaw() const {
    return arctangent(2.0 * (q_[0] * q_[3] + q_[1] * q_[2]), 1.0 - 2.0 * (q_[2] * q_[2] + q_[3] * q_[3]));
  }

  double heading() const { return full_turn(degrees(yaw())); }

  double above_sea() const { return *origin_alt_ - position_[2]; }

  double over_home(std::optional<double> home_z) const { return home_z ? *home_z - position_[2] : -position_[2]; }

  static double finite(double value) {
    if (std::isnan(value)) reject("cannot convert float NaN to integer");
    return value;
  }

  /// Replace the origin (degrees) by the vehicle's position, as geo.reproject does.
  void reproject(double& latitude, double& longitude) const {
    const double x = position_[0] / earth_radius_, y = position_[1] / earth_radius_;
    const double angle = python_hypot(x, y);
    if (angle < 1e-15) return;
    const double phi0 = radians(latitude);
    const double sin_angle = sine(angle), cos_angle = cosine(angle);
    const double sin_phi = cos_angle * sine(phi0) + x * sin_angle * cosine(phi0) / angle;
    // min(max(sine, -1.0), 1.0) of Python, which keeps NaN
    double limited = sin_phi;
    if (sin_phi < -1.0) limited = -1.0;
    if (sin_phi > 1.0) limited = 1.0;
    const double phi = std::asin(limited);
    const double turn = arctangent(y * sin_angle, angle * cosine(phi0) * cos_angle - x * sine(phi0) * sin_angle);
    latitude = degrees(phi);
    longitude += degrees(turn);
  }

  const Reals q_, position_, velocity_, rates_, covariance_, origin_, origin_lon_, origin_alt_, terrain_;
  const Reals accel_, gyro_, mag_, baro_pressure_, baro_alt_, baro_temperature_;
  const Reals sp_q_, sp_rates_, sp_thrust_, sp_position_, sp_velocity_, sp_acceleration_, sp_yaw_, sp_yaw_rate_;
  const Reals actuators_;
  const Integers initialised_, altitude_valid_, origin_set_, terrain_valid_, reset_counter_;
  const std::size_t step_;  // from one element of the covariance's diagonal to the next
  const double earth_radius_;
};
}  // namespace

void bind_telemetry(nb::module_& module) {
  nb::class_<Samples>(module, "Samples", "Samples in the last HIGHRES_IMU on a link.").def(nb::init<>());
  nb::class_<Telemetry>(module, "Telemetry", "Payloads of one vehicle's telemetry, from the records in ``fields``.")
      .def(nb::init<nb::dict, std::size_t, double>(), nb::arg("fields"), nb::arg("states"), nb::arg("earth_radius"))
      .def("refresh", &Telemetry::refresh, nb::arg("now_us"))
      .def_ro("aligned", &Telemetry::aligned)
      .def_ro("located", &Telemetry::located)
      .def("attitude", &Telemetry::attitude)
      .def("attitude_quaternion", &Telemetry::attitude_quaternion)
      .def("local_position_ned", &Telemetry::local_position_ned)
      .def("global_position_int", &Telemetry::global_position_int, nb::arg("home_z").none())
      .def("altitude", &Telemetry::altitude, nb::arg("home_z").none())
      .def("vfr_hud", &Telemetry::vfr_hud, nb::arg("armed"))
      .def("odometry", &Telemetry::odometry)
      .def("highres_imu", &Telemetry::highres_imu, nb::arg("last"))
      .def("attitude_target", &Telemetry::attitude_target)
      .def("position_target_local_ned", &Telemetry::position_target_local_ned)
      .def("servo_output_raw", &Telemetry::servo_output_raw, nb::arg("armed"));
}
}  // namespace mavlink_wire
