/// An idle participant, for measuring the cost of the barrier: `lockstep_idle NAME RATE`.

#include <ros/init.h>

#include <cstdlib>
#include <iostream>
#include <string>

#include "xtdrone_lockstep/lockstep.h"

namespace lockstep = xtdrone_lockstep;

int main(int argc, char** argv) {
  ros::V_string arguments;
  ros::removeROSArgs(argc, argv, arguments);
  char* end = nullptr;
  const double rate = arguments.size() == 3 ? std::strtod(arguments[2].c_str(), &end) : 0.0;
  if (end == nullptr || end == arguments[2].c_str() || *end != '\0') {
    std::cerr << "expected two arguments: a name and a rate in Hz\nusage: lockstep_idle NAME RATE" << std::endl;
    return 2;
  }
  try {
    lockstep::init(argc, argv, arguments[1], rate);
    lockstep::start();
    lockstep::spin();
  } catch (const lockstep::InitError& error) {
    std::cerr << error.what() << std::endl;
    return 1;
  } catch (const std::exception& error) {  // the name or the rate is invalid
    std::cerr << error.what() << "\nusage: lockstep_idle NAME RATE" << std::endl;
    return 2;
  }
  return lockstep::exitStatus();
}
