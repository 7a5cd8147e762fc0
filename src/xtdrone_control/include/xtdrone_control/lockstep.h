// The former name of xtdrone_lockstep/lockstep.h.
#pragma once

#include "xtdrone_lockstep/lockstep.h"

namespace xtdrone_control {
namespace lockstep = xtdrone_lockstep;
}  // namespace xtdrone_control
